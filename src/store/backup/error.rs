//! The errors of backups.

use std::path::{Path, PathBuf};

use super::super::error::Error as StoreError;

/// Why a backup or a restore failed.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The name is not valid.
    #[error("{0} is not a valid name for a backup: use 1 to 64 of A-Z, a-z, 0-9, '-', '_', '.', beginning with a letter or digit")]
    Name(String),
    /// A backup with this name exists.
    #[error("there is a backup {0} already: give another name")]
    Exists(String),
    /// The database is not a file.
    #[error(
        "the database is on a PostgreSQL server: back it up by pg_dump, or with its write-ahead log (docs/cluster.md)"
    )]
    Server,
    /// The folder has no database.
    #[error("{0} has no database: give the --data-dir of a service")]
    NoDatabase(PathBuf),
    /// There is not enough space for the copy.
    #[error("the copy needs {needed} bytes and {free} are free in {path}")]
    NoRoom {
        /// Bytes of the copy.
        needed: u64,
        /// Bytes free.
        free: u64,
        /// Folder of the copy.
        path: PathBuf,
    },
    /// A file cannot be read or written.
    #[error("{path}: {source}")]
    File {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// The manifest is missing or cannot be read.
    #[error("{path} is not the manifest of a backup: {reason}")]
    Manifest {
        /// The manifest.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// The copy does not match the manifest.
    #[error("{path} is damaged: {reason}; nothing was changed; use another backup")]
    Damaged {
        /// The copy.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// The copy has tables, views or triggers that this program did not make.
    #[error("{path} was changed by another program: {reason}; nothing was changed; use another backup")]
    Foreign {
        /// The copy.
        path: PathBuf,
        /// What was changed.
        reason: String,
    },
    /// The backup was made by a newer program.
    #[error("the backup has schema version {found}, newer than this program's {known}: use the newer modalwatch")]
    TooNew {
        /// Schema version of the backup.
        found: i64,
        /// Newest schema version known to this program.
        known: i64,
    },
    /// The data folder already has a database.
    #[error("{0} has a database: give an empty --data-dir, or use --replace, which keeps the present database under another name")]
    NotEmpty(PathBuf),
    /// The database cannot be used.
    #[error(transparent)]
    Store(#[from] StoreError),
}

impl From<sqlx::Error> for Error {
    fn from(error: sqlx::Error) -> Self {
        Self::Store(error.into())
    }
}

/// Makes the error of a file that cannot be read or written.
pub(super) fn at(path: &Path) -> impl FnOnce(std::io::Error) -> Error + use<'_> {
    |source| Error::File { path: path.to_owned(), source }
}
