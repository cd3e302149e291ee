//! The connection that writes, of either database, and its transactions.

use sqlx::pool::PoolConnection;
use sqlx::{AssertSqlSafe, Connection as _};
use sqlx_postgres::Postgres;
use sqlx_sqlite::Sqlite;
use sqlx_sqlite::SqlitePool;

use super::error::{over_network, Error};
use super::file::OpenedFile;
use super::server::{HeldConnection, ServerWriter};
use super::transaction::Transaction;

/// The place of the connection that writes.
pub(super) enum WriterPool {
    /// A pool of one connection, which lives as long as the store, and the file, which must stay where it is.
    Sqlite(SqlitePool, OpenedFile),
    /// The connection that holds the lock of the service.
    Postgres(Box<ServerWriter>),
}

/// The connection.
pub(super) enum Held<'w> {
    Sqlite(PoolConnection<Sqlite>),
    Postgres(HeldConnection<'w>),
}

/// An open transaction of the connection, which is rolled back unless it is committed.
pub(super) enum Open<'c> {
    Sqlite(sqlx::Transaction<'c, Sqlite>),
    Postgres(sqlx::Transaction<'c, Postgres>),
}

impl WriterPool {
    pub(super) async fn acquire(&self) -> Result<Held<'_>, Error> {
        Ok(match self {
            Self::Sqlite(pool, _) => Held::Sqlite(pool.acquire().await?),
            Self::Postgres(writer) => Held::Postgres(writer.acquire().await?),
        })
    }

    /// Whether it was closed.
    pub(super) fn is_closed(&self) -> bool {
        match self {
            Self::Sqlite(pool, _) => pool.is_closed(),
            Self::Postgres(writer) => writer.is_closed(),
        }
    }

    /// Ends the connection, for SQLite after its log was written back.
    pub(super) async fn close(&self) {
        match self {
            Self::Sqlite(pool, _) => {
                let _ = sqlx::query("pragma wal_checkpoint(truncate)").execute(pool).await;
                pool.close().await;
            }
            Self::Postgres(writer) => writer.close().await,
        }
    }

    /// Checks that what was written is where it will be found again.
    pub(super) fn check(&self) -> Result<(), Error> {
        match self {
            Self::Sqlite(_, file) => file.check(),
            Self::Postgres(_) => Ok(()),
        }
    }
}

impl Held<'_> {
    /// Begins a transaction. With SQLite it is immediate, because SQLite refuses at once, without waiting for the busy timeout, to upgrade a
    /// transaction that began with a read while another connection writes.
    pub(super) async fn begin(&mut self) -> Result<Open<'_>, Error> {
        fault_point!("store::begin", |_| Err(sqlx::Error::Io(std::io::Error::other("a fault")).into()));
        Ok(match self {
            Held::Sqlite(connection) => Open::Sqlite(connection.begin_with("begin immediate").await?),
            Held::Postgres(connection) => Open::Postgres(connection.get().begin().await.map_err(over_network)?),
        })
    }

    /// Closes the connection, so that the next transaction has a new one.
    pub(super) async fn close(self) {
        match self {
            // There is nothing to be done about a connection that cannot be closed.
            Self::Sqlite(connection) => drop(connection.detach().close_hard().await),
            Self::Postgres(connection) => connection.break_off().await,
        }
    }
}

impl Open<'_> {
    pub(super) fn transaction(&mut self) -> Transaction<'_> {
        match self {
            Self::Sqlite(open) => Transaction::Sqlite(&mut *open),
            Self::Postgres(open) => Transaction::Postgres(&mut *open),
        }
    }

    pub(super) async fn commit(self) -> Result<(), sqlx::Error> {
        match self {
            Self::Sqlite(open) => open.commit().await,
            Self::Postgres(open) => open.commit().await.map_err(over_network),
        }
    }

    pub(super) async fn rollback(self) -> Result<(), sqlx::Error> {
        match self {
            Self::Sqlite(open) => open.rollback().await,
            Self::Postgres(open) => open.rollback().await.map_err(over_network),
        }
    }

    /// Runs statements without parameters.
    pub(super) async fn run(&mut self, statements: &'static str) -> Result<(), sqlx::Error> {
        match self {
            Self::Sqlite(open) => sqlx::raw_sql(AssertSqlSafe(statements)).execute(&mut **open).await.map(|_| ()),
            Self::Postgres(open) => {
                sqlx::raw_sql(AssertSqlSafe(statements)).execute(&mut **open).await.map(|_| ()).map_err(over_network)
            }
        }
    }
}
