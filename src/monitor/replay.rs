//! Assessment of stored batches that wait for it: after a restart, with a new trained baseline, an extension or a new undamaged
//! reference.
//!
//! They are computed on all cores, and by workers if there are any (`sharing`), and stored in the order of their arrival. The results do not
//! depend on who computes them, because each batch has its own seed.

use std::collections::{BTreeMap, BTreeSet};
use std::pin::pin;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::Duration;

use futures_util::{stream, StreamExt as _, TryStreamExt as _};
use tracing::{error, warn};

use super::assessor::{Assessor, Computed, Finished, Settled, Task};
use super::computation::Counts;
use super::error::{DeclareError, Error};
use super::own_task::in_own_task;
use super::patience::pause;
use super::program::program;
use super::references::{DeclaredReference, ExtensionRequest, ReferenceRequest, References};
use super::sharing::{SharedPage, Sharing};
use crate::assessment::BatchState;
use crate::quantity::StructureId;
use crate::store;
use crate::store::archive::ImportedActions;

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
    /// Structures whose waiting batches are attempted repeatedly, each with whether this was requested again meanwhile.
    recovering: Arc<Mutex<BTreeMap<StructureId, bool>>>,
    /// Structures for which batches without a comparison are looked for at the next attempt.
    unexamined: Arc<Mutex<BTreeSet<StructureId>>>,
    /// With which workers waiting batches are shared; empty for a database that belongs to one process.
    sharing: Arc<OnceLock<Arc<Sharing>>>,
}

impl Replay {
    pub(super) fn new(assessor: Arc<Assessor>, references: Arc<References>) -> Self {
        Self {
            assessor,
            references,
            turns: Arc::default(),
            recovering: Arc::default(),
            unexamined: Arc::default(),
            sharing: Arc::default(),
        }
    }

    /// Shares waiting batches with workers from now on; `own` is the worker in this process, and `lease` is how long they may not be heard of.
    ///
    /// # Errors
    /// [`Error::Store`] if what an earlier service has left behind cannot be removed.
    pub(super) async fn share(&self, own: String, lease: Duration) -> Result<Arc<Sharing>, Error> {
        let sharing = Sharing::new(self.assessor.store.clone(), own, lease, Counts::of(&self.assessor.settings));
        sharing.tidy().await?;
        // Reading the program takes a moment.
        tokio::task::spawn_blocking(program).await.map_err(|_| Error::Panicked)?;
        // A second call changes nothing.
        Ok(Arc::clone(self.sharing.get_or_init(|| Arc::new(sharing))))
    }

    /// Assesses what an earlier run left unassessed, in the background.
    pub fn resume_all(&self) {
        for structure in self.assessor.structures.ids() {
            self.resume_with_baseline(structure);
        }
    }

    /// As [`Self::resume_later`], behind a trained baseline that was put into use: batches that were assessed while another one was in use
    /// may now be comparable with the reference.
    pub(super) fn resume_with_baseline(&self, structure: StructureId) {
        self.unexamined.lock().expect("no holder of this lock panics").insert(structure.clone());
        self.resume_later(structure);
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
            let declared = replay.references.declare(&structure, request, place).await;
            replay.resume_behind(structure, &declared);
            declared
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
            let extended = replay.references.extend(&structure, request, place).await;
            replay.resume_behind(structure, &extended);
            extended
        })
        .await
    }

    /// Assesses what waits for a comparison with a reference that was made or, if the store failed, may have been.
    fn resume_behind(&self, structure: StructureId, made: &Result<DeclaredReference, DeclareError>) {
        if matches!(made, Ok(_) | Err(DeclareError::Monitor(Error::Store(_)))) {
            self.resume_later(structure);
        }
    }

    /// Renews an outdated reference and assesses the waiting batches of a structure, in the background.
    pub(super) fn resume_later(&self, structure: StructureId) {
        let replay = self.clone();
        tokio::spawn(async move {
            if let Err(error) = replay.renew_and_resume(&structure).await {
                error!(structure.id = %structure, %error, "Could not assess the waiting batches of {structure}: {error}");
                replay.resume_until_done(structure);
            }
        });
    }

    /// Attempts to assess the waiting batches of a structure until none is left, in the background. This is needed after a full
    /// disk, for example, because their senders may not send them again.
    pub(super) fn resume_until_done(&self, structure: StructureId) {
        {
            let mut recovering = self.recovering.lock().expect("no holder of this lock panics");
            if let Some(again) = recovering.get_mut(&structure) {
                // The attempt that runs now may have read what waits before the batch of this request was stored.
                *again = true;
                return;
            }
            recovering.insert(structure.clone(), false);
        }
        let replay = self.clone();
        tokio::spawn(async move {
            loop {
                pause().await;
                match replay.renew_and_resume(&structure).await {
                    Ok(_) => {
                        let mut recovering = replay.recovering.lock().expect("no holder of this lock panics");
                        if recovering.insert(structure.clone(), false) != Some(true) {
                            recovering.remove(&structure);
                            return;
                        }
                    }
                    Err(_) if replay.assessor.store.file().is_closed() => return,
                    Err(error) => {
                        warn!(structure.id = %structure, %error, "Could not assess the waiting batches of {structure}, trying again: {error}");
                    }
                }
            }
        });
    }

    /// Follows a switch of versions that was stored without being put into use, renews an outdated reference and assesses the waiting
    /// batches; in a task of its own, so that a panic is an error.
    async fn renew_and_resume(&self, structure: &StructureId) -> Result<ImportedActions, Error> {
        let (replay, structure) = (self.clone(), structure.clone());
        in_own_task(async move {
            replay.assessor.structures.follow_stored(&structure).await?;
            replay.references.renew_if_outdated(&structure).await?;
            replay.references.keep_comparable(&structure).await?;
            let unexamined = || replay.unexamined.lock().expect("no holder of this lock panics");
            let examines = unexamined().remove(&structure);
            if examines {
                let examined = replay.references.requeue_uncompared(&structure).await;
                examined.inspect_err(|_| {
                    unexamined().insert(structure.clone());
                })?;
            }
            replay.resume(&structure).await
        })
        .await
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
                if let Some(sharing) = self.sharing.get() {
                    sharing.finish(structure).await?;
                }
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
        let page = self.sharing.get().map(|sharing| sharing.page(structure, &batches));
        let can_proceed = AtomicBool::new(true);
        // Each in a task of its own: a future of this stream that was given a thread is not polled while a batch below is assessed
        // again, and that would wait for the thread for ever.
        let compute = |id: String| {
            let (replay, structure, page) = (self.clone(), structure.clone(), page.clone());
            in_own_task(async move { replay.compute_waiting(&structure, id, page.as_deref()).await })
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
        if let Some(page) = &page {
            page.forget_taken().await?;
        }
        Ok(can_proceed.load(Ordering::Relaxed))
    }

    /// Resumes a structure whose version, or what was measured before one of its batches, changed while that was assessed.
    pub(super) fn resume_if_superseded(&self, structure: &StructureId, finished: &Finished) {
        if matches!(finished, Finished::Superseded) {
            self.resume_later(structure.clone());
        }
    }

    /// Computes the assessment of a waiting batch, unless a worker has done it.
    async fn compute_waiting(
        &self,
        structure: &StructureId,
        batch_id: String,
        page: Option<&SharedPage>,
    ) -> Result<Waiting, Error> {
        let shared = match page {
            Some(page) => {
                let active = self.assessor.structures.get(structure)?;
                page.result(&active, &batch_id).await?.map(|result| (page, result))
            }
            None => None,
        };
        let place = self.assessor.compute.wait_behind().await;
        // The version may change at any time: each batch is assessed under the present one.
        let active = self.assessor.structures.get(structure)?;
        let Ok(baseline) = &active.baseline else {
            return Ok(Waiting::Later);
        };
        let record = match self.assessor.stored(structure, &batch_id).await {
            // Retention has deleted it meanwhile.
            Err(Error::UnknownBatch { .. }) => return Ok(Waiting::Done),
            // One damaged row must not block the batches after it. Any other error may pass, and the batch is attempted again.
            Err(Error::Store(damaged @ store::Error::Row { .. })) => {
                error!(structure.id = %structure, batch.id = %batch_id, "Batch {batch_id} of {structure}: {damaged}");
                let version = active.simulator.digest();
                let (batches, reason) = (self.assessor.store.batches(), damaged.to_string());
                let failed = batches.mark_failed(structure, &batch_id, version, &reason, place.priority());
                if failed.await?.is_some_and(|failed| failed.alarm_opened) {
                    self.assessor.alarms.report(structure).await;
                }
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
        let mut task = Task::new(active, record, place)?;
        if let Some((page, result)) = shared {
            let taken = self.assessor.take(task, result, program()).await?;
            page.judge(taken.is_ok()).await?;
            match taken {
                Ok(computed) => return Ok(Waiting::Computed(Box::new(computed))),
                Err(given_back) => task = given_back,
            }
        }
        Ok(Waiting::Computed(Box::new(self.assessor.compute(task).await?)))
    }
}
