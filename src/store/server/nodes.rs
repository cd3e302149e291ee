//! The nodes of a database: each process registers itself with the address at which others reach it, and learns which node serves.
//!
//! Which node serves is decided by the lock alone ([`super::holder`]): a node writes next to its address which session of the server holds the
//! lock for it, and the others look that session up among the locks. A node that was killed therefore stops being the one that serves at the
//! moment in which the server ends its session, whatever is left in the table.

use std::sync::Arc;
use std::time::{Duration, Instant};

use sqlx::Connection as _;
use sqlx_postgres::PgConnection;
use tokio::sync::{watch, Notify};
use tokio::task::JoinHandle;
use tracing::{debug, warn};

use super::super::error::{over_network, Error};
use super::super::url::DatabaseUrl;
use super::connect::{self, Place};
use super::{holder, schema};

/// Interval at which a node looks which node serves.
const BETWEEN_LOOKS: Duration = Duration::from_millis(500);

/// Interval of the heartbeats of a node.
const BETWEEN_HEARTBEATS: Duration = Duration::from_secs(2);

/// A node whose last look began so long ago was suspended, or the server does not answer.
const SUSPENDED_AFTER: Duration = Duration::from_secs(1);

/// Longest time for a look: a server that vanished without a reset would otherwise be waited for until the system gives up.
const LOOK_TIMEOUT: Duration = Duration::from_secs(5);

/// A node without a heartbeat for so long is removed from the list.
const FORGOTTEN_AFTER_S: i32 = 60;

/// A process of the database.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Node {
    /// Its id, a new one for each start.
    pub id: String,
    /// Address at which other nodes reach it, such as `http://bridge-2.example:8080`.
    pub url: String,
    /// Version of its program.
    pub version: String,
}

/// The registration of this process among the nodes of a database. Cloning is cheap; it ends when the last clone is dropped.
#[derive(Clone)]
pub struct Nodes(Arc<Inner>);

struct Inner {
    own: Node,
    secret: String,
    serving: watch::Receiver<Option<Node>>,
    /// The session that holds the lock, whoever it belongs to.
    holder: watch::Receiver<Option<i32>>,
    /// When the last look that has ended began, and whether the server answered.
    looked: watch::Receiver<(Instant, bool)>,
    look: Arc<Notify>,
    session: watch::Sender<Option<i32>>,
    task: JoinHandle<()>,
}

impl Nodes {
    /// Registers this process under the address `url`, and begins to watch which node serves.
    ///
    /// # Errors
    /// What prevents the use of the database, as when it is opened.
    pub async fn join(database: &DatabaseUrl, url: String) -> Result<Self, Error> {
        let place = Place::of(database)?;
        let mut connection = place.connect().await?;
        connect::version(&mut connection).await?;
        schema::check(&mut connection, &place).await?;
        let (secret,): (String,) =
            sqlx::query_as("select secret from node_secret").fetch_one(&mut connection).await.map_err(over_network)?;
        let own = Node { id: uuid::Uuid::now_v7().to_string(), url, version: env!("CARGO_PKG_VERSION").to_owned() };
        let (session, of_lock) = watch::channel(None);
        let (found, serving) = watch::channel(None);
        let (held_by, holder) = watch::channel(None);
        let (ended, looked) = watch::channel((Instant::now(), true));
        let look = Arc::new(Notify::new());
        let registration =
            Registration { place, own: own.clone(), of_lock, found, held_by, ended, look: Arc::clone(&look) };
        let task = tokio::spawn(registration.keep(connection));
        Ok(Self(Arc::new(Inner { own, secret, serving, holder, looked, look, session, task })))
    }

    /// This node.
    pub fn own(&self) -> &Node {
        &self.0.own
    }

    /// The secret that the nodes of this database share.
    pub fn secret(&self) -> &str {
        &self.0.secret
    }

    /// The node that serves, or `None` while there is none. While the server cannot be asked, the last answer stays.
    pub fn serving(&self) -> watch::Receiver<Option<Node>> {
        self.0.serving.clone()
    }

    /// Looks again which node serves, without waiting for the next interval.
    pub fn look_again(&self) {
        self.0.look.notify_one();
    }

    /// Whether another session than that of this node holds the lock. A process that was suspended does not know at once that it was replaced: then this looks before it answers,
    /// so that nobody gets an answer from what was known before the pause.
    pub async fn is_replaced(&self) -> bool {
        let mut looked = self.0.looked.clone();
        let (begun, has_answered) = *looked.borrow_and_update();
        if begun.elapsed() > SUSPENDED_AFTER || !has_answered {
            // The answer to a look that began before the pause may have waited for this process as long as the request has.
            let now = Instant::now();
            self.look_again();
            let _ = tokio::time::timeout(2 * LOOK_TIMEOUT, looked.wait_for(|(begun, _)| *begun >= now)).await;
        }
        let (holder, own) = (*self.0.holder.borrow(), *self.0.session.borrow());
        // While nobody holds it, nobody can have changed anything.
        holder.is_some() && holder != own
    }

    /// Announces this node as the one that serves, as long as the session with the lock exists.
    pub fn announce(&self, mut session: watch::Receiver<Option<i32>>) {
        let inner = Arc::downgrade(&self.0);
        tokio::spawn(async move {
            loop {
                let Some(inner) = inner.upgrade() else { return };
                inner.session.send_replace(*session.borrow_and_update());
                inner.look.notify_one();
                drop(inner);
                if session.changed().await.is_err() {
                    return;
                }
            }
        });
    }
}

impl Drop for Inner {
    fn drop(&mut self) {
        self.task.abort();
    }
}

/// What the background task of a node knows.
struct Registration {
    place: Place,
    own: Node,
    /// The session with the lock, if this node has it.
    of_lock: watch::Receiver<Option<i32>>,
    found: watch::Sender<Option<Node>>,
    held_by: watch::Sender<Option<i32>>,
    ended: watch::Sender<(Instant, bool)>,
    look: Arc<Notify>,
}

impl Registration {
    /// Keeps the row of this node and the knowledge of the serving one up to date, over whichever connection works.
    async fn keep(mut self, connection: PgConnection) {
        let mut connection = Some(connection);
        let mut beaten: Option<(Instant, Option<i32>)> = None;
        loop {
            let begun = Instant::now();
            let attempt = tokio::time::timeout(LOOK_TIMEOUT, self.round(&mut connection, &mut beaten));
            let attempt = attempt.await;
            let has_answered = matches!(attempt, Ok(Ok(())));
            match attempt {
                Ok(Ok(())) => {}
                Ok(Err(error)) => {
                    debug!(%error, "The list of nodes cannot be read: {error}");
                    connection = None;
                }
                Err(_) => {
                    warn!("The database has not answered for {} s", LOOK_TIMEOUT.as_secs());
                    connection = None;
                }
            }
            self.ended.send_replace((begun, has_answered));
            tokio::select! {
                () = tokio::time::sleep(BETWEEN_LOOKS) => {}
                () = self.look.notified() => {}
            }
        }
    }

    async fn round(
        &mut self,
        connection: &mut Option<PgConnection>,
        beaten: &mut Option<(Instant, Option<i32>)>,
    ) -> Result<(), Error> {
        let open = match connection {
            Some(open) => open,
            empty => empty.insert(self.place.connect().await?),
        };
        let session = *self.of_lock.borrow_and_update();
        let is_due = beaten.is_none_or(|(at, told)| at.elapsed() >= BETWEEN_HEARTBEATS || told != session);
        if is_due {
            self.beat(open, session).await?;
            *beaten = Some((Instant::now(), session));
        }
        let (holder, serving) = serving(open).await?;
        self.held_by.send_replace(holder);
        self.found.send_if_modified(|known| {
            let is_new = *known != serving;
            *known = serving;
            is_new
        });
        Ok(())
    }

    /// Writes the row of this node, and removes those of nodes that ended.
    async fn beat(&self, connection: &mut PgConnection, session: Option<i32>) -> Result<(), Error> {
        // A heartbeat that a crash of the server loses is repeated: it need not wait for the disk.
        let mut transaction = connection.begin().await.map_err(over_network)?;
        sqlx::query("set local synchronous_commit = off").execute(&mut *transaction).await.map_err(over_network)?;
        // A session has one owner: after a crash the server may give the number of an ended one again.
        sqlx::query("update node set lock_session = null where lock_session = $2 and node_id <> $1")
            .bind(&self.own.id)
            .bind(session)
            .execute(&mut *transaction)
            .await
            .map_err(over_network)?;
        sqlx::query(
            "insert into node (node_id, url, program_version, lock_session) values ($1, $2, $3, $4)
             on conflict (node_id) do update set lock_session = excluded.lock_session, heartbeat_at = clock_timestamp()",
        )
        .bind(&self.own.id)
        .bind(&self.own.url)
        .bind(&self.own.version)
        .bind(session)
        .execute(&mut *transaction)
        .await
        .map_err(over_network)?;
        sqlx::query("delete from node where heartbeat_at < clock_timestamp() - make_interval(secs => $1)")
            .bind(f64::from(FORGOTTEN_AFTER_S))
            .execute(&mut *transaction)
            .await
            .map_err(over_network)?;
        transaction.commit().await.map_err(over_network)?;
        Ok(())
    }
}

/// A session that holds the lock, and the node that has registered it, if there is one.
#[derive(sqlx::FromRow)]
struct LockRow {
    pid: i32,
    node_id: Option<String>,
    url: Option<String>,
    program_version: Option<String>,
}

/// The session that holds the lock, and the node that has registered it.
async fn serving(connection: &mut PgConnection) -> Result<(Option<i32>, Option<Node>), Error> {
    let select = format!(
        "select l.pid, n.node_id, n.url, n.program_version from pg_locks l left join node n on n.lock_session = l.pid
         where {} order by n.heartbeat_at desc nulls last limit 1",
        holder::IS_LOCK
    );
    let found: Option<LockRow> = sqlx::query_as(sqlx::AssertSqlSafe(select))
        .bind(holder::LOCK)
        .fetch_optional(connection)
        .await
        .map_err(over_network)?;
    Ok(match found {
        None => (None, None),
        Some(LockRow { pid, node_id: Some(id), url: Some(url), program_version: Some(version) }) => {
            (Some(pid), Some(Node { id, url, version }))
        }
        Some(LockRow { pid, .. }) => (Some(pid), None),
    })
}
