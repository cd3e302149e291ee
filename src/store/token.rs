//! Access tokens. Of their secrets only digests are stored.

use std::collections::BTreeSet;
use std::sync::Arc;

use sqlx::FromRow;

use super::column::{bad_row, timestamp};
use super::database::Database;
use super::error::Error;
use super::sql;
use crate::access::{Scope, SecretDigest, TokenId, TokenRecord};
use crate::quantity::{StructureId, Timestamp};

const TOKEN: &str = "token";

#[derive(FromRow)]
#[expect(clippy::struct_excessive_bools, reason = "a row has the columns of its table")]
struct TokenRow {
    token_id: String,
    name: String,
    ingest: bool,
    read: bool,
    admin: bool,
    limited: bool,
    digest: Vec<u8>,
    previous_digest: Option<Vec<u8>>,
    previous_until_us: Option<i64>,
    created_at_us: i64,
    expires_at_us: Option<i64>,
    revoked_at_us: Option<i64>,
    sources: Option<String>,
}

/// Access tokens.
#[derive(Clone, Copy)]
pub struct Tokens<'s> {
    pub(super) database: &'s Database,
}

impl Tokens<'_> {
    /// All tokens, including revoked ones.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn list(self) -> Result<Vec<TokenRecord>, Error> {
        let rows: Vec<TokenRow> = sql::query_as(
            "select token_id, name, ingest, read, admin, limited, digest, previous_digest, previous_until_us,
                    created_at_us, expires_at_us, revoked_at_us, sources
             from api_token order by created_at_us, token_id",
        )
        .fetch_all(&self.database.reader)
        .await?;
        let structures: Vec<(String, String)> = sql::query_as("select token_id, structure_id from api_token_structure")
            .fetch_all(&self.database.reader)
            .await?;
        rows.into_iter().map(|row| record(row, &structures)).collect()
    }

    /// Stores a new token.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn insert_token(self, token: &TokenRecord) -> Result<(), Error> {
        let token = token.clone();
        let sources =
            token.sources.as_deref().map(serde_json::to_string).transpose().map_err(|e| bad_row(TOKEN)(&e))?;
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    sql::query(
                        "insert into api_token values ($1, $2, $3, $4, $5, $6, $7, null, null, $8, $9, null, $10)",
                    )
                    .bind(token.id.as_str())
                    .bind(&token.name)
                    .bind(has(&token, Scope::Ingest))
                    .bind(has(&token, Scope::Read))
                    .bind(has(&token, Scope::Admin))
                    .bind(token.structures.is_some())
                    .bind(token.digest.as_bytes().as_slice())
                    .bind(token.created_at.micros())
                    .bind(token.expires_at.map(Timestamp::micros))
                    .bind(sources)
                    .execute(&mut *transaction)
                    .await?;
                    for structure in token.structures.iter().flat_map(|ids| ids.iter()) {
                        sql::query("insert into api_token_structure values ($1, $2)")
                            .bind(token.id.as_str())
                            .bind(structure.as_str())
                            .execute(&mut *transaction)
                            .await?;
                    }
                    Ok(())
                })
            })
            .await
    }

    /// Stores the digests and the revocation of a token, below the minimum of free space as well: no token must stay valid for want of room.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn update_token(self, token: &TokenRecord) -> Result<(), Error> {
        let token = token.clone();
        self.database
            .write_without_floor(move |transaction| {
                Box::pin(async move {
                    let previous = token.previous.as_ref();
                    sql::query(
                    "update api_token set digest = $1, previous_digest = $2, previous_until_us = $3, revoked_at_us = $4
                     where token_id = $5",
                )
                .bind(token.digest.as_bytes().as_slice())
                .bind(previous.map(|(digest, _)| digest.as_bytes().to_vec()))
                .bind(previous.map(|(_, until)| until.micros()))
                .bind(token.revoked_at.map(Timestamp::micros))
                .bind(token.id.as_str())
                .execute(&mut *transaction)
                .await?;
                    Ok(())
                })
            })
            .await
    }
}

fn has(token: &TokenRecord, scope: Scope) -> bool {
    token.scopes.iter().any(|own| own == scope)
}

fn record(row: TokenRow, structures: &[(String, String)]) -> Result<TokenRecord, Error> {
    let digest = |bytes: Vec<u8>| {
        let bytes: [u8; 32] = bytes.try_into().map_err(|_| bad_row(TOKEN)(&"a digest does not have 32 bytes"))?;
        Ok::<_, Error>(SecretDigest::from_stored(bytes))
    };
    let time = |micros: Option<i64>| micros.map(|micros| timestamp(TOKEN, micros)).transpose();
    let scopes = [(row.ingest, Scope::Ingest), (row.read, Scope::Read), (row.admin, Scope::Admin)];
    let own = structures.iter().filter(|(token, _)| *token == row.token_id);
    let own: Result<BTreeSet<StructureId>, Error> =
        own.map(|(_, id)| StructureId::parse(id).map_err(|e| bad_row(TOKEN)(&e))).collect();
    let sources = row.sources.map(|list| serde_json::from_str::<BTreeSet<String>>(&list)).transpose();
    let previous = match (row.previous_digest, time(row.previous_until_us)?) {
        (Some(bytes), Some(until)) => Some((digest(bytes)?, until)),
        _ => None,
    };
    Ok(TokenRecord {
        id: TokenId::parse(&row.token_id).map_err(|e| bad_row(TOKEN)(&e))?,
        name: row.name,
        scopes: scopes.into_iter().filter_map(|(has, scope)| has.then_some(scope)).collect(),
        structures: if row.limited { Some(Arc::new(own?)) } else { None },
        sources: sources.map_err(|e| bad_row(TOKEN)(&e))?.map(Arc::new),
        digest: digest(row.digest)?,
        previous,
        created_at: timestamp(TOKEN, row.created_at_us)?,
        expires_at: time(row.expires_at_us)?,
        revoked_at: time(row.revoked_at_us)?,
    })
}
