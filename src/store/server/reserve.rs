//! Connections for moving data out of a database or into it, without a service.

use sqlx::Connection as _;
use sqlx_postgres::PgConnection;

use super::super::error::{over_network, Error};
use super::super::url::DatabaseUrl;
use super::connect::{self, Place};
use super::{holder, schema};

/// A session that keeps services from using a database.
pub(in super::super) struct Reserved {
    _connection: PgConnection,
    has_data: bool,
}

impl Reserved {
    /// Takes the lock of the service on a database into which data are to be moved. Its schema is made if there is none.
    ///
    /// # Errors
    /// [`Error::ServedElsewhere`] if a service uses it.
    pub(in super::super) async fn for_move(url: &DatabaseUrl) -> Result<Self, Error> {
        let place = Place::of(url)?;
        schema::migrate(url).await?;
        let mut connection = place.connect().await?;
        let unfinished = match schema::check(&mut connection, &place).await {
            Err(Error::MoveIncomplete(_)) => true,
            checked => checked.map(|()| false)?,
        };
        holder::take(&mut connection, &place).await?;
        // A service that lost the lock before knows then that its data were replaced.
        holder::note(&mut connection, "a move of data").await?;
        let (some,): (bool,) =
            sqlx::query_as("select exists (select 1 from structure) or exists (select 1 from api_token)")
                .fetch_one(&mut connection)
                .await
                .map_err(over_network)?;
        Ok(Self { _connection: connection, has_data: some && !unfinished })
    }

    /// Whether there are data that are not those of a move that was broken off.
    pub(in super::super) fn has_data(&self) -> bool {
        self.has_data
    }
}

/// A connection for reading everything, and whether a service uses the database at the same time. Otherwise none can until the connection
/// is closed.
pub(in super::super) async fn for_reading(url: &DatabaseUrl) -> Result<(PgConnection, bool), Error> {
    let place = Place::of(url)?;
    let mut connection = place.connect().await?;
    connect::version(&mut connection).await?;
    schema::check(&mut connection, &place).await?;
    match holder::take(&mut connection, &place).await {
        Ok(_) => Ok((connection, false)),
        Err(Error::ServedElsewhere(_)) => Ok((connection, true)),
        Err(error) => Err(error),
    }
}

/// What `doctor` shows of a database.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServerState {
    /// Version of the server.
    pub version: String,
    /// Whether a service uses the database.
    pub in_use: bool,
}

/// Looks at a database: whether it can be reached, and whether this program can work with its schema.
///
/// # Errors
/// [`Error`], whose message says what to do.
pub async fn look(url: &DatabaseUrl) -> Result<ServerState, Error> {
    let (mut connection, in_use) = for_reading(url).await?;
    let version = connect::version(&mut connection).await?;
    let _ = connection.close().await;
    Ok(ServerState { version, in_use })
}

/// A connection without a lock.
pub(in super::super) async fn connection(url: &DatabaseUrl) -> Result<PgConnection, Error> {
    Place::of(url)?.connect().await
}

/// The tables with triggers of this program.
pub(in super::super) async fn tables_with_triggers(connection: &mut PgConnection) -> Result<Vec<String>, Error> {
    let tables: Vec<(String,)> = sqlx::query_as(
        "select distinct c.relname::text from pg_trigger t join pg_class c on c.oid = t.tgrelid
         join pg_namespace n on n.oid = c.relnamespace where n.nspname = $1 and not t.tgisinternal order by 1",
    )
    .bind(connect::SCHEMA)
    .fetch_all(connection)
    .await
    .map_err(over_network)?;
    Ok(tables.into_iter().map(|(table,)| table).collect())
}
