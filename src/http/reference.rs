//! `/v1/structures/{id}/reference`: declares the undamaged reference of a structure.

use axum::body::Body;
use axum::extract::State;
use axum::http::{header, HeaderMap, HeaderName, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::Deserialize;
use utoipa::ToSchema;

use super::answer::Undamaged;
use super::error::ApiError;
use super::openapi::{BodyRefused, Busy, Conflict, StructurePath, Unknown};
use super::request::{json_body, structure_id, ApiPath};
use super::shared::Shared;

/// Threshold probability p unless the client gives another (paper §4).
const DEFAULT_THRESHOLD_PROBABILITY: f64 = 0.05;

/// Marks an answer of a deprecated route with the date of its deprecation (RFC 9745): 2026-11-23.
const DEPRECATION: (HeaderName, &str) = (HeaderName::from_static("deprecation"), "@1795392000");

/// Batches that were measured while the structure was undamaged.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct ReferenceInput {
    /// Ids of the batches; together they must hold at least ten measurements.
    #[schema(min_items = 1)]
    batches: Vec<String>,
    /// Probability that the undamaged structure is below the damage threshold. It defines the threshold, and a batch exceeds
    /// it when its probability of damage is larger. Default 0.05.
    #[schema(exclusive_minimum = 0, maximum = 0.5)]
    threshold_probability: Option<f64>,
}

/// `PUT /v1/structures/{id}/reference`: declares the undamaged reference; 201 with its new version.
///
/// # Errors
/// 400, 415, 422 for the body, 404 for structure or batch, 409 without a trained model, 503 when the queue is full.
#[utoipa::path(
    put, path = "/v1/structures/{id}/reference", tag = "results", operation_id = "put_reference",
    summary = "Declare the undamaged reference",
    description = "Computes a new version of the undamaged reference from the named batches. Batches that were never compared \
                   with a reference, and all batches measured after those of the reference, are then compared with it. \
                   Batches that cannot be used as a reference are refused with the code `unusable_baseline`, which has kept \
                   the earlier name.",
    params(StructurePath),
    request_body(content = ReferenceInput, example = json!({"batches": ["0199a0c6-7d5e-7c3a-a5b1-0d7e6a3f9b10"]})),
    responses(
        (status = 201, description = "The new version of the undamaged reference", body = Undamaged),
        Unknown, BodyRefused, Conflict, Busy
    )
)]
pub async fn put(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    shared.monitor.structure(&id)?;
    let body: ReferenceInput = json_body(&headers, body, shared.limits).await?;
    if body.batches.is_empty() {
        return Err(ApiError::invalid_field("/batches", "name at least one batch"));
    }
    let probability = body.threshold_probability.unwrap_or(DEFAULT_THRESHOLD_PROBABILITY);
    let record = shared.monitor.replay().declare_reference(&id, body.batches, probability).await?;
    Ok((StatusCode::CREATED, Json(Undamaged::new(&id, &record))).into_response())
}

/// `POST /v1/structures/{id}/reference`: the same as `PUT`.
///
/// # Errors
/// As [`put`].
#[utoipa::path(
    post, path = "/v1/structures/{id}/reference", tag = "results", operation_id = "declare_reference",
    summary = "Declare the undamaged reference", description = "The same as `PUT`.",
    params(StructurePath),
    request_body(content = ReferenceInput, example = json!({"batches": ["0199a0c6-7d5e-7c3a-a5b1-0d7e6a3f9b10"]})),
    responses(
        (status = 201, description = "The new version of the undamaged reference", body = Undamaged),
        Unknown, BodyRefused, Conflict, Busy
    )
)]
pub async fn post(
    state: State<Shared>,
    id: ApiPath<String>,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    put(state, id, headers, body).await
}

/// `POST /v1/structures/{id}/baseline`: the earlier name of this route, with a `Deprecation` header in every answer.
#[utoipa::path(
    post, path = "/v1/structures/{id}/baseline", tag = "results", operation_id = "declare_undamaged",
    summary = "Declare the undamaged reference (earlier name)",
    description = "Deprecated: use `/v1/structures/{id}/reference`, which takes the same body and gives the same answer.",
    params(StructurePath),
    request_body(content = ReferenceInput, example = json!({"batches": ["0199a0c6-7d5e-7c3a-a5b1-0d7e6a3f9b10"]})),
    responses(
        (status = 201, description = "The new version of the undamaged reference", body = Undamaged, headers(
            ("Deprecation" = String, description = "When the route was deprecated (RFC 9745)"),
            ("Link" = String, description = "The route to use instead, `rel=\"successor-version\"`")
        )),
        Unknown, BodyRefused, Conflict, Busy
    )
)]
#[deprecated(note = "clients are asked to use the route `/reference`")]
pub async fn post_baseline(
    state: State<Shared>,
    ApiPath(id): ApiPath<String>,
    headers: HeaderMap,
    body: Body,
) -> impl IntoResponse {
    let successor = structure_id(&id).ok();
    let successor =
        successor.map(|id| [(header::LINK, format!("</v1/structures/{id}/reference>; rel=\"successor-version\""))]);
    ([DEPRECATION], successor, put(state, ApiPath(id), headers, body).await)
}
