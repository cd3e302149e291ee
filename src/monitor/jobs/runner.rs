//! Runs jobs, and reads and changes the list of them.

use std::collections::BTreeSet;
use std::future::Future;
use std::sync::Arc;

use tokio::task::JoinHandle;
use tracing::{error, info, warn};

use super::by_worker::JobWorkers;
use super::halt::Halt;
use super::queue::{Cancel, JobStatus, Queue};
use crate::baseline::Baseline;
use crate::clock;
use crate::monitor::error::{Error, JobError};
use crate::monitor::events::Events;
use crate::monitor::patience::{is_worth_another, patiently, pause};
use crate::monitor::sharing::Sharing;
use crate::monitor::structures::ActiveStructures;
use crate::monitor::versions::Versions;
use crate::quantity::{shown, Digest, StructureId};
use crate::simulator::Simulator;
use crate::store::{self, DiagnosisTrigger, JobEnd, JobKind, JobRecord, JobState, NewVersion, Store};

/// Result of a job as JSON, with the report of a diagnosis as HTML; or why there is none.
pub(super) type JobOutput = Result<(String, Option<String>), Halt>;

/// Starts jobs and reads their results.
#[derive(Clone)]
pub struct Jobs {
    pub(super) store: Store,
    pub(super) structures: Arc<ActiveStructures>,
    pub(super) versions: Versions,
    pub(super) queue: Queue,
    /// To which computations are left.
    pub(super) workers: JobWorkers,
}

impl Jobs {
    pub(in crate::monitor) fn new(
        store: Store,
        structures: Arc<ActiveStructures>,
        versions: Versions,
        events: Events,
    ) -> Self {
        let queue = Queue::new(events);
        let workers = JobWorkers::new(store.clone(), queue.clone());
        Self { store, structures, versions, queue, workers }
    }

    /// Leaves the computations of jobs to workers from now on.
    pub(in crate::monitor) fn share(&self, sharing: Arc<Sharing>) {
        self.workers.share(sharing);
    }

    /// Runs a job in the background when its turn comes, and stores its end.
    pub(super) fn run(
        &self,
        id: &str,
        structure: &StructureId,
        (kind, trigger): (JobKind, Option<DiagnosisTrigger>),
        work: impl Future<Output = JobOutput> + Send + 'static,
    ) {
        self.queue.add(id, structure, kind, trigger);
        let (jobs, id, name) = (self.clone(), id.to_owned(), kind_name(kind));
        let work = {
            let (jobs, id) = (self.clone(), id.clone());
            async move {
                jobs.workers.turn(&id).await?;
                // Only the ends of the program while it runs count against a job.
                if let Err(failure) = jobs.store.diagnoses().note_begun(&id, kind).await {
                    warn!(job = %id, "Could not note that the {name} {id} has begun: {failure}");
                }
                let output = work.await?;
                jobs.queue.begin_storing(&id)?;
                Ok(output)
            }
        };
        tokio::spawn(async move {
            // In a task of its own, so that a panic does not leave the job in the queue for ever.
            let output = tokio::spawn(work).await.unwrap_or_else(|_| Err(Halt::Failed(format!("the {name} panicked"))));
            let (state, end) = match output {
                Ok(output) => (JobState::Done, JobEnd::Done(output)),
                Err(Halt::Cancelled) => {
                    info!(job = %id, "The {name} {id} was cancelled");
                    (JobState::Cancelled, JobEnd::Cancelled)
                }
                // What is stored stays as it is: the next start finds the job there. What fails while the database is being closed is no
                // failure of the job.
                Err(Halt::Stopping) => return jobs.queue.end(&id, JobState::Waiting),
                Err(Halt::Failed(_)) if jobs.queue.is_stopping() => return jobs.queue.end(&id, JobState::Waiting),
                Err(Halt::Failed(failure)) => {
                    warn!(job = %id, "The {name} {id} failed: {failure}");
                    (JobState::Failed, JobEnd::Failed(failure))
                }
            };
            // The result of hours must not be lost to a disk that is full for minutes.
            let stored = patiently(&jobs.store, "store the end of a job", || store_end(&jobs, &id, kind, end.clone()));
            if let Err(failure) = stored.await {
                error!(job = %id, "Could not store the result of the {name} {id}: {failure}");
            }
            jobs.workers.withdraw(&id, kind).await;
            jobs.queue.end(&id, state);
        });
    }

    /// Jobs of all structures or of some, newest first: those that run or wait, and the newest of the others, together at most `limit`. Each
    /// with what it is doing now if it runs or waits.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn list(
        &self,
        structures: Option<&BTreeSet<StructureId>>,
        limit: usize,
    ) -> Result<Vec<(JobRecord, Option<JobStatus>)>, Error> {
        let records = self.store.diagnoses().jobs(structures, limit).await?;
        let with_status = |mut record: JobRecord| {
            let open = self.queue.holds(&record.id, record.kind);
            let status = open.then(|| self.queue.status(&record.id)).flatten();
            if let Some(status) = &status {
                record.state = if status.waits { JobState::Waiting } else { JobState::Running };
            }
            (record, status)
        };
        Ok(records.into_iter().map(with_status).collect())
    }

    /// Requests the end of a job: at once if it waits, otherwise at its next epoch, cell of the calibration, or step. Whatever happens to the
    /// program before, the job does not begin again.
    ///
    /// # Errors
    /// [`JobError::UnknownJob`] if it neither runs nor waits; [`JobError::ResultIsStored`]; [`Error::Store`] if the request may be forgotten with the
    /// end of the program.
    pub async fn cancel(&self, id: &str) -> Result<(), JobError> {
        // Before it is stored, no other job of this id is stored.
        let _change = self.structures.change().await;
        match self.queue.cancel(id) {
            Cancel::Unknown => Err(JobError::UnknownJob(shown(id))),
            Cancel::TooLate => Err(JobError::ResultIsStored(shown(id))),
            Cancel::Requested(kind) => {
                // Stored before it has ended; until then it is told as running by what the queue holds.
                store_end(self, id, kind, JobEnd::Cancelled).await.map_err(Error::from)?;
                Ok(())
            }
        }
    }

    /// Moves a waiting job before the others.
    ///
    /// # Errors
    /// [`JobError::UnknownJob`] if it neither runs nor waits; [`JobError::NotWaiting`] if it runs.
    pub fn move_to_front(&self, id: &str) -> Result<(), JobError> {
        if self.queue.move_to_front(id) {
            return Ok(());
        }
        Err(match self.queue.status(id) {
            Some(_) => JobError::NotWaiting(shown(id)),
            None => JobError::UnknownJob(shown(id)),
        })
    }

    /// Ends all jobs, because the service stops. They begin again after the next start. The task notes in the
    /// database that this stop is an orderly one.
    pub fn stop(&self) -> JoinHandle<()> {
        self.queue.stop();
        let store = self.store.clone();
        tokio::spawn(async move {
            if let Err(failure) = store.diagnoses().note_orderly_stop().await {
                warn!("Could not note that this stop is an orderly one: {failure}");
            }
        })
    }

    /// What a job is doing now; `None` if it neither runs nor waits.
    pub fn status(&self, id: &str) -> Option<JobStatus> {
        self.queue.status(id)
    }

    /// Whether a job of a structure runs or waits, or no job can be added.
    pub(in crate::monitor) fn is_busy(&self, structure: &StructureId) -> bool {
        !self.queue.of_structure(structure).is_empty() || self.queue.check_room().is_err()
    }

    /// The jobs of a structure that run or wait.
    pub(in crate::monitor) fn of_structure(&self, structure: &StructureId) -> Vec<String> {
        self.queue.of_structure(structure)
    }

    /// Number of jobs that run or wait.
    pub fn running(&self) -> usize {
        self.queue.count()
    }
}

/// Puts a version of a structure into use that a job has made, in place of `expected`; attempted again while the database fails for a
/// moment. Returns the version of the renewed reference.
pub(super) async fn switch(
    jobs: &Jobs,
    expected: &Digest,
    version: NewVersion,
    simulator: Simulator,
    baseline: Arc<Baseline>,
) -> Result<Option<u32>, String> {
    loop {
        let parts = (version.clone(), simulator.clone(), Arc::clone(&baseline));
        match jobs.versions.switch(expected, parts.0, parts.1, parts.2).await {
            Err(Error::Store(error)) if is_worth_another(&error, &jobs.store) => {
                warn!(%error, "Could not put the result of a job into use, trying again: {error}");
                pause().await;
            }
            outcome => return outcome.map_err(|e| e.to_string()),
        }
    }
}

async fn store_end(
    jobs: &Jobs,
    id: &str,
    kind: JobKind,
    end: JobEnd<(String, Option<String>)>,
) -> Result<(), store::Error> {
    let now = clock::now();
    let only_json = match end.clone() {
        JobEnd::Done((json, _)) => JobEnd::Done(json),
        JobEnd::Failed(failure) => JobEnd::Failed(failure),
        JobEnd::Cancelled => JobEnd::Cancelled,
    };
    match kind {
        JobKind::Diagnosis => jobs.store.diagnoses().finish_diagnosis(id, end, now).await?,
        JobKind::Extension => jobs.store.diagnoses().finish_extension(id, only_json, now).await?,
        JobKind::Training => jobs.store.trainings().finish(id, only_json, now).await?,
    }
    Ok(())
}

const fn kind_name(kind: JobKind) -> &'static str {
    match kind {
        JobKind::Diagnosis => "diagnosis",
        JobKind::Extension => "extension by diagnosis",
        JobKind::Training => "training",
    }
}
