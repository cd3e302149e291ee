//! Views for the dashboard: `/v1/overview`, `/v1/structures/{id}/batches/{batch}/detail`.

use axum::extract::State;
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::Serialize;
use utoipa::ToSchema;

use super::access::{Client, Share};
use super::error::ApiError;
use super::mode_shapes::ShapeComparisonBody;
use super::openapi::{BatchPath, Computed, Conflict, Invalid, Unknown};
use super::request::{structure_id, ApiPath};
use super::shared::Shared;
use super::verdict::{Condition, Judged};
use crate::access::Grant;
use crate::assessment::{BatchDetail, ModeDetail, ParameterDetail};
use crate::monitor::stored::LatestAssessment;
use crate::process::lasting::LastingChange;
use crate::quantity::{Hertz, StructureId, Timestamp};
use crate::trust::TrustVerdict;

/// Computations that one client may have running or waiting.
pub const MOST_COMPUTATIONS: usize = 32;

/// Value of `Retry-After` when a client has all of them, seconds.
const RETRY_AFTER_S: u32 = 5;

/// Overview of all structures.
#[derive(Debug, Serialize, ToSchema)]
struct Overview {
    items: Vec<OverviewItem>,
    /// Number of diagnoses, extensions and trainings that are running or waiting.
    jobs_running: usize,
}

/// Overview of a structure.
#[derive(Debug, Serialize, ToSchema)]
struct OverviewItem {
    id: StructureId,
    /// What is known about its condition, from the alarm charts alone.
    state: Condition,
    /// The verdict in one or two sentences: what has changed by how much since when, or why there is no verdict.
    verdict: String,
    /// Opening of the oldest open damage alarm.
    #[schema(required)]
    alarm_since: Option<Timestamp>,
    /// The change that the newest batch shows beside the process of the reference, whether it is large enough for an alarm or not.
    #[serde(skip_serializing_if = "Option::is_none")]
    change: Option<LastingChange>,
    /// Number of batches that wait for their assessment.
    waiting_batches: u64,
    open_alarms: u64,
    unacknowledged_alarms: u64,
    #[schema(required)]
    last_measured_at: Option<Timestamp>,
    #[schema(required)]
    last_received_at: Option<Timestamp>,
    batches: u64,
    #[schema(required)]
    latest: Option<Latest>,
    #[schema(required)]
    model_digest: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    model_missing: Option<String>,
    /// False for a model that is overconfident.
    #[schema(required)]
    calibration_passed: Option<bool>,
    /// Outcome of the calibration of the model in use.
    #[schema(required)]
    calibration_outcome: Option<crate::baseline::manifest::Outcome>,
    #[schema(required)]
    undamaged_version: Option<u32>,
}

/// The most recently measured batch that is assessed.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = LatestAssessment)]
struct Latest {
    batch: String,
    trust: TrustVerdict,
    exceeds: bool,
    #[schema(required)]
    max_probability_of_damage: Option<f64>,
    #[schema(required)]
    max_parameter: Option<String>,
    findings: usize,
}

/// Densities of the parameters for a batch, and the predicted frequencies.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = BatchDetail)]
struct DetailBody {
    structure: StructureId,
    batch: String,
    model_digest: String,
    measurement_count: usize,
    /// Number of measurements in `measured_hz`, evenly selected.
    measurements_shown: usize,
    /// Number of posterior samples behind the predictions, evenly selected.
    simulations: usize,
    parameters: Vec<ParameterDensities>,
    modes: Vec<ModeFrequencies>,
    /// Measured mode shapes beside those of the simulation; `null` if the batch has none.
    #[schema(required)]
    mode_shapes: Option<ShapeComparisonBody>,
}

/// Densities of a parameter on one grid, per unit of the parameter.
#[derive(Debug, Serialize, ToSchema)]
struct ParameterDensities {
    name: String,
    unit: String,
    grid: Vec<f64>,
    prior: Vec<f64>,
    posterior: Vec<f64>,
    #[schema(required)]
    undamaged: Option<Vec<f64>>,
    #[schema(required)]
    threshold: Option<f64>,
}

/// A mode, numbered from 1. 90 % of the predicted frequencies, without measurement noise, lie between `low` and `high`.
#[derive(Debug, Serialize, ToSchema)]
struct ModeFrequencies {
    mode: usize,
    measured_hz: Vec<Option<Hertz>>,
    predicted_mean_hz: f64,
    predicted_low_hz: f64,
    predicted_high_hz: f64,
}

/// `GET /v1/overview`: all structures that the token may see, with their alarm state and latest assessment.
///
/// # Errors
/// 500.
#[utoipa::path(
    get, path = "/v1/overview", tag = "results", operation_id = "overview",
    summary = "Overview of all structures",
    description = "The structures that the token may see, each with its alarm state and latest assessment.",
    responses((status = 200, description = "The structures by id", body = Overview))
)]
pub async fn overview(State(shared): State<Shared>, grant: Grant) -> Result<Response, ApiError> {
    let judged = Judged::all(&shared.monitor).await?;
    let items = judged.into_iter().filter(|judged| grant.may_see(&judged.found.id)).map(item).collect();
    let jobs_running = shared.monitor.jobs().running();
    Ok(Json(Overview { items, jobs_running }).into_response())
}

fn item(Judged { found, model, verdict }: Judged) -> OverviewItem {
    let (baseline, model_missing) = (model.as_ref().ok(), model.as_ref().err());
    OverviewItem {
        state: verdict.condition,
        verdict: verdict.sentence,
        alarm_since: verdict.alarm_since,
        change: found.change,
        waiting_batches: found.waiting,
        model_digest: baseline.map(|b| b.digest().to_string()),
        model_missing: model_missing.cloned(),
        calibration_passed: baseline.map(|b| b.manifest().calibration.failures.is_empty()),
        calibration_outcome: baseline.map(|b| b.manifest().calibration.outcome()),
        latest: found.latest.map(latest),
        id: found.id,
        open_alarms: found.open_alarms,
        unacknowledged_alarms: found.unacknowledged_alarms,
        last_measured_at: found.last_measured_at,
        last_received_at: found.last_received_at,
        batches: found.batches,
        undamaged_version: found.undamaged_version,
    }
}

fn latest(found: LatestAssessment) -> Latest {
    let (max_probability_of_damage, max_parameter) = found.worst.unzip();
    Latest {
        batch: found.batch_id,
        trust: found.verdict,
        exceeds: found.exceeds,
        max_probability_of_damage,
        max_parameter,
        findings: found.findings,
    }
}

/// `GET /v1/structures/{id}/batches/{batch}/detail`: densities and predicted frequencies, sampled as for the
/// assessment.
///
/// # Errors
/// 404 for structure or batch, 409 if the batch is not assessed, 503 when too many computations wait.
#[utoipa::path(
    get, path = "/v1/structures/{id}/batches/{batch}/detail", tag = "results", operation_id = "read_batch_detail",
    summary = "Details of a batch",
    description = "Densities of the parameters, and the predicted frequencies beside the measured ones.",
    params(BatchPath),
    responses((status = 200, description = "The densities", body = DetailBody), Unknown, Invalid, Conflict, Computed)
)]
pub async fn detail(
    State(shared): State<Shared>,
    client: Client,
    ApiPath((id, batch)): ApiPath<(String, String)>,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    let _share = share(&shared, &client)?;
    let detail = shared.monitor.records().batch_detail(&id, &batch).await?;
    Ok(Json(detail_body(id, batch, BatchDetail::clone(&detail))).into_response())
}

/// One of the computations that a client may have at a time.
///
/// # Errors
/// 503 when it has all of them.
pub(super) fn share(shared: &Shared, client: &Client) -> Result<Share, ApiError> {
    shared.computations.take(&client.key).ok_or_else(|| {
        let most = shared.computations.most();
        let detail =
            format!("{most} computations of this client run or wait, which is the maximum: ask for fewer at a time");
        ApiError::unavailable("too_many_computations", detail, RETRY_AFTER_S)
    })
}

fn detail_body(structure: StructureId, batch: String, detail: BatchDetail) -> DetailBody {
    let parameter = |p: ParameterDetail| ParameterDensities {
        name: p.name,
        unit: p.unit,
        grid: p.grid,
        prior: p.prior,
        posterior: p.posterior,
        undamaged: p.undamaged,
        threshold: p.threshold,
    };
    let mode = |(index, m): (usize, ModeDetail)| ModeFrequencies {
        mode: index + 1,
        measured_hz: m.measured_hz,
        predicted_mean_hz: m.predicted_mean_hz,
        predicted_low_hz: m.predicted_interval_hz[0],
        predicted_high_hz: m.predicted_interval_hz[1],
    };
    DetailBody {
        structure,
        batch,
        model_digest: detail.model_digest.to_string(),
        measurement_count: detail.measurements,
        measurements_shown: detail.shown,
        simulations: detail.simulations,
        parameters: detail.parameters.into_iter().map(parameter).collect(),
        modes: detail.modes.into_iter().enumerate().map(mode).collect(),
        mode_shapes: detail.shapes.map(ShapeComparisonBody::from),
    }
}
