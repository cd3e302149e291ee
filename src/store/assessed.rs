//! Time series of assessments: monitored quantities, and the trust in the batches.

use std::collections::{BTreeMap, HashMap};

use futures_util::TryStreamExt as _;
use serde::Deserialize;

use super::assessment::kind_of;
use super::column::{bad_row, elements, list};
use super::current::IS_CURRENT;
use super::error::Error;
use super::plotted::{trust_values, Plotted};
use super::series::{bounds, AssessedSeries, Extent, QuantityMark, QuantitySeries, Series, SeriesWindow, TrustMark};
use super::sql::{self, Row as StoredRow, Whole};
use crate::damage::QuantityKind;
use crate::quantity::StructureId;
use crate::reduction::{Reduced, Reducer, Row};
use crate::trust::{FindingCode, TrustVerdict};

/// The part of a stored trust that a series contains.
#[derive(Deserialize)]
struct SeriesTrust {
    verdict: TrustVerdict,
    p_value: Option<f64>,
    findings: Vec<FindingColumn>,
}

#[derive(Deserialize)]
struct FindingColumn {
    code: FindingCode,
}

impl SeriesTrust {
    fn of(text: Option<&str>) -> Result<Self, Error> {
        match text {
            Some(text) => serde_json::from_str(text).map_err(|e| bad_row("assessment")(&e)),
            // Assessments of early versions have no trust.
            None => Ok(Self { verdict: TrustVerdict::Accepted, p_value: None, findings: Vec::new() }),
        }
    }
}

/// A quantity whose series is read.
struct Track {
    name: String,
    unit: String,
    kind: QuantityKind,
    position: i64,
    batches: Reducer<QuantityMark>,
}

/// The series that are being read.
struct Tracks {
    extent: Extent,
    points: usize,
    quantities: Vec<Track>,
    /// Index of a quantity by its name.
    indices: HashMap<String, usize>,
    /// Batches with p-value, 1 if rejected, and number of findings.
    trust: Reducer<String>,
    /// Number of rows that cannot be read.
    left_out: u64,
}

impl Tracks {
    fn new(extent: Extent, points: usize) -> Self {
        let trust = Reducer::new(extent.span(), points, 3);
        Self { extent, points, quantities: Vec::new(), indices: HashMap::new(), trust, left_out: 0 }
    }

    /// Index of a quantity, which is added if its name is new.
    fn index_of(&mut self, (name, unit, kind, position): (String, String, QuantityKind, i64)) -> usize {
        if let Some(index) = self.indices.get(&name) {
            return *index;
        }
        let index = self.quantities.len();
        self.indices.insert(name.clone(), index);
        let batches = Reducer::new(self.extent.span(), self.points, 2);
        self.quantities.push(Track { name, unit, kind, position, batches });
        index
    }
}

impl Series<'_> {
    /// Monitored quantities of the assessed batches of a window, in the order of their position, and the trust in these batches.
    /// When the series is reduced, rejected batches and those with the most findings are kept. Rows that cannot be read are left out and
    /// counted.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn assessed_series(
        self,
        structure: &StructureId,
        window: SeriesWindow,
        extent: &Extent,
    ) -> Result<AssessedSeries, Error> {
        let mut tracks = Tracks::new(*extent, window.points);
        let all_are_plotted = self.read_plotted(structure, window, &mut tracks).await?;
        if !all_are_plotted {
            self.read_unplotted(structure, window, &mut tracks).await?;
        }
        let (trust, without_trust) = self.with_findings(structure, tracks.trust.finish()).await?;
        let left_out = tracks.left_out + without_trust;
        let mut quantities = tracks.quantities;
        quantities.sort_by(|a, b| (a.position, &a.name).cmp(&(b.position, &b.name)));
        let series =
            |Track { name, unit, kind, batches, .. }| QuantitySeries { name, unit, kind, batches: batches.finish() };
        Ok(AssessedSeries { quantities: quantities.into_iter().map(series).collect(), trust, left_out })
    }

    /// Reads the assessments that have the packed column for plots. Returns whether all of the window have it.
    async fn read_plotted(
        self,
        structure: &StructureId,
        window: SeriesWindow,
        tracks: &mut Tracks,
    ) -> Result<bool, Error> {
        let (from, to) = bounds(window);
        let select = format!(
            "select b.measured_to_us, b.batch_id, a.model_digest, a.undamaged_version, a.plotted
             from measurement_batch b cross join assessment a
             where a.structure_id = b.structure_id and a.batch_id = b.batch_id
               and b.structure_id = $1 and b.measured_from_us >= $2 and b.measured_from_us < $3
               and b.state = 'assessed' and {IS_CURRENT}
             order by b.measured_from_us, b.batch_id"
        );
        let mut rows = sql::query(sqlx::AssertSqlSafe(select))
            .bind(structure.as_str())
            .bind(from)
            .bind(to)
            .fetch(&self.database.reader);
        // The quantities of an assessment depend on its trained baseline only.
        let mut known: HashMap<String, Vec<usize>> = HashMap::new();
        let mut all_are_plotted = true;
        while let Some(row) = rows.try_next().await? {
            let (time, batch): (i64, &str) = (row.get(0)?, row.get(1)?);
            let Some(packed) = row.get::<Option<&[u8]>>(4)? else {
                all_are_plotted = false;
                continue;
            };
            let model: &str = row.get(2)?;
            if !known.contains_key(model) {
                let Whole(version) = row.get(3)?;
                let quantities = match self.quantities_of(structure, batch, model, version).await {
                    Ok(quantities) => quantities,
                    Err(error) => {
                        self.leave_out(structure, batch, error, tracks)?;
                        continue;
                    }
                };
                let indices = quantities.into_iter().map(|quantity| tracks.index_of(quantity)).collect();
                known.insert(model.to_owned(), indices);
            }
            let indices = &known[model];
            let plotted = match Plotted::read(packed, indices.len()) {
                Ok(plotted) => plotted,
                Err(error) => {
                    self.leave_out(structure, batch, error, tracks)?;
                    continue;
                }
            };
            tracks.trust.push(time, &plotted.trust(), || batch.to_owned());
            for (position, index) in indices.iter().enumerate() {
                let quantity = plotted.quantity(position);
                let mark = || QuantityMark {
                    batch: batch.to_owned(),
                    mean_interval: quantity.mean_interval,
                    probability_interval: quantity.probability_interval,
                };
                let values = [quantity.mean, quantity.probability];
                tracks.quantities[*index].batches.push(time, &values, mark);
            }
        }
        Ok(all_are_plotted)
    }

    /// Counts and remembers a batch of which a row cannot be read.
    fn leave_out(self, structure: &StructureId, batch: &str, error: Error, tracks: &mut Tracks) -> Result<(), Error> {
        tracks.left_out += 1;
        self.database.damaged.remember(&format!("batch {batch} of {structure}"), error)
    }

    /// The quantities of an assessment by their position: name, unit, kind, position.
    async fn quantities_of(
        self,
        structure: &StructureId,
        batch: &str,
        model: &str,
        undamaged_version: u32,
    ) -> Result<Vec<(String, String, QuantityKind, i64)>, Error> {
        let rows: Vec<(String, String, String, i64)> = sql::query_as(
            "select quantity, unit, kind, position from quantity_assessment
             where structure_id = $1 and batch_id = $2 and model_digest = $3 and undamaged_version = $4 order by position",
        )
        .bind(structure.as_str())
        .bind(batch)
        .bind(model)
        .bind(undamaged_version)
        .fetch_all(&self.database.reader)
        .await?;
        rows.into_iter().map(|(name, unit, kind, position)| Ok((name, unit, kind_of(&kind)?, position))).collect()
    }

    /// Reads the assessments of early versions, which have no packed column for plots, from the rows of their quantities.
    async fn read_unplotted(
        self,
        structure: &StructureId,
        window: SeriesWindow,
        tracks: &mut Tracks,
    ) -> Result<(), Error> {
        let (from, to) = bounds(window);
        let of_window = format!(
            "where a.structure_id = b.structure_id and a.batch_id = b.batch_id
               and b.structure_id = $1 and b.measured_from_us >= $2 and b.measured_from_us < $3
               and b.state = 'assessed' and a.plotted is null and {IS_CURRENT}"
        );
        let select = format!(
            "select b.measured_to_us, b.batch_id, a.trust
             from measurement_batch b cross join assessment a {of_window}
             order by b.measured_from_us, b.batch_id"
        );
        let mut rows = sql::query(sqlx::AssertSqlSafe(select))
            .bind(structure.as_str())
            .bind(from)
            .bind(to)
            .fetch(&self.database.reader);
        while let Some(row) = rows.try_next().await? {
            let trust = match SeriesTrust::of(row.get(2)?) {
                Ok(trust) => trust,
                Err(error) => {
                    self.leave_out(structure, row.get(1)?, error, tracks)?;
                    continue;
                }
            };
            let values = trust_values(trust.p_value, trust.verdict, trust.findings.len());
            let batch = || row.get(1);
            tracks.trust.try_push(row.get(0)?, &values, batch).map_err(sqlx_error)?;
        }
        drop(rows);
        // Joined in this order, the current assessment is determined once per batch and not once per quantity.
        let select = format!(
            "select q.quantity, b.measured_to_us, q.mean, q.probability_of_damage, b.batch_id, q.mean_low, q.mean_high,
                    q.probability_low, q.probability_high, q.unit, q.kind, q.position
             from measurement_batch b
             cross join assessment a
             cross join quantity_assessment q
             {of_window}
               and q.structure_id = a.structure_id and q.batch_id = a.batch_id and q.model_digest = a.model_digest
               and q.undamaged_version = a.undamaged_version
             order by b.measured_from_us, b.batch_id, q.position"
        );
        let mut rows = sql::query(sqlx::AssertSqlSafe(select))
            .bind(structure.as_str())
            .bind(from)
            .bind(to)
            .fetch(&self.database.reader);
        while let Some(row) = rows.try_next().await? {
            let name: &str = row.get(0)?;
            let index = match tracks.indices.get(name) {
                Some(index) => *index,
                None => match named(&row) {
                    Ok(quantity) => tracks.index_of(quantity),
                    Err(error) => {
                        self.leave_out(structure, row.get(4)?, error, tracks)?;
                        continue;
                    }
                },
            };
            let number = |column: usize| row.get::<Option<f64>>(column);
            let values = [row.get(2)?, number(3)?.unwrap_or(f64::NAN)];
            let mark = || {
                Ok(QuantityMark {
                    batch: row.get(4)?,
                    mean_interval: [number(5)?, number(6)?],
                    probability_interval: [number(7)?, number(8)?],
                })
            };
            let batches = &mut tracks.quantities[index].batches;
            batches.try_push(row.get(1)?, &values, mark).map_err(sqlx_error)?;
        }
        Ok(())
    }

    /// Looks up the findings of the batches that are kept. Returns also the number of those whose findings cannot be read.
    async fn with_findings(
        self,
        structure: &StructureId,
        kept: Reduced<String>,
    ) -> Result<(Reduced<TrustMark>, u64), Error> {
        let batches: Vec<&String> = kept.rows.iter().map(|row| &row.tag).collect();
        let select = format!(
            "select a.batch_id, a.trust from assessment a
             where a.structure_id = $1 and a.batch_id in (select value from {}) and {IS_CURRENT}",
            elements!("$2")
        );
        let found: Vec<(String, Option<String>)> = sql::query_as(sqlx::AssertSqlSafe(select))
            .bind(structure.as_str())
            .bind(list(&batches))
            .fetch_all(&self.database.reader)
            .await?;
        let found: BTreeMap<String, Option<String>> = found.into_iter().collect();
        let (mut rows, mut left_out) = (Vec::new(), 0);
        for Row { time_us, values, tag: batch } in kept.rows {
            let trust = match SeriesTrust::of(found.get(&batch).and_then(Option::as_deref)) {
                Ok(trust) => trust,
                Err(error) => {
                    left_out += 1;
                    self.database.damaged.remember(&format!("batch {batch} of {structure}"), error)?;
                    continue;
                }
            };
            let mut findings: Vec<FindingCode> = Vec::new();
            for finding in trust.findings {
                if !findings.contains(&finding.code) {
                    findings.push(finding.code);
                }
            }
            rows.push(Row { time_us, values, tag: TrustMark { batch, verdict: trust.verdict, findings } });
        }
        Ok((Reduced { rows, gaps: kept.gaps, reduced: kept.reduced }, left_out))
    }
}

fn named(row: &StoredRow) -> Result<(String, String, QuantityKind, i64), Error> {
    let kind = kind_of(row.get(10)?)?;
    Ok((row.get(0)?, row.get(9)?, kind, row.get(11)?))
}

fn sqlx_error(error: sqlx::Error) -> Error {
    error.into()
}
