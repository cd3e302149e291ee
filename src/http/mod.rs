//! The door for programs: routes, and what each request passes on its way.
//!
//! `openapi` says how a route is added.

pub mod access;
mod alarms;
mod answer;
mod batches;
mod bulk;
mod dashboard;
mod diagnoses;
mod docs;
mod error;
mod events;
mod explorer;
mod export;
mod history;
mod openapi;
mod operations;
#[cfg(feature = "parquet")]
mod parquet;
mod quarantine;
mod request;
mod safekeeping;
mod series;
pub mod server;
mod structures;
mod table;
#[cfg(test)]
mod tests;
#[cfg(feature = "otel")]
mod traceparent;
mod views;
mod webhooks;

use std::sync::Arc;
use std::time::Duration;

use axum::extract::DefaultBodyLimit;
use axum::http::StatusCode;
use axum::response::{IntoResponse as _, Response};
use axum::routing::get;
use axum::{middleware, Router};
use metrics_exporter_prometheus::PrometheusHandle;
use serde::{Deserialize, Serialize};
use tokio::sync::Semaphore;
use tower_http::catch_panic::CatchPanicLayer;
use utoipa::OpenApi as _;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::monitor::Monitor;
use crate::notify::Notifier;
use access::{AccessControl, RateLimitSettings};
use error::ApiError;
use request::BodyLimits;

/// Limits of the service towards its clients.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct HttpSettings {
    /// Address and port; port 0 takes a free one.
    pub listen: String,
    /// Most bytes of a body; of NDJSON, those of a line.
    pub max_body_bytes: usize,
    /// Most bytes of NDJSON.
    pub max_bulk_bytes: usize,
    /// Longest time for a request's header, seconds.
    pub header_timeout_s: u64,
    /// Longest time for a request's body, seconds.
    pub body_timeout_s: u64,
    /// Most connections at a time; further ones wait to be accepted.
    pub max_connections: usize,
    /// Longest time open requests get to end when the service stops, seconds.
    pub drain_s: u64,
    /// Addresses and networks of proxies whose `X-Forwarded-For` is believed.
    pub trusted_proxies: Vec<String>,
    /// How much one client may ask for.
    pub rate_limit: RateLimitSettings,
}

impl Default for HttpSettings {
    fn default() -> Self {
        Self {
            listen: "127.0.0.1:8080".to_owned(),
            max_body_bytes: 4 << 20,
            max_bulk_bytes: 32 << 20,
            header_timeout_s: 10,
            body_timeout_s: 30,
            max_connections: 1_024,
            drain_s: 30,
            trusted_proxies: Vec::new(),
            rate_limit: RateLimitSettings::default(),
        }
    }
}

/// What the routes answer from.
pub struct Service {
    /// Takes and assesses batches.
    pub monitor: Monitor,
    /// Sends events to webhooks.
    pub notifier: Notifier,
    /// Who may do what.
    pub access: AccessControl,
    /// What `/metrics` shows.
    pub metrics: PrometheusHandle,
}

/// What every handler has at hand.
#[derive(Clone)]
pub struct Shared {
    monitor: Monitor,
    notifier: Notifier,
    metrics: Arc<PrometheusHandle>,
    limits: BodyLimits,
    /// Places for event streams.
    streams: Arc<Semaphore>,
    /// Turns to read a series.
    series: Arc<Semaphore>,
    access: AccessControl,
}

/// Series read at a time, by three of the store's eight connections each.
const SERIES_AT_A_TIME: usize = 2;

/// The operations of the service with their description: one line makes both.
fn api() -> OpenApiRouter<Shared> {
    OpenApiRouter::with_openapi(openapi::Base::openapi())
        .routes(routes!(structures::list))
        .routes(routes!(structures::read, structures::put))
        .routes(routes!(batches::create))
        .routes(routes!(batches::read))
        .routes(routes!(views::detail))
        .routes(routes!(export::measurements))
        .routes(routes!(series::series))
        .routes(routes!(history::history))
        .routes(routes!(history::declare_baseline))
        .routes(routes!(history::exceedances))
        .routes(routes!(alarms::list))
        .routes(routes!(alarms::acknowledge))
        .routes(routes!(alarms::charts))
        .routes(routes!(alarms::maintenance, alarms::add_maintenance))
        .routes(routes!(alarms::identifiability))
        .routes(routes!(diagnoses::list, diagnoses::create))
        .routes(routes!(diagnoses::step_back))
        .routes(routes!(diagnoses::read))
        .routes(routes!(diagnoses::report))
        .routes(routes!(diagnoses::extend))
        .routes(routes!(views::overview))
        .routes(routes!(views::jobs))
        .routes(routes!(events::events))
        .routes(routes!(access::tokens::list, access::tokens::create))
        .routes(routes!(access::tokens::revoke))
        .routes(routes!(access::tokens::rotate))
        .routes(routes!(access::audit::list))
        .routes(routes!(webhooks::list, webhooks::create))
        .routes(routes!(webhooks::read, webhooks::put, webhooks::remove))
        .routes(routes!(webhooks::test))
        .routes(routes!(webhooks::rotate))
        .routes(routes!(webhooks::deliveries))
        .routes(routes!(webhooks::retry))
        .routes(routes!(quarantine::list))
        .routes(routes!(quarantine::read, quarantine::remove))
        .routes(routes!(safekeeping::reload_model))
        .routes(routes!(safekeeping::export))
        .routes(routes!(safekeeping::list_backups, safekeeping::create_backup))
        .routes(routes!(safekeeping::retention))
        .routes(routes!(operations::health))
        .routes(routes!(operations::ready))
        .routes(routes!(operations::metrics))
        .routes(routes!(operations::version))
}

/// All routes of the service.
pub fn router(service: Service, settings: &HttpSettings) -> Router {
    let Service { monitor, notifier, access, metrics } = service;
    let limits = BodyLimits {
        bytes: settings.max_body_bytes,
        bulk_bytes: settings.max_bulk_bytes,
        time: Duration::from_secs(settings.body_timeout_s),
    };
    let shared = Shared {
        monitor,
        notifier,
        metrics: Arc::new(metrics),
        limits,
        streams: Arc::new(Semaphore::new(events::MOST_STREAMS)),
        series: Arc::new(Semaphore::new(SERIES_AT_A_TIME)),
        access: access.clone(),
    };
    let (operations, mut document) = api().split_for_parts();
    openapi::complete(&mut document);
    operations
        .merge(docs::router(&document))
        .route("/", get(dashboard::index))
        .route("/assets/{*path}", get(dashboard::asset))
        .method_not_allowed_fallback(method_not_allowed)
        .fallback(not_found)
        // Bodies are read by `request::read_body`, which has its own limit and its own error.
        .layer(DefaultBodyLimit::disable())
        .layer(middleware::from_fn_with_state(access, access::guard))
        .layer(CatchPanicLayer::custom(panicked))
        .layer(middleware::from_fn(access::headers::secure))
        .layer(middleware::from_fn(request::with_id_and_log))
        .with_state(shared)
}

async fn not_found() -> ApiError {
    ApiError::new(
        StatusCode::NOT_FOUND,
        "unknown_route",
        "there is nothing at this path; /openapi.json lists the routes",
    )
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
