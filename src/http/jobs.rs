//! `/v1/jobs`: the diagnoses, extensions and trainings of all structures; ending them and changing their order.

use axum::extract::State;
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::Serialize;
use utoipa::ToSchema;

use super::error::ApiError;
use super::openapi::{Conflict, JobPath, Unknown};
use super::request::ApiPath;
use super::shared::Shared;
use crate::access::Grant;
use crate::monitor::stored::{DiagnosisTrigger, JobKind, JobRecord, JobState};
use crate::monitor::JobStatus;
use crate::quantity::{StructureId, Timestamp};

/// Maximum number of jobs in the list.
const LISTED_JOBS: usize = 100;

/// What a job is doing; all `null` for one that has ended.
#[derive(Debug, Default, Serialize, ToSchema)]
#[schema(as = JobProgress)]
pub struct Status {
    /// What it is doing, in words.
    #[schema(required)]
    progress: Option<String>,
    /// The share of the present round of a training that is done, 0 to 1; `null` where it is not known.
    #[schema(required)]
    share: Option<f64>,
    /// Estimated time left in the present round of a training, s; `null` before there is something to estimate it from.
    #[schema(required)]
    time_left_s: Option<f64>,
    /// Place among the waiting jobs of its lane, from 1. Diagnoses have one lane, trainings and extensions the other; in each lane
    /// one job runs at a time, or as many as there are workers, and only one of a structure.
    #[schema(required)]
    place: Option<usize>,
}

impl From<Option<JobStatus>> for Status {
    fn from(status: Option<JobStatus>) -> Self {
        let Some(JobStatus { waits: _, place, progress, share, time_left_s }) = status else { return Self::default() };
        Self { progress: Some(progress), share, time_left_s, place }
    }
}

/// Jobs, newest first.
#[derive(Debug, Serialize, ToSchema)]
struct JobList {
    items: Vec<JobItem>,
}

/// A diagnosis, an extension or a training.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Job)]
struct JobItem {
    /// Id of the diagnosis or training; an extension has that of its diagnosis.
    job: String,
    structure: StructureId,
    kind: JobKind,
    /// Why a diagnosis was started; `null` for other jobs.
    #[schema(required)]
    trigger: Option<DiagnosisTrigger>,
    state: JobState,
    #[serde(flatten)]
    status: Status,
    #[serde(skip_serializing_if = "Option::is_none")]
    failure: Option<String>,
    created_at: Timestamp,
    #[schema(required)]
    finished_at: Option<Timestamp>,
    /// Verdict of a diagnosis, or outcome of a training.
    #[schema(required)]
    verdict: Option<String>,
    #[schema(required)]
    summary: Option<String>,
}

/// A job whose end was requested or that was moved.
#[derive(Debug, Serialize, ToSchema)]
struct ChangedJob {
    job: String,
    #[serde(flatten)]
    status: Status,
}

/// `GET /v1/jobs`: jobs of all structures that the token may see, newest first.
///
/// # Errors
/// 500.
#[utoipa::path(
    get, path = "/v1/jobs", tag = "jobs", operation_id = "list_jobs",
    summary = "Jobs",
    description = "Diagnoses, extensions and trainings of all structures that the token may see, newest first: all that run or wait, and the \
                   newest of the others, together 100.",
    responses((status = 200, description = "The jobs", body = JobList))
)]
pub async fn list(State(shared): State<Shared>, grant: Grant) -> Result<Response, ApiError> {
    let item = |(job, status): (JobRecord, Option<JobStatus>)| JobItem {
        job: job.id,
        structure: job.structure,
        kind: job.kind,
        trigger: job.trigger,
        state: job.state,
        status: Status::from(status),
        failure: job.failure,
        created_at: job.created_at,
        finished_at: job.finished_at,
        verdict: job.verdict,
        summary: job.summary,
    };
    let jobs = shared.monitor.jobs().list(grant.structures(), LISTED_JOBS).await?;
    Ok(Json(JobList { items: jobs.into_iter().map(item).collect() }).into_response())
}

/// `DELETE /v1/jobs/{id}`: requests the end of a job.
///
/// # Errors
/// 404 if it neither runs nor waits, 409 if its result is being stored.
#[utoipa::path(
    delete, path = "/v1/jobs/{id}", tag = "jobs", operation_id = "cancel_job",
    summary = "Cancel a job",
    description = "A job that waits ends at once, one that runs at its next epoch or step. Its state is then `cancelled`, and nothing \
                   else changes. The request is stored: the job does not begin again after a restart. A job whose result is being stored \
                   has ended (409).",
    params(JobPath),
    responses((status = 200, description = "The end was requested", body = ChangedJob), Unknown, Conflict)
)]
pub async fn cancel(State(shared): State<Shared>, ApiPath(id): ApiPath<String>) -> Result<Response, ApiError> {
    shared.monitor.jobs().cancel(&id).await?;
    Ok(changed(&shared, id))
}

/// `POST /v1/jobs/{id}/first`: moves a waiting job before the others.
///
/// # Errors
/// 404 if it neither runs nor waits, 409 if it runs.
#[utoipa::path(
    post, path = "/v1/jobs/{id}/first", tag = "jobs", operation_id = "move_job_to_front",
    summary = "Move a waiting job to the front", description = "It is the next to run in its lane.",
    params(JobPath),
    responses((status = 200, description = "The job was moved", body = ChangedJob), Unknown, Conflict)
)]
pub async fn first(State(shared): State<Shared>, ApiPath(id): ApiPath<String>) -> Result<Response, ApiError> {
    shared.monitor.jobs().move_to_front(&id)?;
    Ok(changed(&shared, id))
}

fn changed(shared: &Shared, job: String) -> Response {
    let status = Status::from(shared.monitor.jobs().status(&job));
    Json(ChangedJob { job, status }).into_response()
}
