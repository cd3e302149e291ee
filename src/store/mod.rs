//! The archive: the only room that speaks SQL.
//!
//! One SQLite file, one writer connection, WAL, `synchronous = FULL`: what was acknowledged survives a power loss. Writes run
//! in a task of their own in a `BEGIN IMMEDIATE` transaction, so that a caller who goes away never leaves one open; those that
//! wait at the same time share one, and its sync of the disk.

mod alarm;
pub mod archive;
mod assessed;
mod assessment;
mod audit;
pub mod backup;
mod batch;
mod chart;
mod diagnosis;
mod failure;
mod figures;
mod history;
pub mod inspect;
mod jobs;
mod measurements;
mod outbox;
mod overview;
mod plotted;
mod quarantine;
mod retention;
mod rows;
mod series;
mod structure;
#[cfg(test)]
mod tests;
mod token;
mod undamaged;
mod webhook;
mod writer;

use std::collections::BTreeMap;
use std::fs::{File, TryLockError};
use std::future::Future;
use std::io::Read as _;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use sqlx::migrate::{MigrateError, Migrator};
use sqlx::sqlite::{
    SqliteConnectOptions, SqliteConnection, SqliteJournalMode, SqlitePool, SqlitePoolOptions, SqliteSynchronous,
};
use sqlx::Connection as _;
use tracing::{info_span, Instrument as _};

use crate::quantity::StructureId;
use crate::volume;
use writer::{Work, Writer};

pub use alarm::{Acknowledgement, Episode, MaintenanceWindow};
pub use assessment::StoredAssessment;
pub use audit::{AuditEntry, AuditQuery, NewAuditEntry};
pub use batch::{BatchRecord, InsertBatch};
pub use chart::StoredChartPoint;
pub use diagnosis::{DiagnosisRecord, JobState, NewVersion, StoredBaseline};
pub use figures::{Figures, FolderFigures};
pub use history::{Exceedance, HistoryEntry, HistoryQuery};
pub use jobs::{JobKind, JobRecord};
pub use measurements::{MeasurementPlace, MeasurementQuery, StoredMeasurement};
pub use outbox::{Delivery, DeliveryState, OutboxEvent, Settlement, Turns};
pub use overview::{LatestAssessment, StructureOverview};
pub use quarantine::QuarantinedMessage;
pub use retention::{Deleted, Expired};
pub use series::{ChartMark, ChartSeries, Extent, QuantityMark, QuantitySeries, SeriesWindow, TrustMark};
pub use structure::{PutStructure, StructureRecord, StructureSummary};
pub use undamaged::UndamagedRecord;
pub use webhook::{EventFilter, Secret, WebhookRecord};

/// Name of the database inside the data folder.
pub const DATABASE_FILE: &str = "modalwatch.sqlite";
const LOCK_FILE: &str = "modalwatch.lock";

/// Marks a database as ours: "mdlw".
const APPLICATION_ID: i64 = 0x6d64_6c77;

/// The first SQLite without the WAL-reset corruption that two connections could cause.
const OLDEST_SQLITE: [u32; 3] = [3, 51, 3];

/// Largest database whose indexes are compared with their tables at every start: some five seconds. One flipped bit in a key
/// hides a batch, which the quick check does not see.
const FULL_CHECK_BYTES: u64 = 1 << 30;

/// The log is cut to this when it begins anew; without it, one long reader would leave a large file for ever.
const LOG_LIMIT_BYTES: &str = "67108864";

const READERS: u32 = 8;
/// Rows that a reader hands over at a time: long series would spend more on handing over than on reading.
const ROWS_AT_A_TIME: usize = 1_000;
const BUSY_TIMEOUT: Duration = Duration::from_secs(5);

static MIGRATIONS: Migrator = sqlx::migrate!();

/// Where a database may lie, and how much room it needs.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct StoreSettings {
    /// Open a database on NFS, SMB and the like all the same.
    pub allow_network_filesystem: bool,
    /// Free bytes below which nothing is written any more; 0 = write until the disk is full.
    pub min_free_bytes: u64,
    /// Bytes of the write-ahead log above which `/readyz` says so.
    pub max_wal_bytes: u64,
}

impl Default for StoreSettings {
    fn default() -> Self {
        Self { allow_network_filesystem: false, min_free_bytes: 64 << 20, max_wal_bytes: 256 << 20 }
    }
}

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
    /// Deleted or replaced while it was open: what is written now would be lost with the process.
    #[error("{0} was deleted or replaced while it was open: nothing more is stored; put it back and start the service again")]
    Gone(PathBuf),
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
    /// The folder is on a network file system.
    #[error(
        "{path} is on a network file system ({file_system}), whose locks cannot keep a database whole: give a --data-dir on a \
         local disk, or set store.allow_network_filesystem = true"
    )]
    NetworkFileSystem {
        /// The folder.
        path: PathBuf,
        /// Its file system.
        file_system: String,
    },
    /// The disk is full, or nearly so; this write was not done, and writing goes on as soon as there is room.
    #[error("the disk of the data folder is full: {0}")]
    DiskFull(String),
    /// The disk did not do what it was asked; this write was not done.
    #[error("the disk of the data folder failed: {0}")]
    Disk(String),
    /// The database may not be written any more.
    #[error("the database may not be written: {0}")]
    BecameReadOnly(String),
    /// Another writer held the database for too long.
    #[error("the database is busy: {0}")]
    Busy(String),
    /// SQLite failed.
    #[error("database: {0}")]
    Sqlite(Arc<sqlx::Error>),
    /// A task of ours panicked: a bug.
    #[error("a database task panicked")]
    Panicked,
}

/// Limits that may change while the store is open.
struct Limits {
    min_free_bytes: AtomicU64,
    max_wal_bytes: AtomicU64,
}

/// The store: a cheap handle.
#[derive(Clone)]
pub struct Store {
    writer: Arc<Writer>,
    reader: SqlitePool,
    path: Arc<Path>,
    sqlite_version: Arc<str>,
    /// Newest undamaged states that were read.
    undamaged: Arc<Mutex<BTreeMap<StructureId, Arc<UndamagedRecord>>>>,
    limits: Arc<Limits>,
    /// Held as long as the store is open: a second instance on the same folder is refused.
    _lock: Arc<File>,
}

impl Store {
    /// Opens the database of a data folder, making folder and database where they are missing.
    ///
    /// # Errors
    /// [`Error`], one variant for each way it can be wrong, with what to do.
    pub async fn open(data_dir: &Path) -> Result<Self, Error> {
        Self::open_with(data_dir, &StoreSettings::default()).await
    }

    /// As [`Self::open`], with settings.
    ///
    /// # Errors
    /// [`Error`], one variant for each way it can be wrong, with what to do.
    pub async fn open_with(data_dir: &Path, settings: &StoreSettings) -> Result<Self, Error> {
        let path = data_dir.join(DATABASE_FILE);
        let lock = prepare_folder(data_dir, &path)?;
        let volume = volume::of(data_dir).map_err(|source| Error::Folder { path: data_dir.to_owned(), source })?;
        if volume.network && !settings.allow_network_filesystem {
            let file_system = volume.file_system;
            return Err(Error::NetworkFileSystem { path: data_dir.to_owned(), file_system });
        }
        refuse_foreign(&path).await?;

        let options = SqliteConnectOptions::new()
            .filename(&path)
            .journal_mode(SqliteJournalMode::Wal)
            .synchronous(SqliteSynchronous::Full)
            .foreign_keys(true)
            .pragma("journal_size_limit", LOG_LIMIT_BYTES)
            .busy_timeout(BUSY_TIMEOUT);
        // The connection lives as long as the store; a pool of one is the queue of writers.
        let writer = SqlitePoolOptions::new().max_connections(1).idle_timeout(None).max_lifetime(None);
        let writer = writer.connect_with(options.clone().create_if_missing(true)).await;
        let writer = writer.map_err(|e| not_a_database(e, &path))?;
        let check: Result<(String,), _> = sqlx::query_as(check_of(&path)).fetch_one(&writer).await;
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
        // Savepoints keep the pages that they may have to restore in a temporary file once they are many: a file made, written and
        // removed for nearly every transaction. Not before the migrations, which may sort a whole table.
        sqlx::query("pragma temp_store = memory").execute(&writer).await?;
        writer.set_connect_options(options.clone().pragma("temp_store", "memory"));
        let reader = SqlitePoolOptions::new()
            .max_connections(READERS)
            .connect_with(options.read_only(true).row_buffer_size(ROWS_AT_A_TIME))
            .await?;
        let limits = Limits {
            min_free_bytes: AtomicU64::new(settings.min_free_bytes),
            max_wal_bytes: AtomicU64::new(settings.max_wal_bytes),
        };
        let file = OpenedFile::of(path.clone())?;
        Ok(Self {
            writer: Arc::new(Writer::new(writer, file)),
            reader,
            path: path.into(),
            sqlite_version: sqlite_version.into(),
            undamaged: Arc::default(),
            limits: Arc::new(limits),
            _lock: Arc::new(lock),
        })
    }

    /// The folder of the database.
    pub fn folder(&self) -> &Path {
        self.path.parent().unwrap_or(Path::new("."))
    }

    /// Takes over the limits of changed settings; where the database lies stays as it is.
    pub fn set_limits(&self, settings: &StoreSettings) {
        self.limits.min_free_bytes.store(settings.min_free_bytes, Ordering::Relaxed);
        self.limits.max_wal_bytes.store(settings.max_wal_bytes, Ordering::Relaxed);
    }

    /// Free bytes below which nothing is written.
    pub fn min_free_bytes(&self) -> u64 {
        self.limits.min_free_bytes.load(Ordering::Relaxed)
    }

    /// Bytes of the write-ahead log above which it counts as large.
    pub fn max_wal_bytes(&self) -> u64 {
        self.limits.max_wal_bytes.load(Ordering::Relaxed)
    }

    /// Refuses while less is free than the floor: the rest of the disk is what the log needs to be written back.
    ///
    /// # Errors
    /// [`Error::DiskFull`].
    pub fn refuse_without_room(&self) -> Result<(), Error> {
        let floor = self.min_free_bytes();
        if floor == 0 {
            return Ok(());
        }
        let folder = self.folder();
        let free = volume::free_bytes(folder).map_err(|source| Error::Folder { path: folder.to_owned(), source })?;
        if free >= floor {
            return Ok(());
        }
        Err(Error::DiskFull(format!("{free} bytes are free, store.min_free_bytes asks for {floor}")))
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

    /// Whether it was closed: whatever still wants to write can give up.
    pub fn is_closed(&self) -> bool {
        self.writer.pool.is_closed()
    }

    /// Writes the log back into the database and closes it.
    pub async fn close(&self) {
        self.reader.close().await;
        let _ = sqlx::query("pragma wal_checkpoint(truncate)").execute(&self.writer.pool).await;
        self.writer.pool.close().await;
    }

    /// Runs `work` in an immediate transaction of the writer, in a task of its own; what waits at the same time shares the
    /// transaction. Works are done in the order of the calls, also where the answer is waited for later.
    fn write<T, F>(&self, work: F) -> impl Future<Output = Result<T, Error>> + Send + 'static
    where
        T: Send + 'static,
        F: for<'c> FnOnce(&'c mut SqliteConnection) -> Work<'c, T> + Send + 'static,
    {
        let queued = self.refuse_without_room().map(|()| self.write_without_floor(work));
        let writer = Arc::clone(&self.writer);
        async move {
            match queued {
                Ok(answer) => answer.await,
                Err(error) => {
                    writer.count_failure(&error);
                    Err(error)
                }
            }
        }
    }

    /// As [`Self::write`], however little is free: for what makes room.
    fn write_without_floor<T, F>(&self, work: F) -> impl Future<Output = Result<T, Error>> + Send + 'static
    where
        T: Send + 'static,
        F: for<'c> FnOnce(&'c mut SqliteConnection) -> Work<'c, T> + Send + 'static,
    {
        let trace = info_span!(target: "modalwatch::spans", "store transaction");
        self.writer.queue(work).instrument(trace)
    }
}

/// The database file as it was opened.
///
/// A file that is deleted or replaced lives on under its open handles: SQLite would go on writing into it without an error, and
/// all of it would be gone with the process.
struct OpenedFile {
    path: PathBuf,
    log: PathBuf,
    device_and_inode: (u64, u64),
}

impl OpenedFile {
    fn of(path: PathBuf) -> Result<Self, Error> {
        let device_and_inode =
            device_and_inode(&path).map_err(|source| Error::Folder { path: path.clone(), source })?;
        let mut log = path.clone().into_os_string();
        log.push("-wal");
        Ok(Self { path, log: log.into(), device_and_inode })
    }

    /// Whether file and log are still there; by name only: closing a second handle on the file would drop SQLite's locks.
    fn check(&self) -> Result<(), Error> {
        let same = device_and_inode(&self.path).is_ok_and(|found| found == self.device_and_inode);
        (same && self.log.exists()).then_some(()).ok_or_else(|| Error::Gone(self.path.clone()))
    }
}

fn device_and_inode(path: &Path) -> std::io::Result<(u64, u64)> {
    std::fs::metadata(path).map(|m| (m.dev(), m.ino()))
}

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
    make_private(database).map_err(failed(database))?;
    take_lock(data_dir)
}

/// The lock of a folder that exists.
fn take_lock(data_dir: &Path) -> Result<File, Error> {
    let lock_path = data_dir.join(LOCK_FILE);
    let failed = |path: &Path| {
        let path = path.to_owned();
        move |source| Error::Folder { path, source }
    };
    let lock = File::options().create(true).truncate(false).write(true).open(&lock_path).map_err(failed(&lock_path))?;
    match lock.try_lock() {
        Ok(()) => Ok(lock),
        Err(TryLockError::WouldBlock) => Err(Error::Locked(data_dir.to_owned())),
        Err(TryLockError::Error(source)) => Err(Error::Folder { path: lock_path, source }),
    }
}

/// Makes the database's file, where there is none, for its owner only: it holds the secrets of webhooks. SQLite gives the
/// files beside it the same permissions.
fn make_private(database: &Path) -> std::io::Result<()> {
    let mut options = File::options();
    options.write(true).create_new(true);
    #[cfg(unix)]
    std::os::unix::fs::OpenOptionsExt::mode(&mut options, 0o600);
    match options.open(database) {
        Err(error) if error.kind() != std::io::ErrorKind::AlreadyExists => Err(error),
        _ => Ok(()),
    }
}

/// The check that a start can afford.
fn check_of(path: &Path) -> &'static str {
    match std::fs::metadata(path) {
        Ok(file) if file.len() > FULL_CHECK_BYTES => "pragma quick_check(1)",
        _ => "pragma integrity_check(1)",
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
        _ => Error::Sqlite(Arc::new(error)),
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
