//! Series for plots: read row by row, reduced on the way, so that a window of any length needs the memory of a short one.
//!
//! A window is a set of batches: those that begin in it. Assessments are the current ones, as in the history, of batches that
//! are assessed and do not wait for another assessment.

use std::collections::BTreeMap;

use futures_util::TryStreamExt as _;
use serde::Deserialize;
use sqlx::Row as _;

use super::{bad_row, timestamp, Error, Store};
use crate::damage::QuantityKind;
use crate::quantity::{StructureId, Timestamp};
use crate::reduction::{Reduced, Reducer};
use crate::trust::{FindingCode, TrustVerdict};

/// Most measurements that are looked at for one answer; of more, every second, third … is.
const MOST_MEASUREMENTS: u64 = 500_000;

/// Part of the history that is wanted, and how much of it is to be left.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SeriesWindow {
    /// Batches that begin at or after this time.
    pub from: Option<Timestamp>,
    /// Batches that begin before this time.
    pub to: Option<Timestamp>,
    /// Rows of a series that are kept without a reduction; half of those that one channel of a longer one keeps at most.
    pub points: usize,
}

/// What lies in a window.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Extent {
    /// Batches.
    pub batches: u64,
    /// Their measurements.
    pub measurements: u64,
    /// The first and the last time of a measurement; `None` without batches.
    pub measured: Option<(Timestamp, Timestamp)>,
}

impl Extent {
    /// Every how many measurements one is looked at: 1 unless there are too many of them.
    pub fn stride(&self) -> u64 {
        self.measurements.div_ceil(MOST_MEASUREMENTS).max(1)
    }

    pub(super) fn span(&self) -> (i64, i64) {
        self.measured.map_or((0, 0), |(from, to)| (from.micros(), to.micros()))
    }
}

/// A monitored quantity over the batches of a window.
#[derive(Debug, Clone, PartialEq)]
pub struct QuantitySeries {
    /// Its name.
    pub name: String,
    /// Its unit.
    pub unit: String,
    /// What it is.
    pub kind: QuantityKind,
    /// Batches by the end of their measurements; the values are the mean of the population and the probability of damage.
    pub batches: Reduced<QuantityMark>,
}

/// What a batch of a quantity carries besides mean and probability of damage.
#[derive(Debug, Clone, PartialEq)]
pub struct QuantityMark {
    /// The batch.
    pub batch: String,
    /// 90 % credible interval of the mean.
    pub mean_interval: [Option<f64>; 2],
    /// 90 % credible interval of the probability of damage.
    pub probability_interval: [Option<f64>; 2],
}

/// An alarm chart over a window.
#[derive(Debug, Clone, PartialEq)]
pub struct ChartSeries {
    /// Parameter, or [`crate::alarm::chart::FIT_SERIES`].
    pub chart: String,
    /// Points by the end of their batch; the values are the shift and the moving average.
    pub points: Reduced<ChartMark>,
}

/// What a point of a chart carries besides its values.
#[derive(Debug, Clone, PartialEq)]
pub struct ChartMark {
    /// The batch.
    pub batch: String,
    /// Limit of one shift.
    pub shift_limit: f64,
    /// Limit of the moving average.
    pub ewma_limit: Option<f64>,
    /// True when it moved nothing.
    pub held: bool,
    /// State after it.
    pub state: String,
}

/// How far a batch can be believed; its p-value is the first value of its row.
#[derive(Debug, Clone, PartialEq)]
pub struct TrustMark {
    /// The batch.
    pub batch: String,
    /// The verdict.
    pub verdict: TrustVerdict,
    /// What was found, each code once.
    pub findings: Vec<FindingCode>,
}

impl Store {
    /// What lies in a window.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn extent(&self, structure: &StructureId, window: SeriesWindow) -> Result<Extent, Error> {
        let (from, to) = bounds(window);
        let (batches, measurements, first, last): (i64, i64, Option<i64>, Option<i64>) = sqlx::query_as(
            "select count(*), coalesce(sum(measurement_count), 0), min(measured_from_us), max(measured_to_us)
             from measurement_batch where structure_id = ? and measured_from_us >= ? and measured_from_us < ?",
        )
        .bind(structure.as_str())
        .bind(from)
        .bind(to)
        .fetch_one(&self.reader)
        .await?;
        let measured = match (first, last) {
            (Some(first), Some(last)) => Some((timestamp("batch", first)?, timestamp("batch", last)?)),
            _ => None,
        };
        Ok(Extent { batches: batches.unsigned_abs(), measurements: measurements.unsigned_abs(), measured })
    }

    /// Measured frequencies by time: one value a mode, then one a covariate of the given names; text is no value.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn frequency_series(
        &self,
        structure: &StructureId,
        window: SeriesWindow,
        extent: &Extent,
        modes: usize,
        covariates: &[String],
    ) -> Result<Reduced<()>, Error> {
        let what = "measurement";
        let (from, to) = bounds(window);
        let stride = extent.stride();
        let joined = "from measurement_batch b join measurement m using (structure_id, batch_id)
             where b.structure_id = ?1 and b.measured_from_us >= ?2 and b.measured_from_us < ?3";
        let columns = "measured_at_us, frequency_hz, covariates";
        let select = if stride == 1 {
            format!("select {columns} {joined} order by b.measured_from_us, b.batch_id")
        } else {
            // Thrown away before they leave SQLite: handing a row over costs more than finding it.
            format!(
                "select {columns} from (select {columns}, row_number() over () as number {joined})
                 where number % {stride} = 1"
            )
        };
        let mut rows =
            sqlx::query(sqlx::AssertSqlSafe(select)).bind(structure.as_str()).bind(from).bind(to).fetch(&self.reader);
        let mut reducer = Reducer::new(extent.span(), window.points, modes + covariates.len());
        let mut values = Vec::with_capacity(modes + covariates.len());
        while let Some(row) = rows.try_next().await? {
            values.clear();
            let (blocks, rest) = row.try_get_unchecked::<&[u8], _>(1)?.as_chunks::<8>();
            if !rest.is_empty() {
                return Err(bad_row(what)(&"a vector that is no whole number of values"));
            }
            values.extend(blocks.iter().take(modes).map(|block| f64::from_le_bytes(*block)));
            values.resize(modes, f64::NAN);
            if !covariates.is_empty() {
                let text = row.try_get_unchecked::<&str, _>(2)?;
                let given: BTreeMap<&str, Covariate<'_>> = serde_json::from_str(text).map_err(|e| bad_row(what)(&e))?;
                values
                    .extend(covariates.iter().map(|name| given.get(name.as_str()).map_or(f64::NAN, Covariate::number)));
            }
            reducer.push(row.try_get_unchecked(0)?, &values, || ());
        }
        Ok(reducer.finish())
    }

    /// The charts under the newest undamaged state: points of batches that end in the window.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn chart_series(
        &self,
        structure: &StructureId,
        window: SeriesWindow,
        extent: &Extent,
    ) -> Result<Vec<ChartSeries>, Error> {
        let (from, to) = bounds(window);
        let (version,): (u32,) =
            sqlx::query_as("select coalesce(max(version), 0) from undamaged_state where structure_id = ?")
                .bind(structure.as_str())
                .fetch_one(&self.reader)
                .await?;
        let mut all = Vec::new();
        for (version, chart) in self.chart_names(structure.as_str(), version).await? {
            let mut rows = sqlx::query(
                "select measured_to_us, shift, ewma, batch_id, shift_limit, ewma_limit, held, state from chart_point
                 where structure_id = ? and undamaged_version = ? and series = ?
                   and measured_to_us >= ? and measured_to_us < ?",
            )
            .bind(structure.as_str())
            .bind(version)
            .bind(&chart)
            .bind(from)
            .bind(to)
            .fetch(&self.reader);
            let mut reducer = Reducer::new(extent.span(), window.points, 2);
            while let Some(row) = rows.try_next().await? {
                let values = [row.try_get_unchecked(1)?, row.try_get_unchecked(2)?];
                let mark = || {
                    Ok(ChartMark {
                        batch: row.try_get_unchecked(3)?,
                        shift_limit: row.try_get_unchecked(4)?,
                        ewma_limit: row.try_get_unchecked(5)?,
                        held: row.try_get_unchecked(6)?,
                        state: row.try_get_unchecked(7)?,
                    })
                };
                reducer.try_push(row.try_get_unchecked(0)?, &values, mark).map_err(|e: sqlx::Error| Error::from(e))?;
            }
            drop(rows);
            all.push(ChartSeries { chart, points: reducer.finish() });
        }
        all.retain(|chart| !chart.points.rows.is_empty());
        Ok(all)
    }
}

/// A covariate as it is stored; only numbers can be drawn.
#[derive(Deserialize)]
#[serde(untagged)]
enum Covariate<'a> {
    Number(f64),
    #[allow(dead_code, reason = "a category is told apart from a number, and not looked at")]
    Category(&'a str),
    #[allow(dead_code, reason = "one with escapes in it")]
    Escaped(String),
}

impl Covariate<'_> {
    fn number(&self) -> f64 {
        match self {
            Self::Number(value) => *value,
            _ => f64::NAN,
        }
    }
}

pub(super) fn bounds(window: SeriesWindow) -> (i64, i64) {
    (window.from.map_or(i64::MIN, Timestamp::micros), window.to.map_or(i64::MAX, Timestamp::micros))
}
