//! All structures at a glance.

use sqlx::FromRow;

use super::{bad_row, timestamp, Error, Store};
use crate::alarm::machine::State;
use crate::quantity::{StructureId, Timestamp};

/// What is known of a structure at a glance.
#[derive(Debug, Clone, PartialEq)]
pub struct StructureOverview {
    /// Its id.
    pub id: StructureId,
    /// Batches stored.
    pub batches: u64,
    /// Time of its latest measurement.
    pub last_measured_at: Option<Timestamp>,
    /// When its newest batch arrived.
    pub last_received_at: Option<Timestamp>,
    /// The assessed batch that was measured last.
    pub latest_assessed: Option<String>,
    /// Alarms that last.
    pub open_alarms: u64,
    /// Those of them that nobody has seen.
    pub unacknowledged_alarms: u64,
    /// True while an alarm of silence lasts.
    pub silent: bool,
    /// Version of its newest undamaged state.
    pub undamaged_version: Option<u32>,
    /// Where its charts are now, under the newest undamaged state.
    pub chart_states: Vec<State>,
}

#[derive(FromRow)]
struct Row {
    structure_id: String,
    batches: i64,
    last_measured_us: Option<i64>,
    last_received_us: Option<i64>,
    latest_assessed: Option<String>,
    open_alarms: i64,
    unacknowledged: i64,
    silent: bool,
    undamaged_version: Option<u32>,
}

/// The open alarms of a structure `s`.
const OPEN: &str =
    "from alarm_episode e where e.structure_id = s.structure_id and ended_at_us is null and withdrawn = 0";

impl Store {
    /// All structures, by id.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn overview(&self) -> Result<Vec<StructureOverview>, Error> {
        let select = format!(
            "select s.structure_id,
                    (select count(*) from measurement_batch b where b.structure_id = s.structure_id) as batches,
                    (select max(measured_to_us) from measurement_batch b where b.structure_id = s.structure_id)
                        as last_measured_us,
                    -- Ids are in the order of arrival.
                    (select received_at_us from measurement_batch b where b.structure_id = s.structure_id
                     order by batch_id desc limit 1) as last_received_us,
                    (select batch_id from measurement_batch b
                     where b.structure_id = s.structure_id and state = 'assessed'
                     order by measured_from_us desc, batch_id desc limit 1) as latest_assessed,
                    (select count(*) {OPEN}) as open_alarms,
                    (select count(*) {OPEN} and acknowledged_at_us is null) as unacknowledged,
                    exists (select 1 {OPEN} and kind = 'silence') as silent,
                    (select max(version) from undamaged_state u where u.structure_id = s.structure_id)
                        as undamaged_version
             from structure s order by s.structure_id"
        );
        let rows: Vec<Row> = sqlx::query_as(sqlx::AssertSqlSafe(select)).fetch_all(&self.reader).await?;
        let mut all = Vec::with_capacity(rows.len());
        for row in rows {
            let what = "structure";
            let chart_states = self.chart_states(&row.structure_id, row.undamaged_version.unwrap_or(0)).await?;
            all.push(StructureOverview {
                id: StructureId::parse(&row.structure_id).map_err(|e| bad_row(what)(&e))?,
                batches: row.batches.unsigned_abs(),
                last_measured_at: row.last_measured_us.map(|at| timestamp(what, at)).transpose()?,
                last_received_at: row.last_received_us.map(|at| timestamp(what, at)).transpose()?,
                latest_assessed: row.latest_assessed,
                open_alarms: row.open_alarms.unsigned_abs(),
                unacknowledged_alarms: row.unacknowledged.unsigned_abs(),
                silent: row.silent,
                undamaged_version: row.undamaged_version,
                chart_states,
            });
        }
        Ok(all)
    }

    /// The state after the last point of each chart.
    async fn chart_states(&self, structure: &str, undamaged_version: u32) -> Result<Vec<State>, Error> {
        let mut states = Vec::new();
        for (version, series) in self.chart_names(structure, undamaged_version).await? {
            let (state,): (String,) = sqlx::query_as(
                "select state from chart_point where structure_id = ? and undamaged_version = ? and series = ?
                 order by measured_to_us desc, batch_id desc limit 1",
            )
            .bind(structure)
            .bind(version)
            .bind(series)
            .fetch_one(&self.reader)
            .await?;
            states.push(super::alarm::state_of(&state)?);
        }
        Ok(states)
    }

    /// The charts of a structure under an undamaged state, with the state they belong to: 0 for the fit.
    ///
    /// Name by name, because `select distinct` reads all points.
    pub(super) async fn chart_names(
        &self,
        structure: &str,
        undamaged_version: u32,
    ) -> Result<Vec<(u32, String)>, Error> {
        Ok(sqlx::query_as(
            "with recursive chart (version, series) as (
                 select version, (select min(series) from chart_point
                                  where structure_id = ?1 and undamaged_version = version)
                 from (select ?2 as version union select 0)
                 union all
                 select version, (select min(series) from chart_point p
                                  where structure_id = ?1 and undamaged_version = version and p.series > chart.series)
                 from chart where series is not null)
             select version, series from chart where series is not null order by version desc, series",
        )
        .bind(structure)
        .bind(undamaged_version)
        .fetch_all(&self.reader)
        .await?)
    }
}
