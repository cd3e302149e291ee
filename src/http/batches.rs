//! `/v1/structures/{id}/batches`: posts and reads batches. [`super::bulk`] takes many batches at once.

use axum::body::Body;
use axum::extract::State;
use axum::http::{header, HeaderMap, HeaderName, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use utoipa::IntoParams;

use super::access::Client;
use super::answer;
use super::bulk;
use super::error::ApiError;
use super::openapi::{BatchPath, BodyRefused, Busy, Invalid, StructurePath, Unknown};
use super::problem::BulkAnswer;
use super::request::{media_type, read_body, structure_id, unsupported_media_type, ApiPath, ApiQuery, IDEMPOTENCY_KEY};
use super::shared::Shared;
use super::tables::{self, PostQuery, Posted, PARSED_HERE_BYTES};
use super::upload::{TableForm, FORM};
use crate::measurement::body::{MessageBody, PostBody, RawBatch};
use crate::measurement::check::check_idempotency_key;
use crate::monitor::FoundBatch;

/// Header that marks a batch as already stored.
const IDEMPOTENCY_REPLAYED: HeaderName = HeaderName::from_static("idempotency-replayed");

/// Headers of a post.
#[derive(IntoParams)]
#[into_params(parameter_in = Header)]
#[expect(dead_code, reason = "only its description is used")]
struct PostHeaders {
    /// Key that the client chose for the batch. Not allowed with NDJSON, where each line has its own. With `split`, the key of each
    /// batch is derived from it.
    #[param(rename = "Idempotency-Key", min_length = 1, max_length = 128, pattern = "^[!-~]+$")]
    idempotency_key: Option<String>,
}

/// `POST /v1/structures/{id}/batches`: 201 with the assessment, or 200 with the outcome of each line of NDJSON.
///
/// # Errors
/// 400, 413, 415 and 422 for the body, 403 for a source to which the token is not limited, 404 for the structure, 429 if the rate limit of measurements is exceeded, 503
/// when the queue is full.
#[utoipa::path(
    post, path = "/v1/structures/{id}/batches", tag = "batches", operation_id = "post_batches",
    summary = "Post measurements",
    description = "One batch as JSON or CSV: it is written to disk before it is assessed, and the answer contains the assessment. \
                   Many batches as NDJSON with one batch per line, or as a CSV that `split` cuts by time: each is stored \
                   independently, a refused one does not stop the others, and the answer (200) lists the outcome of every one. Repeating a post is safe: a batch is \
                   recognised by structure, source and `Idempotency-Key`, a measurement by structure, source and time. A token that is limited to one \
                   source posts under it without naming it.",
    params(StructurePath, PostQuery, PostHeaders),
    request_body(
        description = "CSV: a header with `measured_at`, `f1_hz` …, optionally `std_f1_hz` …, covariates by name and \
                       `set_<parameter>`; separator `,`, `;` or tab, decimal comma with the last two. Headers such as `date` and \
                       `Mode 1 (Hz)` and times such as `01.03.2026 12:00` are read too, and `table` in the answer says how. A CSV \
                       that spans more than 48 h needs `split`.",
        content(
            (PostBody = "application/json", example = json!({"source": "tower-1", "measurements": [
                {"measured_at": "2026-03-01T12:00:00Z", "frequencies_hz": [0.4949, 0.9250, 1.2434]}]})),
            (MessageBody = "application/x-ndjson", example = json!(
                "{\"source\":\"tower-1\",\"measurements\":[{\"measured_at\":\"2026-03-01T12:20:00Z\",\
                 \"frequencies_hz\":[0.4949,0.9250,1.2434]}]}\n")),
            (String = "text/csv", example = json!(
                "measured_at,f1_hz,f2_hz,f3_hz\n2026-03-01T12:10:00Z,0.4949,0.9250,1.2434\n")),
            (TableForm = "multipart/form-data", example = json!({"file": "date,f1,f2,f3\n2026-03-01T12:40:00Z,0.4949,0.9250,1.2434\n"}))
        )
    ),
    responses(
        (status = 200, description = "NDJSON, or a CSV with `split`: the outcome of each batch", body = BulkAnswer),
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
    query.check_source()?;
    let kind = media_type(&headers);
    if kind.as_deref() == Some("application/x-ndjson") {
        return bulk::create(&shared, &client, (id, query.source), &headers, body).await;
    }
    let key = idempotency_key(&headers)?;
    let monitor = shared.monitor.clone();
    let (batch, table) = match kind.as_deref() {
        Some("text/csv" | FORM) => {
            let posted = Posted::receive((&shared, &client), active, query, key, (&headers, body)).await?;
            if posted.is_cut() {
                return tables::create(&shared, &client, posted).await;
            }
            let (batch, table) =
                tables::read_in_turn(&shared, posted, move |posted| posted.one_batch(&monitor)).await??;
            (batch, Some(table))
        }
        Some("application/json") => {
            let bytes = read_body(body, &headers, shared.limits).await?;
            let (small, sender) = (bytes.len() <= PARSED_HERE_BYTES, client.clone());
            let parse = move || {
                let mut raw = RawBatch::of_post(&bytes, key)?;
                raw.source = raw.source.or(query.source);
                monitor.ingest().check(&active, sender.posts(raw)?).map_err(ApiError::invalid_input)
            };
            (here_or_aside(small, parse).await?, None)
        }
        other => {
            read_body(body, &headers, shared.limits).await?;
            let allowed = "application/json, text/csv, multipart/form-data or application/x-ndjson";
            return Err(unsupported_media_type(other, allowed));
        }
    };
    shared.access.take_measurements(&client, batch.measurements.len())?;
    let ingested = shared.monitor.ingest().take(batch).await?;

    let location = answer::location(&ingested.view.record);
    let body = answer::Batch::new(ingested.view, false).of_table(table);
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
    summary = "A batch", description = "The batch with its measurements and its current assessment. A batch of which a row cannot be read \
                                        has the state `failed` and the reason, and neither of the two.",
    params(BatchPath),
    responses((status = 200, description = "The batch", body = answer::Batch), Unknown, Invalid)
)]
pub async fn read(
    State(shared): State<Shared>,
    ApiPath((id, batch)): ApiPath<(String, String)>,
) -> Result<Response, ApiError> {
    let found = shared.monitor.records().found_batch(&structure_id(&id)?, &batch).await?;
    let body = match found {
        FoundBatch::Whole(view) => answer::Batch::new(*view, true),
        FoundBatch::Header(header, unreadable) => answer::Batch::of_header(*header, unreadable),
    };
    Ok(Json(body).into_response())
}

fn idempotency_key(headers: &HeaderMap) -> Result<Option<String>, ApiError> {
    let Some(value) = headers.get(IDEMPOTENCY_KEY) else {
        return Ok(None);
    };
    let key = String::from_utf8_lossy(value.as_bytes()).into_owned();
    check_idempotency_key(&key).map_err(|problem| ApiError::invalid_input(vec![problem]))?;
    Ok(Some(key))
}

/// Parses a small body at once, and a large one on a blocking thread. Without an await before the batch is stored, a small one is
/// stored even if the client disconnects right after sending it.
async fn here_or_aside<T: Send + 'static>(
    small: bool,
    parse: impl FnOnce() -> Result<T, ApiError> + Send + 'static,
) -> Result<T, ApiError> {
    if small {
        return parse();
    }
    tokio::task::spawn_blocking(parse).await.map_err(|e| ApiError::internal(&e))?
}
