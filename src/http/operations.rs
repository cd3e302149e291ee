//! `/healthz /readyz /metrics /version`: for those who run the service.

use axum::extract::State;
use axum::http::{header, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::Serialize;
use tracing::error;
use utoipa::ToSchema;

use super::Shared;
use crate::baseline::library::Refusal;
use crate::monitor::Health;
use crate::store::Store;

/// The process answers.
#[derive(Debug, Serialize, ToSchema)]
struct Alive {
    /// `alive`.
    status: &'static str,
}

/// Program and SQLite.
#[derive(Debug, Serialize, ToSchema)]
struct Version {
    name: &'static str,
    version: &'static str,
    sqlite_version: String,
    /// Migrations of the database.
    schema_version: i64,
    /// Layout of the manifests of trained baselines.
    manifest_format: u32,
}

/// Whether batches can be stored and assessed.
#[derive(Debug, Serialize, ToSchema)]
struct Readiness {
    /// Ready or not, why not, and what is degraded.
    #[serde(flatten)]
    health: Health,
    baselines_in_use: usize,
    baselines_refused: Vec<Refusal>,
    free_places_in_queue: usize,
}

/// `GET /healthz`: the process answers. No look at the database, so that a slow disk does not get it killed.
#[utoipa::path(
    get, path = "/healthz", tag = "operations", operation_id = "health",
    summary = "Alive?", description = "The process answers; without a look at the database.",
    responses((status = 200, description = "It does", body = Alive))
)]
pub async fn health() -> Response {
    Json(Alive { status: "alive" }).into_response()
}

/// `GET /readyz`: 200 when batches can be stored and assessed, else 503 with the reasons.
#[utoipa::path(
    get, path = "/readyz", tag = "operations", operation_id = "ready",
    summary = "Ready?", description = "Batches can be stored and assessed.",
    responses(
        (status = 200, description = "Ready", body = Readiness),
        (status = 503, description = "Not ready; `reasons` says why", body = Readiness)
    )
)]
pub async fn ready(State(shared): State<Shared>) -> Response {
    let health = shared.monitor.upkeep().health().await;
    metrics::gauge!("modalwatch_ready").set(f64::from(u8::from(health.ready)));
    metrics::gauge!("modalwatch_findings").set(health.findings.len() as f64);
    let status = if health.ready { StatusCode::OK } else { StatusCode::SERVICE_UNAVAILABLE };
    let readiness = Readiness {
        health,
        baselines_in_use: shared.monitor.upkeep().baselines_in_use(),
        baselines_refused: shared.monitor.structures().library().refusals().to_vec(),
        free_places_in_queue: shared.monitor.upkeep().free_places(),
    };
    (status, Json(readiness)).into_response()
}

/// `GET /metrics`: Prometheus text. Whether the service is ready is asked anew for it: a scraper knows without a probe.
///
/// It answers with a database that cannot be read too: that is when it is looked at.
#[utoipa::path(
    get, path = "/metrics", tag = "operations", operation_id = "metrics",
    summary = "Metrics", description = "For Prometheus.",
    responses((status = 200, description = "Prometheus text", body = String, content_type = "text/plain"))
)]
pub async fn metrics(State(shared): State<Shared>) -> Response {
    let health = shared.monitor.upkeep().health().await;
    metrics::gauge!("modalwatch_ready").set(f64::from(u8::from(health.ready)));
    metrics::gauge!("modalwatch_findings").set(health.findings.len() as f64);
    if let Err(failure) = shared.monitor.upkeep().set_gauges().await {
        error!(error = %failure, "Could not count what is stored: {failure}");
    }
    let text = shared.metrics.render();
    ([(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], text).into_response()
}

/// `GET /version`: program and SQLite.
#[utoipa::path(
    get, path = "/version", tag = "operations", operation_id = "version",
    summary = "Version", description = "Of the program and its SQLite.",
    responses((status = 200, description = "The versions", body = Version))
)]
pub async fn version(State(shared): State<Shared>) -> Response {
    let version = Version {
        name: env!("CARGO_PKG_NAME"),
        version: env!("CARGO_PKG_VERSION"),
        sqlite_version: shared.monitor.store().file().sqlite_version().to_owned(),
        schema_version: schema_version(),
        manifest_format: crate::baseline::manifest::FORMAT,
    };
    Json(version).into_response()
}
