//! `/v1/structures/{id}/alarms`, `/charts`, `/maintenance`, `/identifiability`. What people do with alarms is in `alarm_actions`.

use axum::body::Body;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

use super::alarm_item::AlarmItem;
use super::answer::ChartBody;
use super::error::ApiError;
use super::openapi::{AlarmPath, BodyRefused, Conflict, Invalid, StructurePath, Unknown};
use super::people::check_text;
use super::request::{json_body, page_cursor, page_limit, structure_id, ApiPath, ApiQuery};
use super::shared::Shared;
use crate::baseline::manifest::ParameterIdentifiability;
use crate::clock;
use crate::monitor::stored::{Acknowledgement, EpisodeQuery, MaintenanceWindow};
use crate::quantity::{shown, Digest, StructureId, Timestamp};

/// Query of the alarms.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct AlarmQuery {
    /// `open` for alarms that have not ended. Default: all.
    #[param(value_type = Option<AlarmFilter>, inline)]
    state: Option<String>,
    /// `true` also lists alarms that a later undamaged reference has superseded. Default: `false`.
    #[param(value_type = Option<bool>)]
    superseded: Option<String>,
    /// Maximum number of alarms on the page. Default 100.
    #[param(value_type = Option<u32>, minimum = 1, maximum = 1000)]
    limit: Option<String>,
    /// `next` of the previous page.
    #[param(pattern = "^[0-9]{1,18}$")]
    cursor: Option<String>,
}

/// Filter of the alarms.
#[derive(ToSchema)]
#[schema(rename_all = "lowercase")]
#[expect(dead_code, reason = "only its description is used")]
enum AlarmFilter {
    Any,
    Open,
}

/// Query of the charts.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct ChartQuery {
    /// Maximum number of points on each chart. Default 100.
    #[param(value_type = Option<u32>, minimum = 1, maximum = 1000)]
    limit: Option<String>,
}

/// Alarms, newest first.
#[derive(Debug, Serialize, ToSchema)]
struct AlarmPage {
    structure: StructureId,
    items: Vec<AlarmItem>,
    /// Cursor of the next page; `null` on the last.
    next: Option<String>,
}

/// Points of the charts.
#[derive(Debug, Serialize, ToSchema)]
struct ChartPage {
    structure: StructureId,
    items: Vec<ChartBody>,
}

/// Maintenance windows, newest first.
#[derive(Debug, Serialize, ToSchema)]
struct MaintenanceList {
    structure: StructureId,
    items: Vec<MaintenanceItem>,
}

/// Which parameters the measured modes can distinguish.
#[derive(Debug, Serialize, ToSchema)]
struct Identifiability {
    structure: StructureId,
    model_digest: Digest,
    parameters: Vec<ParameterIdentifiability>,
    /// Names in each group of parameters that the modes cannot distinguish; their damage is reported for the group.
    groups: Vec<Vec<String>>,
}

/// Acknowledgement of an alarm by a person.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = AcknowledgementInput)]
struct AcknowledgementBody {
    #[schema(min_length = 1, max_length = 500, pattern = "^[^\\x00-\\x1f\\x7f-\\x9f]+$")]
    by: String,
    #[schema(min_length = 1, max_length = 500, pattern = "^[^\\x00-\\x1f\\x7f-\\x9f]+$")]
    note: Option<String>,
}

/// A time interval in which batches do not change the alarm charts.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = MaintenanceInput)]
struct MaintenanceBody {
    #[schema(format = DateTime)]
    from: String,
    /// Later than `from`.
    #[schema(format = DateTime)]
    to: String,
    #[schema(min_length = 1, max_length = 500, pattern = "^[^\\x00-\\x1f\\x7f-\\x9f]+$")]
    reason: String,
}

/// A time interval in which batches do not change the alarm charts.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Maintenance)]
struct MaintenanceItem {
    from: Timestamp,
    to: Timestamp,
    reason: String,
}

/// `GET /v1/structures/{id}/alarms`: alarm episodes, newest first.
///
/// # Errors
/// 404 for the structure, 422 for the query.
#[utoipa::path(
    get, path = "/v1/structures/{id}/alarms", tag = "alarms", operation_id = "list_alarms",
    summary = "Alarms",
    description = "Alarms with their start and end, newest first, in pages. After a new model or undamaged reference, the alarms of the \
                   earlier one are superseded where the new charts cover their time, and are listed only on request.",
    params(StructurePath, AlarmQuery),
    responses((status = 200, description = "A page", body = AlarmPage), Unknown, Invalid)
)]
pub async fn list(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    ApiQuery(query): ApiQuery<AlarmQuery>,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    shared.monitor.structure(&id)?;
    let limit = page_limit(query.limit.as_deref())?;
    let open_only = match query.state.as_deref() {
        None | Some("any") => false,
        Some("open") => true,
        Some(other) => {
            return Err(ApiError::invalid_field("query/state", format!("{} is neither open nor any", shown(other))));
        }
    };
    let superseded = match query.superseded.as_deref() {
        None | Some("false") => false,
        Some("true") => true,
        Some(other) => {
            return Err(ApiError::invalid_field(
                "query/superseded",
                format!("{} is neither true nor false", shown(other)),
            ));
        }
    };
    let before = page_cursor(query.cursor.as_deref())?;
    let query = EpisodeQuery { before, open_only, superseded, limit };
    let found = shared.monitor.alarms().episodes(&id, query).await?;
    let next = (found.len() == limit).then(|| found.last().map(|e| e.number.to_string())).flatten();
    let mut handling = shared.monitor.alarms().handling(&id, &found).await?;
    let limits = shared.monitor.alarms().limits();
    let items = found.into_iter().map(|episode| {
        let handling = handling.remove(&episode.number).unwrap_or_default();
        AlarmItem::new(episode, handling, limits)
    });
    Ok(Json(AlarmPage { structure: id, items: items.collect(), next }).into_response())
}

/// `POST /v1/structures/{id}/alarms/{n}/acknowledgement`: records who has seen the alarm. The first acknowledgement is
/// kept.
///
/// # Errors
/// 400, 415, 422 for the body, 404 for structure or alarm.
#[utoipa::path(
    post, path = "/v1/structures/{id}/alarms/{alarm}/acknowledgement", tag = "alarms", operation_id = "acknowledge_alarm",
    summary = "Acknowledge an alarm", description = "Records who has seen the alarm. The first acknowledgement is kept.",
    params(AlarmPath),
    request_body(content = AcknowledgementBody, example = json!({"by": "A. Engineer", "note": "inspection on Monday"})),
    responses((status = 200, description = "The alarm", body = AlarmItem), Unknown, BodyRefused)
)]
pub async fn acknowledge(
    State(shared): State<Shared>,
    ApiPath((id, number)): ApiPath<(String, String)>,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    shared.monitor.structure(&id)?;
    let body: AcknowledgementBody = json_body(&headers, body, shared.limits).await?;
    check_text("/by", &body.by)?;
    body.note.as_deref().map(|note| check_text("/note", note)).transpose()?;
    let unknown = || {
        let detail = format!("structure {id} has no alarm {}", shown(&number));
        ApiError::new(StatusCode::NOT_FOUND, "unknown_alarm", detail)
    };
    let acknowledgement = Acknowledgement { at: clock::now(), by: body.by, note: body.note };
    let parsed: i64 = number.parse().map_err(|_| unknown())?;
    shared.monitor.alarms().acknowledge(&id, parsed, acknowledgement).await?.ok_or_else(unknown)?;
    let (episode, handling) = shared.monitor.alarms().one(&id, parsed).await?.ok_or_else(unknown)?;
    Ok(Json(AlarmItem::new(episode, handling, shared.monitor.alarms().limits())).into_response())
}

/// `GET /v1/structures/{id}/charts`: the newest points of each chart, oldest first.
///
/// # Errors
/// 404 for the structure, 422 for the query.
#[utoipa::path(
    get, path = "/v1/structures/{id}/charts", tag = "alarms", operation_id = "read_charts",
    summary = "Alarm charts", description = "The newest points of each chart, oldest first.",
    params(StructurePath, ChartQuery),
    responses((status = 200, description = "The points", body = ChartPage), Unknown, Invalid)
)]
pub async fn charts(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    ApiQuery(query): ApiQuery<ChartQuery>,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    shared.monitor.structure(&id)?;
    let points = shared.monitor.alarms().charts(&id, page_limit(query.limit.as_deref())?).await?;
    let items: Vec<ChartBody> = points.into_iter().map(ChartBody::from).collect();
    Ok(Json(ChartPage { structure: id, items }).into_response())
}

/// `POST /v1/structures/{id}/maintenance`: batches measured in the interval do not change the alarm charts.
///
/// # Errors
/// 400, 415, 422 for the body, 404 for the structure.
#[utoipa::path(
    post, path = "/v1/structures/{id}/maintenance", tag = "alarms", operation_id = "add_maintenance",
    summary = "Announce maintenance", description = "Batches measured in the interval do not change the alarm charts.",
    params(StructurePath),
    request_body(content = MaintenanceBody, example = json!(
        {"from": "2026-03-01T08:00:00Z", "to": "2026-03-01T16:00:00Z", "reason": "bearing replaced"})),
    responses((status = 201, description = "The window", body = MaintenanceItem), Unknown, BodyRefused)
)]
pub async fn add_maintenance(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    shared.monitor.structure(&id)?;
    let body: MaintenanceBody = json_body(&headers, body, shared.limits).await?;
    let time = |pointer: &str, text: &str| {
        Timestamp::parse(text).map_err(|e| ApiError::invalid_field(pointer.to_owned(), e.to_string()))
    };
    let (from, to) = (time("/from", &body.from)?, time("/to", &body.to)?);
    if to <= from {
        return Err(ApiError::invalid_field("/to", format!("{to} is not after {from}")));
    }
    check_text("/reason", &body.reason)?;
    let window = MaintenanceWindow { from, to, reason: body.reason.clone() };
    shared.monitor.alarms().add_maintenance(&id, window).await?;
    Ok((StatusCode::CREATED, Json(MaintenanceItem { from, to, reason: body.reason })).into_response())
}

/// `GET /v1/structures/{id}/maintenance`: maintenance windows, newest first.
///
/// # Errors
/// 404 for the structure.
#[utoipa::path(
    get, path = "/v1/structures/{id}/maintenance", tag = "alarms", operation_id = "list_maintenance",
    summary = "Maintenance windows", description = "Newest first.",
    params(StructurePath),
    responses((status = 200, description = "The windows", body = MaintenanceList), Unknown, Invalid)
)]
pub async fn maintenance(State(shared): State<Shared>, ApiPath(id): ApiPath<String>) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    shared.monitor.structure(&id)?;
    let windows = shared.monitor.alarms().maintenance(&id).await?;
    let item = |w: MaintenanceWindow| MaintenanceItem { from: w.from, to: w.to, reason: w.reason };
    let items: Vec<MaintenanceItem> = windows.into_iter().map(item).collect();
    Ok(Json(MaintenanceList { structure: id, items }).into_response())
}

/// `GET /v1/structures/{id}/identifiability`: which parameters the modes can distinguish, according to the trained
/// model.
///
/// # Errors
/// 404 for the structure, 409 without a trained model.
#[utoipa::path(
    get, path = "/v1/structures/{id}/identifiability", tag = "structures", operation_id = "read_identifiability",
    summary = "Identifiability", description = "Which parameters the measured modes can distinguish, according to the trained model in use.",
    params(StructurePath),
    responses((status = 200, description = "For each parameter", body = Identifiability), Unknown, Invalid, Conflict)
)]
pub async fn identifiability(State(shared): State<Shared>, ApiPath(id): ApiPath<String>) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    let active = shared.monitor.structure(&id)?;
    let baseline = active.baseline.as_ref().map_err(|reason| {
        ApiError::from(crate::monitor::Error::NoModel { structure: id.clone(), reason: reason.clone() })
    })?;
    let record = &baseline.manifest().identifiability;
    let body = Identifiability {
        structure: id,
        model_digest: baseline.digest().clone(),
        parameters: record.parameters.clone(),
        groups: record.groups.clone(),
    };
    Ok(Json(body).into_response())
}
