//! Whether a file is a database of this program, and whether it is still the file that was opened.

use std::fs::File;
use std::io::Read as _;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use sqlx::Connection as _;
use sqlx_sqlite::{SqliteConnectOptions, SqliteConnection};

use super::super::error::Error;

/// Application id in the header of every database of this program: "mdlw".
pub(in super::super) const APPLICATION_ID: i64 = 0x6d64_6c77;

/// The database file as it was opened.
///
/// A file that is deleted or replaced continues to exist for the processes that have it open. SQLite would write into it
/// without an error, and all data would be lost at the end of the process.
pub(in super::super) struct OpenedFile {
    path: PathBuf,
    log: PathBuf,
    device_and_inode: (u64, u64),
}

impl OpenedFile {
    /// Remembers device and inode of a file.
    pub fn of(path: PathBuf) -> Result<Self, Error> {
        let device_and_inode =
            device_and_inode(&path).map_err(|source| Error::Folder { path: path.clone(), source })?;
        let mut log = path.clone().into_os_string();
        log.push("-wal");
        Ok(Self { path, log: log.into(), device_and_inode })
    }

    /// Checks that the file and its log are still there. It looks at names only, because closing a second handle of the file
    /// would release the locks of SQLite.
    pub fn check(&self) -> Result<(), Error> {
        let same = device_and_inode(&self.path).is_ok_and(|found| found == self.device_and_inode);
        (same && self.log.exists()).then_some(()).ok_or_else(|| Error::Gone(self.path.clone()))
    }
}

fn device_and_inode(path: &Path) -> std::io::Result<(u64, u64)> {
    std::fs::metadata(path).map(|m| (m.dev(), m.ino()))
}

/// Refuses a file that is not a database of this program, before anything is written to it.
pub(in super::super) async fn refuse_foreign(path: &Path) -> Result<(), Error> {
    let failed = |source| Error::Folder { path: path.to_owned(), source };
    if !path.exists() || std::fs::metadata(path).map_err(failed)?.len() == 0 {
        return Ok(());
    }
    let mut head = [0; 16];
    let read = File::open(path).and_then(|mut file| file.read_exact(&mut head));
    if read.is_err() || &head != b"SQLite format 3\0" {
        return Err(Error::NotADatabase(path.to_owned()));
    }
    // Not read-only: if the last process was killed, only a connection that writes can recover the log.
    let mut connection = SqliteConnection::connect_with(&SqliteConnectOptions::new().filename(path))
        .await
        .map_err(|e| not_a_database(e, path))?;
    let found: Result<(i64, bool), _> =
        sqlx::query_as("select application_id, not exists (select 1 from sqlite_schema) from pragma_application_id")
            .fetch_one(&mut connection)
            .await;
    let (application_id, empty) = found.map_err(|e| not_a_database(e, path))?;
    connection.close().await?;
    // A first start that was killed between creating the file and setting its application id leaves an empty database
    // without one.
    if application_id == APPLICATION_ID || (application_id == 0 && empty) {
        Ok(())
    } else {
        Err(Error::Foreign { path: path.to_owned(), application_id })
    }
}

/// The error of a file that cannot be opened as a database.
pub(super) fn not_a_database(error: sqlx::Error, path: &Path) -> Error {
    let code = error.as_database_error().and_then(sqlx::error::DatabaseError::code).map(std::borrow::Cow::into_owned);
    match code.as_deref() {
        Some("26") => Error::NotADatabase(path.to_owned()),
        Some("11") => Error::Corrupt { path: path.to_owned(), detail: error.to_string() },
        _ => Error::Sqlite(Arc::new(error)),
    }
}
