//! Declaring batches as the undamaged state.

use tracing::{info, Instrument as _};

use super::assess::{self, Draws, UndamagedError};
use super::{baseline_of, Error, Monitor};
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
    ) -> Result<UndamagedRecord, Error> {
        let (monitor, structure) = (self.clone(), structure.clone());
        let declare = async move { monitor.declare_here(&structure, batch_ids, threshold_probability).await };
        tokio::spawn(declare.in_current_span()).await.map_err(|_| Error::Panicked)?
    }

    async fn declare_here(
        &self,
        structure: &StructureId,
        batch_ids: Vec<String>,
        threshold_probability: f64,
    ) -> Result<UndamagedRecord, Error> {
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
        let place = self.compute.reserve()?;
        let taken = place
            .run(move || {
                let batches: Vec<_> =
                    records.iter().zip(&drawn).map(|(r, d)| (r.batch.measurements.as_slice(), *d)).collect();
                assess::undamaged_state(&baseline, &batches, threshold_probability)
            })
            .await;
        let state = taken.map_err(|_| Error::Panicked)?.map_err(|error| match error {
            UndamagedError::Assess { batch, source } => Error::Assess { batch: batch_ids[batch].clone(), source },
            UndamagedError::Untrusted { batch, reason } => {
                Error::UnfitForUndamaged { batch: batch_ids[batch].clone(), reason }
            }
            UndamagedError::State(error) => Error::Undamaged(error),
        })?;
        let version =
            self.store.insert_undamaged(structure, &state, &model_digest, &batch_ids, Timestamp::now()).await?;
        let batches = batch_ids.len();
        info!(structure.id = %structure, version, "Took {batches} batches as undamaged state {version} of {structure}");
        self.resume_later(structure.clone());
        let stored = self.store.undamaged(structure).await?;
        Ok(stored.expect("it was stored a moment ago and is never deleted"))
    }
}
