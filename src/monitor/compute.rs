//! The bounded queue in front of the processor: computing never runs on the async threads, and never piles up.

use std::panic::{catch_unwind, AssertUnwindSafe};
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use tokio::sync::{oneshot, OwnedSemaphorePermit, Semaphore};

/// How much may be computed and may wait.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ComputeSettings {
    /// Assessments that run at the same time; 0 stands for the number of cores.
    pub threads: usize,
    /// Assessments that may run or wait; one more is answered 503.
    pub queue: usize,
}

impl Default for ComputeSettings {
    fn default() -> Self {
        Self { threads: 0, queue: 64 }
    }
}

/// The queue is full: nothing was stored, try again later.
#[derive(Debug, thiserror::Error)]
#[error("the queue of assessments is full")]
pub struct QueueFull;

/// The computation panicked: a bug.
#[derive(Debug, thiserror::Error)]
#[error("the computation panicked")]
pub struct Panicked;

/// Runs computations on threads of their own, a few at a time.
#[derive(Clone)]
pub struct Compute {
    places: Arc<Semaphore>,
    threads: Arc<Semaphore>,
    /// Places that work behind all other may hold together: enough to keep the threads busy, and few enough that what comes in
    /// meanwhile soon gets a thread.
    behind: Arc<Semaphore>,
    places_behind: usize,
}

/// A place in the queue; given back when dropped.
pub struct Place {
    _place: OwnedSemaphorePermit,
    _behind: Option<OwnedSemaphorePermit>,
    threads: Arc<Semaphore>,
}

impl Compute {
    /// A queue of the given size.
    pub fn new(settings: ComputeSettings) -> Self {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let threads = if settings.threads == 0 { cores } else { settings.threads };
        // A batch that is computed keeps its place until it is stored: twice as many as there are threads.
        let places_behind = (2 * threads).min(settings.queue / 2).max(1);
        Self {
            places: Arc::new(Semaphore::new(settings.queue)),
            threads: Arc::new(Semaphore::new(threads)),
            behind: Arc::new(Semaphore::new(places_behind)),
            places_behind,
        }
    }

    /// Takes a place at once.
    ///
    /// # Errors
    /// [`QueueFull`] when none is free.
    pub fn reserve(&self) -> Result<Place, QueueFull> {
        let place = Arc::clone(&self.places).try_acquire_owned().map_err(|_| QueueFull)?;
        Ok(Place { _place: place, _behind: None, threads: Arc::clone(&self.threads) })
    }

    /// Takes a place, waiting for one: for work whose sender cannot be told to come again.
    pub async fn wait(&self) -> Place {
        let place = Arc::clone(&self.places).acquire_owned().await.expect("the semaphore is never closed");
        Place { _place: place, _behind: None, threads: Arc::clone(&self.threads) }
    }

    /// Takes one of the places for work that nobody waits for, such as what a restart left over.
    pub async fn wait_behind(&self) -> Place {
        let behind = Arc::clone(&self.behind).acquire_owned().await.expect("the semaphore is never closed");
        Place { _behind: Some(behind), ..self.wait().await }
    }

    /// How many such places there are.
    pub fn places_behind(&self) -> usize {
        self.places_behind
    }

    /// Places free now.
    pub fn free(&self) -> usize {
        self.places.available_permits()
    }
}

impl Place {
    /// Runs `work` on a computing thread as soon as one is free.
    ///
    /// # Errors
    /// [`Panicked`] when `work` panicked.
    pub async fn run<T: Send + 'static>(&self, work: impl FnOnce() -> T + Send + 'static) -> Result<T, Panicked> {
        let _thread = self.threads.acquire().await.expect("the semaphore is never closed");
        let (found, answer) = oneshot::channel();
        // Among the threads that its parallel loops share: from any other, each loop would be handed over and waited for.
        rayon::spawn(move || {
            // Whoever asked may be gone.
            let _ = found.send(catch_unwind(AssertUnwindSafe(work)));
        });
        answer.await.ok().and_then(Result::ok).ok_or(Panicked)
    }
}
