//! `/v1/structures/{id}/diagnoses`, `/v1/diagnoses/{id}`: what the simulation gets wrong, and the extension by it.

use axum::body::Body;
use axum::extract::State;
use axum::http::{header, HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::{Deserialize, Serialize};
use serde_json::value::RawValue;

use super::error::ApiError;
use super::request::{json_body, structure_id, ApiPath};
use super::Shared;
use crate::monitor::{DiagnosisRequest, ExtensionTraining};
use crate::quantity::{StructureId, Timestamp};
use crate::store::{DiagnosisRecord, JobState};

/// Diagnoses listed of one structure.
const LISTED: usize = 100;

/// Body of a request for a diagnosis; `{}` diagnoses all batches.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct DiagnosisBody {
    batches: Vec<String>,
    holdout: Option<String>,
    seed: Option<u64>,
}

/// Body of a request for an extension; `{}` trains as the baseline before was trained.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
struct ExtensionBody {
    samples: Option<usize>,
    epochs: Option<usize>,
    accept_uncalibrated: bool,
}

/// A diagnosis as it is answered.
#[derive(Debug, Serialize)]
struct DiagnosisAnswer {
    diagnosis: String,
    structure: StructureId,
    structure_digest: String,
    state: JobState,
    #[serde(skip_serializing_if = "Option::is_none")]
    progress: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    failure: Option<String>,
    created_at: Timestamp,
    finished_at: Option<Timestamp>,
    result: Option<Box<RawValue>>,
    report: Option<String>,
    extension: Option<ExtensionAnswer>,
}

/// The extension by a diagnosis.
#[derive(Debug, Serialize)]
struct ExtensionAnswer {
    state: JobState,
    #[serde(skip_serializing_if = "Option::is_none")]
    failure: Option<String>,
    result: Option<Box<RawValue>>,
}

/// One line of the list.
#[derive(Debug, Serialize)]
struct Listed {
    diagnosis: String,
    state: JobState,
    created_at: Timestamp,
    verdict: Option<String>,
    summary: Option<String>,
    extension: Option<JobState>,
}

fn raw(json: Option<String>) -> Result<Option<Box<RawValue>>, ApiError> {
    json.map(RawValue::from_string).transpose().map_err(|e| ApiError::internal(&e))
}

fn answer(record: DiagnosisRecord, progress: Option<String>) -> Result<DiagnosisAnswer, ApiError> {
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
        state: record.state,
        progress,
        failure: record.failure,
        created_at: record.created_at,
        finished_at: record.finished_at,
        result: raw(record.result)?,
        extension,
    })
}

/// `POST /v1/structures/{id}/diagnoses`: 202, the job runs on.
///
/// # Errors
/// 404 for structure and batches, 422 for the hold-out.
pub async fn create(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    let body: DiagnosisBody = json_body(&headers, body, shared.limits).await?;
    let holdout = body.holdout.as_deref().unwrap_or("last:0.25").parse();
    let holdout = holdout.map_err(|message: String| ApiError::invalid_field("/holdout", message))?;
    let request = DiagnosisRequest { batches: body.batches, holdout, seed: body.seed.unwrap_or(1) };
    let record = shared.monitor.start_diagnosis(&id, request).await?;
    let location = [(header::LOCATION, format!("/v1/diagnoses/{}", record.id))];
    Ok((StatusCode::ACCEPTED, location, Json(answer(record, Some("waiting".to_owned()))?)).into_response())
}

/// `GET /v1/structures/{id}/diagnoses`: the newest first.
///
/// # Errors
/// 404.
pub async fn list(State(shared): State<Shared>, ApiPath(id): ApiPath<String>) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    shared.monitor.structure(&id)?;
    let mut items = Vec::new();
    for record in shared.monitor.store().diagnoses(&id, LISTED).await? {
        let result: Option<serde_json::Value> = record.result.as_deref().and_then(|r| serde_json::from_str(r).ok());
        let text = |key: &str| result.as_ref().and_then(|r| r[key].as_str()).map(str::to_owned);
        items.push(Listed {
            verdict: text("verdict"),
            summary: text("summary"),
            diagnosis: record.id,
            state: record.state,
            created_at: record.created_at,
            extension: record.extension_state,
        });
    }
    Ok(Json(serde_json::json!({ "structure": id, "items": items })).into_response())
}

/// `GET /v1/diagnoses/{id}`: state, progress and result.
///
/// # Errors
/// 404.
pub async fn read(State(shared): State<Shared>, ApiPath(id): ApiPath<String>) -> Result<Response, ApiError> {
    let (record, progress) = shared.monitor.diagnosis(&id).await?;
    Ok(Json(answer(record, progress)?).into_response())
}

/// `GET /v1/diagnoses/{id}/report`: the page.
///
/// # Errors
/// 404, 409 while there is none.
pub async fn report(State(shared): State<Shared>, ApiPath(id): ApiPath<String>) -> Result<Response, ApiError> {
    shared.monitor.diagnosis(&id).await?;
    let Some(html) = shared.monitor.store().diagnosis_report(&id).await? else {
        return Err(ApiError::new(StatusCode::CONFLICT, "no_report", format!("diagnosis {id} has no report yet")));
    };
    let policy = "default-src 'none'; style-src 'unsafe-inline'; img-src data:";
    let headers = [(header::CONTENT_TYPE, "text/html; charset=utf-8"), (header::CONTENT_SECURITY_POLICY, policy)];
    Ok((headers, html).into_response())
}

/// `POST /v1/diagnoses/{id}/extension`: 202, the job runs on.
///
/// # Errors
/// 404, 409 when it cannot be extended, 422 for the training.
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
    let ExtensionBody { samples, epochs, accept_uncalibrated } = body;
    let training = ExtensionTraining { samples, epochs, accept_uncalibrated };
    let record = shared.monitor.start_extension(&id, training).await?;
    let location = [(header::LOCATION, format!("/v1/diagnoses/{id}"))];
    Ok((StatusCode::ACCEPTED, location, Json(answer(record, Some("waiting".to_owned()))?)).into_response())
}

/// `DELETE /v1/structures/{id}/extension`: one step back.
///
/// # Errors
/// 404, 409 when the structure extends none.
pub async fn step_back(State(shared): State<Shared>, ApiPath(id): ApiPath<String>) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    let digest = shared.monitor.step_back(&id).await?;
    Ok(Json(serde_json::json!({ "structure": id, "structure_digest": digest })).into_response())
}
