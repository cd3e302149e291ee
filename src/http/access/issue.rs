//! Creating, rotating and revoking tokens.

use axum::http::StatusCode;

use super::control::AccessControl;
use crate::access::{NewToken, TokenId, TokenRecord, TokenTable, TokenText};
use crate::clock;
use crate::http::error::ApiError;
use crate::quantity::{shown, Timestamp};

/// Each change is written to the store before it takes effect in memory, and changes are made one at a time. They run
/// inside the task of the audit, which continues when the client disconnects.
impl AccessControl {
    /// Creates a token.
    ///
    /// # Errors
    /// 422 for invalid properties, or for a first token that cannot create others.
    pub async fn create_token(&self, new: NewToken) -> Result<(TokenRecord, TokenText), ApiError> {
        let _one = self.0.changing.lock().await;
        let now = clock::now();
        let problems = new.problems(now);
        if !problems.is_empty() {
            return Err(ApiError::invalid_input(problems));
        }
        let text = TokenText::generate().map_err(|e| ApiError::internal(&e))?;
        let record = new.record(&text, now);
        if self.is_open() && !(record.manages_service() && record.expires_at.is_none()) {
            let detail =
                "the first token closes the service to everybody without a token: it must have the scope admin, no structures \
                 and no expires_at, so that further tokens can be created";
            return Err(ApiError::invalid("first_token_must_be_admin", detail, Vec::new()));
        }
        self.0.store.tokens().insert_token(&record).await?;
        self.remember(record.clone());
        Ok((record, text))
    }

    /// Creates a new secret; the previous one stays valid for `overlap_s` seconds.
    ///
    /// # Errors
    /// 404 if there is no such token, 409 if it is not active.
    pub async fn rotate_token(&self, id: &str, overlap_s: i64) -> Result<(TokenRecord, TokenText), ApiError> {
        let _one = self.0.changing.lock().await;
        let (record, now) = (self.stored_token(id)?, clock::now());
        if !record.is_active(now) {
            let detail = format!("token {id} is {}: create a new one", record.state(now));
            return Err(ApiError::new(StatusCode::CONFLICT, "token_not_active", detail));
        }
        let text = TokenText::with_id(record.id.clone()).map_err(|e| ApiError::internal(&e))?;
        let until = Timestamp::from_micros(now.micros() + overlap_s * 1_000_000);
        let rotated = record.rotated(&text, until.map_err(|e| ApiError::internal(&e))?);
        self.0.store.tokens().update_token(&rotated).await?;
        self.remember(rotated.clone());
        Ok((rotated, text))
    }

    /// Revokes a token.
    ///
    /// # Errors
    /// 404 if there is no such token, 409 if it is the last one that can manage the service.
    pub async fn revoke_token(&self, id: &str) -> Result<TokenRecord, ApiError> {
        let _one = self.0.changing.lock().await;
        let (record, now) = (self.stored_token(id)?, clock::now());
        if record.revoked_at.is_some() {
            return Ok(record);
        }
        let others = |tokens: &TokenTable| {
            tokens.records().any(|other| other.id != record.id && other.manages_service() && other.is_active(now))
        };
        let last = record.manages_service() && record.is_active(now) && self.0.file_token.is_empty();
        if last && !self.read_tokens(others) {
            let detail =
                "this is the last token that can manage the service: create another one with the scope admin first";
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
