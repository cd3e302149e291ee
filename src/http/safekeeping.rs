//! Backups, exports, retention and model reloads.

use std::io;

use axum::body::{Body, Bytes};
use axum::extract::State;
use axum::http::{header, HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use futures_util::stream::try_unfold;
use serde::{Deserialize, Serialize};
use tracing::error;
use utoipa::{IntoParams, ToSchema};

use super::access::Client;
use super::answer::declare_reference;
use super::error::ApiError;
use super::file_parts::broken_off;
use super::openapi::{BodyRefused, Conflict, Invalid, StructurePath, Unknown};
use super::request::{parse_json, read_body, structure_id, ApiPath, ApiQuery};
use super::shared::Shared;
use crate::monitor::retention::RetentionPlan;
use crate::monitor::stored::backup::Manifest;
use crate::monitor::Reloaded;
use crate::quantity::{shown, Digest, StructureId};

/// Maximum number of days of retention; larger values leave the range of the calendar.
const MOST_DAYS: u32 = 36_500;

/// Body of a request for a backup; may be `{}` or absent.
#[derive(Debug, Default, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = BackupInput)]
struct BackupBody {
    /// Name of the backup's folder. Default: made from the time.
    #[schema(pattern = "^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$")]
    name: Option<String>,
    /// Whether the secrets of webhooks are in the copy. Default `false`: its webhooks are disabled until they get new secrets.
    with_secrets: Option<bool>,
}

/// Body of a request for a reload; may be `{}` or absent.
#[derive(Debug, Default, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = ReloadInput)]
struct ReloadBody {
    /// Renew the undamaged reference from the same batches under the new model. Default `true`.
    retake_undamaged: Option<bool>,
}

/// Query of the retention.
#[derive(Debug, Default, Deserialize, IntoParams)]
#[serde(deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct RetentionQuery {
    /// Number of days to keep batches, instead of the configured one.
    #[param(value_type = Option<u32>, minimum = 0, maximum = 36_500)]
    days: Option<String>,
}

/// Backups, newest first.
#[derive(Debug, Serialize, ToSchema)]
struct BackupList {
    items: Vec<Manifest>,
    /// Folders that cannot be read as a backup, with the reason.
    unreadable: Vec<String>,
}

/// The result of a reload.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Reloaded)]
pub struct ReloadedBody {
    /// The structure.
    structure: StructureId,
    /// Digest of the trained baseline that is now in use.
    model_digest: Digest,
    /// Digest of the trained baseline that was in use before.
    #[schema(required)]
    previous_model_digest: Option<Digest>,
    /// False if the files contain the trained baseline that was already in use.
    changed: bool,
    /// Version of the undamaged reference that was renewed with it.
    #[schema(required)]
    undamaged_version: Option<u32>,
    /// What the user has to do next, if anything.
    #[serde(skip_serializing_if = "Option::is_none")]
    next_step: Option<String>,
}

impl From<Reloaded> for ReloadedBody {
    fn from(reloaded: Reloaded) -> Self {
        let next_step = reloaded.reference_outdated.then(|| {
            format!(
                "the undamaged reference was made with another trained model, so batches are not compared with it: declare \
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

/// `POST /v1/backups`: makes a backup in `backups/` of the data folder while the service runs; 201 when it is verified
/// and on disk.
///
/// # Errors
/// 409 if a backup is being made or the name exists, 422 for the name, 507 without enough space.
#[utoipa::path(
    post, path = "/v1/backups", tag = "operations", operation_id = "create_backup",
    summary = "Create a backup",
    description = "Makes a backup in `backups/` of the data folder while the service runs. The answer is sent when it is verified and on disk. \
                   The secrets of webhooks are left out unless `with_secrets` is `true`.",
    request_body(content = Option<BackupBody>, example = json!({"name": "before-the-update"})),
    responses((status = 201, description = "Contents of the backup", body = Manifest), BodyRefused, Conflict)
)]
pub async fn create_backup(State(shared): State<Shared>, headers: HeaderMap, body: Body) -> Result<Response, ApiError> {
    let body: BackupBody = optional_json(&shared, &headers, body).await?;
    let manifest = shared.monitor.upkeep().backups().make(body.name, body.with_secrets.unwrap_or(false)).await?;
    Ok((StatusCode::CREATED, Json(manifest)).into_response())
}

/// `GET /v1/backups`: the backups in the data folder, newest first.
///
/// # Errors
/// 500 if the folder cannot be listed.
#[utoipa::path(
    get, path = "/v1/backups", tag = "operations", operation_id = "list_backups",
    summary = "All backups", description = "The backups in the data folder, newest first.",
    responses((status = 200, description = "The backups", body = BackupList))
)]
pub async fn list_backups(State(shared): State<Shared>) -> Result<Response, ApiError> {
    let (items, unreadable) = shared.monitor.upkeep().backups().list().await?;
    Ok(Json(BackupList { items, unreadable }).into_response())
}

/// `GET /v1/structures/{id}/export`: all data of a structure that another installation needs, as lines of JSON.
///
/// # Errors
/// 404 for the structure. A later failure, also of the token, closes the connection before the last line.
#[utoipa::path(
    get, path = "/v1/structures/{id}/export", tag = "operations", operation_id = "export_structure",
    summary = "Export a structure",
    description = "All data that another installation needs, as lines of JSON. If the export fails, the connection is closed before \
                   the last line, whose `record` is `end`.",
    params(StructurePath),
    responses(
        (status = 200, description = "The archive; the schema is that of a line", body = Object, content_type = "application/x-ndjson"),
        Unknown, Invalid
    )
)]
pub async fn export(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    client: Client,
) -> Result<Response, ApiError> {
    let id = structure_id(&id)?;
    let lines = shared.monitor.archive().export(&id).await?;
    let access = shared.access.clone();
    let lines = try_unfold((lines, access, client), |(mut lines, access, client)| async move {
        let Some(line) = lines.recv().await else { return Ok(None) };
        let line = line.map_err(|failure| {
            error!(error = %failure, "An export failed: {failure}");
            io::Error::other(failure)
        })?;
        // The lines before may have waited for the reader.
        access.look_again(&client).map_err(broken_off)?;
        Ok::<_, io::Error>(Some((Bytes::from(line), (lines, access, client))))
    });
    let name = format!("attachment; filename=\"{id}.ndjson\"");
    let headers = [(header::CONTENT_TYPE, "application/x-ndjson".to_owned()), (header::CONTENT_DISPOSITION, name)];
    Ok((headers, Body::from_stream(lines)).into_response())
}

/// `POST /v1/structures/{id}/model/reload`: reads the models folder again and replaces the trained model; the previous
/// model stays in use if the new one is refused.
///
/// # Errors
/// 404 for the structure, 409 with the reason if the new model is refused.
#[utoipa::path(
    post, path = "/v1/structures/{id}/model/reload", tag = "structures", operation_id = "reload_model",
    summary = "Reload the trained model",
    description = "Reads the models folder again and replaces the trained model. The previous model stays in use if the new one is refused.",
    params(StructurePath),
    request_body(content = Option<ReloadBody>, example = json!({"retake_undamaged": false})),
    responses((status = 200, description = "The model that is now in use", body = ReloadedBody), Unknown, BodyRefused, Conflict)
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

/// `GET /v1/retention`: the retention setting, what would be deleted now, and the result of the last run; `days`
/// replaces the setting. This request deletes nothing.
///
/// # Errors
/// 422 for the query.
#[utoipa::path(
    get, path = "/v1/retention", tag = "operations", operation_id = "retention",
    summary = "Retention", description = "The setting, what would be deleted now, and the result of the last run. This request deletes nothing.",
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

/// Reads a JSON body, or returns the default if there is none.
async fn optional_json<T: serde::de::DeserializeOwned + Default>(
    shared: &Shared,
    headers: &HeaderMap,
    body: Body,
) -> Result<T, ApiError> {
    let bytes = read_body(body, headers, shared.limits).await?;
    // `null` is treated like an empty body.
    if bytes.is_empty() || bytes.trim_ascii() == b"null" {
        return Ok(T::default());
    }
    match super::request::media_type(headers).as_deref() {
        Some("application/json") => parse_json(&bytes),
        other => Err(super::request::unsupported_media_type(other, "application/json")),
    }
}
