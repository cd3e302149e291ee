//! `/v1/structures/{id}/history` and `/exceedances`: results of the batches over time.

use axum::body::Bytes;
use axum::extract::State;
use axum::http::{header, HeaderMap, HeaderValue};
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

use super::access::Client;
use super::answer::{HistoryItem, HISTORY_COLUMNS};
use super::error::ApiError;
use super::file_parts::{file, Basis, FileParts};
use super::openapi::{Invalid, NotAcceptable, StructurePath, Unknown};
use super::request::{page_limit, structure_id, ApiPath, ApiQuery, Window};
use super::shared::Shared;
use super::table::{Format, TableWriter};
use crate::monitor::stored::HistoryQuery;
use crate::monitor::{ActiveStructure, Records};
use crate::quantity::{StructureId, Timestamp};

/// Number of batches that are read for a part of a file.
const FILE_PAGE: usize = 500;

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
    /// Maximum number of batches on the page, 100 by default, or in the file, all by default.
    #[param(value_type = Option<u32>, minimum = 1, maximum = 1000)]
    limit: Option<String>,
    /// `next` of the previous page.
    #[param(pattern = "^[0-9]{1,16}~[0-9a-z-]{1,64}$")]
    cursor: Option<String>,
    /// Format of the answer; by default the one named in `Accept`.
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
    /// Maximum number of exceedances on the page. Default 100.
    #[param(value_type = Option<u32>, minimum = 1, maximum = 1000)]
    limit: Option<String>,
    /// `next` of the previous page.
    #[param(pattern = "^[0-9]{1,16}~[0-9a-z-]{1,64}~.{1,200}$")]
    cursor: Option<String>,
}

/// Formats of a table.
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

/// A probability of damage that is larger than its threshold probability.
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

/// `GET /v1/structures/{id}/history`: assessed batches, oldest first, as JSON, CSV or Parquet.
///
/// # Errors
/// 404 for the structure, 406 for Parquet if it is not built in, 422 for the query.
#[utoipa::path(
    get, path = "/v1/structures/{id}/history", tag = "results", operation_id = "read_history",
    summary = "Batches over time",
    description = "Batches with their current assessments, ordered by the time of their first measurement. JSON is sent in pages, and the \
                   `Link` header has the path of the next page; CSV and Parquet are sent as one file for the whole interval, with one row \
                   for each batch and parameter.",
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
    client: Client,
    headers: HeaderMap,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    let active = shared.monitor.structure(&id)?;
    check_parameter(query.parameter.as_deref(), &active)?;
    let format = Format::of(query.format.as_deref(), &headers, &[Format::Json, Format::Csv, Format::Parquet])?;
    let window = Window::of(query.from.as_deref(), query.to.as_deref())?;
    let after = query.cursor.as_deref().map(parse_cursor).transpose()?;
    let limit = page_limit(query.limit.as_deref())?;
    let mut page = HistoryQuery {
        from: window.from,
        to: window.to,
        parameter: query.parameter.clone(),
        limit,
        after: after.map(|(time, batch, _)| (time, batch)),
        after_quantity: None,
    };
    if format != Format::Json {
        page.limit = FILE_PAGE;
        let records = shared.monitor.records().clone();
        let name = format!("{id}-history");
        let left = query.limit.as_ref().map(|_| limit);
        let table = TableWriter::new(format, &HISTORY_COLUMNS)?;
        let basis = Basis::now(&shared, client, &id).await?;
        return file(basis, HistoryFile { records, structure: id, page, left, table }, format, &name).await;
    }
    let entries = shared.monitor.records().history(&id, &page).await?;
    let next = (entries.len() == limit).then(|| entries.last().map(|e| cursor(e.measured_from, &e.batch_id))).flatten();
    let items: Vec<HistoryItem> = entries.into_iter().map(HistoryItem::from).collect();
    let mut response = Json(HistoryPage { structure: id.clone(), items, next: next.clone() }).into_response();
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

/// The history as a file that is being sent.
struct HistoryFile {
    records: Records,
    structure: StructureId,
    /// The next page to read.
    page: HistoryQuery,
    /// Number of requested batches that are still to be sent; `None` for all.
    left: Option<usize>,
    table: TableWriter,
}

impl FileParts for HistoryFile {
    async fn part(mut self) -> Result<(Bytes, Option<Self>), ApiError> {
        self.page.limit = self.left.map_or(FILE_PAGE, |left| left.min(FILE_PAGE));
        let found = self.records.history(&self.structure, &self.page).await?;
        self.left = self.left.map(|left| left - found.len());
        let last = found.len() < self.page.limit || self.left == Some(0);
        self.page.after = found.last().map(|entry| (entry.measured_from, entry.batch_id.clone())).or(self.page.after);
        let Self { records, structure, page, left, mut table } = self;
        // Writing hundreds of rows takes milliseconds, which must not block an async thread.
        let write = move || {
            let items: Vec<HistoryItem> = found.into_iter().map(HistoryItem::from).collect();
            let bytes = table.rows(items.iter().flat_map(HistoryItem::rows).collect())?;
            Ok::<_, ApiError>(if last { ([bytes, table.end()?].concat(), None) } else { (bytes, Some(table)) })
        };
        let (bytes, table) = tokio::task::spawn_blocking(write).await.map_err(|e| ApiError::internal(&e))??;
        Ok((bytes.into(), table.map(|table| Self { records, structure, page, left, table })))
    }
}

/// `GET /v1/structures/{id}/exceedances`: probabilities of damage above the threshold probability, newest first.
///
/// # Errors
/// 404 for the structure, 422 for the query.
#[utoipa::path(
    get, path = "/v1/structures/{id}/exceedances", tag = "results", operation_id = "list_exceedances",
    summary = "Exceedances",
    description = "Probabilities of damage above the threshold probability of the undamaged reference, newest first, in pages; the \
                   `Link` header has the path of the next page. An exceedance does not by itself raise an alarm.",
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
    let item = |e: crate::monitor::stored::Exceedance| ExceedanceItem {
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

/// 422 for a name that is not a quantity of this structure.
fn check_parameter(name: Option<&str>, active: &ActiveStructure) -> Result<(), ApiError> {
    let Some(name) = name else { return Ok(()) };
    let mut names: Vec<String> = active.simulator.space().iter().map(|p| p.name.clone()).collect();
    names.extend(active.simulator.derived_stiffnesses().into_iter().map(|s| s.name));
    names.extend(active.baseline.iter().flat_map(|b| b.groups()).map(|g| g.name));
    if names.iter().any(|known| known == name) {
        return Ok(());
    }
    let message = format!("{} is not one of {}", crate::quantity::shown(name), names.join(", "));
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
            let message = format!("{} is not a cursor of this service", crate::quantity::shown(text));
            Err(ApiError::invalid_field("query/cursor", message))
        }
    }
}

/// Adds `Link: …; rel="next"` with the query of this page and the cursor of the next.
pub fn link_next(response: &mut Response, path: &str, given: &[(&str, &Option<String>)], next: Option<&str>) {
    // Batches arrive at any time, so a page must not be cached.
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
