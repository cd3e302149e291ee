//! The queue of writers: all that waits is written in one transaction, with one sync of the disk.
//!
//! While one transaction is synced, others queue; the next takes them all. Each piece of work has a savepoint, so that one that
//! fails takes no other with it, and none is answered before the commit: what was acknowledged is on the disk.

use std::collections::VecDeque;
use std::future::Future;
use std::panic::AssertUnwindSafe;
use std::pin::Pin;
use std::sync::atomic::AtomicU64;
use std::sync::{Arc, Mutex, MutexGuard};

use futures_util::FutureExt as _;
use sqlx::pool::PoolConnection;
use sqlx::sqlite::{SqliteConnection, SqlitePool};
use sqlx::{Connection as _, Sqlite, Transaction};
use tokio::sync::{oneshot, Notify};

use super::{Error, OpenedFile};

/// Most pieces of work of one transaction: the first of them waits for the last.
const MOST_TOGETHER: usize = 64;

/// What runs inside a write transaction.
pub(super) type Work<'c, T> = Pin<Box<dyn Future<Output = Result<T, Error>> + Send + 'c>>;

/// A piece of work; what it returns is left where its caller finds it.
type Piece = Box<dyn for<'c> FnOnce(&'c mut SqliteConnection) -> Work<'c, ()> + Send>;

/// A piece of work that waits for its turn.
struct Waiting {
    piece: Piece,
    caller: Caller,
}

/// Who waits for the end of a piece of work; dropped without an answer, it stands for a panic.
type Caller = oneshot::Sender<Result<(), Error>>;

/// What became of a piece of work inside a transaction that is still open.
struct Done {
    caller: Caller,
    outcome: Result<(), Error>,
}

#[derive(Default)]
struct Queue {
    waiting: VecDeque<Waiting>,
    /// Whether a task works the queue off: one for all, since one for each would queue for the connection itself.
    worked_off: bool,
}

/// The one connection that writes, and what waits for it.
pub(super) struct Writer {
    /// Of one connection, which lives as long as the store.
    pub(super) pool: SqlitePool,
    pub(super) file: OpenedFile,
    /// Told after every transaction.
    pub(super) written: Notify,
    /// Writes that the disk refused since the store was opened.
    pub(super) refused: AtomicU64,
    queue: Mutex<Queue>,
}

impl Writer {
    pub(super) fn new(pool: SqlitePool, file: OpenedFile) -> Self {
        Self { pool, file, written: Notify::new(), refused: AtomicU64::new(0), queue: Mutex::default() }
    }

    /// Queues a piece of work, at once; the answer comes when it is on the disk. It is done whether or not the answer is
    /// waited for, in the order in which it was queued.
    pub(super) fn queue<T, F>(self: &Arc<Self>, work: F) -> impl Future<Output = Result<T, Error>> + Send + 'static
    where
        T: Send + 'static,
        F: for<'c> FnOnce(&'c mut SqliteConnection) -> Work<'c, T> + Send + 'static,
    {
        let found = Arc::new(Mutex::new(None));
        let place = Arc::clone(&found);
        let piece = piece(move |connection| {
            Box::pin(async move {
                let value = work(connection).await?;
                *place.lock().expect("no holder of this lock panics") = Some(value);
                Ok(())
            })
        });
        let (caller, answer) = oneshot::channel();
        let idle = {
            let mut queue = self.lock();
            queue.waiting.push_back(Waiting { piece, caller });
            !std::mem::replace(&mut queue.worked_off, true)
        };
        if idle {
            let writer = Arc::clone(self);
            // A task of its own, because axum drops handlers whose client is gone.
            tokio::spawn(async move { writer.work_off().await });
        }
        let writer = Arc::clone(self);
        async move {
            let result = match answer.await {
                Ok(Ok(())) => found.lock().expect("no holder of this lock panics").take().ok_or(Error::Panicked),
                Ok(Err(error)) => Err(error),
                Err(_) => Err(Error::Panicked),
            };
            if let Err(error) = &result {
                writer.count_failure(error);
            }
            result
        }
    }

    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().expect("no holder of this lock panics")
    }

    /// Does all that waits, and what comes meanwhile, until nothing waits any more.
    async fn work_off(&self) {
        loop {
            let connection = self.pool.acquire().await.map_err(Error::from);
            // Now, not before: what came while the connection was waited for goes into the same transaction.
            let together: Vec<Waiting> = {
                let mut queue = self.lock();
                if queue.waiting.is_empty() {
                    queue.worked_off = false;
                    return;
                }
                let count = queue.waiting.len().min(MOST_TOGETHER);
                queue.waiting.drain(..count).collect()
            };
            match connection {
                // A panic drops the callers, who take it for one; those behind them still have their turn.
                Ok(connection) => drop(AssertUnwindSafe(self.write(connection, together)).catch_unwind().await),
                Err(error) => {
                    for waiting in together {
                        answer(waiting.caller, Err(error.again()));
                    }
                }
            }
        }
    }

    /// Writes in one transaction and answers all callers.
    async fn write(&self, mut connection: PoolConnection<Sqlite>, together: Vec<Waiting>) {
        let mut done = Vec::with_capacity(together.len());
        let ended = in_transaction(&mut connection, together, &mut done).await;
        if ended.is_ok() && done.iter().any(|done| done.outcome.is_ok()) {
            self.written.notify_one();
        }
        let spoilt = |error: &Error| error.spoils_the_connection();
        if ended.as_ref().is_err_and(spoilt) || done.iter().any(|done| done.outcome.as_ref().is_err_and(spoilt)) {
            // SQLite ends a transaction by itself when the disk fails. sqlx still counts it as open and would refuse the
            // next one for ever; and a handle that failed once is best not trusted. The pool makes a new one.
            let _ = connection.detach().close_hard().await;
        }
        let ended = ended.and_then(|()| self.file.check());
        for Done { caller, outcome } in done {
            // What failed by itself has its own reason; all others share that of the transaction.
            let outcome = outcome.and_then(|()| ended.as_ref().copied().map_err(Error::again));
            answer(caller, outcome);
        }
    }
}

fn answer(caller: Caller, outcome: Result<(), Error>) {
    // An error means that nobody waits any more.
    let _ = caller.send(outcome);
}

/// Lets the compiler see that a closure takes a connection of any lifetime.
fn piece<F>(work: F) -> Piece
where
    F: for<'c> FnOnce(&'c mut SqliteConnection) -> Work<'c, ()> + Send + 'static,
{
    Box::new(work)
}

/// Does pieces of work one after another in one immediate transaction and commits what did not fail.
///
/// Immediate, because a transaction that begins with a read and then writes is refused at once when another writes, whatever
/// the busy timeout.
async fn in_transaction(
    connection: &mut SqliteConnection,
    together: Vec<Waiting>,
    done: &mut Vec<Done>,
) -> Result<(), Error> {
    let mut transaction = match begin(connection).await {
        Ok(transaction) => transaction,
        Err(error) => {
            done.extend(together.into_iter().map(|waiting| Done { caller: waiting.caller, outcome: Ok(()) }));
            return Err(error);
        }
    };
    let alone = together.len() == 1;
    let (mut savepoint, mut lost) = (FIRST_SAVEPOINT, None);
    for Waiting { piece, caller, .. } in together {
        let outcome = match lost {
            Some(_) => Ok(()),
            None if alone => caught(piece, &mut transaction).await,
            None => one(&mut transaction, piece, savepoint).await.unwrap_or_else(|error| {
                lost = Some(error);
                Ok(())
            }),
        };
        savepoint = NEXT_SAVEPOINT;
        done.push(Done { caller, outcome });
    }
    if let Some(error) = lost {
        // SQLite may have rolled it back already.
        let _ = transaction.rollback().await;
        return Err(error);
    }
    if done.iter().all(|done| done.outcome.is_err()) {
        return Ok(transaction.rollback().await?);
    }
    fault_point!("store::commit", |_| Err(sqlx::Error::Io(std::io::Error::other("a fault")).into()));
    transaction.commit().await?;
    fault_point!("store::committed", |_| Err(sqlx::Error::Io(std::io::Error::other("a fault")).into()));
    Ok(())
}

async fn begin(connection: &mut SqliteConnection) -> Result<Transaction<'_, Sqlite>, Error> {
    fault_point!("store::begin", |_| Err(sqlx::Error::Io(std::io::Error::other("a fault")).into()));
    Ok(connection.begin_with("begin immediate").await?)
}

/// Statements that set the savepoint of a piece: of the first, and of one behind another. A commit ends the last.
const FIRST_SAVEPOINT: &str = "savepoint piece";
const NEXT_SAVEPOINT: &str = "release piece; savepoint piece";

/// Does one piece of work behind a savepoint. The inner result is that of the work; the outer one is an error when the whole
/// transaction is lost.
async fn one(
    transaction: &mut Transaction<'_, Sqlite>,
    piece: Piece,
    savepoint: &'static str,
) -> Result<Result<(), Error>, Error> {
    sqlx::query(savepoint).execute(&mut **transaction).await?;
    let Err(error) = caught(piece, transaction).await else { return Ok(Ok(())) };
    match sqlx::query("rollback to piece").execute(&mut **transaction).await {
        Ok(_) => Ok(Err(error)),
        // SQLite has rolled back everything, or nobody knows what it did.
        Err(failed) if error.disk_cause().is_none() => Err(failed.into()),
        Err(_) => Err(error),
    }
}

async fn caught(piece: Piece, connection: &mut SqliteConnection) -> Result<(), Error> {
    AssertUnwindSafe(piece(connection)).catch_unwind().await.unwrap_or(Err(Error::Panicked))
}

#[cfg(test)]
mod tests {
    use futures_util::future::join_all;

    use super::super::{Error, Store};
    use super::MOST_TOGETHER;
    use crate::fault::Faults;
    use crate::quantity::{Digest, StructureId, Timestamp};

    async fn open() -> (Store, tempfile::TempDir) {
        let folder = tempfile::tempdir().unwrap();
        (Store::open(folder.path()).await.unwrap(), folder)
    }

    /// Writes a structure, and then does what `number` says: every fourth fails, every fifth panics.
    async fn put(store: &Store, number: usize) -> Result<usize, Error> {
        let work = store.write(move |connection| {
            Box::pin(async move {
                let insert = sqlx::query("insert into structure values (?, '{}', 'digest', 0, 0)");
                insert.bind(format!("s{number:03}")).execute(&mut *connection).await?;
                if number.is_multiple_of(4) {
                    return Err(Error::UnknownStructure(format!("s{number:03}")));
                }
                assert!(!number.is_multiple_of(5), "a piece of work panics");
                Ok(number)
            })
        });
        work.await
    }

    async fn stored(store: &Store) -> Vec<String> {
        store.structures().await.unwrap().into_iter().map(|summary| summary.id.to_string()).collect()
    }

    #[tokio::test]
    async fn a_piece_that_fails_or_panics_takes_no_other_with_it() {
        let (store, _folder) = open().await;
        // All are queued before the first gets its turn.
        let outcomes = join_all((0..100).map(|number| put(&store, number))).await;
        for (number, outcome) in outcomes.into_iter().enumerate() {
            match outcome {
                Ok(said) => assert!(said == number && !number.is_multiple_of(4) && !number.is_multiple_of(5)),
                Err(Error::UnknownStructure(_)) => assert!(number.is_multiple_of(4)),
                Err(Error::Panicked) => assert!(number.is_multiple_of(5)),
                Err(other) => panic!("{number}: {other}"),
            }
        }
        let kept = (0..100_usize).filter(|number| !number.is_multiple_of(4) && !number.is_multiple_of(5));
        assert_eq!(stored(&store).await, kept.map(|number| format!("s{number:03}")).collect::<Vec<_>>());
    }

    #[tokio::test]
    async fn what_waits_shares_a_commit_and_is_answered_by_it() {
        let (store, _folder) = open().await;
        let faults = Faults::arm();
        let odd = |count: usize| (0..count).map(|i| 20 * i + 1);
        // One commit fails: all who shared it are told, and none of it is there.
        faults.set("store::commit", "1*return");
        let outcomes = join_all(odd(MOST_TOGETHER + 3).map(|number| put(&store, number))).await;
        faults.clear("store::commit");
        let failed = outcomes.iter().filter(|outcome| outcome.is_err()).count();
        assert_eq!(failed, MOST_TOGETHER, "those behind them have another transaction");
        assert_eq!(stored(&store).await.len(), 3);
        // Lost behind the commit, the answer is an error, and all of it is there.
        faults.set("store::committed", "1*return");
        let outcomes = join_all(odd(MOST_TOGETHER).map(|number| put(&store, number))).await;
        assert!(outcomes.iter().all(Result::is_err));
        assert_eq!(stored(&store).await.len(), MOST_TOGETHER + 3);
    }

    #[tokio::test]
    async fn works_are_done_in_the_order_of_the_calls_whoever_waits_first() {
        let (store, _folder) = open().await;
        let id = |number: usize| StructureId::parse(&format!("s{number}")).unwrap();
        let put = |definition: &'static str| {
            let store = store.clone();
            store.write(move |connection| {
                Box::pin(async move {
                    let insert = "insert into structure values ('s', ?1, 'digest', 0, 0)
                                  on conflict do update set definition = definition || ?1";
                    sqlx::query(insert).bind(definition).execute(&mut *connection).await?;
                    Ok(())
                })
            })
        };
        let (first, second, third) = (put("a"), put("b"), put("c"));
        third.await.unwrap();
        first.await.unwrap();
        second.await.unwrap();
        let record = store.structure(&StructureId::parse("s").unwrap()).await.unwrap().unwrap();
        assert_eq!(record.definition_json, "abc");
        // A caller who goes away leaves the work to be done.
        let digest = Digest::of(&[b"v1"]);
        let (gone, stays) = (id(1), id(2));
        let dropped = store.put_structure(&gone, "{}", &digest, Timestamp::now());
        let _ = tokio::time::timeout(std::time::Duration::ZERO, dropped).await;
        store.put_structure(&stays, "{}", &digest, Timestamp::now()).await.unwrap();
        assert_eq!(stored(&store).await, ["s", "s1", "s2"]);
    }
}
