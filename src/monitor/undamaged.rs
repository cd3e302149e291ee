//! Declaring batches as the undamaged state.

use std::sync::Arc;

use tracing::{info, warn, Instrument as _};

use super::compute::Place;
use super::{baseline_of, Error, Monitor};
use crate::assessment::{undamaged_state, Draws, ReferenceError};
use crate::quantity::{StructureId, Timestamp};
use crate::store::UndamagedRecord;

impl Monitor {
    /// Takes batches as the undamaged state. Other batches that are compared with none are assessed against it afterwards.
    ///
    /// It runs in a task of its own, as [`Self::ingest`] does.
    ///
    /// # Errors
    /// [`Error::NoModel`], [`Error::UnknownBatch`], [`Error::Assess`] for a batch without a complete measurement,
    /// [`Error::Undamaged`] for too few measurements.
    pub async fn declare_undamaged(
        &self,
        structure: &StructureId,
        batch_ids: Vec<String>,
        threshold_probability: f64,
    ) -> Result<Arc<UndamagedRecord>, Error> {
        let (monitor, structure) = (self.clone(), structure.clone());
        let place = self.compute.reserve()?;
        let declare = async move { monitor.declare_here(&structure, batch_ids, threshold_probability, place).await };
        tokio::spawn(declare.in_current_span()).await.map_err(|_| Error::Panicked)?
    }

    /// Takes the batches of the newest undamaged state as undamaged under the baseline in use, where that state was taken with
    /// another: after a switch of versions, also one that a stop of the service cut short. Batches that are unfit now are left
    /// out. Version of the new state.
    pub(super) async fn retake_undamaged(&self, structure: &StructureId) -> Option<u32> {
        let newest = self.store.undamaged(structure).await.ok()??;
        let watched = self.structure(structure).ok()?;
        let baseline = watched.baseline.as_ref().ok()?;
        let version = self.store.structure_version(structure, watched.simulator.digest()).await.ok()?;
        // A baseline that a person replaced is a person's business: only versions made here are followed.
        if newest.model_digest == *baseline.digest() || version.is_none() {
            return None;
        }
        self.take_again(structure).await
    }

    /// Takes the batches of the newest undamaged state as undamaged under the baseline in use. Version of the new state.
    pub(super) async fn take_again(&self, structure: &StructureId) -> Option<u32> {
        let failed = |error: &dyn std::fmt::Display| {
            warn!(structure.id = %structure, "The undamaged batches of {structure} make no undamaged state with its present baseline: {error}");
        };
        let newest = self.store.undamaged(structure).await.map_err(|e| failed(&e)).ok()??;
        let (mut batches, threshold) = (newest.batches.clone(), newest.state.threshold_probability);
        loop {
            let place = self.compute.wait().await;
            match self.declare_here(structure, batches.clone(), threshold, place).await {
                Ok(record) => return Some(record.state.version),
                Err(Error::UnfitForUndamaged { batch, reason }) if batches.len() > 1 => {
                    warn!(structure.id = %structure, batch.id = %batch, "Left batch {batch} out of the undamaged state of {structure}: {reason}");
                    batches.retain(|id| *id != batch);
                }
                Err(error) => {
                    failed(&error);
                    return None;
                }
            }
        }
    }

    async fn declare_here(
        &self,
        structure: &StructureId,
        batch_ids: Vec<String>,
        threshold_probability: f64,
        place: Place,
    ) -> Result<Arc<UndamagedRecord>, Error> {
        let watched = self.structure(structure)?;
        let baseline = baseline_of(structure, &watched)?;
        let mut records = Vec::new();
        for (index, id) in batch_ids.iter().enumerate() {
            if batch_ids[..index].contains(id) {
                return Err(Error::RepeatedBatch(id.clone()));
            }
            records.push(self.stored(structure, id).await?);
        }
        let drawn: Vec<Draws> = records.iter().map(|record| self.draws(&baseline, record)).collect();
        let model_digest = baseline.digest().clone();
        let (known_limits, settings) = (Arc::clone(&self.known_limits), self.settings.alarm);
        let taken = place
            .run(move || {
                let batches: Vec<_> =
                    records.iter().zip(&drawn).map(|(r, d)| (r.batch.measurements.as_slice(), *d)).collect();
                let state = undamaged_state(&baseline, &batches, threshold_probability)?;
                known_limits.prepare(&baseline, &state, &settings);
                Ok(state)
            })
            .await;
        let state = taken.map_err(|_| Error::Panicked)?.map_err(|error| match error {
            ReferenceError::Assess { batch, source } => Error::Assess { batch: batch_ids[batch].clone(), source },
            ReferenceError::Untrusted { batch, reason } => {
                Error::UnfitForUndamaged { batch: batch_ids[batch].clone(), reason }
            }
            ReferenceError::State(error) => Error::Undamaged(error),
        })?;
        let version =
            self.store.insert_undamaged(structure, &state, &model_digest, &batch_ids, Timestamp::now()).await?;
        let batches = batch_ids.len();
        info!(structure.id = %structure, version, "Took {batches} batches as undamaged state {version} of {structure}");
        self.tell_alarms(structure).await;
        self.tell_structure(structure);
        self.resume_later(structure.clone());
        let stored = self.store.undamaged(structure).await?;
        Ok(stored.expect("it was stored a moment ago and is never deleted"))
    }
}
