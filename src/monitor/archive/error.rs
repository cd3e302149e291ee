//! Why an archive was not imported.

use std::path::PathBuf;

use crate::monitor::error::Error;

/// Why an archive was not imported.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// The file cannot be read.
    #[error("{path} cannot be read: {source}")]
    File {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// An invalid line.
    #[error("line {line}: {reason}")]
    Line {
        /// Number of the line, from 1.
        line: u64,
        /// What is wrong.
        reason: String,
    },
    /// It is incomplete or was changed.
    #[error("the archive is incomplete or was changed: {0}; nothing was stored")]
    NotWhole(String),
    /// Its content does not fit this installation.
    #[error(transparent)]
    Monitor(#[from] Error),
}

impl ImportError {
    /// The error with the line whose record it is about.
    pub(super) fn at_line(self, line: u64) -> Self {
        match self {
            Self::Monitor(Error::Store(crate::store::Error::Row { what, detail })) => {
                Self::Line { line, reason: format!("{what}: {detail}") }
            }
            Self::Monitor(Error::Store(crate::store::Error::Sqlite(error))) => {
                Self::Line { line, reason: format!("it cannot be stored: {error}") }
            }
            other => other,
        }
    }
}

impl From<crate::store::Error> for ImportError {
    fn from(error: crate::store::Error) -> Self {
        Self::Monitor(error.into())
    }
}

/// An error in the content of a record.
pub(super) fn invalid(detail: &dyn std::fmt::Display) -> Error {
    Error::Store(crate::store::Error::Row { what: "record of the archive", detail: detail.to_string() })
}
