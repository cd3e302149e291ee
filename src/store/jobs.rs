//! Diagnoses and extensions as one list of jobs.

use sqlx::FromRow;

use super::column::{bad_row, timestamp};
use super::diagnosis::{job_state, Diagnoses, DiagnosisTrigger, JobState};
use super::error::Error;
use crate::quantity::{StructureId, Timestamp};

/// Kind of a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum JobKind {
    /// Searches for discrepancies between simulation and measurements.
    Diagnosis,
    /// Extends the structure by the findings of a diagnosis.
    Extension,
}

/// A job.
#[derive(Debug, Clone, PartialEq)]
pub struct JobRecord {
    /// Id of the diagnosis.
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
    /// Verdict of a diagnosis.
    pub verdict: Option<String>,
    /// A sentence about what a diagnosis found, or a list of what an extension added.
    pub summary: Option<String>,
}

#[derive(FromRow)]
struct JobRow {
    diagnosis_id: String,
    structure_id: String,
    extension: bool,
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
    /// Diagnoses and extensions of all structures, newest first.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn jobs(self, limit: usize) -> Result<Vec<JobRecord>, Error> {
        // The inner select chooses the newest jobs before their results, which can be long, are read.
        let rows: Vec<JobRow> = sqlx::query_as(
            "select d.diagnosis_id, d.structure_id, j.extension,
                    case when j.extension then null else d.started_by end as started_by,
                    case when j.extension then d.extension_state else d.state end as state,
                    case when j.extension then d.extension_failure else d.failure end as failure,
                    j.created_at_us,
                    case when j.extension then d.extended_at_us else d.finished_at_us end as finished_at_us,
                    case when j.extension then null else d.result ->> 'verdict' end as verdict,
                    case when j.extension then null else d.result ->> 'summary' end as summary,
                    case when j.extension then d.extension ->> 'added' end as added
             from (select * from (
                       select diagnosis_id, false as extension, created_at_us from diagnosis
                       union all
                       select diagnosis_id, true, coalesce(extension_begun_at_us, finished_at_us, created_at_us)
                       from diagnosis where extension_state is not null) a
                   order by created_at_us desc, diagnosis_id desc, extension desc limit $1) j
             join diagnosis d using (diagnosis_id)
             order by j.created_at_us desc, d.diagnosis_id desc, j.extension desc",
        )
        .bind(limit as i64)
        .fetch_all(&self.database.reader)
        .await?;
        rows.into_iter().map(record).collect()
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
        id: row.diagnosis_id,
        structure: StructureId::parse(&row.structure_id).map_err(|e| bad_row(what)(&e))?,
        kind: if row.extension { JobKind::Extension } else { JobKind::Diagnosis },
        trigger: row.started_by.as_deref().map(DiagnosisTrigger::from_stored).transpose()?,
        state: job_state(&row.state)?,
        failure: row.failure,
        created_at: timestamp(what, row.created_at_us)?,
        finished_at: row.finished_at_us.map(|at| timestamp(what, at)).transpose()?,
        verdict: row.verdict,
        summary: row.summary.or(added),
    })
}
