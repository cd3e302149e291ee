//! The open database: the readers and the write queue that all areas of the store share.

use std::fs::File;
use std::future::Future;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use super::damaged::DamagedRows;
use super::error::Error;
use super::file::Limits;
use super::reader::Reader;
use super::transaction::Transaction;
use super::write_queue::WritePriority;
use super::writer::{Work, Writer};
use crate::volume;

/// The open database of a data folder.
pub(super) struct Database {
    /// Connections that only read.
    pub reader: Reader,
    /// The connection that writes.
    pub writer: Arc<Writer>,
    /// Where it is.
    pub place: Place,
    /// Limits that can be changed while the database is open.
    pub limits: Limits,
    /// Rows that could not be read.
    pub damaged: DamagedRows,
}

/// Where a database is.
pub(super) enum Place {
    /// A SQLite file.
    File {
        path: PathBuf,
        /// Version of the SQLite library.
        version: String,
        /// Held as long as the database is open, so that a second process on the same folder is refused.
        _lock: File,
    },
    /// A PostgreSQL server.
    Server {
        /// The data folder of this process, for what is not in the database.
        folder: PathBuf,
        version: String,
    },
}

impl Database {
    /// The data folder.
    pub fn folder(&self) -> &Path {
        match &self.place {
            Place::File { path, .. } => path.parent().unwrap_or(Path::new(".")),
            Place::Server { folder, .. } => folder,
        }
    }

    /// Fails while less space is free than the configured minimum, which SQLite needs to write the log back into the database.
    pub fn check_free_space(&self) -> Result<(), Error> {
        let minimum = self.limits.min_free_bytes();
        // The disk of a server is the concern of the server.
        if minimum == 0 || matches!(self.place, Place::Server { .. }) {
            return Ok(());
        }
        let folder = self.folder();
        let free = volume::free_bytes(folder).map_err(|source| Error::Folder { path: folder.to_owned(), source })?;
        if free >= minimum {
            return Ok(());
        }
        Err(Error::DiskFull(format!("{free} bytes are free, but store.min_free_bytes requires {minimum}")))
    }

    /// Queues a write task and returns its result once it is committed.
    ///
    /// Write tasks run in the order of the calls, also where the result is awaited later. Tasks that wait at the same time share
    /// one immediate transaction.
    pub fn write<T, F>(&self, work: F) -> impl Future<Output = Result<T, Error>> + Send + 'static
    where
        T: Send + 'static,
        F: for<'t> FnOnce(&'t mut Transaction<'_>) -> Work<'t, T> + Send + 'static,
    {
        self.write_as(WritePriority::Prompt, work)
    }

    /// As [`Self::write`], with a priority.
    pub fn write_as<T, F>(
        &self,
        priority: WritePriority,
        work: F,
    ) -> impl Future<Output = Result<T, Error>> + Send + 'static
    where
        T: Send + 'static,
        F: for<'t> FnOnce(&'t mut Transaction<'_>) -> Work<'t, T> + Send + 'static,
    {
        self.queue_if(self.check_free_space(), priority, work)
    }

    /// As [`Self::write`], but also below the minimum of free space: for tasks that free space, or that take rights away.
    pub fn write_without_floor<T, F>(&self, work: F) -> impl Future<Output = Result<T, Error>> + Send + 'static
    where
        T: Send + 'static,
        F: for<'t> FnOnce(&'t mut Transaction<'_>) -> Work<'t, T> + Send + 'static,
    {
        self.queue_if(Ok(()), WritePriority::Prompt, work)
    }

    /// As [`Self::write_without_floor`] for a task that `takes_away`, otherwise as [`Self::write`].
    pub fn write_or_take_away<T, F>(
        &self,
        takes_away: bool,
        work: F,
    ) -> impl Future<Output = Result<T, Error>> + Send + 'static
    where
        T: Send + 'static,
        F: for<'t> FnOnce(&'t mut Transaction<'_>) -> Work<'t, T> + Send + 'static,
    {
        let room = if takes_away { Ok(()) } else { self.check_free_space() };
        self.queue_if(room, WritePriority::Prompt, work)
    }

    fn queue_if<T, F>(
        &self,
        room: Result<(), Error>,
        priority: WritePriority,
        work: F,
    ) -> impl Future<Output = Result<T, Error>> + Send + 'static
    where
        T: Send + 'static,
        F: for<'t> FnOnce(&'t mut Transaction<'_>) -> Work<'t, T> + Send + 'static,
    {
        let queued = room.map(|()| self.writer.queue(priority, work));
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
}
