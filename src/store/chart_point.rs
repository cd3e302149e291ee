//! Points of alarm charts as they are stored, and reading them.

use sqlx::FromRow;

use super::alarm::Alarms;
use super::column::{bad_row, timestamp};
use super::error::Error;
use super::sql::{self, Whole};
use crate::alarm::chart::{ChartPoint, Series};
use crate::alarm::machine::State;
use crate::quantity::{StructureId, Timestamp};

/// Moving averages that differ by less than this are treated as equal, because they differ by rounding only.
const SAME: f64 = 1e-9;

/// A stored point of a chart.
#[derive(Debug, Clone, PartialEq)]
pub struct StoredChartPoint {
    /// The batch.
    pub batch_id: String,
    /// Time of the last measurement of the batch.
    pub measured_to: Timestamp,
    /// The parameter, or [`crate::alarm::chart::FIT_SERIES`].
    pub series: String,
    /// Shift towards damage, in standard errors.
    pub shift: f64,
    /// Limit of a single shift.
    pub shift_limit: f64,
    /// Moving average of the shifts.
    pub ewma: f64,
    /// Limit of the moving average; `None` if there is none.
    pub ewma_limit: Option<f64>,
    /// Probability of damage that corresponds to the limit.
    pub probability_limit: Option<f64>,
    /// True if the point does not change the chart, for example because of maintenance.
    pub held: bool,
    /// State of the chart after this point.
    pub state: String,
}

#[derive(FromRow)]
pub(super) struct PointRow {
    pub measured_to_us: i64,
    pub batch_id: String,
    pub series: String,
    pub shift: f64,
    pub shift_limit: f64,
    pub ewma_limit: Option<f64>,
    pub probability_limit: Option<f64>,
    pub held: bool,
    pub ewma: f64,
    pub above: bool,
    pub state: String,
    pub slow: Option<f64>,
}

impl PointRow {
    /// Its position on the chart.
    pub fn position(&self) -> ChartPosition {
        (self.measured_to_us, self.batch_id.clone())
    }

    fn point(&self) -> ChartPoint {
        ChartPoint {
            shift: self.shift,
            limit: self.shift_limit,
            ewma_limit: self.ewma_limit.unwrap_or(f64::INFINITY),
            slow: self.slow,
            held: self.held,
        }
    }

    /// Sets moving average and state as they follow from the points before it. Returns whether they changed.
    pub fn follow(&mut self, series: &mut Series) -> bool {
        let status = series.take(&self.point());
        let same =
            (status.ewma - self.ewma).abs() < SAME && status.above == self.above && status.state.as_str() == self.state;
        (self.ewma, self.above) = (status.ewma, status.above);
        status.state.as_str().clone_into(&mut self.state);
        !same
    }
}

/// Time of the last measurement of a batch in µs, and its id. The points of a series are in this order.
pub(super) type ChartPosition = (i64, String);

/// The columns of a [`PointRow`].
pub(super) const POINT_COLUMNS: &str =
    "measured_to_us, batch_id, series, shift, shift_limit, ewma_limit, probability_limit, held, ewma, above, state, slow";

/// The chart state with a name.
pub(super) fn state_of(name: &str) -> Result<State, Error> {
    State::ALL.into_iter().find(|state| state.as_str() == name).ok_or_else(|| bad_row("chart point")(&name))
}

impl Alarms<'_> {
    /// The points of a batch on the alarm charts.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn chart_points(self, structure: &StructureId, batch_id: &str) -> Result<Vec<StoredChartPoint>, Error> {
        let select = format!(
            "select {POINT_COLUMNS} from chart_point where structure_id = $1 and batch_id = $2
               and undamaged_version in (0, (select max(undamaged_version) from chart_point
                   where structure_id = $1 and batch_id = $2))
             order by undamaged_version desc, series"
        );
        let statement = sql::query_as(sqlx::AssertSqlSafe(select)).bind(structure.as_str()).bind(batch_id);
        self.database.damaged.leave_out(statement, &self.database.reader, 1, stored_point).await
    }

    /// The alarm charts of a structure for its newest undamaged reference: the newest `limit` points of each series, oldest
    /// first.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn charts(self, structure: &StructureId, limit: usize) -> Result<Vec<StoredChartPoint>, Error> {
        let series: Vec<(Whole<u32>, String)> = sql::query_as(
            "select distinct undamaged_version, series from chart_point where structure_id = $1 and undamaged_version in
                 (0, coalesce((select max(version) from undamaged_state where structure_id = $1), 0))
             order by undamaged_version desc, series",
        )
        .bind(structure.as_str())
        .fetch_all(&self.database.reader)
        .await?;
        let mut points = Vec::new();
        for (Whole(version), series) in series {
            let newest = format!(
                "select {POINT_COLUMNS} from chart_point where structure_id = $1 and undamaged_version = $2 and series = $3
                 order by measured_to_us desc, batch_id desc limit $4"
            );
            let statement = sql::query_as(sqlx::AssertSqlSafe(newest))
                .bind(structure.as_str())
                .bind(version)
                .bind(series)
                .bind(limit as i64);
            let found = self.database.damaged.leave_out(statement, &self.database.reader, 1, stored_point).await?;
            points.extend(found.into_iter().rev());
        }
        Ok(points)
    }

    /// The alarm charts of a structure for an undamaged reference: version of the reference, which is 0 for the fit, and series.
    pub(super) async fn chart_names(
        self,
        structure: &str,
        undamaged_version: u32,
    ) -> Result<Vec<(u32, String)>, Error> {
        let select = format!(
            "with recursive whose (structure_id, version) as (select $1, $2 union select $1, 0),
             {CHARTS}
             select version, series from chart where series is not null order by version desc, series"
        );
        let names: Vec<(Whole<u32>, String)> = sql::query_as(sqlx::AssertSqlSafe(select))
            .bind(structure)
            .bind(undamaged_version)
            .fetch_all(&self.database.reader)
            .await?;
        Ok(names.into_iter().map(|(version, series)| (version.0, series)).collect())
    }
}

/// The stored point of a row.
pub(super) fn stored_point(row: PointRow) -> Result<StoredChartPoint, Error> {
    Ok(StoredChartPoint {
        batch_id: row.batch_id,
        measured_to: timestamp("chart point", row.measured_to_us)?,
        series: row.series,
        shift: row.shift,
        shift_limit: row.shift_limit,
        ewma: row.ewma,
        ewma_limit: row.ewma_limit,
        probability_limit: row.probability_limit,
        held: row.held,
        state: row.state,
    })
}

/// The charts of the structures and versions of a table `whose`. It steps from series to series, because `select distinct` would
/// read all points.
pub(super) const CHARTS: &str = "chart (structure_id, version, series) as (
         select w.structure_id, w.version, (select min(series) from chart_point p
             where p.structure_id = w.structure_id and p.undamaged_version = w.version)
         from whose w
         union all
         select structure_id, version, (select min(series) from chart_point p
             where p.structure_id = chart.structure_id and p.undamaged_version = chart.version
               and p.series > chart.series)
         from chart where series is not null)";
