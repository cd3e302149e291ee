//! A worker: computes assessments and jobs for the service that serves the database.
//!
//! It claims a job (`job`), or else a piece of a history. It computes the batches of the piece that wait, and writes the results some at a time.
//! The claim is renewed while it works; if it is lost, because the worker was suspended for example, what it writes is refused, and it goes on
//! with another piece.

mod job;
mod models;
mod state;

use std::future::Future;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use futures_util::{stream, StreamExt as _};
use tokio::sync::watch;
use tracing::{info, warn};

use self::models::{Missing, WorkerModels};
use self::state::WorkerState;
use super::computation::{Computation, Counts};
use super::compute::{Compute, ComputeSettings};
use super::program::program;
use crate::assessment::BatchState;
use crate::baseline::Baseline;
use crate::clock;
use crate::store::{self, Claim, Computations, ComputedResult, Engine, Store};

pub use self::state::WorkerHealth;

/// Pause after a look for something to do that found nothing.
const IDLE: Duration = Duration::from_millis(500);

/// Pause after an error of the database.
const AFTER_ERROR: Duration = Duration::from_secs(1);

/// Results are written when so many are there …
const AT_A_TIME: usize = 16;

/// … or after this time.
const LONGEST_DELAY: Duration = Duration::from_millis(500);

/// How a worker works.
#[derive(Debug, Clone)]
pub struct WorkerSettings {
    /// Limits of the computations.
    pub compute: ComputeSettings,
    /// How long it may not be heard of before others take over its piece.
    pub lease: Duration,
    /// The user's own models.
    pub models_dir: Option<PathBuf>,
}

/// A worker. Cloning it is cheap.
#[derive(Clone)]
pub struct Worker {
    inner: Arc<Inner>,
}

struct Inner {
    id: String,
    store: Store,
    models: WorkerModels,
    compute: Compute,
    lease: Duration,
    state: WorkerState,
}

/// Why a worker ended its work at a piece.
enum Ended {
    /// Everything is computed.
    Complete,
    /// The piece was claimed by another worker, or is not offered any more.
    Lost,
    /// Its model is missing: it is for other workers.
    Lacking,
    /// The database failed.
    Failed(store::Error),
}

impl Worker {
    /// A worker on the database of a store, which must be one of a server.
    pub fn new(store: Store, settings: WorkerSettings) -> Self {
        let WorkerSettings { compute, lease, models_dir } = settings;
        let inner = Inner {
            id: uuid::Uuid::now_v7().to_string(),
            models: WorkerModels::new(store.clone(), models_dir),
            store,
            compute: Compute::new(compute),
            lease,
            state: WorkerState::new(lease),
        };
        Self { inner: Arc::new(inner) }
    }

    /// Its id.
    pub fn id(&self) -> &str {
        &self.inner.id
    }

    /// The program behind its database, and its version.
    pub fn database(&self) -> (Engine, &str) {
        (self.inner.store.file().engine(), self.inner.store.file().version())
    }

    /// What it says about itself.
    pub fn health(&self) -> WorkerHealth {
        self.inner.state.health()
    }

    /// Works until `stopped` is true or has no sender any more; then gives back what is not finished.
    pub async fn run(self, stopped: watch::Receiver<bool>) {
        let Some(computations) = Computations::of(&self.inner.store) else { return };
        // Reading the program takes a moment.
        if tokio::task::spawn_blocking(program).await.is_err() {
            return;
        }
        info!(worker = self.id(), program = program(), "Computing for the service that serves the database");
        tokio::select! {
            () = self.keep_heard(computations) => {}
            () = self.work(computations, stopped) => {}
        }
        if let Err(error) = computations.leave(&self.inner.id).await {
            warn!(%error, "The database forgets this worker by itself: {error}");
        }
    }

    /// Says again and again that the worker lives.
    async fn keep_heard(&self, computations: Computations<'_>) {
        loop {
            let heard = computations.hear(&self.inner.id, program()).await;
            let failed = heard.is_err();
            self.inner.state.heard(heard.map_err(|error| error.to_string()));
            tokio::time::sleep(if failed { AFTER_ERROR } else { self.inner.lease / 4 }).await;
        }
    }

    async fn work(&self, computations: Computations<'_>, mut stopped: watch::Receiver<bool>) {
        while stopped.has_changed().is_ok() && !*stopped.borrow() {
            let pause = match self.work_at_next(computations, &mut stopped).await {
                Ok(true) => Duration::ZERO,
                Ok(false) => IDLE,
                Err(error) => {
                    warn!(%error, "Could not look for computations, trying again: {error}");
                    AFTER_ERROR
                }
            };
            tokio::select! {
                () = tokio::time::sleep(pause) => {}
                _ = stopped.wait_for(|stopped| *stopped) => {}
            }
        }
    }

    /// Claims the next job, or else the next piece, and works at it. Returns whether there was one.
    async fn work_at_next(
        &self,
        computations: Computations<'_>,
        stopped: &mut watch::Receiver<bool>,
    ) -> Result<bool, store::Error> {
        let Inner { id, lease, state, .. } = &*self.inner;
        if let Some(claim) = computations.claim_job(id, program(), *lease, &state.left()).await? {
            self.work_at_job(computations, &claim, stopped).await;
            return Ok(true);
        }
        let Some(claim) = computations.claim(id, program(), *lease, &state.lacking()).await? else { return Ok(false) };
        self.work_at(computations, &claim, stopped).await;
        Ok(true)
    }

    /// Computes a piece that was claimed, until it is complete or lost, or the worker is to stop.
    async fn work_at(&self, computations: Computations<'_>, claim: &Claim, stopped: &mut watch::Receiver<bool>) {
        let (structure, state) = (&claim.structure, &self.inner.state);
        state.works_at(Some(structure));
        // What is computed and not written yet.
        let page = Mutex::new(Vec::new());
        let ended = tokio::select! {
            ended = self.assess(computations, claim, &page) => Some(ended),
            () = self.keep(computations, claim) => Some(Ended::Lost),
            _ = stopped.wait_for(|stopped| *stopped) => None,
        };
        state.works_at(None);
        let left = page.into_inner().unwrap_or_default();
        let given_back = match ended {
            Some(Ended::Complete) => computations.complete(claim).await,
            Some(Ended::Lost) => {
                metrics::counter!("modalwatch_computations_lost_total").increment(1);
                warn!(structure.id = %structure, fence = claim.fence, "Lost a piece of {structure} to another worker, or it is not needed any more");
                return;
            }
            Some(Ended::Lacking) => computations.release(claim).await,
            Some(Ended::Failed(error)) => {
                warn!(structure.id = %structure, %error, "Gave back a piece of {structure}: {error}");
                computations.release(claim).await
            }
            None => match computations.deliver(claim, &left).await {
                Ok(_) => computations.release(claim).await,
                Err(error) => Err(error),
            },
        };
        if let Err(error) = given_back {
            warn!(structure.id = %structure, %error, "Could not give back a piece of {structure}, whose lease will end by itself: {error}");
        }
    }

    /// Renews a claim; ends when it is lost.
    async fn keep(&self, computations: Computations<'_>, claim: &Claim) {
        loop {
            tokio::time::sleep(self.inner.lease / 4).await;
            // If the database cannot be asked, what is written is refused if the claim was lost.
            if let Ok(false) = computations.renew(claim, self.inner.lease).await {
                return;
            }
        }
    }

    /// Assesses the waiting batches of a piece.
    async fn assess(&self, computations: Computations<'_>, claim: &Claim, page: &Mutex<Vec<ComputedResult>>) -> Ended {
        let (structure, with, state) = (&claim.structure, &claim.with, &self.inner.state);
        let baseline = match self.inner.models.find(structure, &with.structure_digest, &with.model_digest).await {
            Ok(baseline) => baseline,
            Err(Missing::Store(error)) => return Ended::Failed(error),
            Err(Missing::Absent(reason)) => {
                if state.lacks(structure, &with.model_digest, reason.clone()) {
                    warn!(structure.id = %structure, model.digest = %with.model_digest, "The batches of {structure} are left to others, because their model is missing: {reason}");
                }
                return Ended::Lacking;
            }
        };
        state.has(&with.model_digest);
        let batches = match patiently(|| computations.waiting(claim)).await {
            Ok(batches) => batches,
            Err(error) => return Ended::Failed(error),
        };
        let at_a_time = self.inner.compute.places_behind();
        // Each in a task of its own, so that the next is read while one is computed.
        let one = |batch: String| {
            let (worker, claim, baseline) = (self.clone(), claim.clone(), Arc::clone(&baseline));
            tokio::spawn(async move { worker.assess_one(&claim, baseline, batch).await })
        };
        let mut computed = stream::iter(batches).map(one).buffered(at_a_time);
        let mut written = Instant::now();
        let taken = || std::mem::take(&mut *page.lock().expect("no holder of this lock panics"));
        while let Some(result) = computed.next().await {
            let count = {
                let mut page = page.lock().expect("no holder of this lock panics");
                page.extend(result.ok().flatten());
                page.len()
            };
            if count >= AT_A_TIME || written.elapsed() >= LONGEST_DELAY {
                if let Some(ended) = self.deliver(computations, claim, taken()).await {
                    return ended;
                }
                written = Instant::now();
            }
        }
        self.deliver(computations, claim, taken()).await.unwrap_or(Ended::Complete)
    }

    /// Writes results; the reason to end if they are refused.
    async fn deliver(
        &self,
        computations: Computations<'_>,
        claim: &Claim,
        results: Vec<ComputedResult>,
    ) -> Option<Ended> {
        match patiently(|| computations.deliver(claim, &results)).await {
            Ok(true) => self.inner.state.delivered(results.len()),
            Ok(false) => return Some(Ended::Lost),
            Err(error) => return Some(Ended::Failed(error)),
        }
        None
    }

    /// The result of a batch. `None` if it does not wait any more, or if only the service that serves the database can decide what becomes of
    /// it: a damaged row, a reference that has to be computed again first, a result that cannot be written as text, a panic.
    async fn assess_one(&self, claim: &Claim, baseline: Arc<Baseline>, batch: String) -> Option<ComputedResult> {
        let Inner { store, compute, .. } = &*self.inner;
        let (structure, with) = (&claim.structure, &claim.with);
        let place = compute.wait_behind().await;
        let record = patiently(|| store.batches().batch(structure, &batch)).await.ok()??;
        if record.state != BatchState::Received {
            return None;
        }
        let references = store.reference();
        let undamaged = match record.kept_reference {
            Some(kept) => {
                let kept = patiently(|| references.version(structure, kept)).await.ok()?;
                if kept.as_ref().is_some_and(|kept| kept.model_digest != *baseline.digest()) {
                    return None;
                }
                kept
            }
            None => patiently(|| references.undamaged(structure)).await.ok()?,
        };
        let (from, _) = record.batch.time_span();
        let (source, measurements) = (record.batch.source.clone(), record.batch.measurements.len());
        let earlier = patiently(|| store.batches().earlier(structure, &source, (from, measurements))).await.ok()?;
        let counts = Counts { per_measurement: with.draws_per_measurement, for_population: with.draws_for_population };
        let computation = Computation::new(baseline, Arc::new(record), earlier, undamaged, counts);
        let inputs = computation.inputs(program());
        let work = move || match computation.assess(clock::now()) {
            Ok(assessment) => assessment.carried().map(Ok),
            Err(error) => Some(Err(error.to_string())),
        };
        let outcome = place.run(work).await.ok()??;
        Some(ComputedResult { batch_id: batch, inputs, outcome })
    }
}

/// Repeats an operation of the database that fails for a moment.
async fn patiently<T, F>(operation: impl Fn() -> F) -> Result<T, store::Error>
where
    F: Future<Output = Result<T, store::Error>>,
{
    loop {
        match operation().await {
            Err(error) if error.is_temporary() => tokio::time::sleep(AFTER_ERROR).await,
            outcome => return outcome,
        }
    }
}
