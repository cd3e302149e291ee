//! `/v1/structures/{id}/alarms`, `/charts`, `/maintenance`: alarms, what leads to them, and when there are none.

use axum::body::Body;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::{Deserialize, Serialize};

use super::answer::ChartBody;
use super::error::ApiError;
use super::request::{json_body, page_limit, structure_id, ApiPath, ApiQuery};
use super::Shared;
use crate::quantity::{shown, StructureId, Timestamp};
use crate::store::{Acknowledgement, Episode, MaintenanceWindow};

/// Longest name or note.
const LONGEST_TEXT: usize = 500;

/// Query of the alarms.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AlarmQuery {
    state: Option<String>,
    limit: Option<String>,
    cursor: Option<String>,
}

/// Query of the charts.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ChartQuery {
    limit: Option<String>,
}

#[derive(Debug, Serialize)]
struct AlarmPage {
    structure: StructureId,
    items: Vec<AlarmItem>,
    next: Option<String>,
}

/// An episode: from the alarm to its end.
#[derive(Debug, Serialize)]
struct AlarmItem {
    alarm: i64,
    kind: String,
    #[serde(skip_serializing_if = "Option::is_none")]
    parameter: Option<String>,
    state: &'static str,
    opened_at: Timestamp,
    opened_batch: Option<String>,
    ended_at: Option<Timestamp>,
    noticed_at: Timestamp,
    #[serde(skip_serializing_if = "Option::is_none")]
    peak_shift_standard_errors: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    undamaged_version: Option<u32>,
    acknowledgement: Option<AcknowledgementItem>,
}

#[derive(Debug, Serialize)]
struct AcknowledgementItem {
    at: Timestamp,
    by: String,
    note: Option<String>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct AcknowledgementBody {
    by: String,
    note: Option<String>,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct MaintenanceBody {
    from: String,
    to: String,
    reason: String,
}

#[derive(Debug, Serialize)]
struct MaintenanceItem {
    from: Timestamp,
    to: Timestamp,
    reason: String,
}

impl From<Episode> for AlarmItem {
    fn from(e: Episode) -> Self {
        let damage = e.kind == "damage";
        Self {
            alarm: e.number,
            state: match (e.withdrawn, e.ended_at) {
                (true, _) => "withdrawn",
                (false, Some(_)) => "ended",
                (false, None) => "open",
            },
            parameter: damage.then_some(e.series),
            peak_shift_standard_errors: (damage && e.peak_shift.is_finite()).then_some(e.peak_shift),
            undamaged_version: damage.then_some(e.undamaged_version),
            kind: e.kind,
            opened_at: e.opened_at,
            opened_batch: e.opened_batch,
            ended_at: e.ended_at,
            noticed_at: e.noticed_at,
            acknowledgement: e.acknowledgement.map(|a| AcknowledgementItem { at: a.at, by: a.by, note: a.note }),
        }
    }
}

/// `GET /v1/structures/{id}/alarms`: episodes, newest first; `state=open` for those that last.
///
/// # Errors
/// 404 for the structure, 422 for the query.
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
    let before = query.cursor.as_deref().map(|text| {
        let message = || format!("{} was not given out by this service", shown(text));
        text.parse::<i64>().map_err(|_| ApiError::invalid_field("query/cursor", message()))
    });
    let found = shared.monitor.store().episodes(&id, before.transpose()?, open_only, limit).await?;
    let next = (found.len() == limit).then(|| found.last().map(|e| e.number.to_string())).flatten();
    Ok(Json(AlarmPage { structure: id, items: found.into_iter().map(AlarmItem::from).collect(), next }).into_response())
}

/// `POST /v1/structures/{id}/alarms/{n}/acknowledgement`: somebody has seen it; the first stays.
///
/// # Errors
/// 400, 415, 422 for the body, 404 for structure or alarm.
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
    let acknowledgement = Acknowledgement { at: Timestamp::now(), by: body.by, note: body.note };
    let parsed: i64 = number.parse().map_err(|_| unknown())?;
    let episode = shared.monitor.store().acknowledge(&id, parsed, acknowledgement).await?.ok_or_else(unknown)?;
    Ok(Json(AlarmItem::from(episode)).into_response())
}

/// `GET /v1/structures/{id}/charts`: the newest points of each chart, oldest first.
///
/// # Errors
/// 404 for the structure, 422 for the query.
pub async fn charts(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    ApiQuery(query): ApiQuery<ChartQuery>,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    shared.monitor.structure(&id)?;
    let points = shared.monitor.store().charts(&id, page_limit(query.limit.as_deref())?).await?;
    let items: Vec<ChartBody> = points.into_iter().map(ChartBody::from).collect();
    Ok(Json(serde_json::json!({ "structure": id, "items": items })).into_response())
}

/// `POST /v1/structures/{id}/maintenance`: batches measured in the window move no chart.
///
/// # Errors
/// 400, 415, 422 for the body, 404 for the structure.
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
    shared.monitor.store().insert_maintenance(&id, window, Timestamp::now()).await?;
    Ok((StatusCode::CREATED, Json(MaintenanceItem { from, to, reason: body.reason })).into_response())
}

/// `GET /v1/structures/{id}/maintenance`: windows, newest first.
///
/// # Errors
/// 404 for the structure.
pub async fn maintenance(State(shared): State<Shared>, ApiPath(id): ApiPath<String>) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    shared.monitor.structure(&id)?;
    let windows = shared.monitor.store().maintenance(&id).await?;
    let item = |w: MaintenanceWindow| MaintenanceItem { from: w.from, to: w.to, reason: w.reason };
    let items: Vec<MaintenanceItem> = windows.into_iter().map(item).collect();
    Ok(Json(serde_json::json!({ "structure": id, "items": items })).into_response())
}

/// `GET /v1/structures/{id}/identifiability`: what the modes can tell apart, by the trained baseline in use.
///
/// # Errors
/// 404 for the structure, 409 without a trained baseline.
pub async fn identifiability(State(shared): State<Shared>, ApiPath(id): ApiPath<String>) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    let watched = shared.monitor.structure(&id)?;
    let baseline = watched.baseline.as_ref().map_err(|reason| {
        ApiError::from(crate::monitor::Error::NoModel { structure: id.clone(), reason: reason.clone() })
    })?;
    let record = &baseline.manifest().identifiability;
    let body = serde_json::json!({
        "structure": id, "model_digest": baseline.digest(), "parameters": record.parameters, "groups": record.groups,
    });
    Ok(Json(body).into_response())
}

fn check_text(pointer: &str, text: &str) -> Result<(), ApiError> {
    let length = text.chars().count();
    if (1..=LONGEST_TEXT).contains(&length) && !text.chars().any(char::is_control) {
        return Ok(());
    }
    let message = format!("{} must have 1 to {LONGEST_TEXT} printable characters", shown(text));
    Err(ApiError::invalid_field(pointer.to_owned(), message))
}
