//! What a worker says about itself.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Mutex, MutexGuard};
use std::time::{Duration, Instant};

use serde::Serialize;

use crate::monitor::reason::Reason;
use crate::quantity::{Digest, StructureId};

/// After this time a model that was not there is looked for again.
const LOOKED_FOR_AGAIN: Duration = Duration::from_mins(1);

/// What a worker says about itself.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct WorkerHealth {
    /// Whether it can claim computations.
    pub ready: bool,
    /// Why not.
    pub reasons: Vec<Reason>,
    /// What it cannot do.
    pub findings: Vec<Reason>,
    /// The structure whose batches it assesses now.
    pub structure: Option<StructureId>,
    /// Batches assessed since its start.
    pub assessed: u64,
}

/// A model that the worker has not.
struct Lacking {
    structure: StructureId,
    reason: String,
    since: Instant,
}

#[derive(Default)]
struct Known {
    heard: Option<Instant>,
    failure: Option<String>,
    structure: Option<StructureId>,
    assessed: u64,
    lacking: BTreeMap<String, Lacking>,
    /// Jobs that are left to others.
    left: BTreeSet<String>,
}

/// The state of a worker, shared with who asks for it.
pub(super) struct WorkerState {
    lease: Duration,
    known: Mutex<Known>,
}

impl WorkerState {
    pub(super) fn new(lease: Duration) -> Self {
        Self { lease, known: Mutex::default() }
    }

    /// The database has heard of the worker, or could not.
    pub(super) fn heard(&self, heard: Result<(), String>) {
        let mut known = self.known();
        match heard {
            Ok(()) => (known.heard, known.failure) = (Some(Instant::now()), None),
            Err(failure) => known.failure = Some(failure),
        }
    }

    /// What it works at.
    pub(super) fn works_at(&self, structure: Option<&StructureId>) {
        self.known().structure = structure.cloned();
    }

    /// It has delivered results.
    pub(super) fn delivered(&self, results: usize) {
        self.known().assessed += results as u64;
        metrics::counter!("modalwatch_computations_delivered_total").increment(results as u64);
    }

    /// A model is not there. Returns whether this is new.
    pub(super) fn lacks(&self, structure: &StructureId, model: &Digest, reason: String) -> bool {
        let lacking = Lacking { structure: structure.clone(), reason, since: Instant::now() };
        self.known().lacking.insert(model.to_string(), lacking).is_none()
    }

    /// A model is there.
    pub(super) fn has(&self, model: &Digest) {
        self.known().lacking.remove(model.as_str());
    }

    /// Models that are not looked for now.
    pub(super) fn lacking(&self) -> Vec<Digest> {
        let known = self.known();
        let recent = known.lacking.iter().filter(|(_, lacking)| lacking.since.elapsed() < LOOKED_FOR_AGAIN);
        recent.map(|(digest, _)| Digest::from_stored(digest.clone())).collect()
    }

    /// A job is left to others.
    pub(super) fn leaves(&self, job: &str) {
        self.known().left.insert(job.to_owned());
    }

    /// The jobs that are left to others.
    pub(super) fn left(&self) -> Vec<String> {
        self.known().left.iter().cloned().collect()
    }

    /// What it says about itself.
    pub(super) fn health(&self) -> WorkerHealth {
        let known = self.known();
        let ready = known.heard.is_some_and(|at| at.elapsed() < self.lease);
        let reason = || match &known.failure {
            Some(failure) => Reason::new("database_unreachable", failure.clone()),
            None => Reason::new("starting", "the database has not heard of this worker yet"),
        };
        let finding = |(digest, lacking): (&String, &Lacking)| {
            let Lacking { structure, reason, .. } = lacking;
            let message =
                format!("{structure}: its batches are left to others, because the model {digest} is missing: {reason}");
            Reason::new("model_missing", message)
        };
        WorkerHealth {
            ready,
            reasons: if ready { Vec::new() } else { vec![reason()] },
            findings: known.lacking.iter().map(finding).collect(),
            structure: known.structure.clone(),
            assessed: known.assessed,
        }
    }

    fn known(&self) -> MutexGuard<'_, Known> {
        self.known.lock().expect("no holder of this lock panics")
    }
}
