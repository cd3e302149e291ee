//! Connecting to a server: how a refusal is explained, and which versions are used.

use std::io::ErrorKind;
use std::time::Duration;

use sqlx::Connection as _;
use sqlx_postgres::{PgConnectOptions, PgConnection};

use super::super::error::{over_network, sql_state, Error};
use super::super::url::DatabaseUrl;

/// Oldest version, as the server states it in `server_version_num`.
const OLDEST: i32 = 150_000;

/// The schema of the database in which the tables are.
pub(in super::super) const SCHEMA: &str = "modalwatch";

/// Longest time for a new connection.
const CONNECT_TIMEOUT: Duration = Duration::from_secs(5);

/// A database of a server, and how to connect to it.
#[derive(Debug, Clone)]
pub(in super::super) struct Place {
    options: PgConnectOptions,
    name: String,
}

impl Place {
    /// The database of a URL.
    pub(super) fn of(url: &DatabaseUrl) -> Result<Self, Error> {
        let options = url.options()?.application_name(&application_name()).options([
            ("search_path", SCHEMA),
            ("timezone", "UTC"),
            ("bytea_output", "hex"),
            // Statements here read some thousand rows at most: compiling one would take longer than running it, and so would starting
            // further processes, which would take processors from new batches.
            ("jit", "off"),
            ("max_parallel_workers_per_gather", "0"),
            // Each join follows keys from the rows of one structure, as SQLite, which knows no other join, always does it. Reading whole
            // tables instead costs what all structures have stored; the server would choose it where it overestimates the rows of a window.
            ("enable_hashjoin", "off"),
            ("enable_mergejoin", "off"),
            // Disks without a moving head. The server's own value, 4, is for others, and makes it read whole tables.
            ("random_page_cost", "1.1"),
        ]);
        Ok(Self { options, name: url.to_string() })
    }

    /// How to connect.
    pub(super) fn options(&self) -> &PgConnectOptions {
        &self.options
    }

    /// The database as messages name it, without the password.
    pub(super) fn name(&self) -> &str {
        &self.name
    }

    /// A new connection.
    pub(super) async fn connect(&self) -> Result<PgConnection, Error> {
        let connecting = tokio::time::timeout(CONNECT_TIMEOUT, PgConnection::connect_with(&self.options));
        let silent =
            |_| Error::Unreachable(format!("{} has not answered for {} s", self.name, CONNECT_TIMEOUT.as_secs()));
        connecting.await.map_err(silent)?.map_err(|error| self.explained(error))
    }

    /// The error of a connection that could not be made.
    fn explained(&self, error: sqlx::Error) -> Error {
        let place = self.name.clone();
        match sql_state(&error).as_deref() {
            // Invalid authorization, wrong password; no such database; no right to connect.
            Some(state) if state.starts_with("28") || matches!(state, "3D000" | "42501") => {
                let detail =
                    error.as_database_error().map_or_else(|| error.to_string(), |error| error.message().to_owned());
                Error::Refused { place, detail }
            }
            _ if self.is_of_encryption(&error) => {
                Error::Unreachable(format!("{place}: {error}; check sslmode and sslrootcert of store.url"))
            }
            _ => match over_network(error) {
                sqlx::Error::Configuration(cause) => Error::Unreachable(format!("{place}: {cause}")),
                other => other.into(),
            },
        }
    }
}

impl Place {
    /// Whether a connection could not be made because of its encryption: the server has none, its certificate is refused, or the file of the
    /// authority cannot be read.
    fn is_of_encryption(&self, error: &sqlx::Error) -> bool {
        match error {
            sqlx::Error::Tls(_) => true,
            sqlx::Error::Io(error)
                if error.get_ref().is_some_and(<dyn std::error::Error + Send + Sync>::is::<rustls::Error>) =>
            {
                true
            }
            sqlx::Error::Io(error) => {
                matches!(error.kind(), ErrorKind::NotFound | ErrorKind::PermissionDenied)
                    && self.name.contains("sslrootcert=")
            }
            _ => false,
        }
    }
}

/// The name under which the server lists a connection, such as `modalwatch 4711@bridge-host`.
fn application_name() -> String {
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let name = format!("modalwatch {}@{}", std::process::id(), host.trim());
    // The server cuts longer names, with a notice.
    name.chars().filter(char::is_ascii).take(63).collect()
}

/// The version of the server.
///
/// # Errors
/// [`Error::ServerTooOld`].
pub(super) async fn version(connection: &mut PgConnection) -> Result<String, Error> {
    let (number, version): (String, String) =
        sqlx::query_as("select current_setting('server_version_num'), current_setting('server_version')")
            .fetch_one(connection)
            .await
            .map_err(over_network)?;
    match number.parse::<i32>() {
        Ok(number) if number < OLDEST => Err(Error::ServerTooOld(version)),
        _ => Ok(version),
    }
}
