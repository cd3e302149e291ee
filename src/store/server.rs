//! Opening a database of a PostgreSQL server: its version, whether it is of this program, and its schema.

use std::str::FromStr as _;
use std::time::Duration;

use sqlx::migrate::Migrator;
use sqlx::postgres::{PgConnectOptions, PgPool, PgPoolOptions};

use super::error::Error;

/// Oldest version, as the server states it in `server_version_num`.
const OLDEST: i32 = 150_000;

/// The schema of the server in which the tables are.
const SCHEMA: &str = "modalwatch";

const READERS: u32 = 8;
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);

static MIGRATIONS: Migrator = sqlx::migrate!("migrations/postgres");

/// The connections of a database that was opened.
pub(super) struct Opened {
    pub writer: PgPool,
    pub reader: PgPool,
    pub version: String,
}

/// Connects, and migrates the database to the newest schema.
pub(super) async fn open(url: &str) -> Result<Opened, Error> {
    let options = PgConnectOptions::from_str(url)?
        .application_name("modalwatch")
        .options([("search_path", SCHEMA), ("timezone", "UTC")]);
    let pool = |connections| PgPoolOptions::new().max_connections(connections).acquire_timeout(CONNECT_TIMEOUT);
    let writer = pool(1).connect_with(options.clone()).await?;
    let (number, version): (String, String) =
        sqlx::query_as("select current_setting('server_version_num'), current_setting('server_version')")
            .fetch_one(&writer)
            .await?;
    if number.parse::<i32>().is_ok_and(|number| number < OLDEST) {
        return Err(Error::ServerTooOld(version));
    }
    sqlx::query(sqlx::AssertSqlSafe(format!("create schema if not exists {SCHEMA}"))).execute(&writer).await?;
    MIGRATIONS.run(&writer).await?;
    let reader = pool(READERS).connect_with(options).await?;
    Ok(Opened { writer, reader, version })
}
