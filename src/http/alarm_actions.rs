//! What people do with an alarm: comments, an assignee, closing with a reason, reopening.

use axum::body::Body;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::Deserialize;
use utoipa::ToSchema;

use super::alarm_item::AlarmItem;
use super::error::ApiError;
use super::openapi::{AlarmPath, BodyRefused, Conflict, Unknown};
use super::people::{author, check_comment, check_text};
use super::request::{json_body, structure_id, ApiPath};
use super::shared::Shared;
use crate::access::Grant;
use crate::clock;
use crate::monitor::stored::{ActionKind, ActionOutcome, ClosingReason, NewAction, MOST_ACTIONS};
use crate::quantity::{shown, StructureId};

/// A comment on an alarm.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = AlarmCommentInput)]
struct CommentBody {
    /// The comment; it may have line breaks.
    #[schema(min_length = 1, max_length = 2000)]
    text: String,
    /// Who writes it; only without tokens, otherwise the name of the token is recorded.
    #[schema(min_length = 1, max_length = 500, pattern = "^[^\\x00-\\x1f\\x7f-\\x9f]+$")]
    author: Option<String>,
}

/// Who takes care of an alarm.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = AlarmAssigneeInput)]
struct AssigneeBody {
    /// The name, or `null` for nobody.
    #[schema(required, min_length = 1, max_length = 500, pattern = "^[^\\x00-\\x1f\\x7f-\\x9f]+$")]
    #[serde(deserialize_with = "Option::deserialize")]
    assignee: Option<String>,
    /// Who assigns it; only without tokens.
    #[schema(min_length = 1, max_length = 500, pattern = "^[^\\x00-\\x1f\\x7f-\\x9f]+$")]
    author: Option<String>,
    /// The number of the last action that you have seen: if assignee or closing were changed since, the answer is 409.
    #[schema(minimum = 0)]
    seen: Option<i64>,
}

/// Closing of an alarm.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = AlarmClosingInput)]
struct ClosingBody {
    reason: ClosingReason,
    /// Explanation; needed for the reason `other`.
    #[schema(min_length = 1, max_length = 2000)]
    text: Option<String>,
    /// Who closes it; only without tokens.
    #[schema(min_length = 1, max_length = 500, pattern = "^[^\\x00-\\x1f\\x7f-\\x9f]+$")]
    author: Option<String>,
    /// As for the assignee.
    #[schema(minimum = 0)]
    seen: Option<i64>,
}

/// Reopening of a closed alarm.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = AlarmReopeningInput)]
struct ReopeningBody {
    /// Explanation.
    #[schema(min_length = 1, max_length = 2000)]
    text: Option<String>,
    /// Who reopens it; only without tokens.
    #[schema(min_length = 1, max_length = 500, pattern = "^[^\\x00-\\x1f\\x7f-\\x9f]+$")]
    author: Option<String>,
    /// As for the assignee.
    #[schema(minimum = 0)]
    seen: Option<i64>,
}

/// `POST /v1/structures/{id}/alarms/{n}/comments`: adds a comment.
///
/// # Errors
/// 400, 415, 422 for the body, 404 for structure or alarm, 409 for too many actions.
#[utoipa::path(
    post, path = "/v1/structures/{id}/alarms/{alarm}/comments", tag = "alarms", operation_id = "comment_alarm",
    summary = "Comment on an alarm", description = "Adds a comment. Comments are kept; they also show on the alarm that continues this one.",
    params(AlarmPath),
    request_body(content = CommentBody, example = json!({"text": "crack found at the north bearing", "author": "A. Engineer"})),
    responses((status = 201, description = "The alarm", body = AlarmItem), Unknown, Conflict, BodyRefused)
)]
pub async fn comment(
    State(shared): State<Shared>,
    ApiPath(path): ApiPath<(String, String)>,
    grant: Grant,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    let id = known(&shared, &path)?;
    let body: CommentBody = json_body(&headers, body, shared.limits).await?;
    check_comment("/text", &body.text)?;
    let author = author(&grant, body.author.as_deref())?;
    let kind = ActionKind::Comment { text: body.text };
    act(&shared, &id, &path.1, NewAction { kind, at: clock::now(), author, seen: None }).await
}

/// `PUT /v1/structures/{id}/alarms/{n}/assignee`: names who takes care of the alarm.
///
/// # Errors
/// 400, 415, 422 for the body, 404 for structure or alarm, 409 if somebody changed the alarm in the meantime.
#[utoipa::path(
    put, path = "/v1/structures/{id}/alarms/{alarm}/assignee", tag = "alarms", operation_id = "assign_alarm",
    summary = "Assign an alarm", description = "Names who takes care of the alarm, or nobody with `null`.",
    params(AlarmPath),
    request_body(content = AssigneeBody, example = json!({"assignee": "B. Inspector", "author": "A. Engineer"})),
    responses((status = 201, description = "The alarm", body = AlarmItem), Unknown, Conflict, BodyRefused)
)]
pub async fn assign(
    State(shared): State<Shared>,
    ApiPath(path): ApiPath<(String, String)>,
    grant: Grant,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    let id = known(&shared, &path)?;
    let body: AssigneeBody = json_body(&headers, body, shared.limits).await?;
    body.assignee.as_deref().map(|name| check_text("/assignee", name)).transpose()?;
    let author = author(&grant, body.author.as_deref())?;
    let kind = ActionKind::Assignment { assignee: body.assignee };
    act(&shared, &id, &path.1, NewAction { kind, at: clock::now(), author, seen: body.seen }).await
}

/// `POST /v1/structures/{id}/alarms/{n}/closing`: closes the alarm with a reason.
///
/// # Errors
/// 400, 415, 422 for the body, 404 for structure or alarm, 409 if it is closed or was changed in the meantime.
#[utoipa::path(
    post, path = "/v1/structures/{id}/alarms/{alarm}/closing", tag = "alarms", operation_id = "close_alarm",
    summary = "Close an alarm",
    description = "Closes the alarm with a reason. The measurements decide about its `state` as before. An alarm that nobody has acknowledged \
                   is acknowledged by this.",
    params(AlarmPath),
    request_body(content = ClosingBody, example = json!({"reason": "repaired", "text": "bearing replaced on Monday", "author": "A. Engineer"})),
    responses((status = 201, description = "The alarm", body = AlarmItem), Unknown, Conflict, BodyRefused)
)]
pub async fn close(
    State(shared): State<Shared>,
    ApiPath(path): ApiPath<(String, String)>,
    grant: Grant,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    let id = known(&shared, &path)?;
    let body: ClosingBody = json_body(&headers, body, shared.limits).await?;
    body.text.as_deref().map(|text| check_comment("/text", text)).transpose()?;
    if body.reason == ClosingReason::Other && body.text.is_none() {
        let message = "is missing: the reason `other` needs an explanation".to_owned();
        return Err(ApiError::invalid_field("/text".to_owned(), message));
    }
    let author = author(&grant, body.author.as_deref())?;
    let kind = ActionKind::Closing { reason: body.reason, text: body.text };
    act(&shared, &id, &path.1, NewAction { kind, at: clock::now(), author, seen: body.seen }).await
}

/// `POST /v1/structures/{id}/alarms/{n}/reopening`: opens a closed alarm again.
///
/// # Errors
/// 400, 415, 422 for the body, 404 for structure or alarm, 409 if it is not closed or was changed in the meantime.
#[utoipa::path(
    post, path = "/v1/structures/{id}/alarms/{alarm}/reopening", tag = "alarms", operation_id = "reopen_alarm",
    summary = "Reopen an alarm", description = "Opens an alarm again that a person has closed.",
    params(AlarmPath),
    request_body(content = ReopeningBody, example = json!({"text": "the crack has grown", "author": "A. Engineer"})),
    responses((status = 201, description = "The alarm", body = AlarmItem), Unknown, Conflict, BodyRefused)
)]
pub async fn reopen(
    State(shared): State<Shared>,
    ApiPath(path): ApiPath<(String, String)>,
    grant: Grant,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    let id = known(&shared, &path)?;
    let body: ReopeningBody = json_body(&headers, body, shared.limits).await?;
    body.text.as_deref().map(|text| check_comment("/text", text)).transpose()?;
    let author = author(&grant, body.author.as_deref())?;
    let kind = ActionKind::Reopening { text: body.text };
    act(&shared, &id, &path.1, NewAction { kind, at: clock::now(), author, seen: body.seen }).await
}

/// The structure of a path, if it exists.
fn known(shared: &Shared, path: &(String, String)) -> Result<StructureId, ApiError> {
    let id = structure_id(&path.0)?;
    shared.monitor.structure(&id)?;
    Ok(id)
}

/// Stores an action and answers with the alarm.
async fn act(shared: &Shared, id: &StructureId, number: &str, action: NewAction) -> Result<Response, ApiError> {
    let alarms = shared.monitor.alarms();
    let unknown = || {
        let detail = format!("structure {id} has no alarm {}", shown(number));
        ApiError::new(StatusCode::NOT_FOUND, "unknown_alarm", detail)
    };
    let parsed: i64 = number.parse().map_err(|_| unknown())?;
    let refused = match alarms.act(id, parsed, action).await? {
        ActionOutcome::Stored => None,
        ActionOutcome::UnknownAlarm => Some(unknown()),
        ActionOutcome::AlreadyClosed => {
            let detail = format!("alarm {parsed} of {id} is closed already: reopen it first");
            Some(ApiError::new(StatusCode::CONFLICT, "alarm_closed", detail))
        }
        ActionOutcome::NotClosed => {
            let detail = format!("alarm {parsed} of {id} is not closed");
            Some(ApiError::new(StatusCode::CONFLICT, "alarm_not_closed", detail))
        }
        ActionOutcome::Changed => {
            let detail = format!(
                "alarm {parsed} of {id} was assigned, closed or reopened by somebody in the meantime: read it again"
            );
            Some(ApiError::new(StatusCode::CONFLICT, "alarm_changed", detail))
        }
        ActionOutcome::TooMany => {
            let detail = format!("alarm {parsed} of {id} has {MOST_ACTIONS} comments and other actions already");
            Some(ApiError::new(StatusCode::CONFLICT, "too_many_actions", detail))
        }
    };
    if let Some(refused) = refused {
        return Err(refused);
    }
    let (episode, handling) = alarms.one(id, parsed).await?.ok_or_else(unknown)?;
    Ok((StatusCode::CREATED, Json(AlarmItem::new(episode, handling, alarms.limits()))).into_response())
}
