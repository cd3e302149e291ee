//! `/v1/events`: events of the structures, as server-sent events.

use std::convert::Infallible;
use std::sync::Arc;
use std::time::Duration;

use axum::extract::State;
use axum::http::{HeaderName, StatusCode};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use futures_util::stream::{self, Stream};
use tokio::sync::broadcast;
use tokio::sync::broadcast::error::RecvError;
use utoipa::ToSchema;

use super::access::{AccessControl, Client};
use super::error::ApiError;
use super::openapi::StreamBusy;
use super::shared::Shared;
use crate::access::{Actor, Grant};
use crate::monitor::events::News;
use crate::quantity::StructureId;

/// Maximum number of open streams.
pub const MOST_STREAMS: usize = 64;

/// Interval of the comments that keep proxies from closing an idle stream.
const KEEP_ALIVE: Duration = Duration::from_secs(15);

/// Maximum number of open streams of one token.
pub const MOST_STREAMS_OF_A_TOKEN: usize = 16;

/// Interval at which the token of a stream is looked at again.
const CHECK_TOKEN: Duration = Duration::from_millis(500);

/// Value of `Retry-After` when all streams are in use, seconds.
const RETRY_AFTER_S: u32 = 10;

/// Value of `Retry-After` while the service stops, seconds.
const RETRY_AFTER_STOP_S: u32 = 5;

/// Asks proxies such as nginx not to buffer the stream.
const NO_BUFFERING: (HeaderName, &str) = (HeaderName::from_static("x-accel-buffering"), "no");

/// An event of the stream, as the OpenAPI document describes it.
#[derive(ToSchema)]
#[expect(dead_code, reason = "written as lines of the event stream, never as JSON")]
struct StreamedEvent {
    /// `batch`, `alarm`, `job`, `structure` or `resync`.
    event: String,
    /// One line of JSON.
    data: String,
}

/// `GET /v1/events`: events of the structures that the token may see. The stream ends when the token expires or is
/// revoked, when its secret is no longer valid, or when the service stops. A client that is too slow loses events, receives the event `resync`, and
/// continues with new ones.
///
/// # Errors
/// 503 when the maximum number of streams is open, in all or by this token, or when the service stops.
#[utoipa::path(
    get, path = "/v1/events", tag = "results", operation_id = "watch_events",
    summary = "Event stream",
    description = "Server-sent events of the structures that the token may see: `batch`, `alarm`, `job` and `structure`, each with \
                   one line of JSON, and `resync` for a client that was too slow and lost events. A comment is sent every 15 s. \
                   The stream ends within a second after its token has expired or was revoked or its secret is no longer valid, and when the \
                   service stops. 64 streams are open at a time, 16 of one token.",
    responses(
        (status = 200, description = "The events; the schema describes one event", body = StreamedEvent, content_type = "text/event-stream"),
        StreamBusy
    )
)]
pub async fn events(State(shared): State<Shared>, grant: Grant, client: Client) -> Result<Response, ApiError> {
    let share = match grant.actor() {
        Actor::Token { .. } => Some(shared.token_streams.take(&client.key).ok_or_else(|| {
            let detail = format!(
                "this token has {MOST_STREAMS_OF_A_TOKEN} event streams open, which is the maximum: close one, or try again later"
            );
            ApiError::unavailable("too_many_streams", detail, RETRY_AFTER_S)
        })?),
        Actor::Local | Actor::Nobody => None,
    };
    let permit = Arc::clone(&shared.streams).try_acquire_owned().map_err(|_| {
        let detail =
            format!("{MOST_STREAMS} event streams are open, which is the maximum: close one, or try again later");
        ApiError::unavailable("too_many_streams", detail, RETRY_AFTER_S)
    })?;
    let news = shared.monitor.events().watch().ok_or_else(|| {
        ApiError::unavailable("stopping", "the service is stopping: try again when it is running", RETRY_AFTER_STOP_S)
    })?;
    let may_see = move |about: Option<&StructureId>| holds(&shared.access, (&grant, &client), about);
    let body = Sse::new(stream_of(news, may_see, (permit, share)))
        .keep_alive(KeepAlive::new().interval(KEEP_ALIVE).text("still here"));
    Ok((StatusCode::OK, [NO_BUFFERING], body).into_response())
}

/// The events of a receiver until the bus is closed or `may_see` returns `None`. The permit is held until the stream
/// ends.
fn stream_of<P: Send>(
    news: broadcast::Receiver<News>,
    may_see: impl Fn(Option<&StructureId>) -> Option<bool> + Send,
    permit: P,
) -> impl Stream<Item = Result<Event, Infallible>> + Send {
    stream::unfold((news, may_see, permit), |(mut news, may_see, permit)| async move {
        let event = loop {
            let Ok(received) = tokio::time::timeout(CHECK_TOKEN, news.recv()).await else {
                may_see(None)?;
                continue;
            };
            match received {
                Ok(news) if may_see(Some(news.structure()))? => {
                    break Event::default().event(news.name()).json_data(&news).expect("news are plain data");
                }
                Ok(_) => {}
                Err(RecvError::Lagged(_)) => break Event::default().event("resync").data("{}"),
                Err(RecvError::Closed) => return None,
            }
        };
        Some((Ok(event), (news, may_see, permit)))
    })
}

/// Whether the token may see the structure; `None` once it is revoked or expired, or its secret replaced.
fn holds(access: &AccessControl, (grant, client): (&Grant, &Client), structure: Option<&StructureId>) -> Option<bool> {
    access.look_again(client).ok()?;
    Some(structure.is_none_or(|id| grant.may_see(id)))
}

#[cfg(test)]
mod tests {
    use http_body_util::BodyExt as _;

    use super::*;
    use crate::monitor::events::Events;

    #[tokio::test]
    async fn a_slow_subscriber_gets_one_resync_and_continues_with_the_newest_events() {
        let events = Events::default();
        let slow = events.watch().unwrap();
        let structure = |i: i32| StructureId::parse(&format!("s{i}")).unwrap();
        for i in 0..5_000 {
            events.publish(News::Structure { structure: structure(i) });
        }
        events.close();
        let body = Sse::new(stream_of(slow, |_| Some(true), ()))
            .into_response()
            .into_body()
            .collect()
            .await
            .unwrap()
            .to_bytes();
        let text = String::from_utf8(body.to_vec()).unwrap();
        assert!(text.starts_with("event: resync\ndata: {}\n\nevent: structure\ndata: "), "{}", &text[..200]);
        assert_eq!(text.matches("event: resync").count(), 1);
        assert!(text.ends_with("event: structure\ndata: {\"structure\":\"s4999\"}\n\n"));
        assert!(events.watch().is_none(), "a closed bus takes no watcher");
    }
}
