//! Failures of the disk: told apart from bugs, counted, and survived.

use std::sync::atomic::Ordering;
use std::sync::Arc;

use super::writer::Writer;
use super::{Error, Store};

impl From<sqlx::Error> for Error {
    /// Failures of the disk get names of their own: they are no bugs, and they pass.
    fn from(error: sqlx::Error) -> Self {
        match primary_code(&error) {
            Some(13) => Self::DiskFull(error.to_string()),
            // IOERR, and CANTOPEN, which a log beside the database can meet at any time.
            Some(10 | 14) => Self::Disk(error.to_string()),
            Some(8) => Self::BecameReadOnly(error.to_string()),
            Some(5 | 6) => Self::Busy(error.to_string()),
            _ if matches!(error, sqlx::Error::PoolTimedOut) => Self::Busy(error.to_string()),
            _ => Self::Sqlite(Arc::new(error)),
        }
    }
}

/// SQLite's result code, without what it is extended by.
fn primary_code(error: &sqlx::Error) -> Option<i32> {
    let code = error.as_database_error()?.code()?;
    code.parse::<i32>().ok().map(|code| code & 0xff)
}

impl Error {
    /// A short word for a cause that lies in the disk and not in the request, for metrics and for `/readyz`.
    pub fn disk_cause(&self) -> Option<&'static str> {
        match self {
            Self::DiskFull(_) => Some("disk_full"),
            Self::Disk(_) => Some("disk_failed"),
            Self::BecameReadOnly(_) | Self::ReadOnly(_) => Some("read_only"),
            Self::Busy(_) => Some("database_busy"),
            Self::Gone(_) => Some("database_gone"),
            _ => None,
        }
    }

    /// The same once more, for others who waited for the same transaction.
    pub(super) fn again(&self) -> Self {
        match self {
            Self::DiskFull(reason) => Self::DiskFull(reason.clone()),
            Self::Disk(reason) => Self::Disk(reason.clone()),
            Self::BecameReadOnly(reason) => Self::BecameReadOnly(reason.clone()),
            Self::Busy(reason) => Self::Busy(reason.clone()),
            Self::Gone(path) => Self::Gone(path.clone()),
            Self::Sqlite(error) => Self::Sqlite(Arc::clone(error)),
            other => Self::Sqlite(Arc::new(sqlx::Error::Protocol(other.to_string()))),
        }
    }

    /// True when the connection that gave this must not be used again.
    pub(super) fn spoils_the_connection(&self) -> bool {
        matches!(self, Self::DiskFull(_) | Self::Disk(_) | Self::BecameReadOnly(_) | Self::Busy(_) | Self::Sqlite(_))
    }
}

impl Writer {
    /// Counts a write that the disk refused.
    pub(super) fn count_failure(&self, error: &Error) {
        if let Some(cause) = error.disk_cause() {
            metrics::counter!("modalwatch_write_failures_total", "cause" => cause).increment(1);
            self.refused.fetch_add(1, Ordering::Relaxed);
        }
    }
}

impl Store {
    /// How many writes the disk has refused since the store was opened: what was known before of the disk is old when it grows.
    pub fn refused_writes(&self) -> u64 {
        self.writer.refused.load(Ordering::Relaxed)
    }
}

#[cfg(test)]
mod tests {
    use super::super::{Store, StoreSettings};
    use crate::quantity::{Digest, StructureId, Timestamp};

    async fn put(store: &Store, id: &str, bytes: usize) -> Result<(), super::Error> {
        let json = format!("\"{}\"", "x".repeat(bytes));
        let id = StructureId::parse(id).unwrap();
        store.put_structure(&id, &json, &Digest::of_file(json.as_bytes()), Timestamp::now()).await.map(|_| ())
    }

    #[tokio::test]
    async fn a_full_disk_is_named_and_writing_goes_on_when_there_is_room_again() {
        let folder = tempfile::tempdir().unwrap();
        let settings = StoreSettings { min_free_bytes: 0, ..StoreSettings::default() };
        let store = Store::open_with(folder.path(), &settings).await.unwrap();
        let pages: (i64,) = sqlx::query_as("pragma page_count").fetch_one(&store.writer.pool).await.unwrap();
        let limit = format!("pragma max_page_count = {}", pages.0 + 2);
        sqlx::query(sqlx::AssertSqlSafe(limit)).execute(&store.writer.pool).await.unwrap();
        // The limit belongs to a connection: the one that fails is thrown away, so the next has none, as after making room.
        let error = put(&store, "large", 100_000).await.unwrap_err();
        assert_eq!(error.disk_cause(), Some("disk_full"), "{error}");
        assert!(store.structures().await.unwrap().is_empty(), "half of it was stored");
        put(&store, "large", 100_000).await.unwrap();
        assert_eq!(store.structures().await.unwrap().len(), 1);
    }

    #[tokio::test]
    async fn below_the_floor_nothing_is_written_and_everything_is_read() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).await.unwrap();
        put(&store, "before", 10).await.unwrap();
        store.set_limits(&StoreSettings { min_free_bytes: u64::MAX, ..StoreSettings::default() });
        let error = put(&store, "during", 10).await.unwrap_err();
        assert_eq!(error.disk_cause(), Some("disk_full"), "{error}");
        assert!(store.is_writable().await.is_err());
        assert_eq!(store.structures().await.unwrap().len(), 1);
        store.set_limits(&StoreSettings::default());
        put(&store, "after", 10).await.unwrap();
        assert_eq!(store.structures().await.unwrap().len(), 2);
    }

    #[tokio::test]
    async fn a_write_that_breaks_a_constraint_leaves_the_writer_usable() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).await.unwrap();
        let broken = store.write(|connection| {
            Box::pin(async move {
                sqlx::query("insert into structure values (null, null, null, null, null)").execute(connection).await?;
                Ok(())
            })
        });
        assert!(matches!(broken.await, Err(super::Error::Sqlite(_))));
        put(&store, "after", 10).await.unwrap();
    }
}
