//! Assessment of stored batches that wait for it: after a restart, with a new trained baseline, an extension or a new undamaged
//! reference.
//!
//! They are computed on all cores and stored in the order of their arrival. The results do not depend on the number of threads,
//! because each batch has its own seed.

use std::collections::{BTreeMap, BTreeSet};
use std::pin::pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use futures_util::{stream, StreamExt as _, TryStreamExt as _};
use tracing::{error, warn};

use super::assessor::{Assessor, Computed, Finished, Settled};
use super::error::{DeclareError, Error};
use super::own_task::in_own_task;
use super::references::{DeclaredReference, ExtensionRequest, ReferenceRequest, References};
use crate::assessment::BatchState;
use crate::quantity::StructureId;
use crate::store;
use crate::store::archive::ImportedActions;

/// Pause between two attempts to store results that could not be stored, for example on a full disk.
const BETWEEN_ATTEMPTS: Duration = Duration::from_secs(2);

/// Number of waiting batches that are read from the store at a time.
const PAGE: usize = 500;

/// The state of a waiting batch after an attempt to assess it.
enum Waiting {
    Computed(Box<Computed>),
    /// It does not wait any more, or it cannot be read.
    Done,
    /// It waits further: there is no trained baseline to assess it with, or the reference that it keeps is computed again first.
    Later,
}

/// Assesses waiting batches.
#[derive(Clone)]
pub struct Replay {
    assessor: Arc<Assessor>,
    references: Arc<References>,
    /// For each structure, held while its waiting batches are assessed.
    turns: Arc<Mutex<BTreeMap<StructureId, Arc<tokio::sync::Mutex<()>>>>>,
    /// Structures whose waiting batches are attempted repeatedly.
    recovering: Arc<Mutex<BTreeSet<StructureId>>>,
}

impl Replay {
    pub(super) fn new(assessor: Arc<Assessor>, references: Arc<References>) -> Self {
        Self { assessor, references, turns: Arc::default(), recovering: Arc::default() }
    }

    /// Assesses what an earlier run left unassessed, in the background.
    pub fn resume_all(&self) {
        for structure in self.assessor.structures.ids() {
            self.resume_later(structure);
        }
    }

    /// Makes an undamaged reference from stored batches. Other batches without a comparison are compared with it afterwards, in the
    /// background.
    ///
    /// # Errors
    /// [`Error::NoModel`], [`Error::UnknownBatch`], [`DeclareError`].
    pub async fn declare_reference(
        &self,
        structure: &StructureId,
        request: ReferenceRequest,
    ) -> Result<DeclaredReference, DeclareError> {
        let (replay, structure) = (self.clone(), structure.clone());
        let place = self.assessor.compute.reserve().map_err(Error::from)?;
        in_own_task(async move {
            let declared = replay.references.declare(&structure, request, place).await?;
            replay.resume_later(structure);
            Ok(declared)
        })
        .await
    }

    /// Extends the undamaged reference by further batches. Others are compared with it afterwards, in the background.
    ///
    /// # Errors
    /// [`Error::NoModel`], [`Error::UnknownBatch`], [`DeclareError`].
    pub async fn extend_reference(
        &self,
        structure: &StructureId,
        request: ExtensionRequest,
    ) -> Result<DeclaredReference, DeclareError> {
        let (replay, structure) = (self.clone(), structure.clone());
        let place = self.assessor.compute.reserve().map_err(Error::from)?;
        in_own_task(async move {
            let extended = replay.references.extend(&structure, request, place).await?;
            replay.resume_later(structure);
            Ok(extended)
        })
        .await
    }

    /// Renews an outdated reference and assesses the waiting batches of a structure, in the background.
    pub(super) fn resume_later(&self, structure: StructureId) {
        let replay = self.clone();
        tokio::spawn(async move {
            replay.references.renew_if_outdated(&structure).await;
            replay.references.keep_comparable(&structure).await;
            if let Err(error) = replay.resume(&structure).await {
                error!(structure.id = %structure, %error, "Could not assess the waiting batches of {structure}: {error}");
                replay.resume_until_done(structure);
            }
        });
    }

    /// Attempts to assess the waiting batches of a structure until none is left, in the background. This is needed after a full
    /// disk, for example, because their senders may not send them again.
    pub(super) fn resume_until_done(&self, structure: StructureId) {
        if !self.recovering.lock().expect("no holder of this lock panics").insert(structure.clone()) {
            return;
        }
        let replay = self.clone();
        tokio::spawn(async move {
            loop {
                tokio::time::sleep(BETWEEN_ATTEMPTS).await;
                match replay.resume(&structure).await {
                    Ok(_) => break,
                    Err(_) if replay.assessor.store.file().is_closed() => break,
                    Err(error) => {
                        warn!(structure.id = %structure, %error, "Could not assess the waiting batches of {structure}, trying again: {error}");
                    }
                }
            }
            replay.recovering.lock().expect("no holder of this lock panics").remove(&structure);
        });
    }

    /// Assesses the waiting batches of a structure, and then stores what an archive says about their alarms.
    pub(super) async fn resume(&self, structure: &StructureId) -> Result<ImportedActions, Error> {
        // One at a time for each structure: two would assess the same batches.
        let turn =
            Arc::clone(self.turns.lock().expect("no holder of this lock panics").entry(structure.clone()).or_default());
        let _turn = turn.lock().await;
        loop {
            let pending = self.assessor.store.batches().pending(structure, PAGE).await?;
            if pending.is_empty() {
                return Ok(self.assessor.store.archive().settle_actions(structure).await?);
            }
            if !self.assess_all(structure, pending).await? {
                return Ok(ImportedActions::default());
            }
        }
    }

    /// Assesses some batches. Returns false when they have to wait further.
    async fn assess_all(&self, structure: &StructureId, batches: Vec<String>) -> Result<bool, Error> {
        let at_a_time = self.assessor.compute.places_behind();
        let can_proceed = AtomicBool::new(true);
        // Each in a task of its own: a future of this stream that was given a thread is not polled while a batch below is assessed
        // again, and that would wait for the thread for ever.
        let compute = |id: String| {
            let (replay, structure) = (self.clone(), structure.clone());
            in_own_task(async move { replay.compute_waiting(&structure, id).await })
        };
        let computed = stream::iter(batches).map(compute).buffered(at_a_time);
        let stored = computed.map_ok(|waiting| {
            // The write is queued here, and therefore in the order of the stream, however long it takes to complete.
            let queued = match waiting {
                Waiting::Computed(computed) => Some(self.assessor.store_computed(*computed)),
                Waiting::Done => None,
                Waiting::Later => {
                    can_proceed.store(false, Ordering::Relaxed);
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
        let mut stored = pin!(stored.try_buffered(at_a_time));
        while let Some(stored) = stored.try_next().await? {
            let Some(stored) = stored else { continue };
            let finished = match self.assessor.settle(stored).await? {
                Settled::Again(task) => self.assessor.finish(task).await?,
                Settled::Finished(finished) => finished,
            };
            self.resume_if_superseded(structure, &finished);
        }
        Ok(can_proceed.load(Ordering::Relaxed))
    }

    /// Resumes a structure whose version changed while one of its batches was assessed.
    pub(super) fn resume_if_superseded(&self, structure: &StructureId, finished: &Finished) {
        if matches!(finished, Finished::OfAnotherVersion) {
            self.resume_later(structure.clone());
        }
    }

    /// Computes the assessment of a waiting batch.
    async fn compute_waiting(&self, structure: &StructureId, batch_id: String) -> Result<Waiting, Error> {
        let place = self.assessor.compute.wait_behind().await;
        // The version may change at any time: each batch is assessed under the present one.
        let active = self.assessor.structures.get(structure)?;
        let Ok(baseline) = &active.baseline else {
            return Ok(Waiting::Later);
        };
        let record = match self.assessor.stored(structure, &batch_id).await {
            // One damaged row must not block the batches after it.
            Err(Error::Store(damaged @ store::Error::Row { .. })) => {
                error!(structure.id = %structure, batch.id = %batch_id, "Batch {batch_id} of {structure}: {damaged}");
                let version = active.simulator.digest();
                self.assessor.store.batches().mark_failed(structure, &batch_id, version, &damaged.to_string()).await?;
                return Ok(Waiting::Done);
            }
            record => record?,
        };
        if record.state != BatchState::Received {
            return Ok(Waiting::Done);
        }
        if let Some(kept) = record.kept_reference {
            let reference = self.assessor.store.reference().version(structure, kept).await?;
            if reference.is_some_and(|reference| reference.model_digest != *baseline.digest()) {
                return Ok(Waiting::Later);
            }
        }
        let task = self.assessor.task(active, record, place).await?;
        Ok(Waiting::Computed(Box::new(self.assessor.compute(task).await?)))
    }
}
