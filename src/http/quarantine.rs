//! `/v1/quarantine`: MQTT messages that cannot be stored as a batch, with the reason.

use axum::extract::State;
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

use super::error::ApiError;
use super::openapi::{Invalid, MessagePath, Unknown};
use super::request::{page_cursor, page_limit, ApiPath, ApiQuery};
use super::shared::Shared;
use crate::monitor::stored::QuarantinedMessage;
use crate::quantity::{shown, Timestamp};

/// Number of characters of a payload in the list.
const PREVIEW: usize = 500;

/// Query of the list.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct QuarantineQuery {
    /// Maximum number of items. Default 100.
    #[param(value_type = Option<u32>, minimum = 1, maximum = 1000)]
    limit: Option<String>,
    /// `next` of the previous page.
    #[param(pattern = "^[0-9]{1,18}$")]
    cursor: Option<String>,
}

/// An MQTT message that cannot be stored as a batch.
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
    /// The payload as text; invalid UTF-8 is replaced.
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

/// `GET /v1/quarantine`: messages, newest first.
///
/// # Errors
/// 422 for the query.
#[utoipa::path(
    get, path = "/v1/quarantine", tag = "operations", operation_id = "list_quarantine",
    summary = "Quarantined messages",
    description = "MQTT messages that cannot be stored as a batch, with the reason, newest first, in pages. Each payload is cut to its first 500 characters.",
    params(QuarantineQuery),
    responses((status = 200, description = "A page", body = QuarantinePage), Invalid)
)]
pub async fn list(
    State(shared): State<Shared>,
    ApiQuery(query): ApiQuery<QuarantineQuery>,
) -> Result<Response, ApiError> {
    let (limit, before) = (page_limit(query.limit.as_deref())?, page_cursor(query.cursor.as_deref())?);
    let found = shared.monitor.quarantine().quarantined(before, limit).await?;
    let next = (found.len() == limit).then(|| found.last().map(|m| m.number.to_string())).flatten();
    Ok(Json(QuarantinePage { items: found.into_iter().map(item).collect(), next }).into_response())
}

/// `GET /v1/quarantine/{message}`: a message with its stored payload, at most 64 KiB.
///
/// # Errors
/// 404.
#[utoipa::path(
    get, path = "/v1/quarantine/{message}", tag = "operations", operation_id = "read_quarantined",
    summary = "A quarantined message", description = "With its stored payload, at most 64 KiB.",
    params(MessagePath),
    responses((status = 200, description = "The message", body = QuarantineItem), Unknown)
)]
pub async fn read(State(shared): State<Shared>, ApiPath(message): ApiPath<String>) -> Result<Response, ApiError> {
    let number: i64 = message.parse().map_err(|_| unknown(&message))?;
    // The message is on the page of one item that begins after the next number.
    let found = shared.monitor.quarantine().quarantined(number.checked_add(1), 1).await?;
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
    summary = "Delete a quarantined message", description = "Deletes the message from the quarantine.",
    params(MessagePath),
    responses((status = 204, description = "It was deleted"), Unknown)
)]
pub async fn remove(State(shared): State<Shared>, ApiPath(message): ApiPath<String>) -> Result<Response, ApiError> {
    let number: i64 = message.parse().map_err(|_| unknown(&message))?;
    if shared.monitor.quarantine().delete_quarantined(number).await? {
        Ok(StatusCode::NO_CONTENT.into_response())
    } else {
        Err(unknown(&message))
    }
}

fn unknown(message: &str) -> ApiError {
    let detail = format!("there is no quarantined message {}", shown(message));
    ApiError::new(StatusCode::NOT_FOUND, "unknown_message", detail)
}
