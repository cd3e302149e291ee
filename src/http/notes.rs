//! `/v1/structures/{id}/notes`: notes on the time line of a structure.

use axum::body::Body;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::error::ApiError;
use super::openapi::{BodyRefused, Conflict, Invalid, NotePath, StructurePath, Unknown};
use super::people::{author, check_comment};
use super::request::{json_body, structure_id, ApiPath};
use super::shared::Shared;
use crate::access::Grant;
use crate::clock;
use crate::monitor::stored::{Note, MOST_NOTES};
use crate::quantity::{shown, StructureId, Timestamp};

/// A note about a moment (`at`) or a period (`from`, `to`).
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = NoteInput)]
struct NoteBody {
    /// The moment; either this or `from` and `to`.
    #[schema(format = DateTime)]
    at: Option<String>,
    /// Beginning of the period.
    #[schema(format = DateTime)]
    from: Option<String>,
    /// End of the period, later than `from`.
    #[schema(format = DateTime)]
    to: Option<String>,
    /// The note; it may have line breaks.
    #[schema(min_length = 1, max_length = 2000)]
    text: String,
    /// Who writes it; only without tokens, otherwise the name of the token is recorded.
    #[schema(min_length = 1, max_length = 500, pattern = "^[^\\x00-\\x1f\\x7f-\\x9f]+$")]
    author: Option<String>,
}

/// A note on the time line.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Note)]
pub struct NoteItem {
    note: String,
    /// The moment, or the beginning of the period.
    from: Timestamp,
    /// End of the period; `null` for a moment.
    #[schema(required)]
    to: Option<Timestamp>,
    text: String,
    author: String,
    created_at: Timestamp,
}

/// Notes, by their beginning, the newest first.
#[derive(Debug, Serialize, ToSchema)]
struct NoteList {
    structure: StructureId,
    items: Vec<NoteItem>,
}

impl From<Note> for NoteItem {
    fn from(n: Note) -> Self {
        Self { note: n.id, from: n.from, to: n.to, text: n.text, author: n.author, created_at: n.created_at }
    }
}

/// `GET /v1/structures/{id}/notes`: notes, the newest first.
///
/// # Errors
/// 404 for the structure.
#[utoipa::path(
    get, path = "/v1/structures/{id}/notes", tag = "alarms", operation_id = "list_notes",
    summary = "Notes", description = "Notes on the time line, by their beginning, the newest first.",
    params(StructurePath),
    responses((status = 200, description = "The notes", body = NoteList), Unknown, Invalid)
)]
pub async fn list(State(shared): State<Shared>, ApiPath(id): ApiPath<String>) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    shared.monitor.structure(&id)?;
    let items = shared.monitor.alarms().notes(&id).await?.into_iter().map(NoteItem::from).collect();
    Ok(Json(NoteList { structure: id, items }).into_response())
}

/// `POST /v1/structures/{id}/notes`: adds a note.
///
/// # Errors
/// 400, 415, 422 for the body, 404 for the structure, 409 if there are too many notes.
#[utoipa::path(
    post, path = "/v1/structures/{id}/notes", tag = "alarms", operation_id = "add_note",
    summary = "Add a note",
    description = "Adds a note about a moment (`at`) or a period (`from` and `to`) to the time line. It is shown on the charts and in the \
                   condition report and changes nothing else.",
    params(StructurePath),
    request_body(content = NoteBody, example = json!(
        {"at": "2026-03-01T12:00:00Z", "text": "new road surface", "author": "A. Engineer"})),
    responses((status = 201, description = "The note", body = NoteItem), Unknown, Conflict, BodyRefused)
)]
pub async fn create(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    grant: Grant,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    shared.monitor.structure(&id)?;
    let body: NoteBody = json_body(&headers, body, shared.limits).await?;
    let (from, to) = period(&body)?;
    check_comment("/text", &body.text)?;
    let author = author(&grant, body.author.as_deref())?;
    let note =
        Note { id: uuid::Uuid::now_v7().to_string(), from, to, text: body.text, author, created_at: clock::now() };
    if !shared.monitor.alarms().add_note(&id, note.clone()).await? {
        let detail = format!("{id} has {MOST_NOTES} notes already: delete some first");
        return Err(ApiError::new(StatusCode::CONFLICT, "too_many_notes", detail));
    }
    Ok((StatusCode::CREATED, Json(NoteItem::from(note))).into_response())
}

/// `DELETE /v1/structures/{id}/notes/{note}`: deletes a note.
///
/// # Errors
/// 404 for structure or note.
#[utoipa::path(
    delete, path = "/v1/structures/{id}/notes/{note}", tag = "alarms", operation_id = "delete_note",
    summary = "Delete a note", description = "Deletes a note.",
    params(NotePath),
    responses((status = 204, description = "It is deleted"), Unknown, Invalid)
)]
pub async fn remove(
    State(shared): State<Shared>,
    ApiPath((id, note)): ApiPath<(String, String)>,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    shared.monitor.structure(&id)?;
    if shared.monitor.alarms().delete_note(&id, &note).await? {
        return Ok(StatusCode::NO_CONTENT.into_response());
    }
    let detail = format!("structure {id} has no note {}", shown(&note));
    Err(ApiError::new(StatusCode::NOT_FOUND, "unknown_note", detail))
}

/// The moment or the period of a note.
fn period(body: &NoteBody) -> Result<(Timestamp, Option<Timestamp>), ApiError> {
    let time = |pointer: &str, text: &str| {
        Timestamp::parse(text).map_err(|e| ApiError::invalid_field(pointer.to_owned(), e.to_string()))
    };
    match (body.at.as_deref(), body.from.as_deref(), body.to.as_deref()) {
        (Some(at), None, None) => Ok((time("/at", at)?, None)),
        (None, Some(from), Some(to)) => {
            let (from, to) = (time("/from", from)?, time("/to", to)?);
            if to <= from {
                return Err(ApiError::invalid_field("/to".to_owned(), format!("{to} is not after {from}")));
            }
            Ok((from, Some(to)))
        }
        _ => {
            let message = "give either `at`, or `from` and `to`".to_owned();
            Err(ApiError::invalid_field("/at".to_owned(), message))
        }
    }
}
