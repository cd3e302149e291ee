//! The undamaged references of the structures: made from stored batches, and renewed for another trained baseline.

use std::collections::BTreeSet;
use std::sync::Arc;

use tracing::{info, warn};

use super::assessor::Assessor;
use super::compute::Place;
use super::error::{DeclareError, Error, LeftOutBatch};
use crate::assessment::{BatchState, DoubtfulBatch, Draws, ReferenceBatches, ReferenceError};
use crate::clock;
use crate::damage::{ReferenceOrigin, UndamagedReference};
use crate::quantity::{Digest, StructureId, Timestamp};
use crate::store::{MeasuredBatch, NewReference, ReferenceRecord};

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

/// A reference that is not stored yet.
struct Made {
    state: UndamagedReference,
    model_digest: Digest,
    batches: Vec<String>,
    left_out: Vec<LeftOutBatch>,
    /// The version of which it is the same reference, computed again.
    replaces: Option<u32>,
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

    /// Computes the newest reference of a structure again from its batches, with the trained baseline in use, and those that waiting
    /// batches keep. Batches that cannot be trusted with this trained baseline are left out. Returns the version of the newest; `None`
    /// if it cannot be made.
    ///
    /// # Errors
    /// [`Error::Store`], after which it should be attempted again.
    pub(super) async fn renew(&self, structure: &StructureId) -> Result<Option<u32>, Error> {
        let references = self.assessor.store.reference();
        let Some(newest) = references.undamaged(structure).await? else { return Ok(None) };
        let mut earlier = Vec::new();
        for version in self.kept_of_other_models(structure).await? {
            let kept = references.version(structure, version).await?;
            if let Some(kept) = kept.filter(|kept| kept.state.version != newest.state.version) {
                earlier.extend(self.renewed(structure, &kept).await?);
            }
        }
        let Some(made) = self.renewed(structure, &newest).await? else { return Ok(None) };
        for LeftOutBatch { batch, reason } in earlier.iter().chain([&made]).flat_map(|made| &made.left_out) {
            warn!(structure.id = %structure, batch.id = %batch, "Left batch {batch} out of the undamaged reference of {structure}: {reason}");
        }
        let stored = self.store(structure, earlier, made).await?;
        Ok(Some(stored.state.version))
    }

    /// Versions of other trained baselines than the one in use that waiting batches keep.
    async fn kept_of_other_models(&self, structure: &StructureId) -> Result<Vec<u32>, Error> {
        let baseline = self.assessor.structures.get(structure)?.trained_baseline()?;
        Ok(self.assessor.store.reference().kept_of_other_models(structure, baseline.digest()).await?)
    }

    /// Waiting batches that keep a reference of another trained baseline than the one in use are compared with none.
    ///
    /// # Errors
    /// [`Error::Store`], after which it should be attempted again.
    pub(super) async fn keep_comparable(&self, structure: &StructureId) -> Result<(), Error> {
        let Ok(active) = self.assessor.structures.get(structure) else { return Ok(()) };
        let Ok(baseline) = &active.baseline else { return Ok(()) };
        let batches = self.assessor.store.reference().keep_none_of_other_models(structure, baseline.digest()).await?;
        if batches > 0 {
            warn!(
                structure.id = %structure,
                "{batches} batches of {structure} are not compared with their undamaged reference: it was made with another trained model"
            );
        }
        Ok(())
    }

    /// A reference, computed again from its batches with the trained baseline in use; `None` if it cannot be made.
    async fn renewed(&self, structure: &StructureId, record: &ReferenceRecord) -> Result<Option<Made>, Error> {
        let origin = record.state.origin.clone();
        let declared_at_us = origin.declared_at_us.or(Some(record.created_at.micros()));
        let making = Making {
            leave_out_doubtful: true,
            threshold_probability: record.state.threshold_probability,
            origin: ReferenceOrigin { declared_at_us, ..origin },
            watched_by: None,
        };
        let place = self.assessor.compute.wait().await;
        match self.make(structure, (record.batches.clone(), Vec::new()), making, place).await {
            Ok(made) => Ok(Some(Made { replaces: Some(record.state.version), ..made })),
            Err(DeclareError::Monitor(Error::Store(error))) => Err(error.into()),
            Err(error) => {
                let version = record.state.version;
                warn!(structure.id = %structure, "Could not renew undamaged reference {version} of {structure} with its present trained model: {error}");
                Ok(None)
            }
        }
    }

    /// Makes a reference from stored batches, and stores it. Other batches are compared with it when they are assessed again.
    pub(super) async fn declare(
        &self,
        structure: &StructureId,
        request: ReferenceRequest,
        place: Place,
    ) -> Result<DeclaredReference, DeclareError> {
        let chosen = self.chosen(structure, &request.choice).await?;
        let ReferenceRequest { leave_out_doubtful, threshold_probability, reason, .. } = request;
        let origin = ReferenceOrigin { reason, ..ReferenceOrigin::default() };
        let making = Making { leave_out_doubtful, threshold_probability, origin, watched_by: None };
        let made = self.make(structure, chosen, making, place).await?;
        self.declared(structure, made).await
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
            origin: ReferenceOrigin {
                extends: Some(version),
                first: Some(first),
                reason: request.reason,
                declared_at_us: None,
            },
            watched_by: (!request.despite_alarms).then(|| of_first.into_iter().collect()),
        };
        let all = newest.batches.iter().cloned().chain(added).collect();
        let made = self.make(structure, (all, left_out), making, place).await?;
        self.declared(structure, made).await
    }

    /// Stores a reference that was declared.
    async fn declared(&self, structure: &StructureId, made: Made) -> Result<DeclaredReference, DeclareError> {
        let left_out = made.left_out.clone();
        Ok(DeclaredReference { record: self.store(structure, Vec::new(), made).await?, left_out })
    }

    /// Stores a reference as the newest one, after earlier ones that were made with the same trained baseline, all in one transaction.
    async fn store(
        &self,
        structure: &StructureId,
        earlier: Vec<Made>,
        made: Made,
    ) -> Result<Arc<ReferenceRecord>, Error> {
        let Assessor { store, events, alarms, .. } = &*self.assessor;
        let Made { state, model_digest, batches: batch_ids, left_out, replaces } = made;
        // A trained baseline that was put into use meanwhile has made some of them: they stay what they were.
        let earlier = earlier.into_iter().filter(|made| made.model_digest == model_digest);
        let new = |state, batches, replaces| NewReference { state, batches, replaces };
        let mut all: Vec<NewReference> = earlier.map(|made| new(made.state, made.batches, made.replaces)).collect();
        all.push(new(state.clone(), batch_ids.clone(), replaces));
        let created_at = clock::now();
        let version = store.reference().insert_all_undamaged(structure, all, &model_digest, created_at).await?;
        let (batches, without) = (batch_ids.len(), left_out.len());
        info!(structure.id = %structure, version, "Made undamaged reference {version} of {structure} from {batches} batches, {without} left out");
        alarms.publish_changes(structure).await;
        events.structure_changed(structure);
        // It is returned as it was stored, without reading it from the database, which might fail.
        let state = UndamagedReference { version, ..state };
        Ok(Arc::new(ReferenceRecord { state, model_digest, created_at, batches: batch_ids }))
    }

    /// Makes a reference from chosen batches, beside those that were left out already.
    async fn make(
        &self,
        structure: &StructureId,
        (mut batch_ids, mut left_out): (Vec<String>, Vec<LeftOutBatch>),
        making: Making,
        place: Place,
    ) -> Result<Made, DeclareError> {
        let baseline = self.assessor.structures.get(structure)?.trained_baseline()?;
        let doubtful_already = !left_out.is_empty();
        let mut records = Vec::new();
        for id in &batch_ids {
            records.push(self.assessor.stored(structure, id).await?);
        }
        let drawn: Vec<Draws> =
            records.iter().map(|record| self.assessor.draws(&baseline, &record.content_digest)).collect();
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
                let watched = is_first.map(|first| examined.watched_by(|batch| first[batch], &settings));
                if let Some(Err(error)) = watched {
                    return (Vec::new(), Err(error));
                }
                let state = examined.reference(threshold_probability, &settings);
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
        Ok(Made { state, model_digest, batches: batch_ids, left_out, replaces: None })
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
