//! Tables (CSV) posted as one batch or cut into many, and `/v1/structures/{id}/tables/preview`, which stores nothing.

use std::sync::Arc;
use std::time::Duration;

use axum::body::{Body, Bytes};
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use axum::response::{IntoResponse as _, Response};
use axum::Json;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

use super::access::Client;
use super::bulk::PATIENCE;
use super::error::ApiError;
use super::openapi::{BodyRefused, StructurePath, Unknown};
use super::problem::BulkAnswer;
use super::request::{
    content_length, media_type, structure_id, unsupported_media_type, ApiPath, ApiQuery, ArrivingBody, BodyLimits,
};
use super::shared::Shared;
use super::table_room::{Room, SMALL_BYTES};
use super::upload::{file_of_form, TableForm, FORM};
use crate::clock;
use crate::measurement::body::RawBatch;
use crate::measurement::check::{check_source, too_many, Problem};
use crate::measurement::table::options::{OptionTexts, TableOptions};
use crate::measurement::table::plan::{plan, too_long, Plan, PlannedBatch};
use crate::measurement::table::refused::Refused;
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
    source: String,
    /// Id of the token of its sender.
    posted_by: Option<String>,
    strict: bool,
    options: TableOptions,
    key: Option<String>,
    bytes: Bytes,
    /// Its room in memory; a small table has none.
    room: Option<Room>,
}

impl Posted {
    /// Reads the options and the body. A table that is cut may be as large as many batches.
    ///
    /// # Errors
    /// 400, 408, 413, 415 for the body, 401 once the token is not valid any more, 403 for a source to which it is not limited, 422 for the
    /// options or a form.
    pub async fn receive(
        (shared, client): (&Shared, &Client),
        active: Arc<ActiveStructure>,
        query: PostQuery,
        key: Option<String>,
        (headers, body): (&HeaderMap, Body),
    ) -> Result<Self, ApiError> {
        let options = query.options()?;
        let (source, posted_by) = (client.source(query.source)?, client.token());
        let most_bytes = if options.split.is_some() { shared.limits.bulk_bytes } else { shared.limits.bytes };
        let (bytes, room) = table_bytes((shared, client), (headers, body), most_bytes).await?;
        let strict = query.strict == Some(true);
        Ok(Self { active, source, posted_by, strict, options, key, bytes, room })
    }

    /// Whether the table is to be cut into batches.
    pub fn is_cut(&self) -> bool {
        self.options.split.is_some()
    }

    fn reading(&self) -> Reading<'_> {
        let simulator = &self.active.simulator;
        let points = simulator.instrumented_points().map_or_else(Vec::new, |points| points.names.clone());
        let layout = Layout { modes: simulator.modes(), covariates: simulator.covariates(), points: &points };
        read(&self.bytes, &layout, &self.options)
    }

    fn plan(&self, monitor: &Monitor, now: Timestamp) -> Plan {
        let ingest = monitor.ingest();
        let mut rows = ingest.row_check(&self.active, now);
        plan(self.reading(), self.options.split, ingest.max_measurements(), |raw| rows.check(raw))
    }

    /// The table as one batch, in the order of its rows, and what was understood.
    ///
    /// # Errors
    /// 422 for a mistake in any row, or for a table that spans more than 48 h.
    pub fn one_batch(&self, monitor: &Monitor) -> Result<(MeasurementBatch, Understood), ApiError> {
        let (ingest, reading) = (monitor.ingest(), self.reading());
        if !reading.problems.is_empty() {
            return Err(listed(&reading.problems, reading.problems.len()));
        }
        let most = ingest.max_measurements();
        let (mut measurements, mut count, mut mistakes) = (Vec::new(), 0, Refused::new(MOST_PROBLEMS));
        reading.each_row(&mut mistakes, |row, _| {
            count += 1;
            if count <= most {
                measurements.push(row.raw);
            }
        });
        if mistakes.count() > 0 {
            return Err(listed(mistakes.first(), mistakes.count()));
        }
        if count > most {
            return Err(ApiError::invalid_input(vec![too_many(count, most)]));
        }
        let raw = RawBatch {
            source: Some(self.source.clone()),
            idempotency_key: self.key.clone(),
            posted_by: self.posted_by.clone(),
            measurements,
        };
        let in_its_words =
            |problems: Vec<Problem>| problems.into_iter().map(|problem| reading.in_its_words(problem)).collect();
        let batch = ingest.check(&self.active, raw).map_err(|p| ApiError::invalid_input(in_its_words(p)))?;
        if let Some(problem) = too_long(batch.measurements.len(), batch.time_span()) {
            return Err(ApiError::invalid_input(vec![problem]));
        }
        let mut understood = reading.understood;
        (understood.accepted, understood.batches) = (batch.measurements.len(), 1);
        Ok((batch, understood))
    }

    /// The table with the batches into which it is cut.
    ///
    /// # Errors
    /// 422 for a table that cannot be read, without a row that can be used, or, if it must be complete, with one that cannot.
    fn cut(self, monitor: &Monitor) -> Result<Cut, ApiError> {
        let now = clock::now();
        let plan = self.plan(monitor, now);
        if !plan.problems.is_empty() {
            return Err(listed(&plan.problems, plan.problems.len()));
        }
        if self.strict && plan.refused.count() > 0 {
            return Err(listed(plan.refused.first(), plan.refused.count()));
        }
        Ok(Cut { posted: self, plan, now })
    }
}

/// A table with the batches into which it is cut. They are read one by one, when they are to be stored.
struct Cut {
    posted: Posted,
    plan: Plan,
    /// The time of the check of the rows, so that those that were accepted are so again.
    now: Timestamp,
}

impl Cut {
    /// A batch by its index, and the line of its first row.
    fn batch(&self, index: usize, monitor: &Monitor) -> (usize, MeasurementBatch) {
        let Posted { active, source, posted_by, key, bytes, .. } = &self.posted;
        let planned = &self.plan.batches[index];
        let mut rows = monitor.ingest().row_check(active, self.now);
        let measurements = self.plan.measurements(bytes, planned, |raw| rows.check(raw));
        let mut batch = MeasurementBatch {
            structure: active.simulator.id().clone(),
            source: source.clone(),
            idempotency_key: None,
            posted_by: posted_by.clone(),
            measurements,
        };
        batch.idempotency_key = Some(derived_key(key.as_deref(), &batch));
        (planned.line, batch)
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

/// 422 with the first of this number of problems, and the number of the others.
fn listed(first: &[Problem], count: usize) -> ApiError {
    let mut problems: Vec<Problem> = first.iter().take(MOST_PROBLEMS).cloned().collect();
    let more = count - problems.len();
    if more > 0 {
        problems.push(Problem::new("", format!("and {more} more problems")));
    }
    ApiError::invalid_input(problems)
}

/// What is answered when there is no room for a table.
const TOO_MANY: &str = "other tables are read and stored, and there is no room for this one: send it again, and one large table after the other";

/// The table in a body of at most this size, and its room in memory. A table that is not small is read from its connection only when there
/// is room for it.
async fn table_bytes(
    (shared, client): (&Shared, &Client),
    (headers, body): (&HeaderMap, Body),
    most_bytes: usize,
) -> Result<(Bytes, Option<Room>), ApiError> {
    let kind = media_type(headers);
    let mut arriving = ArrivingBody::new(body, headers, BodyLimits { bytes: most_bytes, ..shared.limits })?;
    let announced = content_length(headers);
    let may_be_small = announced.is_none_or(|bytes| bytes <= SMALL_BYTES);
    let room = if may_be_small && arriving.read(SMALL_BYTES).await? {
        None
    } else {
        let room = shared.table_room.take(&client.key, announced.unwrap_or(most_bytes).min(most_bytes)).await;
        let room = room.ok_or_else(|| ApiError::unavailable("too_many_tables", TOO_MANY, 10))?;
        // That may have taken minutes.
        shared.access.look_again(client)?;
        arriving.read(usize::MAX).await?;
        Some(room)
    };
    let bytes = arriving.whole()?;
    let table = match kind.as_deref() {
        Some("text/csv") => bytes,
        Some(FORM) => file_of_form(headers, bytes).await?,
        other => return Err(unsupported_media_type(other, "text/csv or multipart/form-data")),
    };
    Ok((table, room))
}

/// Stores the batches of a table that is cut, one after the other.
///
/// # Errors
/// 422 with nothing stored; 429 if the rate limit of measurements is exceeded, 503 when the queue stays full, and other errors of the
/// service, with the outcome of the batches before. The client may repeat the whole request safely.
pub async fn create(shared: &Shared, client: &Client, posted: Posted) -> Result<Response, ApiError> {
    let monitor = shared.monitor.clone();
    let cut = Arc::new(read_in_turn(shared, posted, move |posted| posted.cut(&monitor)).await??);
    let mut answer = BulkAnswer { table: Some(Box::new(cut.plan.understood.clone())), ..BulkAnswer::default() };
    for index in 0..cut.plan.batches.len() {
        let (cut, monitor) = (Arc::clone(&cut), shared.monitor.clone());
        let (line, batch) = match tokio::task::spawn_blocking(move || cut.batch(index, &monitor)).await {
            Ok(read) => read,
            Err(panicked) => return Err(ApiError::internal(&panicked).after(answer)),
        };
        let (count, (from, to)) = (batch.measurements.len(), batch.time_span());
        let taken = match within_rate(shared, client, count).await {
            Ok(()) => shared.monitor.ingest().take_within(batch, PATIENCE).await.map_err(ApiError::from),
            Err(error) => Err(error),
        };
        match taken {
            // The batch itself is not wrong: the client should repeat it.
            Err(error) if error.ends_the_request() => return Err(error.after(answer)),
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
        let Some(wait_s) = error.retry_after_s() else { return Err(error) };
        let pause = Duration::from_secs(wait_s.into());
        if tokio::time::Instant::now() + pause > until {
            return Err(error);
        }
        tokio::time::sleep(pause).await;
    }
}

/// Reads a table: a small one at once or on a blocking thread, a large one there after those before it. Without an await before the batch is
/// stored, a small one is stored even if the client disconnects right after sending it.
///
/// # Errors
/// 500 if `read` panicked.
pub async fn read_in_turn<T: Send + 'static>(
    shared: &Shared,
    posted: Posted,
    read: impl FnOnce(Posted) -> T + Send + 'static,
) -> Result<T, ApiError> {
    if posted.bytes.len() <= PARSED_HERE_BYTES {
        return Ok(read(posted));
    }
    let turn = if posted.room.is_some() { Some(shared.table_room.turn().await) } else { None };
    let read = move || {
        let done = read(posted);
        drop(turn);
        done
    };
    tokio::task::spawn_blocking(read).await.map_err(|e| ApiError::internal(&e))
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
/// 400, 408, 413, 415 for the body, 401 once the token is not valid any more, 403 for a source to which it is not limited, 404 for the structure,
/// 422 for an option that cannot be read.
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
    client: Client,
    headers: HeaderMap,
    body: Body,
) -> Result<Json<TablePreview>, ApiError> {
    let id: StructureId = structure_id(&id)?;
    let active = shared.monitor.structure(&id)?;
    query.check_source()?;
    let options = query.options()?;
    let (source, posted_by) = (client.source(query.source)?, client.token());
    let (bytes, room) = table_bytes((&shared, &client), (&headers, body), shared.limits.bulk_bytes).await?;
    let posted = Posted {
        active: Arc::clone(&active),
        source,
        posted_by,
        strict: query.strict == Some(true),
        options,
        key: None,
        bytes,
        room,
    };
    let monitor = shared.monitor.clone();
    let plan = read_in_turn(&shared, posted, move |posted| posted.plan(&monitor, clock::now())).await?;
    let batch = |batch: &PlannedBatch| {
        let PlannedBatch { line, from, to, .. } = *batch;
        PreviewedBatch { line, from, to, measurements: batch.count() }
    };
    let mut problems = plan.problems;
    problems.truncate(MOST_PROBLEMS);
    Ok(Json(TablePreview {
        batches: plan.batches.iter().take(MOST_LISTED).map(batch).collect(),
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
