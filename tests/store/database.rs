//! The database of the tests: the SQLite file of a folder.

use std::path::Path;

use modalwatch::store::Store;

/// Whether a test may write rows by hand into `modalwatch.sqlite`.
pub const IS_FILE: bool = true;

/// Opens the database of a folder, which is created if it is missing.
pub async fn open_store(folder: &Path) -> Store {
    Store::open(folder).await.unwrap()
}
