//! The write queue: group commit of write tasks on the one connection that writes.
//!
//! While one transaction is synced to disk, further tasks queue; the next transaction runs all of them. Each task has its own
//! savepoint, so that a failed task does not roll back the others. No task is answered before the commit: what was acknowledged
//! is on disk.
//!
//! Tasks of bulk work, such as the results of a replay, run while no other task waits and no sender of a new batch waits for its answer.

use std::future::Future;
use std::panic::AssertUnwindSafe;
use std::pin::Pin;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard};

use futures_util::FutureExt as _;
use tokio::sync::{oneshot, Notify};
use tokio::time::Instant;
use tracing::{info_span, Instrument as _};

use super::error::Error;
use super::transaction::Transaction;
use super::write_connection::{Held, Open, WriterPool};
use super::write_queue::{Group, Next, WritePriority, WriteQueue};

/// The future of a write task.
pub(super) type Work<'t, T> = Pin<Box<dyn Future<Output = Result<T, Error>> + Send + 't>>;

/// A write task that stores its result in a place shared with its caller.
type Task = Box<dyn for<'t> FnOnce(&'t mut Transaction<'_>) -> Work<'t, ()> + Send>;

/// A queued write task.
struct Queued {
    task: Task,
    caller: Caller,
}

#[derive(Default)]
struct Queue {
    waiting: WriteQueue<Queued>,
    /// Whether a Tokio task is draining the queue. There is at most one, because several would compete for the connection.
    draining: bool,
}

/// Receives the outcome of a write task. If it is dropped without an outcome, the task panicked.
type Caller = oneshot::Sender<Result<(), Error>>;

/// A task that has run in a transaction that is not committed yet.
struct Finished {
    caller: Caller,
    outcome: Result<(), Error>,
}

/// The connection that writes, and its queue.
pub(super) struct Writer {
    pub(super) pool: WriterPool,
    /// Notified after every transaction that wrote something.
    pub(super) written: Notify,
    /// Number of writes that failed because of the disk since the store was opened.
    pub(super) refused: AtomicU64,
    queue: Mutex<Queue>,
    /// Notified when bulk tasks need not wait any longer, or when another task is queued.
    changed: Notify,
}

impl Writer {
    pub(super) fn new(pool: WriterPool) -> Self {
        Self {
            pool,
            written: Notify::new(),
            refused: AtomicU64::new(0),
            queue: Mutex::default(),
            changed: Notify::new(),
        }
    }

    /// Queues a write task immediately. The returned future resolves when the task is committed. Tasks of one priority run in the
    /// order of the calls, whether or not the futures are awaited.
    pub(super) fn queue<T, F>(
        self: &Arc<Self>,
        priority: WritePriority,
        work: F,
    ) -> impl Future<Output = Result<T, Error>> + Send + 'static
    where
        T: Send + 'static,
        F: for<'t> FnOnce(&'t mut Transaction<'_>) -> Work<'t, T> + Send + 'static,
    {
        let result = Arc::new(Mutex::new(None));
        let slot = Arc::clone(&result);
        let task = boxed(move |transaction| {
            Box::pin(async move {
                let value = work(transaction).await?;
                *slot.lock().expect("no holder of this lock panics") = Some(value);
                Ok(())
            })
        });
        let (caller, answer) = oneshot::channel();
        let idle = {
            let mut queue = self.lock();
            queue.waiting.push(priority, Queued { task, caller }, Instant::now());
            !std::mem::replace(&mut queue.draining, true)
        };
        if idle {
            let writer = Arc::clone(self);
            // A separate Tokio task, because axum drops the futures of handlers whose client has disconnected.
            tokio::spawn(async move { writer.drain().await });
        } else {
            self.changed.notify_one();
        }
        let writer = Arc::clone(self);
        let answered = async move {
            let outcome = match answer.await {
                Ok(Ok(())) => result.lock().expect("no holder of this lock panics").take().ok_or(Error::Panicked),
                Ok(Err(error)) => Err(error),
                Err(_) => Err(Error::Panicked),
            };
            if let Err(error) = &outcome {
                writer.count_failure(error);
            }
            outcome
        };
        answered.instrument(info_span!(target: "modalwatch::spans", "store transaction"))
    }

    /// A sender waits for an answer from now on.
    pub(super) fn add_sender(&self) {
        self.lock().waiting.add_sender();
    }

    /// A sender has its answer.
    pub(super) fn remove_sender(&self) {
        if self.lock().waiting.remove_sender() {
            self.changed.notify_one();
        }
    }

    /// Counts a write that failed because of the disk.
    pub(super) fn count_failure(&self, error: &Error) {
        if let Some(cause) = error.disk_cause() {
            metrics::counter!("modalwatch_write_failures_total", "cause" => cause).increment(1);
            self.refused.fetch_add(1, Ordering::Relaxed);
        }
    }

    fn lock(&self) -> MutexGuard<'_, Queue> {
        self.queue.lock().expect("no holder of this lock panics")
    }

    /// Runs queued tasks, group by group, until the queue is empty.
    async fn drain(&self) {
        loop {
            let connection = self.pool.acquire().await;
            // The group is taken after the connection is free, so that tasks that arrived in the meantime share the transaction.
            let next = {
                let mut queue = self.lock();
                let next = queue.waiting.next(Instant::now());
                queue.draining = !matches!(next, Next::Nothing);
                next
            };
            let (priority, mut group) = match next {
                Next::Group(priority, group) => (priority, group),
                Next::HeldBack(until) => {
                    drop(connection);
                    let _ = tokio::time::timeout_at(until, self.changed.notified()).await;
                    continue;
                }
                Next::Nothing => return,
            };
            match connection {
                Ok(connection) => {
                    let written = AssertUnwindSafe(self.write(connection, priority, &mut group)).catch_unwind().await;
                    // A panic here drops the callers of the group, who report it; later groups still run.
                    if written.is_ok() {
                        self.lock().waiting.put_back(group);
                    }
                }
                Err(error) => {
                    for (_, queued) in group {
                        answer(queued.caller, Err(error.copy()));
                    }
                }
            }
        }
    }

    /// Runs a group of tasks in one transaction and answers their callers. Bulk tasks that remain when a prompt one arrives are left in
    /// the group.
    async fn write(&self, mut connection: Held<'_>, priority: WritePriority, group: &mut Group<Queued>) {
        let mut finished = Vec::with_capacity(group.len());
        let is_held_back = || priority == WritePriority::Bulk && self.lock().waiting.is_prompt();
        let ended = run_group(&mut connection, group, is_held_back, &mut finished).await;
        if ended.is_ok() && finished.iter().any(|task| task.outcome.is_ok()) {
            self.written.notify_one();
        }
        let spoilt = |error: &Error| error.spoils_the_connection();
        if ended.as_ref().is_err_and(spoilt) || finished.iter().any(|task| task.outcome.as_ref().is_err_and(spoilt)) {
            // SQLite rolls a transaction back by itself when the disk fails. sqlx would still count it as open and refuse every
            // later one, so the connection is closed and the pool opens a new one.
            connection.close().await;
        }
        let ended = ended.and_then(|()| self.pool.check());
        for Finished { caller, outcome } in finished {
            // A failed task reports its own error; all others report the outcome of the transaction.
            let outcome = outcome.and_then(|()| ended.as_ref().copied().map_err(Error::copy));
            answer(caller, outcome);
        }
    }
}

fn answer(caller: Caller, outcome: Result<(), Error>) {
    // Sending fails if the caller no longer waits.
    let _ = caller.send(outcome);
}

/// Lets the compiler infer that a closure takes a transaction of any lifetime.
fn boxed<F>(task: F) -> Task
where
    F: for<'t> FnOnce(&'t mut Transaction<'_>) -> Work<'t, ()> + Send + 'static,
{
    Box::new(task)
}

/// Runs tasks one after another in one immediate transaction and commits those that did not fail. The tasks that remain as soon as
/// `is_held_back` are left in the group.
async fn run_group(
    connection: &mut Held<'_>,
    group: &mut Group<Queued>,
    is_held_back: impl Fn() -> bool,
    finished: &mut Vec<Finished>,
) -> Result<(), Error> {
    let mut transaction = match connection.begin().await {
        Ok(transaction) => transaction,
        Err(error) => {
            finished.extend(group.drain(..).map(|(_, queued)| Finished { caller: queued.caller, outcome: Ok(()) }));
            return Err(error);
        }
    };
    let alone = group.len() == 1;
    let (mut savepoint, mut lost) = (FIRST_SAVEPOINT, None);
    while let Some((_, Queued { task, caller })) = group.pop_front() {
        let outcome = match lost {
            Some(_) => Ok(()),
            None if alone => run(task, &mut transaction).await,
            None => run_in_savepoint(task, &mut transaction, savepoint).await.unwrap_or_else(|error| {
                lost = Some(error);
                Ok(())
            }),
        };
        savepoint = NEXT_SAVEPOINT;
        finished.push(Finished { caller, outcome });
        if lost.is_none() && is_held_back() {
            break;
        }
    }
    if let Some(error) = lost {
        // SQLite may have rolled it back already.
        let _ = transaction.rollback().await;
        return Err(error);
    }
    if finished.iter().all(|task| task.outcome.is_err()) {
        return Ok(transaction.rollback().await?);
    }
    fault_point!("store::commit", |_| Err(sqlx::Error::Io(std::io::Error::other("a fault")).into()));
    transaction.commit().await?;
    fault_point!("store::committed", |_| Err(sqlx::Error::Io(std::io::Error::other("a fault")).into()));
    Ok(())
}

/// Statements that set the savepoint of the first task, and of each later one. The commit releases the last savepoint.
const FIRST_SAVEPOINT: &str = "savepoint task";
const NEXT_SAVEPOINT: &str = "release task; savepoint task";

/// Runs a task behind a savepoint. The inner result is that of the task; the outer one is an error when the whole transaction
/// is lost.
async fn run_in_savepoint(
    task: Task,
    open: &mut Open<'_>,
    savepoint: &'static str,
) -> Result<Result<(), Error>, Error> {
    open.run(savepoint).await?;
    let Err(error) = run(task, open).await else { return Ok(Ok(())) };
    match open.run("rollback to task").await {
        Ok(()) => Ok(Err(error)),
        // SQLite has rolled back everything, or its state is unknown.
        Err(failed) if error.disk_cause().is_none() => Err(failed.into()),
        Err(_) => Err(error),
    }
}

/// Runs a task and turns a panic into an error.
async fn run(task: Task, open: &mut Open<'_>) -> Result<(), Error> {
    let mut transaction = open.transaction();
    let outcome = AssertUnwindSafe(task(&mut transaction)).catch_unwind().await.unwrap_or(Err(Error::Panicked));
    fault_point!("store::task", |_| Err(sqlx::Error::Io(std::io::Error::other("a fault")).into()));
    outcome
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use futures_util::future::{join_all, BoxFuture};
    use futures_util::FutureExt as _;

    use super::super::preferred_sender::PreferredSender;
    use super::super::write_queue::{GROUP_LIMIT, LONGEST_BEHIND};
    use super::super::{Error, Store};
    use super::{Instant, WritePriority};
    use crate::fault::Faults;
    use crate::quantity::{Digest, StructureId};

    async fn open() -> (Store, tempfile::TempDir) {
        let folder = tempfile::tempdir().unwrap();
        (Store::open(folder.path()).await.unwrap(), folder)
    }

    /// Writes a structure; every fourth task then fails and every fifth panics.
    async fn put(store: &Store, number: usize) -> Result<usize, Error> {
        let work = store.database.write(move |transaction| {
            Box::pin(async move {
                let insert = super::super::sql::query("insert into structure values ($1, '{}', 'digest', 0, 0)");
                insert.bind(format!("s{number:03}")).execute(&mut *transaction).await?;
                if number.is_multiple_of(4) {
                    return Err(Error::UnknownStructure(format!("s{number:03}")));
                }
                assert!(!number.is_multiple_of(5), "a write task panics");
                Ok(number)
            })
        });
        work.await
    }

    async fn stored(store: &Store) -> Vec<String> {
        store.structures().list().await.unwrap().into_iter().map(|summary| summary.id.to_string()).collect()
    }

    #[tokio::test]
    async fn a_task_that_fails_or_panics_rolls_back_no_other() {
        let (store, _folder) = open().await;
        // All are queued before the first one runs.
        let outcomes = join_all((0..100).map(|number| put(&store, number))).await;
        for (number, outcome) in outcomes.into_iter().enumerate() {
            match outcome {
                Ok(value) => assert!(value == number && !number.is_multiple_of(4) && !number.is_multiple_of(5)),
                Err(Error::UnknownStructure(_)) => assert!(number.is_multiple_of(4)),
                Err(Error::Panicked) => assert!(number.is_multiple_of(5)),
                Err(other) => panic!("{number}: {other}"),
            }
        }
        let kept = (0..100_usize).filter(|number| !number.is_multiple_of(4) && !number.is_multiple_of(5));
        assert_eq!(stored(&store).await, kept.map(|number| format!("s{number:03}")).collect::<Vec<_>>());
    }

    #[tokio::test]
    async fn waiting_tasks_share_a_commit_and_are_answered_by_it() {
        let (store, _folder) = open().await;
        let faults = Faults::arm();
        let odd = |count: usize| (0..count).map(|i| 20 * i + 1);
        // One commit fails: all tasks of the group fail, and nothing of them is stored.
        faults.set("store::commit", "1*return");
        let outcomes = join_all(odd(GROUP_LIMIT + 3).map(|number| put(&store, number))).await;
        faults.clear("store::commit");
        let failed = outcomes.iter().filter(|outcome| outcome.is_err()).count();
        assert_eq!(failed, GROUP_LIMIT, "later tasks have another transaction");
        assert_eq!(stored(&store).await.len(), 3);
        // A failure after the commit: the tasks report an error, although they are stored.
        faults.set("store::committed", "1*return");
        let outcomes = join_all(odd(GROUP_LIMIT).map(|number| put(&store, number))).await;
        assert!(outcomes.iter().all(Result::is_err));
        assert_eq!(stored(&store).await.len(), GROUP_LIMIT + 3);
    }

    #[tokio::test]
    async fn tasks_run_in_the_order_of_the_calls_whichever_is_awaited_first() {
        let (store, _folder) = open().await;
        let id = |number: usize| StructureId::parse(&format!("s{number}")).unwrap();
        let put = |definition: &'static str| {
            let store = store.clone();
            store.database.write(move |transaction| {
                Box::pin(async move {
                    let insert = "insert into structure values ('s', $1, 'digest', 0, 0)
                                  on conflict do update set definition = definition || $1";
                    super::super::sql::query(insert).bind(definition).execute(&mut *transaction).await?;
                    Ok(())
                })
            })
        };
        let (first, second, third) = (put("a"), put("b"), put("c"));
        third.await.unwrap();
        first.await.unwrap();
        second.await.unwrap();
        let record = store.structures().structure(&StructureId::parse("s").unwrap()).await.unwrap().unwrap();
        assert_eq!(record.definition_json, "abc");
        // A task runs also when its caller no longer waits.
        let digest = Digest::of(&[b"v1"]);
        let (gone, stays) = (id(1), id(2));
        let dropped = store.structures().put_structure(&gone, "{}", &digest, crate::clock::now());
        let _ = tokio::time::timeout(std::time::Duration::ZERO, dropped).await;
        store.structures().put_structure(&stays, "{}", &digest, crate::clock::now()).await.unwrap();
        assert_eq!(stored(&store).await, ["s", "s1", "s2"]);
    }

    /// Queues a task that adds a letter to what is returned.
    fn noting<'s>(
        store: &'s Store,
        order: &'s Arc<Mutex<String>>,
    ) -> impl Fn(WritePriority, char) -> BoxFuture<'static, ()> + 's {
        move |priority, letter| {
            let order = Arc::clone(order);
            let work = store.database.write_as(priority, move |_| {
                Box::pin(async move {
                    // Lets the test queue further tasks in the meantime.
                    tokio::task::yield_now().await;
                    order.lock().unwrap().push(letter);
                    Ok(())
                })
            });
            work.map(Result::unwrap).boxed()
        }
    }

    #[tokio::test]
    async fn bulk_tasks_run_in_their_order_while_no_other_waits() {
        let (store, _folder) = open().await;
        let order = Arc::default();
        let queue = noting(&store, &order);
        let bulk: Vec<_> = ('a'..='e').map(|letter| queue(WritePriority::Bulk, letter)).collect();
        let prompt: Vec<_> = ('1'..='3').map(|letter| queue(WritePriority::Prompt, letter)).collect();
        join_all(bulk.into_iter().chain(prompt)).await;
        assert_eq!(*order.lock().unwrap(), "123abcde");
        // One that arrives during a bulk task waits for that one only, and those behind it keep their order.
        order.lock().unwrap().clear();
        let bulk: Vec<_> = ('a'..='e').map(|letter| queue(WritePriority::Bulk, letter)).collect();
        while order.lock().unwrap().is_empty() {
            tokio::task::yield_now().await;
        }
        queue(WritePriority::Prompt, '1').await;
        join_all(bulk).await;
        let order = order.lock().unwrap().clone();
        assert_eq!(order.replace('1', ""), "abcde");
        assert!(order.find('1').is_some_and(|place| place < 4), "{order}");
    }

    #[tokio::test]
    async fn bulk_tasks_wait_until_a_sender_has_its_answer() {
        let (store, _folder) = open().await;
        let order = Arc::default();
        let queue = noting(&store, &order);
        let (started, sender) = (Instant::now(), PreferredSender::of(&store));
        let bulk = queue(WritePriority::Bulk, 'a');
        queue(WritePriority::Prompt, '1').await;
        let (before, waited) = (order.lock().unwrap().clone(), started.elapsed());
        // On a machine that stood still for so long, it was due.
        assert!(before == "1" || waited >= LONGEST_BEHIND, "{before} after {waited:?}");
        drop(sender);
        bulk.await;
        assert_eq!(order.lock().unwrap().len(), 2);
    }
}
