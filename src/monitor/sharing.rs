//! The workers, and sharing the assessment of waiting batches with them: the part of the service that serves the database.
//!
//! While other processes with the same program are heard of, the service offers them pieces of what waits, takes their results in the order
//! of arrival, and stores them as its own. What they do not deliver it computes itself: a batch that is not offered, one whose result was
//! computed from anything else than what would be used now, one whose worker is not heard of any more.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use tracing::info;

use super::computation::Counts;
use super::program::program;
use super::structures::ActiveStructure;
use crate::quantity::StructureId;
use crate::store::{self, Awaited, Computations, ComputedResult, ComputedWith, LiveWorkers, PieceState, Store};

/// Pause between two looks at what the workers have delivered. It doubles with each look that finds no new result: a computation takes from
/// some milliseconds to seconds. Looks at this rate all the time, and a benchmark that read the metrics as often, together took a third of a
/// processor from the workers beside them.
const BETWEEN_LOOKS: Duration = Duration::from_millis(50);

/// The longest pause between two looks.
const LONGEST_BETWEEN_LOOKS: Duration = Duration::from_millis(400);

/// Batches that are looked for at a time.
const WINDOW: usize = 64;

/// How long the number of workers is taken for known.
const KNOWN_FOR: Duration = Duration::from_secs(1);

/// Pause between two offers of what waits.
const BETWEEN_OFFERS: Duration = Duration::from_secs(2);

/// A piece that nobody has claimed for so long although a worker has nothing to do is one that no worker can compute.
const UNCLAIMED: Duration = Duration::from_secs(3);

/// Number of results in a row that do not hold, after which those that are there are not looked at any more: a new reference was declared.
const OUT_OF_DATE: usize = 3;

/// With whom computations are shared.
pub(super) struct Sharing {
    store: Store,
    /// The worker in this process; empty if there is none.
    own: String,
    lease: Duration,
    counts: Counts,
    workers: Mutex<Option<(Instant, LiveWorkers)>>,
    /// Structures of which pieces were offered.
    offered: Mutex<BTreeSet<StructureId>>,
}

/// Waiting batches of a structure, in the order in which they are stored, of which workers compute some.
pub(super) struct SharedPage {
    sharing: Arc<Sharing>,
    structure: StructureId,
    batches: Vec<String>,
    known: tokio::sync::Mutex<Known>,
    taken: Mutex<Vec<String>>,
    /// Number of the last results in a row that did not hold.
    out_of_date: AtomicUsize,
}

/// What is known of the batches of a page.
struct Known {
    awaited: BTreeMap<String, Awaited>,
    looked: Instant,
    /// Pause until the next look.
    pause: Duration,
    offered: Option<Instant>,
}

impl Known {
    /// Whether what is known of a batch has to be read or read again.
    fn is_outdated(&self, batch: &str) -> bool {
        let since = self.looked.elapsed();
        match self.awaited.get(batch) {
            None => true,
            // It may have been offered in the meantime.
            Some(Awaited { result: None, piece: PieceState::NotOffered, .. }) => since >= BETWEEN_LOOKS,
            Some(_) => since >= self.pause,
        }
    }
}

impl Sharing {
    /// Sharing with workers whose leases have a given length; `own` is the worker in this process.
    pub(super) fn new(store: Store, own: String, lease: Duration, counts: Counts) -> Self {
        Self { store, own, lease, counts, workers: Mutex::default(), offered: Mutex::default() }
    }

    /// Removes what an earlier service has left behind and is out of date, and remembers the rest.
    pub(super) async fn tidy(&self) -> Result<(), store::Error> {
        let Some(computations) = Computations::of(&self.store) else { return Ok(()) };
        computations.tidy().await?;
        computations.withdraw_ended_jobs().await?;
        let left = computations.structures().await?;
        self.offered.lock().expect("no holder of this lock panics").extend(left);
        Ok(())
    }

    /// Waiting batches of a structure, as they are shared with the workers, if any come.
    pub(super) fn page(self: &Arc<Self>, structure: &StructureId, batches: &[String]) -> Arc<SharedPage> {
        let known = Known { awaited: BTreeMap::new(), looked: Instant::now(), pause: BETWEEN_LOOKS, offered: None };
        Arc::new(SharedPage {
            sharing: Arc::clone(self),
            structure: structure.clone(),
            batches: batches.to_vec(),
            known: tokio::sync::Mutex::new(known),
            taken: Mutex::default(),
            out_of_date: AtomicUsize::new(0),
        })
    }

    /// Nothing of a structure waits any more.
    pub(super) async fn finish(&self, structure: &StructureId) -> Result<(), store::Error> {
        if let Some(computations) = Computations::of(&self.store).filter(|_| self.has_offered(structure)) {
            computations.withdraw(structure, true).await?;
            self.offered.lock().expect("no holder of this lock panics").remove(structure);
        }
        Ok(())
    }

    /// Whether there may be pieces or results of a structure.
    fn has_offered(&self, structure: &StructureId) -> bool {
        self.offered.lock().expect("no holder of this lock panics").contains(structure)
    }

    /// Offers what waits, to be computed with the trained baseline in use.
    async fn offer(&self, active: &ActiveStructure) -> Result<(), store::Error> {
        let (Some(computations), Ok(baseline)) = (Computations::of(&self.store), &active.baseline) else {
            return Ok(());
        };
        let structure = active.simulator.id();
        let with = ComputedWith {
            program: program().to_owned(),
            structure_digest: active.simulator.digest().clone(),
            model_digest: baseline.digest().clone(),
            draws_per_measurement: self.counts.per_measurement,
            draws_for_population: self.counts.for_population,
        };
        // Each worker has something to do next, and not much more is computed ahead of what is stored.
        let most = 2 * self.workers().await?.others + 2;
        let first = self.offered.lock().expect("no holder of this lock panics").insert(structure.clone());
        if first {
            info!(structure.id = %structure, "Sharing the assessment of the waiting batches of {structure} with other processes");
        }
        computations.offer(structure, &with, most).await
    }

    /// The worker in this process; empty if there is none.
    pub(super) fn own(&self) -> &str {
        &self.own
    }

    /// Number of workers in other processes that live.
    pub(super) async fn others(&self) -> Result<usize, store::Error> {
        Ok(self.workers().await?.others)
    }

    /// The workers that live.
    async fn workers(&self) -> Result<LiveWorkers, store::Error> {
        let known = || self.workers.lock().expect("no holder of this lock panics");
        if let Some((_, workers)) = known().filter(|(at, _)| at.elapsed() < KNOWN_FOR) {
            return Ok(workers);
        }
        let Some(computations) = Computations::of(&self.store) else { return Ok(LiveWorkers::default()) };
        let workers = computations.workers(program(), &self.own, self.lease).await?;
        *known() = Some((Instant::now(), workers));
        Ok(workers)
    }
}

impl SharedPage {
    /// Waits for the result of a batch, as long as a worker computes it or will do so. `None`: it has to be computed here.
    pub(super) async fn result(
        &self,
        active: &ActiveStructure,
        batch: &str,
    ) -> Result<Option<ComputedResult>, store::Error> {
        if self.sharing.workers().await?.others == 0 && !self.sharing.has_offered(&self.structure) {
            return Ok(None);
        }
        loop {
            let mut known = self.known.lock().await;
            if known.is_outdated(batch) {
                self.look(&mut known, active, batch).await?;
            }
            let piece = match known.awaited.get(batch) {
                // The retention has deleted it.
                None => return Ok(None),
                Some(Awaited { result: None, piece, .. }) => *piece,
                Some(_) => {
                    self.taken.lock().expect("no holder of this lock panics").push(batch.to_owned());
                    return Ok(known.awaited.remove(batch).and_then(|awaited| awaited.result));
                }
            };
            drop(known);
            let waits = match piece {
                PieceState::NotOffered => false,
                PieceState::Held => true,
                PieceState::Free(since) => {
                    let workers = self.sharing.workers().await?;
                    workers.others > 0 && (workers.idle == 0 || since < UNCLAIMED)
                }
            };
            if !waits {
                return Ok(None);
            }
            tokio::time::sleep(BETWEEN_LOOKS).await;
        }
    }

    /// Whether the result of a batch held, or was computed from something else than what would be used now.
    pub(super) async fn judge(&self, holds: bool) -> Result<(), store::Error> {
        if holds {
            self.out_of_date.store(0, Ordering::Relaxed);
            return Ok(());
        }
        if self.out_of_date.fetch_add(1, Ordering::Relaxed) + 1 < OUT_OF_DATE {
            return Ok(());
        }
        self.out_of_date.store(0, Ordering::Relaxed);
        self.known.lock().await.awaited.clear();
        match Computations::of(&self.sharing.store) {
            Some(computations) => computations.withdraw(&self.structure, false).await,
            None => Ok(()),
        }
    }

    /// Removes the results that were taken, which are stored now.
    pub(super) async fn forget_taken(&self) -> Result<(), store::Error> {
        let taken = std::mem::take(&mut *self.taken.lock().expect("no holder of this lock panics"));
        match Computations::of(&self.sharing.store) {
            Some(computations) if !taken.is_empty() => computations.remove(&self.structure, &taken).await,
            _ => Ok(()),
        }
    }

    /// Looks at the batches from a given one on, and offers what waits from time to time.
    async fn look(&self, known: &mut Known, active: &ActiveStructure, batch: &str) -> Result<(), store::Error> {
        let Some(computations) = Computations::of(&self.sharing.store) else { return Ok(()) };
        let is_due = known.offered.is_none_or(|at| at.elapsed() >= BETWEEN_OFFERS);
        if is_due && self.sharing.workers().await?.others > 0 {
            known.offered = Some(Instant::now());
            self.sharing.offer(active).await?;
        }
        let from = self.batches.iter().position(|id| id == batch).unwrap_or(0);
        // Those with a result are not read again.
        known.awaited.retain(|_, awaited| awaited.result.is_some());
        let missing = self.batches[from..].iter().filter(|id| !known.awaited.contains_key(*id));
        let asked: Vec<String> = missing.take(WINDOW).cloned().collect();
        let found = computations.awaited(&self.structure, &asked).await?;
        let has_new = found.iter().any(|awaited| awaited.result.is_some());
        known.pause = if has_new { BETWEEN_LOOKS } else { LONGEST_BETWEEN_LOOKS.min(2 * known.pause) };
        known.awaited.extend(found.into_iter().map(|awaited| (awaited.batch_id.clone(), awaited)));
        known.looked = Instant::now();
        Ok(())
    }
}
