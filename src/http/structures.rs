//! `/v1/structures`: defines and reads structures.

use axum::body::{Body, Bytes};
use axum::extract::State;
use axum::http::{header, HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::Serialize;
use serde_json::Value;
use utoipa::ToSchema;

use super::error::ApiError;
use super::openapi::{BodyRefused, Checked, Conflict, Invalid, StructurePath, Unknown};
use super::presence::Presence;
use super::request::{media_type, parse_json, read_body, structure_id, unsupported_media_type, ApiPath};
use super::shared::Shared;
use crate::access::Grant;
use crate::baseline::manifest::Outcome;
use crate::measurement::check::Problem;
use crate::monitor::stored::PutStructure;
use crate::monitor::{ActiveStructure, FoundReference};
use crate::quantity::{StructureId, Timestamp};
use crate::simulator::definition::{DefinitionError, StructureDefinition};
use crate::simulator::Simulator;

/// Value of `Retry-After` when too many definitions wait to be checked, seconds.
const RETRY_AFTER_S: u32 = 5;

/// Reads and checks the text of a definition.
type Parse = fn(&[u8]) -> Result<Simulator, ApiError>;

/// A structure with its trained model and its undamaged reference.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Structure)]
struct StructureBody {
    id: StructureId,
    digest: String,
    #[schema(value_type = StructureDefinition)]
    definition: Value,
    nominal_frequencies_hz: Vec<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    emulator: Option<EmulatorBody>,
    model: Option<ModelBody>,
    /// Why there is no model, and how to get one.
    #[serde(skip_serializing_if = "Option::is_none")]
    model_missing: Option<String>,
    /// Whether the first batch is answered without a trained model, and a training then starts by itself. Otherwise batches wait until one is
    /// requested.
    trains_by_itself: bool,
    /// The newest undamaged reference; `null` if there is none, or it cannot be read.
    undamaged: Option<super::answer::Undamaged>,
    /// Why the undamaged reference cannot be read, and what to do.
    #[serde(skip_serializing_if = "Option::is_none")]
    undamaged_unreadable: Option<String>,
    /// What is doubtful in the definition: priors that do not contain the nominal stiffness, with the probable cause.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    notes: Vec<String>,
}

/// Accuracy of the emulator of a table of simulation runs. Lists have one entry per measured mode.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Emulator)]
struct EmulatorBody {
    runs: usize,
    /// Root mean square error on runs that were left out of the fit, % of the frequency. It is added to the measurement noise.
    error_percent: Vec<f64>,
    r_squared: Vec<f64>,
    warnings: Vec<String>,
}

/// The trained model in use.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Model)]
struct ModelBody {
    digest: String,
    program_version: String,
    training_samples: usize,
    validation: crate::baseline::manifest::ValidationRecord,
    conditions: crate::baseline::conditions::Conditions,
    /// What the calibration says about the use of the model: `passed`; `cautious`, where intervals are too wide somewhere and nowhere too
    /// narrow; `overconfident`, where they are too narrow somewhere and the model is used only because it was accepted.
    calibration_outcome: Outcome,
    calibration: crate::baseline::manifest::CalibrationRecord,
}

/// All structures.
#[derive(Debug, Serialize, ToSchema)]
struct StructureList {
    items: Vec<ListedStructure>,
}

/// One structure of the list.
#[derive(Debug, Serialize, ToSchema)]
struct ListedStructure {
    id: StructureId,
    digest: String,
    created_at: Timestamp,
    batches: u64,
    last_measured_at: Option<Timestamp>,
    model_digest: Option<String>,
    /// Outcome of the calibration of the model in use.
    calibration_outcome: Option<Outcome>,
    /// Why this version of the program does not accept the stored definition.
    #[serde(skip_serializing_if = "Option::is_none")]
    definition_refused: Option<String>,
}

/// `GET /v1/structures`: the structures that the token may see.
///
/// # Errors
/// 500.
#[utoipa::path(
    get, path = "/v1/structures", tag = "structures", operation_id = "list_structures",
    summary = "All structures", description = "Each with its digest, number of batches and trained model.",
    responses((status = 200, description = "The structures by id", body = StructureList))
)]
pub async fn list(State(shared): State<Shared>, grant: Grant) -> Result<Response, ApiError> {
    let mut items = Vec::new();
    for summary in shared.monitor.records().structures().await?.into_iter().filter(|s| grant.may_see(&s.id)) {
        let baseline =
            shared.monitor.structure(&summary.id).ok().and_then(|active| active.baseline.as_ref().ok().cloned());
        items.push(ListedStructure {
            model_digest: baseline.as_ref().map(|baseline| baseline.digest().to_string()),
            calibration_outcome: baseline.as_ref().map(|baseline| baseline.manifest().calibration.outcome()),
            definition_refused: shared.monitor.structures().refused().get(&summary.id).cloned(),
            id: summary.id,
            digest: summary.digest.to_string(),
            created_at: summary.created_at,
            batches: summary.batches,
            last_measured_at: summary.last_measured_at,
        });
    }
    Ok(Json(StructureList { items }).into_response())
}

/// `GET /v1/structures/{id}`.
///
/// # Errors
/// 404, 422.
#[utoipa::path(
    get, path = "/v1/structures/{id}", tag = "structures", operation_id = "read_structure",
    summary = "A structure", description = "Its definition, its trained model with the calibration, and its undamaged reference.",
    params(StructurePath),
    responses((status = 200, description = "The structure", body = StructureBody), Unknown, Invalid)
)]
pub async fn read(State(shared): State<Shared>, ApiPath(id): ApiPath<String>) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    let active = shared.monitor.structure(&id)?;
    let undamaged = shared.monitor.records().reference(&id).await?;
    Ok(Json(body(&shared, &active, undamaged)).into_response())
}

/// `PUT /v1/structures/{id}`: defines a structure by JSON or TOML; 201 if it is new, 200 if it exists with this
/// definition.
///
/// # Errors
/// 400 and 422 with the location in the file; 409 if the structure has batches under another definition; 503 if many other
/// definitions wait to be checked.
#[utoipa::path(
    put, path = "/v1/structures/{id}", tag = "structures", operation_id = "put_structure",
    summary = "Define a structure",
    description = "JSON or TOML with the same keys; `id` must equal the id in the path. A structure that has batches cannot be \
                   redefined: use another id.",
    params(StructurePath),
    request_body(content(
        (StructureDefinition = "application/json", example = json!({
            "id": "one-mass", "modes": 1, "mass": [{"name": "m1", "kg": 2.0}],
            "spring": [{"name": "k1", "from": "ground", "to": "m1", "n_per_m": 50.0}],
            "parameter": [{"name": "k1", "prior": {"uniform": [30.0, 70.0]}, "sets": [{"spring": "k1"}]}]})),
        (String = "application/toml", example = json!(
            "id = \"one-mass\"\nmodes = 1\n[[mass]]\nname = \"m1\"\nkg = 2.0\n[[spring]]\nname = \"k1\"\n\
             from = \"ground\"\nto = \"m1\"\nn_per_m = 50.0\n[[parameter]]\nname = \"k1\"\n\
             prior = { uniform = [30.0, 70.0] }\nsets = { spring = \"k1\" }\n"))
    )),
    responses(
        (status = 200, description = "It existed already", body = StructureBody,
         headers(("Location" = String, description = "Path of the structure"))),
        (status = 201, description = "It is new", body = StructureBody,
         headers(("Location" = String, description = "Path of the structure"))),
        BodyRefused, Conflict, Checked
    )
)]
pub async fn put(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    presence: Presence,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    let bytes = read_body(body, &headers, shared.limits).await?;
    let kind = media_type(&headers);
    let parse: Parse = match kind.as_deref() {
        Some("application/json") => parse_definition_json,
        Some("application/toml") => |bytes| Simulator::parse_toml(utf8(bytes)?).map_err(refused),
        other => return Err(unsupported_media_type(other, "application/json or application/toml")),
    };
    // A change goes on when its client leaves; the check of a large definition, which nobody waits for any more, does not.
    let simulator = tokio::select! {
        checked = checked(&shared, bytes, parse) => checked?,
        () = presence.ends() => return Err(client_left()),
    };
    if *simulator.id() != id {
        let message = format!("the id in the body is {}, in the path {id}", simulator.id());
        return Err(ApiError::invalid_field("/id", message));
    }
    let outcome = shared.monitor.structures().put(simulator).await?;
    let status = if outcome == PutStructure::Created { StatusCode::CREATED } else { StatusCode::OK };
    let active = shared.monitor.structure(&id)?;
    let undamaged = shared.monitor.records().reference(&id).await?;
    let location = [(header::LOCATION, format!("/v1/structures/{id}"))];
    Ok((status, location, Json(self::body(&shared, &active, undamaged))).into_response())
}

/// Checks a definition in its turn: the check solves the eigenproblem and fits tables of runs, which takes seconds and some 200 MB for a
/// large structure.
async fn checked(shared: &Shared, bytes: Bytes, parse: Parse) -> Result<Simulator, ApiError> {
    let turn = shared.monitor.checks().turn().await;
    let turn = turn.map_err(|full| ApiError::unavailable("too_many_structures", full.to_string(), RETRY_AFTER_S))?;
    turn.run(move |_| parse(&bytes)).await.map_err(|e| ApiError::internal(&e))?
}

fn client_left() -> ApiError {
    let detail = "the client left before its definition was checked: nothing was changed";
    ApiError::new(StatusCode::BAD_REQUEST, "client_left", detail)
}

/// Malformed JSON is answered 400, JSON that does not define a structure 422.
fn parse_definition_json(bytes: &[u8]) -> Result<Simulator, ApiError> {
    parse_json::<Value>(bytes)?;
    Simulator::parse_json(utf8(bytes)?).map_err(refused)
}

fn utf8(bytes: &[u8]) -> Result<&str, ApiError> {
    std::str::from_utf8(bytes).map_err(|e| ApiError::new(StatusCode::BAD_REQUEST, "not_utf8", e.to_string()))
}

#[expect(clippy::needless_pass_by_value, reason = "the signature that map_err requires")]
fn refused(error: DefinitionError) -> ApiError {
    let problem = |p: &crate::simulator::definition::DefinitionProblem| Problem {
        pointer: p.line.map_or_else(|| p.pointer.clone(), |line| format!("line {line}, {}", p.pointer)),
        message: p.message.clone(),
    };
    ApiError::invalid("invalid_structure", error.to_string(), error.problems.iter().map(problem).collect())
}

fn body(shared: &Shared, active: &ActiveStructure, undamaged: FoundReference) -> StructureBody {
    let id = active.simulator.id();
    let model = active.baseline.as_ref().ok().map(|baseline| ModelBody {
        digest: baseline.digest().to_string(),
        program_version: baseline.manifest().program_version.clone(),
        training_samples: baseline.manifest().training.samples,
        validation: baseline.manifest().validation.clone(),
        conditions: baseline.manifest().conditions.clone(),
        calibration_outcome: baseline.manifest().calibration.outcome(),
        calibration: baseline.manifest().calibration.clone(),
    });
    let emulator = active.simulator.table().map(|table| {
        let modes = 0..active.simulator.modes();
        EmulatorBody {
            runs: table.runs(),
            error_percent: modes.clone().map(|mode| 100.0 * table.emulator().relative_error(mode)).collect(),
            r_squared: modes.map(|mode| table.emulator().r_squared(mode)).collect(),
            warnings: active.simulator.warnings(),
        }
    });
    let definition = serde_json::from_str(&active.simulator.definition().canonical_json());
    StructureBody {
        id: id.clone(),
        digest: active.simulator.digest().to_string(),
        definition: definition.expect("canonical JSON is JSON"),
        nominal_frequencies_hz: active.simulator.nominal_frequencies_hz(),
        emulator,
        model,
        model_missing: active.baseline.as_ref().err().cloned(),
        trains_by_itself: shared.monitor.trains_by_itself(&active.simulator),
        undamaged: undamaged.record.map(|record| super::answer::Undamaged::new(id, &record)),
        undamaged_unreadable: undamaged.unreadable,
        notes: active.simulator.prior_doubts().into_iter().map(|doubt| doubt.message).collect(),
    }
}
