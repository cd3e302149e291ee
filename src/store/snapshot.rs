//! Several reads of one moment: what is written meanwhile is in none of them.

use sqlx::Transaction;
use sqlx_postgres::Postgres;
use sqlx_sqlite::Sqlite;

use super::error::over_network;
use super::reader::Reader;
use super::sql::On;

/// A connection whose statements all see the database as it was at the first of them.
///
/// It is a transaction. Only a task that nobody drops halfway may hold one, which the future of a request is not: the client may leave.
pub(super) enum Snapshot {
    Sqlite(Transaction<'static, Sqlite>),
    Postgres(Transaction<'static, Postgres>),
}

impl Reader {
    /// A connection for reads of one moment.
    pub(super) async fn snapshot(&self) -> Result<Snapshot, sqlx::Error> {
        Ok(match self {
            Self::Sqlite(pool) => Snapshot::Sqlite(pool.begin_with("begin deferred").await?),
            Self::Postgres(pool) => {
                let begun = pool.begin_with("begin isolation level repeatable read read only").await;
                Snapshot::Postgres(begun.map_err(over_network)?)
            }
        })
    }
}

impl Snapshot {
    /// Gives the connection back. There is nothing to commit.
    pub(super) async fn end(self) -> Result<(), sqlx::Error> {
        match self {
            Self::Sqlite(transaction) => transaction.rollback().await,
            Self::Postgres(transaction) => transaction.rollback().await.map_err(over_network),
        }
    }
}

impl<'c> From<&'c mut Snapshot> for On<'c> {
    fn from(snapshot: &'c mut Snapshot) -> Self {
        fault_point!("store::query", |kind| On::Failing(super::reader::faults::of(kind.as_deref())));
        match snapshot {
            Snapshot::Sqlite(transaction) => Self::Sqlite(transaction),
            Snapshot::Postgres(transaction) => Self::Postgres(transaction),
        }
    }
}
