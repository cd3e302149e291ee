//! Reading assessments.

use std::collections::btree_map::Entry;
use std::collections::BTreeMap;

use futures_util::TryStreamExt as _;
use sqlx::FromRow;

use super::assessment::{kind_of, Assessments};
use super::column::{bad_row, elements, from_blob, list, timestamp};
use super::current::CURRENT_FIRST;
use super::error::Error;
use super::sql::{self, Whole};
use crate::assessment::Assessment;
use crate::damage::{Damage, Hyperparameters, QuantityAssessment};
use crate::quantity::{Digest, StructureId};
use crate::trust::Trust;

#[derive(FromRow)]
struct AssessmentRow {
    model_digest: String,
    undamaged_version: Whole<u32>,
    structure_digest: String,
    seed: i64,
    draws_per_measurement: i64,
    measurements_used: i64,
    measurements_left_out: i64,
    measurements_outside: i64,
    misfit_percent: Vec<u8>,
    assessed_at_us: i64,
    effective_sample_size: Option<f64>,
    trust: Option<String>,
    joint: Option<String>,
}

#[derive(FromRow)]
struct QuantityAssessmentRow {
    quantity: String,
    unit: String,
    kind: String,
    mean: f64,
    std: Option<f64>,
    variance_within: f64,
    variance_between: Option<f64>,
    edge_mass: f64,
    threshold: Option<f64>,
    probability_of_damage: Option<f64>,
    exceeds: Option<bool>,
    relative_change: Option<f64>,
    mean_low: Option<f64>,
    mean_high: Option<f64>,
    std_low: Option<f64>,
    std_high: Option<f64>,
    pooled_mean: Option<f64>,
    pooled_std: Option<f64>,
    probability_low: Option<f64>,
    probability_high: Option<f64>,
    pooled_probability: Option<f64>,
    change_low: Option<f64>,
    change_high: Option<f64>,
    group_name: Option<String>,
    threshold_probability: Option<f64>,
}

impl Assessments<'_> {
    /// The current assessment of a batch, which is the newest.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn assessment(self, structure: &StructureId, batch_id: &str) -> Result<Option<Assessment>, Error> {
        let mut found = self.current_assessments(structure, &[batch_id.to_owned()], None).await?;
        found.remove(batch_id).transpose()
    }

    /// The current assessments of batches by batch id, with all quantities or only the given one; for one that cannot be read, why.
    pub(super) async fn current_assessments(
        self,
        structure: &StructureId,
        batch_ids: &[String],
        quantity: Option<&str>,
    ) -> Result<BTreeMap<String, Result<Assessment, Error>>, Error> {
        let ids = list(batch_ids);
        let select = format!(
            "select batch_id, model_digest, undamaged_version, structure_digest, seed, draws_per_measurement,
                    measurements_used, measurements_left_out, measurements_outside, misfit_percent, assessed_at_us,
                    effective_sample_size, trust, joint
             from assessment where structure_id = $1 and batch_id in (select value from {})
             order by batch_id, {CURRENT_FIRST}",
            elements!("$2")
        );
        let statement = sql::query_as::<AssessmentRow>(sqlx::AssertSqlSafe(select)).bind(structure.as_str()).bind(&ids);
        let mut rows = statement.rows(&self.database.reader);
        let mut current = BTreeMap::new();
        while let Some(row) = rows.try_next().await? {
            let batch: String = row.get(0)?;
            // The first assessment of each batch is the current one.
            if let Entry::Vacant(first) = current.entry(batch) {
                let read =
                    |row: AssessmentRow| Ok(((row.model_digest.clone(), row.undamaged_version.0), assessment(row)?));
                first.insert(row.read().map_err(Error::from).and_then(read));
            }
        }
        drop(rows);
        let statement = sql::query_as::<QuantityAssessmentRow>(concat!(
            "select batch_id, model_digest, undamaged_version, quantity, unit, kind, mean, std, variance_within,
                    variance_between, edge_mass, threshold, probability_of_damage, exceeds, relative_change, mean_low,
                    mean_high, std_low, std_high, pooled_mean, pooled_std, probability_low, probability_high,
                    pooled_probability, change_low, change_high, group_name,
                    (select threshold_probability from undamaged_state u
                     where u.structure_id = q.structure_id and u.version = q.undamaged_version) as threshold_probability
             from quantity_assessment q
             where structure_id = $1 and batch_id in (select value from ",
            elements!("$2"),
            ") and ($3 is null or quantity = $3)
             order by batch_id, position",
        ))
        .bind(structure.as_str())
        .bind(&ids)
        .bind(quantity);
        let mut rows = statement.rows(&self.database.reader);
        while let Some(row) = rows.try_next().await? {
            let Some(read) = current.get_mut(&row.get::<String>(0)?) else { continue };
            let Ok((key, assessment)) = read else { continue };
            if *key != (row.get::<String>(1)?, row.get::<Whole<u32>>(2)?.0) {
                continue;
            }
            match row.read().map_err(Error::from).and_then(quantity_assessment) {
                Ok(quantity) => assessment.quantities.push(quantity),
                Err(error) => *read = Err(error),
            }
        }
        let outcome = |(batch, read): (String, Result<(_, Assessment), Error>)| {
            if let Err(error) = &read {
                self.database.damaged.note(&format!("batch {batch} of {structure}"), error);
            }
            (batch, read.map(|(_, assessment)| assessment))
        };
        Ok(current.into_iter().map(outcome).collect())
    }
}

fn assessment(row: AssessmentRow) -> Result<Assessment, Error> {
    let joint = row.joint.as_deref().map(serde_json::from_str).transpose();
    Ok(Assessment {
        estimate: None,
        model_digest: Digest::from_stored(row.model_digest),
        structure_digest: Digest::from_stored(row.structure_digest),
        undamaged_version: Some(row.undamaged_version.0).filter(|version| *version > 0),
        seed: row.seed.cast_unsigned(),
        draws_per_measurement: row.draws_per_measurement as usize,
        measurements_used: row.measurements_used as usize,
        measurements_left_out: row.measurements_left_out as usize,
        measurements_outside: row.measurements_outside as usize,
        misfit_percent: from_blob("assessment", &row.misfit_percent)?.into_iter().map(present).collect(),
        effective_sample_size: row.effective_sample_size.unwrap_or(0.0),
        trust: match row.trust {
            Some(trust) => serde_json::from_str(&trust).map_err(|e| bad_row("assessment")(&e))?,
            None => Trust::unknown(),
        },
        assessed_at: timestamp("assessment", row.assessed_at_us)?,
        quantities: Vec::new(),
        joint: joint.map_err(|e| bad_row("assessment")(&e))?,
    })
}

fn quantity_assessment(row: QuantityAssessmentRow) -> Result<QuantityAssessment, Error> {
    let damage = match (row.threshold, row.probability_of_damage, row.exceeds, row.relative_change) {
        (Some(threshold), Some(probability_of_damage), Some(exceeds), Some(relative_change)) => Some(Damage {
            threshold,
            probability_of_damage,
            probability_interval: both(row.probability_low, row.probability_high),
            pooled_probability: row.pooled_probability.unwrap_or(probability_of_damage),
            pooled_exceeds: row.pooled_probability.zip(row.threshold_probability).map(|(share, p)| share > p),
            exceeds,
            relative_change,
            relative_change_interval: both(row.change_low, row.change_high),
        }),
        _ => None,
    };
    Ok(QuantityAssessment {
        kind: kind_of(&row.kind)?,
        name: row.quantity,
        unit: row.unit,
        mean: row.mean,
        mean_interval: both(row.mean_low, row.mean_high),
        std: row.std,
        std_interval: both(row.std_low, row.std_high),
        // Rows of versions without the population model contain the pooled moments in `mean` and `std`.
        pooled: Hyperparameters {
            mean: row.pooled_mean.unwrap_or(row.mean),
            std: row.pooled_mean.map_or(row.std, |_| row.pooled_std),
            within: row.variance_within,
            between: row.variance_between,
        },
        prior_bound_mass: row.edge_mass,
        group: row.group_name,
        effective_measurements: None,
        damage,
    })
}

fn both(low: Option<f64>, high: Option<f64>) -> Option<[f64; 2]> {
    Some([low?, high?])
}

fn present(value: f64) -> Option<f64> {
    Some(value).filter(|v| !v.is_nan())
}
