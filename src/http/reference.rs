//! `/v1/structures/{id}/reference`: declares the undamaged reference of a structure.

use axum::body::Body;
use axum::extract::State;
use axum::http::{header, HeaderMap, HeaderName, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::answer::Undamaged;
use super::error::ApiError;
use super::openapi::{BodyRefused, Busy, Conflict, StructurePath, Unknown};
use super::request::{json_body, structure_id, ApiPath};
use super::shared::Shared;
use crate::measurement::check::Problem;
use crate::monitor::{DeclareError, DeclaredReference, LeftOutBatch, ReferenceChoice, ReferenceRequest};
use crate::quantity::Timestamp;

/// Threshold probability p unless the client gives another (paper §4).
const DEFAULT_THRESHOLD_PROBABILITY: f64 = 0.05;

/// Marks an answer of a deprecated route with the date of its deprecation (RFC 9745): 2026-11-23.
const DEPRECATION: (HeaderName, &str) = (HeaderName::from_static("deprecation"), "@1795392000");

/// What was measured while the structure was undamaged: either `batches`, or the period from `from` to `to`.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct ReferenceInput {
    /// Ids of the batches; together they must hold at least ten measurements.
    #[schema(min_items = 1)]
    batches: Option<Vec<String>>,
    /// Begin of a period: all batches that were measured completely from `from` on and before `to`.
    #[schema(value_type = Option<String>, format = DateTime)]
    from: Option<String>,
    /// End of the period, which is not part of it.
    #[schema(value_type = Option<String>, format = DateTime)]
    to: Option<String>,
    /// Whether batches that cannot be trusted are left out and listed in the answer (the default for a period), or the
    /// declaration is refused and each of them is named (the default for `batches`).
    leave_out_doubtful: Option<bool>,
    /// Probability that the undamaged structure is below the damage threshold. It defines the threshold, and a batch exceeds
    /// it when its probability of damage is larger. Default 0.05.
    #[schema(exclusive_minimum = 0, maximum = 0.5)]
    threshold_probability: Option<f64>,
}

impl ReferenceInput {
    /// The declaration that the body asks for.
    fn request(self) -> Result<ReferenceRequest, ApiError> {
        let time = |pointer: &str, text: &str| {
            Timestamp::parse(text).map_err(|e| ApiError::invalid_field(pointer, e.to_string()))
        };
        let refused = |pointer: &str, message: &str| Err(ApiError::invalid_field(pointer, message));
        let choice = match (self.batches, self.from.as_deref(), self.to.as_deref()) {
            (Some(batches), None, None) if !batches.is_empty() => ReferenceChoice::Batches(batches),
            (None, Some(from), Some(to)) => {
                let (from, to) = (time("/from", from)?, time("/to", to)?);
                if to <= from {
                    return refused("/to", "the end of the period must be after its begin");
                }
                ReferenceChoice::Period { from, to }
            }
            (Some(_), None, None) => return refused("/batches", "name at least one batch"),
            (Some(_), ..) => return refused("/batches", "give either the batches or a period from and to, not both"),
            (None, Some(_), None) => {
                return refused("/to", "the end of the period is missing: RFC 3339 with an offset")
            }
            (None, None, Some(_)) => {
                return refused("/from", "the begin of the period is missing: RFC 3339 with an offset")
            }
            (None, None, None) => {
                let message = "name the batches, or the period in which the structure was undamaged, such as \
                               {\"from\": \"2026-01-01T00:00:00Z\", \"to\": \"2026-07-01T00:00:00Z\"}";
                return refused("/batches", message);
            }
        };
        Ok(ReferenceRequest {
            leave_out_doubtful: self.leave_out_doubtful.unwrap_or(matches!(choice, ReferenceChoice::Period { .. })),
            choice,
            threshold_probability: self.threshold_probability.unwrap_or(DEFAULT_THRESHOLD_PROBABILITY),
        })
    }
}

/// The undamaged reference that was declared.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = DeclaredReference)]
struct Declared {
    #[serde(flatten)]
    reference: Undamaged,
    /// Batches that were named, or measured in the period, and are not part of the reference.
    left_out: Vec<LeftOutBatch>,
}

/// `PUT /v1/structures/{id}/reference`: declares the undamaged reference; 201 with its new version.
///
/// # Errors
/// 400, 415, 422 for the body, 404 for structure or batch, 409 without a trained model, 503 when the queue is full.
#[utoipa::path(
    put, path = "/v1/structures/{id}/reference", tag = "results", operation_id = "put_reference",
    summary = "Declare the undamaged reference",
    description = "Computes a new version of the undamaged reference from the named batches, or from those measured in a period. \
                   Batches that were never compared with a reference, and all batches measured after those of the reference, are \
                   then compared with it. Batches that cannot be used as a reference are refused with the code \
                   `unusable_baseline`, which has kept the earlier name, and `errors` names each of them; with \
                   `leave_out_doubtful` they are left out and listed in the answer. From a period they are left out, and also \
                   batches that were measured only in part in the period or during maintenance, and those without an assessment.",
    params(StructurePath),
    request_body(content = ReferenceInput, examples(
        ("batches" = (summary = "Batches by id", value = json!({"batches": ["0199a0c6-7d5e-7c3a-a5b1-0d7e6a3f9b10"]}))),
        ("period" = (summary = "All batches of a period",
                     value = json!({"from": "2026-01-01T00:00:00Z", "to": "2026-07-01T00:00:00Z"})))
    )),
    responses(
        (status = 201, description = "The new version of the undamaged reference", body = Declared),
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
    let request = body.request()?;
    let choice = request.choice.clone();
    let declared = shared.monitor.replay().declare_reference(&id, request).await;
    let DeclaredReference { record, left_out } = declared.map_err(|error| refusal(error, &choice))?;
    let answer = Declared { reference: Undamaged::new(&id, &record), left_out };
    Ok((StatusCode::CREATED, Json(answer)).into_response())
}

/// The answer to a declaration that failed: every batch that is responsible has its entry in `errors`.
fn refusal(error: DeclareError, choice: &ReferenceChoice) -> ApiError {
    let pointer = |batch: &str| match choice {
        ReferenceChoice::Batches(ids) => ids
            .iter()
            .position(|id| id == batch)
            .map_or_else(|| "/batches".to_owned(), |index| format!("/batches/{index}")),
        ReferenceChoice::Period { .. } => "/from".to_owned(),
    };
    let problem = |LeftOutBatch { batch, reason }: &LeftOutBatch| {
        Problem::new(pointer(batch), format!("batch {batch}: {reason}"))
    };
    let errors = error.left_out().iter().map(problem).collect();
    match error {
        DeclareError::Monitor(error) => error.into(),
        unusable => ApiError::invalid("unusable_baseline", unusable.to_string(), errors),
    }
}

/// `POST /v1/structures/{id}/reference`: the same as `PUT`.
///
/// # Errors
/// As [`put`].
#[utoipa::path(
    post, path = "/v1/structures/{id}/reference", tag = "results", operation_id = "declare_reference",
    summary = "Declare the undamaged reference", description = "The same as `PUT`.",
    params(StructurePath),
    request_body(content = ReferenceInput, examples(
        ("batches" = (summary = "Batches by id", value = json!({"batches": ["0199a0c6-7d5e-7c3a-a5b1-0d7e6a3f9b10"]}))),
        ("period" = (summary = "All batches of a period",
                     value = json!({"from": "2026-01-01T00:00:00Z", "to": "2026-07-01T00:00:00Z"})))
    )),
    responses(
        (status = 201, description = "The new version of the undamaged reference", body = Declared),
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
    request_body(content = ReferenceInput, examples(
        ("batches" = (summary = "Batches by id", value = json!({"batches": ["0199a0c6-7d5e-7c3a-a5b1-0d7e6a3f9b10"]}))),
        ("period" = (summary = "All batches of a period",
                     value = json!({"from": "2026-01-01T00:00:00Z", "to": "2026-07-01T00:00:00Z"})))
    )),
    responses(
        (status = 201, description = "The new version of the undamaged reference", body = Declared, headers(
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
