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
use crate::monitor::stored::ReferenceVersion;
use crate::monitor::{
    DeclareError, DeclaredReference, ExtensionRequest, LeftOutBatch, ReferenceChoice, ReferenceRequest,
};
use crate::quantity::{StructureId, Timestamp};

/// Threshold probability p unless the client gives another (paper §4).
const DEFAULT_THRESHOLD_PROBABILITY: f64 = 0.05;

/// Most characters of a reason.
const MOST_CHARACTERS: usize = 500;

/// Marks an answer of a deprecated route with the date of its deprecation (RFC 9745): 2026-11-23.
const DEPRECATION: (HeaderName, &str) = (HeaderName::from_static("deprecation"), "@1795392000");

/// What was measured while the structure was undamaged: either `batches`, or the period from `from` to `to`.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct ReferenceInput {
    /// Ids of the batches; together they must hold at least ten independent measurements.
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
    /// Why the reference is made, such as a repair; it is kept with the version.
    #[schema(max_length = 500)]
    reason: Option<String>,
}

/// What was measured since, while the structure was undamaged: either `batches`, or the period from `from` to `to`.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
struct ReferenceExtensionInput {
    /// Ids of the batches that are added.
    #[schema(min_items = 1)]
    batches: Option<Vec<String>>,
    /// Begin of a period: all batches that were measured completely from `from` on and before `to`.
    #[schema(value_type = Option<String>, format = DateTime)]
    from: Option<String>,
    /// End of the period, which is not part of it.
    #[schema(value_type = Option<String>, format = DateTime)]
    to: Option<String>,
    /// Whether batches that cannot be trusted, or were measured during a damage alarm, are left out and listed in the answer (the
    /// default for a period), or the extension is refused and each of them is named (the default for `batches`).
    leave_out_doubtful: Option<bool>,
    /// Why the reference is extended; it is kept with the version.
    #[schema(max_length = 500)]
    reason: Option<String>,
    /// Whether batches are accepted although an alarm was open, or the charts of the first version show a lasting change, because an
    /// inspection found no damage. A `reason` is required.
    despite_alarms: Option<bool>,
}

impl ReferenceExtensionInput {
    /// The extension that the body asks for.
    fn request(self) -> Result<ExtensionRequest, ApiError> {
        let choice = choice(self.batches, self.from.as_deref(), self.to.as_deref())?;
        let despite_alarms = self.despite_alarms.unwrap_or(false);
        if despite_alarms && self.reason.is_none() {
            return Err(ApiError::invalid_field(
                "/reason",
                "say what the inspection found, which is kept with the version",
            ));
        }
        Ok(ExtensionRequest {
            leave_out_doubtful: self.leave_out_doubtful.unwrap_or(matches!(choice, ReferenceChoice::Period { .. })),
            choice,
            reason: checked_reason(self.reason)?,
            despite_alarms,
        })
    }
}

/// A reason that is short enough to be kept, and has no control characters but line breaks and tabs.
fn checked_reason(reason: Option<String>) -> Result<Option<String>, ApiError> {
    let control = |c: char| c.is_control() && !['\n', '\t'].contains(&c);
    match reason {
        Some(text) if text.trim().is_empty() || text.chars().count() > MOST_CHARACTERS || text.chars().any(control) => {
            let message = format!(
                "the reason must have 1 to {MOST_CHARACTERS} characters, of which only line breaks and tabs may be control characters"
            );
            Err(ApiError::invalid_field("/reason", message))
        }
        reason => Ok(reason),
    }
}

impl ReferenceInput {
    /// The declaration that the body asks for.
    fn request(self) -> Result<ReferenceRequest, ApiError> {
        let choice = choice(self.batches, self.from.as_deref(), self.to.as_deref())?;
        Ok(ReferenceRequest {
            leave_out_doubtful: self.leave_out_doubtful.unwrap_or(matches!(choice, ReferenceChoice::Period { .. })),
            choice,
            threshold_probability: self.threshold_probability.unwrap_or(DEFAULT_THRESHOLD_PROBABILITY),
            reason: checked_reason(self.reason)?,
        })
    }
}

/// The batches that a body names, or its period.
fn choice(batches: Option<Vec<String>>, from: Option<&str>, to: Option<&str>) -> Result<ReferenceChoice, ApiError> {
    let time =
        |pointer: &str, text: &str| Timestamp::parse(text).map_err(|e| ApiError::invalid_field(pointer, e.to_string()));
    let refused = |pointer: &str, message: &str| Err(ApiError::invalid_field(pointer, message));
    match (batches, from, to) {
        (Some(batches), None, None) if !batches.is_empty() => Ok(ReferenceChoice::Batches(batches)),
        (None, Some(from), Some(to)) => {
            let (from, to) = (time("/from", from)?, time("/to", to)?);
            if to <= from {
                return refused("/to", "the end of the period must be after its begin");
            }
            Ok(ReferenceChoice::Period { from, to })
        }
        (Some(_), None, None) => refused("/batches", "name at least one batch"),
        (Some(_), ..) => refused("/batches", "give either the batches or a period from and to, not both"),
        (None, Some(_), None) => refused("/to", "the end of the period is missing: RFC 3339 with an offset"),
        (None, None, Some(_)) => refused("/from", "the begin of the period is missing: RFC 3339 with an offset"),
        (None, None, None) => {
            let message = "name the batches, or the period in which the structure was undamaged, such as \
                           {\"from\": \"2026-01-01T00:00:00Z\", \"to\": \"2026-07-01T00:00:00Z\"}";
            refused("/batches", message)
        }
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
                   then compared with it. Other batches keep the reference that they were compared with, also after an import and when \
                   another trained model assesses all batches again. Batches that cannot be used as a reference are refused with the code \
                   `unusable_baseline`, which has kept the earlier name, and `errors` names each of them; with \
                   `leave_out_doubtful` they are left out and listed in the answer. The same code refuses measurements that are worth \
                   fewer than ten independent ones. From a period they are left out, and also \
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
    answer(&id, shared.monitor.replay().declare_reference(&id, request).await, &choice)
}

/// `POST /v1/structures/{id}/reference/extend`: adds batches to the newest undamaged reference; 201 with its new version.
///
/// # Errors
/// 400, 415, 422 for the body, 404 for structure or batch, 409 without a trained model, 503 when the queue is full.
#[utoipa::path(
    post, path = "/v1/structures/{id}/reference/extend", tag = "results", operation_id = "extend_reference",
    summary = "Extend the undamaged reference",
    description = "Computes a new version of the undamaged reference from the batches of the newest one and further ones that are \
                   accepted as healthy, so that it has seen more of the year. Earlier versions are kept. Batches that were measured \
                   during a damage alarm are not accepted, and the extension is refused if the charts of the first version show a \
                   lasting change in what was added since: otherwise a slow loss would become part of what is healthy.",
    params(StructurePath),
    request_body(content = ReferenceExtensionInput, examples(
        ("period" = (summary = "All batches of a period",
                     value = json!({"from": "2026-07-01T00:00:00Z", "to": "2026-10-01T00:00:00Z", "reason": "first summer"})))
    )),
    responses(
        (status = 201, description = "The new version of the undamaged reference", body = Declared),
        Unknown, BodyRefused, Conflict, Busy
    )
)]
pub async fn extend(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    shared.monitor.structure(&id)?;
    let body: ReferenceExtensionInput = json_body(&headers, body, shared.limits).await?;
    let request = body.request()?;
    let choice = request.choice.clone();
    answer(&id, shared.monitor.replay().extend_reference(&id, request).await, &choice)
}

/// A version of the undamaged reference, in short.
#[derive(Debug, Serialize, ToSchema)]
struct ReferenceVersionBody {
    version: u32,
    created_at: Timestamp,
    /// The version that it extends; `null` if it was declared by itself.
    #[schema(required)]
    extends: Option<u32>,
    /// Why it was made.
    #[schema(required)]
    reason: Option<String>,
    batch_count: usize,
    measurement_count: usize,
    measured_from: Timestamp,
    measured_to: Timestamp,
}

/// All versions of an undamaged reference.
#[derive(Debug, Serialize, ToSchema)]
struct ReferenceVersions {
    /// The newest first.
    items: Vec<ReferenceVersionBody>,
}

/// `GET /v1/structures/{id}/references`: all versions of the undamaged reference.
///
/// # Errors
/// 404 for the structure.
#[utoipa::path(
    get, path = "/v1/structures/{id}/references", tag = "results", operation_id = "list_references",
    summary = "List the versions of the undamaged reference",
    description = "Batches are compared with the version that was the newest when they were assessed: history and charts of each \
                   version are kept as they were.",
    params(StructurePath),
    responses((status = 200, description = "All versions, the newest first", body = ReferenceVersions), Unknown)
)]
pub async fn list(State(shared): State<Shared>, ApiPath(id): ApiPath<String>) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    shared.monitor.structure(&id)?;
    let versions = shared.monitor.records().reference_versions(&id).await?;
    let body = |v: ReferenceVersion| ReferenceVersionBody {
        version: v.version,
        created_at: v.created_at,
        extends: v.origin.extends,
        reason: v.origin.reason,
        batch_count: v.batches,
        measurement_count: v.measurements,
        measured_from: v.measured_from,
        measured_to: v.measured_to,
    };
    Ok(Json(ReferenceVersions { items: versions.into_iter().map(body).collect() }).into_response())
}

/// The answer to a declaration or an extension.
fn answer(
    id: &StructureId,
    made: Result<DeclaredReference, DeclareError>,
    choice: &ReferenceChoice,
) -> Result<Response, ApiError> {
    let DeclaredReference { record, left_out } = made.map_err(|error| refusal(error, choice))?;
    let answer = Declared { reference: Undamaged::new(id, &record), left_out };
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
        loss @ DeclareError::Loss { .. } => ApiError::invalid("lasting_change", loss.to_string(), errors),
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
