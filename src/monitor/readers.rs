//! Computations for a client that waits for them, such as the detail of a batch or the check of a definition: a few at a time, on threads
//! of their own that give way to those which assess new batches, and given up when nobody waits for the result any more.

use std::panic::{catch_unwind, AssertUnwindSafe};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, LazyLock};

use rayon::{ThreadPool, ThreadPoolBuilder};
use tokio::sync::{oneshot, OwnedSemaphorePermit, Semaphore};

use super::compute::Panicked;

/// Details and drawings that may run or wait.
const MOST_DETAILS: usize = 64;

/// Definitions of structures that may be checked or wait for their check. One of 2,000 masses takes about 200 MB.
const MOST_CHECKS: usize = 16;

/// Threads; `None` if they cannot be started for want of memory, and then the common ones are used.
type Pool = LazyLock<Option<ThreadPool>>;

/// Threads of details and drawings, which anybody with a token may ask for: they give way to everything else.
static OF_DETAILS: Pool = LazyLock::new(|| pool("detail", at_a_time(), 19));

/// The thread of checks, which only an administrator asks for.
static OF_CHECKS: Pool = LazyLock::new(|| pool("check", 1, 15));

/// Threads that are further from the processor by `nice` than those of new batches.
fn pool(name: &'static str, threads: usize, nice: i32) -> Option<ThreadPool> {
    let give_way = move |_| {
        // On Linux this concerns the calling thread alone. Where it is not allowed, the threads are ordinary ones.
        let _ = rustix::process::nice(nice);
    };
    let builder = ThreadPoolBuilder::new().num_threads(threads).start_handler(give_way);
    builder.thread_name(move |number| format!("{name}-{number}")).build().ok()
}

/// Half of the cores, at least one.
fn at_a_time() -> usize {
    (std::thread::available_parallelism().map_or(1, usize::from) / 2).max(1)
}

/// Too many computations of one kind run or wait.
#[derive(Debug, thiserror::Error)]
#[error("{most} computations of this kind run or wait, which is the maximum: try again later")]
pub struct TooManyReaders {
    most: usize,
}

/// Computations of one kind; cloning gives a handle on the same ones.
#[derive(Clone)]
pub struct Readers {
    pool: &'static Pool,
    most: usize,
    places: Arc<Semaphore>,
    turns: Arc<Semaphore>,
}

/// The turn of a reader.
pub struct Turn {
    pool: &'static Pool,
    permits: (OwnedSemaphorePermit, OwnedSemaphorePermit),
}

/// Whether the result of a computation is still wanted.
#[derive(Clone)]
pub struct Wanted(Arc<AtomicBool>);

impl Wanted {
    /// Whether somebody waits for the result.
    pub fn still(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// Ends the wish for a result when the caller is dropped.
struct Wish(Wanted);

impl Drop for Wish {
    fn drop(&mut self) {
        self.0 .0.store(false, Ordering::Relaxed);
    }
}

impl Readers {
    /// Details and drawings: half as many at a time as there are cores.
    pub(super) fn of_details() -> Self {
        Self::new(&OF_DETAILS, MOST_DETAILS, at_a_time())
    }

    /// Checks of definitions, one at a time.
    pub(super) fn of_checks() -> Self {
        Self::new(&OF_CHECKS, MOST_CHECKS, 1)
    }

    fn new(pool: &'static Pool, most: usize, at_a_time: usize) -> Self {
        Self { pool, most, places: Arc::new(Semaphore::new(most)), turns: Arc::new(Semaphore::new(at_a_time)) }
    }

    /// Waits for a turn, in the order of the calls. A caller that is dropped waits no longer.
    ///
    /// # Errors
    /// [`TooManyReaders`].
    pub async fn turn(&self) -> Result<Turn, TooManyReaders> {
        let place = Arc::clone(&self.places).try_acquire_owned();
        let place = place.map_err(|_| TooManyReaders { most: self.most })?;
        let turn = Arc::clone(&self.turns).acquire_owned().await.expect("the semaphore is never closed");
        Ok(Turn { pool: self.pool, permits: (place, turn) })
    }
}

impl Turn {
    /// Runs `work`, which may end early with any result when it is not wanted any more. The turn ends with the work, not with the
    /// caller, so that callers who leave do not make room for further work before theirs has ended.
    ///
    /// # Errors
    /// [`Panicked`] when `work` panicked.
    pub async fn run<T: Send + 'static>(self, work: impl FnOnce(&Wanted) -> T + Send + 'static) -> Result<T, Panicked> {
        let Self { pool, permits } = self;
        let (found, answer) = oneshot::channel();
        let wanted = Wanted(Arc::new(AtomicBool::new(true)));
        let _wish = Wish(wanted.clone());
        let work = move || {
            let done = catch_unwind(AssertUnwindSafe(|| work(&wanted)));
            drop(permits);
            // Sending fails if the caller was dropped.
            let _ = found.send(done);
        };
        match &**pool {
            Some(pool) => pool.spawn(work),
            None => rayon::spawn(work),
        }
        answer.await.ok().and_then(Result::ok).ok_or(Panicked)
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use futures_util::FutureExt as _;

    use super::*;

    #[tokio::test]
    async fn work_is_given_up_with_its_caller_and_its_turn_ends_with_the_work() {
        let readers = Readers::new(&OF_DETAILS, 10, 1);
        let turn = readers.turn().await.unwrap();
        let (began, begun) = std::sync::mpsc::channel();
        let (go_on, goes_on) = std::sync::mpsc::channel::<()>();
        let (given_up, was_given_up) = oneshot::channel();
        let work = move |wanted: &Wanted| {
            began.send(()).unwrap();
            while wanted.still() {
                std::thread::sleep(Duration::from_millis(1));
            }
            goes_on.recv().unwrap();
            given_up.send(()).unwrap();
        };
        let caller = tokio::spawn(turn.run(work));
        tokio::task::spawn_blocking(move || begun.recv().unwrap()).await.unwrap();
        caller.abort();
        let waiting = readers.clone();
        let mut next = tokio::spawn(async move { drop(waiting.turn().await.unwrap()) });
        let early = tokio::time::timeout(Duration::from_millis(50), &mut next).await;
        assert!(early.is_err(), "the next one waits until the work has ended");
        go_on.send(()).unwrap();
        was_given_up.await.unwrap();
        next.await.unwrap();
    }

    #[tokio::test]
    async fn few_wait_and_those_who_leave_make_room() {
        let readers = Readers::new(&OF_DETAILS, 2, 1);
        let first = readers.turn().await.unwrap();
        let mut second = Box::pin(readers.turn());
        assert!((&mut second).now_or_never().is_none());
        assert!(readers.turn().await.is_err());
        drop(second);
        let mut third = Box::pin(readers.turn());
        assert!((&mut third).now_or_never().is_none(), "there is room for it");
        assert!(first.run(|_| panic!("the work panics")).await.is_err());
        assert_eq!(third.await.unwrap().run(|_| 7).await.unwrap(), 7);
    }
}
