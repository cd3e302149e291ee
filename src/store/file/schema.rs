//! Whether the schema of a database is that of this program.

use std::collections::BTreeMap;

use sqlx::Connection as _;
use sqlx_sqlite::{SqliteConnectOptions, SqliteConnection};

use super::super::error::Error;
use super::opening::{schema_version, MIGRATIONS};

/// Objects that are named in an error.
const MOST_NAMED: usize = 5;

/// Tables, indexes, views and triggers of a database that this program did not make as they are, and those that it made and that are
/// missing; compared with the schema of the given version. A trigger of somebody else would run with every write.
pub(in super::super) async fn foreign_objects(
    connection: &mut SqliteConnection,
    version: i64,
) -> Result<Vec<String>, Error> {
    let found = objects(connection).await?;
    let mut expected = BTreeMap::new();
    if version > 0 {
        let mut empty = empty(version).await?;
        expected = objects(&mut empty).await?;
        empty.close().await?;
    }
    let foreign = found
        .iter()
        .filter(|(name, _)| !expected.contains_key(*name))
        .map(|((kind, name), _)| format!("{kind} {} is not of modalwatch", crate::quantity::shown(name)));
    let missing = expected
        .keys()
        .filter(|name| !found.contains_key(*name))
        .map(|(kind, name)| format!("{kind} {name} is missing"));
    let changed = expected.iter().filter(|(name, text)| found.get(*name).is_some_and(|other| other != *text));
    let changed = changed.map(|((kind, name), _)| format!("{kind} {name} was changed"));
    Ok(foreign.chain(missing).chain(changed).take(MOST_NAMED).collect())
}

/// A database in memory with the schema of a version and without rows.
async fn empty(version: i64) -> Result<SqliteConnection, Error> {
    let mut empty = SqliteConnection::connect_with(&SqliteConnectOptions::new().in_memory(true)).await?;
    for migration in MIGRATIONS.iter().filter(|migration| migration.version <= version) {
        sqlx::raw_sql(migration.sql.clone()).execute(&mut empty).await?;
    }
    Ok(empty)
}

/// The triggers of the newest schema: name and definition.
pub(in super::super) async fn triggers() -> Result<Vec<(String, String)>, Error> {
    let mut empty = empty(schema_version()).await?;
    let triggers = sqlx::query_as("select name, sql from sqlite_schema where type = 'trigger' order by name")
        .fetch_all(&mut empty)
        .await?;
    empty.close().await?;
    Ok(triggers)
}

/// The objects by kind and name, with their definition without white space and quotes.
async fn objects(connection: &mut SqliteConnection) -> Result<BTreeMap<(String, String), String>, Error> {
    let rows: Vec<(String, String, Option<String>)> = sqlx::query_as(
        "select type, name, sql from sqlite_schema where name not like 'sqlite\\_%' escape '\\' and name <> '_sqlx_migrations'",
    )
    .fetch_all(connection)
    .await?;
    let plain = |text: String| text.chars().filter(|c| !c.is_whitespace() && *c != '"').collect();
    Ok(rows.into_iter().map(|(kind, name, sql)| ((kind, name), sql.map_or_else(String::new, plain))).collect())
}
