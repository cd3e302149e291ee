//! Tables (CSV) posted as one batch or cut into many, and `/v1/structures/{id}/tables/preview`, which stores nothing.

use std::sync::Arc;
use std::time::Duration;

use axum::body::{Body, Bytes};
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse as _, Response};
use axum::Json;
use serde::{Deserialize, Serialize};
use tokio::sync::{Semaphore, SemaphorePermit};
use utoipa::{IntoParams, ToSchema};

use super::access::Client;
use super::bulk::PATIENCE;
use super::error::ApiError;
use super::openapi::{BodyRefused, StructurePath, Unknown};
use super::problem::BulkAnswer;
use super::request::{media_type, read_body, structure_id, unsupported_media_type, ApiPath, ApiQuery, BodyLimits};
use super::shared::Shared;
use super::upload::{file_of_form, TableForm, FORM};
use crate::measurement::body::RawBatch;
use crate::measurement::check::{check_source, Problem};
use crate::measurement::table::options::{OptionTexts, TableOptions};
use crate::measurement::table::plan::{plan, too_long, Plan, PlannedBatch};
use crate::measurement::table::understood::{Need, Understood};
use crate::measurement::table::{read, Layout, Reading};
use crate::measurement::MeasurementBatch;
use crate::monitor::{ActiveStructure, Monitor};
use crate::quantity::{Digest, StructureId, Timestamp};

/// Larger bodies are parsed on a blocking thread: thousands of measurements take milliseconds. A body of this size
/// takes about 0.1 ms.
pub const PARSED_HERE_BYTES: usize = 16 * 1024;

/// Largest number of problems in one answer.
const MOST_PROBLEMS: usize = 20;

/// Largest number of batches that a preview lists.
const MOST_LISTED: usize = 1_000;

/// Hexadecimal digits of a derived idempotency key.
const KEY_DIGITS: usize = 32;

/// One table that is cut is read at a time: a body of 32 MiB becomes some hundred MiB of rows.
static READING: Semaphore = Semaphore::const_new(1);

/// Query of a post. CSV and NDJSON have no field for a common source; all but `source` is for CSV alone.
#[derive(Debug, Clone, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct PostQuery {
    /// Instrument, gateway or campaign; used where the body does not name one.
    #[param(min_length = 1, max_length = 64, pattern = "^[A-Za-z0-9_.:-]+$")]
    pub source: Option<String>,
    /// CSV columns to ignore, separated by commas: by name, or by number as `#3`.
    pub ignore: Option<String>,
    /// Unit of the times of a CSV that are numbers: Unix `seconds` or `milliseconds`, `serial-days` of a spreadsheet, or `decimal-year`.
    #[param(pattern = "^(seconds|milliseconds|serial-days|decimal-year)$")]
    pub time_unit: Option<String>,
    /// Cuts a CSV into batches: `1d`, `6h` or `30min` for one each such interval of local time, `gap:2h` for a new one after each pause
    /// of two hours, `none` for a single one. Required for a CSV that spans more than 48 h. The answer is then 200 with the outcome of
    /// each batch; rows that cannot be used are left out and listed.
    #[param(pattern = "^(none|(gap:)?[0-9]+(d|h|min))$", example = "1d")]
    pub split: Option<String>,
    /// Time zone of times without an offset: a name of the IANA database, or an offset such as `+01:00`.
    #[param(example = "Europe/Berlin")]
    pub zone: Option<String>,
    /// Order of dates such as 03/04/2026: `dmy` or `mdy`.
    #[param(pattern = "^(dmy|mdy)$")]
    pub date_order: Option<String>,
    /// Decimal sign of a CSV: `point` or `comma`.
    #[param(pattern = "^(point|comma)$")]
    pub decimal: Option<String>,
    /// Unit of frequencies whose header states none: `Hz`, `mHz`, `kHz` or `rad/s`.
    #[param(pattern = "^(Hz|mHz|kHz|rad/s)$")]
    pub unit: Option<String>,
    /// What columns of a CSV are, as `TARGET=COLUMN` separated by commas: `f1=Erste Biegung,time=#1`.
    pub columns: Option<String>,
    /// With `split`: refuse the whole CSV if a row cannot be used.
    pub strict: Option<bool>,
}

impl PostQuery {
    /// The options for reading a table.
    ///
    /// # Errors
    /// 422 for each option that cannot be read.
    fn options(&self) -> Result<TableOptions, ApiError> {
        let texts = OptionTexts {
            columns: self.columns.as_deref(),
            ignore: self.ignore.as_deref(),
            zone: self.zone.as_deref(),
            date_order: self.date_order.as_deref(),
            decimal: self.decimal.as_deref(),
            unit: self.unit.as_deref(),
            time_unit: self.time_unit.as_deref(),
            split: self.split.as_deref(),
        };
        TableOptions::parse(&texts).map_err(ApiError::invalid_input)
    }

    /// Checks the source.
    ///
    /// # Errors
    /// 422.
    pub fn check_source(&self) -> Result<(), ApiError> {
        let in_query = |problem| ApiError::invalid_input(vec![problem]).at("query/source");
        self.source.as_deref().map_or(Ok(()), check_source).map_err(in_query)
    }
}

/// A posted table with its options.
pub struct Posted {
    active: Arc<ActiveStructure>,
    query: PostQuery,
    options: TableOptions,
    key: Option<String>,
    bytes: Bytes,
}

impl Posted {
    /// Reads the options and the body. A table that is cut may be as large as many batches.
    ///
    /// # Errors
    /// 400, 408, 413, 415 for the body, 422 for the options or a form.
    pub async fn receive(
        active: Arc<ActiveStructure>,
        query: PostQuery,
        key: Option<String>,
        (headers, body): (&HeaderMap, Body),
        limits: BodyLimits,
    ) -> Result<Self, ApiError> {
        let options = query.options()?;
        let bytes = if options.split.is_some() { limits.bulk_bytes } else { limits.bytes };
        let bytes = table_bytes(headers, body, BodyLimits { bytes, ..limits }).await?;
        Ok(Self { active, query, options, key, bytes })
    }

    /// Whether the table is to be cut into batches.
    pub fn is_cut(&self) -> bool {
        self.options.split.is_some()
    }

    /// Whether it is small enough to be read on an async thread.
    pub fn is_small(&self) -> bool {
        self.bytes.len() <= PARSED_HERE_BYTES
    }

    fn reading(&self) -> Reading {
        let simulator = &self.active.simulator;
        let points = simulator.instrumented_points().map_or_else(Vec::new, |points| points.names.clone());
        let layout = Layout { modes: simulator.modes(), covariates: simulator.covariates(), points: &points };
        read(&self.bytes, &layout, &self.options)
    }

    fn plan(&self, monitor: &Monitor) -> Plan {
        let ingest = monitor.ingest();
        let most = ingest.max_measurements();
        plan(self.reading(), self.options.split, most, |raw| ingest.check_rows(&self.active, raw))
    }

    /// The table as one batch, in the order of its rows, and what was understood.
    ///
    /// # Errors
    /// 422 for a mistake in any row, or for a table that spans more than 48 h.
    pub fn one_batch(self, monitor: &Monitor) -> Result<(MeasurementBatch, Understood), ApiError> {
        let mut reading = self.reading();
        if !reading.problems.is_empty() {
            return Err(listed(reading.problems));
        }
        let (rows, mistakes): (Vec<_>, Vec<_>) = std::mem::take(&mut reading.rows).into_iter().partition(Result::is_ok);
        let mistakes: Vec<Problem> = mistakes.into_iter().filter_map(Result::err).collect();
        if !mistakes.is_empty() {
            return Err(listed(mistakes));
        }
        let measurements = rows.into_iter().filter_map(Result::ok).collect();
        let raw = RawBatch { source: self.query.source, idempotency_key: self.key, measurements };
        let in_its_words =
            |problems: Vec<Problem>| problems.into_iter().map(|problem| reading.in_its_words(problem)).collect();
        let batch = monitor.ingest().check(&self.active, raw).map_err(|p| ApiError::invalid_input(in_its_words(p)))?;
        let whole = PlannedBatch { line: 1, measurements: batch.measurements };
        if let Some(problem) = too_long(std::slice::from_ref(&whole)) {
            return Err(ApiError::invalid_input(vec![problem]));
        }
        let batch = MeasurementBatch { measurements: whole.measurements, ..batch };
        let mut understood = reading.understood;
        (understood.accepted, understood.batches) = (batch.measurements.len(), 1);
        Ok((batch, understood))
    }

    /// The batches into which the table is cut, each with the line of its first row, and what was understood.
    ///
    /// # Errors
    /// 422 for a table that cannot be read, without a row that can be used, or, if it must be complete, with one that cannot.
    fn batches(self, monitor: &Monitor) -> Result<(Vec<(usize, MeasurementBatch)>, Understood), ApiError> {
        let plan = self.plan(monitor);
        if !plan.problems.is_empty() {
            return Err(listed(plan.problems));
        }
        if self.query.strict == Some(true) && !plan.refused.is_empty() {
            return Err(listed(plan.refused));
        }
        let structure = self.active.simulator.id().clone();
        let source = self.query.source.unwrap_or_else(|| crate::monitor::DEFAULT_SOURCE.to_owned());
        let batch = |PlannedBatch { line, measurements }| {
            let (structure, source) = (structure.clone(), source.clone());
            let mut batch = MeasurementBatch { structure, source, idempotency_key: None, measurements };
            batch.idempotency_key = Some(derived_key(self.key.as_deref(), &batch));
            (line, batch)
        };
        Ok((plan.batches.into_iter().map(batch).collect(), plan.understood))
    }
}

/// Idempotency key of a batch of a table. It is derived from the key of the request and the first time of the batch, so that the same
/// key with other rows is noticed; without a key of the request, from the content.
fn derived_key(key: Option<&str>, batch: &MeasurementBatch) -> String {
    let digest = match key {
        Some(key) => Digest::of(&[key.as_bytes(), batch.time_span().0.to_string().as_bytes()]),
        None => batch.content_digest(),
    };
    format!("table-{}", &digest.as_str()[..KEY_DIGITS])
}

/// 422 with the first problems, and the number of the others.
fn listed(mut problems: Vec<Problem>) -> ApiError {
    let more = problems.len().saturating_sub(MOST_PROBLEMS);
    if more > 0 {
        problems.truncate(MOST_PROBLEMS);
        problems.push(Problem::new("", format!("and {more} more problems")));
    }
    ApiError::invalid_input(problems)
}

/// The table in a body.
async fn table_bytes(headers: &HeaderMap, body: Body, limits: BodyLimits) -> Result<Bytes, ApiError> {
    let kind = media_type(headers);
    let bytes = read_body(body, headers, limits).await?;
    match kind.as_deref() {
        Some("text/csv") => Ok(bytes),
        Some(FORM) => file_of_form(headers, bytes).await,
        other => Err(unsupported_media_type(other, "text/csv or multipart/form-data")),
    }
}

/// Stores the batches of a table that is cut, one after the other.
///
/// # Errors
/// 422 with nothing stored; 429 if the rate limit of measurements is exceeded, 503 when the queue stays full, and other errors of the
/// service, with the outcome of the batches before. The client may repeat the whole request safely.
pub async fn create(shared: &Shared, client: &Client, posted: Posted) -> Result<Response, ApiError> {
    let monitor = shared.monitor.clone();
    let (batches, understood) = alone(move || posted.batches(&monitor)).await??;
    let mut answer = BulkAnswer { table: Some(Box::new(understood)), ..BulkAnswer::default() };
    for (line, batch) in batches {
        let (count, (from, to)) = (batch.measurements.len(), batch.time_span());
        let taken = match within_rate(shared, client, count).await {
            Ok(()) => shared.monitor.ingest().take_within(batch, PATIENCE).await.map_err(ApiError::from),
            Err(error) => Err(error),
        };
        match taken {
            // An error of the service, or an exceeded rate limit, is not an error of the batch: the client should repeat it.
            Err(error) if error.status().is_server_error() || error.status() == StatusCode::TOO_MANY_REQUESTS => {
                return Err(error.after(answer));
            }
            taken => answer.add(line, taken),
        }
        if let Some(item) = answer.items.last_mut() {
            (item.from, item.to, item.measurements) = (Some(from), Some(to), Some(count));
        }
    }
    Ok((StatusCode::OK, Json(answer)).into_response())
}

/// Waits until the rate limit of measurements allows the next batch, at most as long as for a place in the queue. A table cannot be
/// continued where it was refused, and one of a year has more measurements than the limit of a second.
async fn within_rate(shared: &Shared, client: &Client, count: usize) -> Result<(), ApiError> {
    let until = tokio::time::Instant::now() + PATIENCE;
    loop {
        let Err(error) = shared.access.take_measurements(client, count) else { return Ok(()) };
        let pause = Duration::from_secs(error.retry_after_s().unwrap_or(1).into());
        if tokio::time::Instant::now() + pause > until {
            return Err(error);
        }
        tokio::time::sleep(pause).await;
    }
}

/// Runs the reading of a table on a blocking thread, after that of others.
async fn alone<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, ApiError> {
    let permit: SemaphorePermit<'static> = READING.acquire().await.map_err(|e| ApiError::internal(&e))?;
    let work = move || {
        let done = work();
        drop(permit);
        done
    };
    tokio::task::spawn_blocking(work).await.map_err(|e| ApiError::internal(&e))
}

/// What would be made of a table.
#[derive(Debug, Serialize, ToSchema)]
pub struct TablePreview {
    understood: Understood,
    /// What keeps the table from being stored, with the option that helps.
    problems: Vec<Problem>,
    /// The options that the table needs.
    needs: Vec<Need>,
    /// The first 1000 batches.
    batches: Vec<PreviewedBatch>,
    /// What a column can be assigned to by `columns`.
    targets: Vec<String>,
}

/// A batch that would be stored.
#[derive(Debug, Serialize, ToSchema)]
struct PreviewedBatch {
    /// Line in the file of its first measurement, from 1.
    line: usize,
    from: Timestamp,
    to: Timestamp,
    measurements: usize,
}

/// `POST /v1/structures/{id}/tables/preview`: what would be made of a table.
///
/// # Errors
/// 400, 408, 413, 415 for the body, 404 for the structure, 422 for an option that cannot be read.
#[utoipa::path(
    post, path = "/v1/structures/{id}/tables/preview", tag = "batches", operation_id = "preview_table",
    summary = "Preview a table",
    description = "Reads a CSV as `POST /v1/structures/{id}/batches` with the same query would, and stores nothing. The answer says \
                   what every column was taken for, which rows are refused and why, which batches would be made, and which options \
                   the table needs.",
    params(StructurePath, PostQuery),
    request_body(
        description = "A CSV, or a form with one file.",
        content(
            (String = "text/csv", example = json!("Datum;Mode 1 (Hz);Mode 2 (Hz);Mode 3 (Hz)\n01.03.2026 12:10;0,4949;0,9250;1,2434\n")),
            (TableForm = "multipart/form-data", example = json!({"file": "date,f1,f2,f3\n2026-03-01T12:40:00Z,0.4949,0.9250,1.2434\n"}))
        )
    ),
    responses((status = 200, description = "What would be made of the table", body = TablePreview), Unknown, BodyRefused)
)]
pub async fn preview(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    ApiQuery(query): ApiQuery<PostQuery>,
    headers: HeaderMap,
    body: Body,
) -> Result<Json<TablePreview>, ApiError> {
    let id: StructureId = structure_id(&id)?;
    let active = shared.monitor.structure(&id)?;
    query.check_source()?;
    let options = query.options()?;
    let limits = BodyLimits { bytes: shared.limits.bulk_bytes, ..shared.limits };
    let bytes = table_bytes(&headers, body, limits).await?;
    let posted = Posted { active: Arc::clone(&active), query, options, key: None, bytes };
    let monitor = shared.monitor.clone();
    let plan = alone(move || posted.plan(&monitor)).await?;
    let batch = |batch: &PlannedBatch| {
        let times = || batch.measurements.iter().map(|m| m.measured_at);
        let (from, to) = (times().min()?, times().max()?);
        Some(PreviewedBatch { line: batch.line, from, to, measurements: batch.measurements.len() })
    };
    let mut problems = plan.problems;
    problems.truncate(MOST_PROBLEMS);
    Ok(Json(TablePreview {
        batches: plan.batches.iter().take(MOST_LISTED).filter_map(batch).collect(),
        understood: plan.understood,
        problems,
        needs: plan.needs.into_iter().collect(),
        targets: targets(&active),
    }))
}

/// What a column of a table of a structure can be.
fn targets(active: &ActiveStructure) -> Vec<String> {
    let simulator = &active.simulator;
    let modes = 1..=simulator.modes();
    let times = ["time", "date", "time_of_day"].map(str::to_owned).into_iter();
    times
        .chain(modes.clone().map(|mode| format!("f{mode}_hz")))
        .chain(modes.map(|mode| format!("std_f{mode}_hz")))
        .chain(simulator.covariates().iter().map(|covariate| covariate.name.clone()))
        .chain(simulator.space().iter().map(|parameter| format!("set_{}", parameter.name)))
        .collect()
}
