//! The bounded queue of assessments. Computations never run on the async threads, and their number is limited.
//!
//! What nobody waits for, such as the assessment of stored batches, runs on threads of its own with a lower priority of the scheduler. New
//! batches find the compute threads free and take the processors from it; without new batches it uses them whole.

use std::panic::{catch_unwind, AssertUnwindSafe};
use std::sync::{Arc, LazyLock};

use serde::{Deserialize, Serialize};
use tokio::sync::{oneshot, OwnedSemaphorePermit, Semaphore};

use crate::fault::carried;
use crate::store::WritePriority;

/// Limits of the queue of assessments.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ComputeSettings {
    /// Assessments that run at the same time; 0 = the number of cores.
    pub threads: usize,
    /// Assessments that may run or wait; further ones are refused with 503.
    pub queue: usize,
}

impl Default for ComputeSettings {
    fn default() -> Self {
        Self { threads: 0, queue: 64 }
    }
}

/// By how much threads for low-priority work are nicer than others: beside a busy thread of the service one gets a tenth of a processor.
const NICENESS: i32 = 10;

/// Threads for low-priority work, as many as there are others.
static BULK_THREADS: LazyLock<rayon::ThreadPool> = LazyLock::new(|| {
    rayon::ThreadPoolBuilder::new()
        .num_threads(rayon::current_num_threads())
        .thread_name(|number| format!("bulk-{number}"))
        .start_handler(|_| lower_priority())
        .build()
        .expect("the system has room for some more threads")
});

/// Lowers the priority of the present thread. Where the system knows only the priority of processes, it stays as it is.
fn lower_priority() {
    if cfg!(target_os = "linux") {
        // Refused, the thread competes with the others on equal terms.
        let _ = rustix::process::setpriority_process(None, NICENESS);
    }
}

/// The queue is full: nothing was stored, try again later.
#[derive(Debug, thiserror::Error)]
#[error("the queue of assessments is full")]
pub struct QueueFull;

/// The computation panicked, which is a programming error.
#[derive(Debug, thiserror::Error)]
#[error("the computation panicked")]
pub struct Panicked;

/// Runs computations on the compute threads, a limited number at a time.
#[derive(Clone)]
pub struct Compute {
    places: Arc<Semaphore>,
    threads: Arc<Semaphore>,
    bulk_threads: Arc<Semaphore>,
    /// Places for low-priority work: enough to keep the threads busy, and few enough that new batches soon get a thread.
    behind: Arc<Semaphore>,
    places_behind: usize,
}

/// A place in the queue, released when dropped.
pub struct Place {
    _place: OwnedSemaphorePermit,
    /// Of low-priority work.
    behind: Option<OwnedSemaphorePermit>,
    threads: Arc<Semaphore>,
}

impl Compute {
    /// A queue of the given size.
    pub fn new(settings: ComputeSettings) -> Self {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let threads = if settings.threads == 0 { cores } else { settings.threads };
        // A computed batch keeps its place until it is stored, hence twice the number of threads.
        let places_behind = (2 * threads).min(settings.queue / 2).max(1);
        Self {
            places: Arc::new(Semaphore::new(settings.queue)),
            threads: Arc::new(Semaphore::new(threads)),
            bulk_threads: Arc::new(Semaphore::new(threads)),
            behind: Arc::new(Semaphore::new(places_behind)),
            places_behind,
        }
    }

    /// Reserves a place in the queue without waiting.
    ///
    /// # Errors
    /// [`QueueFull`] when none is free.
    pub fn reserve(&self) -> Result<Place, QueueFull> {
        let place = Arc::clone(&self.places).try_acquire_owned().map_err(|_| QueueFull)?;
        Ok(Place { _place: place, behind: None, threads: Arc::clone(&self.threads) })
    }

    /// Waits for a place in the queue. For batches whose sender cannot be asked to repeat the request.
    pub async fn wait(&self) -> Place {
        let place = Arc::clone(&self.places).acquire_owned().await.expect("the semaphore is never closed");
        Place { _place: place, behind: None, threads: Arc::clone(&self.threads) }
    }

    /// Waits for one of the places for low-priority work, such as what was left unassessed before a restart.
    pub async fn wait_behind(&self) -> Place {
        let behind = Arc::clone(&self.behind).acquire_owned().await.expect("the semaphore is never closed");
        let threads = Arc::clone(&self.bulk_threads);
        Place { behind: Some(behind), threads, ..self.wait().await }
    }

    /// Number of places for low-priority work.
    pub fn places_behind(&self) -> usize {
        self.places_behind
    }

    /// Number of free places in the queue.
    pub fn free(&self) -> usize {
        self.places.available_permits()
    }
}

impl Place {
    /// The priority of writing what is computed in this place.
    pub(super) const fn priority(&self) -> WritePriority {
        match self.behind {
            Some(_) => WritePriority::Bulk,
            None => WritePriority::Prompt,
        }
    }

    /// Runs `work` on a compute thread as soon as one is free.
    ///
    /// # Errors
    /// [`Panicked`] when `work` panicked.
    pub async fn run<T: Send + 'static>(&self, work: impl FnOnce() -> T + Send + 'static) -> Result<T, Panicked> {
        let _thread = self.threads.acquire().await.expect("the semaphore is never closed");
        let (found, answer) = oneshot::channel();
        // `work` runs on the thread pool of rayon, which its parallel loops use: a loop that starts on another thread would first
        // have to be handed over to the pool.
        let work = carried(move || {
            // Sending fails if the caller was dropped.
            let _ = found.send(catch_unwind(AssertUnwindSafe(work)));
        });
        match self.behind {
            Some(_) => BULK_THREADS.spawn(work),
            None => rayon::spawn(work),
        }
        answer.await.ok().and_then(Result::ok).ok_or(Panicked)
    }
}
