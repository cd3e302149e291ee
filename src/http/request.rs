//! Reading requests: id, body, JSON, path and query, with our own errors for each way they can be wrong.

use std::future::Future;
use std::time::{Duration, Instant};

use axum::body::{Body, Bytes};
use axum::extract::rejection::{PathRejection, QueryRejection};
use axum::extract::{FromRequestParts, MatchedPath, Request};
use axum::http::{header, HeaderMap, HeaderName, HeaderValue, StatusCode};
use axum::middleware::Next;
use axum::response::Response;
use http_body_util::BodyExt as _;
use serde::de::DeserializeOwned;
use serde::Deserialize as _;
use tracing::{info, Instrument as _};

use super::error::ApiError;
use crate::measurement::check::Problem;
use crate::measurement::json::read_object;
use crate::quantity::Timestamp;

/// Header that carries the request's id both ways.
pub const REQUEST_ID: HeaderName = HeaderName::from_static("x-request-id");

const KNOWN_METHODS: [&str; 7] = ["GET", "HEAD", "POST", "PUT", "PATCH", "DELETE", "OPTIONS"];

tokio::task_local! {
    static CURRENT_ID: String;
}

/// Id of the request this task answers.
pub fn current_id() -> Option<String> {
    CURRENT_ID.try_with(String::clone).ok()
}

/// Runs a part of answering a request in another task, under the same id.
pub async fn with_current_id<F: Future>(id: String, part: F) -> F::Output {
    CURRENT_ID.scope(id, part).await
}

/// Gives each request an id (the client's, if it is short, printable and no token), a log line, and its place in the
/// metrics.
pub async fn with_id_and_log(request: Request, next: Next) -> Response {
    let given = request.headers().get(REQUEST_ID).and_then(|value| value.to_str().ok());
    let usable = |id: &&str| !id.is_empty() && id.len() <= 64 && id.bytes().all(|b| b.is_ascii_graphic());
    let usable = |id: &&str| usable(id) && !crate::access::token_like(id);
    let id = given.filter(usable).map_or_else(|| uuid::Uuid::now_v7().to_string(), str::to_owned);
    // A client may make up methods: they would grow without bound as well.
    let method = KNOWN_METHODS.into_iter().find(|known| *known == request.method().as_str()).unwrap_or("other");
    // The route's pattern, not the path: a label for each id in the path would grow without bound.
    let route = request.extensions().get::<MatchedPath>().map_or("unmatched", MatchedPath::as_str).to_owned();
    let span = tracing::info_span!("request", request.id = %id, method = %method, route = %route);
    let trace = trace(&id, method, &route);
    #[cfg(feature = "otel")]
    super::traceparent::continue_in(&trace, request.headers());
    let started = Instant::now();
    let answer = CURRENT_ID.scope(id.clone(), next.run(request)).instrument(span.clone()).instrument(trace.clone());
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

/// The request in a trace, under the names of OpenTelemetry's conventions.
fn trace(id: &str, method: &str, route: &str) -> tracing::Span {
    tracing::info_span!(
        target: "modalwatch::spans", "request", otel.name = format!("{method} {route}"), otel.kind = "server",
        http.request.method = method, http.route = route, request.id = id,
        http.response.status_code = tracing::field::Empty, otel.status_code = tracing::field::Empty
    )
}

/// What a body may be.
#[derive(Debug, Clone, Copy)]
pub struct BodyLimits {
    /// Most bytes; of NDJSON, those of a line.
    pub bytes: usize,
    /// Most bytes of NDJSON.
    pub bulk_bytes: usize,
    /// Longest time from the end of the header to the end of the body.
    pub time: Duration,
}

/// How many times the limit is read and thrown away before the connection is cut: a client that is still sending does
/// not see the answer, only a broken connection.
const DRAINED_LIMITS: usize = 8;

/// The whole body.
///
/// # Errors
/// 415 when it is compressed, 413 when it is larger than the limit, 408 when it is slower, 400 when the connection breaks.
pub async fn read_body(body: Body, headers: &HeaderMap, limits: BodyLimits) -> Result<Bytes, ApiError> {
    refuse_encoding(headers)?;
    let time = limits.time;
    tokio::time::timeout(time, collect(body, limits.bytes)).await.unwrap_or_else(|_| Err(slow_body(time)))
}

/// 415 for a compressed body.
///
/// # Errors
/// 415.
pub fn refuse_encoding(headers: &HeaderMap) -> Result<(), ApiError> {
    if headers.get(header::CONTENT_ENCODING).is_some_and(|encoding| encoding != "identity") {
        let detail = "a compressed body is not decoded: send it without Content-Encoding";
        return Err(ApiError::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, "unsupported_encoding", detail));
    }
    Ok(())
}

/// 408 for a body that does not arrive.
pub fn slow_body(limit: Duration) -> ApiError {
    let detail = format!("the body did not arrive within {} s", limit.as_secs());
    ApiError::new(StatusCode::REQUEST_TIMEOUT, "body_timeout", detail)
}

/// 400 for a body whose connection broke.
pub fn broken_body() -> ApiError {
    ApiError::new(StatusCode::BAD_REQUEST, "body_unreadable", "the body broke off")
}

async fn collect(mut body: Body, limit: usize) -> Result<Bytes, ApiError> {
    let (mut collected, mut total) = (Vec::new(), 0);
    while let Some(frame) = body.frame().await {
        let Ok(data) = frame.map_err(|_| broken_body())?.into_data() else { continue };
        total += data.len();
        if total <= limit {
            collected.extend_from_slice(&data);
        } else if total > DRAINED_LIMITS * limit {
            break;
        }
    }
    if total > limit {
        let detail = format!("the body is larger than {limit} bytes: split the batch");
        return Err(ApiError::new(StatusCode::PAYLOAD_TOO_LARGE, "body_too_large", detail));
    }
    Ok(collected.into())
}

/// Media type of the body, without parameters, in lower case.
pub fn media_type(headers: &HeaderMap) -> Option<String> {
    let value = headers.get(header::CONTENT_TYPE)?.to_str().ok()?;
    Some(value.split(';').next()?.trim().to_ascii_lowercase())
}

/// 415 with the types that would be right.
pub fn unsupported_media_type(found: Option<&str>, allowed: &str) -> ApiError {
    let found = found.map_or("no Content-Type".to_owned(), |t| format!("Content-Type {}", crate::quantity::shown(t)));
    ApiError::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, "unsupported_media_type", format!("{found}: send {allowed}"))
}

/// A JSON body.
///
/// # Errors
/// 400 when it is no JSON, with line and column; 422 when it is JSON of another shape, or has a number that JSON or f64
/// cannot hold, with a pointer to it.
pub fn parse_json<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, ApiError> {
    Ok(read_object(bytes)?)
}

/// Path parameters, with our own errors.
pub struct ApiPath<T>(pub T);

impl<T: DeserializeOwned + Send, S: Send + Sync> FromRequestParts<S> for ApiPath<T> {
    type Rejection = ApiError;

    fn from_request_parts(
        parts: &mut axum::http::request::Parts,
        state: &S,
    ) -> impl Future<Output = Result<Self, ApiError>> + Send {
        let read = axum::extract::Path::<T>::from_request_parts(parts, state);
        async {
            let invalid = |e: PathRejection| ApiError::invalid_field("path", e.body_text());
            read.await.map(|path| Self(path.0)).map_err(invalid)
        }
    }
}

/// Query parameters, with our own errors.
pub struct ApiQuery<T>(pub T);

impl<T: DeserializeOwned + Send, S: Send + Sync> FromRequestParts<S> for ApiQuery<T> {
    type Rejection = ApiError;

    fn from_request_parts(
        parts: &mut axum::http::request::Parts,
        state: &S,
    ) -> impl Future<Output = Result<Self, ApiError>> + Send {
        let read = axum::extract::Query::<T>::from_request_parts(parts, state);
        async {
            let invalid = |e: QueryRejection| ApiError::invalid_field("query", e.body_text());
            read.await.map(|query| Self(query.0)).map_err(invalid)
        }
    }
}

/// A structure id from the path.
///
/// # Errors
/// 422 for anything that is no id.
pub fn structure_id(text: &str) -> Result<crate::quantity::StructureId, ApiError> {
    let invalid = |e: crate::quantity::OutOfRange| {
        let problem = Problem { pointer: "path".to_owned(), message: e.to_string() };
        ApiError::invalid("invalid_id", e.to_string(), vec![problem])
    };
    crate::quantity::StructureId::parse(text).map_err(invalid)
}

/// A JSON body.
///
/// # Errors
/// 415 for another content type, else as [`read_body`] and [`parse_json`].
pub async fn json_body<T: DeserializeOwned>(
    headers: &HeaderMap,
    body: Body,
    limits: BodyLimits,
) -> Result<T, ApiError> {
    match media_type(headers).as_deref() {
        Some("application/json") => {}
        other => return Err(unsupported_media_type(other, "application/json")),
    }
    parse_json(&read_body(body, headers, limits).await?)
}

/// A whole number of a JSON body; JSON knows no difference between `3` and `3.0`.
///
/// # Errors
/// As serde has it, for anything but a whole number from 0 to 2^53 − 1, the last that every JSON reader keeps.
pub fn whole_number<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<Option<u64>, D::Error> {
    let Some(number) = Option::<serde_json::Number>::deserialize(deserializer)? else { return Ok(None) };
    let from_float = || number.as_f64().filter(|x| x.fract() == 0.0 && (0.0..9e15).contains(x)).map(|x| x as u64);
    let whole = number.as_u64().or_else(from_float).filter(|n| *n <= LARGEST_WHOLE_NUMBER);
    let wrong = || format!("{number} must be a whole number from 0 to {LARGEST_WHOLE_NUMBER}");
    whole.map(Some).ok_or_else(|| serde::de::Error::custom(wrong()))
}

/// The last whole number that every JSON reader keeps: 2^53 − 1.
const LARGEST_WHOLE_NUMBER: u64 = 9_007_199_254_740_991;

/// Items of a page unless the client asks for another number.
const DEFAULT_LIMIT: usize = 100;
/// Most items of a page.
const MAX_LIMIT: usize = 1_000;

/// The `limit` of a query.
///
/// # Errors
/// 422 for anything but a whole number from 1 to 1000.
pub fn page_limit(text: Option<&str>) -> Result<usize, ApiError> {
    let Some(text) = text else { return Ok(DEFAULT_LIMIT) };
    text.parse().ok().filter(|n| (1..=MAX_LIMIT).contains(n)).ok_or_else(|| {
        let message = format!("{} must be a whole number from 1 to {MAX_LIMIT}", crate::quantity::shown(text));
        ApiError::invalid_field("query/limit", message)
    })
}

/// The number that a page begins behind.
///
/// # Errors
/// 422 for anything that was not given out as one.
pub fn page_cursor(text: Option<&str>) -> Result<Option<i64>, ApiError> {
    let number = |text: &str| {
        let message = || format!("{} was not given out by this service", crate::quantity::shown(text));
        text.parse::<i64>().map_err(|_| ApiError::invalid_field("query/cursor", message()))
    };
    text.map(number).transpose()
}

/// From a time on and before another.
#[derive(Debug, Clone, Copy)]
pub struct Window {
    /// At this time or later.
    pub from: Option<Timestamp>,
    /// Before this time.
    pub to: Option<Timestamp>,
}

impl Window {
    /// The `from` and `to` of a query.
    ///
    /// # Errors
    /// 422 for anything but RFC 3339 with an offset.
    pub fn of(from: Option<&str>, to: Option<&str>) -> Result<Self, ApiError> {
        let time = |name: &str, text: Option<&str>| {
            // A plus sign in a query stands for a blank; in an offset it was meant as a plus.
            let parse = |text: &str| {
                Timestamp::parse(&text.replace(' ', "+"))
                    .map_err(|e| ApiError::invalid_field(format!("query/{name}"), e.to_string()))
            };
            text.map(parse).transpose()
        };
        Ok(Self { from: time("from", from)?, to: time("to", to)? })
    }
}
