//! The way of one stored batch: computed off the async threads, stored, told; and again where its baseline or undamaged state
//! became another meanwhile.

use std::future::Future;
use std::sync::Arc;
use std::time::Instant;

use tracing::{info, info_span, warn, Instrument as _};

use super::compute::Place;
use super::{baseline_of, Error, Monitor, Watched};
use crate::assessment::{self, chart_points, Assessment, BatchState, Context, Draws, NewChartPoint};
use crate::baseline::{assessment_seed, Baseline};
use crate::damage::UndamagedState;
use crate::quantity::{Hertz, StructureId, Timestamp};
use crate::store::{BatchRecord, StoredAssessment, StoredChartPoint, UndamagedRecord};

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
    /// Newest version of the undamaged state then, 0 where there was none.
    newest_undamaged: u32,
    seconds: f64,
    /// The assessment with its points on the charts, or why there is none.
    outcome: Result<(Assessment, Vec<NewChartPoint>), String>,
}

/// A batch whose result was stored, unless its structure has another version by now.
pub(super) struct Stored {
    task: Task,
    /// As in [`Computed`].
    newest_undamaged: u32,
    outcome: Outcome,
}

enum Outcome {
    Assessed(Box<Assessment>, StoredAssessment),
    Failed,
    /// Not stored.
    OfAnotherVersion,
}

/// A stored result.
pub(super) enum Settled {
    /// It stands: the assessment as it was stored, with the points of the batch on the charts.
    Stands(Box<Assessment>, Vec<StoredChartPoint>),
    /// There is none, or not yet.
    Without,
    /// Its baseline or undamaged state became another meanwhile.
    GoOn(Task),
}

impl Task {
    /// The task of a stored batch; `previous` are the frequencies of the measurement before it, of the same source.
    pub(super) fn new(
        watched: Arc<Watched>,
        record: BatchRecord,
        previous: Option<Vec<Option<Hertz>>>,
        place: Place,
    ) -> Result<Self, Error> {
        let baseline = baseline_of(&record.batch.structure, &watched)?;
        Ok(Self { watched, baseline, record: Arc::new(record), previous: Arc::new(previous), place })
    }

    /// Whether the batch is compared with an undamaged state: one that was taken with its baseline and without the batch.
    fn is_comparable(&self, undamaged: &UndamagedRecord) -> bool {
        undamaged.model_digest == *self.baseline.digest() && !undamaged.batches.contains(&self.record.batch_id)
    }
}

impl Monitor {
    /// Goes on with a task until its result stands: the assessment with the points of the batch on the charts, as they were
    /// stored; `None` where the reason why there is none was.
    pub(super) async fn finish(&self, task: Task) -> Result<Option<(Assessment, Vec<StoredChartPoint>)>, Error> {
        let computed = self.compute(task).await?;
        self.finish_computed(computed).await
    }

    /// The rest of [`Self::finish`].
    pub(super) async fn finish_computed(
        &self,
        computed: Computed,
    ) -> Result<Option<(Assessment, Vec<StoredChartPoint>)>, Error> {
        let mut computed = computed;
        loop {
            let stored = self.store_computed(computed).await?;
            computed = match self.settle(stored).await? {
                Settled::GoOn(task) => self.compute(task).await?,
                Settled::Stands(assessment, charts) => return Ok(Some((*assessment, charts))),
                Settled::Without => return Ok(None),
            };
        }
    }

    /// The task of a stored batch.
    pub(super) async fn task(&self, watched: Arc<Watched>, record: BatchRecord, place: Place) -> Result<Task, Error> {
        let (batch, (from, _)) = (&record.batch, record.batch.time_span());
        let previous = self.store.frequencies_before(&batch.structure, &batch.source, from).await?;
        Task::new(watched, record, previous, place)
    }

    /// Computes the assessment of a batch, as soon as a thread is free.
    pub(super) async fn compute(&self, task: Task) -> Result<Computed, Error> {
        // Where it is not the newest any more, the batch is computed again (`settle`).
        let undamaged = self.store.undamaged_as_read(&task.record.batch.structure).await?;
        let newest_undamaged = undamaged.as_ref().map_or(0, |record| record.state.version);
        let undamaged = undamaged.filter(|record| task.is_comparable(record));
        let started = Instant::now();
        let draws = self.draws(&task.baseline, &task.record);
        let (baseline, record, previous) =
            (Arc::clone(&task.baseline), Arc::clone(&task.record), Arc::clone(&task.previous));
        let (known, settings) = (Arc::clone(&self.known_limits), self.settings.alarm);
        let work = move || {
            let undamaged: Option<&UndamagedState> = undamaged.as_deref().map(|record| &record.state);
            let context = Context { undamaged, previous: previous.as_deref() };
            let measurements = &record.batch.measurements;
            let assessment = assessment::assess(&baseline, measurements, context, draws, Timestamp::now())?;
            let points = chart_points(&baseline, &assessment, undamaged, &settings, &known);
            Ok::<_, assessment::Error>((assessment, points))
        };
        let (structure, batch) = (task.record.batch.structure.as_str(), &task.record.batch_id);
        let trace = info_span!(target: "modalwatch::spans", "assess", structure.id = structure, batch.id = batch);
        let outcome = match task.place.run(work).instrument(trace).await {
            Ok(Ok(found)) => Ok(found),
            Ok(Err(error)) => Err(error.to_string()),
            Err(panicked) => Err(panicked.to_string()),
        };
        Ok(Computed { task, newest_undamaged, seconds: started.elapsed().as_secs_f64(), outcome })
    }

    /// Stores what was computed. It is queued at once: results are stored in the order of the calls, also where the ends are
    /// waited for later.
    pub(super) fn store_computed(&self, computed: Computed) -> impl Future<Output = Result<Stored, Error>> + Send {
        let Computed { task, newest_undamaged, seconds, outcome } = computed;
        let (structure, id) = (&task.record.batch.structure, &task.record.batch_id);
        let stored = match outcome {
            Ok((assessment, points)) => {
                metrics::histogram!("modalwatch_assessment_seconds").record(seconds);
                report(structure, id, &assessment, seconds);
                let insert = self.store.insert_assessment(structure, id, &assessment, points);
                Ok((Box::new(assessment), insert))
            }
            Err(reason) => {
                metrics::counter!("modalwatch_assessments_failed_total").increment(1);
                warn!(structure.id = %structure, batch.id = %id, "Could not assess batch {id} of {structure}: {reason}");
                let version = task.watched.simulator.digest();
                Err(self.store.mark_failed(structure, id, version, &reason))
            }
        };
        async move {
            let outcome = match stored {
                Ok((mut assessment, insert)) => match insert.await? {
                    Some(stored) => {
                        assessment.assessed_at = stored.assessed_at;
                        Outcome::Assessed(assessment, stored)
                    }
                    None => Outcome::OfAnotherVersion,
                },
                Err(mark) => {
                    if mark.await? {
                        Outcome::Failed
                    } else {
                        Outcome::OfAnotherVersion
                    }
                }
            };
            Ok(Stored { task, newest_undamaged, outcome })
        }
    }

    /// Tells of a stored result; whether it stands.
    pub(super) async fn settle(&self, stored: Stored) -> Result<Settled, Error> {
        let Stored { mut task, newest_undamaged, outcome } = stored;
        let (structure, id) = (&task.record.batch.structure, &task.record.batch_id);
        let (assessment, stored) = match outcome {
            Outcome::Assessed(assessment, stored) => (assessment, stored),
            Outcome::Failed => {
                self.tell_batch(structure, id, BatchState::Failed);
                return Ok(Settled::Without);
            }
            Outcome::OfAnotherVersion => {
                // The batch waits for an assessment under the present version.
                self.resume_later(structure.clone());
                return Ok(Settled::Without);
            }
        };
        self.tell_batch(structure, id, BatchState::Assessed);
        if stored.alarms_changed {
            self.report_episodes(structure).await;
        }
        if let Some(newer) = self.swapped_since(&task.watched, &task.baseline) {
            task.baseline = newer;
            return Ok(Settled::GoOn(task));
        }
        // A state declared while this was computed did not find the batch assessed, and so did not send it back: it is
        // compared now.
        if stored.newest_undamaged != newest_undamaged {
            let present = self.store.undamaged(structure).await?.filter(|record| task.is_comparable(record));
            if present.map(|record| record.state.version) != assessment.undamaged_version {
                return Ok(Settled::GoOn(task));
            }
        }
        Ok(Settled::Stands(assessment, stored.charts))
    }

    /// The baseline that took the place of another for the same version of the structure: a batch that was begun with the old
    /// one would be compared with nothing.
    fn swapped_since(&self, watched: &Watched, used: &Baseline) -> Option<Arc<Baseline>> {
        let present = self.structure(watched.simulator.id()).ok()?;
        let newer = present.baseline.as_ref().ok().filter(|baseline| baseline.digest() != used.digest())?;
        (present.simulator.digest() == watched.simulator.digest()).then(|| Arc::clone(newer))
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
