//! `/v1/quarantine`: messages from the broker that can never become a batch, and why.

use axum::extract::State;
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

use super::error::ApiError;
use super::openapi::{Invalid, MessagePath, Unknown};
use super::request::{page_cursor, page_limit, ApiPath, ApiQuery};
use super::Shared;
use crate::quantity::{shown, Timestamp};
use crate::store::QuarantinedMessage;

/// Characters of a payload in a list; the item has all that was kept.
const PREVIEW: usize = 500;

/// Query of the list.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct QuarantineQuery {
    /// Most items; 100 without.
    #[param(value_type = Option<u32>, minimum = 1, maximum = 1000)]
    limit: Option<String>,
    /// `next` of the page before.
    #[param(pattern = "^[0-9]{1,18}$")]
    cursor: Option<String>,
}

/// A message that can never become a batch.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = QuarantinedMessage)]
struct QuarantineItem {
    message: i64,
    topic: String,
    reason: String,
    tries: u64,
    first_at: Timestamp,
    last_at: Timestamp,
    payload_sha256: String,
    payload_bytes: u64,
    /// As text; what is no UTF-8 is replaced.
    payload: String,
}

/// Messages, newest first.
#[derive(Debug, Serialize, ToSchema)]
struct QuarantinePage {
    items: Vec<QuarantineItem>,
    #[schema(required)]
    next: Option<String>,
}

fn item(m: QuarantinedMessage) -> QuarantineItem {
    QuarantineItem {
        message: m.number,
        topic: m.topic,
        reason: m.reason,
        tries: m.tries,
        first_at: m.first_at,
        last_at: m.last_at,
        payload_sha256: m.digest.to_string(),
        payload_bytes: m.payload_bytes,
        payload: String::from_utf8_lossy(&m.payload).chars().take(PREVIEW).collect(),
    }
}

/// `GET /v1/quarantine`: newest first.
///
/// # Errors
/// 422 for the query.
#[utoipa::path(
    get, path = "/v1/quarantine", tag = "operations", operation_id = "list_quarantine",
    summary = "Messages that became no batch",
    description = "From the broker, with the reason, newest first, a page at a time; of each payload the first 500 characters.",
    params(QuarantineQuery),
    responses((status = 200, description = "A page", body = QuarantinePage), Invalid)
)]
pub async fn list(
    State(shared): State<Shared>,
    ApiQuery(query): ApiQuery<QuarantineQuery>,
) -> Result<Response, ApiError> {
    let (limit, before) = (page_limit(query.limit.as_deref())?, page_cursor(query.cursor.as_deref())?);
    let found = shared.monitor.store().quarantine().quarantined(before, limit).await?;
    let next = (found.len() == limit).then(|| found.last().map(|m| m.number.to_string())).flatten();
    Ok(Json(QuarantinePage { items: found.into_iter().map(item).collect(), next }).into_response())
}

/// `GET /v1/quarantine/{message}`: with all of the payload that was kept, at most 64 KiB.
///
/// # Errors
/// 404.
#[utoipa::path(
    get, path = "/v1/quarantine/{message}", tag = "operations", operation_id = "read_quarantined",
    summary = "A message that became no batch", description = "With all of the payload that was kept, at most 64 KiB.",
    params(MessagePath),
    responses((status = 200, description = "The message", body = QuarantineItem), Unknown)
)]
pub async fn read(State(shared): State<Shared>, ApiPath(message): ApiPath<String>) -> Result<Response, ApiError> {
    let number: i64 = message.parse().map_err(|_| unknown(&message))?;
    // The page of one that begins behind the next number.
    let found = shared.monitor.store().quarantine().quarantined(number.checked_add(1), 1).await?;
    let found = found.into_iter().find(|m| m.number == number).ok_or_else(|| unknown(&message))?;
    let payload = String::from_utf8_lossy(&found.payload).into_owned();
    Ok(Json(QuarantineItem { payload, ..item(found) }).into_response())
}

/// `DELETE /v1/quarantine/{message}`: 204.
///
/// # Errors
/// 404.
#[utoipa::path(
    delete, path = "/v1/quarantine/{message}", tag = "operations", operation_id = "delete_quarantined",
    summary = "Forget a message", description = "It is deleted from the quarantine.",
    params(MessagePath),
    responses((status = 204, description = "It is gone"), Unknown)
)]
pub async fn remove(State(shared): State<Shared>, ApiPath(message): ApiPath<String>) -> Result<Response, ApiError> {
    let number: i64 = message.parse().map_err(|_| unknown(&message))?;
    if shared.monitor.store().quarantine().delete_quarantined(number).await? {
        Ok(StatusCode::NO_CONTENT.into_response())
    } else {
        Err(unknown(&message))
    }
}

fn unknown(message: &str) -> ApiError {
    let detail = format!("there is no quarantined message {}", shown(message));
    ApiError::new(StatusCode::NOT_FOUND, "unknown_message", detail)
}
