//! `/v1/tokens`: make, list, rotate and revoke. A secret is in one answer, the one that makes it, and nowhere else.

use std::collections::BTreeSet;

use axum::body::Body;
use axum::extract::State;
use axum::http::{header, HeaderMap, StatusCode};
use axum::response::{IntoResponse, Response};
use axum::Json;
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use super::AccessControl;
use crate::access::{NewToken, Scope, TokenId, TokenRecord, TokenTable, TokenText};
use crate::http::error::ApiError;
use crate::http::openapi::{BodyRefused, Conflict, TokenPath, Unknown};
use crate::http::request::{json_body, whole_number, ApiPath};
use crate::http::Shared;
use crate::quantity::{shown, StructureId, Timestamp};

/// Seconds that the old secret stays good after a rotation, unless the client says otherwise.
const DEFAULT_OVERLAP_S: i64 = 3_600;
/// Longest overlap: 30 days.
const LONGEST_OVERLAP_S: i64 = 30 * 86_400;

/// A token to make.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = TokenInput)]
struct TokenBody {
    /// For people: who or what has it. It is shown in lists, logs and the audit.
    #[schema(min_length = 1, max_length = 100, pattern = "^[^\\x00-\\x1f\\x7f-\\x9f]+$")]
    name: String,
    #[schema(min_items = 1)]
    scopes: Vec<Scope>,
    /// The only structures it is for; all without.
    #[schema(min_items = 1, max_items = 1000)]
    structures: Option<Vec<String>>,
    /// Until when it is good, in the future: RFC 3339 with an offset; for ever without.
    #[schema(value_type = Option<String>, format = DateTime)]
    expires_at: Option<String>,
}

/// How to rotate; `{}` is enough.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = RotationInput)]
struct RotationBody {
    /// Seconds that the old secret stays good; 3600 without.
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
    /// The only structures; `null` stands for all.
    #[schema(required)]
    structures: Option<Vec<StructureId>>,
    /// `active`, `expired` or `revoked`.
    state: &'static str,
    created_at: Timestamp,
    #[schema(required)]
    expires_at: Option<Timestamp>,
    #[schema(required)]
    revoked_at: Option<Timestamp>,
    /// Until when the secret before the last rotation is good.
    #[schema(required)]
    old_secret_until: Option<Timestamp>,
}

/// All tokens, the oldest first.
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
    /// Shown this once.
    token: String,
}

impl From<&TokenRecord> for TokenItem {
    fn from(record: &TokenRecord) -> Self {
        let now = Timestamp::now();
        Self {
            id: record.id.to_string(),
            name: record.name.clone(),
            scopes: record.scopes.iter().collect(),
            structures: record.structures.as_ref().map(|ids| ids.iter().cloned().collect()),
            state: record.state(now),
            created_at: record.created_at,
            expires_at: record.expires_at,
            revoked_at: record.revoked_at,
            old_secret_until: record.previous.map(|(_, until)| until).filter(|until| *until > now),
        }
    }
}

/// `GET /v1/tokens`: all tokens, the oldest first.
#[utoipa::path(
    get, path = "/v1/tokens", tag = "access", operation_id = "list_tokens",
    summary = "All tokens", description = "Without their secrets, the oldest first.",
    responses((status = 200, description = "The tokens", body = TokenList))
)]
pub async fn list(State(shared): State<Shared>) -> Response {
    let mut items: Vec<TokenItem> = shared.access.read_tokens(|tokens| tokens.records().map(TokenItem::from).collect());
    items.sort_by(|a, b| (a.created_at, &a.id).cmp(&(b.created_at, &b.id)));
    Json(TokenList { items }).into_response()
}

/// `POST /v1/tokens`: 201 with the token, shown this once.
///
/// # Errors
/// 400, 415, 422 for the body.
#[utoipa::path(
    post, path = "/v1/tokens", tag = "access", operation_id = "create_token",
    summary = "Make a token",
    description = "Its secret is in this answer and in no other. The first token closes the service to everybody without one, \
                   and must have the scope `admin`, no `structures` and no `expires_at`.",
    request_body(content = TokenBody, example = json!({"name": "gateway", "scopes": ["ingest"], "structures": ["three-dof"]})),
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
        expires_at: expires_at.map_err(|e| ApiError::invalid_field("/expires_at", e.to_string()))?,
    };
    let (record, text) = shared.access.create_token(new).await?;
    Ok(issued(StatusCode::CREATED, &record, &text))
}

/// `POST /v1/tokens/{id}/rotation`: a new secret, shown this once; the old one stays good for `overlap_s`.
///
/// # Errors
/// 404, 409 for a token that is not active, 422 for the overlap.
#[utoipa::path(
    post, path = "/v1/tokens/{id}/rotation", tag = "access", operation_id = "rotate_token",
    summary = "Give a token another secret",
    description = "The new secret is in this answer and in no other; the old one stays good for `overlap_s`.",
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

/// `DELETE /v1/tokens/{id}`: revoked from now on; a second time changes nothing.
///
/// # Errors
/// 404, 409 for the last token that manages the service.
#[utoipa::path(
    delete, path = "/v1/tokens/{id}", tag = "access", operation_id = "revoke_token",
    summary = "Revoke a token", description = "From now on; a second time changes nothing.",
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

/// Each change reaches the store first and memory after, one at a time. They run inside the task of the audit, which no
/// client can end halfway.
impl AccessControl {
    async fn create_token(&self, new: NewToken) -> Result<(TokenRecord, TokenText), ApiError> {
        let _one = self.0.changing.lock().await;
        let now = Timestamp::now();
        let problems = new.problems(now);
        if !problems.is_empty() {
            return Err(ApiError::invalid_input(problems));
        }
        let text = TokenText::generate().map_err(|e| ApiError::internal(&e))?;
        let record = new.record(&text, now);
        if self.is_open() && !(record.manages_service() && record.expires_at.is_none()) {
            let detail =
                "the first token closes the service to everybody without one: it must have the scope admin, no \
                          structures and no expires_at, so that others can be made";
            return Err(ApiError::invalid("first_token_must_be_admin", detail, Vec::new()));
        }
        self.0.store.tokens().insert_token(&record).await?;
        self.remember(record.clone());
        Ok((record, text))
    }

    async fn rotate_token(&self, id: &str, overlap_s: i64) -> Result<(TokenRecord, TokenText), ApiError> {
        let _one = self.0.changing.lock().await;
        let (record, now) = (self.stored_token(id)?, Timestamp::now());
        if !record.is_active(now) {
            let detail = format!("token {id} is {}: make a new one", record.state(now));
            return Err(ApiError::new(StatusCode::CONFLICT, "token_not_active", detail));
        }
        let text = TokenText::with_id(record.id.clone()).map_err(|e| ApiError::internal(&e))?;
        let until = Timestamp::from_micros(now.micros() + overlap_s * 1_000_000);
        let rotated = record.rotated(&text, until.map_err(|e| ApiError::internal(&e))?);
        self.0.store.tokens().update_token(&rotated).await?;
        self.remember(rotated.clone());
        Ok((rotated, text))
    }

    async fn revoke_token(&self, id: &str) -> Result<TokenRecord, ApiError> {
        let _one = self.0.changing.lock().await;
        let (record, now) = (self.stored_token(id)?, Timestamp::now());
        if record.revoked_at.is_some() {
            return Ok(record);
        }
        let others = |tokens: &TokenTable| {
            tokens.records().any(|other| other.id != record.id && other.manages_service() && other.is_active(now))
        };
        let last = record.manages_service() && record.is_active(now) && self.0.file_token.is_empty();
        if last && !self.read_tokens(others) {
            let detail = "this is the last token that manages the service: make another one with the scope admin first";
            return Err(ApiError::new(StatusCode::CONFLICT, "last_admin_token", detail));
        }
        let revoked = TokenRecord { revoked_at: Some(now), ..record };
        self.0.store.tokens().update_token(&revoked).await?;
        self.remember(revoked.clone());
        Ok(revoked)
    }

    fn stored_token(&self, id: &str) -> Result<TokenRecord, ApiError> {
        let found = TokenId::parse(id).ok().and_then(|id| self.read_tokens(|tokens| tokens.get(&id).cloned()));
        let detail = || format!("there is no token {}", shown(id));
        found.ok_or_else(|| ApiError::new(StatusCode::NOT_FOUND, "unknown_token", detail()))
    }

    fn remember(&self, record: TokenRecord) {
        self.0.tokens.write().expect("no holder of the lock panics").insert(record);
    }
}
