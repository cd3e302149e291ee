//! The database of an open store: its limits, its state, whether it can be written, and whether it was taken over.

use std::path::Path;
use std::sync::atomic::Ordering;
use std::time::Duration;

use tokio::sync::watch;

use super::database::{Database, Place};
use super::error::Error;
use super::file::{schema_version, StoreSettings};
use super::server;
use super::sql;
use super::transaction::Transaction;
use super::write_connection::WriterPool;

/// A standby takes over after some seconds without a statement of the service.
const BETWEEN_BEATS: Duration = Duration::from_secs(1);

/// The program behind the database.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Engine {
    /// SQLite, in this process: a file of the data folder.
    Sqlite,
    /// A PostgreSQL server.
    Postgres,
}

impl Engine {
    /// Its name.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Sqlite => "SQLite",
            Self::Postgres => "PostgreSQL",
        }
    }
}

/// The database of an open store.
#[derive(Clone, Copy)]
pub struct DatabaseFile<'s> {
    pub(super) database: &'s Database,
}

impl<'s> DatabaseFile<'s> {
    /// The data folder.
    pub fn folder(self) -> &'s Path {
        self.database.folder()
    }

    /// Adopts the limits of changed settings. The location of the database does not change.
    pub fn set_limits(self, settings: &StoreSettings) {
        self.database.limits.set(settings);
    }

    /// Free bytes below which nothing is written.
    pub fn min_free_bytes(self) -> u64 {
        self.database.limits.min_free_bytes()
    }

    /// Bytes of the write-ahead log above which `/readyz` warns.
    pub fn max_wal_bytes(self) -> u64 {
        self.database.limits.max_wal_bytes()
    }

    /// Fails while less space is free than the configured minimum.
    ///
    /// # Errors
    /// [`Error::DiskFull`].
    pub fn refuse_without_room(self) -> Result<(), Error> {
        self.database.check_free_space()
    }

    /// The database program.
    pub fn engine(self) -> Engine {
        match &self.database.place {
            Place::File { .. } => Engine::Sqlite,
            Place::Server { .. } => Engine::Postgres,
        }
    }

    /// Number of the last migration that this program knows for the database.
    pub fn schema_version(self) -> i64 {
        match self.engine() {
            Engine::Sqlite => schema_version(),
            Engine::Postgres => server::schema_version(),
        }
    }

    /// Version of the SQLite library, or of the PostgreSQL server.
    pub fn version(self) -> &'s str {
        match &self.database.place {
            Place::File { version, .. } | Place::Server { version, .. } => version,
        }
    }

    /// Writes to the database file, which shows that a batch could be stored now.
    ///
    /// # Errors
    /// [`Error`] with the cause, such as a full disk or a file that became read-only.
    pub async fn is_writable(self) -> Result<(), Error> {
        let written = self.database.write(|transaction| {
            Box::pin(async move {
                // An update without a matching row would not reach the disk.
                let touch = match transaction {
                    // A header field that nothing reads.
                    Transaction::Sqlite(_) => "pragma user_version = 1",
                    Transaction::Postgres(_) => "update application set probes = probes + 1",
                };
                sql::query(touch).execute(&mut *transaction).await?;
                Ok(())
            })
        });
        written.await
    }

    /// Completes with the reason when another service has taken over the database of a server: what this one knows of the data is then out
    /// of date. Never completes for a file, whose lock cannot be lost.
    pub async fn taken_over(self) -> Error {
        let WriterPool::Postgres(writer) = &self.database.writer.pool else { return std::future::pending().await };
        loop {
            if let Err(taken @ Error::ServedElsewhere(_)) = writer.beat().await {
                return taken;
            }
            tokio::time::sleep(BETWEEN_BEATS).await;
        }
    }

    /// Number of the session of the server that holds the lock of this service, which changes when the connection is made again; `None` for a
    /// file.
    pub fn lock_session(self) -> Option<watch::Receiver<Option<i32>>> {
        match &self.database.writer.pool {
            WriterPool::Postgres(writer) => Some(writer.session()),
            WriterPool::Sqlite(..) => None,
        }
    }

    /// Whether the store was closed, so that further writes are pointless.
    pub fn is_closed(self) -> bool {
        self.database.writer.pool.is_closed()
    }

    /// How many writes failed because of the disk since the store was opened. When the number grows, an earlier result of
    /// [`Self::is_writable`] is out of date.
    pub fn refused_writes(self) -> u64 {
        self.database.writer.refused.load(Ordering::Relaxed)
    }

    /// Stored rows that could not be read within the last hour, as sentences.
    pub fn unreadable_rows(self) -> Vec<String> {
        self.database.damaged.remembered()
    }
}
