//! The schema of a database on a server: whether it is of this program, whether it fits, and making or changing it.
//!
//! A service never changes the schema, because others may be using it: `modalwatch migrate schema` does. A new version of the program comes
//! in three steps: a migration that only adds (expand), then the new program on all machines (migrate), then, with the release after it, a
//! migration that removes what only the old program needed (contract). Each database says since which version of the schema a program can
//! work with it (`compatible_from`), so that a program also runs on the schema of its successor.

use std::sync::LazyLock;

use serde::Serialize;
use sqlx::migrate::{MigrateError, Migrator};
use sqlx::Connection as _;
use sqlx_postgres::PgConnection;

use super::super::error::Error;
use super::super::url::DatabaseUrl;
use super::connect::{self, Place, SCHEMA};

/// They leave the record of what was applied, which is newer than this program, to [`check`].
static MIGRATIONS: LazyLock<Migrator> = LazyLock::new(|| {
    let mut migrations = sqlx::sqlx_macros::migrate!("migrations/postgres");
    migrations.set_ignore_missing(true);
    migrations
});

/// What [`migrate`] has done.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
pub struct Migrated {
    /// Schema version before; `None` for a database without tables.
    pub from: Option<i64>,
    /// Schema version now.
    pub to: i64,
}

/// What the schema of a database is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum State {
    /// There are no tables.
    Empty,
    /// There are tables of another application.
    Foreign,
    /// It is of this program.
    Ours { version: i64, compatible_from: i64, moving: bool },
}

/// The newest schema version that this program knows.
pub fn schema_version() -> i64 {
    MIGRATIONS.iter().map(|migration| migration.version).max().unwrap_or_default()
}

/// Checks that this program can work with the schema.
pub(super) async fn check(connection: &mut PgConnection, place: &Place) -> Result<(), Error> {
    let known = schema_version();
    match state(connection).await? {
        State::Empty => Err(Error::NoSchema(place.name().to_owned())),
        State::Foreign => Err(Error::ForeignSchema { place: place.name().to_owned(), schema: SCHEMA }),
        State::Ours { version: found, .. } if found < known => {
            Err(Error::SchemaTooOld { place: place.name().to_owned(), found, known })
        }
        State::Ours { version: found, compatible_from, .. } if compatible_from > known => {
            Err(Error::SchemaTooNew { place: place.name().to_owned(), found, known })
        }
        State::Ours { moving: true, .. } => Err(Error::MoveIncomplete(place.name().to_owned())),
        State::Ours { .. } => Ok(()),
    }
}

/// Makes the schema of an empty database, or brings an earlier one to the version of this program.
///
/// # Errors
/// [`Error::ForeignSchema`], [`Error::SchemaTooNew`], [`Error::Migration`], and whatever prevents the connection.
pub async fn migrate(url: &DatabaseUrl) -> Result<Migrated, Error> {
    let place = Place::of(url)?;
    let mut connection = place.connect().await?;
    connect::version(&mut connection).await?;
    let (to, known) = (schema_version(), schema_version());
    let from = match state(&mut connection).await? {
        State::Empty => None,
        State::Foreign => return Err(Error::ForeignSchema { place: place.name().to_owned(), schema: SCHEMA }),
        State::Ours { version: found, .. } if found > known => {
            return Err(Error::SchemaTooNew { place: place.name().to_owned(), found, known })
        }
        State::Ours { version, .. } => Some(version),
    };
    let create = format!("create schema if not exists {SCHEMA}");
    sqlx::query(sqlx::AssertSqlSafe(create)).execute(&mut connection).await?;
    MIGRATIONS.run(&mut connection).await.map_err(|error| match error {
        MigrateError::VersionMissing(found) => Error::SchemaTooNew { place: place.name().to_owned(), found, known },
        other => Error::Migration(other),
    })?;
    connection.close().await?;
    Ok(Migrated { from, to })
}

async fn state(connection: &mut PgConnection) -> Result<State, Error> {
    let (tables, application, migrations): (i64, bool, bool) = sqlx::query_as(
        "select count(*), count(*) filter (where table_name = 'application') = 1,
                count(*) filter (where table_name = '_sqlx_migrations') = 1
         from information_schema.tables where table_schema = $1",
    )
    .bind(SCHEMA)
    .fetch_one(&mut *connection)
    .await?;
    if tables == 0 {
        return Ok(State::Empty);
    }
    if !(application && migrations) {
        return Ok(State::Foreign);
    }
    let found: Option<(i64, i64, bool)> = sqlx::query_as(
        "select (select max(version) from _sqlx_migrations where success), compatible_from, moving
         from application where name = 'modalwatch'",
    )
    .fetch_optional(connection)
    .await?;
    let ours = |(version, compatible_from, moving)| State::Ours { version, compatible_from, moving };
    Ok(found.map_or(State::Foreign, ours))
}
