//! A look at a database that no service has open, changing nothing: for `doctor`.

use std::path::Path;

use sqlx::sqlite::{SqliteConnectOptions, SqliteConnection};
use sqlx::Connection as _;

use super::diagnosis::StoredBaseline;
use super::{newest, refuse_foreign, take_lock, timestamp, Error, DATABASE_FILE, OLDEST_SQLITE};
use crate::quantity::Timestamp;

/// What was found.
#[derive(Debug)]
pub struct Inspection {
    /// Version of the SQLite library.
    pub sqlite_version: String,
    /// True when it is free of the defect that can damage a log.
    pub sqlite_is_safe: bool,
    /// Schema of the file.
    pub schema_version: i64,
    /// Newest schema of this program.
    pub known_schema: i64,
    /// What is wrong with its pages and indices; empty when nothing is.
    pub damage: Vec<String>,
    /// Rows that refer to rows that are not there.
    pub dangling_rows: u64,
    /// When the newest batch arrived.
    pub newest_received: Option<Timestamp>,
    /// Structures as stored: id, definition, and the baseline that the service trained for the present version.
    pub structures: Vec<(String, String, Option<StoredBaseline>)>,
}

/// Looks at the database of a data folder; `None` when there is none yet.
///
/// # Errors
/// [`Error::Locked`] when a service has it open; [`Error::NotADatabase`], [`Error::Foreign`].
pub async fn inspect(data_dir: &Path) -> Result<Option<Inspection>, Error> {
    let path = data_dir.join(DATABASE_FILE);
    if !path.exists() {
        return Ok(None);
    }
    let _lock = take_lock(data_dir)?;
    refuse_foreign(&path).await?;
    let mut connection = SqliteConnection::connect_with(&SqliteConnectOptions::new().filename(&path)).await?;
    let connection = &mut connection;
    let (sqlite_version,): (String,) = sqlx::query_as("select sqlite_version()").fetch_one(&mut *connection).await?;
    let numbers: Vec<u32> = sqlite_version.split('.').filter_map(|n| n.parse().ok()).collect();
    let findings: Vec<(String,)> = sqlx::query_as("pragma integrity_check(10)").fetch_all(&mut *connection).await?;
    let (dangling,): (i64,) =
        sqlx::query_as("select count(*) from pragma_foreign_key_check").fetch_one(&mut *connection).await?;
    let mut schema_version = 0;
    if has_table(connection, "_sqlx_migrations").await? {
        let (version,): (i64,) =
            sqlx::query_as("select coalesce(max(version), 0) from _sqlx_migrations where success = 1")
                .fetch_one(&mut *connection)
                .await?;
        schema_version = version;
    }
    let (mut newest_received, mut structures) = (None, Vec::new());
    if has_table(connection, "measurement_batch").await? {
        let (newest,): (Option<i64>,) =
            sqlx::query_as("select max(received_at_us) from measurement_batch").fetch_one(&mut *connection).await?;
        newest_received = newest.map(|at| timestamp("batch", at)).transpose()?;
    }
    if has_table(connection, "structure").await? {
        let trained = has_table(connection, "trained_baseline").await?;
        let rows: Vec<(String, String, String)> =
            sqlx::query_as("select structure_id, definition, digest from structure order by structure_id")
                .fetch_all(&mut *connection)
                .await?;
        for (id, definition, digest) in rows {
            let stored = if trained {
                sqlx::query_as(
                    "select model_digest, manifest, weights, accepted from trained_baseline
                     where structure_id = ? and structure_digest = ?",
                )
                .bind(&id)
                .bind(digest)
                .fetch_optional(&mut *connection)
                .await?
            } else {
                None
            };
            structures.push((id, definition, stored));
        }
    }
    Ok(Some(Inspection {
        sqlite_is_safe: numbers.as_slice() >= OLDEST_SQLITE.as_slice(),
        sqlite_version,
        schema_version,
        known_schema: newest(),
        damage: findings.into_iter().map(|(finding,)| finding).filter(|finding| finding != "ok").collect(),
        dangling_rows: dangling.unsigned_abs(),
        newest_received,
        structures,
    }))
}

async fn has_table(connection: &mut SqliteConnection, table: &str) -> Result<bool, Error> {
    let (found,): (bool,) =
        sqlx::query_as("select exists (select 1 from sqlite_schema where type = 'table' and name = ?)")
            .bind(table)
            .fetch_one(connection)
            .await?;
    Ok(found)
}
