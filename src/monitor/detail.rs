//! The detail of a stored batch, computed again from its measurements.

use std::sync::Arc;

use super::{baseline_of, Error, Monitor};
use crate::assessment::{detail, draw, BatchDetail, BatchState};
use crate::quantity::StructureId;
use crate::store::BatchRecord;

impl Monitor {
    /// The detail of an assessed batch, by the samples of its assessment.
    ///
    /// # Errors
    /// [`Error::UnknownStructure`], [`Error::UnknownBatch`], [`Error::NoModel`], [`Error::NotAssessed`],
    /// [`Error::QueueFull`].
    pub async fn batch_detail(&self, structure: &StructureId, batch_id: &str) -> Result<BatchDetail, Error> {
        let watched = self.structure(structure)?;
        let record = self.stored(structure, batch_id).await?;
        let baseline = baseline_of(structure, &watched)?;
        let not_assessed = |reason: String| Error::NotAssessed { batch: batch_id.to_owned(), reason };
        match record.state {
            BatchState::Assessed => {}
            BatchState::Received => return Err(not_assessed("it waits for its assessment".to_owned())),
            BatchState::Failed => return Err(not_assessed(record.failure.unwrap_or_default())),
        }
        let place = self.compute.reserve()?;
        let draws = self.draws(&baseline, &record);
        let (source, from) = (&record.batch.source, record.batch.time_span().0);
        let previous = self.store.frequencies_before(structure, source, from).await?;
        let undamaged = self.store.undamaged(structure).await?;
        let undamaged = undamaged.filter(|u| u.model_digest == *baseline.digest());
        let drawn = Arc::clone(&baseline);
        let work = move || {
            let BatchRecord { batch, .. } = record;
            let samples = draw(&drawn, &batch.measurements, previous.as_deref(), draws)?;
            detail(&drawn, &batch.measurements, &samples, draws.per_measurement, undamaged.as_ref().map(|u| &u.state))
        };
        let done = place.run(work).await.map_err(|_| Error::Panicked)?;
        done.map_err(|error| not_assessed(error.to_string()))
    }
}
