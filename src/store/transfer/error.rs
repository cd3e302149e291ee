//! The errors of a move.

use std::path::PathBuf;

use super::super::error::{over_network, Error};

/// Why data could not be moved.
#[derive(Debug, thiserror::Error)]
pub enum TransferError {
    /// Both places are of the same kind.
    #[error("{0}")]
    Kind(&'static str),
    /// The source has no data.
    #[error("{0} has no database of modalwatch")]
    NoSource(String),
    /// The target has a database that a service could be using.
    #[error("{0} already has a database: give an empty folder as the target")]
    NotEmpty(PathBuf),
    /// The target has data that are not those of a move that was broken off.
    #[error("{0} already has data: with --replace it is made equal to the source, and what only it has is removed")]
    InUse(String),
    /// The schemas differ, because one of the sides was used by another version of the program.
    #[error("the two databases have different tables: {0}; migrate both to the schema of this program first")]
    Tables(String),
    /// A row of the target is not that of the source after the move.
    #[error("table {table} differs after the move, at row {row}: another program is writing to the target")]
    Differs {
        /// The table.
        table: String,
        /// Number of the row in the order of the primary key, from 1.
        row: u64,
    },
    /// A file cannot be created or renamed.
    #[error("{path}: {source}")]
    File {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// One of the databases cannot be used.
    #[error(transparent)]
    Store(#[from] Error),
}

impl From<sqlx::Error> for TransferError {
    fn from(error: sqlx::Error) -> Self {
        Self::Store(over_network(error).into())
    }
}
