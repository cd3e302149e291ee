//! Leaving the computation of jobs to workers: the part of the service that serves the database.

use std::sync::{Arc, OnceLock};
use std::time::Duration;

use tracing::{info, warn};

use super::queue::{Halt, Queue, Report};
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

/// The workers that compute jobs; none for a database that belongs to one process. Cloning it is cheap.
#[derive(Clone)]
pub(super) struct JobWorkers {
    store: Store,
    queue: Queue,
    sharing: Arc<OnceLock<Arc<Sharing>>>,
}

impl JobWorkers {
    pub(super) fn new(store: Store, queue: Queue) -> Self {
        Self { store, queue, sharing: Arc::default() }
    }

    /// Leaves the computations of jobs to workers from now on.
    pub(super) fn share(&self, sharing: Arc<Sharing>) {
        // A second call changes nothing.
        let _ = self.sharing.set(sharing);
    }

    /// Has a job computed by a worker in another process; its progress is reported meanwhile. `None`: it has to be computed here.
    ///
    /// An offer stays when the service stops, so that its successor finds what was computed.
    pub(super) async fn compute(
        &self,
        id: &str,
        structure: &StructureId,
        kind: JobKind,
        task: &Task,
    ) -> Result<Option<JobResult>, Halt> {
        let (Some(sharing), Some(computations)) = (self.sharing.get(), Computations::of(&self.store)) else {
            return Ok(None);
        };
        let failed = |error: store::Error| Halt::Failed(error.to_string());
        let awaited = || computations.awaited_job(id, kind);
        let look = || async { patiently(&self.store, "look at what a worker computes", awaited).await.map_err(failed) };
        let others = patiently(&self.store, "count the workers", || sharing.others()).await.map_err(failed)?;
        if others == 0 && look().await?.is_none() {
            return Ok(None);
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
            if awaited.result.is_some() {
                return Ok(awaited.result);
            }
            let progress = awaited.progress.and_then(|text| serde_json::from_str::<Report>(&text).ok());
            self.queue.note(id, progress.unwrap_or_else(|| Report::from("waiting for a worker".to_owned())))?;
            if matches!(awaited.state, PieceState::Free(since) if since >= UNCLAIMED) {
                self.withdraw(id, kind).await;
                break;
            }
            tokio::time::sleep(BETWEEN_LOOKS).await;
        }
        info!(structure.id = %structure, job = %id, "No worker computes {id}: it is computed here");
        Ok(None)
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
