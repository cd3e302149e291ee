//! The archive: the only room that speaks SQL.
//!
//! One SQLite file, one writer connection, WAL, `synchronous = FULL`: what was acknowledged survives a power loss. Every
//! write is a task of its own in one `BEGIN IMMEDIATE` transaction, so that a caller who goes away never leaves one open.

mod alarm;
mod assessment;
mod batch;
mod diagnosis;
mod history;
mod structure;
#[cfg(test)]
mod tests;
mod undamaged;

use std::fs::{File, TryLockError};
use std::future::Future;
use std::io::Read as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use sqlx::migrate::{MigrateError, Migrator};
use sqlx::sqlite::{
    SqliteConnectOptions, SqliteConnection, SqliteJournalMode, SqlitePool, SqlitePoolOptions, SqliteSynchronous,
};
use sqlx::Connection as _;

pub use alarm::{Acknowledgement, Episode, MaintenanceWindow, NewChartPoint, StoredChartPoint, FIT_SERIES};
pub use batch::{BatchRecord, InsertBatch};
pub use diagnosis::{DiagnosisRecord, JobState, NewVersion, StoredBaseline};
pub use history::{Exceedance, HistoryEntry, HistoryQuery};
pub use structure::{PutStructure, StructureRecord, StructureSummary};
pub use undamaged::UndamagedRecord;

/// Name of the database inside the data folder.
pub const DATABASE_FILE: &str = "modalwatch.sqlite";
const LOCK_FILE: &str = "modalwatch.lock";

/// Marks a database as ours: "mdlw".
const APPLICATION_ID: i64 = 0x6d64_6c77;

/// The first SQLite without the WAL-reset corruption that two connections could cause.
const OLDEST_SQLITE: [u32; 3] = [3, 51, 3];

const READERS: u32 = 4;
const BUSY_TIMEOUT: Duration = Duration::from_secs(5);

static MIGRATIONS: Migrator = sqlx::migrate!();

/// Why the store cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The folder or a file in it cannot be made or read.
    #[error("{path} cannot be used: {source}")]
    Folder {
        /// The path.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// File or folder may only be read.
    #[error("{0} is read-only: give write permission, or another --data-dir")]
    ReadOnly(PathBuf),
    /// Another process has the folder open.
    #[error("{0} is in use by another modalwatch: stop it, or give another --data-dir")]
    Locked(PathBuf),
    /// Not a SQLite file.
    #[error("{0} is no SQLite database: move it away, or give another --data-dir")]
    NotADatabase(PathBuf),
    /// A SQLite file of another program.
    #[error("{path} belongs to another program (application id {application_id:#x}): give another --data-dir")]
    Foreign {
        /// The file.
        path: PathBuf,
        /// Its application id.
        application_id: i64,
    },
    /// Damaged.
    #[error("{path} is damaged ({detail}): restore it from a backup; nothing was changed")]
    Corrupt {
        /// The file.
        path: PathBuf,
        /// What SQLite found first.
        detail: String,
    },
    /// Written by a newer program.
    #[error("{path} has schema version {found}, newer than this program's {known}: use the newer modalwatch")]
    SchemaTooNew {
        /// The file.
        path: PathBuf,
        /// Version in the file.
        found: i64,
        /// Newest version known here.
        known: i64,
    },
    /// Linked with a SQLite that can corrupt a database.
    #[error("SQLite {0} can corrupt a database (WAL reset): version 3.51.3 or later is needed")]
    LibraryTooOld(String),
    /// A structure that is not stored.
    #[error("there is no structure {0}")]
    UnknownStructure(String),
    /// A batch that is not stored.
    #[error("structure {structure} has no batch {batch}")]
    UnknownBatch {
        /// The structure.
        structure: String,
        /// The batch.
        batch: String,
    },
    /// A row that is not what was written: the file was changed by hand, or a bug.
    #[error("a stored {what} cannot be read: {detail}")]
    Row {
        /// Kind of row.
        what: &'static str,
        /// The cause.
        detail: String,
    },
    /// A migration failed.
    #[error("the database could not be brought to this version: {0}")]
    Migration(#[from] MigrateError),
    /// SQLite failed.
    #[error("database: {0}")]
    Sqlite(#[from] sqlx::Error),
    /// A task of ours panicked: a bug.
    #[error("a database task panicked")]
    Panicked,
}

/// The store: a cheap handle.
#[derive(Clone)]
pub struct Store {
    writer: SqlitePool,
    reader: SqlitePool,
    sqlite_version: Arc<str>,
    /// Held as long as the store is open: a second instance on the same folder is refused.
    _lock: Arc<File>,
}

impl Store {
    /// Opens the database of a data folder, making folder and database where they are missing.
    ///
    /// # Errors
    /// [`Error`], one variant for each way it can be wrong, with what to do.
    pub async fn open(data_dir: &Path) -> Result<Self, Error> {
        let path = data_dir.join(DATABASE_FILE);
        let lock = prepare_folder(data_dir, &path)?;
        refuse_foreign(&path).await?;

        let options = SqliteConnectOptions::new()
            .filename(&path)
            .journal_mode(SqliteJournalMode::Wal)
            .synchronous(SqliteSynchronous::Full)
            .foreign_keys(true)
            .busy_timeout(BUSY_TIMEOUT);
        // The connection lives as long as the store; a pool of one is the queue of writers.
        let writer = SqlitePoolOptions::new().max_connections(1).idle_timeout(None).max_lifetime(None);
        let writer = writer.connect_with(options.clone().create_if_missing(true)).await;
        let writer = writer.map_err(|e| not_a_database(e, &path))?;
        let check: Result<(String,), _> = sqlx::query_as("pragma quick_check(1)").fetch_one(&writer).await;
        let (check,) = check.map_err(|e| not_a_database(e, &path))?;
        if check != "ok" {
            return Err(Error::Corrupt { path, detail: check });
        }
        let (sqlite_version,): (String,) = sqlx::query_as("select sqlite_version()").fetch_one(&writer).await?;
        let numbers: Vec<u32> = sqlite_version.split('.').filter_map(|n| n.parse().ok()).collect();
        if numbers.as_slice() < OLDEST_SQLITE.as_slice() {
            return Err(Error::LibraryTooOld(sqlite_version));
        }
        // Only now: the mark is a write, and a damaged file is left as it is.
        let mark = format!("pragma application_id = {APPLICATION_ID}");
        sqlx::query(sqlx::AssertSqlSafe(mark)).execute(&writer).await?;
        MIGRATIONS.run(&writer).await.map_err(|error| match error {
            MigrateError::VersionMissing(found) => Error::SchemaTooNew { path: path.clone(), found, known: newest() },
            other => Error::Migration(other),
        })?;
        let reader = SqlitePoolOptions::new().max_connections(READERS).connect_with(options.read_only(true)).await?;
        Ok(Self { writer, reader, sqlite_version: sqlite_version.into(), _lock: Arc::new(lock) })
    }

    /// Version of the SQLite library.
    pub fn sqlite_version(&self) -> &str {
        &self.sqlite_version
    }

    /// Takes the write lock and gives it back: shows that a batch could be stored now.
    ///
    /// # Errors
    /// [`Error::Sqlite`] with the cause, such as a full disk or a file that became read-only.
    pub async fn is_writable(&self) -> Result<(), Error> {
        self.write(|connection| {
            Box::pin(async move {
                // An update of no row would not reach the file; a header field that nobody reads does.
                sqlx::query("pragma user_version = 1").execute(&mut *connection).await?;
                Ok(())
            })
        })
        .await
    }

    /// Writes the log back into the database and closes it.
    pub async fn close(&self) {
        self.reader.close().await;
        let _ = sqlx::query("pragma wal_checkpoint(truncate)").execute(&self.writer).await;
        self.writer.close().await;
    }

    /// Runs `work` in one immediate transaction of the writer, in a task of its own.
    ///
    /// Immediate, because a transaction that begins with a read and then writes is refused at once when another writes,
    /// whatever the busy timeout. Its own task, because axum drops handlers whose client is gone.
    async fn write<T, F>(&self, work: F) -> Result<T, Error>
    where
        T: Send + 'static,
        F: for<'c> FnOnce(&'c mut SqliteConnection) -> Work<'c, T> + Send + 'static,
    {
        let writer = self.writer.clone();
        let task = tokio::spawn(async move {
            let mut connection = writer.acquire().await?;
            let mut transaction = connection.begin_with("begin immediate").await?;
            let result = work(&mut transaction).await?;
            transaction.commit().await?;
            Ok(result)
        });
        task.await.map_err(|_| Error::Panicked)?
    }
}

/// What runs inside a write transaction.
type Work<'c, T> = std::pin::Pin<Box<dyn Future<Output = Result<T, Error>> + Send + 'c>>;

/// Makes the folder, takes its lock, and looks at permissions before SQLite does.
fn prepare_folder(data_dir: &Path, database: &Path) -> Result<File, Error> {
    let failed = |path: &Path| {
        let path = path.to_owned();
        move |source| Error::Folder { path, source }
    };
    std::fs::create_dir_all(data_dir).map_err(failed(data_dir))?;
    // The permission bits are looked at themselves: root could write all the same, and should not.
    for path in [data_dir, database] {
        if path.exists() && std::fs::metadata(path).map_err(failed(path))?.permissions().readonly() {
            return Err(Error::ReadOnly(path.to_owned()));
        }
    }
    let lock_path = data_dir.join(LOCK_FILE);
    let lock = File::options().create(true).truncate(false).write(true).open(&lock_path).map_err(failed(&lock_path))?;
    match lock.try_lock() {
        Ok(()) => Ok(lock),
        Err(TryLockError::WouldBlock) => Err(Error::Locked(data_dir.to_owned())),
        Err(TryLockError::Error(source)) => Err(Error::Folder { path: lock_path, source }),
    }
}

/// Refuses what is no database of ours before anything is written into it.
async fn refuse_foreign(path: &Path) -> Result<(), Error> {
    let failed = |source| Error::Folder { path: path.to_owned(), source };
    if !path.exists() || std::fs::metadata(path).map_err(failed)?.len() == 0 {
        return Ok(());
    }
    let mut head = [0; 16];
    let read = File::open(path).and_then(|mut file| file.read_exact(&mut head));
    if read.is_err() || &head != b"SQLite format 3\0" {
        return Err(Error::NotADatabase(path.to_owned()));
    }
    // Not read-only: a database whose last owner was killed has a log that only a writer can take up.
    let mut connection = SqliteConnection::connect_with(&SqliteConnectOptions::new().filename(path))
        .await
        .map_err(|e| not_a_database(e, path))?;
    let found: Result<(i64, bool), _> =
        sqlx::query_as("select application_id, not exists (select 1 from sqlite_schema) from pragma_application_id")
            .fetch_one(&mut connection)
            .await;
    let (application_id, empty) = found.map_err(|e| not_a_database(e, path))?;
    connection.close().await?;
    // Unmarked and without a table is what a first start leaves that was killed between making the file and marking it.
    if application_id == APPLICATION_ID || (application_id == 0 && empty) {
        Ok(())
    } else {
        Err(Error::Foreign { path: path.to_owned(), application_id })
    }
}

fn not_a_database(error: sqlx::Error, path: &Path) -> Error {
    let code = error.as_database_error().and_then(sqlx::error::DatabaseError::code).map(std::borrow::Cow::into_owned);
    match code.as_deref() {
        Some("26") => Error::NotADatabase(path.to_owned()),
        Some("11") => Error::Corrupt { path: path.to_owned(), detail: error.to_string() },
        _ => Error::Sqlite(error),
    }
}

fn newest() -> i64 {
    MIGRATIONS.iter().map(|m| m.version).max().unwrap_or_default()
}

/// Little-endian f64 blob of a vector.
fn to_blob(values: impl Iterator<Item = f64>) -> Vec<u8> {
    values.flat_map(f64::to_le_bytes).collect()
}

/// The vector of a blob.
fn from_blob(what: &'static str, blob: &[u8]) -> Result<Vec<f64>, Error> {
    let (chunks, rest) = blob.as_chunks::<8>();
    if rest.is_empty() {
        Ok(chunks.iter().map(|chunk| f64::from_le_bytes(*chunk)).collect())
    } else {
        Err(Error::Row { what, detail: format!("a vector of {} bytes", blob.len()) })
    }
}

fn bad_row(what: &'static str) -> impl Fn(&dyn std::fmt::Display) -> Error {
    move |detail| Error::Row { what, detail: detail.to_string() }
}

fn timestamp(what: &'static str, micros: i64) -> Result<crate::quantity::Timestamp, Error> {
    crate::quantity::Timestamp::from_micros(micros).map_err(|e| bad_row(what)(&e))
}
