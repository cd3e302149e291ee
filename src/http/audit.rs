//! `GET /v1/audit`: who changed what.

use axum::extract::State;
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

use super::error::ApiError;
use super::openapi::Invalid;
use super::request::{page_cursor, page_limit, ApiQuery, Window};
use super::shared::Shared;
use crate::monitor::stored::{AuditEntry, AuditQuery};
use crate::quantity::Timestamp;

/// Query of the audit.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct AuditPageQuery {
    /// Entries at this time or later.
    #[param(value_type = Option<String>, format = DateTime)]
    from: Option<String>,
    /// Entries before this time.
    #[param(value_type = Option<String>, format = DateTime)]
    to: Option<String>,
    /// Maximum number of items. Default 100.
    #[param(value_type = Option<u32>, minimum = 1, maximum = 1000)]
    limit: Option<String>,
    /// `next` of the previous page.
    #[param(pattern = "^[0-9]{1,18}$")]
    cursor: Option<String>,
}

/// Audit entries, newest first.
#[derive(Debug, Serialize, ToSchema)]
struct AuditPage {
    items: Vec<AuditItem>,
    /// Cursor of the next page; `null` on the last.
    #[schema(required)]
    next: Option<String>,
}

/// A change, or an attempted change.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = AuditEntry)]
struct AuditItem {
    entry: i64,
    at: Timestamp,
    /// Id of the token, or `local`.
    actor: String,
    #[schema(required)]
    actor_name: Option<String>,
    #[schema(required)]
    peer: Option<String>,
    #[schema(required)]
    request_id: Option<String>,
    action: String,
    #[schema(required)]
    structure: Option<String>,
    #[schema(required)]
    subject: Option<String>,
    /// `done`, `refused`, `failed`, or `unknown` if the program ended before the outcome was known.
    outcome: &'static str,
    #[schema(required)]
    status: Option<u16>,
}

impl From<AuditEntry> for AuditItem {
    fn from(stored: AuditEntry) -> Self {
        let AuditEntry { number, entry, status } = stored;
        Self {
            entry: number,
            at: entry.at,
            actor: entry.actor,
            actor_name: entry.actor_name,
            peer: entry.peer,
            request_id: entry.request_id,
            action: entry.action,
            structure: entry.structure,
            subject: entry.subject,
            outcome: match status {
                None => "unknown",
                Some(..400) => "done",
                Some(400..500) => "refused",
                Some(500..) => "failed",
            },
            status,
        }
    }
}

/// `GET /v1/audit`: who changed what, newest first.
///
/// # Errors
/// 422 for the query.
#[utoipa::path(
    get, path = "/v1/audit", tag = "access", operation_id = "list_audit",
    summary = "Audit of changes", description = "Every change and every attempted change, newest first, in pages.",
    params(AuditPageQuery),
    responses((status = 200, description = "A page", body = AuditPage), Invalid)
)]
pub async fn list(
    State(shared): State<Shared>,
    ApiQuery(query): ApiQuery<AuditPageQuery>,
) -> Result<Response, ApiError> {
    let Window { from, to } = Window::of(query.from.as_deref(), query.to.as_deref())?;
    let before = page_cursor(query.cursor.as_deref())?;
    let asked = AuditQuery { from, to, before, limit: page_limit(query.limit.as_deref())? };
    let found = shared.monitor.audit().list(&asked).await?;
    let next = (found.len() == asked.limit).then(|| found.last().map(|e| e.number.to_string())).flatten();
    Ok(Json(AuditPage { items: found.into_iter().map(AuditItem::from).collect(), next }).into_response())
}
