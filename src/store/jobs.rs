//! Diagnoses and extensions as one list of jobs.

use sqlx::FromRow;

use super::diagnosis::{job_state, JobState};
use super::{bad_row, timestamp, Error, Store};
use crate::quantity::{StructureId, Timestamp};

/// What a job does.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum JobKind {
    /// It looks for what the simulation gets wrong.
    Diagnosis,
    /// It extends the structure by what a diagnosis found.
    Extension,
}

/// A job.
#[derive(Debug, Clone, PartialEq)]
pub struct JobRecord {
    /// Id of the diagnosis.
    pub id: String,
    /// The structure.
    pub structure: StructureId,
    /// What it does.
    pub kind: JobKind,
    /// Where it is.
    pub state: JobState,
    /// Why it failed.
    pub failure: Option<String>,
    /// When it was asked for; of extensions stored by earlier versions, when their diagnosis ended.
    pub created_at: Timestamp,
    /// When it ended.
    pub finished_at: Option<Timestamp>,
    /// Verdict of a diagnosis.
    pub verdict: Option<String>,
    /// A sentence: what a diagnosis found, what an extension added.
    pub summary: Option<String>,
}

#[derive(FromRow)]
struct Row {
    diagnosis_id: String,
    structure_id: String,
    extension: bool,
    state: String,
    failure: Option<String>,
    created_at_us: i64,
    finished_at_us: Option<i64>,
    verdict: Option<String>,
    summary: Option<String>,
}

impl Store {
    /// Diagnoses and extensions of all structures, newest first.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn jobs(&self, limit: usize) -> Result<Vec<JobRecord>, Error> {
        // The newest are chosen before any result, which can be long, is read.
        let rows: Vec<Row> = sqlx::query_as(
            "select d.diagnosis_id, d.structure_id, j.extension,
                    iif(j.extension, d.extension_state, d.state) as state,
                    iif(j.extension, d.extension_failure, d.failure) as failure,
                    j.created_at_us,
                    iif(j.extension, d.extended_at_us, d.finished_at_us) as finished_at_us,
                    iif(j.extension, null, d.result ->> '$.verdict') as verdict,
                    iif(j.extension, (select group_concat(value, '; ') from json_each(d.extension, '$.added')),
                        d.result ->> '$.summary') as summary
             from (select * from (
                       select diagnosis_id, false as extension, created_at_us from diagnosis
                       union all
                       select diagnosis_id, true, coalesce(extension_begun_at_us, finished_at_us, created_at_us)
                       from diagnosis where extension_state is not null)
                   order by created_at_us desc, diagnosis_id desc, extension desc limit ?) j
             join diagnosis d using (diagnosis_id)
             order by j.created_at_us desc, d.diagnosis_id desc, j.extension desc",
        )
        .bind(limit as i64)
        .fetch_all(&self.reader)
        .await?;
        rows.into_iter().map(record).collect()
    }
}

fn record(row: Row) -> Result<JobRecord, Error> {
    let what = "job";
    Ok(JobRecord {
        id: row.diagnosis_id,
        structure: StructureId::parse(&row.structure_id).map_err(|e| bad_row(what)(&e))?,
        kind: if row.extension { JobKind::Extension } else { JobKind::Diagnosis },
        state: job_state(&row.state)?,
        failure: row.failure,
        created_at: timestamp(what, row.created_at_us)?,
        finished_at: row.finished_at_us.map(|at| timestamp(what, at)).transpose()?,
        verdict: row.verdict,
        summary: row.summary,
    })
}
