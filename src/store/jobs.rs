//! Diagnoses, extensions and trainings as one list of jobs.

use std::collections::BTreeSet;

use sqlx::FromRow;

use super::column::{bad_row, timestamp};
use super::diagnosis::{job_state, Diagnoses, DiagnosisTrigger, JobState};
use super::error::Error;
use super::sql;
use crate::quantity::{StructureId, Timestamp};

/// Kind of a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum JobKind {
    /// Searches for discrepancies between simulation and measurements.
    Diagnosis,
    /// Extends the structure by the findings of a diagnosis.
    Extension,
    /// Trains the model of a structure.
    Training,
}

/// A job.
#[derive(Debug, Clone, PartialEq)]
pub struct JobRecord {
    /// Id of the diagnosis or training.
    pub id: String,
    /// The structure.
    pub structure: StructureId,
    /// Its kind.
    pub kind: JobKind,
    /// Why a diagnosis was started.
    pub trigger: Option<DiagnosisTrigger>,
    /// Its state.
    pub state: JobState,
    /// Why it failed.
    pub failure: Option<String>,
    /// When it was requested. For extensions stored by early versions, the end of their diagnosis.
    pub created_at: Timestamp,
    /// When it ended.
    pub finished_at: Option<Timestamp>,
    /// Verdict of a diagnosis, or outcome of a training.
    pub verdict: Option<String>,
    /// A sentence about what a diagnosis found or about the outcome of a training, or a list of what an extension added.
    pub summary: Option<String>,
}

#[derive(FromRow)]
struct JobRow {
    job_id: String,
    structure_id: String,
    kind: String,
    started_by: Option<String>,
    state: String,
    failure: Option<String>,
    created_at_us: i64,
    finished_at_us: Option<i64>,
    verdict: Option<String>,
    summary: Option<String>,
    /// What an extension added, a JSON list of texts.
    added: Option<String>,
}

impl Diagnoses<'_> {
    /// Jobs of all structures or of some, newest first: those that have not ended, and the newest of the others, together at most `limit`.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn jobs(self, structures: Option<&BTreeSet<StructureId>>, limit: usize) -> Result<Vec<JobRecord>, Error> {
        let structures = structures.map(|ids| serde_json::to_string(ids).expect("ids are plain data"));
        // The inner select chooses the jobs before their results, which can be long, are read.
        let statement = sql::query_as(
            "with newest as (
                 select * from (
                     select diagnosis_id as job_id, structure_id, 'diagnosis' as kind, created_at_us,
                            case when state = 'running' then 0 else 1 end as has_ended from diagnosis
                     union all
                     select diagnosis_id, structure_id, 'extension', coalesce(extension_begun_at_us, finished_at_us, created_at_us),
                            case when extension_state = 'running' then 0 else 1 end
                     from diagnosis where extension_state is not null
                     union all
                     select training_id, structure_id, 'training', created_at_us, case when state = 'waiting' then 0 else 1 end
                     from training) jobs
                 where $2 is null or structure_id in (select value from json_each($2))
                 order by has_ended, created_at_us desc, job_id desc, kind desc limit $1)
             select n.job_id as job_id, d.structure_id, n.kind as kind, d.started_by, iif(d.cancelled_at_us is null, d.state, 'cancelled') as state,
                    d.failure, n.created_at_us as created_at_us, d.finished_at_us,
                    case when json_valid(d.result) = 1 then d.result ->> 'verdict' end as verdict,
                    case when json_valid(d.result) = 1 then d.result ->> 'summary' end as summary, null as added
             from newest n join diagnosis d on d.diagnosis_id = n.job_id where n.kind = 'diagnosis'
             union all
             select n.job_id, d.structure_id, n.kind, null,
                    iif(d.extension_cancelled_at_us is null, d.extension_state, 'cancelled'), d.extension_failure, n.created_at_us,
                    d.extended_at_us, null, null,
                    case when json_valid(d.extension) = 1 then d.extension ->> 'added' end
             from newest n join diagnosis d on d.diagnosis_id = n.job_id where n.kind = 'extension'
             union all
             select n.job_id, t.structure_id, n.kind, null, t.state, t.failure, n.created_at_us, t.finished_at_us,
                    case when json_valid(t.result) = 1 then t.result ->> 'outcome' end,
                    case when json_valid(t.result) = 1 then t.result ->> 'summary' end, null
             from newest n join training t on t.training_id = n.job_id where n.kind = 'training'
             order by created_at_us desc, job_id desc, kind desc",
        )
        .bind(limit as i64)
        .bind(structures);
        self.database.damaged.leave_out(statement, &self.database.reader, 1, record).await
    }

    /// The structure of a diagnosis or training.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn structure_of_job(self, id: &str) -> Result<Option<String>, Error> {
        let row: Option<(String,)> = sql::query_as(
            "select structure_id from diagnosis where diagnosis_id = $1
             union all select structure_id from training where training_id = $1",
        )
        .bind(id)
        .fetch_optional(&self.database.reader)
        .await?;
        Ok(row.map(|(structure,)| structure))
    }
}

impl JobKind {
    /// Its name.
    pub(super) const fn name(self) -> &'static str {
        match self {
            Self::Diagnosis => "diagnosis",
            Self::Extension => "extension",
            Self::Training => "training",
        }
    }
}

/// The kind with a name.
pub(super) fn kind(text: &str) -> Result<JobKind, Error> {
    match text {
        "diagnosis" => Ok(JobKind::Diagnosis),
        "extension" => Ok(JobKind::Extension),
        "training" => Ok(JobKind::Training),
        other => Err(Error::Row { what: "job", detail: format!("unknown kind {other:?}") }),
    }
}

fn record(row: JobRow) -> Result<JobRecord, Error> {
    let what = "job";
    let added: Option<Vec<String>> = match &row.added {
        Some(added) => serde_json::from_str(added).map_err(|e| bad_row(what)(&e))?,
        None => None,
    };
    let added = added.filter(|added| !added.is_empty()).map(|added| added.join("; "));
    Ok(JobRecord {
        id: row.job_id,
        structure: StructureId::parse(&row.structure_id).map_err(|e| bad_row(what)(&e))?,
        kind: kind(&row.kind)?,
        trigger: row.started_by.as_deref().map(DiagnosisTrigger::from_stored).transpose()?,
        state: job_state(&row.state)?,
        failure: row.failure,
        created_at: timestamp(what, row.created_at_us)?,
        finished_at: row.finished_at_us.map(|at| timestamp(what, at)).transpose()?,
        verdict: row.verdict,
        summary: row.summary.or(added),
    })
}
