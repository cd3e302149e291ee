//! The points of a batch on their charts, and the episodes of alarms that they open and end.
//!
//! A point is stored in the transaction that stores its assessment, and the states of all later points of its series with
//! it: a batch that comes late is charted where it was measured, and alarms that it changes are amended.

use std::sync::LazyLock;

use sqlx::sqlite::SqliteConnection;
use sqlx::FromRow;

use super::alarm::{insert_episode, kind_of};
use super::rows::{parts, InsertStatements};
use super::{bad_row, timestamp, Error, Store};
use crate::alarm::chart::{ChartPoint, Series};
use crate::alarm::machine::State;
use crate::assessment::NewChartPoint;
use crate::quantity::{StructureId, Timestamp};

/// Points read at a time.
const PAGE: usize = 500;

/// Charts whose points are read by one statement: SQLite joins some hundreds of parts, and each chart has two.
const CHARTS_TOGETHER: usize = 32;

/// Difference of moving averages that is none.
const SAME: f64 = 1e-9;

/// A stored point of a chart.
#[derive(Debug, Clone, PartialEq)]
pub struct StoredChartPoint {
    /// The batch.
    pub batch_id: String,
    /// When it ended.
    pub measured_to: Timestamp,
    /// Parameter, or [`crate::alarm::chart::FIT_SERIES`].
    pub series: String,
    /// Shift towards damage, standard errors.
    pub shift: f64,
    /// Limit of one shift.
    pub shift_limit: f64,
    /// Moving average of the shifts.
    pub ewma: f64,
    /// Its limit; `None` without one.
    pub ewma_limit: Option<f64>,
    /// Probability of damage that stands at the limit.
    pub probability_limit: Option<f64>,
    /// True when the batch moved nothing.
    pub held: bool,
    /// State after it.
    pub state: String,
}

#[derive(FromRow)]
struct PointRow {
    measured_to_us: i64,
    batch_id: String,
    series: String,
    shift: f64,
    shift_limit: f64,
    ewma_limit: Option<f64>,
    probability_limit: Option<f64>,
    held: bool,
    ewma: f64,
    above: bool,
    state: String,
}

impl PointRow {
    /// Its place on the chart.
    fn place(&self) -> Place {
        (self.measured_to_us, self.batch_id.clone())
    }

    fn point(&self) -> ChartPoint {
        ChartPoint {
            shift: self.shift,
            limit: self.shift_limit,
            ewma_limit: self.ewma_limit.unwrap_or(f64::INFINITY),
            held: self.held,
        }
    }

    /// Takes on what it means behind the points before it; whether that is something new.
    fn follow(&mut self, series: &mut Series) -> bool {
        let status = series.take(&self.point());
        let same =
            (status.ewma - self.ewma).abs() < SAME && status.above == self.above && status.state.as_str() == self.state;
        (self.ewma, self.above) = (status.ewma, status.above);
        status.state.as_str().clone_into(&mut self.state);
        !same
    }
}

/// Time of the last measurement of a batch, µs, and its id: places of points of a series are in this order.
pub(super) type Place = (i64, String);

const POINT_COLUMNS: &str =
    "measured_to_us, batch_id, series, shift, shift_limit, ewma_limit, probability_limit, held, ewma, above, state";

/// The points of some series that their states at a place come from, and those from there on: structure, time and batch are
/// parameters 1 to 3, then come version and name of each series.
///
/// The limits stand in the text, since SQLite prepares a statement anew whenever a limit is bound.
fn select_about(charts: &[NewChartPoint]) -> String {
    let of_one = |(chart, new): (usize, &NewChartPoint)| {
        let (version, series) = (4 + 2 * chart, 5 + 2 * chart);
        let of_series = format!("where structure_id = ?1 and undamaged_version = ?{version} and series = ?{series}");
        let memory = Series::memory(&new.settings);
        format!(
            "select * from (select {POINT_COLUMNS} from chart_point {of_series} and (measured_to_us, batch_id) < (?2, ?3)
                 and held = 0 order by measured_to_us desc, batch_id desc limit {memory})
             union all
             select * from (select {POINT_COLUMNS} from chart_point {of_series} and (measured_to_us, batch_id) >= (?2, ?3)
                 order by measured_to_us, batch_id limit {PAGE})"
        )
    };
    charts.iter().enumerate().map(of_one).collect::<Vec<_>>().join(" union all ")
}

/// The points of a series behind a place.
static SELECT_BEHIND: LazyLock<String> = LazyLock::new(|| {
    format!(
        "select {POINT_COLUMNS} from chart_point where structure_id = ? and undamaged_version = ? and series = ?
             and (measured_to_us, batch_id) > (?, ?) order by measured_to_us, batch_id limit {PAGE}"
    )
});

/// Statements that insert points; structure, time and batch are common to all rows.
static INSERT_POINTS: InsertStatements = InsertStatements::new("insert or replace into chart_point", 13, &[0, 3, 4]);

/// A batch whose points are to be stored.
pub(super) struct Charted<'a> {
    pub structure: &'a str,
    pub place: Place,
    pub now: Timestamp,
    /// Whether it was measured in a maintenance window.
    pub maintained: bool,
    /// Newest undamaged state of the structure, 0 where there is none.
    pub newest_undamaged: u32,
}

/// What became of the points.
pub(super) struct Charts {
    /// As they are stored.
    pub points: Vec<StoredChartPoint>,
    /// Whether an alarm was opened, changed or withdrawn.
    pub alarms_changed: bool,
}

/// A point among those of its series.
struct Placed {
    undamaged_version: u32,
    row: PointRow,
    /// Whether it is to be inserted: it was not there, or said something else.
    new: bool,
    alarms_changed: bool,
}

/// Puts the points of a batch on their charts and amends what follows them.
///
/// A point that is there already and says the same is left alone: assessing a batch again changes nothing.
pub(super) async fn chart(
    connection: &mut SqliteConnection,
    batch: &Charted<'_>,
    points: Vec<NewChartPoint>,
) -> Result<Charts, Error> {
    let mut placed = Vec::new();
    // A state declared while this was computed has ended the charts of the one before.
    let points = points.into_iter().filter(|new| [0, batch.newest_undamaged].contains(&new.undamaged_version));
    for charts in points.collect::<Vec<_>>().chunks(CHARTS_TOGETHER) {
        let mut about = about(connection, batch, charts).await?;
        for new in charts {
            let own = about.extract_if(.., |row| row.series == new.series).collect();
            placed.push(place(connection, batch, new, own).await?);
        }
    }
    placed.sort_by(|a, b| b.undamaged_version.cmp(&a.undamaged_version).then_with(|| a.row.series.cmp(&b.row.series)));
    insert_points(connection, batch, &placed).await?;
    let alarms_changed = placed.iter().any(|placed| placed.alarms_changed);
    let points = placed.into_iter().map(|placed| stored_point(placed.row)).collect::<Result<_, _>>()?;
    Ok(Charts { points, alarms_changed })
}

/// The stored points that the states of some charts at the place of a batch come from, and those from there on.
async fn about(
    connection: &mut SqliteConnection,
    batch: &Charted<'_>,
    charts: &[NewChartPoint],
) -> Result<Vec<PointRow>, Error> {
    let mut select = sqlx::query_as(sqlx::AssertSqlSafe(select_about(charts)))
        .bind(batch.structure)
        .bind(batch.place.0)
        .bind(&batch.place.1);
    for new in charts {
        select = select.bind(new.undamaged_version).bind(&new.series);
    }
    Ok(select.fetch_all(&mut *connection).await?)
}

async fn insert_points(connection: &mut SqliteConnection, batch: &Charted<'_>, placed: &[Placed]) -> Result<(), Error> {
    let new: Vec<&Placed> = placed.iter().filter(|placed| placed.new).collect();
    for part in parts(new.len()) {
        let mut insert =
            sqlx::query(INSERT_POINTS.of(part.len())).bind(batch.structure).bind(batch.place.0).bind(&batch.place.1);
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
                .bind(&row.state);
        }
        insert.execute(&mut *connection).await?;
    }
    Ok(())
}

/// Finds what a new point means behind those before it, and goes through the series behind it: states, and the episodes that
/// they make. `about`: the stored points about it.
///
/// It ends where the points come out as they were: the moving average forgets, and so does the count of points above.
async fn place(
    connection: &mut SqliteConnection,
    batch: &Charted<'_>,
    new: &NewChartPoint,
    mut about: Vec<PointRow>,
) -> Result<Placed, Error> {
    let undamaged_version = new.undamaged_version;
    let memory = Series::memory(&new.settings);
    about.sort_by_cached_key(PointRow::place);
    let mut page = about.split_off(about.partition_point(|row| row.place() < batch.place));
    let before = about;
    let mut last_page = page.len() < PAGE;
    let stored = page.first().is_some_and(|row| row.place() == batch.place).then(|| page.remove(0));
    let ewma_limit = Some(new.point.ewma_limit).filter(|limit| limit.is_finite());
    // A maintenance window declared later leaves what was charted as it is.
    let held = stored.as_ref().map_or(new.point.held || batch.maintained, |row| row.held);
    let said = (new.point.shift, new.point.limit, ewma_limit, held);
    let same = |row: &PointRow| (row.shift, row.shift_limit, row.ewma_limit, row.held) == said;
    let stored = match stored {
        Some(row) if same(&row) => return Ok(Placed { undamaged_version, row, new: false, alarms_changed: false }),
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
    // Behind the end of a series nothing was opened before.
    let amended = stored.is_some() || !page.is_empty();
    let mut episodes = Episodes::of(connection, batch, new, inside, amended).await?;
    let mut first = PointRow {
        measured_to_us: batch.place.0,
        batch_id: batch.place.1.clone(),
        series: new.series.clone(),
        shift: new.point.shift,
        shift_limit: new.point.limit,
        ewma_limit,
        probability_limit: new.probability_limit,
        held,
        ewma: 0.0,
        above: false,
        state: String::new(),
    };
    first.follow(&mut series);
    episodes.pass(&first)?;
    let mut unchanged = 0;
    'pages: loop {
        for row in &mut page {
            let changed = row.follow(&mut series);
            if changed {
                write_status(connection, batch.structure, new.undamaged_version, row).await?;
            }
            episodes.pass(row)?;
            unchanged = if changed { 0 } else { unchanged + usize::from(!row.held) };
            if unchanged > memory && !episodes.inside {
                episodes.nothing_behind(&row.place());
                break 'pages;
            }
        }
        let Some(last) = page.last().filter(|_| !last_page) else { break };
        page = sqlx::query_as(SELECT_BEHIND.as_str())
            .bind(batch.structure)
            .bind(new.undamaged_version)
            .bind(&new.series)
            .bind(last.measured_to_us)
            .bind(&last.batch_id)
            .fetch_all(&mut *connection)
            .await?;
        last_page = page.len() < PAGE;
    }
    let alarms_changed = episodes.store(connection, batch, new).await?;
    Ok(Placed { undamaged_version, row: first, new: true, alarms_changed })
}

async fn write_status(
    connection: &mut SqliteConnection,
    structure: &str,
    version: u32,
    row: &PointRow,
) -> Result<(), Error> {
    sqlx::query(
        "update chart_point set ewma = ?, above = ?, state = ?
         where structure_id = ? and undamaged_version = ? and series = ? and measured_to_us = ? and batch_id = ?",
    )
    .bind(row.ewma)
    .bind(row.above)
    .bind(&row.state)
    .bind(structure)
    .bind(version)
    .bind(&row.series)
    .bind(row.measured_to_us)
    .bind(&row.batch_id)
    .execute(&mut *connection)
    .await?;
    Ok(())
}

/// An episode as it was stored: number, time and batch that opened it, its end, whether it was withdrawn.
type StoredEpisode = (i64, i64, Option<String>, Option<i64>, bool);

/// An episode as it was found.
struct FoundEpisode {
    opened_at: i64,
    batch: String,
    ended_at: Option<i64>,
    peak: f64,
}

/// Episodes of a series from a point on, as they are and as they were stored.
struct Episodes {
    /// Those stored that begin at or behind the point.
    stored: Vec<StoredEpisode>,
    /// The one that lasts at the point: number and peak.
    running: Option<(i64, f64)>,
    /// How it ends; `None` while it lasts.
    running_end: Option<i64>,
    found: Vec<FoundEpisode>,
    /// Whether an episode lasts at the last point passed.
    inside: bool,
}

impl Episodes {
    async fn of(
        connection: &mut SqliteConnection,
        batch: &Charted<'_>,
        new: &NewChartPoint,
        inside: bool,
        amended: bool,
    ) -> Result<Self, Error> {
        let mut episodes = Self { stored: Vec::new(), running: None, running_end: None, found: Vec::new(), inside };
        // Parameters of both: the series, and the place in it.
        macro_rules! of_series {
            ($select:literal) => {
                sqlx::query_as($select)
                    .bind(batch.structure)
                    .bind(kind_of(&new.series))
                    .bind(&new.series)
                    .bind(new.undamaged_version)
                    .bind(batch.place.0)
                    .bind(&batch.place.1)
            };
        }
        if amended {
            let select = of_series!(
                "select episode, opened_at_us, opened_batch, ended_at_us, withdrawn from alarm_episode
                 where structure_id = ? and kind = ? and series = ? and undamaged_version = ?
                   and (opened_at_us, opened_batch) >= (?, ?) order by opened_at_us, opened_batch"
            );
            episodes.stored = select.fetch_all(&mut *connection).await?;
        }
        if inside {
            let select = of_series!(
                "select episode, peak_shift from alarm_episode
                 where structure_id = ? and kind = ? and series = ? and undamaged_version = ? and withdrawn = 0
                   and (opened_at_us, opened_batch) < (?, ?) order by opened_at_us desc, opened_batch desc limit 1"
            );
            episodes.running = select.fetch_optional(&mut *connection).await?;
        }
        Ok(episodes)
    }

    /// Goes on to the next point.
    fn pass(&mut self, row: &PointRow) -> Result<(), Error> {
        let inside = state_of(&row.state)?.in_episode();
        match (self.inside, inside) {
            (false, true) => self.found.push(FoundEpisode {
                opened_at: row.measured_to_us,
                batch: row.batch_id.clone(),
                ended_at: None,
                peak: row.shift,
            }),
            (true, false) => match self.found.last_mut() {
                Some(last) => last.ended_at = Some(row.measured_to_us),
                None => self.running_end = Some(row.measured_to_us),
            },
            _ => {}
        }
        self.inside = inside;
        if inside && !row.held {
            match (self.found.last_mut(), &mut self.running) {
                (Some(last), _) => last.peak = last.peak.max(row.shift),
                (None, Some((_, peak))) => *peak = peak.max(row.shift),
                (None, None) => {}
            }
        }
        Ok(())
    }

    /// Nothing changes behind this point: episodes that open there stay as they are.
    fn nothing_behind(&mut self, place: &Place) {
        self.stored.retain(|(_, at, batch, ..)| (*at, batch.clone().unwrap_or_default()) <= *place);
    }

    /// Stores what was found; whether anything was or is there.
    async fn store(
        mut self,
        connection: &mut SqliteConnection,
        batch: &Charted<'_>,
        new: &NewChartPoint,
    ) -> Result<bool, Error> {
        let structure = batch.structure;
        let any = self.running.is_some() || !self.found.is_empty() || !self.stored.is_empty();
        if let Some((number, peak)) = self.running {
            sqlx::query(
                "update alarm_episode set ended_at_us = ?, peak_shift = ? where structure_id = ? and episode = ?",
            )
            .bind(self.running_end)
            .bind(peak)
            .bind(structure)
            .bind(number)
            .execute(&mut *connection)
            .await?;
        }
        for found in self.found {
            // The same one: opened by the same batch, or, since late data can move its beginning, at the same time.
            let (found_end, never) = (found.ended_at.unwrap_or(i64::MAX), i64::MAX);
            let same_batch = |s: &StoredEpisode| s.2.as_ref() == Some(&found.batch);
            let overlaps = |s: &StoredEpisode| !s.4 && s.1 <= found_end && found.opened_at <= s.3.unwrap_or(never);
            let known = self.stored.iter().position(same_batch).or_else(|| self.stored.iter().position(overlaps));
            if let Some(index) = known {
                let (number, ..) = self.stored.remove(index);
                sqlx::query(
                    "update alarm_episode set opened_at_us = ?, opened_batch = ?, ended_at_us = ?, withdrawn = 0,
                         peak_shift = ? where structure_id = ? and episode = ?",
                )
                .bind(found.opened_at)
                .bind(&found.batch)
                .bind(found.ended_at)
                .bind(found.peak)
                .bind(structure)
                .bind(number)
                .execute(&mut *connection)
                .await?;
                continue;
            }
            let row = (new.undamaged_version, found.opened_at, Some(found.batch.as_str()), found.ended_at, found.peak);
            insert_episode(connection, structure, &new.series, row, batch.now).await?;
        }
        for (number, ..) in self.stored {
            sqlx::query("update alarm_episode set withdrawn = 1 where structure_id = ? and episode = ?")
                .bind(structure)
                .bind(number)
                .execute(&mut *connection)
                .await?;
        }
        Ok(any)
    }
}

pub(super) fn state_of(name: &str) -> Result<State, Error> {
    State::ALL.into_iter().find(|state| state.as_str() == name).ok_or_else(|| bad_row("chart point")(&name))
}

impl Store {
    /// Points of a batch on the charts.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn chart_points(&self, structure: &StructureId, batch_id: &str) -> Result<Vec<StoredChartPoint>, Error> {
        let select = format!(
            "select {POINT_COLUMNS} from chart_point where structure_id = ?1 and batch_id = ?2
               and undamaged_version in (0, (select max(undamaged_version) from chart_point
                   where structure_id = ?1 and batch_id = ?2))
             order by undamaged_version desc, series"
        );
        let rows: Vec<PointRow> = sqlx::query_as(sqlx::AssertSqlSafe(select))
            .bind(structure.as_str())
            .bind(batch_id)
            .fetch_all(&self.reader)
            .await?;
        rows.into_iter().map(stored_point).collect()
    }

    /// The charts of a structure under its newest undamaged state, oldest point first: at most `limit` of each series, the
    /// newest.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn charts(&self, structure: &StructureId, limit: usize) -> Result<Vec<StoredChartPoint>, Error> {
        let series: Vec<(u32, String)> = sqlx::query_as(
            "select distinct undamaged_version, series from chart_point where structure_id = ?1 and undamaged_version in
                 (0, coalesce((select max(version) from undamaged_state where structure_id = ?1), 0))
             order by undamaged_version desc, series",
        )
        .bind(structure.as_str())
        .fetch_all(&self.reader)
        .await?;
        let mut points = Vec::new();
        for (version, series) in series {
            let newest = format!(
                "select {POINT_COLUMNS} from chart_point where structure_id = ? and undamaged_version = ? and series = ?
                 order by measured_to_us desc, batch_id desc limit ?"
            );
            let rows: Vec<PointRow> = sqlx::query_as(sqlx::AssertSqlSafe(newest))
                .bind(structure.as_str())
                .bind(version)
                .bind(series)
                .bind(limit as i64)
                .fetch_all(&self.reader)
                .await?;
            points.extend(rows.into_iter().rev());
        }
        points.into_iter().map(stored_point).collect()
    }
}

fn stored_point(row: PointRow) -> Result<StoredChartPoint, Error> {
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
