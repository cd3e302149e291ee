//! The undamaged references of the structures: made from stored batches, and renewed for another trained baseline.

use std::collections::BTreeSet;
use std::sync::Arc;

use tracing::{info, warn};

use super::assessor::Assessor;
use super::compute::Place;
use super::error::{DeclareError, Error, LeftOutBatch};
use crate::assessment::{BatchState, DoubtfulBatch, Draws, ReferenceBatches, ReferenceError};
use crate::damage::{ReferenceOrigin, UndamagedReference};
use crate::quantity::{StructureId, Timestamp};
use crate::store::{MeasuredBatch, ReferenceRecord};

/// The batches of an undamaged reference.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ReferenceChoice {
    /// Batches by id.
    Batches(Vec<String>),
    /// The batches whose measurements were all made in a period.
    Period {
        /// Its begin.
        from: Timestamp,
        /// Its end, which is not part of it.
        to: Timestamp,
    },
}

/// A declaration of the undamaged reference.
#[derive(Debug, Clone, PartialEq)]
pub struct ReferenceRequest {
    /// The batches.
    pub choice: ReferenceChoice,
    /// Whether batches that cannot be trusted are left out; otherwise the declaration is refused and all of them are named.
    pub leave_out_doubtful: bool,
    /// Probability that the undamaged structure is below the damage threshold.
    pub threshold_probability: f64,
    /// Why the reference is made, such as a repair.
    pub reason: Option<String>,
}

/// An extension of the newest undamaged reference by further batches.
#[derive(Debug, Clone, PartialEq)]
pub struct ExtensionRequest {
    /// The batches to add.
    pub choice: ReferenceChoice,
    /// Whether batches that cannot be trusted are left out; otherwise the extension is refused and all of them are named.
    pub leave_out_doubtful: bool,
    /// Why the reference is extended.
    pub reason: Option<String>,
    /// Whether batches are accepted during which an alarm was open or a lasting change shows, because an inspection found no damage.
    pub despite_alarms: bool,
}

/// How batches become a reference.
struct Making {
    leave_out_doubtful: bool,
    threshold_probability: f64,
    origin: ReferenceOrigin,
    /// Ids of the batches of the first version, whose charts watch the others; `None` without that test.
    watched_by: Option<BTreeSet<String>>,
}

/// An undamaged reference that was declared.
#[derive(Debug, Clone)]
pub struct DeclaredReference {
    /// The reference as it was stored.
    pub record: Arc<ReferenceRecord>,
    /// The batches that were left out.
    pub left_out: Vec<LeftOutBatch>,
}

/// Makes undamaged references.
pub(super) struct References {
    assessor: Arc<Assessor>,
}

impl References {
    pub(super) fn new(assessor: Arc<Assessor>) -> Self {
        Self { assessor }
    }

    /// Renews the newest reference of a structure if it was made with another trained baseline than the one of the version in use.
    /// This is the case after a switch of versions, including one that was interrupted by a stop of the service. Returns the
    /// version of the new reference.
    ///
    /// # Errors
    /// [`Error::Store`], after which it should be attempted again.
    pub(super) async fn renew_if_outdated(&self, structure: &StructureId) -> Result<Option<u32>, Error> {
        let Assessor { store, structures, .. } = &*self.assessor;
        let Ok(active) = structures.get(structure) else { return Ok(None) };
        let Ok(baseline) = &active.baseline else { return Ok(None) };
        let Some(newest) = store.reference().undamaged(structure).await? else { return Ok(None) };
        if newest.model_digest == *baseline.digest() {
            return Ok(None);
        }
        // Only after a switch to a version made by an extension is the reference renewed automatically; after a trained baseline
        // was replaced, the user decides.
        match store.structures().structure_version(structure, active.simulator.digest()).await? {
            Some(_) => self.renew(structure).await,
            None => Ok(None),
        }
    }

    /// Marks batches to be assessed again that were assessed while another trained baseline than that of the newest reference was in use,
    /// if its own one is in use now.
    ///
    /// # Errors
    /// [`Error::Store`], after which it should be attempted again.
    pub(super) async fn requeue_uncompared(&self, structure: &StructureId) -> Result<(), Error> {
        let Assessor { store, structures, .. } = &*self.assessor;
        let Ok(active) = structures.get(structure) else { return Ok(()) };
        let Ok(baseline) = &active.baseline else { return Ok(()) };
        let newest = store.reference().undamaged(structure).await?;
        if let Some(newest) = newest.filter(|newest| newest.model_digest == *baseline.digest()) {
            store.reference().requeue_uncompared(structure, newest.state.version).await?;
        }
        Ok(())
    }

    /// Computes the newest reference of a structure again from its batches, with the trained baseline in use. Batches that cannot
    /// be trusted with this trained baseline are left out. Returns the version of the new reference; `None` if none can be made.
    ///
    /// # Errors
    /// [`Error::Store`], after which it should be attempted again.
    pub(super) async fn renew(&self, structure: &StructureId) -> Result<Option<u32>, Error> {
        let Some(newest) = self.assessor.store.reference().undamaged(structure).await? else { return Ok(None) };
        let request = ReferenceRequest {
            choice: ReferenceChoice::Batches(newest.batches.clone()),
            leave_out_doubtful: true,
            threshold_probability: newest.state.threshold_probability,
            reason: newest.state.origin.reason.clone(),
        };
        let place = self.assessor.compute.wait().await;
        let origin = newest.state.origin.clone();
        let declared = match self.declare_as(structure, request, origin, place).await {
            Ok(declared) => declared,
            Err(DeclareError::Monitor(Error::Store(error))) => return Err(error.into()),
            Err(error) => {
                warn!(structure.id = %structure, "Could not renew the undamaged reference of {structure} with its present trained model: {error}");
                return Ok(None);
            }
        };
        for LeftOutBatch { batch, reason } in &declared.left_out {
            warn!(structure.id = %structure, batch.id = %batch, "Left batch {batch} out of the undamaged reference of {structure}: {reason}");
        }
        Ok(Some(declared.record.state.version))
    }

    /// Makes a reference from stored batches, and stores it. Other batches are compared with it when they are assessed again.
    pub(super) async fn declare(
        &self,
        structure: &StructureId,
        request: ReferenceRequest,
        place: Place,
    ) -> Result<DeclaredReference, DeclareError> {
        let origin = ReferenceOrigin { reason: request.reason.clone(), ..ReferenceOrigin::default() };
        self.declare_as(structure, request, origin, place).await
    }

    async fn declare_as(
        &self,
        structure: &StructureId,
        request: ReferenceRequest,
        origin: ReferenceOrigin,
        place: Place,
    ) -> Result<DeclaredReference, DeclareError> {
        let chosen = self.chosen(structure, &request.choice).await?;
        let ReferenceRequest { leave_out_doubtful, threshold_probability, .. } = request;
        let making = Making { leave_out_doubtful, threshold_probability, origin, watched_by: None };
        self.make(structure, chosen, making, place).await
    }

    /// Extends the newest reference by further batches, and stores the result as the next version.
    pub(super) async fn extend(
        &self,
        structure: &StructureId,
        request: ExtensionRequest,
        place: Place,
    ) -> Result<DeclaredReference, DeclareError> {
        let references = self.assessor.store.reference();
        let newest = references.undamaged(structure).await?;
        let newest = newest.ok_or_else(|| DeclareError::NothingToExtend(structure.clone()))?;
        let (version, origin) = (newest.state.version, &newest.state.origin);
        let (mut added, mut left_out) = self.chosen(structure, &request.choice).await?;
        added.retain(|id| !newest.batches.contains(id));
        let first = origin.first.unwrap_or(version);
        if !request.despite_alarms {
            for (batch, alarm) in references.alarms_during(structure, first, &added).await? {
                added.retain(|id| *id != batch);
                let reason = format!("it was measured while damage alarm {alarm} was open");
                left_out.push(LeftOutBatch { batch, reason });
            }
        }
        if added.is_empty() {
            return Err(DeclareError::NothingNew { version, left_out });
        }
        let of_first = references.batches_of(structure, first).await?;
        let making = Making {
            leave_out_doubtful: request.leave_out_doubtful,
            threshold_probability: newest.state.threshold_probability,
            origin: ReferenceOrigin { extends: Some(version), first: Some(first), reason: request.reason },
            watched_by: (!request.despite_alarms).then(|| of_first.into_iter().collect()),
        };
        let all = newest.batches.iter().cloned().chain(added).collect();
        self.make(structure, (all, left_out), making, place).await
    }

    /// Makes a reference from chosen batches, beside those that were left out already, and stores it.
    async fn make(
        &self,
        structure: &StructureId,
        (mut batch_ids, mut left_out): (Vec<String>, Vec<LeftOutBatch>),
        making: Making,
        place: Place,
    ) -> Result<DeclaredReference, DeclareError> {
        let Assessor { store, structures, events, alarms, .. } = &*self.assessor;
        let baseline = structures.get(structure)?.trained_baseline()?;
        let doubtful_already = !left_out.is_empty();
        let mut records = Vec::new();
        for id in &batch_ids {
            records.push(self.assessor.stored(structure, id).await?);
        }
        let drawn: Vec<Draws> = records.iter().map(|record| self.assessor.draws(&baseline, record)).collect();
        let model_digest = baseline.digest().clone();
        let settings = self.assessor.settings.alarm;
        let known_limits = Arc::clone(&self.assessor.known_limits);
        let Making { leave_out_doubtful, threshold_probability, origin, watched_by } = making;
        let first = origin.first.unwrap_or_default();
        let is_first: Option<Vec<bool>> =
            watched_by.map(|first| batch_ids.iter().map(|id| first.contains(id)).collect());
        let made = place
            .run(move || {
                let batches: Vec<_> =
                    records.iter().zip(&drawn).map(|(r, d)| (r.batch.measurements.as_slice(), *d)).collect();
                let examined = match ReferenceBatches::examine(&baseline, &batches) {
                    Ok(examined) => examined,
                    Err(error) => return (Vec::new(), Err(error)),
                };
                let doubtful = examined.doubtful().to_vec();
                if !leave_out_doubtful && (doubtful_already || !doubtful.is_empty()) {
                    return (Vec::new(), Err(ReferenceError::Doubtful(doubtful)));
                }
                let watched =
                    is_first.map(|first| examined.watched_by(|batch| first[batch], settings.mean_run_batches));
                if let Some(Err(error)) = watched {
                    return (Vec::new(), Err(error));
                }
                let state = examined.reference(threshold_probability, settings.mean_run_batches);
                // The charts of a process have limits of their own.
                if let Some(state) = state.as_ref().ok().filter(|state| state.process.is_none()) {
                    known_limits.prepare(&baseline, state, &settings);
                }
                (doubtful, state.map(|state| UndamagedReference { origin, ..state }))
            })
            .await;
        let (doubtful, state) = made.map_err(|_| Error::Panicked)?;
        let with_id =
            |DoubtfulBatch { batch, reason }: DoubtfulBatch| LeftOutBatch { batch: batch_ids[batch].clone(), reason };
        let doubtful: Vec<LeftOutBatch> = doubtful.into_iter().map(with_id).collect();
        let batches = batch_ids.len() + left_out.len();
        let state = state.map_err(|error| match error {
            ReferenceError::Assess { batch, source } => {
                DeclareError::Assess { batch: batch_ids[batch].clone(), source }
            }
            ReferenceError::Doubtful(found) => {
                let doubtful = left_out.iter().cloned().chain(found.into_iter().map(with_id)).collect();
                DeclareError::Doubtful { batches, doubtful }
            }
            ReferenceError::LastingChange(change) => DeclareError::Loss { first, change: change.sentence() },
            ReferenceError::State(source) => {
                DeclareError::Reference { source, left_out: [left_out.clone(), doubtful.clone()].concat() }
            }
        })?;
        batch_ids.retain(|id| doubtful.iter().all(|left_out| left_out.batch != *id));
        left_out.extend(doubtful);
        let created_at = Timestamp::now();
        let version =
            store.reference().insert_undamaged(structure, &state, &model_digest, &batch_ids, created_at).await?;
        let (batches, without) = (batch_ids.len(), left_out.len());
        info!(structure.id = %structure, version, "Made undamaged reference {version} of {structure} from {batches} batches, {without} left out");
        alarms.publish_changes(structure).await;
        events.structure_changed(structure);
        // It is returned as it was stored, without reading it from the database, which might fail.
        let state = UndamagedReference { version, ..state };
        let record = Arc::new(ReferenceRecord { state, model_digest, created_at, batches: batch_ids });
        Ok(DeclaredReference { record, left_out })
    }

    /// The ids of the chosen batches, and those that cannot be used whatever they contain.
    async fn chosen(
        &self,
        structure: &StructureId,
        choice: &ReferenceChoice,
    ) -> Result<(Vec<String>, Vec<LeftOutBatch>), DeclareError> {
        let (from, to) = match choice {
            ReferenceChoice::Batches(ids) => {
                let repeated = ids.iter().enumerate().find(|(index, id)| ids[..*index].contains(id));
                return match repeated {
                    Some((_, id)) => Err(DeclareError::RepeatedBatch(id.clone())),
                    None => Ok((ids.clone(), Vec::new())),
                };
            }
            ReferenceChoice::Period { from, to } => (*from, *to),
        };
        let found = self.assessor.store.reference().batches_in(structure, from, to).await?;
        if found.is_empty() {
            return Err(DeclareError::EmptyPeriod { from, to });
        }
        let (mut ids, mut left_out) = (Vec::new(), Vec::new());
        for batch in found {
            match unsuitable(&batch, from, to) {
                Some(reason) => left_out.push(LeftOutBatch { batch: batch.batch_id, reason }),
                None => ids.push(batch.batch_id),
            }
        }
        Ok((ids, left_out))
    }
}

/// Why a batch cannot be part of the undamaged reference of a period, if this is known before its measurements are examined.
fn unsuitable(batch: &MeasuredBatch, from: Timestamp, to: Timestamp) -> Option<String> {
    if batch.measured_from < from || batch.measured_to >= to {
        return Some(format!(
            "it was measured from {} to {}, which is only in part in the period",
            batch.measured_from, batch.measured_to
        ));
    }
    if let Some(reason) = &batch.maintenance {
        return Some(format!("it was measured during maintenance: {reason}"));
    }
    match (batch.state, batch.assessed) {
        (BatchState::Failed, _) => {
            Some(format!("its assessment failed: {}", batch.failure.as_deref().unwrap_or("the reason is not known")))
        }
        (_, false) => Some("it has no assessment yet".to_owned()),
        (_, true) => None,
    }
}
