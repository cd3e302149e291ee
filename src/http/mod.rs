//! The door for programs: routes, and what each request passes on its way.

mod alarms;
mod answer;
mod batches;
mod diagnoses;
mod error;
mod history;
mod operations;
mod request;
pub mod server;
mod structures;

use std::sync::Arc;
use std::time::Duration;

use axum::extract::DefaultBodyLimit;
use axum::http::StatusCode;
use axum::response::{IntoResponse as _, Response};
use axum::routing::{delete, get, post};
use axum::{middleware, Router};
use metrics_exporter_prometheus::PrometheusHandle;
use serde::{Deserialize, Serialize};
use tower_http::catch_panic::CatchPanicLayer;

use crate::monitor::Monitor;
use error::ApiError;
use request::BodyLimits;

/// Limits of the service towards its clients.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HttpSettings {
    /// Address and port; port 0 takes a free one.
    pub listen: String,
    /// Most bytes of a body.
    pub max_body_bytes: usize,
    /// Longest time for a request's header, seconds.
    pub header_timeout_s: u64,
    /// Longest time for a request's body, seconds.
    pub body_timeout_s: u64,
    /// Most connections at a time; further ones wait to be accepted.
    pub max_connections: usize,
    /// Longest time open requests get to end when the service stops, seconds.
    pub drain_s: u64,
}

impl Default for HttpSettings {
    fn default() -> Self {
        Self {
            listen: "127.0.0.1:8080".to_owned(),
            max_body_bytes: 4 << 20,
            header_timeout_s: 10,
            body_timeout_s: 30,
            max_connections: 1_024,
            drain_s: 30,
        }
    }
}

/// What every handler has at hand.
#[derive(Clone)]
pub struct Shared {
    monitor: Monitor,
    metrics: Arc<PrometheusHandle>,
    limits: BodyLimits,
}

/// All routes of the service.
pub fn router(monitor: Monitor, metrics: PrometheusHandle, settings: &HttpSettings) -> Router {
    let limits = BodyLimits { bytes: settings.max_body_bytes, time: Duration::from_secs(settings.body_timeout_s) };
    let shared = Shared { monitor, metrics: Arc::new(metrics), limits };
    Router::new()
        .route("/v1/structures", get(structures::list))
        .route("/v1/structures/{id}", get(structures::read).put(structures::put))
        .route("/v1/structures/{id}/batches", post(batches::create))
        .route("/v1/structures/{id}/batches/{batch}", get(batches::read))
        .route("/v1/structures/{id}/history", get(history::history))
        .route("/v1/structures/{id}/baseline", post(history::declare_baseline))
        .route("/v1/structures/{id}/exceedances", get(history::exceedances))
        .route("/v1/structures/{id}/alarms", get(alarms::list))
        .route("/v1/structures/{id}/alarms/{alarm}/acknowledgement", post(alarms::acknowledge))
        .route("/v1/structures/{id}/charts", get(alarms::charts))
        .route("/v1/structures/{id}/maintenance", get(alarms::maintenance).post(alarms::add_maintenance))
        .route("/v1/structures/{id}/identifiability", get(alarms::identifiability))
        .route("/v1/structures/{id}/diagnoses", get(diagnoses::list).post(diagnoses::create))
        .route("/v1/structures/{id}/extension", delete(diagnoses::step_back))
        .route("/v1/diagnoses/{id}", get(diagnoses::read))
        .route("/v1/diagnoses/{id}/report", get(diagnoses::report))
        .route("/v1/diagnoses/{id}/extension", post(diagnoses::extend))
        .route("/healthz", get(operations::health))
        .route("/readyz", get(operations::ready))
        .route("/metrics", get(operations::metrics))
        .route("/version", get(operations::version))
        .method_not_allowed_fallback(method_not_allowed)
        .fallback(not_found)
        // Bodies are read by `request::read_body`, which has its own limit and its own error.
        .layer(DefaultBodyLimit::disable())
        .layer(CatchPanicLayer::custom(panicked))
        .layer(middleware::from_fn(request::with_id_and_log))
        .with_state(shared)
}

async fn not_found() -> ApiError {
    ApiError::new(StatusCode::NOT_FOUND, "unknown_route", "there is nothing at this path; README lists the routes")
}

async fn method_not_allowed() -> ApiError {
    ApiError::new(StatusCode::METHOD_NOT_ALLOWED, "method_not_allowed", "this path does not take this method")
}

#[expect(clippy::needless_pass_by_value, reason = "the shape that CatchPanicLayer takes")]
fn panicked(panic: Box<dyn std::any::Any + Send + 'static>) -> Response {
    let cause = panic.downcast_ref::<&str>().map(ToString::to_string);
    let cause = cause.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_else(|| "a panic".to_owned());
    ApiError::internal(&cause).into_response()
}
