//! `DELETE /v1/structures/{id}`.

use axum::extract::State;
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::Deserialize;
use utoipa::IntoParams;

use super::error::ApiError;
use super::openapi::{Conflict, Invalid, StructurePath, Unknown};
use super::request::{structure_id, ApiPath, ApiQuery};
use super::shared::Shared;
use crate::monitor::DeletedStructure;
use crate::quantity::shown;

/// Query of the deletion of a structure.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct DeletionQuery {
    /// The id of the structure once more, as a confirmation.
    #[param(required)]
    confirm: Option<String>,
}

/// `DELETE /v1/structures/{id}?confirm={id}`: deletes a structure with all its data.
///
/// # Errors
/// 404 for the structure, 409 while jobs of it run or wait, 422 without the confirmation.
#[utoipa::path(
    delete, path = "/v1/structures/{id}", tag = "structures", operation_id = "delete_structure",
    summary = "Delete a structure",
    description = "Deletes a structure with its batches, undamaged references, alarms, notes, diagnoses, and the models that the service \
                   trained for it. This cannot be undone; make a backup or an export before. It takes many small transactions, between \
                   which batches of other structures are stored, and goes on after a stop of the service. The audit keeps its entries. A \
                   structure of the models folder returns, without data, with the next start.",
    params(StructurePath, DeletionQuery),
    responses((status = 200, description = "What was deleted", body = DeletedStructure), Unknown, Invalid, Conflict)
)]
pub async fn remove(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    ApiQuery(query): ApiQuery<DeletionQuery>,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    if query.confirm.as_deref() != Some(id.as_str()) {
        let given = query
            .confirm
            .as_deref()
            .map_or_else(|| "it is missing".to_owned(), |text| format!("it is {}", shown(text)));
        let message = format!("must be {id}, to confirm that this structure is deleted with all its data, but {given}");
        return Err(ApiError::invalid_field("query/confirm", message));
    }
    Ok(Json(shared.monitor.deletions().delete(&id).await?).into_response())
}
