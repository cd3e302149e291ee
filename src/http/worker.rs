//! The answers of a process that only computes: whether it lives, whether it is ready, and its metrics.

use std::convert::Infallible;
use std::future::Future;
use std::pin::pin;
use std::sync::Arc;
use std::time::Duration;

use axum::body::Body;
use axum::http::{header, Request, Response, StatusCode};
use axum::response::IntoResponse as _;
use axum::Json;
use hyper::body::Incoming;
use hyper::server::conn::http1::Builder;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use metrics_exporter_prometheus::PrometheusHandle;
use serde_json::json;
use tokio::net::TcpListener;
use tokio::sync::Semaphore;
use tracing::debug;

use super::error::ApiError;
use super::settings::HttpSettings;
use crate::monitor::Worker;

/// Connections that are served at the same time; supervisors need few.
const MOST_CONNECTIONS: usize = 32;

/// Longest time of a connection, which is enough for an answer of some kilobytes.
const LONGEST_CONNECTION: Duration = Duration::from_mins(1);

/// Pause after a failed accept: if the process has no free file descriptor, an immediate retry would loop.
const PAUSE_AFTER_FAILED_ACCEPT: Duration = Duration::from_millis(50);

/// Answers until `shutdown` completes.
pub async fn run(
    listener: TcpListener,
    worker: Worker,
    metrics: PrometheusHandle,
    settings: &HttpSettings,
    shutdown: impl Future<Output = ()>,
) {
    let mut builder = Builder::new();
    builder.timer(TokioTimer::new()).header_read_timeout(Duration::from_secs(settings.header_timeout_s));
    let (places, metrics) = (Arc::new(Semaphore::new(MOST_CONNECTIONS)), Arc::new(metrics));
    let mut shutdown = pin!(shutdown);
    loop {
        let accepted = tokio::select! {
            accepted = listener.accept() => accepted,
            () = &mut shutdown => return,
        };
        let Ok((stream, _)) = accepted else {
            tokio::time::sleep(PAUSE_AFTER_FAILED_ACCEPT).await;
            continue;
        };
        // A connection beyond the limit is closed.
        let Ok(place) = Arc::clone(&places).try_acquire_owned() else { continue };
        let (worker, metrics) = (worker.clone(), Arc::clone(&metrics));
        let service = service_fn(move |request: Request<Incoming>| {
            let answered = answer(request.uri().path(), &worker, &metrics);
            async move { Ok::<_, Infallible>(answered) }
        });
        let serving = builder.serve_connection(TokioIo::new(stream), service);
        tokio::spawn(async move {
            if let Ok(Err(error)) = tokio::time::timeout(LONGEST_CONNECTION, serving).await {
                debug!(%error, "A connection ended early: {error}");
            }
            drop(place);
        });
    }
}

fn answer(path: &str, worker: &Worker, metrics: &PrometheusHandle) -> Response<Body> {
    let health = worker.health();
    match path {
        "/healthz" => Json(json!({ "status": "alive" })).into_response(),
        "/readyz" => {
            let status = if health.ready { StatusCode::OK } else { StatusCode::SERVICE_UNAVAILABLE };
            (status, Json(health)).into_response()
        }
        "/metrics" => {
            metrics::gauge!("modalwatch_ready").set(f64::from(u8::from(health.ready)));
            metrics.run_upkeep();
            ([(header::CONTENT_TYPE, "text/plain; version=0.0.4")], metrics.render()).into_response()
        }
        _ => {
            let detail = "this process only computes (roles = [\"worker\"]): it answers /healthz, /readyz and /metrics";
            ApiError::new(StatusCode::NOT_FOUND, "unknown_route", detail).into_response()
        }
    }
}
