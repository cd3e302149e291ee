//! `/v1/structures/{id}/trainings`, `/v1/trainings/{id}`: models that the service trains.

use axum::body::Body;
use axum::extract::State;
use axum::http::{header, HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::{Deserialize, Serialize};
use serde_json::value::RawValue;
use utoipa::ToSchema;

use super::error::ApiError;
use super::jobs::Status;
use super::openapi::{BodyRefused, Busy, Conflict, Invalid, StructurePath, TrainingPath, Unknown};
use super::request::{json_body, structure_id, whole_number, ApiPath};
use super::shared::Shared;
use crate::baseline::conditions::NoiseRange;
use crate::baseline::recipe::RecipeRequest;
use crate::baseline::train::MINIMUM_SAMPLES;
use crate::monitor::stored::{JobState, TrainingJobRecord};
use crate::monitor::{JobStatus, TrainingRequest, TrainingResult};
use crate::quantity::{StructureId, Timestamp};
use crate::simulator::Simulator;

/// Maximum number of trainings in the list of a structure.
const LISTED: usize = 100;

/// Body of a request for a training; `{}` trains as `modalwatch train` does without options.
#[derive(Debug, Default, Deserialize, ToSchema)]
#[serde(deny_unknown_fields, default)]
#[schema(as = TrainingInput)]
struct TrainingBody {
    /// Number of simulated training samples. Default: `defaults` of the list of trainings.
    #[serde(deserialize_with = "whole_number")]
    #[schema(value_type = Option<u64>, minimum = 100, maximum = 2_000_000)]
    samples: Option<u64>,
    /// Number of passes over the samples in the first round. Default: `defaults` of the list of trainings.
    #[serde(deserialize_with = "whole_number")]
    #[schema(value_type = Option<u64>, minimum = 1, maximum = 2000)]
    epochs: Option<u64>,
    /// Number of coupling units of the network; more represent more complex posteriors and take longer. Default 4.
    #[serde(deserialize_with = "whole_number")]
    #[schema(value_type = Option<u64>, minimum = 1, maximum = 64)]
    units: Option<u64>,
    /// Most rounds: after a round whose calibration does not pass, a shorter round follows. Default 4; 1 if `samples` or `epochs` is
    /// given.
    #[serde(deserialize_with = "whole_number")]
    #[schema(value_type = Option<u64>, minimum = 1, maximum = 16)]
    rounds: Option<u64>,
    /// Range of noise that the model must cover, as multiples of the noise of the structure. Default 0.1 to 5.
    #[schema(examples(json!({"lowest": 0.1, "highest": 5.0})))]
    noise_range: Option<NoiseRange>,
    /// Seed of all random numbers: the same seed gives the same model. Default 1.
    #[serde(deserialize_with = "whole_number")]
    #[schema(value_type = Option<u64>, maximum = 9_007_199_254_740_991_i64)]
    seed: Option<u64>,
    /// Use the model even if it is overconfident; every assessment then has a finding about it.
    accept_uncalibrated: bool,
}

/// How a model is trained.
#[derive(Debug, Serialize, ToSchema)]
struct TrainingRecipe {
    samples: usize,
    epochs: usize,
    units: usize,
    rounds: usize,
    noise_range: NoiseRange,
    seed: u64,
}

/// A training with its job.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = TrainingJob)]
struct TrainingAnswer {
    training: String,
    structure: StructureId,
    /// Version of the structure that the model is for.
    structure_digest: String,
    recipe: TrainingRecipe,
    accept_uncalibrated: bool,
    state: JobState,
    #[serde(flatten)]
    status: Status,
    #[serde(skip_serializing_if = "Option::is_none")]
    failure: Option<String>,
    created_at: Timestamp,
    #[schema(required)]
    finished_at: Option<Timestamp>,
    #[schema(value_type = Option<TrainingResult>, required)]
    result: Option<Box<RawValue>>,
}

/// Trainings of a structure, newest first.
#[derive(Debug, Serialize, ToSchema)]
struct TrainingList {
    structure: StructureId,
    /// The recipe of a request without settings.
    defaults: TrainingRecipe,
    items: Vec<TrainingAnswer>,
}

fn recipe(request: &RecipeRequest, simulator: &Simulator) -> TrainingRecipe {
    let recipe = request.recipe(simulator);
    TrainingRecipe {
        samples: recipe.samples,
        epochs: recipe.settings.epochs,
        units: recipe.flow.units,
        rounds: recipe.rounds,
        noise_range: recipe.noise_range,
        seed: recipe.settings.seed,
    }
}

fn answer(
    record: TrainingJobRecord,
    status: Option<JobStatus>,
    simulator: &Simulator,
) -> Result<TrainingAnswer, ApiError> {
    let unreadable = |error| ApiError::unreadable("training", &error);
    let request: TrainingRequest = serde_json::from_str(&record.request).map_err(unreadable)?;
    let result = record.result.map(RawValue::from_string).transpose().map_err(unreadable)?;
    // What is stored does not say whether a training that has not ended runs.
    let runs = record.state == JobState::Waiting && status.as_ref().is_some_and(|status| !status.waits);
    Ok(TrainingAnswer {
        training: record.id,
        structure: record.structure,
        structure_digest: record.structure_digest.to_string(),
        recipe: recipe(&request.recipe, simulator),
        accept_uncalibrated: request.accept_uncalibrated,
        state: if runs { JobState::Running } else { record.state },
        status: Status::from(status),
        failure: record.failure,
        created_at: record.created_at,
        finished_at: record.finished_at,
        result,
    })
}

/// The request of a body, after a check of all its numbers.
fn request(body: &TrainingBody) -> Result<TrainingRequest, ApiError> {
    let checked = |pointer: &str, value: Option<u64>, lowest: u64, highest: u64| match value {
        Some(value) if !(lowest..=highest).contains(&value) => {
            Err(ApiError::invalid_field(pointer, format!("{value} must be between {lowest} and {highest}")))
        }
        value => Ok(value.map(|value| value as usize)),
    };
    if let Some(NoiseRange { lowest, highest }) = body.noise_range {
        if !(lowest > 0.0 && highest.is_finite() && lowest < highest && (lowest..=highest).contains(&1.0)) {
            let message = format!(
                "{lowest} to {highest} must be two ascending multiples of the structure's noise, both above 0, with 1 between them"
            );
            return Err(ApiError::invalid_field("/noise_range", message));
        }
    }
    Ok(TrainingRequest {
        recipe: RecipeRequest {
            samples: checked("/samples", body.samples, MINIMUM_SAMPLES as u64, 2_000_000)?,
            epochs: checked("/epochs", body.epochs, 1, 2_000)?,
            units: checked("/units", body.units, 1, 64)?,
            rounds: checked("/rounds", body.rounds, 1, 16)?,
            noise_range: body.noise_range,
            seed: body.seed,
        },
        accept_uncalibrated: body.accept_uncalibrated,
    })
}

/// `POST /v1/structures/{id}/trainings`: 202, starts a background job.
///
/// # Errors
/// 404, 409 while a training of the structure runs or waits, 422 for the settings.
#[utoipa::path(
    post, path = "/v1/structures/{id}/trainings", tag = "trainings", operation_id = "start_training",
    summary = "Train the model of a structure",
    description = "Starts a background job that trains a model for the present version of the structure, with the defaults of \
                   `modalwatch train`; the same settings and seed give the same model. A model that passes its calibration or is cautious \
                   is put into use, and all batches are assessed. An overconfident one is not used unless `accept_uncalibrated` is true.",
    params(StructurePath),
    request_body(content = TrainingBody, example = json!({"samples": 200_000, "epochs": 80})),
    responses(
        (status = 202, description = "The job has started", body = TrainingAnswer,
         headers(("Location" = String, description = "Path of the training"))),
        Unknown, BodyRefused, Conflict, Busy
    )
)]
pub async fn create(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    let body: TrainingBody = json_body(&headers, body, shared.limits).await?;
    let active = shared.monitor.structure(&id)?;
    let record = shared.monitor.jobs().start_training(&id, request(&body)?).await?;
    let location = [(header::LOCATION, format!("/v1/trainings/{}", record.id))];
    let status = shared.monitor.jobs().status(&record.id);
    Ok((StatusCode::ACCEPTED, location, Json(answer(record, status, &active.simulator)?)).into_response())
}

/// `GET /v1/structures/{id}/trainings`: the newest first.
///
/// # Errors
/// 404.
#[utoipa::path(
    get, path = "/v1/structures/{id}/trainings", tag = "trainings", operation_id = "list_trainings",
    summary = "Trainings of a structure", description = "The 100 newest, newest first, and the default settings for this structure.",
    params(StructurePath),
    responses((status = 200, description = "The trainings", body = TrainingList), Unknown, Invalid)
)]
pub async fn list(State(shared): State<Shared>, ApiPath(id): ApiPath<String>) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    let active = shared.monitor.structure(&id)?;
    let jobs = shared.monitor.jobs();
    let records = jobs.trainings(&id, LISTED).await?;
    let items = records.into_iter().map(|record| {
        let status = jobs.status(&record.id);
        answer(record, status, &active.simulator)
    });
    let items = items.collect::<Result<Vec<_>, _>>()?;
    let defaults = recipe(&RecipeRequest::default(), &active.simulator);
    Ok(Json(TrainingList { structure: id, defaults, items }).into_response())
}

/// `GET /v1/trainings/{id}`: state, progress and result.
///
/// # Errors
/// 404.
#[utoipa::path(
    get, path = "/v1/trainings/{id}", tag = "trainings", operation_id = "read_training",
    summary = "A training", description = "State and progress of the job, and its result once it is done.",
    params(TrainingPath),
    responses((status = 200, description = "The training", body = TrainingAnswer), Unknown)
)]
pub async fn read(State(shared): State<Shared>, ApiPath(id): ApiPath<String>) -> Result<Response, ApiError> {
    let (record, status) = shared.monitor.jobs().training(&id).await?;
    let active = shared.monitor.structure(&record.structure)?;
    Ok(Json(answer(record, status, &active.simulator)?).into_response())
}
