//! The open write transaction as the areas of the store see it.

use sqlx_postgres::PgConnection;
use sqlx_sqlite::SqliteConnection;

use super::sql::On;

/// The write transaction in which a write task runs.
///
/// Only the write queue begins and ends transactions. A function of one area that takes part in a larger write takes the
/// transaction as its first argument.
pub(super) enum Transaction<'c> {
    Sqlite(&'c mut SqliteConnection),
    Postgres(&'c mut PgConnection),
}

impl Transaction<'_> {
    /// The place where a statement inside the transaction runs.
    pub(super) fn on(&mut self) -> On<'_> {
        match self {
            Self::Sqlite(connection) => On::Sqlite(connection),
            Self::Postgres(connection) => On::Postgres(connection),
        }
    }
}

impl<'c> From<&'c mut Transaction<'_>> for On<'c> {
    fn from(transaction: &'c mut Transaction<'_>) -> Self {
        transaction.on()
    }
}
