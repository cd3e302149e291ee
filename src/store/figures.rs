//! Sizes and counts of the stored data, for `/readyz`, `/metrics` and `doctor`.

use std::path::Path;

use super::error::Error;
use super::file::DATABASE_FILE;
use super::overview::Overview;
use super::sql;
use crate::volume;

/// Sizes of the files of a data folder, and the state of its volume.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FolderFigures {
    /// Bytes of the database file.
    pub database_bytes: u64,
    /// Bytes of its write-ahead log.
    pub wal_bytes: u64,
    /// The volume of the folder.
    pub volume: volume::Volume,
}

impl FolderFigures {
    /// The sizes of an existing data folder. The size of a missing file is 0.
    ///
    /// # Errors
    /// The error of the operating system if the volume cannot be read.
    pub fn of(data_dir: &Path) -> std::io::Result<Self> {
        let bytes = |name: String| std::fs::metadata(data_dir.join(name)).map_or(0, |file| file.len());
        Ok(Self {
            database_bytes: bytes(DATABASE_FILE.to_owned()),
            wal_bytes: bytes(format!("{DATABASE_FILE}-wal")),
            volume: volume::of(data_dir)?,
        })
    }
}

/// Counts of the stored data.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Figures {
    /// Structures.
    pub structures: u64,
    /// Batches that wait for their assessment.
    pub pending_batches: u64,
    /// Open alarms: kind, number, and number of those that are not acknowledged.
    pub open_alarms: Vec<(String, u64, u64)>,
}

impl Overview<'_> {
    /// Counts of the stored data. Each is read by an index, so that the cost does not grow with the history.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn figures(self) -> Result<Figures, Error> {
        let (structures, pending): (i64, i64) = sql::query_as(
            "select (select count(*) from structure), (select count(*) from measurement_batch where state = 'received')",
        )
        .fetch_one(&self.database.reader)
        .await?;
        let alarms: Vec<(String, i64, i64)> = sql::query_as(
            "select kind, count(*), count(*) filter (where acknowledged_at_us is null) from alarm_episode
             where ended_at_us is null and withdrawn = 0 group by kind order by kind",
        )
        .fetch_all(&self.database.reader)
        .await?;
        let count = i64::unsigned_abs;
        Ok(Figures {
            structures: count(structures),
            pending_batches: count(pending),
            open_alarms: alarms.into_iter().map(|(kind, open, unseen)| (kind, count(open), count(unseen))).collect(),
        })
    }
}
