//! Opening the database: pragmas, integrity check, and migrations.

use std::cmp::Ordering;
use std::path::Path;
use std::time::Duration;

use sqlx::migrate::{MigrateError, Migrator};
use sqlx_sqlite::{
    SqliteConnectOptions, SqliteConnection, SqliteJournalMode, SqlitePool, SqlitePoolOptions, SqliteSynchronous,
};

use super::super::error::Error;
use super::identity::{not_a_database, APPLICATION_ID};

/// The first SQLite release without the WAL-reset defect, through which two connections could corrupt a database.
const OLDEST_SQLITE: [u32; 3] = [3, 51, 3];

/// Largest database whose indexes are compared with their tables at every start, which takes about five seconds. A single
/// flipped bit in a key hides a batch, and the quick check does not detect it.
const FULL_CHECK_BYTES: u64 = 1 << 30;

/// The log file is truncated to this size when it restarts. Without the limit, one long read would leave a large file permanently.
const LOG_LIMIT_BYTES: &str = "67108864";

const READERS: u32 = 8;
/// Rows that a reader buffers: for long series, passing rows singly between threads would cost more than reading them.
const ROWS_AT_A_TIME: usize = 1_000;
const BUSY_TIMEOUT: Duration = Duration::from_secs(5);

pub(super) static MIGRATIONS: Migrator = sqlx::sqlx_macros::migrate!();

/// The newest schema version that this program knows, which is that of every open store.
pub fn schema_version() -> i64 {
    MIGRATIONS.iter().map(|m| m.version).max().unwrap_or_default()
}

/// The connections of a database that was opened.
pub(in super::super) struct Opened {
    pub writer: SqlitePool,
    pub reader: SqlitePool,
    pub sqlite_version: String,
}

/// Opens a database: checks its integrity, sets the application id of this program, and migrates it to the newest schema.
pub(in super::super) async fn open(path: &Path) -> Result<Opened, Error> {
    let options = SqliteConnectOptions::new()
        .filename(path)
        .journal_mode(SqliteJournalMode::Wal)
        .synchronous(SqliteSynchronous::Full)
        .foreign_keys(true)
        .pragma("journal_size_limit", LOG_LIMIT_BYTES)
        .busy_timeout(BUSY_TIMEOUT);
    // The only connection that writes; it lives as long as the store.
    let writer = SqlitePoolOptions::new().max_connections(1).idle_timeout(None).max_lifetime(None);
    let writer = writer.connect_with(options.clone().create_if_missing(true)).await;
    let writer = writer.map_err(|e| not_a_database(e, path))?;
    let check: Result<(String,), _> = sqlx::query_as(check_of(path)).fetch_one(&writer).await;
    let (check,) = check.map_err(|e| not_a_database(e, path))?;
    if check != "ok" {
        return Err(Error::Corrupt { path: path.to_owned(), detail: check });
    }
    let (sqlite_version, safe) = library_version(&mut *writer.acquire().await?).await?;
    if !safe {
        return Err(Error::LibraryTooOld(sqlite_version));
    }
    // The application id is set after the checks, because it is a write and a damaged file must stay as it is.
    let (application_id,): (i64,) = sqlx::query_as("pragma application_id").fetch_one(&writer).await?;
    // It is not written again: a service must start on a full disk, for reading.
    if application_id != APPLICATION_ID {
        let mark = format!("pragma application_id = {APPLICATION_ID}");
        sqlx::query(sqlx::AssertSqlSafe(mark)).execute(&writer).await?;
    }
    MIGRATIONS.run(&writer).await.map_err(|error| match error {
        MigrateError::VersionMissing(found) => {
            Error::SchemaTooNew { place: path.display().to_string(), found, known: schema_version() }
        }
        other => Error::Migration(other),
    })?;
    // For larger savepoints SQLite copies pages to a temporary file, which would be created, written and removed in nearly every
    // transaction. It is set after the migrations, which may have to sort a whole table.
    sqlx::query("pragma temp_store = memory").execute(&writer).await?;
    writer.set_connect_options(options.clone().pragma("temp_store", "memory"));
    let reader = SqlitePoolOptions::new()
        .max_connections(READERS)
        .connect_with(options.read_only(true).row_buffer_size(ROWS_AT_A_TIME))
        .await?;
    Ok(Opened { writer, reader, sqlite_version })
}

/// Checks that a file that is only read has the newest schema.
pub(in super::super) async fn check_version(connection: &mut SqliteConnection, path: &Path) -> Result<(), Error> {
    let (found,): (i64,) = sqlx::query_as("select coalesce(max(version), 0) from _sqlx_migrations where success = 1")
        .fetch_one(connection)
        .await?;
    let (place, known) = (path.display().to_string(), schema_version());
    match found.cmp(&known) {
        Ordering::Less => Err(Error::FileTooOld { place, found, known }),
        Ordering::Greater => Err(Error::SchemaTooNew { place, found, known }),
        Ordering::Equal => Ok(()),
    }
}

/// The version of the SQLite library, and whether it is free of the WAL-reset defect.
pub(in super::super) async fn library_version(connection: &mut SqliteConnection) -> Result<(String, bool), Error> {
    let (version,): (String,) = sqlx::query_as("select sqlite_version()").fetch_one(connection).await?;
    let numbers: Vec<u32> = version.split('.').filter_map(|n| n.parse().ok()).collect();
    let safe = numbers.as_slice() >= OLDEST_SQLITE.as_slice();
    Ok((version, safe))
}

/// The integrity check that is fast enough for every start.
fn check_of(path: &Path) -> &'static str {
    match std::fs::metadata(path) {
        Ok(file) if file.len() > FULL_CHECK_BYTES => "pragma quick_check(1)",
        _ => "pragma integrity_check(1)",
    }
}
