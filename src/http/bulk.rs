//! Many batches in one request: NDJSON with one batch per line. Each line is stored and answered independently.
//!
//! A line that is refused is reported in the answer, and the next line is processed. An error that stops the whole
//! request (too many bytes or lines, a broken connection, an internal error, a token that is not valid any more) is
//! answered by a problem that lists the outcome of the lines before it; the client may repeat the whole request safely.
//! Only one line is in memory at a time.

use std::time::Duration;

use axum::body::{Body, Bytes};
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use http_body_util::BodyExt as _;

use super::access::Client;
use super::answer;
use super::error::ApiError;
use super::problem::{BulkAnswer, BulkItem};
use super::request::{broken_body, content_length, refuse_encoding, slow_body, BodyLimits, IDEMPOTENCY_KEY};
use super::shared::Shared;
use crate::measurement::body::RawBatch;
use crate::measurement::check::check_idempotency_key;
use crate::measurement::MeasurementBatch;
use crate::monitor::{Ingested, Monitor};
use crate::quantity::StructureId;

/// Maximum number of batches in one request: each has an entry in the answer.
const MOST_LINES: usize = 10_000;

/// An oversized body is read and discarded up to this multiple of the limit before the connection is closed: a client
/// that is still sending would see a broken connection instead of the answer.
const DRAINED_LIMITS: usize = 2;

/// Maximum time that a line waits for a free slot in the queue.
pub const PATIENCE: Duration = Duration::from_secs(30);

/// Stores the batches of an NDJSON body. `source` applies to lines that do not name one.
///
/// # Errors
/// 400, 408, 413, 415 for the body as a whole, 422 for an idempotency key in the header, 401 once the token is not valid
/// any more, 429 if the rate limit of measurements is exceeded, 503 when the queue stays full. Errors after the first line
/// carry the outcome of the lines before.
pub async fn create(
    shared: &Shared,
    client: &Client,
    (structure, source): (StructureId, Option<String>),
    headers: &HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    refuse_encoding(headers)?;
    if headers.contains_key(IDEMPOTENCY_KEY) {
        let message = "a key in the header cannot identify many batches: give each line its own \"idempotency_key\"";
        return Err(ApiError::invalid_field("header/Idempotency-Key", message));
    }
    let mut lines = Lines::new(body, shared.limits);
    let mut answer = BulkAnswer::default();
    if content_length(headers).is_some_and(|bytes| bytes > shared.limits.bulk_bytes) {
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
            let detail = format!("more than {MOST_LINES} lines: send the lines from {line} on in another request");
            return Err(ApiError::new(StatusCode::PAYLOAD_TOO_LARGE, "too_many_lines", detail).after(answer));
        }
        // A line may come long after the one before it, and also one that is refused costs something.
        let taken = match (shared.access.look_again(client), text) {
            (Ok(()), Ok(text)) => take(shared, client, (structure.clone(), source.clone()), text).await,
            (Err(refusal), _) | (Ok(()), Err(refusal)) => Err(refusal),
        };
        match taken {
            // The line itself is not wrong: the client should repeat it.
            Err(error) if error.ends_the_request() => {
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
    let (monitor, sender) = (shared.monitor.clone(), client.clone());
    let batch = tokio::task::spawn_blocking(move || parse(&monitor, &sender, (&structure, source), &text));
    let batch = batch.await.map_err(|e| ApiError::internal(&e))??;
    shared.access.take_measurements(client, batch.measurements.len())?;
    Ok(shared.monitor.ingest().take_within(batch, PATIENCE).await?)
}

fn parse(
    monitor: &Monitor,
    sender: &Client,
    (structure, source): (&StructureId, Option<String>),
    text: &[u8],
) -> Result<MeasurementBatch, ApiError> {
    // The structure may have been extended since the previous line.
    let active = monitor.structure(structure)?;
    // A line has no headers: its idempotency key is a field of the JSON.
    let mut line = RawBatch::of_message(text)?;
    line.source = line.source.or(source);
    if let Some(key) = &line.idempotency_key {
        let at_key = |problem| ApiError::invalid_input(vec![problem]).at("/idempotency_key");
        check_idempotency_key(key).map_err(at_key)?;
    }
    monitor.ingest().check(&active, sender.posts(line)?).map_err(ApiError::invalid_input)
}

impl BulkAnswer {
    /// Adds the outcome of the batch at a line.
    pub fn add(&mut self, line: usize, taken: Result<Ingested, ApiError>) {
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
                    from: None,
                    to: None,
                    measurements: None,
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
                    from: None,
                    to: None,
                    measurements: None,
                    problem: Some(Box::new(error.into_body())),
                }
            }
        };
        self.items.push(item);
    }
}

/// Number and text of a line; `Err` for a line that is too long and was discarded.
type Line = (usize, Result<Vec<u8>, ApiError>);

/// The lines of a body as they arrive.
struct Lines {
    body: Body,
    limits: BodyLimits,
    /// Bytes that have arrived but have not been processed.
    chunk: Bytes,
    bytes: usize,
    line: usize,
}

impl Lines {
    fn new(body: Body, limits: BodyLimits) -> Self {
        Self { body, limits, chunk: Bytes::new(), bytes: 0, line: 0 }
    }

    /// The next non-blank line. The time limit applies to its arrival, not to the processing between lines.
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

    /// Receives the next part of the body; false at its end.
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

    /// Reads and discards the rest of the body, within limits: a client that is still sending would see a broken
    /// connection instead of the answer.
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
