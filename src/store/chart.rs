//! Storing the points of a batch on the alarm charts.
//!
//! A point is stored in the transaction of its assessment, together with the changed states of all later points of its series: a
//! batch that arrives late is inserted at the time of its measurements, and the alarms that it changes are corrected.

use std::sync::LazyLock;

use super::chart_episode::{Charted, Episodes};
use super::chart_point::{state_of, stored_point, ChartPosition, PointRow, StoredChartPoint, POINT_COLUMNS};
use super::error::Error;
use super::process;
use super::rows::{parts, RowStatements};
use super::sql;
use super::transaction::Transaction;
use crate::alarm::chart::Series;
use crate::alarm::machine::State;
use crate::assessment::{NewChartPoint, NewCharts};

/// Points read at a time.
const PAGE: usize = 500;

/// Charts that are read by one statement. SQLite allows 500 terms of a union, and each chart has two.
const CHARTS_TOGETHER: usize = 32;

/// Selects, for each series, the last points before a position, which determine the state there, and the points from there on.
/// Structure, time and batch are parameters 1 to 3; version and name of each series follow.
///
/// The limits are part of the text, because SQLite prepares a statement again whenever a bound limit changes.
fn select_about(charts: &[NewChartPoint]) -> String {
    let of_one = |(chart, new): (usize, &NewChartPoint)| {
        let (version, series) = (4 + 2 * chart, 5 + 2 * chart);
        let of_series = format!("where structure_id = $1 and undamaged_version = ${version} and series = ${series}");
        let memory = Series::memory(&new.settings);
        format!(
            "select * from (select {POINT_COLUMNS} from chart_point {of_series} and (measured_to_us, batch_id) < ($2, $3)
                 and held = 0 order by measured_to_us desc, batch_id desc limit {memory}) before{chart}
             union all
             select * from (select {POINT_COLUMNS} from chart_point {of_series} and (measured_to_us, batch_id) >= ($2, $3)
                 order by measured_to_us, batch_id limit {PAGE}) from{chart}"
        )
    };
    charts.iter().enumerate().map(of_one).collect::<Vec<_>>().join(" union all ")
}

/// Selects the points of a series after a position.
static SELECT_AFTER: LazyLock<String> = LazyLock::new(|| {
    format!(
        "select {POINT_COLUMNS} from chart_point where structure_id = $1 and undamaged_version = $2 and series = $3
             and (measured_to_us, batch_id) > ($4, $5) order by measured_to_us, batch_id limit {PAGE}"
    )
});

/// Statements that insert points or replace them. Structure, time and batch are the same in all rows.
static INSERT_POINTS: RowStatements = RowStatements::with_clause(
    "insert into chart_point (structure_id, undamaged_version, series, measured_to_us, batch_id, shift, shift_limit, ewma_limit,
     probability_limit, held, ewma, above, state, slow) ",
    14,
    &[0, 3, 4],
    " on conflict (structure_id, undamaged_version, series, measured_to_us, batch_id) do update
     set shift = excluded.shift, shift_limit = excluded.shift_limit, ewma_limit = excluded.ewma_limit,
         probability_limit = excluded.probability_limit, held = excluded.held, ewma = excluded.ewma,
         above = excluded.above, state = excluded.state, slow = excluded.slow",
);

/// Statements that write the states of stored points of a series. Structure, version and series are the same in all rows.
static NEW_STATES: RowStatements = RowStatements::with_clause(
    "update chart_point set ewma = given.column6, above = given.column7, state = given.column8 from (",
    8,
    &[0, 1, 2],
    ") as given where structure_id = given.column1 and undamaged_version = given.column2 and series = given.column3
         and measured_to_us = given.column4 and batch_id = given.column5",
);

/// The result of storing the points of a batch.
pub(super) struct ChartOutcome {
    /// The points as stored.
    pub points: Vec<StoredChartPoint>,
    /// Whether an alarm was opened, changed or withdrawn.
    pub alarms_changed: bool,
}

/// A point among those of its series.
struct Placed {
    undamaged_version: u32,
    row: PointRow,
    /// Whether the point is written, because it was not stored yet or had other values.
    new: bool,
    alarms_changed: bool,
}

/// Inserts the points of a batch into their charts and updates the later points.
///
/// A point that is stored with the same values is left as it is, so that assessing a batch again changes nothing.
pub(super) async fn chart(
    transaction: &mut Transaction<'_>,
    batch: &Charted<'_>,
    NewCharts { mut points, process, .. }: NewCharts,
) -> Result<ChartOutcome, Error> {
    let mut placed = Vec::new();
    let mut changed_to = None;
    if let Some(new) = process.filter(|new| new.undamaged_version == batch.undamaged_version) {
        let followed = process::follow(transaction, batch, &new).await?;
        points.extend(followed.points);
        changed_to = followed.changed_to;
    }
    // An undamaged reference that was stored in the meantime has ended the charts of the earlier reference.
    let points = points.into_iter().filter(|new| [0, batch.undamaged_version].contains(&new.undamaged_version));
    for charts in points.collect::<Vec<_>>().chunks(CHARTS_TOGETHER) {
        let mut about = about(transaction, batch, charts).await?;
        for new in charts {
            let own = about.extract_if(.., |row| row.series == new.series).collect();
            placed.push(
                place(transaction, batch, new, own, changed_to.as_ref().filter(|_| new.point.slow.is_some())).await?,
            );
        }
    }
    placed.sort_by(|a, b| b.undamaged_version.cmp(&a.undamaged_version).then_with(|| a.row.series.cmp(&b.row.series)));
    insert_points(transaction, batch, &placed).await?;
    let alarms_changed = placed.iter().any(|placed| placed.alarms_changed);
    let points = placed.into_iter().map(|placed| stored_point(placed.row)).collect::<Result<_, _>>()?;
    Ok(ChartOutcome { points, alarms_changed })
}

/// The stored points that determine the states of charts at the position of a batch, and those from there on.
async fn about(
    transaction: &mut Transaction<'_>,
    batch: &Charted<'_>,
    charts: &[NewChartPoint],
) -> Result<Vec<PointRow>, Error> {
    let mut select = sql::query_as(sqlx::AssertSqlSafe(select_about(charts)))
        .bind(batch.structure)
        .bind(batch.position.0)
        .bind(&batch.position.1);
    for new in charts {
        select = select.bind(new.undamaged_version).bind(&new.series);
    }
    Ok(select.fetch_all(&mut *transaction).await?)
}

async fn insert_points(transaction: &mut Transaction<'_>, batch: &Charted<'_>, placed: &[Placed]) -> Result<(), Error> {
    let new: Vec<&Placed> = placed.iter().filter(|placed| placed.new).collect();
    for part in parts(new.len()) {
        let mut insert = sql::query(INSERT_POINTS.of(part.len()))
            .bind(batch.structure)
            .bind(batch.position.0)
            .bind(&batch.position.1);
        for Placed { undamaged_version, row, .. } in &new[part] {
            insert = insert
                .bind(undamaged_version)
                .bind(&row.series)
                .bind(row.shift)
                .bind(row.shift_limit)
                .bind(row.ewma_limit)
                .bind(row.probability_limit)
                .bind(row.held)
                .bind(row.ewma)
                .bind(row.above)
                .bind(&row.state)
                .bind(row.slow);
        }
        insert.execute(&mut *transaction).await?;
    }
    Ok(())
}

/// Determines the state of a new point from the points before it, and updates the states of the later points of its series and
/// the alarm episodes that follow from them. `about` contains the stored points around it.
///
/// `changed_to`: the last position at which points themselves were changed, if any. Behind it, the update stops where the states no
/// longer change, because the influence of a point on the moving average and on the count of points above the limit fades.
async fn place(
    transaction: &mut Transaction<'_>,
    batch: &Charted<'_>,
    new: &NewChartPoint,
    mut about: Vec<PointRow>,
    changed_to: Option<&ChartPosition>,
) -> Result<Placed, Error> {
    let undamaged_version = new.undamaged_version;
    let memory = Series::memory(&new.settings);
    about.sort_by_cached_key(PointRow::position);
    let mut page = about.split_off(about.partition_point(|row| row.position() < batch.position));
    let before = about;
    let mut last_page = page.len() < PAGE;
    let stored = page.first().is_some_and(|row| row.position() == batch.position).then(|| page.remove(0));
    let ewma_limit = Some(new.point.ewma_limit).filter(|limit| limit.is_finite());
    // A maintenance window that was stored later does not change a stored point.
    let held = new.point.held || batch.maintained && stored.as_ref().is_none_or(|row| row.held);
    let values = (new.point.shift, new.point.limit, ewma_limit, new.point.slow, held);
    let same = |row: &PointRow| (row.shift, row.shift_limit, row.ewma_limit, row.slow, row.held) == values;
    let stored = match stored {
        Some(row) if same(&row) && changed_to.is_none() => {
            return Ok(Placed { undamaged_version, row, new: false, alarms_changed: false })
        }
        stored => stored,
    };
    let mut series = match before.last() {
        None => Series::new(new.settings),
        Some(last) => {
            let recent = before.iter().map(|row| row.above).collect();
            Series::resume(new.settings, last.ewma, state_of(&last.state)?, recent)
        }
    };
    let inside = before.last().map(|last| state_of(&last.state)).transpose()?.is_some_and(State::in_episode);
    // No stored episode begins after the end of a series.
    let amended = stored.is_some() || !page.is_empty();
    let mut episodes = Episodes::of(transaction, batch, new, inside, amended).await?;
    let mut first = row_of(batch, new, ewma_limit, held);
    first.follow(&mut series);
    episodes.pass(&first)?;
    let mut unchanged = 0;
    loop {
        let (mut followed, mut settled) = (Vec::new(), false);
        for row in &mut page {
            let changed = row.follow(&mut series);
            episodes.pass(row)?;
            unchanged = if changed { 0 } else { unchanged + usize::from(!row.held) };
            let points_end = changed_to.is_none_or(|changed| row.position() > *changed);
            settled = unchanged > memory && !episodes.inside && points_end;
            if settled {
                episodes.keep_after(&row.position());
            }
            if changed {
                followed.push(&*row);
            }
            if settled {
                break;
            }
        }
        write_states(transaction, batch.structure, new, &followed).await?;
        let Some(last) = page.last().filter(|_| !settled && !last_page) else { break };
        page = sql::query_as(SELECT_AFTER.as_str())
            .bind(batch.structure)
            .bind(new.undamaged_version)
            .bind(&new.series)
            .bind(last.measured_to_us)
            .bind(&last.batch_id)
            .fetch_all(&mut *transaction)
            .await?;
        last_page = page.len() < PAGE;
    }
    let alarms_changed = episodes.store(transaction, batch, new).await?;
    Ok(Placed { undamaged_version, row: first, new: true, alarms_changed })
}

/// The row of a new point, before its moving average and state are known.
fn row_of(batch: &Charted<'_>, new: &NewChartPoint, ewma_limit: Option<f64>, held: bool) -> PointRow {
    PointRow {
        measured_to_us: batch.position.0,
        batch_id: batch.position.1.clone(),
        series: new.series.clone(),
        shift: new.point.shift,
        shift_limit: new.point.limit,
        ewma_limit,
        probability_limit: new.probability_limit,
        held,
        ewma: 0.0,
        above: false,
        state: String::new(),
        slow: new.point.slow,
    }
}

/// Writes the states of later points of the series of a new one.
async fn write_states(
    transaction: &mut Transaction<'_>,
    structure: &str,
    new: &NewChartPoint,
    points: &[&PointRow],
) -> Result<(), Error> {
    for part in parts(points.len()) {
        let mut update =
            sql::query(NEW_STATES.of(part.len())).bind(structure).bind(new.undamaged_version).bind(&new.series);
        for row in &points[part] {
            update =
                update.bind(row.measured_to_us).bind(&row.batch_id).bind(row.ewma).bind(row.above).bind(&row.state);
        }
        update.execute(&mut *transaction).await?;
    }
    Ok(())
}
