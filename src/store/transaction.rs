//! The open write transaction as the areas of the store see it.

use sqlx::sqlite::SqliteConnection;

/// The write transaction in which a write task runs.
///
/// Only the write queue begins and ends transactions. A function of one area that takes part in a larger write takes the
/// transaction as its first argument.
pub(super) struct Transaction<'c> {
    connection: &'c mut SqliteConnection,
}

impl<'c> Transaction<'c> {
    /// The transaction that is open on a connection.
    pub const fn of(connection: &'c mut SqliteConnection) -> Self {
        Self { connection }
    }

    /// The connection, to execute a statement inside the transaction.
    pub const fn connection(&mut self) -> &mut SqliteConnection {
        self.connection
    }
}
