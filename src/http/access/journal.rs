//! The audit entry of a request that changes something: written before the request is answered, completed with its status
//! afterwards. No change goes unrecorded, whatever happens to the client, the connection or the process in between.

use axum::extract::Request;
use axum::http::header;
use axum::middleware::Next;
use axum::response::{IntoResponse as _, Response};
use tracing::{error, Instrument as _};

use super::client::Client;
use super::control::AccessControl;
use super::route;
use crate::access::Grant;
use crate::clock;
use crate::http::error::ApiError;
use crate::http::request_id::{current_id, with_current_id};
use crate::monitor::stored::NewAuditEntry;

/// Maximum length of a stored path, characters.
const LONGEST_SUBJECT: usize = 300;

/// A request that changes something.
pub(super) struct Change {
    entry: NewAuditEntry,
    takes_away: bool,
}

/// The change that a request attempts.
///
/// # Errors
/// 429 for one that takes something away, if it is served below the minimum of free space and its client has attempted too many there.
pub(super) fn change(
    access: &AccessControl,
    (grant, client): (&Grant, &Client),
    request: &Request,
    pattern: &str,
    structure: Option<String>,
) -> Result<Change, ApiError> {
    let takes_away = route::takes_away(request.method(), pattern);
    if takes_away && access.0.store.file().refuse_without_room().is_err() {
        access.0.limits.take_below_floor(&client.key)?;
    }
    let path = request.uri().path();
    let entry = NewAuditEntry {
        at: clock::now(),
        actor: grant.actor().as_str().to_owned(),
        actor_name: grant.actor().name().map(str::to_owned),
        peer: client.address.map(|address| address.to_string()),
        request_id: current_id(),
        action: format!("{} {pattern}", request.method()),
        structure: structure.map(|id| id.chars().take(LONGEST_SUBJECT).collect()),
        subject: Some(path.chars().take(LONGEST_SUBJECT).collect()),
    };
    Ok(Change { entry, takes_away })
}

/// Writes the entry, answers the request and adds its status, in a task that continues when the client disconnects.
pub(super) async fn run(access: &AccessControl, change: Change, request: Request, next: Next) -> Response {
    let (store, id) = (access.0.store.clone(), current_id().unwrap_or_default());
    let task = async move {
        let audit = if change.takes_away { store.audit().without_floor() } else { store.audit() };
        let number = match audit.begin_audit(change.entry).await {
            Ok(number) => number,
            // A change that cannot be recorded is not made.
            Err(error) => return Ok(ApiError::from(error).into_response()),
        };
        // A second task, so that the entry is completed if the handler panics.
        let answering = with_current_id(current_id().unwrap_or_default(), next.run(request)).in_current_span();
        let answered = tokio::spawn(answering).await;
        let status = answered.as_ref().map_or(500, |response| response.status().as_u16());
        let made = answered.as_ref().ok().and_then(|response| response.headers().get(header::LOCATION));
        let made = made.and_then(|value| value.to_str().ok()).map(str::to_owned);
        if let Err(cause) = audit.end_audit(number, status, made).await {
            // The entry exists and the change is made: the client receives its result.
            error!(%cause, number, status, "Could not write the outcome of audit entry {number}: {cause}");
        }
        answered
    };
    match tokio::spawn(with_current_id(id, task).in_current_span()).await.and_then(|answered| answered) {
        Ok(response) => response,
        Err(ended) if ended.is_panic() => std::panic::resume_unwind(ended.into_panic()),
        Err(ended) => ApiError::internal(&ended).into_response(),
    }
}
