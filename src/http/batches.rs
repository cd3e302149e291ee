//! `/v1/structures/{id}/batches`: post and read; many at once in [`super::bulk`].

use axum::body::{Body, Bytes};
use axum::extract::State;
use axum::http::{header, HeaderMap, HeaderName, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::Deserialize;
use utoipa::IntoParams;

use super::access::Client;
use super::bulk::{self, BulkAnswer};
use super::error::ApiError;
use super::openapi::{BatchPath, BodyRefused, Busy, Invalid, StructurePath, Unknown};
use super::request::{media_type, read_body, structure_id, unsupported_media_type, ApiPath, ApiQuery};
use super::{answer, Shared};
use crate::measurement::body::{MessageBody, PostBody, RawBatch};
use crate::measurement::check::{check_idempotency_key, check_source};
use crate::measurement::csv::{self, CsvOptions, Times};
use crate::measurement::MeasurementBatch;
use crate::monitor::{ActiveStructure, Monitor};

/// The client's own key for a batch.
pub const IDEMPOTENCY_KEY: HeaderName = HeaderName::from_static("idempotency-key");
/// Says that this batch had been posted before.
const IDEMPOTENCY_REPLAYED: HeaderName = HeaderName::from_static("idempotency-replayed");

/// Most bytes of a body that are parsed where they were read, in some tenth of a millisecond at most: thousands of measurements take
/// milliseconds, which are not for an async thread.
const PARSED_HERE_BYTES: usize = 16 * 1024;

/// Query of a post; for CSV and NDJSON, which have no place for a common source.
#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct PostQuery {
    /// Instrument, gateway or campaign, unless the body names one.
    #[param(min_length = 1, max_length = 64, pattern = "^[A-Za-z0-9_.:-]+$")]
    source: Option<String>,
    /// Columns of a CSV that are not read, separated by commas.
    ignore: Option<String>,
}

/// Headers of a post.
#[derive(IntoParams)]
#[into_params(parameter_in = Header)]
#[expect(dead_code, reason = "only its description is used")]
struct PostHeaders {
    /// The client's own key for the batch; not for NDJSON, whose lines have their own.
    #[param(rename = "Idempotency-Key", min_length = 1, max_length = 128, pattern = "^[!-~]+$")]
    idempotency_key: Option<String>,
}

/// `POST /v1/structures/{id}/batches`: 201 with the assessment, or 200 with what became of each line of NDJSON.
///
/// # Errors
/// 400, 413, 415 and 422 for the body, 404 for the structure, 429 beyond the measurements a second
/// of `http.rate_limit`, 503 when the queue is full.
#[utoipa::path(
    post, path = "/v1/structures/{id}/batches", tag = "batches", operation_id = "post_batches",
    summary = "Post measurements",
    description = "One batch as JSON or CSV: it is on disk before it is assessed, and the assessment comes with the answer. \
                   Many batches as NDJSON, one a line: each is stored by itself, a line that is refused does not stop the \
                   others, and the answer (200) tells of each in its place. What was posted before is not stored again: a \
                   batch is known by `Idempotency-Key`, a measurement by structure, source and time.",
    params(StructurePath, PostQuery, PostHeaders),
    request_body(
        description = "CSV: a header with `measured_at`, `f1_hz` …, optionally `std_f1_hz` …, covariates by name and \
                       `set_<parameter>`; separator `,`, `;` or tab, decimal comma with the last two. Mode shapes come as JSON only.",
        content(
            (PostBody = "application/json", example = json!({"source": "tower-1", "measurements": [
                {"measured_at": "2026-03-01T12:00:00Z", "frequencies_hz": [0.4949, 0.9250, 1.2434]}]})),
            (MessageBody = "application/x-ndjson", example = json!(
                "{\"source\":\"tower-1\",\"measurements\":[{\"measured_at\":\"2026-03-01T12:20:00Z\",\
                 \"frequencies_hz\":[0.4949,0.9250,1.2434]}]}\n")),
            (String = "text/csv", example = json!(
                "measured_at,f1_hz,f2_hz,f3_hz\n2026-03-01T12:10:00Z,0.4949,0.9250,1.2434\n"))
        )
    ),
    responses(
        (status = 200, description = "NDJSON: what became of each line", body = BulkAnswer),
        (status = 201, description = "The batch with its assessment", body = answer::Batch, headers(
            ("Location" = String, description = "Path of the batch"),
            ("Idempotency-Replayed" = String, description = "`true` when it had been posted before")
        )),
        Unknown, BodyRefused, Busy
    )
)]
pub async fn create(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    ApiQuery(query): ApiQuery<PostQuery>,
    client: Client,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    let active = shared.monitor.structure(&id)?;
    if let Some(source) = &query.source {
        let in_query = |problem| ApiError::invalid_input(vec![problem]).at("query/source");
        check_source(source).map_err(in_query)?;
    }
    let kind = media_type(&headers);
    if kind.as_deref() == Some("application/x-ndjson") {
        return bulk::create(&shared, &client, (id, query.source), &headers, body).await;
    }
    let key = idempotency_key(&headers)?;
    let bytes = read_body(body, &headers, shared.limits).await?;
    let monitor = shared.monitor.clone();
    let small = bytes.len() <= PARSED_HERE_BYTES;
    let parse = move || parse_batch(&monitor, &active, key, kind.as_deref(), &bytes, query);
    let batch = if small {
        // Without a wait up to where it is stored: also when the client is gone as soon as all was sent.
        parse()?
    } else {
        tokio::task::spawn_blocking(parse).await.map_err(|e| ApiError::internal(&e))??
    };
    shared.access.take_measurements(&client, batch.measurements.len())?;
    let ingested = shared.monitor.ingest().take(batch).await?;

    let location = answer::location(&ingested.view.record);
    let body = answer::Batch::new(ingested.view, false);
    let mut response = (StatusCode::CREATED, [(header::LOCATION, location)], Json(body)).into_response();
    if ingested.replayed {
        response.headers_mut().insert(IDEMPOTENCY_REPLAYED, header::HeaderValue::from_static("true"));
    }
    Ok(response)
}

/// `GET /v1/structures/{id}/batches/{batch}`.
///
/// # Errors
/// 404.
#[utoipa::path(
    get, path = "/v1/structures/{id}/batches/{batch}", tag = "batches", operation_id = "read_batch",
    summary = "A batch", description = "The batch with its measurements and its current assessment.",
    params(BatchPath),
    responses((status = 200, description = "The batch", body = answer::Batch), Unknown, Invalid)
)]
pub async fn read(
    State(shared): State<Shared>,
    ApiPath((id, batch)): ApiPath<(String, String)>,
) -> Result<Response, ApiError> {
    let view = shared.monitor.records().batch(&structure_id(&id)?, &batch).await?;
    Ok(Json(answer::Batch::new(view, true)).into_response())
}

fn idempotency_key(headers: &HeaderMap) -> Result<Option<String>, ApiError> {
    let Some(value) = headers.get(IDEMPOTENCY_KEY) else {
        return Ok(None);
    };
    let key = String::from_utf8_lossy(value.as_bytes()).into_owned();
    check_idempotency_key(&key).map_err(|problem| ApiError::invalid_input(vec![problem]))?;
    Ok(Some(key))
}

fn parse_batch(
    monitor: &Monitor,
    active: &ActiveStructure,
    idempotency_key: Option<String>,
    kind: Option<&str>,
    bytes: &Bytes,
    query: PostQuery,
) -> Result<MeasurementBatch, ApiError> {
    let mut raw = match kind {
        Some("application/json") => RawBatch::of_post(bytes, idempotency_key)?,
        Some("text/csv") => {
            let ignore = query.ignore.as_deref().unwrap_or_default().split(',').map(|c| c.trim().to_owned());
            let ignore = ignore.filter(|column| !column.is_empty()).collect();
            let options = CsvOptions { times: Times::Required, ignore, time_column: None };
            let simulator = &active.simulator;
            let read = csv::read(bytes, simulator.modes(), simulator.covariates(), &options);
            RawBatch { source: None, idempotency_key, measurements: read.map_err(ApiError::invalid_input)? }
        }
        other => return Err(unsupported_media_type(other, "application/json, text/csv or application/x-ndjson")),
    };
    raw.source = raw.source.or(query.source);
    monitor.ingest().check(active, raw).map_err(ApiError::invalid_input)
}
