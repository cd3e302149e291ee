//! Many batches in one request: NDJSON, one batch a line, each stored by itself and answered in its place.
//!
//! Nothing is half-silent: a line that is refused says so and the next goes on. What stops the whole request (too many bytes or
//! lines, a body that breaks off, an error of the service) is a problem that carries what was done before; posting the same
//! again is safe. One line at a time is in memory, whatever the length of the body.

use std::time::Duration;

use axum::body::{Body, Bytes};
use axum::http::{header, HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use http_body_util::BodyExt as _;
use serde::Serialize;
use utoipa::ToSchema;

use super::access::Client;
use super::answer;
use super::error::{ApiError, ProblemBody};
use super::request::{broken_body, refuse_encoding, slow_body, BodyLimits};
use super::Shared;
use crate::assessment::BatchState;
use crate::measurement::body::RawBatch;
use crate::measurement::check::check_idempotency_key;
use crate::measurement::MeasurementBatch;
use crate::monitor::{Ingested, Monitor};
use crate::quantity::StructureId;

/// Most batches of one request: each has an entry in the answer.
const MOST_LINES: usize = 10_000;

/// How many times the limit is read and thrown away before the connection is cut, so that a client that is still sending sees
/// the answer.
const DRAINED_LIMITS: usize = 2;

/// Longest wait of a line for a place in the queue.
const PATIENCE: Duration = Duration::from_secs(30);

/// What became of each line.
#[derive(Debug, Default, Serialize, ToSchema)]
pub struct BulkAnswer {
    /// One entry for each line that is not blank, in their order.
    items: Vec<BulkItem>,
    /// Lines whose batch is stored now and was not before.
    stored: usize,
    /// Lines whose batch had been stored before.
    replayed: usize,
    /// Lines that were refused.
    refused: usize,
}

/// What became of one line.
#[derive(Debug, Serialize, ToSchema)]
struct BulkItem {
    /// Line of the body, from 1.
    line: usize,
    /// The status that the batch alone would have been answered with.
    status: u16,
    /// Id of the batch.
    #[serde(skip_serializing_if = "Option::is_none")]
    batch: Option<String>,
    /// How far the batch has come.
    #[serde(skip_serializing_if = "Option::is_none")]
    state: Option<BatchState>,
    /// Whether it had been stored before.
    #[serde(skip_serializing_if = "Option::is_none")]
    replayed: Option<bool>,
    /// Path of the batch.
    #[serde(skip_serializing_if = "Option::is_none")]
    location: Option<String>,
    /// Why it was refused.
    #[serde(skip_serializing_if = "Option::is_none")]
    #[schema(no_recursion)]
    problem: Option<Box<ProblemBody>>,
}

/// Takes a body of NDJSON; the source of the query stands for lines without one.
///
/// # Errors
/// 400, 408, 413, 415 for the body as a whole, 422 for a key in the header, 429 beyond the measurements a second of
/// `http.rate_limit`, 503 when no place becomes free in time; those that come after the first line carry what was done.
pub async fn create(
    shared: &Shared,
    client: &Client,
    (structure, source): (StructureId, Option<String>),
    headers: &HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    refuse_encoding(headers)?;
    if headers.contains_key(super::batches::IDEMPOTENCY_KEY) {
        let message = "a key in the header cannot stand for many batches: give each line its own \"idempotency_key\"";
        return Err(ApiError::invalid_field("header/Idempotency-Key", message));
    }
    let announced = headers.get(header::CONTENT_LENGTH).and_then(|v| v.to_str().ok()).and_then(|v| v.parse().ok());
    let mut lines = Lines::new(body, shared.limits);
    let mut answer = BulkAnswer::default();
    if announced.is_some_and(|bytes: usize| bytes > shared.limits.bulk_bytes) {
        lines.drain().await;
        return Err(lines.too_large());
    }
    loop {
        let (line, text) = match lines.next().await {
            Ok(Some(line)) => line,
            Ok(None) => return Ok((StatusCode::OK, Json(answer)).into_response()),
            Err(error) => return Err(error.after(answer)),
        };
        if answer.items.len() == MOST_LINES {
            lines.drain().await;
            let detail = format!("more than {MOST_LINES} lines: send those from line {line} on in another request");
            return Err(ApiError::new(StatusCode::PAYLOAD_TOO_LARGE, "too_many_lines", detail).after(answer));
        }
        let taken = match text {
            Ok(text) => take(shared, client, (structure.clone(), source.clone()), text).await,
            Err(too_large) => Err(too_large),
        };
        match taken {
            // What is wrong with the service, or comes too soon, is not wrong with the line: the client should send it again.
            Err(error) if error.status().is_server_error() || error.status() == StatusCode::TOO_MANY_REQUESTS => {
                lines.drain().await;
                return Err(error.after(answer));
            }
            taken => answer.add(line, taken),
        }
    }
}

/// Parses, stores and assesses one line.
async fn take(
    shared: &Shared,
    client: &Client,
    (structure, source): (StructureId, Option<String>),
    text: Vec<u8>,
) -> Result<Ingested, ApiError> {
    let monitor = shared.monitor.clone();
    let batch = tokio::task::spawn_blocking(move || parse(&monitor, &structure, source, &text));
    let batch = batch.await.map_err(|e| ApiError::internal(&e))??;
    shared.access.take_measurements(client, batch.measurements.len())?;
    Ok(shared.monitor.ingest().take_within(batch, PATIENCE).await?)
}

fn parse(
    monitor: &Monitor,
    structure: &StructureId,
    source: Option<String>,
    text: &[u8],
) -> Result<MeasurementBatch, ApiError> {
    // The structure may have been extended since the line before.
    let active = monitor.structure(structure)?;
    // A line has no headers: its key is a field, as in a message.
    let mut line = RawBatch::of_message(text)?;
    line.source = line.source.or(source);
    if let Some(key) = &line.idempotency_key {
        let at_key = |problem| ApiError::invalid_input(vec![problem]).at("/idempotency_key");
        check_idempotency_key(key).map_err(at_key)?;
    }
    monitor.ingest().check(&active, line).map_err(ApiError::invalid_input)
}

impl BulkAnswer {
    fn add(&mut self, line: usize, taken: Result<Ingested, ApiError>) {
        let item = match taken {
            Ok(Ingested { view, replayed }) => {
                *(if replayed { &mut self.replayed } else { &mut self.stored }) += 1;
                let state = view.record.state;
                let (location, batch) = (answer::location(&view.record), view.record.batch_id);
                BulkItem {
                    line,
                    status: StatusCode::CREATED.as_u16(),
                    batch: Some(batch),
                    state: Some(state),
                    replayed: Some(replayed),
                    location: Some(location),
                    problem: None,
                }
            }
            Err(error) => {
                self.refused += 1;
                BulkItem {
                    line,
                    status: error.status().as_u16(),
                    batch: None,
                    state: None,
                    replayed: None,
                    location: None,
                    problem: Some(Box::new(error.into_body())),
                }
            }
        };
        self.items.push(item);
    }
}

/// A line's number and text; `Err` for one that is too long, of which nothing was kept.
type Line = (usize, Result<Vec<u8>, ApiError>);

/// The lines of a body as they arrive.
struct Lines {
    body: Body,
    limits: BodyLimits,
    /// What has arrived and not been read.
    chunk: Bytes,
    bytes: usize,
    line: usize,
}

impl Lines {
    fn new(body: Body, limits: BodyLimits) -> Self {
        Self { body, limits, chunk: Bytes::new(), bytes: 0, line: 0 }
    }

    /// The next line that is not blank; the time limit is for its arrival, not for the work between.
    async fn next(&mut self) -> Result<Option<Line>, ApiError> {
        let time = self.limits.time;
        tokio::time::timeout(time, self.read()).await.unwrap_or_else(|_| Err(slow_body(time)))
    }

    async fn read(&mut self) -> Result<Option<Line>, ApiError> {
        let (mut text, mut length) = (Vec::new(), 0);
        loop {
            let end = self.chunk.iter().position(|b| *b == b'\n');
            let part = self.chunk.split_to(end.unwrap_or(self.chunk.len()));
            length += part.len();
            if length <= self.limits.bytes {
                text.extend_from_slice(&part);
            }
            if end.is_some() {
                let _newline = self.chunk.split_to(1);
            }
            let ended = end.is_some() || !self.fetch().await?;
            if !ended {
                continue;
            }
            self.line += 1;
            if self.line == 1 && text.starts_with(b"\xef\xbb\xbf") {
                text.drain(..3);
            }
            if length > self.limits.bytes {
                let detail = format!("line {} is larger than {} bytes: split the batch", self.line, self.limits.bytes);
                let error = ApiError::new(StatusCode::PAYLOAD_TOO_LARGE, "line_too_large", detail);
                return Ok(Some((self.line, Err(error))));
            }
            if !text.trim_ascii().is_empty() {
                return Ok(Some((self.line, Ok(text))));
            }
            if end.is_none() {
                return Ok(None);
            }
            (text, length) = (Vec::new(), 0);
        }
    }

    /// Gets the next part of the body; false at its end.
    async fn fetch(&mut self) -> Result<bool, ApiError> {
        while let Some(frame) = self.body.frame().await {
            let Ok(data) = frame.map_err(|_| broken_body())?.into_data() else { continue };
            self.bytes += data.len();
            if self.bytes > self.limits.bulk_bytes {
                self.drain().await;
                return Err(self.too_large());
            }
            self.chunk = data;
            return Ok(true);
        }
        Ok(false)
    }

    fn too_large(&self) -> ApiError {
        let detail =
            format!("the body is larger than {} bytes: send the rest in another request", self.limits.bulk_bytes);
        ApiError::new(StatusCode::PAYLOAD_TOO_LARGE, "body_too_large", detail)
    }

    /// Reads on and throws away, within limits: a client that is still sending would see a broken connection instead of the
    /// answer.
    async fn drain(&mut self) {
        let most = DRAINED_LIMITS * self.limits.bulk_bytes;
        let body = &mut self.body;
        let read = async {
            let mut bytes = 0;
            while let Some(Ok(frame)) = body.frame().await {
                bytes += frame.into_data().map_or(0, |data| data.len());
                if bytes > most {
                    break;
                }
            }
        };
        let _ = tokio::time::timeout(self.limits.time, read).await;
    }
}
