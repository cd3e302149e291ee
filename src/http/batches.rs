//! `/v1/structures/{id}/batches`: post and read.

use std::collections::BTreeMap;

use axum::body::{Body, Bytes};
use axum::extract::State;
use axum::http::{header, HeaderMap, HeaderName, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::Deserialize;

use super::answer;
use super::error::ApiError;
use super::request::{media_type, parse_json, read_body, structure_id, unsupported_media_type, ApiPath, ApiQuery};
use super::Shared;
use crate::measurement::check::{
    check_idempotency_key, check_measurements, check_source, Place, Problem, RawMeasurement,
};
use crate::measurement::csv::{self, CsvOptions, Times};
use crate::measurement::{CovariateValue, MeasurementBatch, ModalMeasurement};
use crate::monitor::{MissingCovariate, Monitor, Watched};
use crate::quantity::StructureId;

/// The client's own key for a batch.
const IDEMPOTENCY_KEY: HeaderName = HeaderName::from_static("idempotency-key");
/// Says that this batch had been posted before.
const IDEMPOTENCY_REPLAYED: HeaderName = HeaderName::from_static("idempotency-replayed");

/// Source of a batch that names none.
const DEFAULT_SOURCE: &str = "default";

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct BatchBody {
    source: Option<String>,
    measurements: Vec<MeasurementBody>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct MeasurementBody {
    measured_at: Option<String>,
    frequencies_hz: Vec<Option<f64>>,
    std_hz: Option<Vec<Option<f64>>>,
    #[serde(default)]
    covariates: BTreeMap<String, CovariateValue>,
    #[serde(default)]
    settings: BTreeMap<String, f64>,
}

/// Query of a post; for CSV, which has no place for a source.
#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PostQuery {
    source: Option<String>,
    /// Columns of a CSV that are not read, separated by commas.
    ignore: Option<String>,
}

/// `POST /v1/structures/{id}/batches`: 201 with the assessment; the batch is on disk before.
///
/// # Errors
/// 400, 413, 415 and 422 for the body, 404 for the structure, 503 when the queue is full.
pub async fn create(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    ApiQuery(query): ApiQuery<PostQuery>,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    let watched = shared.monitor.structure(&id)?;
    let key = idempotency_key(&headers)?;
    let bytes = read_body(body, &headers, shared.limits).await?;
    let kind = media_type(&headers);
    let monitor = shared.monitor.clone();
    // A body of thousands of measurements takes milliseconds to parse: not on an async thread.
    let parse = move || parse_batch(&monitor, &watched, id, key, kind.as_deref(), &bytes, query);
    let batch = tokio::task::spawn_blocking(parse).await.map_err(|e| ApiError::internal(&e))??;
    let ingested = shared.monitor.ingest(batch).await?;

    let body = answer::Batch::new(ingested.view, false);
    let location = body.location();
    let mut response = (StatusCode::CREATED, [(header::LOCATION, location)], Json(body)).into_response();
    if ingested.replayed {
        response.headers_mut().insert(IDEMPOTENCY_REPLAYED, header::HeaderValue::from_static("true"));
    }
    Ok(response)
}

/// `GET /v1/structures/{id}/batches/{batch}`: measurements and current assessment.
///
/// # Errors
/// 404.
pub async fn read(
    State(shared): State<Shared>,
    ApiPath((id, batch)): ApiPath<(String, String)>,
) -> Result<Response, ApiError> {
    let view = shared.monitor.batch(&structure_id(&id)?, &batch).await?;
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
    watched: &Watched,
    structure: StructureId,
    idempotency_key: Option<String>,
    kind: Option<&str>,
    bytes: &Bytes,
    query: PostQuery,
) -> Result<MeasurementBatch, ApiError> {
    let (source, raw) = match kind {
        Some("application/json") => from_json(bytes)?,
        Some("text/csv") => {
            let ignore = query.ignore.as_deref().unwrap_or_default().split(',').map(|c| c.trim().to_owned());
            let ignore = ignore.filter(|column| !column.is_empty()).collect();
            let options = CsvOptions { times: Times::Required, ignore, time_column: None };
            let simulator = &watched.simulator;
            let raw = csv::read(bytes, simulator.modes(), simulator.covariates(), &options);
            (None, raw.map_err(ApiError::invalid_input)?)
        }
        other => return Err(unsupported_media_type(other, "application/json or text/csv")),
    };
    let source = source.or(query.source).unwrap_or_else(|| DEFAULT_SOURCE.to_owned());
    check_source(&source).map_err(|problem| ApiError::invalid_input(vec![problem]))?;
    let places: Vec<Place> = raw.iter().map(|r| r.place).collect();
    let measurements = check_measurements(raw, &monitor.expectation(watched)).map_err(ApiError::invalid_input)?;
    if monitor.settings().missing_covariate == MissingCovariate::Refuse {
        let missing = |(m, place): (&ModalMeasurement, &Place)| {
            let missing = watched.simulator.effect_sizes(&m.covariates).missing;
            missing
                .into_iter()
                .map(|name| {
                    let message = format!("{name} is missing: the simulation of this structure depends on it");
                    Problem::new(place.of_covariate(&name), message)
                })
                .collect::<Vec<_>>()
        };
        let problems: Vec<Problem> = measurements.iter().zip(&places).flat_map(missing).take(20).collect();
        if !problems.is_empty() {
            return Err(ApiError::invalid_input(problems));
        }
    }
    Ok(MeasurementBatch { structure, source, idempotency_key, measurements })
}

fn from_json(bytes: &[u8]) -> Result<(Option<String>, Vec<RawMeasurement>), ApiError> {
    let body: BatchBody = parse_json(bytes)?;
    let raw = |(index, m): (usize, MeasurementBody)| RawMeasurement {
        place: Place::Json { index },
        measured_at: m.measured_at,
        frequencies_hz: m.frequencies_hz,
        std_hz: m.std_hz,
        covariates: m.covariates,
        settings: m.settings,
    };
    Ok((body.source, body.measurements.into_iter().enumerate().map(raw).collect()))
}
