//! Alarm episodes.

use std::collections::BTreeMap;

use serde::de::DeserializeOwned;
use sqlx::FromRow;

use super::column::{bad_row, elements, list, timestamp};
use super::damaged::{DamagedRows, Page};
use super::database::Database;
use super::diagnosis::{job_state, JobState};
use super::error::Error;
use super::sql::{self, On, Row, Whole};
use super::transaction::Transaction;
use crate::alarm::chart::{parameter_of, FIT_SERIES};
use crate::alarm::severity::{AlarmFacts, BatchChange, Grade, Severity, SeverityLimits};
use crate::process::lasting::LastingChange;
use crate::quantity::{StructureId, Timestamp};

/// Series name of alarms about missing data.
pub const SILENCE_SERIES: &str = "structure:silence";

/// Series name of alarms about batches that cannot be judged.
pub(super) const NOT_ASSESSED_SERIES: &str = "structure:not_assessed";

/// An alarm from its beginning to its end.
#[derive(Debug, Clone, PartialEq)]
pub struct Episode {
    /// Number within the structure, from 1.
    pub number: i64,
    /// `damage`, `simulation_does_not_fit`, `silence` or `not_assessed`.
    pub kind: String,
    /// The series of the chart that raised it: a parameter, all together as `structure:joint`, or `simulation:fit`; otherwise
    /// `structure:silence` or `structure:not_assessed`.
    pub series: String,
    /// Version of the undamaged reference of a damage alarm; 0 for the other kinds.
    pub undamaged_version: u32,
    /// Time of the measurement that raised the alarm.
    pub opened_at: Timestamp,
    /// The batch of that measurement.
    pub opened_batch: Option<String>,
    /// When it ended; `None` while it is open.
    pub ended_at: Option<Timestamp>,
    /// True if data that arrived later showed that there was no alarm.
    pub withdrawn: bool,
    /// Largest shift during the alarm, in standard errors.
    pub peak_shift: f64,
    /// When the service raised it.
    pub noticed_at: Timestamp,
    /// Who acknowledged it, when, and with which note.
    pub acknowledgement: Option<Acknowledgement>,
    /// The latest diagnosis that the service started because of it.
    pub diagnosis: Option<EpisodeDiagnosis>,
    /// Onset and size of the change, as the newest batch of the alarm shows them; `None` without a process.
    pub change: Option<LastingChange>,
    /// The version of a later undamaged reference whose charts cover the opening of the alarm, so that they decide about that time;
    /// `None` if there is none.
    pub superseded_by: Option<u32>,
    /// The latest alarm of an earlier undamaged reference about the same series and time.
    pub continues: Option<i64>,
    /// The change in its newest batch above a limit; `None` without one, and for alarms that are no damage.
    pub batch_change: Option<BatchChange>,
    /// The largest grade that it has had; `None` before it was graded.
    pub highest_grade: Option<Grade>,
}

/// Which episodes are read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EpisodeQuery {
    /// Only those with numbers below.
    pub before: Option<i64>,
    /// Only those that have not ended.
    pub open_only: bool,
    /// Also those that a later undamaged reference has superseded, and those that an earlier version of the program never announced, because
    /// another alarm was about the same event.
    pub superseded: bool,
    /// Maximum number.
    pub limit: usize,
}

/// The open damage alarms of a structure.
pub type OpenAlarms = BTreeMap<StructureId, Vec<Episode>>;

/// A diagnosis that was started because of an alarm.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct EpisodeDiagnosis {
    /// Its id.
    pub id: String,
    /// Its state.
    pub state: JobState,
    /// Its verdict; `None` until it is done.
    pub verdict: Option<String>,
}

impl Episode {
    /// `open`, `ended`, `superseded` or `withdrawn`.
    pub const fn state(&self) -> &'static str {
        match (self.withdrawn, self.superseded_by, self.ended_at) {
            (true, ..) => "withdrawn",
            (false, Some(_), _) => "superseded",
            (false, None, Some(_)) => "ended",
            (false, None, None) => "open",
        }
    }

    /// The parameters that it is about: those that have certainly changed, or else that of its chart.
    pub fn parameters(&self) -> Vec<String> {
        match &self.change {
            Some(change) => {
                let parameters = change.changes.iter().filter(|own| own.is_of_quantity());
                parameters.map(|own| own.name.clone()).collect()
            }
            None => parameter_of(self.series.clone()).into_iter().collect(),
        }
    }

    /// Its severity by the size and certainty of the loss.
    pub fn severity(&self, limits: SeverityLimits) -> Severity {
        let (kind, change) = (self.kind.as_str(), self.change.as_ref());
        limits.severity(AlarmFacts { kind, change, batch_change: self.batch_change })
    }
}

/// The acknowledgement of an alarm.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Acknowledgement {
    /// When it was acknowledged.
    pub at: Timestamp,
    /// By whom.
    pub by: String,
    /// Their note.
    pub note: Option<String>,
}

/// Index of the number of an episode in its row.
const EPISODE_COLUMN: usize = 1;

#[derive(FromRow)]
struct EpisodeRow {
    structure_id: String,
    episode: i64,
    kind: String,
    series: String,
    undamaged_version: Whole<u32>,
    opened_at_us: i64,
    opened_batch: Option<String>,
    ended_at_us: Option<i64>,
    withdrawn: bool,
    peak_shift: f64,
    noticed_at_us: i64,
    acknowledged_at_us: Option<i64>,
    acknowledged_by: Option<String>,
    acknowledgement_note: Option<String>,
    diagnosis_id: Option<String>,
    diagnosis_state: Option<String>,
    diagnosis_verdict: Option<String>,
    change: Option<String>,
    superseded_by: Option<Whole<u32>>,
    continues: Option<i64>,
    batch_change: Option<String>,
    grade: Option<i64>,
}

/// The version of the latest undamaged reference whose charts have a point of the series of a damage alarm `e` at its opening or before, or
/// null. An alarm of all parameters together is judged again by any damage chart.
macro_rules! superseding_version {
    () => {
        "(select max(u.version) from undamaged_state u
          where u.structure_id = e.structure_id and u.version > e.undamaged_version and e.kind = 'damage'
            and exists (select 1 from chart_point p
                where p.structure_id = e.structure_id and p.undamaged_version = u.version
                  and (p.series = e.series or e.series = 'structure:joint' and p.series <> 'simulation:fit')
                  and p.measured_to_us <= e.opened_at_us))"
    };
}

/// Selects [`EpisodeRow`]s; a condition follows.
macro_rules! select_episodes {
    ($condition:expr) => {
        concat!(
            "select e.*, ",
            superseding_version!(),
            " as superseded_by,
                 (select max(o.episode) from alarm_episode o
                  where o.structure_id = e.structure_id and o.kind = e.kind and (o.series = e.series or 'structure:joint' in (o.series, e.series))
                    and o.withdrawn = 0
                    and o.undamaged_version < e.undamaged_version
                    and o.opened_at_us <= coalesce(e.ended_at_us, 9e18)
                    and coalesce(o.ended_at_us, 9e18) >= e.opened_at_us) as continues,
                 d.diagnosis_id, iif(d.cancelled_at_us is null, d.state, 'cancelled') as diagnosis_state, case when json_valid(d.result) = 1 then d.result ->> 'verdict' end as diagnosis_verdict,
                 (select case when json_valid(p.changes) = 1 then p.changes -> e.series end from process_point p
                  where p.structure_id = e.structure_id and p.undamaged_version = e.undamaged_version
                    and p.measured_to_us between e.opened_at_us and coalesce(e.ended_at_us, 9e18)
                    and case when json_valid(p.changes) = 1 then p.changes -> e.series end is not null
                  order by p.measured_to_us desc, p.batch_id desc limit 1) as change,
                 (select b.batch_change from alarm_batch_change b
                  where b.structure_id = e.structure_id and b.episode = e.episode) as batch_change
             from alarm_episode e
             left join diagnosis d on d.diagnosis_id =
                 (select max(diagnosis_id) from diagnosis where structure_id = e.structure_id and alarm = e.episode)
             where ",
            $condition
        )
    };
}

/// The kind of the alarms of a series.
pub(super) fn kind_of(series: &str) -> &'static str {
    match series {
        FIT_SERIES => "simulation_does_not_fit",
        SILENCE_SERIES => "silence",
        NOT_ASSESSED_SERIES => "not_assessed",
        _ => "damage",
    }
}

/// Inserts an episode under the next number: version of the undamaged reference, opening time in µs, opening batch, end in µs,
/// and largest shift.
pub(super) async fn insert_episode(
    transaction: &mut Transaction<'_>,
    structure: &str,
    series: &str,
    (version, opened_at, batch, ended_at, peak): (u32, i64, Option<&str>, Option<i64>, f64),
    now: Timestamp,
) -> Result<(), Error> {
    sql::query(
        "insert into alarm_episode (structure_id, episode, kind, series, undamaged_version, opened_at_us, opened_batch,
             ended_at_us, withdrawn, peak_shift, noticed_at_us)
         select $1, coalesce(max(episode), 0) + 1, $2, $3, $4, $5, $6, $7, false, $8, $9
         from alarm_episode where structure_id = $1",
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
    .execute(&mut *transaction)
    .await?;
    Ok(())
}

/// Alarm episodes, alarm charts and maintenance windows.
#[derive(Clone, Copy)]
pub struct Alarms<'s> {
    pub(super) database: &'s Database,
}

impl Alarms<'_> {
    /// Alarm episodes, newest first.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn episodes(self, structure: &StructureId, query: EpisodeQuery) -> Result<Vec<Episode>, Error> {
        let place = |row: &Row| row.get::<i64>(EPISODE_COLUMN);
        let page = Page { limit: query.limit, behind: query.before.unwrap_or(i64::MAX), names: 2 };
        let statement = |before: &i64, limit: i64| {
            sql::query_as(select_episodes!(concat!(
                "e.structure_id = $1 and episode < $2 and ($3 = 0 or (ended_at_us is null and withdrawn = 0))
               and ($4 = 1 or held_back = 0 and ",
                superseding_version!(),
                " is null) order by episode desc limit $5"
            )))
            .bind(structure.as_str())
            .bind(*before)
            .bind(query.open_only)
            .bind(query.superseded)
            .bind(limit)
        };
        let damaged = &self.database.damaged;
        damaged.page(&self.database.reader, page, statement, place, |row| episode(row, damaged)).await
    }

    /// The open damage alarms of all structures, at most 1000, the latest ones first.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn open_damage(self) -> Result<OpenAlarms, Error> {
        open_damage(self.database, &self.database.reader).await
    }

    /// Episodes with numbers above `newest`, open episodes, and those with the given numbers, in the order of their numbers.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn episodes_since(
        self,
        structure: &StructureId,
        newest: i64,
        numbers: &[i64],
    ) -> Result<Vec<Episode>, Error> {
        let statement = sql::query_as(select_episodes!(concat!(
            "e.structure_id = $1
               and (episode > $2 or (ended_at_us is null and withdrawn = 0) or episode in (select cast(value as bigint) from ",
            elements!("$3"),
            ")) order by episode",
        )))
        .bind(structure.as_str())
        .bind(newest)
        .bind(list(numbers));
        let damaged = &self.database.damaged;
        damaged.leave_out(statement, &self.database.reader, 2, |row| episode(row, damaged)).await
    }

    /// Acknowledges an alarm; only the first acknowledgement is kept. `None` if there is no such episode.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn acknowledge(
        self,
        structure: &StructureId,
        number: i64,
        acknowledgement: Acknowledgement,
    ) -> Result<Option<Episode>, Error> {
        let id = structure.to_string();
        let row = self.database
            .write(move |transaction| {
                Box::pin(async move {
                    sql::query(
                        "update alarm_episode set acknowledged_at_us = $1, acknowledged_by = $2, acknowledgement_note = $3
                         where structure_id = $4 and episode = $5 and acknowledged_at_us is null",
                    )
                    .bind(acknowledgement.at.micros())
                    .bind(acknowledgement.by)
                    .bind(acknowledgement.note)
                    .bind(&id)
                    .bind(number)
                    .execute(&mut *transaction)
                    .await?;
                    let row: Option<EpisodeRow> =
                        sql::query_as(select_episodes!("e.structure_id = $1 and episode = $2"))
                            .bind(&id)
                            .bind(number)
                            .fetch_optional(&mut *transaction)
                            .await?;
                    Ok(row)
                })
            })
            .await?;
        row.map(|row| episode(row, &self.database.damaged)).transpose()
    }

    /// Stores grades of alarms, by their numbers, that are larger than the stored ones.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn raise_grades(self, structure: &StructureId, grades: Vec<(i64, Grade)>) -> Result<(), Error> {
        let id = structure.to_string();
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    for (number, grade) in grades {
                        sql::query(
                            "update alarm_episode set grade = $1
                             where structure_id = $2 and episode = $3 and coalesce(grade, -1) < $1",
                        )
                        .bind(grade.number())
                        .bind(&id)
                        .bind(number)
                        .execute(&mut *transaction)
                        .await?;
                    }
                    Ok(())
                })
            })
            .await
    }

    /// Opens an episode of missing data that began at `since`, or ends the open one if `since` is `None`. Returns whether
    /// something changed.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn set_silent(
        self,
        structure: &StructureId,
        since: Option<Timestamp>,
        now: Timestamp,
    ) -> Result<bool, Error> {
        let id = structure.to_string();
        self.database.write(move |transaction| {
            Box::pin(async move {
                let open: Option<(i64,)> = sql::query_as(
                    "select episode from alarm_episode where structure_id = $1 and kind = 'silence' and ended_at_us is null
                     order by episode desc limit 1",
                )
                .bind(&id)
                .fetch_optional(&mut *transaction)
                .await?;
                match (open, since) {
                    (None, Some(since)) => {
                        let row = (0, since.micros(), None, None, 0.0);
                        insert_episode(transaction, &id, SILENCE_SERIES, row, now).await?;
                        Ok(true)
                    }
                    (Some((number,)), None) => {
                        sql::query("update alarm_episode set ended_at_us = $1 where structure_id = $2 and episode = $3")
                            .bind(now.micros())
                            .bind(&id)
                            .bind(number)
                            .execute(&mut *transaction)
                            .await?;
                        Ok(true)
                    }
                    _ => Ok(false),
                }
            })
        })
        .await
    }
}

/// The open damage alarms of all structures, as in [`Alarms::open_damage`].
pub(super) async fn open_damage<'c>(database: &Database, on: impl Into<On<'c>>) -> Result<OpenAlarms, Error> {
    let statement = sql::query_as(select_episodes!(
        "e.kind = 'damage' and ended_at_us is null and withdrawn = 0 order by e.opened_at_us desc, e.episode limit 1000"
    ));
    let of_structure = |row: EpisodeRow| {
        let structure = StructureId::parse(&row.structure_id).map_err(|e| bad_row("alarm episode")(&e))?;
        Ok((structure, episode(row, &database.damaged)?))
    };
    let mut open = OpenAlarms::new();
    for (structure, episode) in database.damaged.leave_out(statement, on, 2, of_structure).await? {
        open.entry(structure).or_default().push(episode);
    }
    Ok(open)
}

/// The episode of a row. Without what a damaged text says about its change, which is remembered, it is still the alarm.
fn episode(row: EpisodeRow, damaged: &DamagedRows) -> Result<Episode, Error> {
    let what = "alarm episode";
    let name = || format!("alarm {} of {}", row.episode, row.structure_id);
    let acknowledgement = match (row.acknowledged_at_us, row.acknowledged_by) {
        (Some(at), Some(by)) => Some(Acknowledgement { at: timestamp(what, at)?, by, note: row.acknowledgement_note }),
        _ => None,
    };
    let diagnosis = match (row.diagnosis_id, row.diagnosis_state) {
        (Some(id), Some(state)) => {
            Some(EpisodeDiagnosis { id, state: job_state(&state)?, verdict: row.diagnosis_verdict })
        }
        _ => None,
    };
    Ok(Episode {
        number: row.episode,
        kind: row.kind,
        series: row.series,
        undamaged_version: row.undamaged_version.0,
        opened_at: timestamp(what, row.opened_at_us)?,
        opened_batch: row.opened_batch,
        ended_at: row.ended_at_us.map(|at| timestamp(what, at)).transpose()?,
        withdrawn: row.withdrawn,
        peak_shift: row.peak_shift,
        noticed_at: timestamp(what, row.noticed_at_us)?,
        acknowledgement,
        diagnosis,
        change: row.change.as_deref().and_then(|text| readable(text, what, damaged, name)),
        superseded_by: row.superseded_by.map(|version| version.0),
        continues: row.continues,
        batch_change: row.batch_change.as_deref().and_then(|text| readable(text, what, damaged, name)),
        highest_grade: row.grade.and_then(Grade::of_number),
    })
}

/// What a JSON text of an alarm says; `None` if it is damaged.
fn readable<T: DeserializeOwned>(
    text: &str,
    what: &'static str,
    damaged: &DamagedRows,
    name: impl Fn() -> String,
) -> Option<T> {
    serde_json::from_str(text).inspect_err(|error| damaged.note(&name(), &bad_row(what)(error))).ok()
}
