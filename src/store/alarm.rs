//! Alarm charts, episodes and maintenance windows.
//!
//! A point is stored in the transaction that stores its assessment, and the states of all later points of its series with
//! it: a batch that comes late is charted where it was measured, and alarms that it changes are amended.

use sqlx::sqlite::SqliteConnection;
use sqlx::FromRow;

use super::{bad_row, timestamp, Error, Store};
use crate::alarm::chart::{ChartPoint, ChartStatus, Series};
use crate::alarm::machine::State;
use crate::alarm::AlarmSettings;
use crate::quantity::{StructureId, Timestamp};

/// Points read at a time.
const PAGE: usize = 500;

/// Difference of moving averages that is none.
const SAME: f64 = 1e-9;

/// Series of the chart of the simulation's fit; no parameter can have a colon in its name.
pub const FIT_SERIES: &str = "simulation:fit";
/// Series of silence.
pub const SILENCE_SERIES: &str = "structure:silence";

/// Kinds of alarms.
pub const ALARM_KINDS: [&str; 3] = ["damage", "simulation_does_not_fit", "silence"];

/// A batch on a chart, to be stored.
#[derive(Debug, Clone, PartialEq)]
pub struct NewChartPoint {
    /// Parameter of a damage chart, or [`FIT_SERIES`].
    pub series: String,
    /// Undamaged state it is compared with; 0 for the fit.
    pub undamaged_version: u32,
    /// When the batch began and ended; the end is its place in time.
    pub measured: (Timestamp, Timestamp),
    /// Its place on the chart.
    pub point: ChartPoint,
    /// Probability of damage that stands at the limit.
    pub probability_limit: Option<f64>,
    /// Rules of the chart.
    pub settings: AlarmSettings,
}

/// A stored point of a chart.
#[derive(Debug, Clone, PartialEq)]
pub struct StoredChartPoint {
    /// The batch.
    pub batch_id: String,
    /// When it ended.
    pub measured_to: Timestamp,
    /// Parameter, or [`FIT_SERIES`].
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

/// From an alarm to its end.
#[derive(Debug, Clone, PartialEq)]
pub struct Episode {
    /// Number within the structure, from 1.
    pub number: i64,
    /// `damage`, `simulation_does_not_fit` or `silence`.
    pub kind: String,
    /// Parameter of a damage alarm.
    pub series: String,
    /// The undamaged state compared with; 0 for the other kinds.
    pub undamaged_version: u32,
    /// Time of the measurement that made it an alarm.
    pub opened_at: Timestamp,
    /// The batch that did.
    pub opened_batch: Option<String>,
    /// When it ended.
    pub ended_at: Option<Timestamp>,
    /// True when late data showed that there was none.
    pub withdrawn: bool,
    /// Largest shift in it, standard errors.
    pub peak_shift: f64,
    /// When the service raised it.
    pub noticed_at: Timestamp,
    /// Who has seen it, when, and what they said.
    pub acknowledgement: Option<Acknowledgement>,
}

impl Episode {
    /// `open`, `ended`, or `withdrawn`.
    pub const fn state(&self) -> &'static str {
        match (self.withdrawn, self.ended_at) {
            (true, _) => "withdrawn",
            (false, Some(_)) => "ended",
            (false, None) => "open",
        }
    }
}

/// Somebody has seen an alarm.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Acknowledgement {
    /// When.
    pub at: Timestamp,
    /// Who.
    pub by: String,
    /// What they said.
    pub note: Option<String>,
}

/// A time in which batches move no chart.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MaintenanceWindow {
    /// Its beginning.
    pub from: Timestamp,
    /// Its end.
    pub to: Timestamp,
    /// Why.
    pub reason: String,
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

#[derive(FromRow)]
struct EpisodeRow {
    episode: i64,
    kind: String,
    series: String,
    undamaged_version: u32,
    opened_at_us: i64,
    opened_batch: Option<String>,
    ended_at_us: Option<i64>,
    withdrawn: bool,
    peak_shift: f64,
    noticed_at_us: i64,
    acknowledged_at_us: Option<i64>,
    acknowledged_by: Option<String>,
    acknowledgement_note: Option<String>,
}

const POINT_COLUMNS: &str =
    "measured_to_us, batch_id, series, shift, shift_limit, ewma_limit, probability_limit, held, ewma, above, state";

/// Puts the points of a batch on their charts and amends what follows them.
///
/// A point that is there already and says the same is left alone: assessing a batch again changes nothing.
pub(super) async fn chart(
    connection: &mut SqliteConnection,
    structure: &str,
    batch_id: &str,
    points: Vec<NewChartPoint>,
    now: Timestamp,
) -> Result<(), Error> {
    let (newest,): (u32,) =
        sqlx::query_as("select coalesce(max(version), 0) from undamaged_state where structure_id = ?")
            .bind(structure)
            .fetch_one(&mut *connection)
            .await?;
    // All points of a batch are of the same time.
    let mut maintained = None;
    // A state declared while this was computed has ended the charts of the one before.
    for new in points.into_iter().filter(|new| [0, newest].contains(&new.undamaged_version)) {
        let stored: Option<(f64, f64, Option<f64>, bool)> = sqlx::query_as(
            "select shift, shift_limit, ewma_limit, held from chart_point
             where structure_id = ? and undamaged_version = ? and series = ? and measured_to_us = ? and batch_id = ?",
        )
        .bind(structure)
        .bind(new.undamaged_version)
        .bind(&new.series)
        .bind(new.measured.1.micros())
        .bind(batch_id)
        .fetch_optional(&mut *connection)
        .await?;
        let ewma_limit = Some(new.point.ewma_limit).filter(|limit| limit.is_finite());
        // A maintenance window declared later leaves what was charted as it is.
        let held = match stored {
            Some((.., held)) => held,
            None if new.point.held => true,
            None => match maintained {
                Some((measured, maintained)) if measured == new.measured => maintained,
                _ => {
                    let found = in_maintenance(connection, structure, new.measured).await?;
                    maintained = Some((new.measured, found));
                    found
                }
            },
        };
        if stored == Some((new.point.shift, new.point.limit, ewma_limit, held)) {
            continue;
        }
        sqlx::query("insert or replace into chart_point values (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, 0, 0, 'normal')")
            .bind(structure)
            .bind(new.undamaged_version)
            .bind(&new.series)
            .bind(new.measured.1.micros())
            .bind(batch_id)
            .bind(new.point.shift)
            .bind(new.point.limit)
            .bind(ewma_limit)
            .bind(new.probability_limit)
            .bind(held)
            .execute(&mut *connection)
            .await?;
        replay(connection, structure, batch_id, &new, now).await?;
    }
    Ok(())
}

/// True when the time from the first to the second touches a maintenance window.
async fn in_maintenance(
    connection: &mut SqliteConnection,
    structure: &str,
    (from, to): (Timestamp, Timestamp),
) -> Result<bool, Error> {
    let (found,): (bool,) = sqlx::query_as(
        "select exists (select 1 from maintenance_window where structure_id = ?1 and from_us <= ?2 and to_us > ?3)",
    )
    .bind(structure)
    .bind(to.micros())
    .bind(from.micros())
    .fetch_one(&mut *connection)
    .await?;
    Ok(found)
}

/// Goes through the series from the new point on: states, and the episodes that they make.
///
/// It ends where the points come out as they were: the moving average forgets, and so does the count of points above.
async fn replay(
    connection: &mut SqliteConnection,
    structure: &str,
    batch_id: &str,
    new: &NewChartPoint,
    now: Timestamp,
) -> Result<(), Error> {
    let memory = Series::memory(&new.settings);
    let at = new.measured.1.micros();
    let before = format!(
        "select {POINT_COLUMNS} from chart_point
         where structure_id = ? and undamaged_version = ? and series = ? and (measured_to_us, batch_id) < (?, ?) and held = 0
         order by measured_to_us desc, batch_id desc limit ?"
    );
    let mut before: Vec<PointRow> = sqlx::query_as(sqlx::AssertSqlSafe(before))
        .bind(structure)
        .bind(new.undamaged_version)
        .bind(&new.series)
        .bind(at)
        .bind(batch_id)
        .bind(memory as i64)
        .fetch_all(&mut *connection)
        .await?;
    before.reverse();
    let mut series = match before.last() {
        None => Series::new(new.settings),
        Some(last) => {
            let recent = before.iter().map(|row| row.above).collect();
            Series::resume(new.settings, last.ewma, state_of(&last.state)?, recent)
        }
    };
    let mut inside = before.last().map(|last| state_of(&last.state)).transpose()?.is_some_and(State::in_episode);
    let mut episodes = Episodes::of(connection, structure, batch_id, new, inside).await?;
    let from = format!(
        "select {POINT_COLUMNS} from chart_point
         where structure_id = ? and undamaged_version = ? and series = ? and (measured_to_us, batch_id) >= (?, ?)
         order by measured_to_us, batch_id limit {PAGE}"
    );
    let mut place = (at, batch_id.to_owned());
    let mut unchanged = 0;
    'pages: loop {
        let points: Vec<PointRow> = sqlx::query_as(sqlx::AssertSqlSafe(from.clone()))
            .bind(structure)
            .bind(new.undamaged_version)
            .bind(&new.series)
            .bind(place.0)
            .bind(&place.1)
            .fetch_all(&mut *connection)
            .await?;
        let last_page = points.len() < PAGE;
        for row in &points {
            let first = row.measured_to_us == at && row.batch_id == batch_id;
            if !first && (row.measured_to_us, &row.batch_id) == (place.0, &place.1) {
                // The last of the page before.
                continue;
            }
            let point = ChartPoint {
                shift: row.shift,
                limit: row.shift_limit,
                ewma_limit: row.ewma_limit.unwrap_or(f64::INFINITY),
                held: row.held,
            };
            let status = series.take(&point);
            let same = (status.ewma - row.ewma).abs() < SAME
                && status.above == row.above
                && status.state.as_str() == row.state;
            if !same || first {
                write_status(connection, structure, new, row, &status).await?;
            }
            match (inside, status.state.in_episode()) {
                (false, true) => episodes.open(row),
                (true, false) => episodes.end(row.measured_to_us),
                _ => {}
            }
            inside = status.state.in_episode();
            if inside && !row.held {
                episodes.rise(row.shift);
            }
            unchanged = if same && !first { unchanged + usize::from(!row.held) } else { 0 };
            if unchanged > memory && !inside {
                episodes.nothing_behind(&(row.measured_to_us, row.batch_id.clone()));
                break 'pages;
            }
        }
        match points.last() {
            Some(last) if !last_page => place = (last.measured_to_us, last.batch_id.clone()),
            _ => break,
        }
    }
    episodes.store(connection, structure, new, now).await
}

async fn write_status(
    connection: &mut SqliteConnection,
    structure: &str,
    new: &NewChartPoint,
    row: &PointRow,
    status: &ChartStatus,
) -> Result<(), Error> {
    sqlx::query(
        "update chart_point set ewma = ?, above = ?, state = ?
         where structure_id = ? and undamaged_version = ? and series = ? and measured_to_us = ? and batch_id = ?",
    )
    .bind(status.ewma)
    .bind(status.above)
    .bind(status.state.as_str())
    .bind(structure)
    .bind(new.undamaged_version)
    .bind(&new.series)
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
}

impl Episodes {
    async fn of(
        connection: &mut SqliteConnection,
        structure: &str,
        batch_id: &str,
        new: &NewChartPoint,
        inside: bool,
    ) -> Result<Self, Error> {
        let (kind, at) = (kind_of(&new.series), new.measured.1.micros());
        let stored = sqlx::query_as(
            "select episode, opened_at_us, opened_batch, ended_at_us, withdrawn from alarm_episode
             where structure_id = ? and kind = ? and series = ? and undamaged_version = ?
               and (opened_at_us, opened_batch) >= (?, ?) order by opened_at_us, opened_batch",
        )
        .bind(structure)
        .bind(kind)
        .bind(&new.series)
        .bind(new.undamaged_version)
        .bind(at)
        .bind(batch_id)
        .fetch_all(&mut *connection)
        .await?;
        let running: Option<(i64, f64)> = sqlx::query_as(
            "select episode, peak_shift from alarm_episode
             where structure_id = ? and kind = ? and series = ? and undamaged_version = ? and withdrawn = 0
               and (opened_at_us, opened_batch) < (?, ?) order by opened_at_us desc, opened_batch desc limit 1",
        )
        .bind(structure)
        .bind(kind)
        .bind(&new.series)
        .bind(new.undamaged_version)
        .bind(at)
        .bind(batch_id)
        .fetch_optional(&mut *connection)
        .await?;
        Ok(Self { stored, running: running.filter(|_| inside), running_end: None, found: Vec::new() })
    }

    fn open(&mut self, row: &PointRow) {
        let (opened_at, batch) = (row.measured_to_us, row.batch_id.clone());
        self.found.push(FoundEpisode { opened_at, batch, ended_at: None, peak: row.shift });
    }

    fn end(&mut self, at: i64) {
        match self.found.last_mut() {
            Some(last) => last.ended_at = Some(at),
            None => self.running_end = Some(at),
        }
    }

    fn rise(&mut self, shift: f64) {
        match (self.found.last_mut(), &mut self.running) {
            (Some(last), _) => last.peak = last.peak.max(shift),
            (None, Some((_, peak))) => *peak = peak.max(shift),
            (None, None) => {}
        }
    }

    /// Nothing changes behind this point: episodes that open there stay as they are.
    fn nothing_behind(&mut self, place: &(i64, String)) {
        self.stored.retain(|(_, at, batch, ..)| (*at, batch.clone().unwrap_or_default()) <= *place);
    }

    async fn store(
        mut self,
        connection: &mut SqliteConnection,
        structure: &str,
        new: &NewChartPoint,
        now: Timestamp,
    ) -> Result<(), Error> {
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
            insert(connection, structure, kind_of(&new.series), &new.series, row, now).await?;
        }
        for (number, ..) in self.stored {
            sqlx::query("update alarm_episode set withdrawn = 1 where structure_id = ? and episode = ?")
                .bind(structure)
                .bind(number)
                .execute(&mut *connection)
                .await?;
        }
        Ok(())
    }
}

async fn insert(
    connection: &mut SqliteConnection,
    structure: &str,
    kind: &str,
    series: &str,
    (version, opened_at, batch, ended_at, peak): (u32, i64, Option<&str>, Option<i64>, f64),
    now: Timestamp,
) -> Result<(), Error> {
    sqlx::query(
        "insert into alarm_episode (structure_id, episode, kind, series, undamaged_version, opened_at_us, opened_batch,
             ended_at_us, withdrawn, peak_shift, noticed_at_us)
         select ?1, coalesce(max(episode), 0) + 1, ?2, ?3, ?4, ?5, ?6, ?7, 0, ?8, ?9
         from alarm_episode where structure_id = ?1",
    )
    .bind(structure)
    .bind(kind)
    .bind(series)
    .bind(version)
    .bind(opened_at)
    .bind(batch)
    .bind(ended_at)
    .bind(peak)
    .bind(now.micros())
    .execute(&mut *connection)
    .await?;
    Ok(())
}

fn kind_of(series: &str) -> &'static str {
    match series {
        FIT_SERIES => "simulation_does_not_fit",
        SILENCE_SERIES => "silence",
        _ => "damage",
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

    /// Alarm episodes, newest first; behind number `before`, if given; only those that last, if asked for.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn episodes(
        &self,
        structure: &StructureId,
        before: Option<i64>,
        open_only: bool,
        limit: usize,
    ) -> Result<Vec<Episode>, Error> {
        let rows: Vec<EpisodeRow> = sqlx::query_as(
            "select * from alarm_episode where structure_id = ? and episode < ?
               and (?3 = 0 or (ended_at_us is null and withdrawn = 0))
             order by episode desc limit ?4",
        )
        .bind(structure.as_str())
        .bind(before.unwrap_or(i64::MAX))
        .bind(open_only)
        .bind(limit as i64)
        .fetch_all(&self.reader)
        .await?;
        rows.into_iter().map(episode).collect()
    }

    /// Episodes behind number `newest`, those that last, and those of the given numbers, by number.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn episodes_since(
        &self,
        structure: &StructureId,
        newest: i64,
        numbers: &[i64],
    ) -> Result<Vec<Episode>, Error> {
        let numbers = serde_json::to_string(numbers).map_err(|e| bad_row("alarm episode")(&e))?;
        let rows: Vec<EpisodeRow> = sqlx::query_as(
            "select * from alarm_episode where structure_id = ?1
               and (episode > ?2 or (ended_at_us is null and withdrawn = 0)
                    or episode in (select value from json_each(?3)))
             order by episode",
        )
        .bind(structure.as_str())
        .bind(newest)
        .bind(numbers)
        .fetch_all(&self.reader)
        .await?;
        rows.into_iter().map(episode).collect()
    }

    /// Notes that somebody has seen an alarm; the first to do so stays. `None` when there is no such episode.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn acknowledge(
        &self,
        structure: &StructureId,
        number: i64,
        acknowledgement: Acknowledgement,
    ) -> Result<Option<Episode>, Error> {
        let id = structure.to_string();
        let row = self
            .write(move |connection| {
                Box::pin(async move {
                    sqlx::query(
                        "update alarm_episode set acknowledged_at_us = ?, acknowledged_by = ?, acknowledgement_note = ?
                         where structure_id = ? and episode = ? and acknowledged_at_us is null",
                    )
                    .bind(acknowledgement.at.micros())
                    .bind(acknowledgement.by)
                    .bind(acknowledgement.note)
                    .bind(&id)
                    .bind(number)
                    .execute(&mut *connection)
                    .await?;
                    let row: Option<EpisodeRow> =
                        sqlx::query_as("select * from alarm_episode where structure_id = ? and episode = ?")
                            .bind(&id)
                            .bind(number)
                            .fetch_optional(&mut *connection)
                            .await?;
                    Ok(row)
                })
            })
            .await?;
        row.map(episode).transpose()
    }

    /// Opens an episode of silence that began at `since`, or ends the one that lasts; nothing changes when it is so already.
    /// True when something changed.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn set_silent(
        &self,
        structure: &StructureId,
        since: Option<Timestamp>,
        now: Timestamp,
    ) -> Result<bool, Error> {
        let id = structure.to_string();
        self.write(move |connection| {
            Box::pin(async move {
                let lasting: Option<(i64,)> = sqlx::query_as(
                    "select episode from alarm_episode where structure_id = ? and kind = 'silence' and ended_at_us is null
                     order by episode desc limit 1",
                )
                .bind(&id)
                .fetch_optional(&mut *connection)
                .await?;
                match (lasting, since) {
                    (None, Some(since)) => {
                        let row = (0, since.micros(), None, None, 0.0);
                        insert(connection, &id, "silence", SILENCE_SERIES, row, now).await?;
                        Ok(true)
                    }
                    (Some((number,)), None) => {
                        sqlx::query("update alarm_episode set ended_at_us = ? where structure_id = ? and episode = ?")
                            .bind(now.micros())
                            .bind(&id)
                            .bind(number)
                            .execute(&mut *connection)
                            .await?;
                        Ok(true)
                    }
                    _ => Ok(false),
                }
            })
        })
        .await
    }

    /// Declares a maintenance window; batches that were charted before stay as they are.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn insert_maintenance(
        &self,
        structure: &StructureId,
        window: MaintenanceWindow,
        now: Timestamp,
    ) -> Result<(), Error> {
        let id = structure.to_string();
        self.write(move |connection| {
            Box::pin(async move {
                sqlx::query("insert or replace into maintenance_window values (?, ?, ?, ?, ?)")
                    .bind(&id)
                    .bind(window.from.micros())
                    .bind(window.to.micros())
                    .bind(&window.reason)
                    .bind(now.micros())
                    .execute(&mut *connection)
                    .await?;
                Ok(())
            })
        })
        .await
    }

    /// True when a time lies in a maintenance window.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn is_in_maintenance(&self, structure: &StructureId, at: Timestamp) -> Result<bool, Error> {
        in_maintenance(&mut *self.reader.acquire().await?, structure.as_str(), (at, at)).await
    }

    /// Maintenance windows of a structure, newest first, at most 1000.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn maintenance(&self, structure: &StructureId) -> Result<Vec<MaintenanceWindow>, Error> {
        let rows: Vec<(i64, i64, String)> = sqlx::query_as(
            "select from_us, to_us, reason from maintenance_window where structure_id = ? order by from_us desc limit 1000",
        )
        .bind(structure.as_str())
        .fetch_all(&self.reader)
        .await?;
        let window = |(from, to, reason)| {
            let what = "maintenance window";
            Ok(MaintenanceWindow { from: timestamp(what, from)?, to: timestamp(what, to)?, reason })
        };
        rows.into_iter().map(window).collect()
    }

    /// When the newest batch of a structure arrived.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn last_received(&self, structure: &StructureId) -> Result<Option<Timestamp>, Error> {
        let row: (Option<i64>,) =
            // Ids are in the order of arrival.
            sqlx::query_as(
                "select max(received_at_us) from (select received_at_us from measurement_batch where structure_id = ?
                     order by batch_id desc limit 1)",
            )
                .bind(structure.as_str())
                .fetch_one(&self.reader)
                .await?;
        row.0.map(|at| timestamp("batch", at)).transpose()
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

fn episode(row: EpisodeRow) -> Result<Episode, Error> {
    let what = "alarm episode";
    let acknowledgement = match (row.acknowledged_at_us, row.acknowledged_by) {
        (Some(at), Some(by)) => Some(Acknowledgement { at: timestamp(what, at)?, by, note: row.acknowledgement_note }),
        _ => None,
    };
    Ok(Episode {
        number: row.episode,
        kind: row.kind,
        series: row.series,
        undamaged_version: row.undamaged_version,
        opened_at: timestamp(what, row.opened_at_us)?,
        opened_batch: row.opened_batch,
        ended_at: row.ended_at_us.map(|at| timestamp(what, at)).transpose()?,
        withdrawn: row.withdrawn,
        peak_shift: row.peak_shift,
        noticed_at: timestamp(what, row.noticed_at_us)?,
        acknowledgement,
    })
}
