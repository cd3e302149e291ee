//! Sizes and counts of the store, for `/readyz`, `/metrics` and `doctor`.

use std::path::Path;

use super::{newest, Error, Store, DATABASE_FILE};
use crate::volume;

/// Sizes of the files of a data folder, and the room beside them.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FolderFigures {
    /// Bytes of the database file.
    pub database_bytes: u64,
    /// Bytes of its write-ahead log.
    pub wal_bytes: u64,
    /// The volume it lies on.
    pub volume: volume::Volume,
}

impl FolderFigures {
    /// The figures of a data folder that exists.
    ///
    /// # Errors
    /// What the operating system says of the volume; files that are missing have no bytes.
    pub fn of(data_dir: &Path) -> std::io::Result<Self> {
        let bytes = |name: String| std::fs::metadata(data_dir.join(name)).map_or(0, |file| file.len());
        Ok(Self {
            database_bytes: bytes(DATABASE_FILE.to_owned()),
            wal_bytes: bytes(format!("{DATABASE_FILE}-wal")),
            volume: volume::of(data_dir)?,
        })
    }
}

/// Counts of what is stored.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Figures {
    /// Structures.
    pub structures: u64,
    /// Batches that wait for their assessment.
    pub pending_batches: u64,
    /// Alarms that last: kind, how many, and how many of them nobody has acknowledged.
    pub open_alarms: Vec<(String, u64, u64)>,
}

impl Store {
    /// The newest schema this program knows: that of every store it has open.
    pub fn schema_version() -> i64 {
        newest()
    }

    /// Counts of what is stored; each is read from an index, so that a scrape costs the same for a year of data.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn figures(&self) -> Result<Figures, Error> {
        let (structures, pending): (i64, i64) = sqlx::query_as(
            "select (select count(*) from structure), (select count(*) from measurement_batch where state = 'received')",
        )
        .fetch_one(&self.reader)
        .await?;
        let alarms: Vec<(String, i64, i64)> = sqlx::query_as(
            "select kind, count(*), coalesce(sum(acknowledged_at_us is null), 0) from alarm_episode
             where ended_at_us is null and withdrawn = 0 group by kind order by kind",
        )
        .fetch_all(&self.reader)
        .await?;
        let count = i64::unsigned_abs;
        Ok(Figures {
            structures: count(structures),
            pending_batches: count(pending),
            open_alarms: alarms.into_iter().map(|(kind, open, unseen)| (kind, count(open), count(unseen))).collect(),
        })
    }
}
