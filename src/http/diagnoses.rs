//! `/v1/structures/{id}/diagnoses`, `/v1/diagnoses/{id}`: diagnoses of the simulation, and extensions of the structure
//! by them.

use axum::body::Body;
use axum::extract::State;
use axum::http::{header, HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::{Deserialize, Serialize};
use serde_json::value::RawValue;
use utoipa::ToSchema;

use super::error::ApiError;
use super::openapi::{BodyRefused, Busy, Conflict, DiagnosisPath, Invalid, StructurePath, Unknown};
use super::request::{json_body, structure_id, whole_number, ApiPath};
use super::shared::Shared;
use crate::discrepancy::Diagnosis;
use crate::monitor::stored::{DiagnosisRecord, DiagnosisTrigger, JobState};
use crate::monitor::{DiagnosisRequest, ExtensionResult, ExtensionTraining, JobStatus};
use crate::quantity::{Digest, StructureId, Timestamp};

/// Maximum number of diagnoses in the list of a structure.
const LISTED: usize = 100;

/// Body of a request for a diagnosis; `{}` diagnoses all batches.
#[derive(Debug, Default, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, default)]
#[schema(as = DiagnosisInput)]
struct DiagnosisBody {
    /// Ids of batches. Default: all.
    batches: Vec<String>,
    /// Only measurements from this time on: RFC 3339, or a day, which stands for its midnight in UTC. Default: from the first.
    #[schema(examples("2025-01-01", "2025-01-01T00:00:00Z"))]
    from: Option<String>,
    /// Only measurements before this time, in the same form. Default: to the last.
    #[schema(examples("2026-01-01", "2026-01-01T00:00:00Z"))]
    to: Option<String>,
    /// Measurements that are held out to evaluate the gain: the last share, those since a day or time, or those with a category.
    /// Default `last:0.25`.
    #[schema(
        pattern = r"^(last:0(\.[0-9]{1,6})?|last:\.[0-9]{1,6}|since:[0-9]{4}-.+|where:[^=]+=.+)$",
        examples("last:0.25", "since:2025-08-07", "where:operator=anna")
    )]
    holdout: Option<String>,
    /// Seed of the bootstrap. Default 1.
    #[serde(deserialize_with = "whole_number")]
    #[schema(value_type = Option<u64>, maximum = 9_007_199_254_740_991_i64)]
    seed: Option<u64>,
}

/// Body of a request for an extension; with `{}` the training starts from the weights of the present model.
#[derive(Debug, Default, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, default)]
#[schema(as = ExtensionInput)]
struct ExtensionBody {
    /// Number of simulated training samples.
    #[serde(deserialize_with = "whole_number")]
    #[schema(value_type = Option<u64>, minimum = 1000, maximum = 2_000_000)]
    samples: Option<u64>,
    /// Number of training epochs.
    #[serde(deserialize_with = "whole_number")]
    #[schema(value_type = Option<u64>, minimum = 1, maximum = 2000)]
    epochs: Option<u64>,
    /// Use the model even if it fails its calibration; every assessment then carries a finding.
    accept_uncalibrated: bool,
    /// Add a discrepancy learned from the data instead of the causes. It is refused where the diagnosis found nothing or possible
    /// damage, where a stiffness changes among the measurements, and where the discrepancy predicts measurements that it has not
    /// seen no better.
    learned: bool,
    /// Start the training from random weights instead of those of the present model.
    from_scratch: bool,
}

/// A diagnosis with its job.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = DiagnosisJob)]
struct DiagnosisAnswer {
    diagnosis: String,
    structure: StructureId,
    structure_digest: String,
    trigger: DiagnosisTrigger,
    /// Number of the alarm because of which the service started it.
    #[schema(required)]
    alarm: Option<i64>,
    state: JobState,
    /// What it or its extension is doing, in words.
    #[serde(skip_serializing_if = "Option::is_none")]
    progress: Option<String>,
    /// The share of the present round of the training of an extension that is done, 0 to 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    share: Option<f64>,
    /// Estimated time left in that round, s.
    #[serde(skip_serializing_if = "Option::is_none")]
    time_left_s: Option<f64>,
    /// Place among the waiting jobs of its lane, from 1.
    #[serde(skip_serializing_if = "Option::is_none")]
    place: Option<usize>,
    #[serde(skip_serializing_if = "Option::is_none")]
    failure: Option<String>,
    created_at: Timestamp,
    finished_at: Option<Timestamp>,
    #[schema(value_type = Option<Diagnosis>)]
    result: Option<Box<RawValue>>,
    /// Path of the report, once the diagnosis is done.
    report: Option<String>,
    extension: Option<ExtensionAnswer>,
}

/// The extension of the structure by a diagnosis.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = ExtensionJob)]
struct ExtensionAnswer {
    state: JobState,
    #[serde(skip_serializing_if = "Option::is_none")]
    failure: Option<String>,
    #[schema(value_type = Option<ExtensionResult>)]
    result: Option<Box<RawValue>>,
}

/// One line of the list.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = ListedDiagnosis)]
struct Listed {
    diagnosis: String,
    trigger: DiagnosisTrigger,
    /// Number of the alarm because of which the service started it.
    #[schema(required)]
    alarm: Option<i64>,
    state: JobState,
    created_at: Timestamp,
    verdict: Option<String>,
    summary: Option<String>,
    extension: Option<JobState>,
}

/// Diagnoses of a structure, newest first.
#[derive(Debug, Serialize, ToSchema)]
struct DiagnosisList {
    structure: StructureId,
    /// Why the structure cannot be diagnosed now; `null` where it can.
    #[schema(required)]
    not_possible: Option<String>,
    items: Vec<Listed>,
}

/// Result of reverting an extension.
#[derive(Debug, Serialize, ToSchema)]
struct SteppedBack {
    structure: StructureId,
    /// Version of the structure that is now in use.
    structure_digest: Digest,
}

fn raw(json: Option<String>) -> Result<Option<Box<RawValue>>, ApiError> {
    json.map(RawValue::from_string).transpose().map_err(|e| ApiError::unreadable("diagnosis", &e))
}

fn answer(record: DiagnosisRecord, status: Option<JobStatus>) -> Result<DiagnosisAnswer, ApiError> {
    let done = record.state == JobState::Done;
    let extension = match record.extension_state {
        Some(state) => {
            Some(ExtensionAnswer { state, failure: record.extension_failure, result: raw(record.extension)? })
        }
        None => None,
    };
    Ok(DiagnosisAnswer {
        report: done.then(|| format!("/v1/diagnoses/{}/report", record.id)),
        diagnosis: record.id,
        structure: record.structure,
        structure_digest: record.structure_digest.to_string(),
        trigger: record.trigger,
        alarm: record.alarm,
        state: record.state,
        share: status.as_ref().and_then(|status| status.share),
        time_left_s: status.as_ref().and_then(|status| status.time_left_s),
        place: status.as_ref().and_then(|status| status.place),
        progress: status.map(|status| status.progress),
        failure: record.failure,
        created_at: record.created_at,
        finished_at: record.finished_at,
        result: raw(record.result)?,
        extension,
    })
}

/// The ends of a period.
fn period(from: Option<&str>, to: Option<&str>) -> Result<[Option<Timestamp>; 2], ApiError> {
    let read = |pointer: &str, text: Option<&str>| {
        let time = text.map(Timestamp::parse_day_or_time).transpose();
        time.map_err(|e| ApiError::invalid_field(pointer, e.to_string()))
    };
    let (first, end) = (read("/from", from)?, read("/to", to)?);
    if let (Some(first), Some(end)) = (first, end) {
        if end <= first {
            return Err(ApiError::invalid_field("/to", format!("{end} must be after \"from\", which is {first}")));
        }
    }
    Ok([first, end])
}

/// `POST /v1/structures/{id}/diagnoses`: 202, starts a background job.
///
/// # Errors
/// 404 for structure and batches, 422 for the hold-out and the period.
#[utoipa::path(
    post, path = "/v1/structures/{id}/diagnoses", tag = "diagnoses", operation_id = "start_diagnosis",
    summary = "Diagnose the simulation",
    description = "Starts a background job that looks for systematic errors of the simulation in stored batches. All measurements, those held out as well, \
                   are tested for a lasting change in time, which may be damage (`lasting_change`); what was measured since then is used neither \
                   to find causes nor to measure their gain.",
    params(StructurePath),
    request_body(content = DiagnosisBody, example = json!({"holdout": "last:0.25"})),
    responses(
        (status = 202, description = "The job has started", body = DiagnosisAnswer,
         headers(("Location" = String, description = "Path of the diagnosis"))),
        Unknown, BodyRefused, Conflict, Busy
    )
)]
pub async fn create(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    let body: DiagnosisBody = json_body(&headers, body, shared.limits).await?;
    let all = DiagnosisRequest::default();
    let holdout = body.holdout.as_deref().map(str::parse).transpose();
    let holdout = holdout.map_err(|message: String| ApiError::invalid_field("/holdout", message))?;
    let [from, to] = period(body.from.as_deref(), body.to.as_deref())?;
    let request = DiagnosisRequest {
        batches: body.batches,
        from,
        to,
        holdout: holdout.unwrap_or(all.holdout),
        seed: body.seed.unwrap_or(all.seed),
    };
    let record = shared.monitor.jobs().start_diagnosis(&id, request, (DiagnosisTrigger::Requested, None)).await?;
    let location = [(header::LOCATION, format!("/v1/diagnoses/{}", record.id))];
    let status = shared.monitor.jobs().status(&record.id);
    Ok((StatusCode::ACCEPTED, location, Json(answer(record, status)?)).into_response())
}

/// `GET /v1/structures/{id}/diagnoses`: the newest first.
///
/// # Errors
/// 404.
#[utoipa::path(
    get, path = "/v1/structures/{id}/diagnoses", tag = "diagnoses", operation_id = "list_diagnoses",
    summary = "Diagnoses of a structure", description = "The 100 newest, newest first.",
    params(StructurePath),
    responses((status = 200, description = "The diagnoses", body = DiagnosisList), Unknown, Invalid)
)]
pub async fn list(State(shared): State<Shared>, ApiPath(id): ApiPath<String>) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    shared.monitor.structure(&id)?;
    let mut items = Vec::new();
    for record in shared.monitor.jobs().diagnoses(&id, LISTED).await? {
        let result: Option<serde_json::Value> = record.result.as_deref().and_then(|r| serde_json::from_str(r).ok());
        let text = |key: &str| result.as_ref().and_then(|r| r[key].as_str()).map(str::to_owned);
        items.push(Listed {
            verdict: text("verdict"),
            summary: text("summary"),
            diagnosis: record.id,
            trigger: record.trigger,
            alarm: record.alarm,
            state: record.state,
            created_at: record.created_at,
            extension: record.extension_state,
        });
    }
    let not_possible = shared.monitor.jobs().no_diagnosis(&id).await?;
    Ok(Json(DiagnosisList { structure: id, not_possible, items }).into_response())
}

/// `GET /v1/diagnoses/{id}`: state, progress and result.
///
/// # Errors
/// 404.
#[utoipa::path(
    get, path = "/v1/diagnoses/{id}", tag = "diagnoses", operation_id = "read_diagnosis",
    summary = "A diagnosis", description = "State and progress of the job, and its result once it is done.",
    params(DiagnosisPath),
    responses((status = 200, description = "The diagnosis", body = DiagnosisAnswer), Unknown)
)]
pub async fn read(State(shared): State<Shared>, ApiPath(id): ApiPath<String>) -> Result<Response, ApiError> {
    let (record, status) = shared.monitor.jobs().diagnosis(&id).await?;
    Ok(Json(answer(record, status)?).into_response())
}

/// `GET /v1/diagnoses/{id}/report`: the report as HTML.
///
/// # Errors
/// 404, 409 while the report does not exist.
#[utoipa::path(
    get, path = "/v1/diagnoses/{id}/report", tag = "diagnoses", operation_id = "read_report",
    summary = "Report of a diagnosis", description = "One self-contained HTML page.",
    params(DiagnosisPath),
    responses((status = 200, description = "The report", body = String, content_type = "text/html"), Unknown, Conflict)
)]
pub async fn report(State(shared): State<Shared>, ApiPath(id): ApiPath<String>) -> Result<Response, ApiError> {
    let Some(html) = shared.monitor.jobs().report(&id).await? else {
        return Err(ApiError::new(StatusCode::CONFLICT, "no_report", format!("diagnosis {id} has no report yet")));
    };
    let policy = "default-src 'none'; style-src 'unsafe-inline'; img-src data:";
    let headers = [(header::CONTENT_TYPE, "text/html; charset=utf-8"), (header::CONTENT_SECURITY_POLICY, policy)];
    Ok((headers, html).into_response())
}

/// `POST /v1/diagnoses/{id}/extension`: 202, starts a background job.
///
/// # Errors
/// 404, 409 if the structure cannot be extended by this diagnosis, 422 for the training settings.
#[utoipa::path(
    post, path = "/v1/diagnoses/{id}/extension", tag = "diagnoses", operation_id = "extend_structure",
    summary = "Extend the structure by a diagnosis",
    description = "Starts a background job that adds the causes to a new version of the structure and trains a model for it.",
    params(DiagnosisPath),
    request_body(content = ExtensionBody, example = json!({"samples": 200_000, "epochs": 80})),
    responses(
        (status = 202, description = "The job has started", body = DiagnosisAnswer,
         headers(("Location" = String, description = "Path of the diagnosis"))),
        Unknown, BodyRefused, Conflict, Busy
    )
)]
pub async fn extend(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    let body: ExtensionBody = json_body(&headers, body, shared.limits).await?;
    for (pointer, value, range) in [("/samples", body.samples, 1_000..=2_000_000), ("/epochs", body.epochs, 1..=2_000)]
    {
        if let Some(value) = value.filter(|value| !range.contains(value)) {
            let message = format!("{value} must be between {} and {}", range.start(), range.end());
            return Err(ApiError::invalid_field(pointer, message));
        }
    }
    let ExtensionBody { samples, epochs, accept_uncalibrated, learned, from_scratch } = body;
    let size = |number: Option<u64>| number.map(|n| n as usize);
    let (samples, epochs) = (size(samples), size(epochs));
    let training = ExtensionTraining { samples, epochs, from_scratch, accept_uncalibrated, learned };
    let record = shared.monitor.jobs().start_extension(&id, training).await?;
    let location = [(header::LOCATION, format!("/v1/diagnoses/{id}"))];
    let status = shared.monitor.jobs().status(&id);
    Ok((StatusCode::ACCEPTED, location, Json(answer(record, status)?)).into_response())
}

/// `DELETE /v1/structures/{id}/extension`: reverts the last extension.
///
/// # Errors
/// 404, 409 if the structure has no extension.
#[utoipa::path(
    delete, path = "/v1/structures/{id}/extension", tag = "diagnoses", operation_id = "step_back",
    summary = "Revert the last extension", description = "Returns to the version that the present one extends.",
    params(StructurePath),
    responses((status = 200, description = "The version that is now in use", body = SteppedBack), Unknown, Invalid, Conflict)
)]
pub async fn step_back(State(shared): State<Shared>, ApiPath(id): ApiPath<String>) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    let digest = shared.monitor.versions().step_back(&id).await?;
    Ok(Json(SteppedBack { structure: id, structure_digest: digest }).into_response())
}
