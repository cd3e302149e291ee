//! The details of assessed batches: densities of the parameters and predicted frequencies, computed when they are read.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};

use super::assessor::Assessor;
use super::error::Error;
use super::readers::Readers;
use crate::assessment::{detail, draw, BatchDetail, BatchState, Context, Draws, Earlier};
use crate::baseline::Baseline;
use crate::quantity::{Digest, StructureId, Timestamp};
use crate::store::{BatchRecord, ReferenceRecord};

/// Details that are kept.
const KEPT: usize = 32;

/// A detail that was computed.
#[derive(Clone)]
struct Kept {
    of: Measured,
    /// Digest of all that it depends on.
    key: Digest,
    detail: Arc<BatchDetail>,
}

/// What a detail depends on of the batch itself, which never changes.
#[derive(Clone)]
struct Measured {
    structure: StructureId,
    batch_id: String,
    content_digest: Digest,
    source: String,
    /// Time of the first measurement.
    from: Timestamp,
    /// How many there are.
    measurements: usize,
}

/// Computes the details of batches, and keeps the last ones.
#[derive(Clone)]
pub(super) struct Details {
    assessor: Arc<Assessor>,
    readers: Readers,
    /// The last ones, the newest last.
    kept: Arc<Mutex<VecDeque<Kept>>>,
}

impl Details {
    pub(super) fn new(assessor: Arc<Assessor>, readers: Readers) -> Self {
        Self { assessor, readers, kept: Arc::default() }
    }

    /// The detail of an assessed batch, by the samples of its assessment, which are drawn again unless they were drawn just before.
    pub(super) async fn of_batch(&self, structure: &StructureId, batch_id: &str) -> Result<Arc<BatchDetail>, Error> {
        // The turn comes first, so that no more batches are in memory than are computed.
        let turn = self.readers.turn().await?;
        let active = self.assessor.structures.get(structure)?;
        let baseline = active.trained_baseline();
        if let Ok(baseline) = &baseline {
            if let Some(detail) = self.known(baseline, structure, batch_id).await? {
                return Ok(detail);
            }
        }
        let record = self.assessor.stored(structure, batch_id).await?;
        let baseline = baseline?;
        let not_assessed = |reason: String| Error::NotAssessed { batch: batch_id.to_owned(), reason };
        match record.state {
            BatchState::Assessed => {}
            BatchState::Received => return Err(not_assessed("it still waits for its assessment".to_owned())),
            BatchState::Failed => return Err(not_assessed(record.failure.unwrap_or_default())),
        }
        let of = Measured::of(&record);
        let Inputs { draws, earlier, reference, key } = self.inputs(&baseline, &of).await?;
        let work = move |wanted: &super::readers::Wanted| {
            let measurements = &record.batch.measurements;
            let undamaged = reference.as_ref().map(|record| &record.state);
            let samples = draw(&baseline, measurements, Context { undamaged, earlier: Some(&earlier) }, draws)?;
            if !wanted.still() {
                return Ok(None);
            }
            detail(&baseline, measurements, &samples, draws.per_measurement, undamaged).map(Some)
        };
        let done: Result<_, crate::assessment::Error> = turn.run(work).await.map_err(|_| Error::Panicked)?;
        let detail = done.map_err(|error| not_assessed(error.to_string()))?;
        let detail = Arc::new(detail.expect("the caller waits for it"));
        self.keep(Kept { of, key, detail: Arc::clone(&detail) });
        Ok(detail)
    }

    /// A kept detail, if all that it depends on is still the same. This does not read the thousands of measurements of the batch.
    async fn known(
        &self,
        baseline: &Baseline,
        structure: &StructureId,
        batch_id: &str,
    ) -> Result<Option<Arc<BatchDetail>>, Error> {
        let Some(Kept { of, key, detail }) = self.kept(structure, batch_id) else { return Ok(None) };
        let stored = self.assessor.store.batches().state(structure, batch_id).await?;
        let unchanged = stored.is_some_and(|stored| stored == (BatchState::Assessed, of.content_digest.clone()));
        Ok((unchanged && self.inputs(baseline, &of).await?.key == key).then_some(detail))
    }

    /// What a detail depends on beside the measurements of its batch.
    async fn inputs(&self, baseline: &Baseline, of: &Measured) -> Result<Inputs, Error> {
        let store = &self.assessor.store;
        let draws = self.assessor.draws(baseline, &of.content_digest);
        let earlier = store.batches().earlier(&of.structure, &of.source, (of.from, of.measurements)).await?;
        let reference = store.reference().undamaged(&of.structure).await?;
        let reference = reference.filter(|found| found.model_digest == *baseline.digest());
        let key = key(of, baseline.digest(), draws, &earlier, reference.as_deref());
        Ok(Inputs { draws, earlier, reference, key })
    }

    fn kept(&self, structure: &StructureId, batch_id: &str) -> Option<Kept> {
        let kept = self.kept.lock().expect("no holder of this lock panics");
        kept.iter().find(|found| found.of.is(structure, batch_id)).cloned()
    }

    fn keep(&self, new: Kept) {
        let mut kept = self.kept.lock().expect("no holder of this lock panics");
        kept.retain(|found| !found.of.is(&new.of.structure, &new.of.batch_id));
        if kept.len() >= KEPT {
            kept.pop_front();
        }
        kept.push_back(new);
    }
}

impl Measured {
    fn of(record: &BatchRecord) -> Self {
        Self {
            structure: record.batch.structure.clone(),
            batch_id: record.batch_id.clone(),
            content_digest: record.content_digest.clone(),
            source: record.batch.source.clone(),
            from: record.batch.time_span().0,
            measurements: record.batch.measurements.len(),
        }
    }

    fn is(&self, structure: &StructureId, batch_id: &str) -> bool {
        self.structure == *structure && self.batch_id == batch_id
    }
}

/// What a detail depends on beside the measurements of its batch.
struct Inputs {
    draws: Draws,
    /// What was measured before the batch.
    earlier: Earlier,
    reference: Option<Arc<ReferenceRecord>>,
    /// Digest of all that the detail depends on.
    key: Digest,
}

/// Digest of all that a detail depends on: the measurements, the trained model, the numbers of samples, what was measured before
/// the batch, and the undamaged reference.
fn key(of: &Measured, model: &Digest, draws: Draws, earlier: &Earlier, reference: Option<&ReferenceRecord>) -> Digest {
    let reference = reference.map(|found| (found.state.version, &found.batches));
    let rest = format!("{draws:?} {earlier:?} {reference:?}");
    Digest::of(&[
        of.structure.as_str().as_bytes(),
        of.batch_id.as_bytes(),
        of.content_digest.as_str().as_bytes(),
        model.as_str().as_bytes(),
        rest.as_bytes(),
    ])
}
