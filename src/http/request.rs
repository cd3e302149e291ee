//! Reading bodies, JSON, path and query parameters, with a problem for each way in which they can be wrong.

use std::future::Future;
use std::time::Duration;

use axum::body::{Body, Bytes};
use axum::extract::rejection::{PathRejection, QueryRejection};
use axum::extract::FromRequestParts;
use axum::http::{header, HeaderMap, HeaderName, StatusCode};
use http_body_util::BodyExt as _;
use serde::de::DeserializeOwned;
use serde::Deserialize as _;

use super::error::ApiError;
use crate::measurement::check::Problem;
use crate::measurement::json::read_object;
use crate::quantity::Timestamp;

/// Header with the key that the client chose for a batch.
pub const IDEMPOTENCY_KEY: HeaderName = HeaderName::from_static("idempotency-key");

/// Limits of a request body.
#[derive(Debug, Clone, Copy)]
pub struct BodyLimits {
    /// Maximum size in bytes; for NDJSON, of each line.
    pub bytes: usize,
    /// Maximum size of an NDJSON body in bytes.
    pub bulk_bytes: usize,
    /// Time limit from the end of the header to the end of the body; for a large table, from the moment there is room for it.
    pub time: Duration,
}

/// An oversized body is read and discarded up to this multiple of the limit before the connection is closed: a client
/// that is still sending would see a broken connection instead of the answer.
const DRAINED_LIMITS: usize = 8;

/// Reads the whole body.
///
/// # Errors
/// 415 for a compressed body, 413 for one that exceeds the limit, 408 for one that arrives too slowly, 400 if the
/// connection breaks.
pub async fn read_body(body: Body, headers: &HeaderMap, limits: BodyLimits) -> Result<Bytes, ApiError> {
    let mut arriving = ArrivingBody::new(body, headers, limits)?;
    arriving.read(usize::MAX).await?;
    arriving.whole()
}

/// A body that is read in parts: what is not read stays in the buffers of its connection.
pub struct ArrivingBody {
    body: Body,
    limits: BodyLimits,
    collected: Vec<u8>,
    /// Number of bytes that have arrived; those beyond the limit are not collected.
    total: usize,
}

impl ArrivingBody {
    /// A body of which nothing has been read.
    ///
    /// # Errors
    /// 415 for a compressed body.
    pub fn new(body: Body, headers: &HeaderMap, limits: BodyLimits) -> Result<Self, ApiError> {
        refuse_encoding(headers)?;
        Ok(Self { body, limits, collected: Vec::new(), total: 0 })
    }

    /// Reads until the body ends, or until more than `enough` bytes have arrived, within the time limit; returns whether it has ended.
    ///
    /// # Errors
    /// 408 for a body that arrives too slowly, 400 if the connection breaks.
    pub async fn read(&mut self, enough: usize) -> Result<bool, ApiError> {
        let time = self.limits.time;
        tokio::time::timeout(time, self.collect(enough)).await.unwrap_or_else(|_| Err(slow_body(time)))
    }

    async fn collect(&mut self, enough: usize) -> Result<bool, ApiError> {
        let limit = self.limits.bytes;
        while self.total <= enough {
            let Some(frame) = self.body.frame().await else { return Ok(true) };
            let Ok(data) = frame.map_err(|_| broken_body())?.into_data() else { continue };
            self.total += data.len();
            if self.total <= limit {
                self.collected.extend_from_slice(&data);
            } else if self.total > DRAINED_LIMITS * limit {
                return Ok(true);
            }
        }
        Ok(false)
    }

    /// The body, after its end was read.
    ///
    /// # Errors
    /// 413 for one that exceeds the limit.
    pub fn whole(self) -> Result<Bytes, ApiError> {
        let limit = self.limits.bytes;
        if self.total > limit {
            let detail = format!("the body is larger than {limit} bytes: split the batch");
            return Err(ApiError::new(StatusCode::PAYLOAD_TOO_LARGE, "body_too_large", detail));
        }
        Ok(self.collected.into())
    }
}

/// Size of the body that a client announces.
pub fn content_length(headers: &HeaderMap) -> Option<usize> {
    headers.get(header::CONTENT_LENGTH)?.to_str().ok()?.parse().ok()
}

/// Refuses a compressed body.
///
/// # Errors
/// 415.
pub fn refuse_encoding(headers: &HeaderMap) -> Result<(), ApiError> {
    if headers.get(header::CONTENT_ENCODING).is_some_and(|encoding| encoding != "identity") {
        let detail = "compressed bodies are not supported: send the body without Content-Encoding";
        return Err(ApiError::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, "unsupported_encoding", detail));
    }
    Ok(())
}

/// 408 for a body that did not arrive in time.
pub fn slow_body(limit: Duration) -> ApiError {
    let detail = format!("the body did not arrive within {} s", limit.as_secs());
    ApiError::new(StatusCode::REQUEST_TIMEOUT, "body_timeout", detail)
}

/// 400 for a body whose connection broke before its end.
pub fn broken_body() -> ApiError {
    ApiError::new(StatusCode::BAD_REQUEST, "body_unreadable", "the connection broke before the end of the body")
}

/// Media type of the body in lower case, without parameters.
pub fn media_type(headers: &HeaderMap) -> Option<String> {
    let value = headers.get(header::CONTENT_TYPE)?.to_str().ok()?;
    Some(value.split(';').next()?.trim().to_ascii_lowercase())
}

/// 415 with the media types that are supported.
pub fn unsupported_media_type(found: Option<&str>, allowed: &str) -> ApiError {
    let found = found.map_or("no Content-Type".to_owned(), |t| format!("Content-Type {}", crate::quantity::shown(t)));
    ApiError::new(StatusCode::UNSUPPORTED_MEDIA_TYPE, "unsupported_media_type", format!("{found}: send {allowed}"))
}

/// A JSON body.
///
/// # Errors
/// 400 with line and column if the text is not JSON; 422 with a JSON pointer if the JSON has another shape, or contains
/// a number that cannot be represented as f64.
pub fn parse_json<T: DeserializeOwned>(bytes: &[u8]) -> Result<T, ApiError> {
    Ok(read_object(bytes)?)
}

/// Path parameters; invalid ones are answered with a problem.
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

/// Query parameters; invalid ones are answered with a problem.
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
/// 422 if the text is not a valid id.
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
/// 415 for another content type, otherwise as [`read_body`] and [`parse_json`].
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

/// Deserialises a whole number. JSON does not distinguish `3` from `3.0`, so both are accepted.
///
/// # Errors
/// A serde error unless the number is whole and from 0 to 2^53 − 1, the largest that every JSON reader represents
/// exactly.
pub fn whole_number<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<Option<u64>, D::Error> {
    let Some(number) = Option::<serde_json::Number>::deserialize(deserializer)? else { return Ok(None) };
    let from_float = || number.as_f64().filter(|x| x.fract() == 0.0 && (0.0..9e15).contains(x)).map(|x| x as u64);
    let whole = number.as_u64().or_else(from_float).filter(|n| *n <= LARGEST_WHOLE_NUMBER);
    let wrong = || format!("{number} must be a whole number from 0 to {LARGEST_WHOLE_NUMBER}");
    whole.map(Some).ok_or_else(|| serde::de::Error::custom(wrong()))
}

/// Largest whole number that every JSON reader represents exactly: 2^53 − 1.
const LARGEST_WHOLE_NUMBER: u64 = 9_007_199_254_740_991;

/// Number of items on a page if the client does not specify one.
const DEFAULT_LIMIT: usize = 100;
/// Maximum number of items on a page.
const MAX_LIMIT: usize = 1_000;

/// The `limit` of a query.
///
/// # Errors
/// 422 unless the text is a whole number from 1 to 1000.
pub fn page_limit(text: Option<&str>) -> Result<usize, ApiError> {
    let Some(text) = text else { return Ok(DEFAULT_LIMIT) };
    text.parse().ok().filter(|n| (1..=MAX_LIMIT).contains(n)).ok_or_else(|| {
        let message = format!("{} must be a whole number from 1 to {MAX_LIMIT}", crate::quantity::shown(text));
        ApiError::invalid_field("query/limit", message)
    })
}

/// The number after which a page begins, from the `cursor` of a query.
///
/// # Errors
/// 422 if the text is not a number.
pub fn page_cursor(text: Option<&str>) -> Result<Option<i64>, ApiError> {
    let number = |text: &str| {
        let message = || format!("{} is not a cursor of this service", crate::quantity::shown(text));
        text.parse::<i64>().map_err(|_| ApiError::invalid_field("query/cursor", message()))
    };
    text.map(number).transpose()
}

/// A half-open time interval; a missing end is unbounded.
#[derive(Debug, Clone, Copy)]
pub struct Window {
    /// Inclusive start.
    pub from: Option<Timestamp>,
    /// Exclusive end.
    pub to: Option<Timestamp>,
}

impl Window {
    /// Parses the `from` and `to` of a query.
    ///
    /// # Errors
    /// 422 unless both are RFC 3339 with a UTC offset.
    pub fn of(from: Option<&str>, to: Option<&str>) -> Result<Self, ApiError> {
        let time = |name: &str, text: Option<&str>| {
            // In a query, an unescaped plus sign means a space; in a UTC offset it was meant as a plus sign.
            let parse = |text: &str| {
                Timestamp::parse(&text.replace(' ', "+"))
                    .map_err(|e| ApiError::invalid_field(format!("query/{name}"), e.to_string()))
            };
            text.map(parse).transpose()
        };
        Ok(Self { from: time("from", from)?, to: time("to", to)? })
    }
}
