//! `/healthz /readyz /metrics /version`: for those who run the service.

use axum::extract::State;
use axum::http::{header, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::Serialize;

use super::Shared;
use crate::baseline::library::Refusal;

#[derive(Debug, Serialize)]
struct Readiness {
    ready: bool,
    /// Why not; empty when ready.
    reasons: Vec<String>,
    baselines_in_use: usize,
    baselines_refused: Vec<Refusal>,
    free_places_in_queue: usize,
}

/// `GET /healthz`: the process answers. No look at the database, so that a slow disk does not get it killed.
pub async fn health() -> Response {
    Json(serde_json::json!({ "status": "alive" })).into_response()
}

/// `GET /readyz`: 200 when batches can be stored and assessed, else 503 with the reasons.
pub async fn ready(State(shared): State<Shared>) -> Response {
    let mut reasons = Vec::new();
    if let Err(error) = shared.monitor.store().is_writable().await {
        reasons.push(format!("the database cannot be written: {error}"));
    }
    let baselines_in_use = shared.monitor.baselines_in_use();
    if baselines_in_use == 0 {
        reasons.push("no trained baseline is in use".to_owned());
    }
    let readiness = Readiness {
        ready: reasons.is_empty(),
        reasons,
        baselines_in_use,
        baselines_refused: shared.monitor.refusals().to_vec(),
        free_places_in_queue: shared.monitor.free_places(),
    };
    let status = if readiness.ready { StatusCode::OK } else { StatusCode::SERVICE_UNAVAILABLE };
    (status, Json(readiness)).into_response()
}

/// `GET /metrics`: Prometheus text.
pub async fn metrics(State(shared): State<Shared>) -> Response {
    metrics::gauge!("modalwatch_queue_free_places").set(shared.monitor.free_places() as f64);
    metrics::gauge!("modalwatch_baselines_in_use").set(shared.monitor.baselines_in_use() as f64);
    let text = shared.metrics.render();
    ([(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], text).into_response()
}

/// `GET /version`: program and SQLite.
pub async fn version(State(shared): State<Shared>) -> Response {
    Json(serde_json::json!({
        "name": env!("CARGO_PKG_NAME"),
        "version": env!("CARGO_PKG_VERSION"),
        "sqlite_version": shared.monitor.store().sqlite_version(),
        "manifest_format": crate::baseline::manifest::FORMAT,
    }))
    .into_response()
}
