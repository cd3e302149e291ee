//! The progress of the jobs that run or wait.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use crate::monitor::events::{Events, News};
use crate::quantity::StructureId;
use crate::store::{DiagnosisTrigger, JobKind, JobState};

/// Least time between two events about the same job.
const BETWEEN_EVENTS: Duration = Duration::from_millis(200);

/// The jobs that run or wait, by id; cloning gives a handle on the same jobs.
#[derive(Clone)]
pub(super) struct Progress {
    running: Arc<Mutex<BTreeMap<String, RunningJob>>>,
    events: Events,
}

/// A job that runs or waits.
struct RunningJob {
    structure: StructureId,
    kind: JobKind,
    trigger: Option<DiagnosisTrigger>,
    progress: String,
    published: Option<Instant>,
}

impl RunningJob {
    fn event(&self, id: &str, state: JobState) -> News {
        let (job, structure) = (id.to_owned(), self.structure.clone());
        let progress = (state == JobState::Running).then(|| self.progress.clone());
        News::Job { job, structure, kind: self.kind, state, progress, trigger: self.trigger }
    }
}

impl Progress {
    pub(super) fn new(events: Events) -> Self {
        Self { running: Arc::default(), events }
    }

    /// Adds a job that waits: a diagnosis with the reason of its start, or an extension.
    pub(super) fn begin(&self, id: &str, structure: &StructureId, kind: JobKind, trigger: Option<DiagnosisTrigger>) {
        let job = RunningJob { structure: structure.clone(), kind, trigger, progress: String::new(), published: None };
        self.lock().insert(id.to_owned(), job);
        self.report(id, "waiting");
    }

    /// Notes what a job is doing now.
    pub(super) fn report(&self, id: &str, what: impl Into<String>) {
        let mut running = self.lock();
        let Some(job) = running.get_mut(id) else { return };
        job.progress = what.into();
        // A report that is not published is superseded by the next one or by the end of the job.
        if job.published.is_none_or(|published| published.elapsed() >= BETWEEN_EVENTS) {
            job.published = Some(Instant::now());
            self.events.publish(job.event(id, JobState::Running));
        }
    }

    /// Removes a job that has ended.
    pub(super) fn end(&self, id: &str, state: JobState) {
        if let Some(job) = self.lock().remove(id) {
            self.events.publish(job.event(id, state));
        }
    }

    /// Number of jobs that run or wait.
    pub(super) fn count(&self) -> usize {
        self.lock().len()
    }

    /// Whether a job of a structure runs or waits.
    pub(super) fn has(&self, structure: &StructureId) -> bool {
        self.lock().values().any(|job| job.structure == *structure)
    }

    /// What a job is doing now.
    pub(super) fn of(&self, id: &str) -> Option<String> {
        self.lock().get(id).map(|job| job.progress.clone())
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<String, RunningJob>> {
        self.running.lock().expect("no holder of this lock panics")
    }
}
