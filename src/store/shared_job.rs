//! Diagnoses, trainings and extensions whose computation the service that serves a PostgreSQL database leaves to a worker.
//!
//! Claims are those of the pieces of [`Computations`]: each has a number, and holds until its lease ends. What is computed, its progress and its
//! result are texts here; `monitor::jobs` has their meaning.

use std::time::Duration;

use sqlx::FromRow;

use super::column::bad_row;
use super::computation::{Computations, PieceState};
use super::error::{over_network, Error};
use super::jobs::{kind, JobKind};
use super::sql;
use crate::quantity::StructureId;

/// A job whose computation is offered.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SharedJob {
    /// Id of the diagnosis or training.
    pub id: String,
    /// Its kind.
    pub kind: JobKind,
    /// The structure.
    pub structure: StructureId,
    /// What must be equal of the program and its machine.
    pub program: String,
    /// What is computed, as JSON.
    pub task: String,
}

/// A job that a worker holds.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JobClaim {
    /// The job.
    pub job: SharedJob,
    /// Number of the claim.
    pub fence: i64,
}

/// What a worker has computed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct JobResult {
    /// The result as JSON, or why there is none.
    pub content: Result<String, String>,
    /// Weights of the model that was trained.
    pub weights: Option<Vec<u8>>,
}

/// What other processes do about a job.
#[derive(Debug, Clone, PartialEq)]
pub struct AwaitedJob {
    /// What it is doing, as JSON.
    pub progress: Option<String>,
    /// Who computes it.
    pub state: PieceState,
    /// Its result, if there is one.
    pub result: Option<JobResult>,
}

#[derive(FromRow)]
struct ClaimRow {
    job_id: String,
    kind: String,
    structure_id: String,
    program: String,
    task: String,
    fence: i64,
}

#[derive(FromRow)]
struct AwaitedRow {
    progress: Option<String>,
    held: bool,
    free_s: Option<f64>,
    failed: Option<bool>,
    content: Option<String>,
    weights: Option<Vec<u8>>,
}

impl Computations<'_> {
    /// Offers the computation of a job to all workers but `own`. One that is offered already with the same task stays as it is, also if a worker
    /// holds it or has its result; one with anything else is taken from its holder.
    ///
    /// # Errors
    /// [`Error::Unreachable`], [`Error::ServedElsewhere`].
    pub async fn offer_job(self, job: &SharedJob, own: &str) -> Result<(), Error> {
        let (job, own) = (job.clone(), own.to_owned());
        let written = self.database.write(move |transaction| {
            Box::pin(async move {
                sql::query("delete from computation_job where job_id = $1 and kind = $2 and (program, task) is distinct from ($3, $4)")
                    .bind(&job.id)
                    .bind(job.kind.name())
                    .bind(&job.program)
                    .bind(&job.task)
                    .execute(&mut *transaction)
                    .await?;
                sql::query(
                    "insert into computation_job (job_id, kind, structure_id, program, task, offered_by, fence, free_since)
                     values ($1, $2, $3, $4, $5, $6, nextval('computation_fence'), clock_timestamp())
                     on conflict (job_id, kind) do update set offered_by = excluded.offered_by, free_since = excluded.free_since",
                )
                .bind(&job.id)
                .bind(job.kind.name())
                .bind(job.structure.as_str())
                .bind(&job.program)
                .bind(&job.task)
                .bind(&own)
                .execute(&mut *transaction)
                .await?;
                Ok(())
            })
        });
        written.await
    }

    /// What other processes do about a job; `None` if it is not offered.
    ///
    /// # Errors
    /// [`Error::Unreachable`].
    pub async fn awaited_job(self, id: &str, kind: JobKind) -> Result<Option<AwaitedJob>, Error> {
        let row: Option<AwaitedRow> = sqlx::query_as(
            "select progress, coalesce(lease_until > clock_timestamp(), false) as held,
                    extract(epoch from clock_timestamp() - greatest(free_since, lease_until))::float8 as free_s,
                    failed, content, weights
             from computation_job where job_id = $1 and kind = $2",
        )
        .bind(id)
        .bind(kind.name())
        .fetch_optional(self.pool)
        .await
        .map_err(over_network)?;
        Ok(row.map(AwaitedRow::awaited))
    }

    /// Withdraws the offer of a job, with its result.
    ///
    /// # Errors
    /// [`Error::Unreachable`], [`Error::ServedElsewhere`].
    pub async fn withdraw_job(self, id: &str, kind: JobKind) -> Result<(), Error> {
        let id = id.to_owned();
        let written = self.database.write(move |transaction| {
            Box::pin(async move {
                let delete = sql::query("delete from computation_job where job_id = $1 and kind = $2").bind(id);
                delete.bind(kind.name()).execute(&mut *transaction).await?;
                Ok(())
            })
        });
        written.await
    }

    /// Withdraws what an earlier service has offered of jobs that have ended.
    ///
    /// # Errors
    /// [`Error::Unreachable`], [`Error::ServedElsewhere`].
    pub async fn withdraw_ended_jobs(self) -> Result<(), Error> {
        let written = self.database.write(move |transaction| {
            Box::pin(async move {
                let delete = "delete from computation_job j
                     where not exists (select 1 from training t where t.training_id = j.job_id and t.state = 'waiting')
                       and not exists (select 1 from diagnosis d where d.diagnosis_id = j.job_id
                           and 'running' in (d.state, d.extension_state))";
                sql::query(delete).execute(&mut *transaction).await?;
                Ok(())
            })
        });
        written.await
    }

    /// Claims the first job that nobody holds and that has no result, among those for this program, not offered by the process of this worker,
    /// and not one that it has left.
    ///
    /// # Errors
    /// [`Error::Unreachable`].
    pub async fn claim_job(
        self,
        worker: &str,
        program: &str,
        lease: Duration,
        left: &[String],
    ) -> Result<Option<JobClaim>, Error> {
        let row: Option<ClaimRow> = sqlx::query_as(
            "update computation_job
             set worker = $1, fence = nextval('computation_fence'), lease_until = clock_timestamp() + make_interval(secs => $3)
             where (job_id, kind) = (
                 select job_id, kind from computation_job
                 where program = $2 and offered_by <> $1 and failed is null and not job_id = any ($4)
                   and (lease_until is null or lease_until <= clock_timestamp())
                 order by fence limit 1 for update skip locked)
             returning job_id, kind, structure_id, program, task, fence",
        )
        .bind(worker)
        .bind(program)
        .bind(lease.as_secs_f64())
        .bind(left)
        .fetch_optional(self.pool)
        .await
        .map_err(over_network)?;
        row.map(ClaimRow::claim).transpose()
    }

    /// Renews the lease of a claim, and says what the job is doing. Returns false if the job was claimed again, or is not offered any more.
    ///
    /// # Errors
    /// [`Error::Unreachable`].
    pub async fn renew_job(self, claim: &JobClaim, lease: Duration, progress: Option<String>) -> Result<bool, Error> {
        let update =
            "update computation_job set lease_until = clock_timestamp() + make_interval(secs => $4), progress = $5
             where job_id = $1 and kind = $2 and fence = $3 and failed is null";
        let renewed = bound(update, claim).bind(lease.as_secs_f64()).bind(progress).execute(self.pool).await;
        Ok(renewed.map_err(over_network)?.rows_affected() == 1)
    }

    /// Writes the result of a job. Returns false, and writes nothing, if the job was claimed again, or is not offered any more.
    ///
    /// # Errors
    /// [`Error::Unreachable`].
    pub async fn deliver_job(self, claim: &JobClaim, result: &JobResult) -> Result<bool, Error> {
        let update = "update computation_job set lease_until = null, failed = $4, content = $5, weights = $6
             where job_id = $1 and kind = $2 and fence = $3 and failed is null";
        let content = result.content.as_ref().map_or_else(String::as_str, String::as_str);
        let delivered = bound(update, claim).bind(result.content.is_err()).bind(content).bind(&result.weights);
        let delivered = delivered.execute(self.pool).await.map_err(over_network)?;
        Ok(delivered.rows_affected() == 1)
    }

    /// Gives a job back, for another worker.
    ///
    /// # Errors
    /// [`Error::Unreachable`].
    pub async fn release_job(self, claim: &JobClaim) -> Result<(), Error> {
        let update = "update computation_job set worker = null, lease_until = null, free_since = clock_timestamp()
             where job_id = $1 and kind = $2 and fence = $3 and failed is null";
        bound(update, claim).execute(self.pool).await.map_err(over_network)?;
        Ok(())
    }
}

/// A statement with id, kind and number of a claim as its first three arguments.
fn bound<'q>(
    statement: &'static str,
    claim: &'q JobClaim,
) -> sqlx::query::Query<'q, sqlx_postgres::Postgres, sqlx_postgres::PgArguments> {
    sqlx::query(statement).bind(&claim.job.id).bind(claim.job.kind.name()).bind(claim.fence)
}

impl ClaimRow {
    fn claim(self) -> Result<JobClaim, Error> {
        let structure = StructureId::parse(&self.structure_id).map_err(|error| bad_row("shared job")(&error))?;
        let Self { job_id: id, program, task, fence, .. } = self;
        Ok(JobClaim { job: SharedJob { id, kind: kind(&self.kind)?, structure, program, task }, fence })
    }
}

impl AwaitedRow {
    fn awaited(self) -> AwaitedJob {
        let state = if self.held {
            PieceState::Held
        } else {
            PieceState::Free(Duration::from_secs_f64(self.free_s.unwrap_or(0.0).max(0.0)))
        };
        let content = self.content.unwrap_or_default();
        let result = self.failed.map(|failed| JobResult {
            content: if failed { Err(content) } else { Ok(content) },
            weights: self.weights,
        });
        AwaitedJob { progress: self.progress, state, result }
    }
}
