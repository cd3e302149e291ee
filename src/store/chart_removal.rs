//! Taking a batch out of charts: one that was assessed again may be rejected now, and is then on no chart on which it was before.

use std::sync::Arc;

use super::chart::chart;
use super::chart_episode::Charted;
use super::chart_point::{PointRow, StoredChartPoint, POINT_COLUMNS};
use super::column::bad_row;
use super::error::Error;
use super::sql;
use super::transaction::Transaction;
use crate::alarm::chart::{fit_settings, process_settings, ChartPoint};
use crate::assessment::{ChartRules, NewChartPoint, NewCharts, NewProcessPoint};

/// What a batch is on the charts now.
pub(super) struct Present<'c> {
    /// The reference that it was compared with, if it is charted by that one.
    pub compared: Option<u32>,
    /// Its points.
    pub points: &'c [StoredChartPoint],
    /// Whether it is on the charts of the process behind the reference.
    pub on_process: bool,
}

/// Takes a batch out of the charts of the fit and of the reference that it was compared with on which it is not any more, and corrects the states
/// and alarms after it. Returns whether an alarm was changed.
pub(super) async fn take_out(
    transaction: &mut Transaction<'_>,
    batch: &Charted<'_>,
    present: Present<'_>,
    rules: &ChartRules,
) -> Result<bool, Error> {
    let gone = gone(transaction, batch, &present).await?;
    let process = match present.compared {
        Some(version) if !present.on_process => held_on_process(transaction, batch, version, rules).await?,
        _ => None,
    };
    if gone.is_empty() && process.is_none() {
        return Ok(false);
    }
    // A point that is held has no influence on those after it: then it can be deleted.
    let is_of_process = |row: &PointRow| row.slow.is_some();
    let others = gone.iter().filter(|(_, row)| !is_of_process(row));
    let points = others.map(|(version, row)| held(*version, row, rules)).collect();
    let leaves_process = process.is_some();
    let outcome = chart(transaction, batch, NewCharts { points, process, rules: None }).await?;
    for (version, row) in &gone {
        sql::query(
            "delete from chart_point where structure_id = $1 and undamaged_version = $2 and series = $3 and measured_to_us = $4
                 and batch_id = $5",
        )
        .bind(batch.structure)
        .bind(version)
        .bind(&row.series)
        .bind(row.measured_to_us)
        .bind(&row.batch_id)
        .execute(&mut *transaction)
        .await?;
    }
    if leaves_process {
        sql::query(
            "delete from process_point where structure_id = $1 and undamaged_version = $2 and measured_to_us = $3 and batch_id = $4",
        )
        .bind(batch.structure)
        .bind(batch.undamaged_version)
        .bind(batch.position.0)
        .bind(&batch.position.1)
        .execute(&mut *transaction)
        .await?;
    }
    Ok(outcome.alarms_changed)
}

/// The stored points of a batch that it has not any more, each with the version of its reference.
async fn gone(
    transaction: &mut Transaction<'_>,
    batch: &Charted<'_>,
    present: &Present<'_>,
) -> Result<Vec<(u32, PointRow)>, Error> {
    let mut gone = Vec::new();
    for version in [0].into_iter().chain(present.compared) {
        let select = format!(
            "select {POINT_COLUMNS} from chart_point where structure_id = $1 and batch_id = $2 and undamaged_version = $3"
        );
        let stored: Vec<PointRow> = sql::query_as(sqlx::AssertSqlSafe(select))
            .bind(batch.structure)
            .bind(&batch.position.1)
            .bind(version)
            .fetch_all(&mut *transaction)
            .await?;
        let is_gone = |row: &PointRow| present.points.iter().all(|point| point.series != row.series);
        gone.extend(stored.into_iter().filter(is_gone).map(|row| (version, row)));
    }
    Ok(gone)
}

/// The batch on the charts of the process as it is stored, but held; `None` if it is not on them.
async fn held_on_process(
    transaction: &mut Transaction<'_>,
    batch: &Charted<'_>,
    undamaged_version: u32,
    rules: &ChartRules,
) -> Result<Option<NewProcessPoint>, Error> {
    let Some(reference) = &rules.process else { return Ok(None) };
    let stored: Option<(String,)> = sql::query_as(
        "select estimate from process_point
         where structure_id = $1 and undamaged_version = $2 and measured_to_us = $3 and batch_id = $4",
    )
    .bind(batch.structure)
    .bind(undamaged_version)
    .bind(batch.position.0)
    .bind(&batch.position.1)
    .fetch_optional(&mut *transaction)
    .await?;
    let Some((estimate,)) = stored else { return Ok(None) };
    Ok(Some(NewProcessPoint {
        reference: Arc::clone(reference),
        undamaged_version,
        estimate: serde_json::from_str(&estimate).map_err(|e| bad_row("process point")(&e))?,
        held: true,
        settings: process_settings(&rules.settings),
    }))
}

/// A stored point of a chart of its own, but held.
fn held(undamaged_version: u32, row: &PointRow, rules: &ChartRules) -> NewChartPoint {
    NewChartPoint {
        series: row.series.clone(),
        undamaged_version,
        point: ChartPoint {
            shift: row.shift,
            limit: row.shift_limit,
            ewma_limit: row.ewma_limit.unwrap_or(f64::INFINITY),
            slow: row.slow,
            held: true,
        },
        probability_limit: row.probability_limit,
        settings: if undamaged_version == 0 { fit_settings(&rules.settings) } else { rules.settings },
        raises_alarms: true,
    }
}
