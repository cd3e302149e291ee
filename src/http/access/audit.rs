//! Changes are written down before they are tried, and their outcome after: no change goes unrecorded, whatever happens
//! to the client, the connection or the process in between. And `GET /v1/audit`.

use axum::extract::{Request, State};
use axum::http::header;
use axum::middleware::Next;
use axum::response::{IntoResponse as _, Response};
use axum::Json;
use serde::{Deserialize, Serialize};
use tracing::{error, Instrument as _};
use utoipa::{IntoParams, ToSchema};

use super::client::Client;
use super::AccessControl;
use crate::access::Grant;
use crate::http::error::ApiError;
use crate::http::openapi::Invalid;
use crate::http::request::{current_id, page_cursor, page_limit, with_current_id, ApiQuery, Window};
use crate::http::Shared;
use crate::quantity::Timestamp;
use crate::store::{AuditEntry, AuditQuery, NewAuditEntry};

/// Longest path kept.
const LONGEST_SUBJECT: usize = 300;

/// The entry of a request that changes something.
pub(super) fn entry(
    grant: &Grant,
    client: &Client,
    request: &Request,
    pattern: &str,
    structure: Option<String>,
) -> NewAuditEntry {
    let path = request.uri().path();
    NewAuditEntry {
        at: Timestamp::now(),
        actor: grant.actor().as_str().to_owned(),
        actor_name: grant.actor().name().map(str::to_owned),
        peer: client.address.map(|address| address.to_string()),
        request_id: current_id(),
        action: format!("{} {pattern}", request.method()),
        structure: structure.map(|id| id.chars().take(LONGEST_SUBJECT).collect()),
        subject: Some(path.chars().take(LONGEST_SUBJECT).collect()),
    }
}

/// Writes the entry, answers the request, and adds the status, in a task that goes on when the client does not.
pub(super) async fn run(access: &AccessControl, entry: NewAuditEntry, request: Request, next: Next) -> Response {
    let (store, id) = (access.0.store.clone(), current_id().unwrap_or_default());
    let task = async move {
        let number = match store.audit().begin_audit(entry).await {
            Ok(number) => number,
            // What cannot be written down is not done.
            Err(error) => return Ok(ApiError::from(error).into_response()),
        };
        // A task of its own once more, so that a panic of the handler has its entry ended too.
        let answering = with_current_id(current_id().unwrap_or_default(), next.run(request)).in_current_span();
        let answered = tokio::spawn(answering).await;
        let status = answered.as_ref().map_or(500, |response| response.status().as_u16());
        let made = answered.as_ref().ok().and_then(|response| response.headers().get(header::LOCATION));
        let made = made.and_then(|value| value.to_str().ok()).map(str::to_owned);
        if let Err(cause) = store.audit().end_audit(number, status, made).await {
            // The entry itself is there, and the change is done: the client is told what came of it.
            error!(%cause, number, status, "The outcome of audit entry {number} could not be written: {cause}");
        }
        answered
    };
    match tokio::spawn(with_current_id(id, task).in_current_span()).await.and_then(|answered| answered) {
        Ok(response) => response,
        Err(ended) if ended.is_panic() => std::panic::resume_unwind(ended.into_panic()),
        Err(ended) => ApiError::internal(&ended).into_response(),
    }
}

/// Query of the audit.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct AuditPageQuery {
    /// Changes at this time or later.
    #[param(value_type = Option<String>, format = DateTime)]
    from: Option<String>,
    /// Changes before this time.
    #[param(value_type = Option<String>, format = DateTime)]
    to: Option<String>,
    /// Most items; 100 without.
    #[param(value_type = Option<u32>, minimum = 1, maximum = 1000)]
    limit: Option<String>,
    /// `next` of the page before.
    #[param(pattern = "^[0-9]{1,18}$")]
    cursor: Option<String>,
}

/// Changes, newest first.
#[derive(Debug, Serialize, ToSchema)]
struct AuditPage {
    items: Vec<AuditItem>,
    /// Cursor of the next page; `null` on the last.
    #[schema(required)]
    next: Option<String>,
}

/// A change, or what came of trying it.
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
    /// `done`, `refused`, `failed`, or `unknown` when the program ended in between.
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
    summary = "Who changed what", description = "Every change and every try, newest first, a page at a time.",
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
    let found = shared.monitor.store().audit().list(&asked).await?;
    let next = (found.len() == asked.limit).then(|| found.last().map(|e| e.number.to_string())).flatten();
    Ok(Json(AuditPage { items: found.into_iter().map(AuditItem::from).collect(), next }).into_response())
}
