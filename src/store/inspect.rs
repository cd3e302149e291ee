//! Inspecting a database that no service has open, without changing it, for `doctor`.

use std::path::Path;

use sqlx::Connection as _;
use sqlx_sqlite::{SqliteConnectOptions, SqliteConnection};

use super::column::timestamp;
use super::error::Error;
use super::file::{foreign_objects, library_version, refuse_foreign, schema_version, take_lock, DATABASE_FILE};
use super::server;
use super::unreadable::{unreadable, Inspected};
use super::url::DatabaseUrl;
use super::version::StoredBaseline;
use crate::quantity::Timestamp;

/// The state of a database.
#[derive(Debug)]
pub struct Inspection {
    /// Version of the SQLite library.
    pub sqlite_version: String,
    /// True if the library is free of the WAL-reset defect.
    pub sqlite_is_safe: bool,
    /// Schema version of the file.
    pub schema_version: i64,
    /// Newest schema version known to this program.
    pub known_schema: i64,
    /// Defects of its pages and indexes.
    pub damage: Vec<String>,
    /// Tables, views and triggers that this program did not make.
    pub foreign: Vec<String>,
    /// Rows that cannot be read.
    pub unreadable: Vec<String>,
    /// Number of rows that refer to missing rows.
    pub dangling_rows: u64,
    /// When the newest batch arrived.
    pub newest_received: Option<Timestamp>,
    /// Structures: id, definition, and the trained baseline that the service made for the present version.
    pub structures: Vec<(String, String, Option<StoredBaseline>)>,
}

/// Inspects the database of a data folder. `None` if there is none yet.
///
/// # Errors
/// [`Error::Locked`] if a service has it open; [`Error::NotADatabase`], [`Error::Foreign`].
pub async fn inspect(data_dir: &Path) -> Result<Option<Inspection>, Error> {
    let path = data_dir.join(DATABASE_FILE);
    if !path.exists() {
        return Ok(None);
    }
    let _lock = take_lock(data_dir)?;
    refuse_foreign(&path).await?;
    let mut connection = SqliteConnection::connect_with(&SqliteConnectOptions::new().filename(&path)).await?;
    let connection = &mut connection;
    let (sqlite_version, sqlite_is_safe) = library_version(connection).await?;
    let findings: Vec<(String,)> = sqlx::query_as("pragma integrity_check(10)").fetch_all(&mut *connection).await?;
    let (dangling,): (i64,) =
        sqlx::query_as("select count(*) from pragma_foreign_key_check").fetch_one(&mut *connection).await?;
    let mut found_schema = 0;
    if has_table(connection, "_sqlx_migrations").await? {
        let (version,): (i64,) =
            sqlx::query_as("select coalesce(max(version), 0) from _sqlx_migrations where success = 1")
                .fetch_one(&mut *connection)
                .await?;
        found_schema = version;
    }
    let foreign =
        if found_schema <= schema_version() { foreign_objects(connection, found_schema).await? } else { Vec::new() };
    let unreadable =
        if found_schema == schema_version() { unreadable(Inspected::File(connection)).await? } else { Vec::new() };
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
                     where structure_id = $1 and structure_digest = $2",
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
        sqlite_version,
        sqlite_is_safe,
        schema_version: found_schema,
        known_schema: schema_version(),
        damage: findings.into_iter().map(|(finding,)| finding).filter(|finding| finding != "ok").collect(),
        foreign,
        unreadable,
        dangling_rows: dangling.unsigned_abs(),
        newest_received,
        structures,
    }))
}

/// The rows of a database of a server that cannot be read, as sentences. A service may be using it.
///
/// # Errors
/// [`Error`], whose message says what to do.
pub async fn unreadable_on_server(url: &DatabaseUrl) -> Result<Vec<String>, Error> {
    let mut connection = server::connection(url).await?;
    let found = unreadable(Inspected::Server(&mut connection)).await?;
    let _ = connection.close().await;
    Ok(found)
}

async fn has_table(connection: &mut SqliteConnection, table: &str) -> Result<bool, Error> {
    let (found,): (bool,) =
        sqlx::query_as("select exists (select 1 from sqlite_schema where type = 'table' and name = $1)")
            .bind(table)
            .fetch_one(connection)
            .await?;
    Ok(found)
}
