//! The processing of one stored batch. Its assessment is computed on a compute thread and stored; both are repeated if the trained
//! baseline or the undamaged reference changed in the meantime, or if a batch arrived that was measured before and changes it.

use std::future::Future;
use std::sync::Arc;
use std::time::Instant;

use tracing::{info, info_span, warn, Instrument as _};

use super::alarms::Alarms;
use super::computation::{is_comparable, Computation, Counts};
use super::compute::{Compute, Place};
use super::error::Error;
use super::events::Events;
use super::settings::MonitorSettings;
use super::structures::{ActiveStructure, ActiveStructures};
use crate::assessment::{self, chart_points, Assessment, BatchState, Draws, KnownLimits, NewCharts};
use crate::baseline::Baseline;
use crate::clock;
use crate::quantity::{shown, Digest, StructureId};
use crate::store::{
    BatchRecord, Before, ComparedWith, ComputedResult, ReferenceRecord, Store, StoredAssessment, StoredChartPoint,
};

/// A batch to assess, and what it is assessed with.
pub(super) struct Task {
    active: Arc<ActiveStructure>,
    baseline: Arc<Baseline>,
    record: Arc<BatchRecord>,
    place: Place,
}

/// What was stored when a computation was begun.
struct Seen {
    /// Version of the newest undamaged reference; 0 if there was none.
    newest_undamaged: u32,
    /// What was stored before the batch.
    before: Before,
}

/// A batch whose assessment was computed.
pub(super) struct Computed {
    task: Task,
    seen: Seen,
    /// How long the computation took; `None` if another process has done it.
    seconds: Option<f64>,
    /// The assessment with its points on the charts, or why there is none.
    outcome: Result<(Assessment, NewCharts), String>,
}

/// A batch whose result was stored, or discarded because of what was stored in the meantime.
pub(super) struct Stored {
    task: Task,
    /// As in [`Seen`].
    newest_undamaged: u32,
    outcome: Outcome,
}

enum Outcome {
    Assessed(Box<Assessment>, StoredAssessment),
    Failed {
        alarm_opened: bool,
    },
    /// Not stored, because in the meantime the structure has another version, or a batch has arrived that changes it.
    Superseded,
}

/// The final result of a batch.
pub(super) enum Finished {
    /// The assessment as it was stored, with the points of the batch on the charts.
    Assessed(Box<Assessment>, Vec<StoredChartPoint>),
    /// The assessment failed, and the reason was stored.
    Failed,
    /// Nothing was stored: the batch waits for an assessment under the present version of its structure, and by all that was measured before it.
    Superseded,
}

/// A stored result.
pub(super) enum Settled {
    /// It is final.
    Finished(Finished),
    /// The trained baseline or the undamaged reference changed in the meantime: the batch has to be assessed again.
    Again(Task),
}

impl Task {
    /// The task of a stored batch.
    pub(super) fn new(active: Arc<ActiveStructure>, record: BatchRecord, place: Place) -> Result<Self, Error> {
        let baseline = active.trained_baseline()?;
        Ok(Self { active, baseline, record: Arc::new(record), place })
    }

    /// Whether the batch is compared with an undamaged reference.
    fn is_comparable(&self, undamaged: &ReferenceRecord) -> bool {
        is_comparable(&self.baseline, &self.record, undamaged)
    }
}

/// Assesses stored batches.
pub(super) struct Assessor {
    pub(super) store: Store,
    pub(super) structures: Arc<ActiveStructures>,
    pub(super) compute: Compute,
    pub(super) known_limits: Arc<KnownLimits>,
    pub(super) alarms: Arc<Alarms>,
    pub(super) events: Events,
    pub(super) settings: MonitorSettings,
}

impl Assessor {
    /// A stored batch.
    pub(super) async fn stored(&self, structure: &StructureId, batch_id: &str) -> Result<BatchRecord, Error> {
        let unknown = || Error::UnknownBatch { structure: structure.clone(), batch: shown(batch_id) };
        self.store.batches().batch(structure, batch_id).await?.ok_or_else(unknown)
    }

    /// Processes a task until its result is final.
    pub(super) async fn finish(&self, task: Task) -> Result<Finished, Error> {
        let computed = self.compute(task).await?;
        self.finish_computed(computed).await
    }

    /// Stores a computed assessment, and assesses the batch again until its result is final.
    pub(super) async fn finish_computed(&self, mut computed: Computed) -> Result<Finished, Error> {
        loop {
            let stored = self.store_computed(computed).await?;
            computed = match self.settle(stored).await? {
                Settled::Again(task) => self.compute(task).await?,
                Settled::Finished(finished) => return Ok(finished),
            };
        }
    }

    /// What the assessment of a batch is computed from.
    async fn computation(&self, task: &Task) -> Result<(Computation, Seen), Error> {
        let (references, structure) = (self.store.reference(), &task.record.batch.structure);
        let undamaged = match task.record.kept_reference {
            Some(kept) => references.version(structure, kept).await?,
            // If a newer reference is stored in the meantime, the batch is assessed again (`settle`).
            None => references.undamaged_as_read(structure).await?,
        };
        let newest_undamaged = undamaged.as_ref().map_or(0, |record| record.state.version);
        let (baseline, record) = (Arc::clone(&task.baseline), Arc::clone(&task.record));
        let place = (record.batch.time_span().0, record.batch.measurements.len());
        let before = self.store.batches().before(structure, &record.batch.source, place).await?;
        let (earlier, counts) = (before.earlier.clone(), Counts::of(&self.settings));
        Ok((Computation::new(baseline, record, earlier, undamaged, counts), Seen { newest_undamaged, before }))
    }

    /// Computes the assessment of a batch, as soon as a thread is free.
    pub(super) async fn compute(&self, task: Task) -> Result<Computed, Error> {
        let (computation, seen) = self.computation(&task).await?;
        let started = Instant::now();
        let (known, settings) = (Arc::clone(&self.known_limits), self.settings.alarm);
        let work = move || {
            let assessment = computation.assess(clock::now())?;
            let points = chart_points(computation.baseline(), &assessment, computation.undamaged(), &settings, &known);
            Ok::<_, assessment::Error>((assessment, points))
        };
        let (structure, batch) = (task.record.batch.structure.as_str(), &task.record.batch_id);
        let trace = info_span!(target: "modalwatch::spans", "assess", structure.id = structure, batch.id = batch);
        let outcome = match task.place.run(work).instrument(trace).await {
            Ok(Ok(found)) => Ok(found),
            Ok(Err(error)) => Err(error.to_string()),
            Err(panicked) => Err(panicked.to_string()),
        };
        Ok(Computed { task, seen, seconds: Some(started.elapsed().as_secs_f64()), outcome })
    }

    /// Takes the result of a batch that another process has computed with `program`, as if it had been computed here. Gives the task back if
    /// it was computed from anything else than what would be used here now, or cannot be read: then it has to be computed here.
    pub(super) async fn take(
        &self,
        task: Task,
        result: ComputedResult,
        program: &str,
    ) -> Result<Result<Computed, Task>, Error> {
        let (computation, seen) = self.computation(&task).await?;
        if computation.inputs(program) != result.inputs {
            return Ok(Err(task));
        }
        let text = match result.outcome {
            Ok(text) => text,
            Err(reason) => {
                return Ok(Ok(Computed { task, seen, seconds: None, outcome: Err(reason) }));
            }
        };
        let (known, settings) = (Arc::clone(&self.known_limits), self.settings.alarm);
        let work = move || {
            let mut assessment = Assessment::from_carried(&text)?;
            // The newest assessment is the current one: by the clock of this process, as for all others.
            assessment.assessed_at = clock::now();
            let points = chart_points(computation.baseline(), &assessment, computation.undamaged(), &settings, &known);
            Some((assessment, points))
        };
        Ok(match task.place.run(work).await {
            Ok(Some(found)) => Ok(Computed { task, seen, seconds: None, outcome: Ok(found) }),
            _ => Err(task),
        })
    }

    /// Stores what was computed. The write is queued at once, so that results of one priority are stored in the order of the calls even
    /// when their futures are awaited later.
    pub(super) fn store_computed(&self, computed: Computed) -> impl Future<Output = Result<Stored, Error>> + Send {
        let Computed { task, seen: Seen { newest_undamaged, before }, seconds, outcome } = computed;
        let (structure, id) = (&task.record.batch.structure, &task.record.batch_id);
        let stored = match outcome {
            Ok((assessment, points)) => {
                if let Some(seconds) = seconds {
                    metrics::histogram!("modalwatch_assessment_seconds").record(seconds);
                }
                log_assessment(structure, id, &assessment, seconds);
                let kept = task.record.kept_reference;
                // A batch that keeps its reference does not wait for a newer one.
                let compared = kept.map_or(ComparedWith::Newest(newest_undamaged), ComparedWith::Kept);
                let (charted, priority) = ((points, compared, Some(before)), task.place.priority());
                let insert = self.store.assessments().insert_computed(structure, id, &assessment, charted, priority);
                Ok((Box::new(assessment), insert))
            }
            Err(reason) => {
                metrics::counter!("modalwatch_assessments_failed_total").increment(1);
                warn!(structure.id = %structure, batch.id = %id, "Could not assess batch {id} of {structure}: {reason}");
                let version = task.active.simulator.digest();
                Err(self.store.batches().mark_failed(structure, id, version, &reason, task.place.priority()))
            }
        };
        async move {
            let outcome = match stored {
                Ok((mut assessment, insert)) => match insert.await? {
                    Some(stored) => {
                        assessment.assessed_at = stored.assessed_at;
                        Outcome::Assessed(assessment, stored)
                    }
                    None => Outcome::Superseded,
                },
                Err(mark) => match mark.await? {
                    Some(marked) => Outcome::Failed { alarm_opened: marked.alarm_opened },
                    None => Outcome::Superseded,
                },
            };
            Ok(Stored { task, newest_undamaged, outcome })
        }
    }

    /// Publishes a stored result, and decides whether it is final.
    pub(super) async fn settle(&self, stored: Stored) -> Result<Settled, Error> {
        let Stored { mut task, newest_undamaged, outcome } = stored;
        let (structure, id) = (&task.record.batch.structure, &task.record.batch_id);
        let (assessment, stored) = match outcome {
            Outcome::Assessed(assessment, stored) => (assessment, stored),
            Outcome::Failed { alarm_opened } => {
                self.events.batch_changed(structure, id, BatchState::Failed);
                if alarm_opened {
                    self.alarms.report(structure).await;
                }
                return Ok(Settled::Finished(Finished::Failed));
            }
            Outcome::Superseded => return Ok(Settled::Finished(Finished::Superseded)),
        };
        if !stored.repeated {
            self.events.batch_changed(structure, id, BatchState::Assessed);
        }
        if stored.alarms_changed {
            self.alarms.report(structure).await;
        }
        // What it is compared with next is stored.
        if task.record.kept_reference.is_some() {
            return Ok(Settled::Finished(Finished::Assessed(assessment, stored.charts)));
        }
        if let Some(newer) = self.swapped_since(&task.active, &task.baseline) {
            task.baseline = newer;
            return Ok(Settled::Again(task));
        }
        // A reference that was declared during the computation did not mark the batch to be assessed again, because the batch was
        // not assessed yet. It is therefore compared with that reference now.
        if stored.newest_undamaged != newest_undamaged {
            let present =
                self.store.reference().undamaged(structure).await?.filter(|record| task.is_comparable(record));
            if present.map(|record| record.state.version) != assessment.undamaged_version {
                return Ok(Settled::Again(task));
            }
        }
        Ok(Settled::Finished(Finished::Assessed(assessment, stored.charts)))
    }

    /// The trained baseline that replaced `used` for the same version of the structure: a batch assessed with the old one could not
    /// be compared with the reference.
    fn swapped_since(&self, active: &ActiveStructure, used: &Baseline) -> Option<Arc<Baseline>> {
        let present = self.structures.get(active.simulator.id()).ok()?;
        let newer = present.baseline.as_ref().ok().filter(|baseline| baseline.digest() != used.digest())?;
        (present.simulator.digest() == active.simulator.digest()).then(|| Arc::clone(newer))
    }

    /// The numbers of posterior samples and the seed for a batch.
    pub(super) fn draws(&self, baseline: &Baseline, content_digest: &Digest) -> Draws {
        Counts::of(&self.settings).draws(baseline, content_digest)
    }
}

fn log_assessment(structure: &StructureId, batch_id: &str, assessment: &Assessment, seconds: Option<f64>) {
    metrics::counter!("modalwatch_assessments_total").increment(1);
    let exceeding = assessment.quantities.iter().filter(|q| q.damage.as_ref().is_some_and(|d| d.exceeds));
    let exceeding: Vec<&str> = exceeding.map(|q| q.name.as_str()).collect();
    let duration_ms = seconds.map(|seconds| seconds * 1e3);
    let measurements = assessment.measurements_used;
    info!(
        structure.id = %structure, batch.id = %batch_id, model.digest = %assessment.model_digest, duration_ms,
        exceeding = ?exceeding, "Assessed {measurements} measurements of {structure}"
    );
}
