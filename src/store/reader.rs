//! The connections that read, with a point before each statement at which unit tests can make it fail.

use sqlx::pool::PoolConnection;
use sqlx_postgres::PgPool;
use sqlx_postgres::Postgres;
use sqlx_sqlite::Sqlite;
use sqlx_sqlite::SqlitePool;

use super::error::over_network;
use super::sql::On;

/// Connections that only read.
#[derive(Debug)]
pub(super) enum Reader {
    Sqlite(SqlitePool),
    Postgres(PgPool),
}

/// One of the connections.
pub(super) enum ReaderConnection {
    Sqlite(PoolConnection<Sqlite>),
    Postgres(PoolConnection<Postgres>),
}

impl Reader {
    /// Where a statement runs that reads.
    pub(super) fn on(&self) -> On<'_> {
        fault_point!("store::query", |kind| On::Failing(faults::of(kind.as_deref())));
        match self {
            Self::Sqlite(pool) => On::SqlitePool(pool),
            Self::Postgres(pool) => On::PostgresPool(pool),
        }
    }

    /// One of the connections, for several statements.
    pub(super) async fn acquire(&self) -> Result<ReaderConnection, sqlx::Error> {
        Ok(match self {
            Self::Sqlite(pool) => ReaderConnection::Sqlite(pool.acquire().await?),
            Self::Postgres(pool) => ReaderConnection::Postgres(pool.acquire().await.map_err(over_network)?),
        })
    }

    /// Waits until all connections are closed.
    pub(super) async fn close(&self) {
        match self {
            Self::Sqlite(pool) => pool.close().await,
            Self::Postgres(pool) => pool.close().await,
        }
    }
}

impl<'c> From<&'c Reader> for On<'c> {
    fn from(reader: &'c Reader) -> Self {
        reader.on()
    }
}

impl<'c> From<&'c mut ReaderConnection> for On<'c> {
    fn from(connection: &'c mut ReaderConnection) -> Self {
        fault_point!("store::query", |kind| On::Failing(faults::of(kind.as_deref())));
        match connection {
            ReaderConnection::Sqlite(connection) => Self::Sqlite(connection),
            ReaderConnection::Postgres(connection) => Self::Postgres(connection),
        }
    }
}

/// What a read returns while the database fails for a moment.
#[cfg(test)]
pub(super) mod faults {
    pub(in super::super) fn of(kind: Option<&str>) -> sqlx::Error {
        match kind {
            // What a pool returns when its connections are busy for longer than it waits.
            Some("busy") => sqlx::Error::PoolTimedOut,
            // What a statement returns whose connection ended while it ran.
            Some("interrupted") => sqlx::Error::WorkerCrashed,
            _ => sqlx::Error::Io(std::io::Error::other("a fault")),
        }
    }
}
