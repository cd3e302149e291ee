//! Writing the archive of a structure.

use std::collections::BTreeMap;

use sqlx::FromRow;
use tokio::sync::mpsc::Sender;

use super::super::column::{bad_row, elements, from_blob, list, timestamp};
use super::super::comparison::all_comparisons;
use super::super::current::CURRENT_FIRST;
use super::super::database::Database;
use super::super::error::Error;
use super::super::measurement_row::mode_shapes;
use super::super::reference_content::batches_of;
use super::super::sql::{self, Whole};
use super::super::structure::Structures;
use super::record::{
    Acknowledged, ArchivedModel, Batch, Maintenance, Measurement, Record, Structure, Undamaged, UndamagedQuantity,
    Version,
};
use crate::quantity::StructureId;

/// Batches read at a time.
const PAGE: i64 = 200;

/// Export and import of one structure.
#[derive(Clone, Copy)]
pub struct Archive<'s> {
    pub(in super::super) database: &'s Database,
}

#[derive(FromRow)]
struct ExportedMeasurement {
    batch_id: String,
    measured_at_us: i64,
    frequency_hz: Vec<u8>,
    std_hz: Option<Vec<u8>>,
    mode_shapes: Option<String>,
    covariates: String,
    settings: String,
}

/// Columns of a batch: id, source, idempotency key, content digest, time of arrival in µs, state, id of the token.
type BatchRow = (String, String, Option<String>, String, i64, String, Option<String>);

/// Columns of an undamaged reference: version, model digest, creation in µs, threshold probability, number of measurements,
/// conditions, doubts, joint probability, origin, process, why there is none.
type StateRow =
    (Whole<u32>, String, i64, f64, i64, String, String, Option<String>, Option<String>, Option<String>, Option<String>);

/// The error of an export whose receiver was dropped while records were still to be sent.
pub(super) fn receiver_dropped<T>(_: T) -> Error {
    Error::Row { what: "archive", detail: "the receiver of the export was dropped".to_owned() }
}

/// Digests of version and trained baseline, manifest, weights, and whether it is used although it failed its calibration check.
type ModelRow = (String, String, Vec<u8>, Vec<u8>, bool);

impl Archive<'_> {
    /// Sends the records of an archive between its first and its last line, in order, with the given trained baselines.
    ///
    /// # Errors
    /// [`Error::UnknownStructure`], [`Error::Sqlite`], [`Error::Row`] if the receiver was dropped.
    pub async fn export(
        self,
        structure: &StructureId,
        models: Vec<ArchivedModel>,
        records: &Sender<Record>,
    ) -> Result<(), Error> {
        let present = Structures { database: self.database }.structure(structure).await?;
        let present = present.ok_or_else(|| Error::UnknownStructure(structure.to_string()))?;
        let versions: Vec<(String, String, Option<String>, i64)> = sql::query_as(
            "select digest, definition, parent_digest, created_at_us from structure_version where structure_id = $1
             order by created_at_us, digest",
        )
        .bind(structure.as_str())
        .fetch_all(&self.database.reader)
        .await?;
        let present = Structure {
            digest: present.digest.to_string(),
            definition: present.definition_json,
            created_at: present.created_at.to_string(),
        };
        records.send(Record::Structure(present)).await.map_err(receiver_dropped)?;
        for (digest, definition, parent_digest, created) in versions {
            let created_at = timestamp("version", created)?.to_string();
            let version = Version { digest, definition, parent_digest, created_at };
            records.send(Record::Version(version)).await.map_err(receiver_dropped)?;
        }
        for model in models {
            records.send(Record::Model(model)).await.map_err(receiver_dropped)?;
        }
        self.export_batches(structure, records).await?;
        self.export_states(structure, records).await?;
        self.export_notes(structure, records).await?;
        self.export_people(structure, records).await
    }

    async fn export_batches(self, structure: &StructureId, records: &Sender<Record>) -> Result<(), Error> {
        let (mut received, mut last) = (i64::MIN, String::new());
        loop {
            let rows: Vec<BatchRow> = sql::query_as(
                "select batch_id, source, idempotency_key, content_digest, received_at_us, state, posted_by from measurement_batch
                 where structure_id = $1 and (received_at_us, batch_id) > ($2, $3) order by received_at_us, batch_id limit $4",
            )
            .bind(structure.as_str())
            .bind(received)
            .bind(&last)
            .bind(PAGE)
            .fetch_all(&self.database.reader)
            .await?;
            let Some(end) = rows.last() else { return Ok(()) };
            (received, last) = (end.4, end.0.clone());
            let ids: Vec<&String> = rows.iter().map(|row| &row.0).collect();
            let measured: Vec<ExportedMeasurement> = sql::query_as(concat!(
                "select batch_id, measured_at_us, frequency_hz, std_hz, mode_shapes, covariates, settings
                 from measurement where structure_id = $1 and batch_id in (select value from ",
                elements!("$2"),
                ") order by batch_id, ordinal",
            ))
            .bind(structure.as_str())
            .bind(list(&ids))
            .fetch_all(&self.database.reader)
            .await?;
            let mut by_batch = BTreeMap::<String, Vec<Measurement>>::new();
            for row in measured {
                by_batch.entry(row.batch_id.clone()).or_default().push(measurement(row)?);
            }
            let mut compared = self.comparisons(structure, &ids).await?;
            let ids: Vec<(String, bool)> = rows.iter().map(|row| (row.0.clone(), row.5 == "assessed")).collect();
            for (id, assessed) in ids {
                let found = compared.entry(id).or_default();
                // A batch that waits for the newest reference, or that failed, says nothing.
                found.stated = assessed || !found.kept.is_empty();
            }
            for (batch, source, idempotency_key, content_digest, received, _, posted_by) in rows {
                let measurements = by_batch.remove(&batch).unwrap_or_default();
                let received_at = timestamp("batch", received)?.to_string();
                let compared_with = compared.remove(&batch).and_then(Compared::versions);
                let record = Batch {
                    batch,
                    source,
                    idempotency_key,
                    posted_by,
                    content_digest,
                    received_at,
                    compared_with,
                    measurements,
                };
                records.send(Record::Batch(record)).await.map_err(receiver_dropped)?;
            }
        }
    }

    /// What batches were compared with, and are still to be compared with, by batch.
    async fn comparisons(self, structure: &StructureId, ids: &[&String]) -> Result<BTreeMap<String, Compared>, Error> {
        let select = format!(
            "select batch_id, undamaged_version, model_digest from assessment
             where structure_id = $1 and batch_id in (select value from {}) order by batch_id, {CURRENT_FIRST}",
            elements!("$2")
        );
        let assessed: Vec<(String, Whole<u32>, String)> = sql::query_as(sqlx::AssertSqlSafe(select))
            .bind(structure.as_str())
            .bind(list(ids))
            .fetch_all(&self.database.reader)
            .await?;
        let kept: Vec<(String, Whole<u32>)> = sql::query_as(concat!(
            "select batch_id, undamaged_version from kept_comparison where structure_id = $1 and batch_id in (select value from ",
            elements!("$2"),
            ") order by batch_id, position"
        ))
        .bind(structure.as_str())
        .bind(list(ids))
        .fetch_all(&self.database.reader)
        .await?;
        let mut all = BTreeMap::<String, Compared>::new();
        for (batch, Whole(version), model) in assessed {
            all.entry(batch).or_default().assessed.push((version, model));
        }
        for (batch, Whole(version)) in kept {
            all.entry(batch).or_default().kept.push(version);
        }
        Ok(all)
    }

    async fn export_states(self, structure: &StructureId, records: &Sender<Record>) -> Result<(), Error> {
        let rows: Vec<StateRow> = sql::query_as(
            "select version, model_digest, created_at_us, threshold_probability, measurement_count, conditions, doubts, joint,
                    origin, (select process from undamaged_process p where p.structure_id = s.structure_id and p.version = s.version),
                    (select reason from undamaged_process p where p.structure_id = s.structure_id and p.version = s.version)
             from undamaged_state s where structure_id = $1 order by version",
        )
        .bind(structure.as_str())
        .fetch_all(&self.database.reader)
        .await?;
        for row in rows {
            let (
                Whole(version),
                model_digest,
                created,
                threshold_probability,
                measurements,
                conditions,
                doubts,
                joint,
                origin,
                process,
                without,
            ) = row;
            let batches = batches_of(self.database, structure, version).await?;
            let quantities: Vec<UndamagedQuantity> = sql::query_as(
                "select quantity, position, mean, std, threshold, detail, mean_draws, std_draws
                 from undamaged_quantity where structure_id = $1 and version = $2 order by position",
            )
            .bind(structure.as_str())
            .bind(version)
            .fetch_all(&self.database.reader)
            .await?;
            let state = Undamaged {
                version,
                model_digest,
                created_at: timestamp("undamaged reference", created)?.to_string(),
                threshold_probability,
                measurements,
                conditions,
                doubts,
                joint,
                process,
                without_process: without,
                origin,
                batches,
                quantities,
            };
            records.send(Record::UndamagedReference(state)).await.map_err(receiver_dropped)?;
        }
        Ok(())
    }

    async fn export_notes(self, structure: &StructureId, records: &Sender<Record>) -> Result<(), Error> {
        let windows: Vec<(i64, i64, String, i64)> = sql::query_as(
            "select from_us, to_us, reason, created_at_us from maintenance_window where structure_id = $1 order by from_us, to_us",
        )
        .bind(structure.as_str())
        .fetch_all(&self.database.reader)
        .await?;
        let time = |micros| timestamp("maintenance window", micros).map(|t| t.to_string());
        for (from, to, reason, created) in windows {
            let window = Maintenance { from: time(from)?, to: time(to)?, reason, created_at: time(created)? };
            records.send(Record::Maintenance(window)).await.map_err(receiver_dropped)?;
        }
        let seen: Vec<AcknowledgedRow> = sql::query_as(
            "select kind, series, undamaged_version, opened_batch, acknowledged_at_us, acknowledged_by, acknowledgement_note
             from alarm_episode where structure_id = $1 and acknowledged_at_us is not null and acknowledged_by is not null
               and opened_batch is not null and withdrawn = 0 order by episode",
        )
        .bind(structure.as_str())
        .fetch_all(&self.database.reader)
        .await?;
        for (kind, series, Whole(version), opened_batch, at, by, note) in seen {
            let at = timestamp("acknowledgement", at)?.to_string();
            let undamaged_version = Some(version);
            let record = Acknowledged { kind, series, undamaged_version, opened_batch, at, by, note };
            records.send(Record::Acknowledgement(record)).await.map_err(receiver_dropped)?;
        }
        Ok(())
    }

    /// The trained baselines that the service made for the versions of a structure.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn trained_models(self, structure: &StructureId) -> Result<Vec<ArchivedModel>, Error> {
        let rows: Vec<ModelRow> = sql::query_as(
            "select structure_digest, model_digest, manifest, weights, accepted from trained_baseline
             where structure_id = $1 order by created_at_us, structure_digest",
        )
        .bind(structure.as_str())
        .fetch_all(&self.database.reader)
        .await?;
        let model = |(version, digest, manifest, weights, accepted): ModelRow| {
            ArchivedModel::new(&version, &digest, &manifest, &weights, accepted)
        };
        Ok(rows.into_iter().map(model).collect())
    }
}

/// Kind, series, version of the reference, opening batch, time in µs, person and note of an acknowledgement.
type AcknowledgedRow = (String, String, Whole<u32>, String, i64, String, Option<String>);

/// What a batch was compared with.
#[derive(Default)]
struct Compared {
    /// Undamaged reference and trained baseline of its assessments, the current one first.
    assessed: Vec<(u32, String)>,
    /// References that it is still to be compared with.
    kept: Vec<u32>,
    /// Whether this is all that it is compared with.
    stated: bool,
}

impl Compared {
    /// What it is compared with by the importing installation, if this is known.
    fn versions(self) -> Option<Vec<u32>> {
        let all = all_comparisons(self.assessed, self.kept);
        (self.stated && !all.is_empty()).then_some(all)
    }
}

fn measurement(row: ExportedMeasurement) -> Result<Measurement, Error> {
    let what = "measurement";
    let present = |values: Vec<f64>| values.into_iter().map(|v| Some(v).filter(|v| !v.is_nan())).collect();
    Ok(Measurement {
        measured_at: timestamp(what, row.measured_at_us)?.to_string(),
        frequencies_hz: present(from_blob(what, &row.frequency_hz)?),
        std_hz: row.std_hz.map(|blob| from_blob(what, &blob)).transpose()?.map(present),
        mode_shapes: mode_shapes(row.mode_shapes.as_deref())?,
        covariates: serde_json::from_str(&row.covariates).map_err(|e| bad_row(what)(&e))?,
        settings: serde_json::from_str(&row.settings).map_err(|e| bad_row(what)(&e))?,
    })
}
