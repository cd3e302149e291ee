//! `/healthz`, `/readyz`, `/metrics`, `/version`: for operators of the service.

use axum::extract::State;
use axum::http::{header, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::Serialize;
use tracing::error;
use utoipa::ToSchema;

use super::shared::Shared;
use super::structure_metrics::{self, StructureState};
use super::verdict::Judged;
use crate::access::{allow, About, Grant, Need, Scope};
use crate::baseline::library::Refusal;
use crate::monitor::stored::Engine;
use crate::monitor::{Error, Health, Reason};

/// The process is running.
#[derive(Debug, Serialize, ToSchema)]
struct Alive {
    /// `alive`.
    status: &'static str,
}

/// Versions of the program and of its database.
#[derive(Debug, Serialize, ToSchema)]
struct Version {
    name: &'static str,
    version: &'static str,
    /// `SQLite` or `PostgreSQL`.
    database: &'static str,
    database_version: String,
    /// `database_version` of SQLite; null with a PostgreSQL server.
    sqlite_version: Option<String>,
    /// Number of the last migration of the database.
    schema_version: i64,
    /// Format version of the manifests of trained models.
    manifest_format: u32,
}

/// The message of a finding for those who may not read all structures.
const HIDDEN: &str = "a token with the scope read for all structures shows what is meant";

/// Readiness to store and assess batches.
#[derive(Debug, Serialize, ToSchema)]
pub struct Readiness {
    /// Whether the service is ready, why not, and which parts are degraded.
    #[serde(flatten)]
    health: Health,
    /// `serving`, or `standby` for a node that passes requests on to the one that serves the database.
    role: &'static str,
    /// Address of the serving node; only of a node that stands by.
    #[serde(skip_serializing_if = "Option::is_none")]
    serving_node: Option<String>,
    baselines_in_use: usize,
    baselines_refused: Vec<Refusal>,
    free_places_in_queue: usize,
}

impl Readiness {
    /// That of a node which stands by: the address of the serving node, or why it cannot be reached.
    pub fn of_standby(reached: Result<String, Reason>) -> Self {
        let (serving_node, reasons) = match reached {
            Ok(url) => (Some(url), Vec::new()),
            Err(reason) => (None, vec![reason]),
        };
        Self {
            health: Health { ready: reasons.is_empty(), reasons, findings: Vec::new() },
            role: "standby",
            serving_node,
            baselines_in_use: 0,
            baselines_refused: Vec::new(),
            free_places_in_queue: 0,
        }
    }
}

/// `GET /healthz`: the process is running. The database is not checked, so that a slow disk does not cause a restart.
#[utoipa::path(
    get, path = "/healthz", tag = "operations", operation_id = "health",
    summary = "Liveness", description = "Answers while the process is running. The database is not checked.",
    responses((status = 200, description = "The process is running", body = Alive))
)]
pub async fn health() -> Response {
    Json(Alive { status: "alive" }).into_response()
}

/// `GET /readyz`: 200 if batches can be stored and assessed, otherwise 503 with the reasons.
#[utoipa::path(
    get, path = "/readyz", tag = "operations", operation_id = "ready",
    summary = "Readiness",
    description = "Whether batches can be stored and assessed; of a node that stands by, whether it can pass requests on to the one that \
                   serves. Findings name structures and files: without a token that may read all structures, their messages and the \
                   refused models are left out.",
    responses(
        (status = 200, description = "Ready", body = Readiness),
        (status = 503, description = "Not ready; `reasons` says why", body = Readiness)
    )
)]
pub async fn ready(State(shared): State<Shared>, grant: Grant) -> Response {
    let mut health = shared.monitor.upkeep().health().await;
    metrics::gauge!("modalwatch_ready").set(f64::from(u8::from(health.ready)));
    metrics::gauge!("modalwatch_findings").set(health.findings.len() as f64);
    let status = if health.ready { StatusCode::OK } else { StatusCode::SERVICE_UNAVAILABLE };
    let mut baselines_refused = shared.monitor.structures().library().refusals().to_vec();
    if allow(&grant, Need::Scope(Scope::Read), About::Service).is_err() {
        baselines_refused.clear();
        for finding in &mut health.findings {
            HIDDEN.clone_into(&mut finding.message);
        }
    }
    let readiness = Readiness {
        health,
        role: "serving",
        serving_node: None,
        baselines_in_use: shared.monitor.upkeep().baselines_in_use(),
        baselines_refused,
        free_places_in_queue: shared.monitor.upkeep().free_places(),
    };
    (status, Json(readiness)).into_response()
}

/// `GET /metrics`: metrics in the text format of Prometheus. Readiness is evaluated for each request, so that a scraper
/// sees it without calling `/readyz`. The route also answers if the database cannot be read.
#[utoipa::path(
    get, path = "/metrics", tag = "operations", operation_id = "metrics",
    summary = "Metrics",
    description = "Metrics in the text format of Prometheus: of the service, and of each structure with its state, newest values and charts.",
    responses((status = 200, description = "Prometheus text", body = String, content_type = "text/plain"))
)]
pub async fn metrics(State(shared): State<Shared>) -> Response {
    let health = shared.monitor.upkeep().health().await;
    metrics::gauge!("modalwatch_ready").set(f64::from(u8::from(health.ready)));
    metrics::gauge!("modalwatch_findings").set(health.findings.len() as f64);
    if let Err(failure) = shared.monitor.upkeep().set_gauges().await {
        error!(error = %failure, "Could not count what is stored: {failure}");
    }
    let mut text = shared.metrics.render();
    match of_structures(&shared).await {
        Ok(structures) => text.push_str(&structures),
        Err(failure) => {
            error!(error = %failure, "Could not read the values of the structures for the metrics: {failure}");
        }
    }
    ([(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")], text).into_response()
}

/// Metrics of the structures, as many as the settings allow.
async fn of_structures(shared: &Shared) -> Result<String, Error> {
    let most = shared.metrics_structures;
    if most == 0 {
        return Ok(String::new());
    }
    let state = |judged: Judged| StructureState {
        structure: judged.found.id,
        condition: judged.verdict.condition,
        batches: judged.found.batches,
        waiting_batches: judged.found.waiting,
        open_alarms: judged.found.open_alarms,
        last_measured_at: judged.found.last_measured_at,
    };
    let states: Vec<StructureState> = Judged::all(&shared.monitor).await?.into_iter().take(most).map(state).collect();
    let (quantities, points) = shared.monitor.records().latest(most).await?;
    Ok(structure_metrics::text(&states, &quantities, &points))
}

/// `GET /version`: versions of the program and of its database.
#[utoipa::path(
    get, path = "/version", tag = "operations", operation_id = "version",
    summary = "Version", description = "Versions of the program and of its database.",
    responses((status = 200, description = "The versions", body = Version))
)]
pub async fn version(State(shared): State<Shared>) -> Response {
    let (engine, database_version) = shared.monitor.database();
    let version = Version {
        name: env!("CARGO_PKG_NAME"),
        version: env!("CARGO_PKG_VERSION"),
        database: engine.as_str(),
        database_version: database_version.to_owned(),
        sqlite_version: (engine == Engine::Sqlite).then(|| database_version.to_owned()),
        schema_version: shared.monitor.schema_version(),
        manifest_format: crate::baseline::manifest::FORMAT,
    };
    Json(version).into_response()
}
