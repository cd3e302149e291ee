//! The database of a PostgreSQL server: how it is opened, its schema, and which service may write to it.
//!
//! One service at a time serves a database. It holds a lock of its session with the server, on the connection that writes: whoever has lost
//! the lock has lost that connection too, so that a service which was cut off cannot write behind the back of its successor. With
//! `store.standby`, further services wait for the lock and take over when the server releases it, which it does at once when a process ends,
//! or when the holder has not been heard of for `store.takeover_s`. A process that takes the lock again, after its connection broke, ends if
//! another has held it in between: what it knows is out of date. Each process is registered ([`Nodes`]), so that those that wait can pass
//! requests on to the one that serves.

mod connect;
mod holder;
mod nodes;
mod reserve;
mod schema;
mod writer;

use std::time::Duration;

use sqlx_postgres::{PgPool, PgPoolOptions};
use tracing::info;

use super::error::Error;
use super::url::DatabaseUrl;
pub(super) use connect::SCHEMA;
pub use nodes::{Node, Nodes};
pub(super) use reserve::{connection, for_reading, tables_with_triggers, Reserved};
pub use reserve::{look, ServerState};
pub use schema::{migrate, schema_version, Migrated};
pub(super) use writer::{HeldConnection, ServerWriter};

use connect::Place;

const READERS: u32 = 8;

/// How long a request waits for a connection that reads.
const ACQUIRE_TIMEOUT: Duration = Duration::from_secs(5);

/// Pause between two attempts of a standby to take over.
const BETWEEN_ATTEMPTS: Duration = Duration::from_millis(500);

/// The connections of a database that was opened.
pub(super) struct Opened {
    pub writer: ServerWriter,
    pub reader: PgPool,
    pub version: String,
}

/// Connects, checks server and schema, and takes the lock of the service; with a time of `takeover`, waits for the lock.
pub(super) async fn open(url: &DatabaseUrl, takeover: Option<Duration>) -> Result<Opened, Error> {
    let place = Place::of(url)?;
    let mut connection = place.connect().await?;
    let version = connect::version(&mut connection).await?;
    schema::check(&mut connection, &place).await?;
    drop(connection);
    let writer = ServerWriter::new(place.clone());
    let mut told = false;
    loop {
        match (writer.hold().await, takeover) {
            (Ok(()), _) => break,
            (Err(Error::ServedElsewhere(holder)), Some(limit)) => {
                if !std::mem::replace(&mut told, true) {
                    info!("Standing by: {holder}");
                }
                // A server that cannot be asked now is asked again after the pause.
                let _ = holder::end_silent(&place, limit).await;
            }
            (Err(Error::Unreachable(_)), Some(_)) if told => {}
            (Err(error), _) => return Err(error),
        }
        tokio::time::sleep(BETWEEN_ATTEMPTS).await;
    }
    // The schema may have changed while the service stood by.
    schema::check(&mut place.connect().await?, &place).await?;
    Ok(Opened { writer, reader: readers(&place), version })
}

/// Connects and checks server and schema, for a process beside the service that holds the lock. There is no connection that writes.
pub(super) async fn open_beside(url: &DatabaseUrl) -> Result<Opened, Error> {
    let place = Place::of(url)?;
    let mut connection = place.connect().await?;
    let version = connect::version(&mut connection).await?;
    schema::check(&mut connection, &place).await?;
    Ok(Opened { writer: ServerWriter::closed(place.clone()), reader: readers(&place), version })
}

fn readers(place: &Place) -> PgPool {
    let readers = PgPoolOptions::new().max_connections(READERS).acquire_timeout(ACQUIRE_TIMEOUT);
    readers.connect_lazy_with(place.options().clone())
}
