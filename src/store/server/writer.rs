//! The one connection that writes, which holds the lock of the service.

use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use sqlx::Connection as _;
use sqlx_postgres::PgConnection;
use tokio::sync::{watch, Mutex, MutexGuard};

use super::super::error::{over_network, Error};
use super::connect::Place;
use super::holder;

/// Time for the answer of a server before each transaction: one that vanished without a reset would otherwise be waited for until the system
/// gives up, a quarter of an hour.
const PING_TIMEOUT: Duration = Duration::from_secs(5);

/// The connection that writes; made again, with the lock, when it broke.
pub(in super::super) struct ServerWriter {
    place: Place,
    connection: Mutex<Option<PgConnection>>,
    /// Number of the session that holds the lock.
    session: watch::Sender<Option<i32>>,
    /// By which this process knows itself as the last holder of the lock.
    process: String,
    /// Whether it has held the lock before.
    has_held: AtomicBool,
    closed: AtomicBool,
}

/// The connection while a transaction uses it.
pub(in super::super) struct HeldConnection<'w>(MutexGuard<'w, Option<PgConnection>>);

impl ServerWriter {
    pub(super) fn new(place: Place) -> Self {
        Self {
            place,
            connection: Mutex::default(),
            session: watch::Sender::default(),
            process: uuid::Uuid::now_v7().to_string(),
            has_held: AtomicBool::new(false),
            closed: AtomicBool::new(false),
        }
    }

    /// A connection that is never made, for a process that may not write.
    pub(super) fn closed(place: Place) -> Self {
        Self { closed: AtomicBool::new(true), ..Self::new(place) }
    }

    /// Makes the connection, with the lock.
    ///
    /// # Errors
    /// [`Error::ServedElsewhere`], [`Error::Unreachable`].
    pub(super) async fn hold(&self) -> Result<(), Error> {
        self.acquire().await.map(drop)
    }

    /// The connection, checked by a round trip to the server.
    ///
    /// # Errors
    /// [`Error::ServedElsewhere`] if another service has taken the lock since the connection broke; [`Error::Unreachable`].
    pub(in super::super) async fn acquire(&self) -> Result<HeldConnection<'_>, Error> {
        let mut place = self.connection.lock().await;
        if self.closed.load(Ordering::Relaxed) {
            return Err(Error::Unreachable("the connection was closed".to_owned()));
        }
        if let Some(mut connection) = place.take() {
            let answered = tokio::time::timeout(PING_TIMEOUT, connection.ping()).await;
            if answered.is_ok_and(|answered| answered.is_ok()) {
                *place = Some(connection);
                return Ok(HeldConnection(place));
            }
            let _ = connection.close_hard().await;
        }
        let mut connection = self.place.connect().await?;
        match self.take(&mut connection).await {
            Ok(session) => self.session.send_replace(Some(session)),
            Err(error) => {
                let _ = connection.close_hard().await;
                return Err(error);
            }
        };
        *place = Some(connection);
        Ok(HeldConnection(place))
    }

    /// Takes the lock for the session of a new connection, unless another process has held it since this one did.
    async fn take(&self, connection: &mut PgConnection) -> Result<i32, Error> {
        let session = holder::take(connection, &self.place).await?;
        if self.has_held.load(Ordering::Relaxed) {
            holder::check(connection, &self.process, &self.place).await?;
        } else {
            holder::note(connection, &self.process).await?;
            self.has_held.store(true, Ordering::Relaxed);
        }
        Ok(session)
    }

    /// Sends a statement without effect, by which the server and a standby see that this service lives, and which finds a broken connection.
    pub(in super::super) async fn beat(&self) -> Result<(), Error> {
        let mut held = self.acquire().await?;
        sqlx::query("select 1").execute(held.get()).await.map_err(over_network)?;
        Ok(())
    }

    /// Number of the session that holds the lock, as it changes when the connection is made again.
    pub(in super::super) fn session(&self) -> watch::Receiver<Option<i32>> {
        self.session.subscribe()
    }

    pub(in super::super) fn is_closed(&self) -> bool {
        self.closed.load(Ordering::Relaxed)
    }

    /// Ends the connection, which releases the lock.
    pub(in super::super) async fn close(&self) {
        self.closed.store(true, Ordering::Relaxed);
        if let Some(connection) = self.connection.lock().await.take() {
            let _ = connection.close().await;
        }
    }
}

impl HeldConnection<'_> {
    /// The connection.
    pub(in super::super) fn get(&mut self) -> &mut PgConnection {
        self.0.as_mut().expect("acquire leaves a connection in its place, and break_off consumes the holder")
    }

    /// Closes a connection whose state is unknown; the next transaction makes a new one.
    pub(in super::super) async fn break_off(mut self) {
        if let Some(connection) = self.0.take() {
            let _ = connection.close_hard().await;
        }
    }
}
