//! `/v1/structures/{id}/measurements`: the measurements as they were received.
//!
//! JSON is sent in pages; CSV, NDJSON and Parquet as one file for the whole interval. A file is written page by page
//! while it is sent, so that the memory needed does not depend on its size and no transaction stays open for a slow
//! reader.

use axum::body::Bytes;
use axum::extract::State;
use axum::http::HeaderMap;
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

use super::access::Client;
use super::cell::{Cell, ColumnKind};
use super::error::ApiError;
use super::file_parts::{file, Basis, FileParts};
use super::history::link_next;
use super::openapi::{Invalid, NotAcceptable, StructurePath, Unknown};
use super::request::{page_limit, structure_id, ApiPath, ApiQuery, Window};
use super::shared::Shared;
use super::table::{Format, TableWriter};
use crate::measurement::{Covariate, CovariateKind, CovariateValue, ModalMeasurement};
use crate::monitor::stored::{MeasurementPlace, MeasurementQuery, StoredMeasurement};
use crate::monitor::{ActiveStructure, Records};
use crate::quantity::{shown, Hertz, StructureId, Timestamp};

/// Measurements read from the store at a time.
const PAGE: usize = 2_000;

/// The same for Parquet, which is smaller and faster with large row groups.
const ROW_GROUP: usize = 10_000;

/// Query of the measurements.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct MeasurementParams {
    /// Measured at this time or later.
    #[param(value_type = Option<String>, format = DateTime)]
    from: Option<String>,
    /// Measured before this time.
    #[param(value_type = Option<String>, format = DateTime)]
    to: Option<String>,
    /// Format of the answer; by default the one named in `Accept`.
    #[param(value_type = Option<ExportFormat>, inline)]
    format: Option<String>,
    /// Maximum number of measurements. Default: 100 for JSON, all for other formats.
    #[param(value_type = Option<u32>, minimum = 1, maximum = 1000)]
    limit: Option<String>,
    /// `next` of the previous page.
    #[param(pattern = "^[0-9]{1,16}~[0-9a-z-]{1,64}~[0-9]{1,9}$")]
    cursor: Option<String>,
}

/// Formats of measurements.
#[derive(ToSchema)]
#[schema(rename_all = "lowercase")]
#[expect(dead_code, reason = "only its description is used")]
enum ExportFormat {
    Json,
    Csv,
    Ndjson,
    #[cfg(feature = "parquet")]
    Parquet,
}

/// Measurements in the order of the history.
#[derive(Debug, Serialize, ToSchema)]
struct MeasurementPage {
    structure: StructureId,
    items: Vec<MeasurementItem>,
    /// Cursor of the next page; `null` on the last.
    next: Option<String>,
}

/// A measurement with its batch and source.
#[derive(Debug, Serialize, ToSchema)]
struct MeasurementItem {
    batch: String,
    source: String,
    #[serde(flatten)]
    measurement: ModalMeasurement,
}

impl From<StoredMeasurement> for MeasurementItem {
    fn from(stored: StoredMeasurement) -> Self {
        Self { batch: stored.place.batch_id, source: stored.source, measurement: stored.measurement }
    }
}

/// `GET /v1/structures/{id}/measurements`: raw measurements in a time interval.
///
/// # Errors
/// 404 for the structure, 406 for Parquet if it is not built in, 422 for the query.
#[utoipa::path(
    get, path = "/v1/structures/{id}/measurements", tag = "batches", operation_id = "export_measurements",
    summary = "Raw measurements",
    description = "Measurements in the order of the history: batches by the time of their first measurement, and within a batch \
                   in the order received. JSON is sent in pages, and the `Link` header has the path of the next page; CSV, NDJSON \
                   and Parquet are sent as one file for the whole interval. A table has the columns `measured_at`, `source`, \
                   `batch`, `f1_hz` …, `std_f1_hz` …, the declared covariates and `set_<parameter>`; mode shapes are in JSON and \
                   NDJSON only. A table posted again with `ignore=source,batch` is recognised as the same batch.",
    params(StructurePath, MeasurementParams),
    responses(
        (status = 200, description = "Measurements", content(
            (MeasurementPage = "application/json"), (String = "text/csv"), (MeasurementItem = "application/x-ndjson"),
            ("application/vnd.apache.parquet")
        ), headers(("Link" = String, description = "The next page, `rel=\"next\"`"))),
        Unknown, Invalid, NotAcceptable
    )
)]
pub async fn measurements(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    ApiQuery(query): ApiQuery<MeasurementParams>,
    client: Client,
    headers: HeaderMap,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    shared.monitor.structure(&id)?;
    let allowed = [Format::Json, Format::Csv, Format::Ndjson, Format::Parquet];
    let format = Format::of(query.format.as_deref(), &headers, &allowed)?;
    let window = Window::of(query.from.as_deref(), query.to.as_deref())?;
    let after = query.cursor.as_deref().map(parse_cursor).transpose()?;
    let limit = query.limit.as_deref().map(|limit| page_limit(Some(limit))).transpose()?;
    let records = shared.monitor.records().clone();
    let mut page = MeasurementQuery { from: window.from, to: window.to, limit: page_limit(None)?, after };
    if format != Format::Json {
        page.limit = if format == Format::Parquet { ROW_GROUP } else { PAGE };
        let basis = Basis::now(&shared, client, &id).await?;
        let writer = Writer::new(format, &*shared.monitor.structure(&id)?)?;
        let name = format!("{id}-measurements");
        let export = Export { records, structure: id, page, left: limit, writer };
        return file(basis, export, format, &name).await;
    }
    page.limit = limit.unwrap_or(page.limit);
    let found = records.measurements(&id, &page).await?;
    let next = (found.len() == page.limit).then(|| found.last().map(|m| cursor(&m.place))).flatten();
    let items = found.into_iter().map(MeasurementItem::from).collect();
    let mut response = Json(MeasurementPage { structure: id.clone(), items, next: next.clone() }).into_response();
    let given = [("from", &query.from), ("to", &query.to), ("format", &query.format), ("limit", &query.limit)];
    link_next(&mut response, &format!("/v1/structures/{id}/measurements"), &given, next.as_deref());
    Ok(response)
}

fn cursor(position: &MeasurementPlace) -> String {
    format!("{}~{}~{}", position.batch_from.micros(), position.batch_id, position.ordinal)
}

fn parse_cursor(text: &str) -> Result<MeasurementPlace, ApiError> {
    let mut parts = text.splitn(3, '~');
    let time = parts.next().and_then(|t| t.parse().ok()).and_then(|t| Timestamp::from_micros(t).ok());
    let batch = parts.next().filter(|batch| batch.len() <= 64);
    if let (Some(batch_from), Some(batch), Some(ordinal)) = (time, batch, parts.next().and_then(|n| n.parse().ok())) {
        return Ok(MeasurementPlace { batch_from, batch_id: batch.to_owned(), ordinal });
    }
    let message = format!("{} is not a cursor of this service", shown(text));
    Err(ApiError::invalid_field("query/cursor", message))
}

/// A file that is being sent.
struct Export {
    records: Records,
    structure: StructureId,
    /// The next page to read.
    page: MeasurementQuery,
    /// Number of requested measurements that are still to be sent; `None` for all.
    left: Option<usize>,
    writer: Writer,
}

impl FileParts for Export {
    async fn part(mut self) -> Result<(Bytes, Option<Self>), ApiError> {
        self.page.limit = self.left.map_or(self.page.limit, |left| left.min(self.page.limit));
        let found = self.records.measurements(&self.structure, &self.page).await?;
        self.left = self.left.map(|left| left - found.len());
        let last = found.len() < self.page.limit || self.left == Some(0);
        self.page.after = found.last().map(|m| m.place.clone()).or(self.page.after);
        // Writing thousands of rows takes milliseconds, which must not block an async thread.
        let mut writer = self.writer;
        let write = move || {
            let bytes = writer.write(found)?;
            Ok::<_, ApiError>(if last { ([bytes, writer.end()?].concat(), None) } else { (bytes, Some(writer)) })
        };
        let (bytes, writer) = tokio::task::spawn_blocking(write).await.map_err(|e| ApiError::internal(&e))??;
        let rest = writer.map(|writer| Self { writer, ..self });
        Ok((bytes.into(), rest))
    }
}

/// Writes measurements as a file.
enum Writer {
    Ndjson,
    Table { table: TableWriter, columns: Columns },
}

/// The columns that depend on the structure.
struct Columns {
    modes: usize,
    covariates: Vec<Covariate>,
    settings: Vec<String>,
}

impl Writer {
    fn new(format: Format, active: &ActiveStructure) -> Result<Self, ApiError> {
        if format == Format::Ndjson {
            return Ok(Self::Ndjson);
        }
        let simulator = &active.simulator;
        let columns = Columns {
            modes: simulator.modes(),
            covariates: simulator.covariates().to_vec(),
            settings: simulator.space().iter().map(|p| p.name.clone()).collect(),
        };
        Ok(Self::Table { table: TableWriter::new(format, &columns.header())?, columns })
    }

    fn write(&mut self, measurements: Vec<StoredMeasurement>) -> Result<Vec<u8>, ApiError> {
        match self {
            Self::Ndjson => {
                let mut text = Vec::new();
                for stored in measurements {
                    let item = MeasurementItem::from(stored);
                    serde_json::to_writer(&mut text, &item).map_err(|e| ApiError::internal(&e))?;
                    text.push(b'\n');
                }
                Ok(text)
            }
            Self::Table { table, columns } => table.rows(measurements.into_iter().map(|m| columns.row(m)).collect()),
        }
    }

    fn end(self) -> Result<Vec<u8>, ApiError> {
        match self {
            Self::Ndjson => Ok(Vec::new()),
            Self::Table { table, .. } => table.end(),
        }
    }
}

impl Columns {
    fn header(&self) -> Vec<(String, ColumnKind)> {
        let mut header = vec![
            ("measured_at".to_owned(), ColumnKind::Time),
            ("source".to_owned(), ColumnKind::Text),
            ("batch".to_owned(), ColumnKind::Text),
        ];
        header.extend((1..=self.modes).map(|mode| (format!("f{mode}_hz"), ColumnKind::Number)));
        header.extend((1..=self.modes).map(|mode| (format!("std_f{mode}_hz"), ColumnKind::Number)));
        header.extend(self.covariates.iter().map(|c| {
            let kind = if c.kind == CovariateKind::Number { ColumnKind::Number } else { ColumnKind::Text };
            (c.name.clone(), kind)
        }));
        header.extend(self.settings.iter().map(|name| (format!("set_{name}"), ColumnKind::Number)));
        header
    }

    fn row(&self, stored: StoredMeasurement) -> Vec<Cell> {
        let StoredMeasurement { place, source, measurement: m } = stored;
        let mut row = vec![Cell::Time(m.measured_at), Cell::Text(source), Cell::Text(place.batch_id)];
        row.extend(
            (0..self.modes).map(|mode| Cell::number(m.frequencies_hz.get(mode).copied().flatten().map(Hertz::get))),
        );
        let std = |mode: usize| m.std_hz.as_ref().and_then(|stds| stds.get(mode).copied().flatten());
        row.extend((0..self.modes).map(|mode| Cell::number(std(mode))));
        row.extend(self.covariates.iter().map(|c| match m.covariates.get(&c.name) {
            Some(CovariateValue::Number(number)) => Cell::Number(*number),
            Some(CovariateValue::Category(text)) => Cell::Text(text.clone()),
            None => Cell::Empty,
        }));
        row.extend(self.settings.iter().map(|name| Cell::number(m.settings.get(name).copied())));
        row
    }
}
