//! The database file of an open store: its limits, its state, and whether it can be written.

use std::path::Path;
use std::sync::atomic::Ordering;

use super::database::{Database, Place};
use super::error::Error;
use super::file::StoreSettings;
use super::sql;
use super::transaction::Transaction;

/// The database file of an open store.
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

    /// Whether the store was closed, so that further writes are pointless.
    pub fn is_closed(self) -> bool {
        self.database.writer.pool.is_closed()
    }

    /// How many writes failed because of the disk since the store was opened. When the number grows, an earlier result of
    /// [`Self::is_writable`] is out of date.
    pub fn refused_writes(self) -> u64 {
        self.database.writer.refused.load(Ordering::Relaxed)
    }
}
