//! `/v1/structures/{id}/history`, `/baseline` and `/exceedances`: what the batches say over time.

use axum::body::Body;
use axum::extract::State;
use axum::http::{header, HeaderMap, HeaderValue, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::{Deserialize, Serialize};

use super::answer::{HistoryItem, Undamaged, HISTORY_COLUMNS};
use super::error::ApiError;
use super::request::{json_body, page_limit, structure_id, ApiPath, ApiQuery};
use super::Shared;
use crate::quantity::{StructureId, Timestamp};
use crate::store::HistoryQuery;

/// p of the damage threshold unless the client gives another (paper §4).
const DEFAULT_THRESHOLD_PROBABILITY: f64 = 0.05;

/// Query of a page.
#[derive(Debug, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PageQuery {
    from: Option<String>,
    to: Option<String>,
    parameter: Option<String>,
    limit: Option<String>,
    cursor: Option<String>,
    format: Option<String>,
}

#[derive(Debug, Serialize)]
struct HistoryPage {
    structure: StructureId,
    items: Vec<HistoryItem>,
    /// Cursor of the next page; `null` on the last.
    next: Option<String>,
}

#[derive(Debug, Serialize)]
struct ExceedancePage {
    structure: StructureId,
    items: Vec<ExceedanceItem>,
    next: Option<String>,
}

/// A probability of damage above the undamaged threshold.
#[derive(Debug, Serialize)]
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

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct BaselineBody {
    batches: Vec<String>,
    threshold_probability: Option<f64>,
}

/// `GET /v1/structures/{id}/history`: assessed batches, oldest first, as JSON or CSV.
///
/// # Errors
/// 404 for the structure, 422 for the query.
pub async fn history(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    ApiQuery(query): ApiQuery<PageQuery>,
    headers: HeaderMap,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    let watched = shared.monitor.structure(&id)?;
    if let Some(name) = &query.parameter {
        let mut names: Vec<String> = watched.simulator.space().iter().map(|p| p.name.clone()).collect();
        names.extend(watched.simulator.derived_stiffnesses().into_iter().map(|s| s.name));
        names.extend(watched.baseline.iter().flat_map(|b| b.groups()).map(|g| g.name));
        if !names.contains(name) {
            let message = format!("{} is none of {}", crate::quantity::shown(name), names.join(", "));
            return Err(ApiError::invalid_field("query/parameter", message));
        }
    }
    let csv = wants_csv(&query, &headers)?;
    let page = page(&query)?;
    let limit = page.limit;
    let entries = shared.monitor.store().history(&id, &page).await?;
    let next = (entries.len() == limit).then(|| entries.last().map(|e| cursor(e.measured_from, &e.batch_id))).flatten();
    let items: Vec<HistoryItem> = entries.into_iter().map(HistoryItem::from).collect();
    let mut response = if csv {
        ([(header::CONTENT_TYPE, "text/csv; charset=utf-8")], to_csv(&items)).into_response()
    } else {
        Json(HistoryPage { structure: id.clone(), items, next: next.clone() }).into_response()
    };
    link_next(&mut response, &format!("/v1/structures/{id}/history"), &query, next.as_deref());
    Ok(response)
}

/// `GET /v1/structures/{id}/exceedances`: probabilities of damage above the undamaged threshold, newest first.
///
/// # Errors
/// 404 for the structure, 422 for the query.
pub async fn exceedances(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    ApiQuery(query): ApiQuery<PageQuery>,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    shared.monitor.structure(&id)?;
    let page = page(&query)?;
    let limit = page.limit;
    let found = shared.monitor.store().exceedances(&id, &page).await?;
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
    link_next(&mut response, &format!("/v1/structures/{id}/exceedances"), &query, next.as_deref());
    Ok(response)
}

/// `POST /v1/structures/{id}/baseline`: takes batches as the undamaged state; 201 with its new version.
///
/// # Errors
/// 400, 415, 422 for the body, 404 for structure or batch, 409 without a trained baseline, 503 when the queue is full.
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
    let record = shared.monitor.declare_undamaged(&id, body.batches, probability).await?;
    Ok((StatusCode::CREATED, Json(Undamaged::new(&id, record))).into_response())
}

fn page(query: &PageQuery) -> Result<HistoryQuery, ApiError> {
    let time = |name: &str, text: &Option<String>| {
        let parse = |text: &String| {
            // A plus sign in a query stands for a blank; in an offset it was meant as a plus.
            Timestamp::parse(&text.replace(' ', "+"))
                .map_err(|e| ApiError::invalid_field(format!("query/{name}"), e.to_string()))
        };
        text.as_ref().map(parse).transpose()
    };
    let limit = page_limit(query.limit.as_deref())?;
    let after = query.cursor.as_deref().map(parse_cursor).transpose()?;
    let (after, after_quantity) = after.map_or((None, None), |(time, batch, quantity)| (Some((time, batch)), quantity));
    Ok(HistoryQuery {
        from: time("from", &query.from)?,
        to: time("to", &query.to)?,
        parameter: query.parameter.clone(),
        limit,
        after,
        after_quantity,
    })
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

fn wants_csv(query: &PageQuery, headers: &HeaderMap) -> Result<bool, ApiError> {
    match query.format.as_deref() {
        Some("csv") => Ok(true),
        Some("json") => Ok(false),
        Some(other) => {
            let message = format!("{} is neither json nor csv", crate::quantity::shown(other));
            Err(ApiError::invalid_field("query/format", message))
        }
        None => Ok(headers.get(header::ACCEPT).is_some_and(|v| v.as_bytes().starts_with(b"text/csv"))),
    }
}

fn to_csv(items: &[HistoryItem]) -> Vec<u8> {
    let mut writer = csv::Writer::from_writer(Vec::new());
    let rows = items.iter().flat_map(HistoryItem::csv_rows);
    writer.write_record(HISTORY_COLUMNS).expect("writing to memory cannot fail");
    rows.for_each(|row| writer.write_record(row).expect("rows have as many cells as the header"));
    writer.into_inner().expect("writing to memory cannot fail")
}

/// `Link: …; rel="next"` with the query of this page and the cursor of the next.
fn link_next(response: &mut Response, path: &str, query: &PageQuery, next: Option<&str>) {
    // Batches arrive all the time: no page is kept.
    response.headers_mut().insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    let Some(next) = next else { return };
    let given = [
        ("from", &query.from),
        ("to", &query.to),
        ("parameter", &query.parameter),
        ("limit", &query.limit),
        ("format", &query.format),
    ];
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
