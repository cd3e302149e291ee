//! `/v1/structures/{id}/drawing.svg`: the drawing of a structure.

use axum::extract::State;
use axum::http::header;
use axum::response::{IntoResponse, Response};
use serde::Deserialize;
use utoipa::IntoParams;

use super::access::Client;
use super::error::ApiError;
use super::openapi::{Computed, Invalid, StructurePath, Unknown};
use super::request::{structure_id, ApiPath, ApiQuery};
use super::shared::Shared;
use super::views::share;
use crate::assessment::Assessment;
use crate::monitor::stored::{Episode, LatestQuantity};
use crate::parameter::Parameter;
use crate::quantity::{shown, StructureId};
use crate::simulator::drawing::{Error, Marks};
use crate::simulator::Simulator;

/// Nothing is loaded or run by a drawing.
const POLICY: &str = "default-src 'none'";

/// Query of a drawing.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct DrawingQuery {
    /// Measured mode, counted from 1, whose shape at the nominal parameters is drawn too.
    #[param(value_type = Option<u32>, minimum = 1, maximum = 2000)]
    mode: Option<String>,
    /// Batch whose measured shape of the mode is drawn beside that of the simulation at the batch's estimated parameters, with their MAC.
    /// Only with `mode`.
    batch: Option<String>,
}

/// `GET /v1/structures/{id}/drawing.svg`: masses, springs, beams and supports with their names.
///
/// # Errors
/// 404 for the structure; 422 for a mode that is not measured, and for a table of finite-element runs, which has no geometry;
/// 503 when too many computations wait.
#[utoipa::path(
    get, path = "/v1/structures/{id}/drawing.svg", tag = "structures", operation_id = "draw_structure",
    summary = "Drawing of a structure",
    description = "Masses, springs, beams and supports with their names, as SVG. Colours are the changes of the latest assessed batch from \
                   the undamaged reference, outlines are open damage alarms. Beams along their axis in metres, masses as many storeys \
                   above the ground as springs lead there. A table of finite-element runs has no geometry and is answered 422.",
    params(StructurePath, DrawingQuery),
    responses((status = 200, description = "The drawing", body = String, content_type = "image/svg+xml"), Unknown, Invalid, Computed)
)]
pub async fn drawing(
    State(shared): State<Shared>,
    client: Client,
    ApiPath(id): ApiPath<String>,
    ApiQuery(query): ApiQuery<DrawingQuery>,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    let _share = share(&shared, &client)?;
    let simulator = shared.monitor.structure(&id)?.simulator.clone();
    let wrong = |text: &str| {
        let message = format!("{} is not a mode from 1 to {}", shown(text), simulator.modes());
        ApiError::invalid_field("query/mode", message)
    };
    let mode = query.mode.as_deref().map(|text| text.parse::<usize>().map_err(|_| wrong(text))).transpose()?;
    if mode.is_none() && query.batch.is_some() {
        let message = "a batch is drawn beside a mode: give the mode too, such as ?mode=1&batch=…";
        return Err(ApiError::invalid_field("query/batch", message.to_owned()));
    }
    let batch = match &query.batch {
        Some(batch) => Some(shared.monitor.records().batch(&id, batch).await?),
        None => None,
    };
    let marks = marks(&shared, &id).await?;
    // The shape needs an eigenproblem, which takes time for large structures.
    let turn = shared.monitor.readers().turn().await.map_err(crate::monitor::Error::from)?;
    let draw = move |_: &_| {
        let nominal = simulator.nominal_parameters();
        match (mode, batch) {
            (Some(mode), Some(view)) => {
                let theta = view.assessment.map_or(nominal, |assessment| estimated(&simulator, &assessment));
                simulator.drawing_beside(&marks, (mode, &theta), &view.record.batch.measurements)
            }
            (mode, _) => simulator.drawing(&marks, mode.map(|mode| (mode, nominal.as_slice()))),
        }
    };
    let drawn = turn.run(draw).await.map_err(|e| ApiError::internal(&e))?;
    let drawing = drawn.map_err(|error| match error {
        Error::NoMode { .. } => ApiError::invalid_field("query/mode", error.to_string()),
        Error::NoGeometry => ApiError::invalid_field("path/id", error.to_string()),
        Error::Physics(cause) => ApiError::internal(&cause),
    })?;
    let headers = [(header::CONTENT_TYPE, "image/svg+xml"), (header::CONTENT_SECURITY_POLICY, POLICY)];
    Ok((headers, drawing.svg()).into_response())
}

/// Mean of the posterior samples of each parameter in an assessment, `[d]`; the nominal value of a parameter that it does not have.
fn estimated(simulator: &Simulator, assessment: &Assessment) -> Vec<f64> {
    let quantity = |name: &str| assessment.quantities.iter().find(|q| q.name == name);
    let nominal = simulator.nominal_parameters();
    let one = |(parameter, nominal): (&Parameter, f64)| quantity(&parameter.name).map_or(nominal, |q| q.pooled.mean);
    simulator.space().iter().zip(nominal).map(one).collect()
}

/// What the latest assessed batch and the open alarms say about the parts of a structure.
pub(super) async fn marks(shared: &Shared, id: &StructureId) -> Result<Marks, ApiError> {
    let quantities = shared.monitor.records().latest_quantities(id).await?;
    let change = |q: LatestQuantity| Some((q.quantity, 100.0 * q.relative_change?));
    let open = shared.monitor.alarms().open_damage().await?.remove(id).unwrap_or_default();
    let names = |series: &str| -> Vec<String> {
        series
            .strip_prefix("group:")
            .map_or_else(|| vec![series.to_owned()], |group| group.split('+').map(str::to_owned).collect())
    };
    Ok(Marks {
        change_percent: quantities.into_iter().filter_map(change).collect(),
        alarms: open.iter().flat_map(Episode::parameters).flat_map(|name: String| names(&name)).collect(),
    })
}
