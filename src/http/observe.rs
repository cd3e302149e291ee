//! The id, log line, metrics and trace of each request.

use std::time::Instant;

use axum::extract::{MatchedPath, Request};
use axum::http::{HeaderMap, HeaderName, HeaderValue};
use axum::middleware::Next;
use axum::response::Response;
use tracing::{info, Instrument as _};

use super::request_id::with_current_id;

/// Header with the request id, in requests and responses.
pub const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");

const KNOWN_METHODS: [&str; 7] = ["GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"];

/// The id that the client, or the node that passed the request on, has given it, if it is short, printable and does not contain a token.
pub fn given_id(headers: &HeaderMap) -> Option<&str> {
    let given = headers.get(REQUEST_ID).and_then(|value| value.to_str().ok());
    let usable = |id: &&str| !id.is_empty() && id.len() <= 64 && id.bytes().all(|b| b.is_ascii_graphic());
    given.filter(|id| usable(id) && !crate::access::token_like(id))
}

/// Gives each request an id, a log line, metrics and a trace. A [given id](given_id) is used.
pub async fn with_id_and_log(request: Request, next: Next) -> Response {
    let id = given_id(request.headers()).map_or_else(|| uuid::Uuid::now_v7().to_string(), str::to_owned);
    // A client may invent methods, each of which would become a new label.
    let method = KNOWN_METHODS.into_iter().find(|known| *known == request.method().as_str()).unwrap_or("other");
    // The pattern of the route instead of the path: ids in the path would create an unlimited number of labels.
    let route = request.extensions().get::<MatchedPath>().map_or("unmatched", MatchedPath::as_str).to_owned();
    let span = tracing::info_span!("request", request.id = %id, method = %method, route = %route);
    let trace = trace(&id, method, &route);
    #[cfg(feature = "otel")]
    super::traceparent::continue_in(&trace, request.headers());
    let started = Instant::now();
    let answer = with_current_id(id.clone(), next.run(request)).instrument(span.clone()).instrument(trace.clone());
    let mut response = answer.await;

    let (status, seconds) = (response.status().as_u16(), started.elapsed().as_secs_f64());
    trace.record("http.response.status_code", status);
    if status >= 500 {
        trace.record("otel.status_code", "ERROR");
    }
    let labels = [("method", method.to_string()), ("route", route.clone()), ("status", status.to_string())];
    metrics::counter!("modalwatch_http_requests_total", &labels).increment(1);
    metrics::histogram!("modalwatch_http_request_seconds", "route" => route.clone()).record(seconds);
    let duration_ms = seconds * 1e3;
    span.in_scope(|| info!(status, duration_ms, "Answered {method} {route} with {status}"));
    if let Ok(value) = HeaderValue::from_str(&id) {
        response.headers_mut().insert(REQUEST_ID, value);
    }
    response
}

/// Span of the request for traces, with the attribute names of the OpenTelemetry semantic conventions.
fn trace(id: &str, method: &str, route: &str) -> tracing::Span {
    tracing::info_span!(
        target: "modalwatch::spans", "request", otel.name = format!("{method} {route}"), otel.kind = "server",
        http.request.method = method, http.route = route, request.id = id,
        http.response.status_code = tracing::field::Empty, otel.status_code = tracing::field::Empty
    )
}
