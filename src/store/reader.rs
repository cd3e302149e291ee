//! The connections that read, with a point before each statement at which unit tests can make it fail.

use std::ops::Deref;

use futures_util::future::BoxFuture;
use futures_util::stream::BoxStream;
use sqlx::sqlite::{SqlitePool, SqliteQueryResult, SqliteRow, SqliteStatement, SqliteTypeInfo};
use sqlx::{Describe, Either, Execute, Executor, SqlStr, Sqlite};

/// Connections that only read.
#[derive(Debug)]
pub(super) struct Reader(SqlitePool);

impl Reader {
    pub(super) fn new(pool: SqlitePool) -> Self {
        Self(pool)
    }
}

impl Deref for Reader {
    type Target = SqlitePool;

    fn deref(&self) -> &SqlitePool {
        &self.0
    }
}

impl<'p> Executor<'p> for &'p Reader {
    type Database = Sqlite;

    fn fetch_many<'e, 'q: 'e, E>(
        self,
        query: E,
    ) -> BoxStream<'e, Result<Either<SqliteQueryResult, SqliteRow>, sqlx::Error>>
    where
        'p: 'e,
        E: 'q + Execute<'q, Sqlite>,
    {
        fault_point!("store::query", |kind| Box::pin(futures_util::stream::iter([Err(faults::of(kind.as_deref()))])));
        self.0.fetch_many(query)
    }

    fn fetch_optional<'e, 'q: 'e, E>(self, query: E) -> BoxFuture<'e, Result<Option<SqliteRow>, sqlx::Error>>
    where
        'p: 'e,
        E: 'q + Execute<'q, Sqlite>,
    {
        fault_point!("store::query", |kind| Box::pin(futures_util::future::ready(Err(faults::of(kind.as_deref())))));
        self.0.fetch_optional(query)
    }

    fn prepare_with<'e>(
        self,
        sql: SqlStr,
        parameters: &'e [SqliteTypeInfo],
    ) -> BoxFuture<'e, Result<SqliteStatement, sqlx::Error>>
    where
        'p: 'e,
    {
        self.0.prepare_with(sql, parameters)
    }

    fn describe<'e>(self, sql: SqlStr) -> BoxFuture<'e, Result<Describe<Sqlite>, sqlx::Error>>
    where
        'p: 'e,
    {
        self.0.describe(sql)
    }
}

/// What a read returns while the database fails for a moment.
#[cfg(test)]
mod faults {
    pub(super) fn of(kind: Option<&str>) -> sqlx::Error {
        match kind {
            // What a pool returns when its connections are busy for longer than it waits.
            Some("busy") => sqlx::Error::PoolTimedOut,
            // What a statement returns whose connection ended while it ran.
            Some("interrupted") => sqlx::Error::WorkerCrashed,
            _ => sqlx::Error::Io(std::io::Error::other("a fault")),
        }
    }
}
