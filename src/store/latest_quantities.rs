//! The newest values of the structures, for metrics: quantities of the latest assessed batch, and the last points of the alarm charts.

use sqlx::FromRow;

use super::chart_point::CHARTS;
use super::current::IS_CURRENT;
use super::error::Error;
use super::overview::Overview;
use super::sql;
use crate::quantity::StructureId;

/// A quantity in the current assessment of the assessed batch that was measured last.
#[derive(Debug, Clone, PartialEq, FromRow)]
pub struct LatestQuantity {
    /// The structure.
    pub structure_id: String,
    /// The quantity.
    pub quantity: String,
    /// Its unit.
    pub unit: String,
    /// Its mean over the batch.
    pub mean: f64,
    /// Its standard deviation over the batch; `None` for one measurement.
    pub std: Option<f64>,
    /// Probability of damage; `None` without a comparison.
    pub probability_of_damage: Option<f64>,
    /// Relative difference from its mean in the undamaged reference; `None` without a comparison.
    pub relative_change: Option<f64>,
}

/// The last point of an alarm chart for the newest undamaged reference.
#[derive(Debug, Clone, PartialEq, FromRow)]
pub struct LatestPoint {
    /// The structure.
    pub structure_id: String,
    /// The parameter, or a name with a colon for charts of the structure.
    pub series: String,
    /// Shift towards damage in standard errors, or the evidence of the fast chart in standard deviations.
    pub shift: f64,
    /// Its limit.
    pub shift_limit: f64,
    /// Moving average of the shifts, or the evidence of the slow chart.
    pub ewma: f64,
    /// Its limit; `None` if there is none.
    pub ewma_limit: Option<f64>,
}

impl Overview<'_> {
    /// Quantities of the latest assessed batch of each of the first `structures` structures by id, or of one.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn latest_quantities(
        self,
        structures: usize,
        only: Option<&StructureId>,
    ) -> Result<Vec<LatestQuantity>, Error> {
        let select = format!(
            "with latest as materialized (
                 select s.structure_id,
                        (select batch_id from measurement_batch b
                         where b.structure_id = s.structure_id and state = 'assessed'
                         order by measured_from_us desc, batch_id desc limit 1) as batch_id
                 from structure s where $2 is null or s.structure_id = $2 order by s.structure_id limit $1)
             select q.structure_id, q.quantity, q.unit, q.mean, q.std, q.probability_of_damage, q.relative_change
             from latest l
                  cross join assessment a
                  join quantity_assessment q on q.structure_id = a.structure_id and q.batch_id = a.batch_id
                      and q.model_digest = a.model_digest and q.undamaged_version = a.undamaged_version
             where a.structure_id = l.structure_id and a.batch_id = l.batch_id and {IS_CURRENT}
             order by q.structure_id, q.position"
        );
        Ok(sql::query_as(sqlx::AssertSqlSafe(select))
            .bind(structures as i64)
            .bind(only.map(StructureId::as_str))
            .fetch_all(&self.database.reader)
            .await?)
    }

    /// The last points of the alarm charts of each of the first `structures` structures by id.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn latest_points(self, structures: usize) -> Result<Vec<LatestPoint>, Error> {
        let select = format!(
            "with recursive first (structure_id) as materialized (
                 select structure_id from structure order by structure_id limit $1),
             whose (structure_id, version) as (
                 select u.structure_id, max(u.version) from undamaged_state u join first using (structure_id) group by 1
                 union select structure_id, 0 from first),
             {CHARTS}
             select p.structure_id, p.series, p.shift, p.shift_limit, p.ewma, p.ewma_limit
             from chart join chart_point p on p.structure_id = chart.structure_id
                 and p.undamaged_version = chart.version and p.series = chart.series
                 and (p.measured_to_us, p.batch_id) = (
                     select measured_to_us, batch_id from chart_point n where n.structure_id = chart.structure_id
                       and n.undamaged_version = chart.version and n.series = chart.series
                     order by measured_to_us desc, batch_id desc limit 1)
             where chart.series is not null order by p.structure_id, p.series"
        );
        Ok(sql::query_as(sqlx::AssertSqlSafe(select)).bind(structures as i64).fetch_all(&self.database.reader).await?)
    }
}
