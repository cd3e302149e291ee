//! Time series for plots. They are read row by row and reduced at the same time, so that the memory does not grow with the window.
//!
//! A window consists of the batches that begin in it. As in the history, assessments are the current ones; batches that wait for
//! another assessment are left out.

use std::collections::BTreeMap;

use futures_util::TryStreamExt as _;
use serde::Deserialize;

use super::column::{bad_row, timestamp};
use super::database::Database;
use super::error::Error;
use super::sql::{self, Row};
use crate::damage::QuantityKind;
use crate::quantity::{StructureId, Timestamp};
use crate::reduction::{Reduced, Reducer};
use crate::trust::{FindingCode, TrustVerdict};

/// Largest number of measurements that is read for one series. Of longer series, every second, third … measurement is read.
const MOST_MEASUREMENTS: u64 = 500_000;

/// Selects part of the history, and how far its series are reduced.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SeriesWindow {
    /// Batches that begin at or after this time.
    pub from: Option<Timestamp>,
    /// Batches that begin before this time.
    pub to: Option<Timestamp>,
    /// Largest number of rows of a series that is not reduced. A reduced series keeps at most twice as many rows for each channel.
    pub points: usize,
}

/// The extent of a window.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Extent {
    /// Number of batches.
    pub batches: u64,
    /// Number of their measurements.
    pub measurements: u64,
    /// Times of the first and the last measurement; `None` without batches.
    pub measured: Option<(Timestamp, Timestamp)>,
}

impl Extent {
    /// The step at which measurements are read: 1 unless there are too many.
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
    /// Its kind.
    pub kind: QuantityKind,
    /// Batches by the time of their last measurement. The values are the population mean and the probability of damage.
    pub batches: Reduced<QuantityMark>,
}

/// What a batch of a quantity has besides mean and probability of damage.
#[derive(Debug, Clone, PartialEq)]
pub struct QuantityMark {
    /// The batch.
    pub batch: String,
    /// 90 % credible interval of the mean.
    pub mean_interval: [Option<f64>; 2],
    /// 90 % credible interval of the probability of damage.
    pub probability_interval: [Option<f64>; 2],
}

/// The trust in a batch. Its p-value is the first value of its row.
#[derive(Debug, Clone, PartialEq)]
pub struct TrustMark {
    /// The batch.
    pub batch: String,
    /// The verdict.
    pub verdict: TrustVerdict,
    /// Codes of the findings, each once.
    pub findings: Vec<FindingCode>,
}

/// Monitored quantities over the batches of a window.
#[derive(Debug, Clone, PartialEq)]
pub struct AssessedSeries {
    /// The quantities, by their position.
    pub quantities: Vec<QuantitySeries>,
    /// The trust in the batches.
    pub trust: Reduced<TrustMark>,
    /// Number of stored rows that cannot be read and are left out.
    pub left_out: u64,
}

/// Time series for plots.
#[derive(Clone, Copy)]
pub struct Series<'s> {
    pub(super) database: &'s Database,
}

impl Series<'_> {
    /// The extent of a window.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn extent(self, structure: &StructureId, window: SeriesWindow) -> Result<Extent, Error> {
        let (from, to) = bounds(window);
        let (batches, measurements, first, last): (i64, i64, Option<i64>, Option<i64>) = sql::query_as(
            "select count(*), coalesce(cast(sum(measurement_count) as bigint), 0), min(measured_from_us), max(measured_to_us)
             from measurement_batch where structure_id = $1 and measured_from_us >= $2 and measured_from_us < $3",
        )
        .bind(structure.as_str())
        .bind(from)
        .bind(to)
        .fetch_one(&self.database.reader)
        .await?;
        let measured = match (first, last) {
            (Some(first), Some(last)) => Some((timestamp("batch", first)?, timestamp("batch", last)?)),
            _ => None,
        };
        Ok(Extent { batches: batches.unsigned_abs(), measurements: measurements.unsigned_abs(), measured })
    }

    /// Measurements by time: the frequency of each mode in Hz, then the value of each named covariate. A missing value and a
    /// covariate that is not a number are NaN. Also the number of measurements that cannot be read and are left out.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn frequency_series(
        self,
        structure: &StructureId,
        window: SeriesWindow,
        extent: &Extent,
        modes: usize,
        covariates: &[String],
    ) -> Result<(Reduced<()>, u64), Error> {
        let (from, to) = bounds(window);
        let stride = extent.stride();
        let joined = "from measurement_batch b join measurement m using (structure_id, batch_id)
             where b.structure_id = $1 and b.measured_from_us >= $2 and b.measured_from_us < $3";
        let columns = "measured_at_us, frequency_hz, covariates, batch_id";
        let select = if stride == 1 {
            format!("select {columns} {joined} order by b.measured_from_us, b.batch_id, m.ordinal")
        } else {
            // Skipped inside the database, because returning a row costs more than finding it.
            format!(
                "select {columns} from (select {columns},
                     row_number() over (order by b.measured_from_us, b.batch_id, m.ordinal) as number {joined}) numbered
                 where number % {stride} = 1 order by number"
            )
        };
        let mut rows = sql::query(sqlx::AssertSqlSafe(select))
            .bind(structure.as_str())
            .bind(from)
            .bind(to)
            .fetch(&self.database.reader);
        let mut reducer = Reducer::new(extent.span(), window.points, modes + covariates.len());
        let mut values = Vec::with_capacity(modes + covariates.len());
        let mut left_out = 0;
        while let Some(row) = rows.try_next().await? {
            values.clear();
            let time_us = row.get(0)?;
            match read_values(&row, modes, covariates, &mut values) {
                Ok(()) => reducer.push(time_us, &values, || ()),
                Err(error) => {
                    left_out += 1;
                    let batch: &str = row.get(3)?;
                    self.database.damaged.remember(&format!("batch {batch} of {structure}"), error)?;
                }
            }
        }
        Ok((reducer.finish(), left_out))
    }
}

/// Frequencies and covariates of a row of [`Series::frequency_series`].
fn read_values(row: &Row, modes: usize, covariates: &[String], values: &mut Vec<f64>) -> Result<(), Error> {
    let bad = bad_row("measurement");
    let (blocks, rest) = row.get::<&[u8]>(1)?.as_chunks::<8>();
    if !rest.is_empty() {
        return Err(bad(&"the length of a vector is not a multiple of 8 bytes"));
    }
    values.extend(blocks.iter().take(modes).map(|block| f64::from_le_bytes(*block)));
    values.resize(modes, f64::NAN);
    if !covariates.is_empty() {
        let given: BTreeMap<&str, Covariate<'_>> = serde_json::from_str(row.get::<&str>(2)?).map_err(|e| bad(&e))?;
        values.extend(covariates.iter().map(|name| given.get(name.as_str()).map_or(f64::NAN, Covariate::number)));
    }
    Ok(())
}

/// A stored covariate. Only numbers can be plotted.
#[derive(Deserialize)]
#[serde(untagged)]
enum Covariate<'a> {
    Number(f64),
    #[allow(dead_code, reason = "distinguishes a category from a number, and is not read")]
    Category(&'a str),
    #[allow(dead_code, reason = "a category with escaped characters, which cannot be borrowed")]
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
