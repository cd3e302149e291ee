//! The undamaged references of the structures: made from stored batches, and renewed for another trained baseline.

use std::sync::Arc;

use tracing::{info, warn};

use super::assessor::Assessor;
use super::compute::Place;
use super::error::{DeclareError, Error};
use crate::assessment::{undamaged_reference, Draws, ReferenceError};
use crate::quantity::{StructureId, Timestamp};
use crate::store::ReferenceRecord;

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
    pub(super) async fn renew_if_outdated(&self, structure: &StructureId) -> Option<u32> {
        let Assessor { store, structures, .. } = &*self.assessor;
        let newest = store.reference().undamaged(structure).await.ok()??;
        let active = structures.get(structure).ok()?;
        let baseline = active.baseline.as_ref().ok()?;
        let version = store.structures().structure_version(structure, active.simulator.digest()).await.ok()?;
        // Only after a switch to a version made by an extension is the reference renewed automatically; after a trained baseline
        // was replaced, the user decides.
        if newest.model_digest == *baseline.digest() || version.is_none() {
            return None;
        }
        self.renew(structure).await
    }

    /// Computes the newest reference of a structure again from its batches, with the trained baseline in use. Batches that cannot
    /// be trusted with this trained baseline are left out. Returns the version of the new reference.
    pub(super) async fn renew(&self, structure: &StructureId) -> Option<u32> {
        let failed = |error: &dyn std::fmt::Display| {
            warn!(structure.id = %structure, "Could not renew the undamaged reference of {structure} with its present trained baseline: {error}");
        };
        let newest = self.assessor.store.reference().undamaged(structure).await.map_err(|e| failed(&e)).ok()??;
        let (mut batches, threshold) = (newest.batches.clone(), newest.state.threshold_probability);
        loop {
            let place = self.assessor.compute.wait().await;
            match self.declare(structure, batches.clone(), threshold, place).await {
                Ok(record) => return Some(record.state.version),
                Err(DeclareError::Untrusted { batch, reason }) if batches.len() > 1 => {
                    warn!(structure.id = %structure, batch.id = %batch, "Left batch {batch} out of the undamaged reference of {structure}: {reason}");
                    batches.retain(|id| *id != batch);
                }
                Err(error) => {
                    failed(&error);
                    return None;
                }
            }
        }
    }

    /// Makes a reference from stored batches, and stores it. Other batches are compared with it when they are assessed again.
    pub(super) async fn declare(
        &self,
        structure: &StructureId,
        batch_ids: Vec<String>,
        threshold_probability: f64,
        place: Place,
    ) -> Result<Arc<ReferenceRecord>, DeclareError> {
        let Assessor { store, structures, events, alarms, .. } = &*self.assessor;
        let baseline = structures.get(structure)?.trained_baseline()?;
        let mut records = Vec::new();
        for (index, id) in batch_ids.iter().enumerate() {
            if batch_ids[..index].contains(id) {
                return Err(DeclareError::RepeatedBatch(id.clone()));
            }
            records.push(self.assessor.stored(structure, id).await?);
        }
        let drawn: Vec<Draws> = records.iter().map(|record| self.assessor.draws(&baseline, record)).collect();
        let model_digest = baseline.digest().clone();
        let (known_limits, settings) = (Arc::clone(&self.assessor.known_limits), self.assessor.settings.alarm);
        let made = place
            .run(move || {
                let batches: Vec<_> =
                    records.iter().zip(&drawn).map(|(r, d)| (r.batch.measurements.as_slice(), *d)).collect();
                let state = undamaged_reference(&baseline, &batches, threshold_probability)?;
                known_limits.prepare(&baseline, &state, &settings);
                Ok(state)
            })
            .await;
        let state = made.map_err(|_| Error::Panicked)?.map_err(|error| match error {
            ReferenceError::Assess { batch, source } => {
                DeclareError::Assess { batch: batch_ids[batch].clone(), source }
            }
            ReferenceError::Untrusted { batch, reason } => {
                DeclareError::Untrusted { batch: batch_ids[batch].clone(), reason }
            }
            ReferenceError::State(error) => DeclareError::Reference(error),
        })?;
        let version =
            store.reference().insert_undamaged(structure, &state, &model_digest, &batch_ids, Timestamp::now()).await?;
        let batches = batch_ids.len();
        info!(structure.id = %structure, version, "Made undamaged reference {version} of {structure} from {batches} batches");
        alarms.publish_changes(structure).await;
        events.structure_changed(structure);
        let stored = store.reference().undamaged(structure).await?;
        Ok(stored.expect("it was stored a moment ago and is never deleted"))
    }
}
