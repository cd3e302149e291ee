//! Diagnoses and extensions.

use serde::de::IgnoredAny;
use sqlx::FromRow;

use super::column::{bad_row, timestamp};
use super::database::Database;
use super::error::Error;
use super::job_end::JobEnd;
use super::sql;
use crate::quantity::{Digest, StructureId, Timestamp};

/// State of a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum JobState {
    /// It waits for its turn.
    Waiting,
    /// It is running.
    Running,
    /// It has a result.
    Done,
    /// It failed.
    Failed,
    /// Somebody ended it.
    Cancelled,
}

/// Why a diagnosis was started.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum DiagnosisTrigger {
    /// Somebody requested it.
    Requested,
    /// The service started it because of an alarm of the kind `simulation_does_not_fit`.
    RejectedEpisode,
    /// The service started it on schedule.
    Schedule,
}

impl DiagnosisTrigger {
    /// The name in tables and answers.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Requested => "requested",
            Self::RejectedEpisode => "rejected_episode",
            Self::Schedule => "schedule",
        }
    }

    /// The trigger with a name.
    pub(super) fn from_stored(text: &str) -> Result<Self, Error> {
        let all = [Self::Requested, Self::RejectedEpisode, Self::Schedule];
        let unknown = || Error::Row { what: "diagnosis", detail: format!("unknown reason of its start {text:?}") };
        all.into_iter().find(|trigger| trigger.as_str() == text).ok_or_else(unknown)
    }
}

/// A diagnosis that is about to run.
#[derive(Debug, Clone, PartialEq)]
pub struct NewDiagnosis {
    /// Its id.
    pub id: String,
    /// The structure.
    pub structure: StructureId,
    /// Digest of the version to diagnose.
    pub structure_digest: Digest,
    /// The request, JSON.
    pub request: String,
    /// Why it is started.
    pub trigger: DiagnosisTrigger,
    /// Number of the alarm because of which it is started.
    pub alarm: Option<i64>,
}

/// A stored diagnosis.
#[derive(Debug, Clone, PartialEq)]
pub struct DiagnosisRecord {
    /// Its id.
    pub id: String,
    /// The structure.
    pub structure: StructureId,
    /// Digest of the version that was diagnosed.
    pub structure_digest: Digest,
    /// The request, JSON.
    pub request: String,
    /// Why it was started.
    pub trigger: DiagnosisTrigger,
    /// Number of the alarm because of which it was started.
    pub alarm: Option<i64>,
    /// Its state.
    pub state: JobState,
    /// Why it failed.
    pub failure: Option<String>,
    /// The result, JSON.
    pub result: Option<String>,
    /// When it was requested.
    pub created_at: Timestamp,
    /// When it ended.
    pub finished_at: Option<Timestamp>,
    /// State of its extension.
    pub extension_state: Option<JobState>,
    /// Why its extension failed.
    pub extension_failure: Option<String>,
    /// Result of the extension, JSON.
    pub extension: Option<String>,
}

#[derive(FromRow)]
struct DiagnosisRow {
    diagnosis_id: String,
    structure_id: String,
    structure_digest: String,
    request: String,
    started_by: String,
    alarm: Option<i64>,
    state: String,
    failure: Option<String>,
    result: Option<String>,
    created_at_us: i64,
    finished_at_us: Option<i64>,
    extension_state: Option<String>,
    extension_failure: Option<String>,
    extension: Option<String>,
}

const COLUMNS: &str =
    "diagnosis_id, structure_id, structure_digest, request, started_by, alarm, iif(cancelled_at_us is null, state, 'cancelled') as state,
     failure, result, created_at_us, finished_at_us,
     iif(extension_cancelled_at_us is null, extension_state, 'cancelled') as extension_state, extension_failure, extension";

/// The state with a name.
pub(super) fn job_state(text: &str) -> Result<JobState, Error> {
    match text {
        "waiting" => Ok(JobState::Waiting),
        "running" => Ok(JobState::Running),
        "cancelled" => Ok(JobState::Cancelled),
        "done" => Ok(JobState::Done),
        "failed" => Ok(JobState::Failed),
        other => Err(Error::Row { what: "diagnosis", detail: format!("unknown state {other:?}") }),
    }
}

fn record(row: DiagnosisRow) -> Result<DiagnosisRecord, Error> {
    Ok(DiagnosisRecord {
        structure: StructureId::parse(&row.structure_id).map_err(|e| bad_row("diagnosis")(&e))?,
        id: row.diagnosis_id,
        structure_digest: Digest::from_stored(row.structure_digest),
        request: row.request,
        trigger: DiagnosisTrigger::from_stored(&row.started_by)?,
        alarm: row.alarm,
        state: job_state(&row.state)?,
        failure: row.failure,
        result: row.result,
        created_at: timestamp("diagnosis", row.created_at_us)?,
        finished_at: row.finished_at_us.map(|t| timestamp("diagnosis", t)).transpose()?,
        extension_state: row.extension_state.as_deref().map(job_state).transpose()?,
        extension_failure: row.extension_failure,
        extension: row.extension,
    })
}

/// Diagnoses and extensions.
#[derive(Clone, Copy)]
pub struct Diagnoses<'s> {
    pub(super) database: &'s Database,
}

impl Diagnoses<'_> {
    /// Stores a diagnosis that is about to run.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn insert_diagnosis(self, new: NewDiagnosis, now: Timestamp) -> Result<(), Error> {
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    sql::query(
                        "insert into diagnosis (diagnosis_id, structure_id, structure_digest, request, started_by, alarm, state,
                             created_at_us)
                         values ($1, $2, $3, $4, $5, $6, 'running', $7)",
                    )
                    .bind(&new.id)
                    .bind(new.structure.as_str())
                    .bind(new.structure_digest.as_str())
                    .bind(&new.request)
                    .bind(new.trigger.as_str())
                    .bind(new.alarm)
                    .bind(now.micros())
                    .execute(&mut *transaction)
                    .await?;
                    Ok(())
                })
            })
            .await
    }

    /// Stores the end of a diagnosis; its result is the JSON and the report.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn finish_diagnosis(
        self,
        id: &str,
        end: JobEnd<(String, Option<String>)>,
        now: Timestamp,
    ) -> Result<(), Error> {
        let (id, now) = (id.to_owned(), now.micros());
        // A job is ended below the minimum of free space as well.
        let takes_away = end == JobEnd::Cancelled;
        let cancelled = (end == JobEnd::Cancelled).then_some(now);
        let (state, failure, result, report) = match end {
            JobEnd::Done((result, report)) => ("done", None, Some(result), report),
            JobEnd::Failed(failure) => ("failed", Some(failure), None, None),
            JobEnd::Cancelled => ("failed", None, None, None),
        };
        self.database
            .write_or_take_away(takes_away, move |transaction| {
                Box::pin(async move {
                    sql::query(
                        "update diagnosis set state = $1, failure = $2, result = $3, report = $4, finished_at_us = $5,
                             cancelled_at_us = $6
                     where diagnosis_id = $7",
                    )
                    .bind(state)
                    .bind(failure)
                    .bind(result)
                    .bind(report)
                    .bind(now)
                    .bind(cancelled)
                    .bind(&id)
                    .execute(&mut *transaction)
                    .await?;
                    Ok(())
                })
            })
            .await
    }

    /// Marks the extension of a finished diagnosis as running, unless one is running. Returns whether it was marked. `training` says
    /// how it is trained, JSON.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn begin_extension(self, id: &str, training: String, now: Timestamp) -> Result<bool, Error> {
        let (id, now) = (id.to_owned(), now.micros());
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    let updated = sql::query(
                        "update diagnosis set extension_state = 'running', extension_failure = null,
                         extension_begun_at_us = $1, extended_at_us = null, extension_cancelled_at_us = null,
                         extension_request = $2, extension_interruptions = 0
                     where diagnosis_id = $3 and state = 'done'
                       and (extension_state is null or extension_state <> 'running')",
                    )
                    .bind(now)
                    .bind(&training)
                    .bind(&id)
                    .execute(&mut *transaction)
                    .await?;
                    Ok(updated.rows_affected() == 1)
                })
            })
            .await
    }

    /// Stores the end of an extension; its result is JSON.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn finish_extension(self, id: &str, end: JobEnd<String>, now: Timestamp) -> Result<(), Error> {
        let (id, now) = (id.to_owned(), now.micros());
        // A job is ended below the minimum of free space as well.
        let takes_away = end == JobEnd::Cancelled;
        let cancelled = (end == JobEnd::Cancelled).then_some(now);
        let (state, failure, extension) = match end {
            JobEnd::Done(extension) => ("done", None, Some(extension)),
            JobEnd::Failed(failure) => ("failed", Some(failure), None),
            JobEnd::Cancelled => ("failed", None, None),
        };
        self.database.write_or_take_away(takes_away, move |transaction| {
            Box::pin(async move {
                sql::query(
                    "update diagnosis set extension_state = $1, extension_failure = $2, extension = $3, extended_at_us = $4,
                         extension_cancelled_at_us = $5
                     where diagnosis_id = $6",
                )
                .bind(state)
                .bind(failure)
                .bind(extension)
                .bind(now)
                .bind(cancelled)
                .bind(&id)
                .execute(&mut *transaction)
                .await?;
                Ok(())
            })
        })
        .await
    }

    /// A diagnosis.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn diagnosis(self, id: &str) -> Result<Option<DiagnosisRecord>, Error> {
        let select = format!("select {COLUMNS} from diagnosis where diagnosis_id = $1");
        let row: Option<DiagnosisRow> =
            sql::query_as(sqlx::AssertSqlSafe(select)).bind(id).fetch_optional(&self.database.reader).await?;
        row.map(record).transpose()
    }

    /// Diagnoses of a structure, newest first.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn list(self, structure: &StructureId, limit: usize) -> Result<Vec<DiagnosisRecord>, Error> {
        let select =
            format!("select {COLUMNS} from diagnosis where structure_id = $1 order by diagnosis_id desc limit $2");
        let statement = sql::query_as(sqlx::AssertSqlSafe(select)).bind(structure.as_str()).bind(limit as i64);
        let damaged = &self.database.damaged;
        // Without a result that cannot be read, it is still a diagnosis.
        let with_result = |row: DiagnosisRow| {
            let mut record = record(row)?;
            let result = record.result.as_deref().map(serde_json::from_str::<IgnoredAny>).transpose();
            if let Err(error) = result {
                damaged.note(&format!("diagnosis {}", record.id), &bad_row("diagnosis")(&error));
                record.result = None;
            }
            Ok(record)
        };
        damaged.leave_out(statement, &self.database.reader, 1, with_result).await
    }

    /// The report of a diagnosis, HTML.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn diagnosis_report(self, id: &str) -> Result<Option<String>, Error> {
        let row: Option<(Option<String>,)> = sql::query_as("select report from diagnosis where diagnosis_id = $1")
            .bind(id)
            .fetch_optional(&self.database.reader)
            .await?;
        Ok(row.and_then(|row| row.0))
    }
}
