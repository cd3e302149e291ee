//! `/v1/structures/{id}/history`, `/baseline` and `/exceedances`: what the batches say over time.

use axum::body::Body;
use axum::extract::State;
use axum::http::{header, HeaderMap, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

use super::answer::{HistoryItem, Undamaged, HISTORY_COLUMNS};
use super::error::ApiError;
use super::openapi::{BodyRefused, Busy, Conflict, Invalid, NotAcceptable, StructurePath, Unknown};
use super::request::{json_body, page_limit, structure_id, ApiPath, ApiQuery, Window};
use super::table::{Cell, Format, TableWriter};
use super::Shared;
use crate::monitor::ActiveStructure;
use crate::quantity::{StructureId, Timestamp};
use crate::store::HistoryQuery;

/// p of the damage threshold unless the client gives another (paper §4).
const DEFAULT_THRESHOLD_PROBABILITY: f64 = 0.05;

/// Query of the history.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct HistoryParams {
    /// Batches that begin at this time or later.
    #[param(value_type = Option<String>, format = DateTime)]
    from: Option<String>,
    /// Batches that begin before this time.
    #[param(value_type = Option<String>, format = DateTime)]
    to: Option<String>,
    /// Only this parameter, spring stiffness or group.
    #[param(min_length = 1, example = "k1")]
    parameter: Option<String>,
    /// Most batches of the page; 100 without.
    #[param(value_type = Option<u32>, minimum = 1, maximum = 1000)]
    limit: Option<String>,
    /// `next` of the page before.
    #[param(pattern = "^[0-9]{1,16}~[0-9a-z-]{1,64}$")]
    cursor: Option<String>,
    /// Without it, `Accept` decides.
    #[param(value_type = Option<TableFormat>, inline)]
    format: Option<String>,
}

/// Query of the exceedances.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct ExceedanceParams {
    /// Batches that begin at this time or later.
    #[param(value_type = Option<String>, format = DateTime)]
    from: Option<String>,
    /// Batches that begin before this time.
    #[param(value_type = Option<String>, format = DateTime)]
    to: Option<String>,
    /// Only this parameter, spring stiffness or group.
    #[param(min_length = 1, example = "k1")]
    parameter: Option<String>,
    /// Most exceedances of the page; 100 without.
    #[param(value_type = Option<u32>, minimum = 1, maximum = 1000)]
    limit: Option<String>,
    /// `next` of the page before.
    #[param(pattern = "^[0-9]{1,16}~[0-9a-z-]{1,64}~.{1,200}$")]
    cursor: Option<String>,
}

/// How a table is written.
#[derive(ToSchema)]
#[schema(rename_all = "lowercase")]
#[expect(dead_code, reason = "only its description is used")]
enum TableFormat {
    Json,
    Csv,
    #[cfg(feature = "parquet")]
    Parquet,
}

/// Batches, oldest first.
#[derive(Debug, Serialize, ToSchema)]
struct HistoryPage {
    structure: StructureId,
    items: Vec<HistoryItem>,
    /// Cursor of the next page; `null` on the last.
    next: Option<String>,
}

/// Exceedances, newest first.
#[derive(Debug, Serialize, ToSchema)]
struct ExceedancePage {
    structure: StructureId,
    items: Vec<ExceedanceItem>,
    /// Cursor of the next page; `null` on the last.
    next: Option<String>,
}

/// A probability of damage above the undamaged threshold.
#[derive(Debug, Serialize, ToSchema)]
struct ExceedanceItem {
    batch: String,
    measured_from: Timestamp,
    measured_to: Timestamp,
    parameter: String,
    unit: String,
    probability_of_damage: f64,
    threshold_probability: f64,
    threshold: f64,
    relative_change: f64,
    undamaged_version: u32,
    model_digest: String,
}

/// The undamaged state.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = BaselineInput)]
struct BaselineBody {
    /// Ids of the batches that it is taken from; ten measurements at least, all together.
    #[schema(min_items = 1)]
    batches: Vec<String>,
    /// Probability below the threshold in the undamaged state; also that above which a batch exceeds. 0.05 without.
    #[schema(exclusive_minimum = 0, maximum = 0.5)]
    threshold_probability: Option<f64>,
}

/// `GET /v1/structures/{id}/history`: assessed batches, oldest first, as JSON, CSV or Parquet.
///
/// # Errors
/// 404 for the structure, 406 for Parquet where it is not built in, 422 for the query.
#[utoipa::path(
    get, path = "/v1/structures/{id}/history", tag = "results", operation_id = "read_history",
    summary = "Batches over time",
    description = "Batches with their current assessments by the time of their first measurement, a page at a time; the header \
                   `Link` has the path of the next. As CSV or Parquet one row for each batch and parameter.",
    params(StructurePath, HistoryParams),
    responses(
        (status = 200, description = "A page", content(
            (HistoryPage = "application/json"), (String = "text/csv"), ("application/vnd.apache.parquet")
        ), headers(("Link" = String, description = "The next page, `rel=\"next\"`"))),
        Unknown, Invalid, NotAcceptable
    )
)]
pub async fn history(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    ApiQuery(query): ApiQuery<HistoryParams>,
    headers: HeaderMap,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    let active = shared.monitor.structure(&id)?;
    check_parameter(query.parameter.as_deref(), &active)?;
    let format = Format::of(query.format.as_deref(), &headers, &[Format::Json, Format::Csv, Format::Parquet])?;
    let window = Window::of(query.from.as_deref(), query.to.as_deref())?;
    let after = query.cursor.as_deref().map(parse_cursor).transpose()?;
    let limit = page_limit(query.limit.as_deref())?;
    let page = HistoryQuery {
        from: window.from,
        to: window.to,
        parameter: query.parameter.clone(),
        limit,
        after: after.map(|(time, batch, _)| (time, batch)),
        after_quantity: None,
    };
    let entries = shared.monitor.records().history(&id, &page).await?;
    let next = (entries.len() == limit).then(|| entries.last().map(|e| cursor(e.measured_from, &e.batch_id))).flatten();
    let items: Vec<HistoryItem> = entries.into_iter().map(HistoryItem::from).collect();
    let mut response = if format == Format::Json {
        Json(HistoryPage { structure: id.clone(), items, next: next.clone() }).into_response()
    } else {
        let rows: Vec<Vec<Cell>> = items.iter().flat_map(HistoryItem::rows).collect();
        let mut table = TableWriter::new(format, &HISTORY_COLUMNS)?;
        let text = table.rows(rows)?;
        let end = table.end()?;
        ([(header::CONTENT_TYPE, format.content_type())], [text, end].concat()).into_response()
    };
    let given = [
        ("from", &query.from),
        ("to", &query.to),
        ("parameter", &query.parameter),
        ("limit", &query.limit),
        ("format", &query.format),
    ];
    link_next(&mut response, &format!("/v1/structures/{id}/history"), &given, next.as_deref());
    Ok(response)
}

/// `GET /v1/structures/{id}/exceedances`: probabilities of damage above the undamaged threshold, newest first.
///
/// # Errors
/// 404 for the structure, 422 for the query.
#[utoipa::path(
    get, path = "/v1/structures/{id}/exceedances", tag = "results", operation_id = "list_exceedances",
    summary = "Exceedances",
    description = "Probabilities of damage above the threshold probability of the undamaged state, newest first, a page at a \
                   time; the header `Link` has the path of the next. An exceedance is no alarm.",
    params(StructurePath, ExceedanceParams),
    responses(
        (status = 200, description = "A page", body = ExceedancePage,
         headers(("Link" = String, description = "The next page, `rel=\"next\"`"))),
        Unknown, Invalid
    )
)]
pub async fn exceedances(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    ApiQuery(query): ApiQuery<ExceedanceParams>,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    let active = shared.monitor.structure(&id)?;
    check_parameter(query.parameter.as_deref(), &active)?;
    let window = Window::of(query.from.as_deref(), query.to.as_deref())?;
    let after = query.cursor.as_deref().map(parse_cursor).transpose()?;
    let (after, after_quantity) = after.map_or((None, None), |(time, batch, quantity)| (Some((time, batch)), quantity));
    let limit = page_limit(query.limit.as_deref())?;
    let parameter = query.parameter.clone();
    let page = HistoryQuery { from: window.from, to: window.to, parameter, limit, after, after_quantity };
    let found = shared.monitor.records().exceedances(&id, &page).await?;
    let next = (found.len() == limit)
        .then(|| found.last().map(|e| format!("{}~{}", cursor(e.measured_from, &e.batch_id), e.quantity)))
        .flatten();
    let item = |e: crate::store::Exceedance| ExceedanceItem {
        batch: e.batch_id,
        measured_from: e.measured_from,
        measured_to: e.measured_to,
        parameter: e.quantity,
        unit: e.unit,
        probability_of_damage: e.probability_of_damage,
        threshold_probability: e.threshold_probability,
        threshold: e.threshold,
        relative_change: e.relative_change,
        undamaged_version: e.undamaged_version,
        model_digest: e.model_digest.to_string(),
    };
    let items = found.into_iter().map(item).collect();
    let mut response = Json(ExceedancePage { structure: id.clone(), items, next: next.clone() }).into_response();
    let given = [("from", &query.from), ("to", &query.to), ("parameter", &query.parameter), ("limit", &query.limit)];
    link_next(&mut response, &format!("/v1/structures/{id}/exceedances"), &given, next.as_deref());
    Ok(response)
}

/// `POST /v1/structures/{id}/baseline`: takes batches as the undamaged state; 201 with its new version.
///
/// # Errors
/// 400, 415, 422 for the body, 404 for structure or batch, 409 without a trained baseline, 503 when the queue is full.
#[utoipa::path(
    post, path = "/v1/structures/{id}/baseline", tag = "results", operation_id = "declare_undamaged",
    summary = "Declare the undamaged state",
    description = "Takes batches as the undamaged state, in a new version; batches from before are compared with it too.",
    params(StructurePath),
    request_body(content = BaselineBody, example = json!({"batches": ["0199a0c6-7d5e-7c3a-a5b1-0d7e6a3f9b10"]})),
    responses(
        (status = 201, description = "The new version of the undamaged state", body = Undamaged),
        Unknown, BodyRefused, Conflict, Busy
    )
)]
pub async fn declare_baseline(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    shared.monitor.structure(&id)?;
    let body: BaselineBody = json_body(&headers, body, shared.limits).await?;
    if body.batches.is_empty() {
        return Err(ApiError::invalid_field("/batches", "name at least one batch"));
    }
    let probability = body.threshold_probability.unwrap_or(DEFAULT_THRESHOLD_PROBABILITY);
    let record = shared.monitor.replay().declare_reference(&id, body.batches, probability).await?;
    Ok((StatusCode::CREATED, Json(Undamaged::new(&id, &record))).into_response())
}

/// 422 for a name that this structure does not estimate.
fn check_parameter(name: Option<&str>, active: &ActiveStructure) -> Result<(), ApiError> {
    let Some(name) = name else { return Ok(()) };
    let mut names: Vec<String> = active.simulator.space().iter().map(|p| p.name.clone()).collect();
    names.extend(active.simulator.derived_stiffnesses().into_iter().map(|s| s.name));
    names.extend(active.baseline.iter().flat_map(|b| b.groups()).map(|g| g.name));
    if names.iter().any(|known| known == name) {
        return Ok(());
    }
    let message = format!("{} is none of {}", crate::quantity::shown(name), names.join(", "));
    Err(ApiError::invalid_field("query/parameter", message))
}

fn cursor(time: Timestamp, batch: &str) -> String {
    format!("{}~{batch}", time.micros())
}

fn parse_cursor(text: &str) -> Result<(Timestamp, String, Option<String>), ApiError> {
    let mut parts = text.splitn(3, '~');
    let time = parts.next().and_then(|t| t.parse().ok()).and_then(|t| Timestamp::from_micros(t).ok());
    match (time, parts.next()) {
        (Some(time), Some(batch)) if batch.len() <= 64 => Ok((time, batch.to_owned(), parts.next().map(str::to_owned))),
        _ => {
            let message = format!("{} was not given out by this service", crate::quantity::shown(text));
            Err(ApiError::invalid_field("query/cursor", message))
        }
    }
}

/// `Link: …; rel="next"` with the query of this page and the cursor of the next.
pub fn link_next(response: &mut Response, path: &str, given: &[(&str, &Option<String>)], next: Option<&str>) {
    // Batches arrive all the time: no page is kept.
    response.headers_mut().insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    let Some(next) = next else { return };
    let given = given.iter().filter_map(|(name, value)| value.as_ref().map(|v| format!("{name}={}&", encoded(v))));
    let link = format!("<{path}?{}cursor={}>; rel=\"next\"", given.collect::<String>(), encoded(next));
    if let Ok(value) = HeaderValue::from_str(&link) {
        response.headers_mut().insert(header::LINK, value);
    }
}

/// Percent-encoding of a query value.
fn encoded(text: &str) -> String {
    let keep = |b: u8| b.is_ascii_alphanumeric() || b"-_.~".contains(&b);
    text.bytes().map(|b| if keep(b) { char::from(b).to_string() } else { format!("%{b:02X}") }).collect()
}
