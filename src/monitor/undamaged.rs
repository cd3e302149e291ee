//! Declaring batches as the undamaged state.

use tracing::{info, Instrument as _};

use super::{assess, baseline_of, draws, Error, Monitor};
use crate::baseline::Baseline;
use crate::damage::{QuantitySamples, UndamagedState};
use crate::quantity::{StructureId, Timestamp};
use crate::store::{BatchRecord, UndamagedRecord};

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
        let per_measurement = self.settings.draws_per_measurement;
        let model_digest = baseline.digest().clone();
        let place = self.compute.reserve()?;
        let pooled = place.run(move || pool(&baseline, &records, per_measurement)).await;
        let samples = pooled.map_err(|_| Error::Panicked)??;
        let state = UndamagedState::from_samples(0, &samples, threshold_probability)?;
        let version =
            self.store.insert_undamaged(structure, &state, &model_digest, &batch_ids, Timestamp::now()).await?;
        let batches = batch_ids.len();
        info!(structure.id = %structure, version, "Took {batches} batches as undamaged state {version} of {structure}");
        self.resume_later(structure.clone());
        let stored = self.store.undamaged(structure).await?;
        Ok(stored.expect("it was stored a moment ago and is never deleted"))
    }
}

/// Samples of several batches as one pool for each quantity.
fn pool(baseline: &Baseline, records: &[BatchRecord], per_measurement: usize) -> Result<Vec<QuantitySamples>, Error> {
    let mut pooled: Vec<QuantitySamples> = Vec::new();
    for record in records {
        let failed = |source| Error::Assess { batch: record.batch_id.clone(), source };
        let draws = draws(baseline, record, per_measurement);
        let samples = assess::draw(baseline, &record.batch.measurements, draws).map_err(failed)?;
        let quantities = assess::monitored_quantities(baseline, &samples.posterior);
        if pooled.is_empty() {
            pooled = quantities;
        } else {
            pooled.iter_mut().zip(quantities).for_each(|(all, more)| all.pool.extend(more.pool));
        }
    }
    Ok(pooled)
}
