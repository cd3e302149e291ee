//! Episodes of alarms, and maintenance windows.

use sqlx::sqlite::SqliteConnection;
use sqlx::FromRow;

use super::{bad_row, timestamp, Error, Store};
use crate::alarm::chart::FIT_SERIES;
use crate::quantity::{StructureId, Timestamp};

/// Series of silence.
pub const SILENCE_SERIES: &str = "structure:silence";

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

/// Kind of the alarms of a series.
pub(super) fn kind_of(series: &str) -> &'static str {
    match series {
        FIT_SERIES => "simulation_does_not_fit",
        SILENCE_SERIES => "silence",
        _ => "damage",
    }
}

pub(super) async fn insert_episode(
    connection: &mut SqliteConnection,
    structure: &str,
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
    .bind(kind_of(series))
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

impl Store {
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
                        insert_episode(connection, &id, SILENCE_SERIES, row, now).await?;
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
        let (found,): (bool,) = sqlx::query_as(
            "select exists (select 1 from maintenance_window where structure_id = ?1 and from_us <= ?2 and to_us > ?2)",
        )
        .bind(structure.as_str())
        .bind(at.micros())
        .fetch_one(&self.reader)
        .await?;
        Ok(found)
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
