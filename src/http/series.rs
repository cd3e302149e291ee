//! `/v1/structures/{id}/series`: all time series of a structure, reduced to the resolution of a screen.

use std::collections::BTreeMap;

use axum::extract::State;
use axum::http::header;
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::{Deserialize, Serialize};
use utoipa::{IntoParams, ToSchema};

use super::error::ApiError;
use super::notes::NoteItem;
use super::openapi::{Invalid, StructurePath, Unknown};
use super::request::{structure_id, ApiPath, ApiQuery, Window};
use super::shared::Shared;
use crate::damage::{QuantityKind, UndamagedReference};
use crate::measurement::{Covariate, CovariateKind};
use crate::monitor::stored::{
    ChartMark, ChartSeries, Episode, EpisodeQuery, MaintenanceWindow, QuantityMark, QuantitySeries, ReferenceVersion,
    SeriesWindow, TrustMark,
};
use crate::monitor::{FoundReference, Series};
use crate::quantity::{shown, StructureId, Timestamp};
use crate::reduction::{Reduced, Row};
use crate::trust::{FindingCode, TrustVerdict};

/// Series that are read at a time; each uses three of the eight connections of the store.
pub const MOST_AT_A_TIME: usize = 2;
/// Number of points if the client does not specify one.
const DEFAULT_POINTS: usize = 1_000;
/// Minimum and maximum number of points.
const POINTS: [usize; 2] = [10, 5_000];
/// Number of newest alarms that are considered.
const MOST_ALARMS: usize = 1_000;

/// Query of the series.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct SeriesQuery {
    /// Batches that begin at this time or later.
    #[param(value_type = Option<String>, format = DateTime)]
    from: Option<String>,
    /// Batches that begin before this time, which must be after `from`.
    #[param(value_type = Option<String>, format = DateTime)]
    to: Option<String>,
    /// Approximate number of points of a series. Default 1000.
    #[param(value_type = Option<u32>, minimum = 10, maximum = 5000)]
    points: Option<String>,
}

/// All time series of a structure.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Series)]
struct SeriesBody {
    structure: StructureId,
    /// As requested; otherwise the times of the first and last measurement.
    #[schema(required)]
    from: Option<Timestamp>,
    #[schema(required)]
    to: Option<Timestamp>,
    batches: u64,
    measurements: u64,
    /// True if any series was reduced.
    reduced: bool,
    /// Only every n-th measurement was considered; absent if all were.
    #[serde(skip_serializing_if = "Option::is_none")]
    thinned_to_every: Option<u64>,
    frequencies: Frequencies,
    parameters: Vec<Track>,
    charts: Vec<Chart>,
    trust: Vec<TrustPoint>,
    alarms: Vec<AlarmSpan>,
    maintenance: Vec<MaintenanceSpan>,
    notes: Vec<NoteItem>,
    /// The versions of the undamaged reference that begin in the time span, the newest first.
    references: Vec<ReferenceSpan>,
    /// How many stored rows of the time span cannot be read and are left out.
    #[serde(skip_serializing_if = "Option::is_none")]
    unreadable: Option<String>,
    /// Why the undamaged reference cannot be read, whose means and thresholds are then missing.
    #[serde(skip_serializing_if = "Option::is_none")]
    undamaged_unreadable: Option<String>,
}

/// One entry per selected measurement; `values_hz` has one value per mode. An entry without values marks a gap in time.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = FrequencySeries)]
struct Frequencies {
    modes: usize,
    nominal_hz: Vec<f64>,
    times: Vec<Timestamp>,
    values_hz: Vec<Vec<Option<f64>>>,
    covariates: BTreeMap<String, Vec<Option<f64>>>,
    /// Unit of each covariate that has one: stated in the structure file, or else that at the end of its name.
    covariate_units: BTreeMap<String, String>,
}

/// A monitored quantity; `low` and `high` bound the 90 % interval of the mean.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = ParameterSeries)]
struct Track {
    name: String,
    unit: String,
    kind: QuantityKind,
    #[schema(required)]
    threshold: Option<f64>,
    #[schema(required)]
    undamaged_mean: Option<f64>,
    times: Vec<Timestamp>,
    batches: Vec<String>,
    mean: Vec<Option<f64>>,
    low: Vec<Option<f64>>,
    high: Vec<Option<f64>>,
    probability_of_damage: Vec<Option<f64>>,
    pod_low: Vec<Option<f64>>,
    pod_high: Vec<Option<f64>>,
}

/// A control chart with one entry per batch.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = ChartSeries)]
struct Chart {
    /// The parameter, `simulation:fit`, or `structure:joint` for all parameters together.
    chart: String,
    /// True with a process behind the undamaged reference: `shift` is then the evidence on its fast chart, which finds steps, and `ewma`
    /// that on its slow chart, which finds small lasting losses, both in standard deviations.
    is_process: bool,
    times: Vec<Timestamp>,
    batches: Vec<String>,
    shift: Vec<Option<f64>>,
    shift_limit: Vec<f64>,
    ewma: Vec<Option<f64>>,
    ewma_limit: Vec<Option<f64>>,
    held: Vec<bool>,
    state: Vec<String>,
}

/// Whether a batch was accepted.
#[derive(Debug, Serialize, ToSchema)]
struct TrustPoint {
    time: Timestamp,
    batch: String,
    verdict: TrustVerdict,
    findings: Vec<FindingCode>,
    #[schema(required)]
    p_value: Option<f64>,
}

/// An alarm, from its opening to its end.
#[derive(Debug, Serialize, ToSchema)]
struct AlarmSpan {
    alarm: i64,
    kind: String,
    /// The parameters that have certainly changed.
    parameters: Vec<String>,
    opened_at: Timestamp,
    #[schema(required)]
    ended_at: Option<Timestamp>,
    state: &'static str,
}

/// The time in which a version of the undamaged reference was measured.
#[derive(Debug, Serialize, ToSchema)]
struct ReferenceSpan {
    version: u32,
    from: Timestamp,
    to: Timestamp,
    /// Why it was made.
    #[schema(required)]
    reason: Option<String>,
}

/// A maintenance window.
#[derive(Debug, Serialize, ToSchema)]
struct MaintenanceSpan {
    from: Timestamp,
    to: Timestamp,
    reason: String,
}

/// `GET /v1/structures/{id}/series`: frequencies, parameters, charts, trust, alarms and maintenance of the batches that
/// begin in a time interval.
///
/// # Errors
/// 404 for the structure, 422 for the query.
#[utoipa::path(
    get, path = "/v1/structures/{id}/series", tag = "results", operation_id = "read_series",
    summary = "All time series",
    description = "Frequencies, parameters, charts, trust, alarms and maintenance of the batches that begin in a time interval. Long \
                   series are reduced; the extremes of each segment are kept.",
    params(StructurePath, SeriesQuery),
    responses((status = 200, description = "The series", body = SeriesBody), Unknown, Invalid)
)]
pub async fn series(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    ApiQuery(query): ApiQuery<SeriesQuery>,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    let active = shared.monitor.structure(&id)?;
    let window = window(&query)?;
    // A long interval occupies three connections of the store; the others must stay available.
    let _turn = shared.series.acquire().await.map_err(|e| ApiError::internal(&e))?;
    let (modes, declared) = (active.simulator.modes(), active.simulator.covariates().iter());
    let names: Vec<String> = declared.filter(|c| c.kind == CovariateKind::Number).map(|c| c.name.clone()).collect();
    let unit = |c: &Covariate| Some((c.name.clone(), c.unit()?.to_owned()));
    let covariate_units = active.simulator.covariates().iter().filter_map(unit).collect();
    let Series { extent, measured, quantities, trust, charts, unreadable: left_out } =
        shared.monitor.records().series(&id, window, modes, &names).await?;
    let (from, to) = (window.from.or(extent.measured.map(|m| m.0)), window.to.or(extent.measured.map(|m| m.1)));
    let reduced = measured.reduced
        || trust.reduced
        || extent.stride() > 1
        || quantities.iter().any(|q| q.batches.reduced)
        || charts.iter().any(|c| c.points.reduced);

    // The reference applies only if it was made with the trained model in use.
    let in_use = active.baseline.as_ref().ok().map(|baseline| baseline.digest());
    let FoundReference { record, unreadable } = shared.monitor.records().reference(&id).await?;
    let undamaged = record.filter(|u| in_use == Some(&u.model_digest));
    let within = |begin: Timestamp, end: Option<Timestamp>| {
        to.is_none_or(|to| begin <= to) && from.is_none_or(|from| end.is_none_or(|end| end >= from))
    };
    // Alarms of a superseded reference have no points on these charts.
    let current = EpisodeQuery { before: None, open_only: false, superseded: false, limit: MOST_ALARMS };
    let episodes = shared.monitor.alarms().episodes(&id, current).await?;
    let maintenance = shared.monitor.alarms().maintenance(&id).await?;
    let notes = shared.monitor.alarms().notes(&id).await?;
    let versions = shared.monitor.records().reference_versions(&id).await?;
    let body = SeriesBody {
        from,
        to,
        batches: extent.batches,
        measurements: extent.measurements,
        reduced,
        thinned_to_every: Some(extent.stride()).filter(|stride| *stride > 1),
        frequencies: Frequencies {
            covariate_units,
            ..frequencies(measured, active.simulator.nominal_frequencies_hz(), &names)?
        },
        parameters: quantities
            .into_iter()
            .map(|q| track(q, undamaged.as_ref().map(|u| &u.state)))
            .collect::<Result<_, _>>()?,
        charts: charts.into_iter().map(chart).collect::<Result<_, _>>()?,
        trust: trust.rows.into_iter().map(trust_point).collect::<Result<_, _>>()?,
        alarms: episodes.into_iter().filter(|e| !e.withdrawn && within(e.opened_at, e.ended_at)).map(alarm).collect(),
        maintenance: maintenance.into_iter().filter(|w| within(w.from, Some(w.to))).map(maintenance_span).collect(),
        notes: notes.into_iter().filter(|n| within(n.from, Some(n.to.unwrap_or(n.from)))).map(NoteItem::from).collect(),
        references: versions
            .into_iter()
            .filter(|v| within(v.measured_from, Some(v.measured_to)))
            .map(reference_span)
            .collect(),
        unreadable: left_out,
        undamaged_unreadable: unreadable,
        structure: id,
    };
    Ok(([(header::CACHE_CONTROL, "no-store")], Json(body)).into_response())
}

fn window(query: &SeriesQuery) -> Result<SeriesWindow, ApiError> {
    let Window { from, to } = Window::of(query.from.as_deref(), query.to.as_deref())?;
    if let (Some(from), Some(to)) = (from, to) {
        if to <= from {
            return Err(ApiError::invalid_field("query/to", format!("{to} is not after {from}, which is query/from")));
        }
    }
    let points = match query.points.as_deref() {
        None => DEFAULT_POINTS,
        Some(text) => text.parse().ok().filter(|n| (POINTS[0]..=POINTS[1]).contains(n)).ok_or_else(|| {
            let message = format!("{} must be a whole number from {} to {}", shown(text), POINTS[0], POINTS[1]);
            ApiError::invalid_field("query/points", message)
        })?,
    };
    Ok(SeriesWindow { from, to, points })
}

/// Measurements, with an empty entry in each gap.
fn frequencies(measured: Reduced<()>, nominal_hz: Vec<f64>, covariates: &[String]) -> Result<Frequencies, ApiError> {
    let modes = nominal_hz.len();
    let entries = measured.rows.len() + measured.gaps.len();
    let (mut times, mut values_hz) = (Vec::with_capacity(entries), Vec::with_capacity(entries));
    let mut of_covariates = vec![Vec::with_capacity(entries); covariates.len()];
    let mut gaps = measured.gaps.into_iter().peekable();
    let mut put = |time_us: i64, values: Vec<Option<f64>>| {
        times.push(time(time_us)?);
        of_covariates.iter_mut().zip(&values[modes..]).for_each(|(column, value)| column.push(*value));
        values_hz.push(values[..modes].to_vec());
        Ok::<_, ApiError>(())
    };
    for (index, row) in measured.rows.iter().enumerate() {
        if let Some((middle, _)) = gaps.next_if(|(_, behind)| *behind == index) {
            put(middle, vec![None; modes + covariates.len()])?;
        }
        put(row.time_us, row.values.iter().copied().map(number).collect())?;
    }
    let covariates = covariates.iter().cloned().zip(of_covariates).collect();
    Ok(Frequencies { modes, nominal_hz, times, values_hz, covariates, covariate_units: BTreeMap::new() })
}

fn track(series: QuantitySeries, undamaged: Option<&UndamagedReference>) -> Result<Track, ApiError> {
    let state = undamaged.and_then(|state| state.quantities.iter().find(|q| q.name == series.name));
    let rows = series.batches.rows;
    let [mean, probability_of_damage] = columns(&rows);
    let times = times(&rows)?;
    let column = |of: fn(&QuantityMark) -> Option<f64>| rows.iter().map(|row| of(&row.tag)).collect();
    Ok(Track {
        name: series.name,
        unit: series.unit,
        kind: series.kind,
        threshold: state.and_then(|q| q.threshold),
        undamaged_mean: state.map(|q| q.mean),
        times,
        mean,
        low: column(|mark| mark.mean_interval[0]),
        high: column(|mark| mark.mean_interval[1]),
        probability_of_damage,
        pod_low: column(|mark| mark.probability_interval[0]),
        pod_high: column(|mark| mark.probability_interval[1]),
        batches: rows.into_iter().map(|row| row.tag.batch).collect(),
    })
}

fn chart(series: ChartSeries) -> Result<Chart, ApiError> {
    let rows = series.points.rows;
    let [shift, ewma] = columns(&rows);
    let mut chart = Chart {
        chart: series.chart,
        is_process: series.is_process,
        times: times(&rows)?,
        batches: Vec::with_capacity(rows.len()),
        shift,
        shift_limit: Vec::with_capacity(rows.len()),
        ewma,
        ewma_limit: Vec::with_capacity(rows.len()),
        held: Vec::with_capacity(rows.len()),
        state: Vec::with_capacity(rows.len()),
    };
    for row in rows {
        let ChartMark { batch, shift_limit, ewma_limit, held, state } = row.tag;
        chart.batches.push(batch);
        chart.shift_limit.push(shift_limit);
        chart.ewma_limit.push(ewma_limit);
        chart.held.push(held);
        chart.state.push(state);
    }
    Ok(chart)
}

fn trust_point(row: Row<TrustMark>) -> Result<TrustPoint, ApiError> {
    let TrustMark { batch, verdict, findings } = row.tag;
    let p_value = row.values.first().copied().and_then(number);
    Ok(TrustPoint { time: time(row.time_us)?, batch, verdict, findings, p_value })
}

fn alarm(episode: Episode) -> AlarmSpan {
    AlarmSpan {
        alarm: episode.number,
        state: episode.state(),
        parameters: episode.parameters(),
        kind: episode.kind,
        opened_at: episode.opened_at,
        ended_at: episode.ended_at,
    }
}

fn reference_span(version: ReferenceVersion) -> ReferenceSpan {
    ReferenceSpan {
        version: version.version,
        from: version.measured_from,
        to: version.measured_to,
        reason: version.origin.reason,
    }
}

fn maintenance_span(window: MaintenanceWindow) -> MaintenanceSpan {
    MaintenanceSpan { from: window.from, to: window.to, reason: window.reason }
}

/// The first N values of each row as columns.
fn columns<T, const N: usize>(rows: &[Row<T>]) -> [Vec<Option<f64>>; N] {
    std::array::from_fn(|channel| rows.iter().map(|row| number(row.values[channel])).collect())
}

fn times<T>(rows: &[Row<T>]) -> Result<Vec<Timestamp>, ApiError> {
    rows.iter().map(|row| time(row.time_us)).collect()
}

fn time(micros: i64) -> Result<Timestamp, ApiError> {
    Timestamp::from_micros(micros).map_err(|e| ApiError::internal(&e))
}

/// `None` for NaN and infinity, which JSON cannot represent.
fn number(value: f64) -> Option<f64> {
    Some(value).filter(|value| value.is_finite())
}
