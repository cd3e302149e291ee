//! Backups, exports, retention and reloads: for those who keep the service.

use axum::body::{Body, Bytes};
use axum::extract::State;
use axum::http::{header, HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use http_body_util::channel::Channel;
use serde::{Deserialize, Serialize};
use tracing::error;
use utoipa::{IntoParams, ToSchema};

use super::answer::declare_reference;
use super::error::ApiError;
use super::openapi::{BodyRefused, Conflict, Invalid, StructurePath, Unknown};
use super::request::{parse_json, read_body, structure_id, ApiPath, ApiQuery};
use super::Shared;
use crate::monitor::retention::RetentionPlan;
use crate::monitor::Reloaded;
use crate::quantity::{shown, Digest, StructureId};
use crate::store::backup::Manifest;

/// Lines of an archive on their way to the client.
const BUFFERED: usize = 16;

/// Most days of retention: beyond, the calendar ends.
const MOST_DAYS: u32 = 36_500;

/// A backup to make; `{}`, or no body, is enough.
#[derive(Debug, Default, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = BackupInput)]
struct BackupBody {
    /// Name of its folder; one made of the time without.
    #[schema(pattern = "^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
    name: Option<String>,
}

/// How to reload; `{}`, or no body, is enough.
#[derive(Debug, Default, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = ReloadInput)]
struct ReloadBody {
    /// Take the undamaged batches as that under the new baseline too; `true` without.
    retake_undamaged: Option<bool>,
}

/// Query of the retention.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct RetentionQuery {
    /// Days to keep, instead of those of the settings.
    #[param(value_type = Option<u32>, minimum = 0, maximum = 36_500)]
    days: Option<String>,
}

/// Backups, newest first.
#[derive(Debug, Serialize, ToSchema)]
struct BackupList {
    items: Vec<Manifest>,
    /// Folders that are no backup that can be read, and why.
    unreadable: Vec<String>,
}

/// The result of a reload.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Reloaded)]
pub struct ReloadedBody {
    /// The structure.
    structure: StructureId,
    /// The trained baseline in use now.
    model_digest: Digest,
    /// The one before.
    #[schema(required)]
    previous_model_digest: Option<Digest>,
    /// False when the files are those in use.
    changed: bool,
    /// Version of the undamaged reference that was renewed with it.
    #[schema(required)]
    undamaged_version: Option<u32>,
    /// What is left to do.
    #[serde(skip_serializing_if = "Option::is_none")]
    next_step: Option<String>,
}

impl From<Reloaded> for ReloadedBody {
    fn from(reloaded: Reloaded) -> Self {
        let next_step = reloaded.reference_outdated.then(|| {
            format!(
                "the undamaged reference was made with another trained baseline, so batches are not compared with it: declare \
                 undamaged batches again by {}",
                declare_reference(&reloaded.structure)
            )
        });
        Self {
            structure: reloaded.structure,
            model_digest: reloaded.model_digest,
            previous_model_digest: reloaded.previous_model_digest,
            changed: reloaded.changed,
            undamaged_version: reloaded.undamaged_version,
            next_step,
        }
    }
}

/// `POST /v1/backups`: a backup under `backups/` of the data folder, made while everything goes on; 201 when it is checked and
/// on disk.
///
/// # Errors
/// 409 when one is being made or the name is taken, 422 for the name, 507 without room.
#[utoipa::path(
    post, path = "/v1/backups", tag = "operations", operation_id = "create_backup",
    summary = "Make a backup",
    description = "Under `backups/` of the data folder, while everything goes on; answered when it is checked and on disk.",
    request_body(content = Option<BackupBody>, example = json!({"name": "before-the-update"})),
    responses((status = 201, description = "What is in it", body = Manifest), BodyRefused, Conflict)
)]
pub async fn create_backup(State(shared): State<Shared>, headers: HeaderMap, body: Body) -> Result<Response, ApiError> {
    let body: BackupBody = optional_json(&shared, &headers, body).await?;
    let manifest = shared.monitor.upkeep().backups().make(body.name).await?;
    Ok((StatusCode::CREATED, Json(manifest)).into_response())
}

/// `GET /v1/backups`: the service's own backups, newest first.
///
/// # Errors
/// 500 when the folder cannot be listed.
#[utoipa::path(
    get, path = "/v1/backups", tag = "operations", operation_id = "list_backups",
    summary = "All backups", description = "The service's own, newest first.",
    responses((status = 200, description = "The backups", body = BackupList))
)]
pub async fn list_backups(State(shared): State<Shared>) -> Result<Response, ApiError> {
    let (items, unreadable) = shared.monitor.upkeep().backups().list().await?;
    Ok(Json(BackupList { items, unreadable }).into_response())
}

/// `GET /v1/structures/{id}/export`: everything of a structure that another installation needs, as lines of JSON.
///
/// # Errors
/// 404 for the structure. A failure on the way breaks the connection, and the last line is missing.
#[utoipa::path(
    get, path = "/v1/structures/{id}/export", tag = "operations", operation_id = "export_structure",
    summary = "Everything of a structure",
    description = "What another installation needs, as lines of JSON. A failure on the way breaks the connection, and the last \
                   line, whose `record` is `end`, is missing.",
    params(StructurePath),
    responses(
        (status = 200, description = "The archive; the schema is that of a line", body = Object, content_type = "application/x-ndjson"),
        Unknown, Invalid
    )
)]
pub async fn export(State(shared): State<Shared>, ApiPath(id): ApiPath<String>) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    let mut lines = shared.monitor.archive().export(&id).await?;
    let (mut sender, body) = Channel::<Bytes, crate::monitor::Error>::new(BUFFERED);
    tokio::spawn(async move {
        while let Some(line) = lines.recv().await {
            match line {
                Ok(line) => {
                    if sender.send_data(Bytes::from(line)).await.is_err() {
                        return;
                    }
                }
                Err(failure) => {
                    error!(error = %failure, "An export broke off: {failure}");
                    sender.abort(failure);
                    return;
                }
            }
        }
    });
    let name = format!("attachment; filename=\"{id}.ndjson\"");
    let headers = [(header::CONTENT_TYPE, "application/x-ndjson".to_owned()), (header::CONTENT_DISPOSITION, name)];
    Ok((headers, Body::new(body)).into_response())
}

/// `POST /v1/structures/{id}/model/reload`: reads the models folder again and swaps the trained baseline; the one in use stays
/// when the new one is refused.
///
/// # Errors
/// 404 for the structure, 409 with the reason when the new one is refused.
#[utoipa::path(
    post, path = "/v1/structures/{id}/model/reload", tag = "structures", operation_id = "reload_model",
    summary = "Put another trained baseline into use",
    description = "Reads the models folder again; the baseline in use stays when the new one is refused.",
    params(StructurePath),
    request_body(content = Option<ReloadBody>, example = json!({"retake_undamaged": false})),
    responses((status = 200, description = "What is in use now", body = ReloadedBody), Unknown, BodyRefused, Conflict)
)]
pub async fn reload_model(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    let body: ReloadBody = optional_json(&shared, &headers, body).await?;
    let reloaded = shared.monitor.models().reload(&id, body.retake_undamaged.unwrap_or(true)).await?;
    Ok(Json(ReloadedBody::from(reloaded)).into_response())
}

/// `GET /v1/retention`: what is kept, what would go now, and what the last look did; `days` asks for another number. Nothing is
/// deleted by it.
///
/// # Errors
/// 422 for the query.
#[utoipa::path(
    get, path = "/v1/retention", tag = "operations", operation_id = "retention",
    summary = "What is kept, and what would go", description = "And what the last look did. Nothing is deleted by asking.",
    params(RetentionQuery),
    responses((status = 200, description = "The plan", body = RetentionPlan), Invalid)
)]
pub async fn retention(
    State(shared): State<Shared>,
    ApiQuery(query): ApiQuery<RetentionQuery>,
) -> Result<Response, ApiError> {
    let days = query.days.map(|text| {
        let days = text.parse().ok().filter(|days| *days <= MOST_DAYS);
        days.ok_or_else(|| {
            let message = format!("{} must be a whole number from 0 to {MOST_DAYS}", shown(&text));
            ApiError::invalid_field("query/days", message)
        })
    });
    Ok(Json(shared.monitor.upkeep().retention().plan(days.transpose()?).await?).into_response())
}

/// A JSON body, or its default where there is none.
async fn optional_json<T: serde::de::DeserializeOwned + Default>(
    shared: &Shared,
    headers: &HeaderMap,
    body: Body,
) -> Result<T, ApiError> {
    let bytes = read_body(body, headers, shared.limits).await?;
    // `null` says the same as nothing.
    if bytes.is_empty() || bytes.trim_ascii() == b"null" {
        return Ok(T::default());
    }
    match super::request::media_type(headers).as_deref() {
        Some("application/json") => parse_json(&bytes),
        other => Err(super::request::unsupported_media_type(other, "application/json")),
    }
}
