//! The computations behind the jobs: the diagnosis of measurements, and the training of a model or of an extension.

use std::collections::BTreeSet;
use std::time::Instant;

use serde::{Deserialize, Serialize};
use tracing::info;

use super::queue::Queue;
use super::watch::Watch;
use crate::baseline::extension::{ExtensionPlan, Progress as TrainingProgress};
use crate::baseline::recipe::Recipe;
use crate::baseline::rounds::Progress;
use crate::baseline::train::Trained;
use crate::baseline::Baseline;
use crate::discrepancy::data::Data;
use crate::discrepancy::extend::extend;
use crate::discrepancy::learned::extension::extend_learned;
use crate::discrepancy::{diagnose, report, Holdout, Outcome, Step, FEWEST_ROWS};
use crate::measurement::order::{Disorder, Ordered};
use crate::measurement::ModalMeasurement;
use crate::monitor::patience::patiently;
use crate::quantity::{StructureId, Timestamp};
use crate::simulator::Simulator;
use crate::store::Store;

/// Largest number of measurements that a note names.
const MOST_NAMED: usize = 5;

/// The measurements of a diagnosis, and how they are used.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DiagnosisRequest {
    /// Batches, by id.
    pub batches: Vec<String>,
    /// Only measurements from this time on.
    #[serde(default)]
    pub from: Option<Timestamp>,
    /// Only measurements before this time.
    #[serde(default)]
    pub to: Option<Timestamp>,
    /// Measurements held out to measure the gain.
    pub holdout: Holdout,
    /// Seed of the bootstrap and, in an extension, of the training.
    pub seed: u64,
}

impl Default for DiagnosisRequest {
    /// All batches; the last quarter of the measurements is held out.
    fn default() -> Self {
        Self { batches: Vec::new(), from: None, to: None, holdout: Holdout::Last(0.25), seed: 1 }
    }
}

impl DiagnosisRequest {
    /// Whether a time lies in the period of the request.
    pub(super) fn contains(&self, time: Timestamp) -> bool {
        self.from.is_none_or(|from| time >= from) && self.to.is_none_or(|to| time < to)
    }

    /// The period as a note; `None` for all measurements.
    pub(super) fn period_in_words(&self) -> Option<String> {
        match (self.from, self.to) {
            (None, None) => None,
            (Some(from), None) => Some(format!("only the measurements from {from} on are used, as requested")),
            (None, Some(to)) => Some(format!("only the measurements before {to} are used, as requested")),
            (Some(from), Some(to)) => {
                Some(format!("only the measurements from {from} to before {to} are used, as requested"))
            }
        }
    }
}

/// How an extension is trained.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct ExtensionTraining {
    /// Number of simulated pairs; `None` for a number that follows from the training of the present baseline.
    pub samples: Option<usize>,
    /// Number of epochs; `None` for a number that follows from the training of the present baseline.
    pub epochs: Option<usize>,
    /// Start from random weights instead of those of the present baseline.
    pub from_scratch: bool,
    /// Use the flow even if it fails its calibration; every assessment then has a finding about it.
    pub accept_uncalibrated: bool,
    /// Add a learned discrepancy instead of the causes.
    pub learned: bool,
}

/// A job that computes on measurements of a structure.
pub(super) struct Study {
    pub(super) id: String,
    pub(super) simulator: Simulator,
    pub(super) measurements: Vec<ModalMeasurement>,
    /// Times of the measurements in the declared undamaged reference.
    pub(super) undamaged: BTreeSet<Timestamp>,
    pub(super) request: DiagnosisRequest,
    pub(super) queue: Queue,
}

/// A trained extension of a structure.
pub(super) struct TrainedExtension {
    pub(super) added: Vec<String>,
    pub(super) left_out: Vec<String>,
    pub(super) simulator: Simulator,
    pub(super) trained: Trained,
}

impl Study {
    /// The diagnosis as JSON, and its report as HTML.
    pub(super) fn diagnose(&self) -> Result<(String, Option<String>), String> {
        let (data, outcome) = self.outcome()?;
        let html = report::html(&self.simulator, &data, &outcome);
        Ok((serde_json::to_string(&outcome.diagnosis).expect("a diagnosis is plain data"), html))
    }

    /// Extends the structure by the causes of the diagnosis, and trains a flow for it, from the weights of the present one where they
    /// can be used.
    pub(super) fn extend(
        &self,
        before: Option<&Baseline>,
        training: ExtensionTraining,
    ) -> Result<TrainedExtension, String> {
        // The fits of the diagnosis are not stored; they are computed again, with the same result, from the same data and seed.
        let (data, outcome) = self.outcome()?;
        let (definition, added, left_out) = if training.learned {
            let extended = extend_learned(&self.simulator, &data, &outcome).map_err(|e| e.to_string())?;
            (extended.definition, vec![extended.added], extended.left_out)
        } else {
            let extended = extend(&self.simulator, &data, &outcome).map_err(|e| e.to_string())?;
            (extended.definition, extended.added, extended.left_out)
        };
        let simulator = Simulator::new(definition).map_err(|e| e.to_string())?;
        let ExtensionTraining { samples, epochs, from_scratch, accept_uncalibrated: _, learned: _ } = training;
        let plan = ExtensionPlan { parent: before, from_scratch, samples, epochs, seed: self.request.seed };
        let mut watch = Watch::new();
        let trained = plan.train(&simulator, &mut |progress| {
            if let TrainingProgress::Start(what) | TrainingProgress::Round(what) = &progress {
                info!(structure.id = %simulator.id(), diagnosis = %self.id, "Extension of {}: {what}", simulator.id());
            }
            if let Some(mut report) = watch.report(&progress, Instant::now()) {
                report.what = format!("training, {}", report.what);
                self.queue.report(&self.id, report);
            }
        });
        self.queue.report(&self.id, "switching".to_owned());
        Ok(TrainedExtension { added, left_out, simulator, trained: trained.map_err(|e| e.to_string())? })
    }

    fn outcome(&self) -> Result<(Data, Outcome), String> {
        let ordered = Ordered::of(&self.measurements);
        let used: Vec<ModalMeasurement> = ordered.kept.iter().map(|index| self.measurements[*index].clone()).collect();
        let data = Data::new(&self.simulator, &used).with_undamaged(&self.undamaged);
        let progress = |step: Step| self.queue.report(&self.id, step.to_string());
        let outcome = diagnose(&self.simulator, &data, &self.request.holdout, self.request.seed, &progress);
        let mut outcome = outcome.map_err(|e| e.to_string())?;
        let notes = self.request.period_in_words().into_iter().chain(self.left_out(&ordered)).chain(ordered.notes);
        outcome.diagnosis.notes.splice(0..0, notes);
        Ok((data, outcome))
    }

    /// A sentence about the measurements that are left out, if there are any.
    fn left_out(&self, ordered: &Ordered) -> Option<String> {
        let named =
            |(index, disorder): &(usize, Disorder)| format!("{}: {disorder}", self.measurements[*index].measured_at);
        let mut some: Vec<String> = ordered.left_out.iter().take(MOST_NAMED).map(named).collect();
        let (count, all) = (ordered.left_out.len(), self.measurements.len());
        if count > MOST_NAMED {
            some.push(format!("and {} more", count - MOST_NAMED));
        }
        (count > 0)
            .then(|| format!("{count} of {all} measurements cannot be used and are left out: {}", some.join("; ")))
    }
}

/// Reads the measurements on which a job computes.
pub(super) async fn read_study(
    store: &Store,
    queue: &Queue,
    id: String,
    structure: &StructureId,
    simulator: Simulator,
    request: DiagnosisRequest,
) -> Result<Study, String> {
    let batches = store.batches();
    let text = |e: &dyn std::fmt::Display| e.to_string();
    let all = || batches.measurements_of(structure, &request.batches);
    let all = patiently(store, "read the measurements of a job", all).await;
    let mut measurements = all.map_err(|e| text(&e))?;
    let all = measurements.len();
    measurements.retain(|measurement| request.contains(measurement.measured_at));
    if let (true, Some(period)) = (measurements.len() < FEWEST_ROWS, request.period_in_words()) {
        return Err(format!(
            "{period}, and these are {} of {all}: a diagnosis needs at least {FEWEST_ROWS}",
            measurements.len()
        ));
    }
    let reference = || store.reference().undamaged(structure);
    let reference = patiently(store, "read the reference for a job", reference).await.map_err(|e| text(&e))?;
    let declared = reference.map_or_else(Vec::new, |reference| reference.batches.clone());
    let declared: Vec<String> = declared.into_iter().filter(|id| request.batches.contains(id)).collect();
    let undamaged = || batches.measurements_of(structure, &declared);
    let undamaged = patiently(store, "read the measurements of a job", undamaged).await;
    let undamaged = undamaged.map_err(|e| text(&e))?;
    let undamaged = undamaged.iter().map(|measurement| measurement.measured_at).collect();
    Ok(Study { id, simulator, measurements, undamaged, request, queue: queue.clone() })
}

/// Trains a model on the present thread, which is unwound when the training shall end.
pub(super) fn train_model(queue: &Queue, id: &str, simulator: &Simulator, recipe: &Recipe) -> Result<Trained, String> {
    queue.report(id, format!("simulating {} measurements", recipe.samples));
    let mut watch = Watch::new();
    let trained = recipe.train(simulator, &mut |progress| {
        if let Progress::Round(why) = &progress {
            info!(structure.id = %simulator.id(), training = %id, "Training of {}: {why}", simulator.id());
        }
        if let Some(report) = watch.report(&progress, Instant::now()) {
            queue.report(id, report);
        }
    });
    let trained = trained.map_err(|e| e.to_string())?;
    // The last place where the training can be cancelled.
    queue.report(id, "putting the model into use".to_owned());
    Ok(trained)
}
