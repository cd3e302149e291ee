//! The jobs that run or wait: their order, their progress, and requests to end them.
//!
//! There are two lanes: short jobs (diagnoses) never wait behind long ones (trainings and extensions). In each lane one job runs at a time,
//! or as many as there are workers in other processes ([`Queue::run_at_once`]), but only one of a structure.
//!
//! A job that computes is ended cooperatively: [`Queue::report`], which it calls at each epoch, cell or step, unwinds its thread with
//! [`Halt`] when somebody cancelled it or when the service stops.

use std::collections::BTreeMap;
use std::num::NonZeroUsize;
use std::panic::resume_unwind;
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use tokio::sync::Notify;

use super::halt::Halt;
use crate::monitor::error::JobError;
use crate::monitor::events::{Events, News};
use crate::quantity::StructureId;
use crate::store::{DiagnosisTrigger, JobKind, JobState};

/// Largest number of jobs that run or wait, for each that may run at once in a lane.
const MOST_JOBS: usize = 16;

/// Least time between two events about the same job.
const BETWEEN_EVENTS: Duration = Duration::from_millis(200);

/// What a job is doing now.
#[derive(Debug, Clone, PartialEq)]
pub struct JobStatus {
    /// Whether it waits for its turn.
    pub waits: bool,
    /// Its place among the waiting jobs of its lane, from 1; `None` for one that runs.
    pub place: Option<usize>,
    /// What it is doing, in words.
    pub progress: String,
    /// The share that is done, 0 to 1, where it is known.
    pub share: Option<f64>,
    /// Estimated time left, s, where there is something to estimate it from.
    pub time_left_s: Option<f64>,
}

/// What a job that computes reports.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Report {
    pub(super) what: String,
    pub(super) share: Option<f64>,
    pub(super) time_left_s: Option<f64>,
}

impl From<String> for Report {
    fn from(what: String) -> Self {
        Self { what, ..Self::default() }
    }
}

/// The jobs that run or wait, by id; cloning gives a handle on the same jobs.
#[derive(Clone)]
pub(super) struct Queue {
    jobs: Arc<Mutex<Jobs>>,
    changed: Arc<Notify>,
    events: Events,
}

struct Jobs {
    by_id: BTreeMap<String, QueuedJob>,
    /// Rank of the next job; a job with a smaller rank has its turn earlier.
    next_rank: i64,
    /// Largest number of jobs that run in a lane.
    at_once: usize,
    stopping: bool,
}

impl Default for Jobs {
    fn default() -> Self {
        Self { by_id: BTreeMap::new(), next_rank: 0, at_once: 1, stopping: false }
    }
}

/// A job that runs or waits.
struct QueuedJob {
    structure: StructureId,
    kind: JobKind,
    trigger: Option<DiagnosisTrigger>,
    rank: i64,
    runs: bool,
    cancelled: bool,
    /// Whether what it has computed is being stored, after which it cannot be ended any more.
    stores: bool,
    report: Report,
    published: Option<Instant>,
}

/// What a request to end a job comes upon.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Cancel {
    /// A job that runs or waits: it ends.
    Requested(JobKind),
    /// A job whose result is being stored.
    TooLate,
    /// No such job.
    Unknown,
}

impl QueuedJob {
    const fn is_long(&self) -> bool {
        matches!(self.kind, JobKind::Training | JobKind::Extension)
    }
}

impl Jobs {
    /// The id of the job that has the next turn in a lane, unless as many as may run there do so. A job of a structure of which one runs
    /// there waits for its end, because that may put another version of the structure into use.
    fn next(&self, long: bool) -> Option<&String> {
        let lane = || self.by_id.iter().filter(|(_, job)| job.is_long() == long);
        let running: Vec<&StructureId> = lane().filter(|(_, job)| job.runs).map(|(_, job)| &job.structure).collect();
        if running.len() >= self.at_once {
            return None;
        }
        let may_run = lane().filter(|(_, job)| !job.runs && !running.contains(&&job.structure));
        may_run.min_by_key(|(_, job)| job.rank).map(|(id, _)| id)
    }

    fn status(&self, id: &str) -> Option<JobStatus> {
        let job = self.by_id.get(id)?;
        let before = |other: &&QueuedJob| !other.runs && other.is_long() == job.is_long() && other.rank < job.rank;
        let place = (!job.runs).then(|| 1 + self.by_id.values().filter(before).count());
        let Report { what, share, time_left_s } = job.report.clone();
        Some(JobStatus { waits: !job.runs, place, progress: what, share, time_left_s })
    }

    fn event(&self, id: &str, ended: Option<JobState>) -> Option<News> {
        let job = self.by_id.get(id)?;
        let status = self.status(id).filter(|_| ended.is_none());
        let state = ended.unwrap_or(if job.runs { JobState::Running } else { JobState::Waiting });
        Some(News::Job {
            job: id.to_owned(),
            structure: job.structure.clone(),
            kind: job.kind,
            state,
            progress: status.as_ref().map(|status| status.progress.clone()),
            share: status.as_ref().and_then(|status| status.share),
            time_left_s: status.as_ref().and_then(|status| status.time_left_s),
            place: status.and_then(|status| status.place),
            trigger: job.trigger,
        })
    }
}

impl Queue {
    pub(super) fn new(events: Events) -> Self {
        Self { jobs: Arc::default(), changed: Arc::default(), events }
    }

    /// Adds a job that waits, behind all others. `trigger` is the reason of the start of a diagnosis.
    pub(super) fn add(&self, id: &str, structure: &StructureId, kind: JobKind, trigger: Option<DiagnosisTrigger>) {
        let mut jobs = self.lock();
        let rank = jobs.next_rank;
        jobs.next_rank += 1;
        let report = Report::from("waiting".to_owned());
        let structure = structure.clone();
        let (runs, cancelled, stores) = (false, false, false);
        let job = QueuedJob { structure, kind, trigger, rank, runs, cancelled, stores, report, published: None };
        jobs.by_id.insert(id.to_owned(), job);
        self.publish(&jobs, id, None);
    }

    /// Waits for the turn of a job.
    ///
    /// # Errors
    /// [`Halt`] when it is cancelled before, or when the service stops.
    pub(super) async fn turn(&self, id: &str) -> Result<(), Halt> {
        loop {
            let changed = self.changed.notified();
            tokio::pin!(changed);
            // A change between the look and the wait is not missed.
            changed.as_mut().enable();
            {
                let mut jobs = self.lock();
                if jobs.stopping {
                    return Err(Halt::Stopping);
                }
                let Some(job) = jobs.by_id.get(id) else { return Err(Halt::Cancelled) };
                if job.cancelled {
                    return Err(Halt::Cancelled);
                }
                if jobs.next(job.is_long()).is_some_and(|next| next == id) {
                    if let Some(job) = jobs.by_id.get_mut(id) {
                        job.runs = true;
                        job.report = Report::from("starting".to_owned());
                    }
                    self.publish(&jobs, id, None);
                    drop(jobs);
                    // There may be a turn for the next one, too.
                    self.changed.notify_waiters();
                    return Ok(());
                }
            }
            changed.await;
        }
    }

    /// Sets the largest number of jobs that run at once in each lane.
    pub(super) fn run_at_once(&self, jobs: NonZeroUsize) {
        let more = {
            let mut queue = self.lock();
            let before = std::mem::replace(&mut queue.at_once, jobs.get());
            before < jobs.get()
        };
        if more {
            self.changed.notify_waiters();
        }
    }

    /// Notes what a job that computes is doing now. Only for the thread that [`computed`] awaits: it is unwound when the job shall end.
    pub(super) fn report(&self, id: &str, report: impl Into<Report>) {
        if let Err(halt) = self.note(id, report) {
            resume_unwind(Box::new(halt));
        }
    }

    /// Notes what a job is doing now.
    ///
    /// # Errors
    /// [`Halt`] when it was cancelled, or when the service stops.
    pub(super) fn note(&self, id: &str, report: impl Into<Report>) -> Result<(), Halt> {
        let mut jobs = self.lock();
        let stopping = jobs.stopping;
        let Some(job) = jobs.by_id.get_mut(id) else { return Ok(()) };
        job.report = report.into();
        // A report that is not published is superseded by the next one or by the end of the job.
        let due = job.published.is_none_or(|published| published.elapsed() >= BETWEEN_EVENTS);
        let cancelled = job.cancelled;
        if due {
            job.published = Some(Instant::now());
            self.publish(&jobs, id, None);
        }
        match (cancelled, stopping) {
            (true, _) => Err(Halt::Cancelled),
            (false, true) => Err(Halt::Stopping),
            (false, false) => Ok(()),
        }
    }

    /// A job has computed its result, which is stored from now on: it cannot be ended any more.
    ///
    /// # Errors
    /// [`Halt::Cancelled`] when its end was requested before.
    pub(super) fn begin_storing(&self, id: &str) -> Result<(), Halt> {
        let mut jobs = self.lock();
        let Some(job) = jobs.by_id.get_mut(id) else { return Ok(()) };
        if job.cancelled {
            return Err(Halt::Cancelled);
        }
        job.stores = true;
        drop(jobs);
        Ok(())
    }

    /// Requests the end of a job.
    pub(super) fn cancel(&self, id: &str) -> Cancel {
        let mut jobs = self.lock();
        let Some(job) = jobs.by_id.get_mut(id) else { return Cancel::Unknown };
        if job.stores {
            return Cancel::TooLate;
        }
        let kind = job.kind;
        job.cancelled = true;
        if job.runs {
            "ending, as requested".clone_into(&mut job.report.what);
            job.report.time_left_s = None;
        }
        self.publish(&jobs, id, None);
        drop(jobs);
        self.changed.notify_waiters();
        Cancel::Requested(kind)
    }

    /// Moves a waiting job before the others. Returns false if it does not wait.
    pub(super) fn move_to_front(&self, id: &str) -> bool {
        let mut jobs = self.lock();
        let first = jobs.by_id.values().map(|job| job.rank).min().unwrap_or(0);
        let Some(job) = jobs.by_id.get_mut(id).filter(|job| !job.runs) else { return false };
        job.rank = first - 1;
        let waiting: Vec<String> = jobs.by_id.iter().filter(|(_, job)| !job.runs).map(|(id, _)| id.clone()).collect();
        for id in &waiting {
            self.publish(&jobs, id, None);
        }
        drop(jobs);
        self.changed.notify_waiters();
        true
    }

    /// Ends all jobs, because the service stops.
    pub(super) fn stop(&self) {
        self.lock().stopping = true;
        self.changed.notify_waiters();
    }

    /// Whether the service stops.
    pub(super) fn is_stopping(&self) -> bool {
        self.lock().stopping
    }

    /// Removes a job that has ended.
    pub(super) fn end(&self, id: &str, state: JobState) {
        let mut jobs = self.lock();
        self.publish(&jobs, id, Some(state));
        jobs.by_id.remove(id);
        drop(jobs);
        self.changed.notify_waiters();
    }

    /// Number of jobs that run or wait.
    pub(super) fn count(&self) -> usize {
        self.lock().by_id.len()
    }

    /// Checks that a job can be added. Only while [`ActiveStructures::change`](crate::monitor::structures::ActiveStructures::change) is held, so that
    /// requests that come together do not all find the last place free.
    ///
    /// # Errors
    /// [`JobError::TooManyJobs`].
    pub(super) fn check_room(&self) -> Result<(), JobError> {
        let most = MOST_JOBS * self.lock().at_once;
        if self.count() >= most {
            return Err(JobError::TooManyJobs(most));
        }
        Ok(())
    }

    /// The jobs of a structure that run or wait.
    pub(super) fn of_structure(&self, structure: &StructureId) -> Vec<String> {
        let jobs = self.lock();
        let of_it = jobs.by_id.iter().filter(|(_, job)| job.structure == *structure);
        of_it.map(|(id, _)| id.clone()).collect()
    }

    /// The training of a structure that runs or waits.
    pub(super) fn training_of(&self, structure: &StructureId) -> Option<String> {
        let jobs = self.lock();
        let found = jobs.by_id.iter().find(|(_, job)| job.structure == *structure && job.kind == JobKind::Training);
        found.map(|(id, _)| id.clone())
    }

    /// Whether a job of this id and kind runs or waits; an extension has the id of its diagnosis.
    pub(super) fn holds(&self, id: &str, kind: JobKind) -> bool {
        self.lock().by_id.get(id).is_some_and(|job| job.kind == kind)
    }

    /// The state of a job as people see it: one whose end is stored has not ended before it is out of the queue.
    pub(super) fn seen_state(&self, id: &str, kind: JobKind, stored: JobState) -> JobState {
        let ended = !matches!(stored, JobState::Running | JobState::Waiting);
        if ended && self.holds(id, kind) {
            JobState::Running
        } else {
            stored
        }
    }

    /// What a job is doing now; `None` if it neither runs nor waits.
    pub(super) fn status(&self, id: &str) -> Option<JobStatus> {
        self.lock().status(id)
    }

    fn publish(&self, jobs: &Jobs, id: &str, ended: Option<JobState>) {
        if let Some(event) = jobs.event(id, ended) {
            self.events.publish(event);
        }
    }

    fn lock(&self) -> MutexGuard<'_, Jobs> {
        self.jobs.lock().expect("no holder of this lock panics")
    }
}

#[cfg(test)]
mod tests {
    use super::super::halt::computed;
    use super::*;

    fn queue() -> Queue {
        Queue::new(Events::default())
    }

    fn add(queue: &Queue, id: &str, kind: JobKind) {
        queue.add(id, &StructureId::parse("bridge").unwrap(), kind, None);
    }

    /// Whether a job gets its turn without waiting.
    async fn has_turn(queue: &Queue, id: &str) -> bool {
        tokio::time::timeout(Duration::from_millis(20), queue.turn(id)).await.is_ok_and(|turn| turn.is_ok())
    }

    #[tokio::test]
    async fn a_short_job_does_not_wait_behind_a_long_one_and_long_ones_run_in_order() {
        let queue = queue();
        for (id, kind) in [("t1", JobKind::Training), ("x2", JobKind::Extension), ("d3", JobKind::Diagnosis)] {
            add(&queue, id, kind);
        }
        add(&queue, "t4", JobKind::Training);
        assert!(!has_turn(&queue, "x2").await, "t1 is before it");
        assert!(has_turn(&queue, "t1").await);
        assert!(has_turn(&queue, "d3").await, "a diagnosis has a lane of its own");
        let place = |id: &str| queue.status(id).unwrap().place;
        assert_eq!([place("t1"), place("x2"), place("t4")], [None, Some(1), Some(2)]);
        assert!(queue.move_to_front("t4"));
        assert_eq!([place("x2"), place("t4")], [Some(2), Some(1)]);
        assert!(!queue.move_to_front("t1"), "it runs");
        assert!(!has_turn(&queue, "t4").await, "t1 still runs");
        queue.end("t1", JobState::Done);
        assert!(!has_turn(&queue, "x2").await, "t4 was moved before it");
        assert!(has_turn(&queue, "t4").await);
    }

    #[tokio::test]
    async fn with_workers_several_jobs_run_at_once_but_one_of_a_structure() {
        let queue = queue();
        for (id, structure) in [("t1", "a"), ("x2", "a"), ("t3", "b"), ("t4", "c")] {
            let kind = if id == "x2" { JobKind::Extension } else { JobKind::Training };
            queue.add(id, &StructureId::parse(structure).unwrap(), kind, None);
        }
        assert!(has_turn(&queue, "t1").await);
        assert!(!has_turn(&queue, "t3").await, "one at a time");
        let waiting = tokio::spawn({
            let queue = queue.clone();
            async move { queue.turn("t3").await }
        });
        queue.run_at_once(NonZeroUsize::new(2).unwrap());
        assert_eq!(waiting.await.unwrap(), Ok(()), "x2 is before it, and waits for t1 of the same structure");
        assert!(!has_turn(&queue, "t4").await, "two at a time");
        queue.end("t1", JobState::Done);
        assert!(!has_turn(&queue, "t4").await, "x2 is before it");
        assert!(has_turn(&queue, "x2").await);
        // A worker leaves: those that run go on, and no further one begins before there is room for it.
        queue.run_at_once(NonZeroUsize::MIN);
        queue.end("t3", JobState::Done);
        assert!(!has_turn(&queue, "t4").await, "x2 runs");
        queue.end("x2", JobState::Done);
        assert!(has_turn(&queue, "t4").await);
    }

    #[tokio::test]
    async fn a_cancelled_job_ends_at_once_where_it_waits_and_at_its_next_report_where_it_computes() {
        let queue = queue();
        add(&queue, "t1", JobKind::Training);
        add(&queue, "t2", JobKind::Training);
        queue.turn("t1").await.unwrap();
        let waiting = tokio::spawn({
            let queue = queue.clone();
            async move { queue.turn("t2").await }
        });
        tokio::time::sleep(Duration::from_millis(10)).await;
        assert_eq!(queue.cancel("t2"), Cancel::Requested(JobKind::Training));
        assert_eq!(queue.cancel("unknown"), Cancel::Unknown);
        assert_eq!(waiting.await.unwrap(), Err(Halt::Cancelled));

        let (handle, (reported, reports)) = (queue.clone(), std::sync::mpsc::channel());
        let work = tokio::spawn(computed("training", move || -> Result<(), String> {
            loop {
                handle.report("t1", "epoch".to_owned());
                let _ = reported.send(());
                std::thread::sleep(Duration::from_millis(1));
            }
        }));
        tokio::task::spawn_blocking(move || reports.recv().unwrap()).await.unwrap();
        assert_eq!(queue.cancel("t1"), Cancel::Requested(JobKind::Training));
        assert_eq!(work.await.unwrap(), Err(Halt::Cancelled));
        assert_eq!(queue.begin_storing("t1"), Err(Halt::Cancelled), "also where it had computed everything meanwhile");
        assert_eq!(queue.begin_storing("t2"), Err(Halt::Cancelled));
        add(&queue, "t3", JobKind::Training);
        assert_eq!(queue.begin_storing("t3"), Ok(()));
        assert_eq!(queue.cancel("t3"), Cancel::TooLate, "what is being stored is not ended half-way");
    }

    #[tokio::test]
    async fn a_stop_ends_jobs_that_wait_and_jobs_that_compute_and_a_panic_is_a_failure() {
        let queue = queue();
        add(&queue, "t1", JobKind::Training);
        queue.turn("t1").await.unwrap();
        add(&queue, "t2", JobKind::Training);
        queue.stop();
        assert_eq!(queue.turn("t2").await, Err(Halt::Stopping));
        let handle = queue.clone();
        let ended = computed("training", move || -> Result<(), String> {
            // As from within a parallel loop.
            rayon::join(|| handle.report("t1", "epoch".to_owned()), || ());
            Err("it went on".to_owned())
        });
        assert_eq!(ended.await, Err(Halt::Stopping));
        let failed = computed::<()>("training", || panic!("on purpose"));
        assert_eq!(failed.await, Err(Halt::Failed("the training panicked".to_owned())));
    }
}
