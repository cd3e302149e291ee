//! Leaving the computation of jobs to workers: the part of the service that serves the database.

use std::num::NonZeroUsize;
use std::pin::pin;
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};
use tracing::{info, warn};

use super::halt::Halt;
use super::queue::{Queue, Report};
use super::task::Task;
use crate::monitor::patience::patiently;
use crate::monitor::program::program;
use crate::monitor::sharing::Sharing;
use crate::quantity::StructureId;
use crate::store::{self, Computations, JobKind, JobResult, PieceState, SharedJob, Store};

/// Pause between two looks at what a worker is doing.
const BETWEEN_LOOKS: Duration = Duration::from_millis(200);

/// A job that nobody has claimed for so long is computed here: the workers are busy, or none can compute it.
const UNCLAIMED: Duration = Duration::from_secs(5);

/// Pause between two counts of the workers while a job waits for its turn.
const BETWEEN_COUNTS: Duration = Duration::from_secs(1);

/// The workers that compute jobs; none for a database that belongs to one process. Cloning it is cheap.
#[derive(Clone)]
pub(super) struct JobWorkers {
    store: Store,
    queue: Queue,
    sharing: Arc<OnceLock<Arc<Sharing>>>,
    /// One place each for a diagnosis and for a training or extension that is computed in this process.
    here: [Arc<Semaphore>; 2],
}

/// Who computes a job.
pub(super) enum Computer {
    /// A worker, which has delivered this.
    Worker(JobResult),
    /// This process, which has a place for it until this is dropped.
    Here(OwnedSemaphorePermit),
}

impl JobWorkers {
    pub(super) fn new(store: Store, queue: Queue) -> Self {
        let here = [(), ()].map(|()| Arc::new(Semaphore::new(1)));
        Self { store, queue, sharing: Arc::default(), here }
    }

    /// Leaves the computations of jobs to workers from now on.
    pub(super) fn share(&self, sharing: Arc<Sharing>) {
        // A second call changes nothing.
        let _ = self.sharing.set(sharing);
    }

    /// Waits for the turn of a job. As many run at once in each lane of the queue as there are workers in other processes, and at least one.
    ///
    /// # Errors
    /// As [`Queue::turn`].
    pub(super) async fn turn(&self, id: &str) -> Result<(), Halt> {
        let mut turn = pin!(self.queue.turn(id));
        let Some(sharing) = self.sharing.get() else { return turn.await };
        loop {
            // A count that fails is made again, and the last one holds meanwhile.
            if let Ok(others) = sharing.others().await {
                self.queue.run_at_once(NonZeroUsize::new(others).unwrap_or(NonZeroUsize::MIN));
            }
            if let Ok(turn) = tokio::time::timeout(BETWEEN_COUNTS, &mut turn).await {
                return turn;
            }
        }
    }

    /// Has a job computed by a worker in another process, or finds a place in this one; its progress is reported meanwhile.
    ///
    /// An offer stays when the service stops, so that its successor finds what was computed.
    pub(super) async fn compute(
        &self,
        id: &str,
        structure: &StructureId,
        kind: JobKind,
        task: &Task,
    ) -> Result<Computer, Halt> {
        let (Some(sharing), Some(computations)) = (self.sharing.get(), Computations::of(&self.store)) else {
            return self.place_here(id, kind).await;
        };
        let failed = |error: store::Error| Halt::Failed(error.to_string());
        let awaited = || computations.awaited_job(id, kind);
        let look = || async { patiently(&self.store, "look at what a worker computes", awaited).await.map_err(failed) };
        let others = patiently(&self.store, "count the workers", || sharing.others()).await.map_err(failed)?;
        if others == 0 && look().await?.is_none() {
            return self.place_here(id, kind).await;
        }
        let job = SharedJob {
            id: id.to_owned(),
            kind,
            structure: structure.clone(),
            program: program().to_owned(),
            task: serde_json::to_string(task).expect("a task is plain data"),
        };
        let offer = || computations.offer_job(&job, sharing.own());
        patiently(&self.store, "offer a job to workers", offer).await.map_err(failed)?;
        info!(structure.id = %structure, job = %id, "Offered the computation of {id} to workers");
        while let Some(awaited) = look().await? {
            if let Some(result) = awaited.result {
                return Ok(Computer::Worker(result));
            }
            // What a worker said that has given it back, or is not heard of any more, is not what is done now.
            let said = awaited.progress.filter(|_| awaited.state == PieceState::Held);
            let progress = said.and_then(|text| serde_json::from_str::<Report>(&text).ok());
            self.queue.note(id, progress.unwrap_or_else(|| Report::from("waiting for a worker".to_owned())))?;
            let is_unclaimed = matches!(awaited.state, PieceState::Free(since) if since >= UNCLAIMED);
            // Without a place it stays offered: a worker may have finished before.
            if let Some(place) = is_unclaimed.then(|| self.free_place_here(kind)).flatten() {
                self.withdraw(id, kind).await;
                info!(structure.id = %structure, job = %id, "No worker computes {id}: it is computed here");
                return Ok(Computer::Here(place));
            }
            tokio::time::sleep(BETWEEN_LOOKS).await;
        }
        info!(structure.id = %structure, job = %id, "The offer of {id} is gone: it is computed here");
        self.place_here(id, kind).await
    }

    /// Waits until a job can be computed in this process.
    async fn place_here(&self, id: &str, kind: JobKind) -> Result<Computer, Halt> {
        loop {
            if let Some(place) = self.free_place_here(kind) {
                return Ok(Computer::Here(place));
            }
            self.queue.note(id, "waiting for the job that is computed here".to_owned())?;
            tokio::time::sleep(BETWEEN_LOOKS).await;
        }
    }

    fn free_place_here(&self, kind: JobKind) -> Option<OwnedSemaphorePermit> {
        let lane = usize::from(kind != JobKind::Diagnosis);
        Arc::clone(&self.here[lane]).try_acquire_owned().ok()
    }

    /// Withdraws what was left to workers of a job.
    pub(super) async fn withdraw(&self, id: &str, kind: JobKind) {
        let Some(computations) = Computations::of(&self.store).filter(|_| self.sharing.get().is_some()) else { return };
        let withdraw = || computations.withdraw_job(id, kind);
        if let Err(error) = patiently(&self.store, "withdraw a job from workers", withdraw).await {
            warn!(job = %id, %error, "The next start withdraws the job {id} from workers: {error}");
        }
    }
}
