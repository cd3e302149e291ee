//! `GET /v1/structures/{id}/report`: the condition of a structure over a period as one HTML page, made for print.

mod alarms;
mod page;
mod words;

use axum::extract::State;
use axum::http::header;
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use utoipa::IntoParams;

use crate::clock;
use crate::http::drawing;
use crate::http::error::ApiError;
use crate::http::openapi::{Invalid, StructurePath, Unknown};
use crate::http::request::{structure_id, ApiPath, ApiQuery, Window};
use crate::http::shared::Shared;
use crate::http::verdict::Judged;
use crate::measurement::CovariateKind;
use crate::monitor::stored::{EpisodeQuery, SeriesWindow};
use page::{Contents, Period};

/// Maximum number of points of a curve.
const POINTS: usize = 400;

/// Maximum number of alarms in a report.
const MOST_ALARMS: usize = 200;

/// Query of the report.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct ReportQuery {
    /// Batches that begin at or after this time. Default: all.
    #[param(value_type = Option<String>, format = DateTime)]
    from: Option<String>,
    /// Batches that begin before this time. Default: all.
    #[param(value_type = Option<String>, format = DateTime)]
    to: Option<String>,
}

/// `GET /v1/structures/{id}/report`: the condition of a structure over a period as one HTML page.
///
/// # Errors
/// 404 for the structure, 422 for the query.
#[utoipa::path(
    get, path = "/v1/structures/{id}/report", tag = "results", operation_id = "read_condition_report",
    summary = "Condition report",
    description = "The condition of a structure over a period as one self-contained HTML page for print: verdict, alarms with what people \
                   noted, parameters, quality of the data, and what is not known.",
    params(StructurePath, ReportQuery),
    responses((status = 200, description = "The report", body = String, content_type = "text/html"), Unknown, Invalid)
)]
pub async fn report(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    ApiQuery(query): ApiQuery<ReportQuery>,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    let active = shared.monitor.structure(&id)?;
    let Window { from, to } = Window::of(query.from.as_deref(), query.to.as_deref())?;
    if let Some((from, to)) = from.zip(to).filter(|(from, to)| to <= from) {
        return Err(ApiError::invalid_field("query/to", format!("{to} is not after {from}, which is query/from")));
    }
    let _turn = shared.series.acquire().await.map_err(|e| ApiError::internal(&e))?;
    let declared = active.simulator.covariates().iter();
    let covariates: Vec<String> =
        declared.filter(|c| c.kind == CovariateKind::Number).map(|c| c.name.clone()).collect();
    let records = shared.monitor.records();
    let window = SeriesWindow { from, to, points: POINTS };
    let series = records.series(&id, window, active.simulator.modes(), &covariates).await?;
    let in_use = active.baseline.as_ref().ok().map(|baseline| baseline.digest().clone());
    let found = records.reference(&id).await?;
    let reference = found.record.filter(|r| in_use.as_ref() == Some(&r.model_digest));
    let all = EpisodeQuery { before: None, open_only: false, superseded: false, limit: MOST_ALARMS };
    let period =
        Period { from: from.or(series.extent.measured.map(|m| m.0)), to: to.or(series.extent.measured.map(|m| m.1)) };
    let alarms = shared.monitor.alarms().episodes(&id, all).await?;
    let handling = shared.monitor.alarms().handling(&id, &alarms).await?;
    let maintenance = shared.monitor.alarms().maintenance(&id).await?;
    let notes = shared.monitor.alarms().notes(&id).await?;
    let judged = Judged::all(&shared.monitor).await?.into_iter().find(|judged| judged.found.id == id);
    let marks = drawing::marks(&shared, &id).await?;
    let simulator = active.simulator.clone();
    let mut contents = Contents {
        drawing: None,
        description: active.simulator.definition().description.clone(),
        modes: active.simulator.modes(),
        structure: id,
        verdict: judged.map(|judged| judged.verdict.sentence).unwrap_or_default(),
        made_at: clock::now(),
        alarms: alarms.into_iter().filter(|e| !e.withdrawn && period.overlaps(e.opened_at, e.ended_at)).collect(),
        handling,
        limits: shared.monitor.alarms().limits(),
        notes: notes.into_iter().filter(|n| period.overlaps(n.from, Some(n.to.unwrap_or(n.from)))).collect(),
        maintenance: maintenance.into_iter().filter(|w| period.overlaps(w.from, Some(w.to))).collect(),
        model: active.baseline.clone(),
        period,
        series,
        reference,
        reference_unreadable: found.unreadable,
    };
    // Drawing takes a few milliseconds for each parameter.
    let draw = move || {
        contents.drawing = simulator.drawing(&marks, None).ok().map(|drawing| drawing.svg());
        page::html(&contents)
    };
    let html = tokio::task::spawn_blocking(draw).await.map_err(|e| ApiError::internal(&e))?;
    let policy = "default-src 'none'; style-src 'unsafe-inline'; img-src data:";
    let headers = [
        (header::CONTENT_TYPE, "text/html; charset=utf-8"),
        (header::CONTENT_SECURITY_POLICY, policy),
        (header::CACHE_CONTROL, "no-store"),
    ];
    Ok((headers, html).into_response())
}
