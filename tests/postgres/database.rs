//! The database of the tests: one of the PostgreSQL server, for each folder.

use std::path::Path;

use modalwatch::store::{server, DatabaseUrl, Store, StoreSettings};

use crate::postgres::server::Server;

/// The database that belongs to a folder, with the schema of the program.
pub async fn url_of(folder: &Path) -> DatabaseUrl {
    let url = DatabaseUrl::parse(&Server::get().database_of(folder)).unwrap();
    server::migrate(&url).await.unwrap();
    url
}

/// Whether a test may write rows by hand into `modalwatch.sqlite`.
pub const IS_FILE: bool = false;

/// Opens the database that belongs to a folder, which is created if it is missing. Without PostgreSQL it is a SQLite file, and the test is
/// recorded as skipped.
pub async fn open_store(folder: &Path) -> Store {
    if !Server::is_installed() {
        return Store::open(folder).await.unwrap();
    }
    let settings = StoreSettings { url: Some(url_of(folder).await), ..StoreSettings::default() };
    Store::open_with(folder, &settings).await.unwrap()
}
