//! `/v1/tokens`: creates, lists, rotates and revokes tokens. A secret is shown once, in the answer that creates it.

use std::collections::BTreeSet;

use axum::body::Body;
use axum::extract::State;
use axum::http::{header, HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::error::ApiError;
use super::openapi::{BodyRefused, Conflict, TokenPath, Unknown};
use super::request::{json_body, whole_number, ApiPath};
use super::shared::Shared;
use crate::access::{NewToken, Scope, TokenRecord, TokenText};
use crate::clock;
use crate::quantity::{StructureId, Timestamp};

/// Time for which the previous secret stays valid after a rotation by default, seconds.
const DEFAULT_OVERLAP_S: i64 = 3_600;
/// Longest overlap: 30 days.
const LONGEST_OVERLAP_S: i64 = 30 * 86_400;

/// Body of a request for a token.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = TokenInput)]
struct TokenBody {
    /// Name of the holder. It is shown in lists, logs and the audit.
    #[schema(min_length = 1, max_length = 100, pattern = "^[^\\x00-\\x1f\\x7f-\\x9f]+$")]
    name: String,
    #[schema(min_items = 1)]
    scopes: Vec<Scope>,
    /// Structures to which the token is limited. Default: all.
    #[schema(min_items = 1, max_items = 1000)]
    structures: Option<Vec<String>>,
    /// Sources to which its posts are limited, for a token with the scope `ingest` and without `admin`. Default: all. With a single one, a post
    /// need not name it.
    #[schema(min_items = 1, max_items = 100)]
    sources: Option<Vec<String>>,
    /// When the token expires: in the future, RFC 3339 with a UTC offset. Default: never.
    #[schema(value_type = Option<String>, format = DateTime)]
    expires_at: Option<String>,
}

/// Body of a request for a rotation; may be `{}`.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = RotationInput)]
struct RotationBody {
    /// Time for which the previous secret stays valid, seconds. Default 3600.
    #[schema(minimum = 0, maximum = 2_592_000)]
    #[serde(default, deserialize_with = "whole_number")]
    overlap_s: Option<u64>,
}

/// A token without its secret.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = Token)]
struct TokenItem {
    id: String,
    name: String,
    scopes: Vec<Scope>,
    /// Structures to which the token is limited; `null` means all.
    #[schema(required)]
    structures: Option<Vec<StructureId>>,
    /// Sources to which its posts are limited; `null` means all.
    #[schema(required)]
    sources: Option<Vec<String>>,
    /// `active`, `expired` or `revoked`.
    state: &'static str,
    created_at: Timestamp,
    #[schema(required)]
    expires_at: Option<Timestamp>,
    #[schema(required)]
    revoked_at: Option<Timestamp>,
    /// Until when the secret from before the last rotation is valid.
    #[schema(required)]
    old_secret_until: Option<Timestamp>,
}

/// All tokens, oldest first.
#[derive(Debug, Serialize, ToSchema)]
struct TokenList {
    items: Vec<TokenItem>,
}

/// A token with its secret.
#[derive(Debug, Serialize, ToSchema)]
#[schema(as = IssuedToken)]
struct Issued {
    #[serde(flatten)]
    item: TokenItem,
    /// The token. It cannot be read again.
    token: String,
}

impl From<&TokenRecord> for TokenItem {
    fn from(record: &TokenRecord) -> Self {
        let now = clock::now();
        Self {
            id: record.id.to_string(),
            name: record.name.clone(),
            scopes: record.scopes.iter().collect(),
            structures: record.structures.as_ref().map(|ids| ids.iter().cloned().collect()),
            sources: record.sources.as_ref().map(|sources| sources.iter().cloned().collect()),
            state: record.state(now),
            created_at: record.created_at,
            expires_at: record.expires_at,
            revoked_at: record.revoked_at,
            old_secret_until: record.previous.map(|(_, until)| until).filter(|until| *until > now),
        }
    }
}

/// `GET /v1/tokens`: all tokens, oldest first.
#[utoipa::path(
    get, path = "/v1/tokens", tag = "access", operation_id = "list_tokens",
    summary = "All tokens", description = "All tokens without their secrets, oldest first.",
    responses((status = 200, description = "The tokens", body = TokenList))
)]
pub async fn list(State(shared): State<Shared>) -> Response {
    let mut items: Vec<TokenItem> = shared.access.read_tokens(|tokens| tokens.records().map(TokenItem::from).collect());
    items.sort_by(|a, b| (a.created_at, &a.id).cmp(&(b.created_at, &b.id)));
    Json(TokenList { items }).into_response()
}

/// `POST /v1/tokens`: 201 with the token, which cannot be read again.
///
/// # Errors
/// 400, 415, 422 for the body.
#[utoipa::path(
    post, path = "/v1/tokens", tag = "access", operation_id = "create_token",
    summary = "Create a token",
    description = "The secret is contained only in this answer. The first token closes the service to everybody without a token. It \
                   must have the scope `admin`, no `structures` and no `expires_at`.",
    request_body(content = TokenBody, example = json!({"name": "gateway", "scopes": ["ingest"], "structures": ["three-dof"], "sources": ["gateway-7"]})),
    responses(
        (status = 201, description = "The token with its secret", body = Issued,
         headers(("Location" = String, description = "Path of the token"))),
        BodyRefused
    )
)]
pub async fn create(State(shared): State<Shared>, headers: HeaderMap, body: Body) -> Result<Response, ApiError> {
    let body: TokenBody = json_body(&headers, body, shared.limits).await?;
    let structure = |(index, text): (usize, String)| {
        let pointer = format!("/structures/{index}");
        StructureId::parse(&text).map_err(|e| ApiError::invalid_field(pointer, e.to_string()))
    };
    let structures = body.structures.map(|ids| ids.into_iter().enumerate().map(structure).collect());
    let structures: Option<BTreeSet<StructureId>> = structures.transpose()?;
    let expires_at = body.expires_at.as_deref().map(Timestamp::parse).transpose();
    let new = NewToken {
        name: body.name,
        scopes: body.scopes.into_iter().collect(),
        structures,
        sources: body.sources.map(|sources| sources.into_iter().collect()),
        expires_at: expires_at.map_err(|e| ApiError::invalid_field("/expires_at", e.to_string()))?,
    };
    let (record, text) = shared.access.create_token(new).await?;
    Ok(issued(StatusCode::CREATED, &record, &text))
}

/// `POST /v1/tokens/{id}/rotation`: creates a new secret; the previous one stays valid for `overlap_s`.
///
/// # Errors
/// 404, 409 if the token is not active, 422 for the overlap.
#[utoipa::path(
    post, path = "/v1/tokens/{id}/rotation", tag = "access", operation_id = "rotate_token",
    summary = "Rotate the secret of a token",
    description = "Creates a new secret, which is contained only in this answer. The previous one stays valid for `overlap_s`.",
    params(TokenPath),
    request_body(content = RotationBody, example = json!({"overlap_s": 600})),
    responses(
        (status = 201, description = "The token with its new secret", body = Issued,
         headers(("Location" = String, description = "Path of the token"))),
        Unknown, BodyRefused, Conflict
    )
)]
pub async fn rotate(
    State(shared): State<Shared>,
    ApiPath(id): ApiPath<String>,
    headers: HeaderMap,
    body: Body,
) -> Result<Response, ApiError> {
    let body: RotationBody = json_body(&headers, body, shared.limits).await?;
    let overlap_s = body.overlap_s.map_or(DEFAULT_OVERLAP_S, |seconds| i64::try_from(seconds).unwrap_or(i64::MAX));
    if overlap_s > LONGEST_OVERLAP_S {
        let message = format!("{overlap_s} must be from 0 to {LONGEST_OVERLAP_S} (30 days)");
        return Err(ApiError::invalid_field("/overlap_s", message));
    }
    let (record, text) = shared.access.rotate_token(&id, overlap_s).await?;
    Ok(issued(StatusCode::CREATED, &record, &text))
}

/// `DELETE /v1/tokens/{id}`: revokes the token immediately. Revoking it again changes nothing.
///
/// # Errors
/// 404, 409 if it is the last token that can manage the service.
#[utoipa::path(
    delete, path = "/v1/tokens/{id}", tag = "access", operation_id = "revoke_token",
    summary = "Revoke a token", description = "Takes effect immediately. Revoking it again changes nothing.",
    params(TokenPath),
    responses((status = 200, description = "The token", body = TokenItem), Unknown, Conflict)
)]
pub async fn revoke(State(shared): State<Shared>, ApiPath(id): ApiPath<String>) -> Result<Response, ApiError> {
    let record = shared.access.revoke_token(&id).await?;
    Ok(Json(TokenItem::from(&record)).into_response())
}

fn issued(status: StatusCode, record: &TokenRecord, text: &TokenText) -> Response {
    let location = [(header::LOCATION, format!("/v1/tokens/{}", record.id))];
    let body = Issued { item: TokenItem::from(record), token: text.reveal() };
    (status, location, Json(body)).into_response()
}
