//! Trainings of the model of a structure, as jobs.

use std::sync::Arc;
use std::time::Instant;

use serde::{Deserialize, Serialize};
use tracing::info;

use super::by_worker::Computer;
use super::halt::{computed, Halt};
use super::queue::{JobStatus, Queue};
use super::runner::{switch, JobOutput, Jobs};
use super::study::train_model;
use super::task::{delivered_training, Task};
use crate::baseline::manifest::{Manifest, Outcome};
use crate::baseline::recipe::RecipeRequest;
use crate::baseline::rounds::MOST_ROUNDS;
use crate::baseline::starting::starting_model;
use crate::baseline::train::Trained;
use crate::clock;
use crate::monitor::error::{Error, JobError};
use crate::monitor::own_task::in_own_task;
use crate::quantity::{shown, Digest, StructureId};
use crate::simulator::Simulator;
use crate::store::{JobKind, NewTraining, NewVersion, StoredBaseline, TrainingJobRecord};

/// Largest number of coupling units that a next step names.
const MOST_UNITS: usize = 64;

/// Reasons of a calibration that the sentence of a result names.
const MOST_NAMED: usize = 3;

/// How a model is trained, and whether it is used in any case.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainingRequest {
    /// Samples, epochs and so on; `None` for the defaults of `modalwatch train`.
    pub recipe: RecipeRequest,
    /// Use the model even if it is overconfident; every assessment then has a finding about it.
    pub accept_uncalibrated: bool,
}

/// The result of a training.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct TrainingResult {
    /// What the calibration says about the use of the model.
    pub outcome: Outcome,
    /// The outcome in sentences, with the next step where there is one.
    pub summary: String,
    /// Where intervals are too narrow or too wide, in sentences.
    pub reasons: Vec<String>,
    /// Whether the model was put into use.
    pub in_use: bool,
    /// Digest of the model: the same as that of `modalwatch train` with the same recipe.
    pub model_digest: String,
    /// Number of simulated pairs.
    pub samples: usize,
    /// Epochs of the first round.
    pub epochs: usize,
    /// Number of coupling units of the network.
    pub units: usize,
    /// Rounds that were trained.
    pub rounds: usize,
    /// Seed of all random numbers.
    pub seed: u64,
    /// Duration of the training, s.
    pub seconds: f64,
    /// Version of the undamaged reference that was renewed with it.
    pub undamaged_version: Option<u32>,
}

impl Jobs {
    /// Starts to train a model for the present version of a structure. If it may be used, it is put into use, and all batches are
    /// assessed again.
    ///
    /// # Errors
    /// [`Error::UnknownStructure`], [`JobError::TooManyJobs`]; [`JobError::TrainingRuns`] when one of the structure runs or waits.
    pub async fn start_training(
        &self,
        structure: &StructureId,
        request: TrainingRequest,
    ) -> Result<TrainingJobRecord, JobError> {
        let (jobs, structure) = (self.clone(), structure.clone());
        in_own_task(async move { jobs.start_training_here(&structure, request).await }).await
    }

    async fn start_training_here(
        &self,
        structure: &StructureId,
        request: TrainingRequest,
    ) -> Result<TrainingJobRecord, JobError> {
        let _change = self.structures.change().await;
        let active = self.structures.get(structure)?;
        if let Some(training) = self.queue.training_of(structure) {
            return Err(JobError::TrainingRuns { structure: structure.clone(), training });
        }
        self.queue.check_room()?;
        let id = uuid::Uuid::now_v7().to_string();
        let new = NewTraining {
            id: id.clone(),
            structure: structure.clone(),
            structure_digest: active.simulator.digest().clone(),
            request: serde_json::to_string(&request).expect("a request is plain data"),
        };
        self.store.trainings().insert(new, clock::now()).await?;
        let record = self.store.trainings().training(&id).await?;
        let record = record.ok_or_else(|| JobError::UnknownTraining(id.clone()))?;
        run_training(self, &record, request);
        Ok(record)
    }

    /// A training, and what its job is doing now.
    ///
    /// # Errors
    /// [`JobError::UnknownTraining`], [`Error::Store`].
    pub async fn training(&self, id: &str) -> Result<(TrainingJobRecord, Option<JobStatus>), JobError> {
        let record = self.store.trainings().training(id).await?;
        let record = record.ok_or_else(|| JobError::UnknownTraining(shown(id)))?;
        Ok((seen(&self.queue, record), self.queue.status(id)))
    }

    /// Trainings of a structure, newest first, at most `limit`.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn trainings(&self, structure: &StructureId, limit: usize) -> Result<Vec<TrainingJobRecord>, Error> {
        let records = self.store.trainings().list(structure, limit).await?;
        Ok(records.into_iter().map(|record| seen(&self.queue, record)).collect())
    }
}

/// A training in the state that people see.
fn seen(queue: &Queue, record: TrainingJobRecord) -> TrainingJobRecord {
    TrainingJobRecord { state: queue.seen_state(&record.id, JobKind::Training, record.state), ..record }
}

pub(super) fn run_training(jobs: &Jobs, record: &TrainingJobRecord, request: TrainingRequest) {
    let (own, id) = (jobs.clone(), record.id.clone());
    let (structure, digest) = (record.structure.clone(), record.structure_digest.clone());
    let train = async move { train(&own, id, &structure, &digest, request).await };
    jobs.run(&record.id, &record.structure, (JobKind::Training, None), train);
}

/// Trains a model and puts it into use if it may be; the result as JSON.
async fn train(
    jobs: &Jobs,
    id: String,
    structure: &StructureId,
    digest: &Digest,
    request: TrainingRequest,
) -> JobOutput {
    let text = |e: &dyn std::fmt::Display| e.to_string();
    let active = jobs.structures.get(structure).map_err(|e| text(&e))?;
    if active.simulator.digest() != digest {
        let changed = "the structure changed to another version while the training waited: train the present version";
        return Err(Halt::Failed(changed.to_owned()));
    }
    let (simulator, started) = (active.simulator.clone(), Instant::now());
    let task = Task::Training { version: digest.clone(), recipe: request.recipe };
    let trained = match jobs.workers.compute(&id, structure, JobKind::Training, &task).await? {
        Computer::Worker(result) => delivered_training(result, simulator.clone()).await?,
        Computer::Here(_place) => {
            let recipe = request.recipe.recipe(&simulator);
            let (queue, id, simulator) = (jobs.queue.clone(), id.clone(), simulator.clone());
            computed("training", move || train_model(&queue, &id, &simulator, &recipe)).await?
        }
    };
    let usable = jobs.structures.usable(&trained.baseline).is_ok();
    let in_use = usable || request.accept_uncalibrated;
    let seconds = started.elapsed().as_secs_f64();
    let mut result = TrainingResult { seconds, ..result(&trained, simulator.is_noisy(), in_use) };
    jobs.queue.begin_storing(&id)?;
    if in_use {
        result.undamaged_version = put_into_use(jobs, simulator, trained, !usable).await?;
    }
    info!(structure.id = %structure, training = %id, "Trained {structure}: {}", result.summary);
    Ok((serde_json::to_string(&result).expect("a result is plain data"), None))
}

/// Makes a model of the present version of a structure in about a second and puts it into use, so that batches are assessed before one is
/// trained.
///
/// # Errors
/// Why there is none.
pub(in crate::monitor) async fn answer_at_once(jobs: &Jobs, simulator: &Simulator) -> Result<(), String> {
    let of = simulator.clone();
    let made = tokio::task::spawn_blocking(move || starting_model(&of).map_err(|e| e.to_string()));
    let made = made.await.unwrap_or_else(|_| Err(Error::Panicked.to_string()))?;
    put_into_use(jobs, simulator.clone(), made, false).await.map(drop)
}

/// Stores a model and puts it into use for the version that it was trained for. Returns the version of the renewed reference.
async fn put_into_use(
    jobs: &Jobs,
    simulator: Simulator,
    trained: Trained,
    accepted: bool,
) -> Result<Option<u32>, String> {
    let digest = simulator.digest().clone();
    let Trained { baseline, manifest_json, weights } = trained;
    let model_digest = baseline.digest().to_string();
    let version = NewVersion {
        digest: digest.clone(),
        definition_json: simulator.definition().canonical_json(),
        // A version that is an extension keeps its row, which names its parent.
        parent: None,
        diagnosis: None,
        baseline: Some(StoredBaseline { model_digest, manifest: manifest_json, weights, accepted }),
    };
    switch(jobs, &digest, version, simulator, Arc::new(baseline)).await
}

/// The result of a training, without its duration and the renewed reference.
fn result(trained: &Trained, is_noisy: bool, in_use: bool) -> TrainingResult {
    let manifest = trained.baseline.manifest();
    let settings = &manifest.training.settings;
    TrainingResult {
        outcome: manifest.calibration.outcome(),
        summary: summary(manifest, is_noisy, in_use),
        reasons: manifest.calibration.reasons().map(str::to_owned).collect(),
        in_use,
        model_digest: trained.baseline.digest().to_string(),
        samples: manifest.training.samples,
        epochs: settings.epochs,
        units: manifest.architecture.units,
        rounds: 1 + manifest.training.further_rounds.len(),
        seed: settings.seed,
        seconds: 0.0,
        undamaged_version: None,
    }
}

/// The outcome of a training in sentences, with the next step.
fn summary(manifest: &Manifest, is_noisy: bool, in_use: bool) -> String {
    let calibration = &manifest.calibration;
    let (cells, simulations) = (calibration.cells.len(), calibration.simulations);
    let again = format!(
        "train again with {} epochs, {} units and {MOST_ROUNDS} rounds",
        2 * manifest.training.settings.epochs,
        (2 * manifest.architecture.units).min(MOST_UNITS)
    );
    let reasons = |all: &[String]| {
        let named = all.iter().take(MOST_NAMED).map(String::as_str).collect::<Vec<_>>().join("; ");
        let further = all.len().saturating_sub(MOST_NAMED);
        if further == 0 {
            named
        } else {
            format!("{named}; and {further} more")
        }
    };
    match calibration.outcome() {
        Outcome::Passed => format!(
            "The calibration passed: the intervals hold the stated share of the true values in {cells} situations of {simulations} \
             simulated measurements each. The model is in use."
        ),
        Outcome::NotMeasured => "The calibration was not measured. The model is in use.".to_owned(),
        Outcome::Cautious => format!(
            "The model is cautious: some of its intervals are wider than they need to be and none is too narrow, so that a small \
             change may be noticed later than possible ({}). The model is in use. For narrower intervals, {again}.",
            reasons(&calibration.cautions)
        ),
        Outcome::Overconfident => {
            let failures = reasons(&calibration.failures);
            let next = if is_noisy {
                format!("Next: {again}")
            } else {
                "Next: state measurement_noise in the definition of the structure, and train again".to_owned()
            };
            if in_use {
                format!(
                    "The model is overconfident: some of its intervals are too narrow or misplaced ({failures}). It is in use because \
                     this was requested, and every assessment has a finding about it. {next}."
                )
            } else {
                format!(
                    "The model is overconfident: some of its intervals are too narrow or misplaced ({failures}). It is not used. {next}. \
                     To use such a model nevertheless, train with \"accept_uncalibrated\": true; every assessment then has a finding \
                     about it."
                )
            }
        }
    }
}
