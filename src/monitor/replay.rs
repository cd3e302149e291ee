//! Going on with stored batches that wait for their assessment: after a restart, a new baseline, an extension, a new undamaged
//! state.
//!
//! They are computed on all cores and stored in the order of their arrival. What comes out does not depend on the number of
//! threads: each batch has a seed of its own.

use std::pin::pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;
use std::time::Duration;

use futures_util::{stream, StreamExt as _, TryStreamExt as _};
use tracing::{error, warn};

use super::task::{Computed, Settled};
use super::{Error, Monitor};
use crate::assessment::BatchState;
use crate::quantity::StructureId;
use crate::store;

/// Pause between two tries to store what could not be stored, such as on a full disk.
const BETWEEN_TRIES: Duration = Duration::from_secs(2);

/// Batches that are looked up at a time.
const PAGE: usize = 500;

/// What became of a batch that waits.
enum Taken {
    Computed(Box<Computed>),
    /// Somebody else has done it, or it cannot be read.
    Done,
    /// There is no baseline to assess it with.
    NoBaseline,
}

impl Monitor {
    /// Assesses what an earlier run left unassessed, in the background.
    pub fn resume(&self) {
        let structures: Vec<StructureId> = self.lock_read().keys().cloned().collect();
        for structure in structures {
            self.resume_later(structure);
        }
    }

    pub(super) fn resume_later(&self, structure: StructureId) {
        let monitor = self.clone();
        tokio::spawn(async move {
            monitor.retake_undamaged(&structure).await;
            if let Err(error) = monitor.resume_structure(&structure).await {
                error!(structure.id = %structure, %error, "Could not go on with unassessed batches of {structure}: {error}");
                monitor.resume_until_done(structure);
            }
        });
    }

    /// Goes on with unassessed batches until none is left: after a full disk nobody may post them again.
    pub(super) fn resume_until_done(&self, structure: StructureId) {
        if !self.recovering.lock().expect("no holder of this lock panics").insert(structure.clone()) {
            return;
        }
        let monitor = self.clone();
        tokio::spawn(async move {
            loop {
                tokio::time::sleep(BETWEEN_TRIES).await;
                match monitor.resume_structure(&structure).await {
                    Ok(()) => break,
                    Err(_) if monitor.store.file().is_closed() => break,
                    Err(error) => {
                        warn!(structure.id = %structure, %error, "Unassessed batches of {structure} still wait: {error}");
                    }
                }
            }
            monitor.recovering.lock().expect("no holder of this lock panics").remove(&structure);
        });
    }

    pub(super) async fn resume_structure(&self, structure: &StructureId) -> Result<(), Error> {
        // One at a time for each structure: two would assess the same batches.
        let turn = Arc::clone(
            self.resuming.lock().expect("no holder of this lock panics").entry(structure.clone()).or_default(),
        );
        let _turn = turn.lock().await;
        loop {
            let pending = self.store.batches().pending(structure, PAGE).await?;
            if pending.is_empty() || !self.replay(structure, pending).await? {
                return Ok(());
            }
        }
    }

    /// Assesses some batches; false when there is no baseline to assess them with.
    async fn replay(&self, structure: &StructureId, batches: Vec<String>) -> Result<bool, Error> {
        let together = self.compute.places_behind();
        let has_baseline = AtomicBool::new(true);
        let computed = stream::iter(batches).map(|id| self.compute_waiting(structure, id)).buffered(together);
        let stored = computed.map_ok(|taken| {
            // Queued here, and so in the order of the stream, however long each takes from here on.
            let queued = match taken {
                Taken::Computed(computed) => Some(self.store_computed(*computed)),
                Taken::Done => None,
                Taken::NoBaseline => {
                    has_baseline.store(false, Ordering::Relaxed);
                    None
                }
            };
            async move {
                match queued {
                    Some(stored) => stored.await.map(Some),
                    None => Ok(None),
                }
            }
        });
        let mut stored = pin!(stored.try_buffered(together));
        while let Some(stored) = stored.try_next().await? {
            let Some(stored) = stored else { continue };
            if let Settled::GoOn(task) = self.settle(stored).await? {
                self.finish(task).await?;
            }
        }
        Ok(has_baseline.load(Ordering::Relaxed))
    }

    /// Computes the assessment of a batch that waits.
    async fn compute_waiting(&self, structure: &StructureId, batch_id: String) -> Result<Taken, Error> {
        let place = self.compute.wait_behind().await;
        // The version may change at any time: each batch is taken under the present one.
        let watched = self.structure(structure)?;
        if watched.baseline.is_err() {
            return Ok(Taken::NoBaseline);
        }
        let record = match self.stored(structure, &batch_id).await {
            // One damaged row must not keep the batches behind it waiting.
            Err(Error::Store(damaged @ store::Error::Row { .. })) => {
                error!(structure.id = %structure, batch.id = %batch_id, "Batch {batch_id} of {structure}: {damaged}");
                let version = watched.simulator.digest();
                self.store.batches().mark_failed(structure, &batch_id, version, &damaged.to_string()).await?;
                return Ok(Taken::Done);
            }
            record => record?,
        };
        if record.state != BatchState::Received {
            return Ok(Taken::Done);
        }
        let task = self.task(watched, record, place).await?;
        Ok(Taken::Computed(Box::new(self.compute(task).await?)))
    }
}
