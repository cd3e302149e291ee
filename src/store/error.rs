//! The errors of the store, and how failures of the disk are distinguished from programming errors.

use std::path::PathBuf;
use std::sync::Arc;

use sqlx::migrate::MigrateError;
use sqlx_postgres::PgDatabaseError;
use sqlx_sqlite::SqliteError;

use super::url::UrlError;

/// Why an operation of the store failed.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The data folder or a file in it cannot be created or read.
    #[error("{path} cannot be used: {source}")]
    Folder {
        /// The path.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// The database file or its folder is read-only.
    #[error("{0} is read-only: give write permission, or another --data-dir")]
    ReadOnly(PathBuf),
    /// The database file was deleted or replaced while it was open, so that new data would be lost with the process.
    #[error("{0} was deleted or replaced while it was open: nothing more is stored; put it back and start the service again")]
    Gone(PathBuf),
    /// Another process has the data folder open.
    #[error("{0} is in use by another modalwatch: stop it, or give another --data-dir")]
    Locked(PathBuf),
    /// The file is not a SQLite database.
    #[error("{0} is not a SQLite database: move it away, or give another --data-dir")]
    NotADatabase(PathBuf),
    /// The file is a SQLite database of another program.
    #[error("{path} belongs to another program (application id {application_id:#x}): give another --data-dir")]
    Foreign {
        /// The file.
        path: PathBuf,
        /// Its application id.
        application_id: i64,
    },
    /// The database file is damaged.
    #[error("{path} is damaged ({detail}): restore it from a backup; nothing was changed")]
    Corrupt {
        /// The file.
        path: PathBuf,
        /// The first defect that SQLite reported.
        detail: String,
    },
    /// The database was written by a newer program.
    #[error("{place} has schema version {found}, newer than this program's {known}: use the newer modalwatch")]
    SchemaTooNew {
        /// The file, or the database of a server.
        place: String,
        /// Schema version of the file.
        found: i64,
        /// Newest schema version known to this program.
        known: i64,
    },
    /// The linked SQLite library has a defect that can corrupt a database.
    #[error("SQLite {0} can corrupt a database (WAL reset): version 3.51.3 or later is needed")]
    LibraryTooOld(String),
    /// The PostgreSQL server is older than version 15.
    #[error("the PostgreSQL server has version {0}: version 15 or later is needed")]
    ServerTooOld(String),
    /// The setting `store.url` cannot be used.
    #[error("store.url: {0}")]
    Url(#[from] UrlError),
    /// The server refuses the user, the password or the database.
    #[error("{place} refuses the connection: {detail}; check user, password and database of store.url")]
    Refused {
        /// The database, without the password.
        place: String,
        /// What the server says.
        detail: String,
    },
    /// The server does not answer, or the connection to it broke.
    #[error("the database cannot be reached: {0}")]
    Unreachable(String),
    /// The database has no tables of this program yet.
    #[error("{0} has no tables of modalwatch yet: make them by `modalwatch migrate schema`")]
    NoSchema(String),
    /// The database was last used by an earlier program.
    #[error("{place} has schema version {found}, this program needs {known}: stop all services and run `modalwatch migrate schema`")]
    SchemaTooOld {
        /// The database, without the password.
        place: String,
        /// Schema version of the database.
        found: i64,
        /// Schema version that this program needs.
        known: i64,
    },
    /// The file was last used by an earlier program.
    #[error("{place} has schema version {found}, this program needs {known}: start `modalwatch serve` on it once, which brings it to that version")]
    FileTooOld {
        /// The file.
        place: String,
        /// Schema version of the file.
        found: i64,
        /// Schema version that this program needs.
        known: i64,
    },
    /// The schema of the database has tables of another application.
    #[error("the schema {schema} of {place} belongs to another application: give another database")]
    ForeignSchema {
        /// The database, without the password.
        place: String,
        /// The schema.
        schema: &'static str,
    },
    /// Data were being moved into the database, and the move is not complete.
    #[error("data are being moved into {0}, or a move was broken off: run the same `modalwatch migrate --from … --to …` again")]
    MoveIncomplete(String),
    /// Another service serves the database, or has taken it over.
    #[error("{0}")]
    ServedElsewhere(String),
    /// The structure is not stored.
    #[error("there is no structure {0}")]
    UnknownStructure(String),
    /// The batch is not stored.
    #[error("structure {structure} has no batch {batch}")]
    UnknownBatch {
        /// The structure.
        structure: String,
        /// The batch.
        batch: String,
    },
    /// A row cannot be decoded: the file was changed by another program, or there is a programming error.
    #[error("a stored {what} cannot be read: {detail}")]
    Row {
        /// Kind of row.
        what: &'static str,
        /// The cause.
        detail: String,
    },
    /// A migration of the schema failed.
    #[error("the database could not be migrated to this version: {0}")]
    Migration(#[from] MigrateError),
    /// The data folder is on a network file system.
    #[error(
        "{path} is on a network file system ({file_system}), whose locks are not reliable enough for a database: give a --data-dir \
         on a local disk, or set store.allow_network_filesystem = true"
    )]
    NetworkFileSystem {
        /// The folder.
        path: PathBuf,
        /// Its file system.
        file_system: String,
    },
    /// The disk is full, or has less free space than the configured minimum. Nothing was written; writes succeed again as soon
    /// as there is space.
    #[error("the disk of the data folder is full: {0}")]
    DiskFull(String),
    /// The disk reported an input or output error. Nothing was written.
    #[error("the disk of the data folder failed: {0}")]
    Disk(String),
    /// The database became read-only while it was open.
    #[error("the database can no longer be written: {0}")]
    BecameReadOnly(String),
    /// Another connection held the write lock longer than the busy timeout.
    #[error("the database is busy: {0}")]
    Busy(String),
    /// Any other error of SQLite.
    #[error("database: {0}")]
    Sqlite(Arc<sqlx::Error>),
    /// A write task panicked, which is a programming error.
    #[error("a database task panicked")]
    Panicked,
}

impl From<sqlx::Error> for Error {
    /// Maps failures of the disk to variants of their own, because they are temporary and not programming errors.
    fn from(error: sqlx::Error) -> Self {
        let error = match error {
            sqlx::Error::Configuration(cause) => match cause.downcast::<BrokenConnection>() {
                Ok(broken) => return Self::Unreachable(broken.0),
                Err(cause) => sqlx::Error::Configuration(cause),
            },
            other => other,
        };
        if let Some(state) = sql_state(&error) {
            return Self::of_server(&state, error);
        }
        match primary_code(&error) {
            Some(13) => Self::DiskFull(error.to_string()),
            // SQLITE_IOERR, and SQLITE_CANTOPEN, which opening the write-ahead log can return at any time.
            Some(10 | 14) => Self::Disk(error.to_string()),
            Some(8) => Self::BecameReadOnly(error.to_string()),
            Some(5 | 6) => Self::Busy(error.to_string()),
            _ => match error {
                sqlx::Error::PoolTimedOut => Self::Busy(error.to_string()),
                // A column with a value of another type: reading it again returns the same.
                sqlx::Error::ColumnDecode { .. } | sqlx::Error::Decode(_) => {
                    Self::Row { what: "row", detail: error.to_string() }
                }
                error => Self::Sqlite(Arc::new(error)),
            },
        }
    }
}

/// A server that does not answer, or to which the connection broke. It travels inside [`sqlx::Error::Configuration`], because the errors of
/// both databases have one type there.
#[derive(Debug, Clone, thiserror::Error)]
#[error("{0}")]
struct BrokenConnection(String);

impl From<BrokenConnection> for sqlx::Error {
    fn from(broken: BrokenConnection) -> Self {
        Self::Configuration(Box::new(broken))
    }
}

/// Names a broken connection to a server as such. For SQLite, the same errors are faults of the disk or of the program.
pub(super) fn over_network(error: sqlx::Error) -> sqlx::Error {
    match error {
        sqlx::Error::Io(_) | sqlx::Error::Tls(_) | sqlx::Error::Protocol(_) | sqlx::Error::WorkerCrashed => {
            BrokenConnection(error.to_string()).into()
        }
        sqlx::Error::PoolTimedOut => {
            BrokenConnection("no connection to the server could be made, or all are in use".to_owned()).into()
        }
        // Ended by an administrator or by a service that took over, crashed, stopping, starting; connection exceptions.
        error if sql_state(&error).is_some_and(|state| state.starts_with("57P") || state.starts_with("08")) => {
            BrokenConnection(error.to_string()).into()
        }
        error => error,
    }
}

/// The state that a PostgreSQL server gives with an error, five characters.
pub(super) fn sql_state(error: &sqlx::Error) -> Option<String> {
    let error = error.as_database_error()?.try_downcast_ref::<PgDatabaseError>()?;
    Some(error.code().to_owned())
}

/// The primary result code of SQLite, without its extension.
fn primary_code(error: &sqlx::Error) -> Option<i32> {
    let error = error.as_database_error()?;
    error.try_downcast_ref::<SqliteError>()?;
    let code = error.code()?;
    code.parse::<i32>().ok().map(|code| code & 0xff)
}

impl Error {
    /// The error of a PostgreSQL server. Source: PostgreSQL 15, appendix A.
    fn of_server(state: &str, error: sqlx::Error) -> Self {
        match state {
            "53100" => Self::DiskFull(error.to_string()),
            "58030" => Self::Disk(error.to_string()),
            "25006" => Self::BecameReadOnly(error.to_string()),
            // Serialization failure, deadlock, lock not available, too many connections.
            "40001" | "40P01" | "55P03" | "53300" => Self::Busy(error.to_string()),
            _ => Self::Sqlite(Arc::new(error)),
        }
    }

    /// Short name of the cause if it is the disk and not the request, for metrics and for `/readyz`.
    pub fn disk_cause(&self) -> Option<&'static str> {
        match self {
            Self::DiskFull(_) => Some("disk_full"),
            Self::Disk(_) => Some("disk_failed"),
            Self::BecameReadOnly(_) | Self::ReadOnly(_) => Some("read_only"),
            Self::Busy(_) => Some("database_busy"),
            Self::Gone(_) => Some("database_gone"),
            Self::Unreachable(_) | Self::ServedElsewhere(_) => Some("database_unreachable"),
            _ => None,
        }
    }

    /// Whether the same call may succeed later without anybody repairing anything: a disk that is full or fails, a busy database, a
    /// statement that was interrupted.
    pub fn is_temporary(&self) -> bool {
        // SQLITE_ABORT, SQLITE_NOMEM, SQLITE_INTERRUPT.
        const ENDED_EARLY: [i32; 3] = [4, 7, 9];
        match self {
            Self::DiskFull(_) | Self::Disk(_) | Self::BecameReadOnly(_) | Self::Busy(_) | Self::Unreachable(_) => true,
            Self::Sqlite(error) => {
                matches!(**error, sqlx::Error::Io(_) | sqlx::Error::WorkerCrashed)
                    || primary_code(error).is_some_and(|code| ENDED_EARLY.contains(&code))
            }
            _ => false,
        }
    }

    /// A copy of the error, for each further caller that waited for the same transaction.
    pub(super) fn copy(&self) -> Self {
        match self {
            Self::DiskFull(reason) => Self::DiskFull(reason.clone()),
            Self::Disk(reason) => Self::Disk(reason.clone()),
            Self::BecameReadOnly(reason) => Self::BecameReadOnly(reason.clone()),
            Self::Busy(reason) => Self::Busy(reason.clone()),
            Self::Gone(path) => Self::Gone(path.clone()),
            Self::Unreachable(reason) => Self::Unreachable(reason.clone()),
            Self::ServedElsewhere(reason) => Self::ServedElsewhere(reason.clone()),
            Self::Sqlite(error) => Self::Sqlite(Arc::clone(error)),
            other => Self::Sqlite(Arc::new(sqlx::Error::Protocol(other.to_string()))),
        }
    }

    /// True when the connection that returned this error must not be used again.
    pub(super) fn spoils_the_connection(&self) -> bool {
        matches!(
            self,
            Self::DiskFull(_)
                | Self::Disk(_)
                | Self::BecameReadOnly(_)
                | Self::Busy(_)
                | Self::Unreachable(_)
                | Self::Sqlite(_)
        )
    }
}

/// What a disk that fails for a moment causes, for fault points.
#[cfg(test)]
pub(super) fn unreadable() -> Error {
    Error::from(sqlx::Error::Io(std::io::Error::other("a fault")))
}

#[cfg(test)]
mod tests {
    use super::super::{Store, StoreSettings};
    use super::Error;
    use crate::quantity::{Digest, StructureId};

    async fn put(store: &Store, id: &str, bytes: usize) -> Result<(), Error> {
        let json = format!("\"{}\"", "x".repeat(bytes));
        let (id, digest) = (StructureId::parse(id).unwrap(), Digest::of_file(json.as_bytes()));
        store.structures().put_structure(&id, &json, &digest, crate::clock::now()).await.map(|_| ())
    }

    #[tokio::test]
    async fn a_full_disk_is_reported_and_writes_succeed_again_when_there_is_space() {
        let folder = tempfile::tempdir().unwrap();
        let settings = StoreSettings { min_free_bytes: 0, ..StoreSettings::default() };
        let store = Store::open_with(folder.path(), &settings).await.unwrap();
        let super::super::WriterPool::Sqlite(pool, _) = &store.database.writer.pool else { unreachable!() };
        let pages: (i64,) = sqlx::query_as("pragma page_count").fetch_one(pool).await.unwrap();
        let limit = format!("pragma max_page_count = {}", pages.0 + 2);
        sqlx::query(sqlx::AssertSqlSafe(limit)).execute(pool).await.unwrap();
        // The limit belongs to the connection. The failed connection is closed, so its successor has no limit, as if space had
        // been freed.
        let error = put(&store, "large", 100_000).await.unwrap_err();
        assert_eq!(error.disk_cause(), Some("disk_full"), "{error}");
        assert!(store.structures().list().await.unwrap().is_empty(), "half of it was stored");
        put(&store, "large", 100_000).await.unwrap();
        assert_eq!(store.structures().list().await.unwrap().len(), 1);
    }

    #[tokio::test]
    async fn below_the_minimum_of_free_space_nothing_is_written_and_everything_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).await.unwrap();
        put(&store, "before", 10).await.unwrap();
        store.file().set_limits(&StoreSettings { min_free_bytes: u64::MAX, ..StoreSettings::default() });
        let error = put(&store, "during", 10).await.unwrap_err();
        assert_eq!(error.disk_cause(), Some("disk_full"), "{error}");
        assert!(store.file().is_writable().await.is_err());
        assert_eq!(store.structures().list().await.unwrap().len(), 1);
        store.file().set_limits(&StoreSettings::default());
        put(&store, "after", 10).await.unwrap();
        assert_eq!(store.structures().list().await.unwrap().len(), 2);
    }

    #[test]
    fn what_may_pass_is_distinguished_from_what_stays() {
        for passes in
            [sqlx::Error::PoolTimedOut, sqlx::Error::WorkerCrashed, sqlx::Error::Io(std::io::Error::other("a"))]
        {
            assert!(Error::from(passes).is_temporary());
        }
        // A value that cannot be decoded is a damaged row, which must not block the batches after it for ever.
        let damaged = Error::from(sqlx::Error::ColumnDecode { index: "a".to_owned(), source: "not a number".into() });
        assert!(matches!(damaged, Error::Row { .. }) && !damaged.is_temporary());
        assert!(!Error::from(sqlx::Error::RowNotFound).is_temporary());
    }

    #[tokio::test]
    async fn a_write_that_breaks_a_constraint_leaves_the_writer_usable() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).await.unwrap();
        let broken = store.database.write(|transaction| {
            Box::pin(async move {
                let insert = crate::store::sql::query("insert into structure values (null, null, null, null, null)");
                insert.execute(&mut *transaction).await?;
                Ok(())
            })
        });
        assert!(matches!(broken.await, Err(Error::Sqlite(_))));
        put(&store, "after", 10).await.unwrap();
    }
}
