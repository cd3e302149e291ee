//! The details of assessed batches: densities of the parameters and predicted frequencies, computed when they are read.

use std::collections::VecDeque;
use std::sync::{Arc, Mutex};

use super::assessor::Assessor;
use super::error::Error;
use super::readers::Readers;
use crate::assessment::{detail, draw, BatchDetail, BatchState, Draws};
use crate::quantity::{Digest, Hertz, StructureId};
use crate::store::{BatchRecord, ReferenceRecord};

/// Details that are kept.
const KEPT: usize = 32;

/// A detail and the digest of what it depends on.
type Kept = (Digest, Arc<BatchDetail>);

/// Computes the details of batches, and keeps the last ones.
#[derive(Clone)]
pub(super) struct Details {
    assessor: Arc<Assessor>,
    readers: Readers,
    /// The last ones by the digest of what they depend on, the newest last.
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
        let Assessor { store, structures, .. } = &*self.assessor;
        let active = structures.get(structure)?;
        let record = self.assessor.stored(structure, batch_id).await?;
        let baseline = active.trained_baseline()?;
        let not_assessed = |reason: String| Error::NotAssessed { batch: batch_id.to_owned(), reason };
        match record.state {
            BatchState::Assessed => {}
            BatchState::Received => return Err(not_assessed("it still waits for its assessment".to_owned())),
            BatchState::Failed => return Err(not_assessed(record.failure.unwrap_or_default())),
        }
        let draws = self.assessor.draws(&baseline, &record);
        let (source, from) = (&record.batch.source, record.batch.time_span().0);
        let previous = store.batches().frequencies_before(structure, source, from).await?;
        let reference = store.reference().undamaged(structure).await?.filter(|u| u.model_digest == *baseline.digest());
        let key = key(&record, baseline.digest(), draws, previous.as_deref(), reference.as_deref());
        if let Some(kept) = self.kept(&key) {
            return Ok(kept);
        }
        let work = move |wanted: &super::readers::Wanted| {
            let measurements = &record.batch.measurements;
            let samples = draw(&baseline, measurements, previous.as_deref(), draws)?;
            if !wanted.still() {
                return Ok(None);
            }
            let reference = reference.as_ref().map(|record| &record.state);
            detail(&baseline, measurements, &samples, draws.per_measurement, reference).map(Some)
        };
        let done: Result<_, crate::assessment::Error> = turn.run(work).await.map_err(|_| Error::Panicked)?;
        let detail = done.map_err(|error| not_assessed(error.to_string()))?;
        let detail = Arc::new(detail.expect("the caller waits for it"));
        self.keep(key, Arc::clone(&detail));
        Ok(detail)
    }

    fn kept(&self, key: &Digest) -> Option<Arc<BatchDetail>> {
        let kept = self.kept.lock().expect("no holder of this lock panics");
        kept.iter().find(|(found, _)| found == key).map(|(_, detail)| Arc::clone(detail))
    }

    fn keep(&self, key: Digest, detail: Arc<BatchDetail>) {
        let mut kept = self.kept.lock().expect("no holder of this lock panics");
        kept.retain(|(found, _)| *found != key);
        if kept.len() >= KEPT {
            kept.pop_front();
        }
        kept.push_back((key, detail));
    }
}

/// Digest of all that a detail depends on: the measurements, the trained model, the numbers of samples, the measurement before the
/// batch, and the undamaged reference.
fn key(
    record: &BatchRecord,
    model: &Digest,
    draws: Draws,
    previous: Option<&[Option<Hertz>]>,
    reference: Option<&ReferenceRecord>,
) -> Digest {
    let reference = reference.map(|found| (found.state.version, &found.batches));
    let rest = format!("{draws:?} {previous:?} {reference:?}");
    Digest::of(&[
        record.batch.structure.as_str().as_bytes(),
        record.batch_id.as_bytes(),
        record.content_digest.as_str().as_bytes(),
        model.as_str().as_bytes(),
        rest.as_bytes(),
    ])
}
