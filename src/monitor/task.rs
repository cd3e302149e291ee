//! The way of one stored batch: computed on a blocking thread, stored, told; and again where its baseline or undamaged state
//! became another meanwhile.

use std::future::Future;
use std::sync::Arc;
use std::time::Instant;

use tracing::{info, info_span, warn, Instrument as _};

use super::assess::{self, Context, Draws};
use super::compute::Place;
use super::{baseline_of, charts, Error, Monitor, Watched};
use crate::assessment::{Assessment, BatchState};
use crate::baseline::{assessment_seed, Baseline};
use crate::damage::UndamagedState;
use crate::quantity::{Hertz, StructureId};
use crate::store::{BatchRecord, NewChartPoint, UndamagedRecord};

/// A batch on its way, and what it is assessed with.
pub(super) struct Task {
    watched: Arc<Watched>,
    baseline: Arc<Baseline>,
    record: Arc<BatchRecord>,
    /// Frequencies of the measurement before it, of the same source.
    previous: Arc<Option<Vec<Option<Hertz>>>>,
    place: Place,
}

/// A batch that was computed, and under which undamaged state.
pub(super) struct Computed {
    task: Task,
    undamaged_version: Option<u32>,
    seconds: f64,
    /// The assessment with its points on the charts, or why there is none.
    outcome: Result<(Assessment, Vec<NewChartPoint>), String>,
}

/// A batch whose result was stored, unless its structure has another version by now.
pub(super) struct Stored {
    task: Task,
    undamaged_version: Option<u32>,
    state: BatchState,
    stored: bool,
}

impl Monitor {
    /// Assesses a stored batch and stores the result, or the reason why there is none.
    pub(super) async fn assess_stored(
        &self,
        watched: Arc<Watched>,
        record: BatchRecord,
        place: Place,
    ) -> Result<(), Error> {
        let task = self.task(watched, record, place).await?;
        self.finish(task).await
    }

    /// Goes on with a task until its result stands.
    pub(super) async fn finish(&self, task: Task) -> Result<(), Error> {
        let mut next = Some(task);
        while let Some(task) = next {
            let computed = self.compute(task).await?;
            let stored = self.store_computed(computed).await?;
            next = self.settle(stored).await?;
        }
        Ok(())
    }

    /// The task of a stored batch.
    pub(super) async fn task(&self, watched: Arc<Watched>, record: BatchRecord, place: Place) -> Result<Task, Error> {
        let structure = &record.batch.structure;
        let baseline = baseline_of(structure, &watched)?;
        let (from, _) = record.batch.time_span();
        let previous = Arc::new(self.store.frequencies_before(structure, &record.batch.source, from).await?);
        Ok(Task { watched, baseline, record: Arc::new(record), previous, place })
    }

    /// Computes the assessment of a batch, as soon as a thread is free.
    pub(super) async fn compute(&self, task: Task) -> Result<Computed, Error> {
        let undamaged = self.comparable(&task).await?;
        let undamaged_version = undamaged.as_ref().map(|record| record.state.version);
        let started = Instant::now();
        let draws = self.draws(&task.baseline, &task.record);
        let (baseline, record, previous) =
            (Arc::clone(&task.baseline), Arc::clone(&task.record), Arc::clone(&task.previous));
        let (known, settings) = (Arc::clone(&self.known_limits), self.settings.alarm);
        let work = move || {
            let undamaged: Option<&UndamagedState> = undamaged.as_deref().map(|record| &record.state);
            let context = Context { undamaged, previous: previous.as_deref() };
            let assessment = assess::assess(&baseline, &record.batch.measurements, context, draws)?;
            let measured = record.batch.time_span();
            let points = charts::points(&baseline, &assessment, undamaged, measured, &settings, &known);
            Ok::<_, assess::Error>((assessment, points))
        };
        let (structure, batch) = (task.record.batch.structure.as_str(), &task.record.batch_id);
        let trace = info_span!(target: "modalwatch::spans", "assess", structure.id = structure, batch.id = batch);
        let outcome = match task.place.run(work).instrument(trace).await {
            Ok(Ok(found)) => Ok(found),
            Ok(Err(error)) => Err(error.to_string()),
            Err(panicked) => Err(panicked.to_string()),
        };
        Ok(Computed { task, undamaged_version, seconds: started.elapsed().as_secs_f64(), outcome })
    }

    /// Stores what was computed. It is queued at once: results are stored in the order of the calls, also where the ends are
    /// waited for later.
    pub(super) fn store_computed(&self, computed: Computed) -> impl Future<Output = Result<Stored, Error>> + Send {
        let Computed { task, undamaged_version, seconds, outcome } = computed;
        let (structure, id) = (&task.record.batch.structure, &task.record.batch_id);
        let (stored, state) = match outcome {
            Ok((assessment, points)) => {
                metrics::histogram!("modalwatch_assessment_seconds").record(seconds);
                report(structure, id, &assessment, seconds);
                (Ok(self.store.insert_assessment(structure, id, &assessment, points)), BatchState::Assessed)
            }
            Err(reason) => {
                metrics::counter!("modalwatch_assessments_failed_total").increment(1);
                warn!(structure.id = %structure, batch.id = %id, "Could not assess batch {id} of {structure}: {reason}");
                let version = task.watched.simulator.digest();
                (Err(self.store.mark_failed(structure, id, version, &reason)), BatchState::Failed)
            }
        };
        async move {
            let stored = match stored {
                Ok(insert) => insert.await?,
                Err(mark) => mark.await?,
            };
            Ok(Stored { task, undamaged_version, state, stored })
        }
    }

    /// Tells of a stored result. A task to go on with where it does not stand.
    pub(super) async fn settle(&self, stored: Stored) -> Result<Option<Task>, Error> {
        let Stored { mut task, undamaged_version, state, stored } = stored;
        let structure = &task.record.batch.structure;
        if !stored {
            // The structure has another version by now: the batch waits for an assessment under that.
            self.resume_later(structure.clone());
            return Ok(None);
        }
        self.tell_batch(structure, &task.record.batch_id, state);
        if state == BatchState::Failed {
            return Ok(None);
        }
        self.report_episodes(structure).await;
        // A state declared while this was computed did not find the batch assessed, and so did not send it back: it is
        // compared now.
        let swapped = self.swapped_since(&task.watched, &task.baseline);
        let same_model = swapped.is_none();
        task.baseline = swapped.unwrap_or(task.baseline);
        let present = self.comparable(&task).await?.map(|record| record.state.version);
        Ok((!same_model || present != undamaged_version).then_some(task))
    }

    /// The baseline that took the place of another for the same version of the structure: a batch that was begun with the old
    /// one would be compared with nothing.
    fn swapped_since(&self, watched: &Watched, used: &Baseline) -> Option<Arc<Baseline>> {
        let present = self.structure(watched.simulator.id()).ok()?;
        let newer = present.baseline.as_ref().ok().filter(|baseline| baseline.digest() != used.digest())?;
        (present.simulator.digest() == watched.simulator.digest()).then(|| Arc::clone(newer))
    }

    /// The undamaged state a batch is compared with: the newest, if it was taken with its baseline and without the batch.
    async fn comparable(&self, task: &Task) -> Result<Option<Arc<UndamagedRecord>>, Error> {
        let newest = self.store.undamaged(&task.record.batch.structure).await?;
        let fits = |u: &Arc<UndamagedRecord>| {
            u.model_digest == *task.baseline.digest() && !u.batches.contains(&task.record.batch_id)
        };
        Ok(newest.filter(fits))
    }

    pub(super) fn draws(&self, baseline: &Baseline, record: &BatchRecord) -> Draws {
        Draws {
            per_measurement: self.settings.draws_per_measurement,
            for_population: self.settings.draws_for_population,
            seed: assessment_seed(&record.content_digest, baseline.digest()),
        }
    }
}

fn report(structure: &StructureId, batch_id: &str, assessment: &Assessment, seconds: f64) {
    metrics::counter!("modalwatch_assessments_total").increment(1);
    let exceeding = assessment.quantities.iter().filter(|q| q.damage.as_ref().is_some_and(|d| d.exceeds));
    let exceeding: Vec<&str> = exceeding.map(|q| q.name.as_str()).collect();
    let duration_ms = seconds * 1e3;
    let measurements = assessment.measurements_used;
    info!(
        structure.id = %structure, batch.id = %batch_id, model.digest = %assessment.model_digest, duration_ms,
        exceeding = ?exceeding, "Assessed {measurements} measurements of {structure}"
    );
}
