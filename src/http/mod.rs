//! The HTTP API: its routes, and the layers that every request passes. `openapi` describes how a route is added.

pub mod access;
mod alarm_actions;
mod alarm_item;
mod alarms;
mod answer;
mod audit;
mod batches;
mod bulk;
mod cell;
mod condition_report;
mod connections;
mod dashboard;
mod diagnoses;
mod docs;
mod drawing;
mod error;
mod events;
mod explorer;
mod export;
mod file_parts;
mod forward;
mod history;
mod jobs;
mod mode_shapes;
mod node_header;
mod notes;
mod observe;
mod openapi;
mod operations;
#[cfg(feature = "parquet")]
mod parquet;
mod people;
mod presence;
mod problem;
mod quarantine;
mod reference;
mod request;
mod request_id;
mod safekeeping;
mod series;
pub mod server;
mod settings;
mod shared;
mod slow_reader;
pub mod standby;
mod starting;
mod structure_deletion;
mod structure_metrics;
mod structures;
mod table;
mod table_room;
mod tables;
#[cfg(test)]
mod tests;
mod tokens;
#[cfg(feature = "otel")]
mod traceparent;
mod trainings;
mod upload;
mod verdict;
mod views;
mod webhooks;
pub mod worker;

use std::sync::Arc;
use std::time::Duration;

use axum::extract::DefaultBodyLimit;
use axum::http::StatusCode;
use axum::middleware;
use axum::response::{IntoResponse as _, Response};
use axum::routing::get;
use axum::Router;
use metrics_exporter_prometheus::PrometheusHandle;
use tokio::sync::Semaphore;
use tower_http::catch_panic::CatchPanicLayer;
use utoipa::OpenApi as _;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use crate::monitor::Monitor;
use crate::notify::Notifier;
use access::{AccessControl, Shares};
use error::ApiError;
use request::BodyLimits;
use server::Routes;
pub use settings::{HttpSettings, RateLimitSettings};
use shared::Shared;
use table_room::TableRoom;

/// The parts of the service that the routes use.
pub struct Service {
    /// Receives and assesses batches.
    pub monitor: Monitor,
    /// Sends alarm events to webhooks.
    pub notifier: Notifier,
    /// Tokens, rate limits and audit.
    pub access: AccessControl,
    /// Source of the text at `/metrics`.
    pub metrics: PrometheusHandle,
}

/// All operations of the service together with their OpenAPI description.
#[expect(deprecated, reason = "deprecated routes are served as well")]
fn api() -> OpenApiRouter<Shared> {
    OpenApiRouter::with_openapi(openapi::Base::openapi())
        .routes(routes!(structures::list))
        .routes(routes!(structures::read, structures::put, structure_deletion::remove))
        .routes(routes!(drawing::drawing))
        .routes(routes!(batches::create))
        .routes(routes!(tables::preview))
        .routes(routes!(batches::read))
        .routes(routes!(views::detail))
        .routes(routes!(export::measurements))
        .routes(routes!(series::series))
        .routes(routes!(history::history))
        .routes(routes!(reference::put, reference::post))
        .routes(routes!(reference::post_baseline))
        .routes(routes!(reference::extend))
        .routes(routes!(reference::list))
        .routes(routes!(history::exceedances))
        .routes(routes!(alarms::list))
        .routes(routes!(alarms::acknowledge))
        .routes(routes!(alarm_actions::comment))
        .routes(routes!(alarm_actions::assign))
        .routes(routes!(alarm_actions::close))
        .routes(routes!(alarm_actions::reopen))
        .routes(routes!(notes::list, notes::create))
        .routes(routes!(notes::remove))
        .routes(routes!(alarms::charts))
        .routes(routes!(alarms::maintenance, alarms::add_maintenance))
        .routes(routes!(alarms::identifiability))
        .routes(routes!(diagnoses::list, diagnoses::create))
        .routes(routes!(diagnoses::step_back))
        .routes(routes!(diagnoses::read))
        .routes(routes!(diagnoses::report))
        .routes(routes!(diagnoses::extend))
        .routes(routes!(condition_report::report))
        .routes(routes!(views::overview))
        .routes(routes!(jobs::list))
        .routes(routes!(jobs::cancel))
        .routes(routes!(jobs::first))
        .routes(routes!(trainings::list, trainings::create))
        .routes(routes!(trainings::read))
        .routes(routes!(events::events))
        .routes(routes!(tokens::list, tokens::create))
        .routes(routes!(tokens::revoke))
        .routes(routes!(tokens::rotate))
        .routes(routes!(audit::list))
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
pub fn router(service: Service, settings: &HttpSettings) -> Routes {
    let (operations, mut document) = api().split_for_parts();
    openapi::complete(&mut document);
    let routes = operations
        .merge(docs::router(&document))
        .route("/", get(dashboard::index))
        .route("/assets/{*path}", get(dashboard::asset));
    guarded(routes, service, settings)
}

/// Routes behind what every request passes: its id, panics as answers, access, headers.
fn guarded(routes: Router<Shared>, service: Service, settings: &HttpSettings) -> Routes {
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
        token_streams: Arc::new(Shares::new(events::MOST_STREAMS_OF_A_TOKEN)),
        computations: Arc::new(Shares::new(views::MOST_COMPUTATIONS)),
        series: Arc::new(Semaphore::new(series::MOST_AT_A_TIME)),
        table_room: Arc::new(TableRoom::new(limits.bytes.max(limits.bulk_bytes))),
        access: access.clone(),
        metrics_structures: settings.metrics_structures,
    };
    let router = routes
        .method_not_allowed_fallback(method_not_allowed)
        .fallback(not_found)
        // Bodies are read by `request::read_body`, which has its own limit and its own error.
        .layer(DefaultBodyLimit::disable())
        .layer(middleware::from_fn_with_state(access.clone(), access::guard))
        .layer(CatchPanicLayer::custom(panicked))
        .layer(middleware::from_fn(access::headers::secure))
        .layer(middleware::from_fn(observe::with_id_and_log))
        .with_state(shared);
    Routes { router, access, nodes: None }
}

async fn not_found() -> ApiError {
    ApiError::new(StatusCode::NOT_FOUND, "unknown_route", "this path does not exist; /openapi.json lists the routes")
}

async fn method_not_allowed() -> ApiError {
    ApiError::new(StatusCode::METHOD_NOT_ALLOWED, "method_not_allowed", "this path does not support this method")
}

#[expect(clippy::needless_pass_by_value, reason = "the signature that CatchPanicLayer requires")]
fn panicked(panic: Box<dyn std::any::Any + Send + 'static>) -> Response {
    let cause = panic.downcast_ref::<&str>().map(ToString::to_string);
    let cause = cause.or_else(|| panic.downcast_ref::<String>().cloned()).unwrap_or_else(|| "a panic".to_owned());
    ApiError::internal(&cause).into_response()
}
