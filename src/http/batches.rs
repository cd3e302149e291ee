//! `/v1/structures/{id}/batches`: posts and reads batches. [`super::bulk`] takes many batches at once.

use axum::body::{Body, Bytes};
use axum::extract::State;
use axum::http::{header, HeaderMap, HeaderName, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::Deserialize;
use utoipa::IntoParams;

use super::access::Client;
use super::answer;
use super::bulk;
use super::error::ApiError;
use super::openapi::{BatchPath, BodyRefused, Busy, Invalid, StructurePath, Unknown};
use super::problem::BulkAnswer;
use super::request::{media_type, read_body, structure_id, unsupported_media_type, ApiPath, ApiQuery, IDEMPOTENCY_KEY};
use super::shared::Shared;
use crate::measurement::body::{MessageBody, PostBody, RawBatch};
use crate::measurement::check::{check_idempotency_key, check_source};
use crate::measurement::csv::{self, CsvOptions, Times};
use crate::measurement::times::read_dates;
use crate::measurement::MeasurementBatch;
use crate::monitor::{ActiveStructure, Monitor};

/// Header that marks a batch as already stored.
const IDEMPOTENCY_REPLAYED: HeaderName = HeaderName::from_static("idempotency-replayed");

/// Larger bodies are parsed on a blocking thread: thousands of measurements take milliseconds. A body of this size
/// takes about 0.1 ms.
const PARSED_HERE_BYTES: usize = 16 * 1024;

/// Query of a post. CSV and NDJSON have no field for a common source.
#[derive(Debug, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct PostQuery {
    /// Instrument, gateway or campaign; used where the body does not name one.
    #[param(min_length = 1, max_length = 64, pattern = "^[A-Za-z0-9_.:-]+$")]
    source: Option<String>,
    /// CSV columns to ignore, separated by commas.
    ignore: Option<String>,
    /// Unit of the times of a CSV that are numbers: Unix `seconds` or `milliseconds`, `serial-days` of a spreadsheet, or `decimal-year`.
    #[param(pattern = "^(seconds|milliseconds|serial-days|decimal-year)$")]
    time_unit: Option<String>,
}

/// Headers of a post.
#[derive(IntoParams)]
#[into_params(parameter_in = Header)]
#[expect(dead_code, reason = "only its description is used")]
struct PostHeaders {
    /// Key that the client chose for the batch. Not allowed with NDJSON, where each line has its own.
    #[param(rename = "Idempotency-Key", min_length = 1, max_length = 128, pattern = "^[!-~]+$")]
    idempotency_key: Option<String>,
}

/// `POST /v1/structures/{id}/batches`: 201 with the assessment, or 200 with the outcome of each line of NDJSON.
///
/// # Errors
/// 400, 413, 415 and 422 for the body, 404 for the structure, 429 if the rate limit of measurements is exceeded, 503
/// when the queue is full.
#[utoipa::path(
    post, path = "/v1/structures/{id}/batches", tag = "batches", operation_id = "post_batches",
    summary = "Post measurements",
    description = "One batch as JSON or CSV: it is written to disk before it is assessed, and the answer contains the assessment. \
                   Many batches as NDJSON with one batch per line: each line is stored independently, a refused line does not stop \
                   the others, and the answer (200) lists the outcome of every line. Repeating a post is safe: a batch is \
                   recognised by `Idempotency-Key`, a measurement by structure, source and time.",
    params(StructurePath, PostQuery, PostHeaders),
    request_body(
        description = "CSV: a header with `measured_at`, `f1_hz` …, optionally `std_f1_hz` …, covariates by name and \
                       `set_<parameter>`; separator `,`, `;` or tab, decimal comma with the last two. Mode shapes can be sent as JSON only.",
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
        (status = 200, description = "NDJSON: the outcome of each line", body = BulkAnswer),
        (status = 201, description = "The batch with its assessment", body = answer::Batch, headers(
            ("Location" = String, description = "Path of the batch"),
            ("Idempotency-Replayed" = String, description = "`true` if the batch was already stored")
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
        // Without an await before the batch is stored, it is stored even if the client disconnects right after sending
        // it.
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
            let simulator = &active.simulator;
            let points = simulator.instrumented_points().map_or_else(Vec::new, |points| points.names.clone());
            let options = CsvOptions { times: Times::Required, ignore, points, ..CsvOptions::default() };
            let read = csv::read(bytes, simulator.modes(), simulator.covariates(), &options);
            let mut measurements = read.map_err(ApiError::invalid_input)?;
            if let Some(unit) = query.time_unit {
                let unit =
                    unit.parse().map_err(|message: String| ApiError::invalid_field("query/time_unit", message))?;
                read_dates(&mut measurements, unit).map_err(ApiError::invalid_input)?;
            }
            RawBatch { source: None, idempotency_key, measurements }
        }
        other => return Err(unsupported_media_type(other, "application/json, text/csv or application/x-ndjson")),
    };
    raw.source = raw.source.or(query.source);
    monitor.ingest().check(active, raw).map_err(ApiError::invalid_input)
}
