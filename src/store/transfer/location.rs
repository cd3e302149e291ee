//! Where data are moved from and to.

use std::path::PathBuf;

use super::super::url::DatabaseUrl;

/// A place of stored data.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Location {
    /// The SQLite file of a data folder.
    Folder(PathBuf),
    /// A database of a PostgreSQL server.
    Server(DatabaseUrl),
}
