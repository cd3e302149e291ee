//! Diagnoses as jobs: one at a time, away from the queue of assessments; and the switch to an extended structure.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use serde::{Deserialize, Serialize};
use tracing::{error, info, warn};

use super::events::{Events, News};
use super::watched::Watched;
use super::{Error, Monitor};
use crate::baseline::observation::DEFAULT_NOISE_RANGE;
use crate::baseline::train::{train, Trained};
use crate::baseline::Baseline;
use crate::discrepancy::data::Data;
use crate::discrepancy::extend::extend;
use crate::discrepancy::{diagnose, report, Holdout, Outcome, Step};
use crate::flow::train::TrainSettings;
use crate::flow::FlowSettings;
use crate::measurement::ModalMeasurement;
use crate::quantity::{Digest, StructureId, Timestamp};
use crate::simulator::definition::StructureDefinition;
use crate::simulator::Simulator;
use crate::store::{DiagnosisRecord, JobKind, JobRecord, JobState, NewVersion, StoredBaseline};

/// Training of an extension of a structure that had no baseline.
const SAMPLES: usize = 200_000;
const EPOCHS: usize = 80;

/// Most measurements of one diagnosis.
const MOST_MEASUREMENTS: usize = 200_000;

/// Most jobs that run or wait.
const MOST_JOBS: usize = 16;

/// What is diagnosed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct DiagnosisRequest {
    /// Batches, by id.
    pub batches: Vec<String>,
    /// Measurements kept for measuring the gain.
    pub holdout: Holdout,
    /// Seed of the bootstrap and, in an extension, of the training.
    pub seed: u64,
}

/// How an extension is trained.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct ExtensionTraining {
    /// Simulated pairs; as the baseline before without.
    pub samples: Option<usize>,
    /// Passes over them; as the baseline before without.
    pub epochs: Option<usize>,
    /// Use the flow even if it fails its calibration; every answer says so then.
    pub accept_uncalibrated: bool,
}

/// What an extension did.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct ExtensionResult {
    /// Effects that were added, by name.
    pub added: Vec<String>,
    /// Causes that were left out, and why.
    pub left_out: Vec<String>,
    /// The new version.
    pub structure_digest: String,
    /// The version that it extends.
    pub parent_digest: String,
    /// Its trained baseline.
    pub model_digest: String,
    /// The undamaged state taken again with it.
    pub undamaged_version: Option<u32>,
}

/// Time between two news of the same job.
const NEWS_EVERY: Duration = Duration::from_millis(200);

/// Where jobs are, by id.
#[derive(Clone)]
pub(super) struct Jobs {
    one_at_a_time: Arc<tokio::sync::Semaphore>,
    running: Arc<Mutex<BTreeMap<String, RunningJob>>>,
    events: Events,
}

/// A job that runs or waits.
struct RunningJob {
    structure: StructureId,
    kind: JobKind,
    progress: String,
    told: Option<Instant>,
}

impl Jobs {
    pub(super) fn new(events: Events) -> Self {
        Self { one_at_a_time: Arc::new(tokio::sync::Semaphore::new(1)), running: Arc::default(), events }
    }

    fn begin(&self, id: &str, structure: &StructureId, kind: JobKind) {
        let job = RunningJob { structure: structure.clone(), kind, progress: String::new(), told: None };
        self.lock().insert(id.to_owned(), job);
        self.say(id, "waiting");
    }

    fn say(&self, id: &str, what: impl Into<String>) {
        let mut running = self.lock();
        let Some(job) = running.get_mut(id) else { return };
        job.progress = what.into();
        // What is left out here is overtaken by the next, or by the end.
        if job.told.is_none_or(|told| told.elapsed() >= NEWS_EVERY) {
            job.told = Some(Instant::now());
            self.events.publish(job.news(id, JobState::Running));
        }
    }

    fn end(&self, id: &str, state: JobState) {
        if let Some(job) = self.lock().remove(id) {
            self.events.publish(job.news(id, state));
        }
    }

    fn waiting(&self) -> usize {
        self.lock().len()
    }

    fn of(&self, id: &str) -> Option<String> {
        self.lock().get(id).map(|job| job.progress.clone())
    }

    fn lock(&self) -> MutexGuard<'_, BTreeMap<String, RunningJob>> {
        self.running.lock().expect("no holder of this lock panics")
    }
}

impl RunningJob {
    fn news(&self, id: &str, state: JobState) -> News {
        let progress = (state == JobState::Running).then(|| self.progress.clone());
        News::Job { job: id.to_owned(), structure: self.structure.clone(), kind: self.kind, state, progress }
    }
}

impl Monitor {
    /// Begins a diagnosis; `batches` empty stands for all.
    ///
    /// # Errors
    /// [`Error::UnknownStructure`], [`Error::UnknownBatch`], [`Error::Store`].
    pub async fn start_diagnosis(
        &self,
        structure: &StructureId,
        request: DiagnosisRequest,
    ) -> Result<DiagnosisRecord, Error> {
        let (monitor, structure) = (self.clone(), structure.clone());
        let task = tokio::spawn(async move { monitor.start_diagnosis_here(&structure, request).await });
        task.await.map_err(|_| Error::Panicked)?
    }

    async fn start_diagnosis_here(
        &self,
        structure: &StructureId,
        mut request: DiagnosisRequest,
    ) -> Result<DiagnosisRecord, Error> {
        let watched = self.structure(structure)?;
        let stored = self.store.batches().batch_sizes(structure).await?;
        if request.batches.is_empty() {
            request.batches = stored.iter().map(|(id, _)| id.clone()).collect();
        }
        let sizes: BTreeMap<&String, usize> = stored.iter().map(|(id, count)| (id, *count)).collect();
        let mut seen = BTreeSet::new();
        let mut found = 0;
        for id in &request.batches {
            if !seen.insert(id) {
                return Err(Error::RepeatedBatch(id.clone()));
            }
            let unknown = || Error::UnknownBatch { structure: structure.clone(), batch: crate::quantity::shown(id) };
            found += sizes.get(id).ok_or_else(unknown)?;
        }
        if found > MOST_MEASUREMENTS {
            return Err(Error::TooManyMeasurements { found, most: MOST_MEASUREMENTS });
        }
        if self.jobs.waiting() >= MOST_JOBS {
            return Err(Error::QueueFull(super::compute::QueueFull));
        }
        let id = uuid::Uuid::now_v7().to_string();
        let json = serde_json::to_string(&request).expect("a request is plain data");
        let digest = watched.simulator.digest();
        self.store.diagnoses().insert_diagnosis(&id, structure, digest, &json, Timestamp::now()).await?;
        self.jobs.begin(&id, structure, JobKind::Diagnosis);
        let (monitor, job, of) = (self.clone(), id.clone(), structure.clone());
        tokio::spawn(async move {
            let outcome = monitor.diagnose_here(&job, &of, &watched.simulator, &request).await;
            let stored = outcome.map_err(|failure| {
                warn!(diagnosis = %job, "Diagnosis {job} failed: {failure}");
                failure
            });
            let stored = stored.map(|(outcome, html)| {
                (serde_json::to_string(&outcome.diagnosis).expect("a diagnosis is plain data"), html)
            });
            let state = if stored.is_ok() { JobState::Done } else { JobState::Failed };
            if let Err(failure) = monitor.store.diagnoses().finish_diagnosis(&job, stored, Timestamp::now()).await {
                error!(diagnosis = %job, "Could not store the end of diagnosis {job}: {failure}");
            }
            monitor.jobs.end(&job, state);
        });
        self.diagnosis(&id).await.map(|(record, _)| record)
    }

    async fn diagnose_here(
        &self,
        id: &str,
        structure: &StructureId,
        simulator: &Simulator,
        request: &DiagnosisRequest,
    ) -> Result<(Outcome, Option<String>), String> {
        let _turn = self.jobs.one_at_a_time.acquire().await.expect("the semaphore is never closed");
        let measurements =
            self.store.batches().measurements_of(structure, &request.batches).await.map_err(|e| e.to_string())?;
        let (jobs, id, simulator, request) = (self.jobs.clone(), id.to_owned(), simulator.clone(), request.clone());
        let work = move || {
            let (data, outcome) = study(&jobs, &id, &simulator, &measurements, &request)?;
            let html = report::html(&simulator, &data, &outcome);
            Ok((outcome, html))
        };
        tokio::task::spawn_blocking(work).await.map_err(|_| "the diagnosis panicked".to_owned())?
    }

    /// A diagnosis, and what its job does now.
    ///
    /// # Errors
    /// [`Error::UnknownDiagnosis`], [`Error::Store`].
    pub async fn diagnosis(&self, id: &str) -> Result<(DiagnosisRecord, Option<String>), Error> {
        let record = self.store.diagnoses().diagnosis(id).await?;
        let record = record.ok_or_else(|| Error::UnknownDiagnosis(crate::quantity::shown(id)))?;
        Ok((record, self.jobs.of(id)))
    }

    /// Diagnoses and extensions, newest first, at most `limit`, each with what it does now if it runs.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn jobs(&self, limit: usize) -> Result<Vec<(JobRecord, Option<String>)>, Error> {
        let records = self.store.diagnoses().jobs(limit).await?;
        let with_progress = |record: JobRecord| {
            let running = record.state == JobState::Running;
            let progress = running.then(|| self.jobs.of(&record.id)).flatten();
            (record, progress)
        };
        Ok(records.into_iter().map(with_progress).collect())
    }

    /// Jobs that run or wait.
    pub fn jobs_running(&self) -> usize {
        self.jobs.waiting()
    }

    /// Begins to extend the structure with the causes of a diagnosis: a new version of the structure, a baseline trained for
    /// it, and all batches assessed again.
    ///
    /// # Errors
    /// [`Error::UnknownDiagnosis`], [`Error::NoExtension`] when it is not done, when the structure has changed since, or when
    /// an extension runs.
    pub async fn start_extension(&self, id: &str, training: ExtensionTraining) -> Result<DiagnosisRecord, Error> {
        let (monitor, id) = (self.clone(), id.to_owned());
        let task = tokio::spawn(async move { monitor.start_extension_here(&id, training).await });
        task.await.map_err(|_| Error::Panicked)?
    }

    async fn start_extension_here(&self, id: &str, training: ExtensionTraining) -> Result<DiagnosisRecord, Error> {
        let (record, _) = self.diagnosis(id).await?;
        let watched = self.structure(&record.structure)?;
        let refuse = |why: &str| Error::NoExtension { diagnosis: id.to_owned(), reason: why.to_owned() };
        if record.state != JobState::Done {
            return Err(refuse("it is not done"));
        }
        if record.structure_digest != *watched.simulator.digest() {
            return Err(refuse("the structure is another version now: diagnose that one"));
        }
        if !self.store.diagnoses().begin_extension(id, Timestamp::now()).await? {
            return Err(refuse("it is being extended"));
        }
        self.jobs.begin(id, &record.structure, JobKind::Extension);
        let (monitor, job) = (self.clone(), id.to_owned());
        let begun = self.diagnosis(id).await?.0;
        tokio::spawn(async move {
            let outcome = monitor.extend_here(&record, &watched, training).await;
            if let Err(failure) = &outcome {
                warn!(diagnosis = %job, "Extension by diagnosis {job} failed: {failure}");
            }
            let state = if outcome.is_ok() { JobState::Done } else { JobState::Failed };
            if let Err(failure) = monitor.store.diagnoses().finish_extension(&job, outcome, Timestamp::now()).await {
                error!(diagnosis = %job, "Could not store the end of the extension by {job}: {failure}");
            }
            monitor.jobs.end(&job, state);
        });
        Ok(begun)
    }

    async fn extend_here(
        &self,
        record: &DiagnosisRecord,
        watched: &Watched,
        training: ExtensionTraining,
    ) -> Result<String, String> {
        let simulator = &watched.simulator;
        // Trained as the baseline before it, for the same noise.
        let before = watched.baseline.as_ref().ok().map(|baseline| baseline.manifest());
        let noise_range = before.and_then(|m| m.conditions.noise_range).unwrap_or(DEFAULT_NOISE_RANGE);
        let samples = training.samples.or(before.map(|m| m.training.samples)).unwrap_or(SAMPLES);
        let epochs = training.epochs.or(before.map(|m| m.training.settings.epochs)).unwrap_or(EPOCHS);
        let said = |e: &dyn std::fmt::Display| e.to_string();
        let _turn = self.jobs.one_at_a_time.acquire().await.expect("the semaphore is never closed");
        if self.structure(&record.structure).map_err(|e| said(&e))?.simulator.digest() != simulator.digest() {
            return Err("the structure became another version while this waited: diagnose that one".to_owned());
        }
        let request: DiagnosisRequest = serde_json::from_str(&record.request).map_err(|e| said(&e))?;
        let structure = &record.structure;
        let measurements =
            self.store.batches().measurements_of(structure, &request.batches).await.map_err(|e| said(&e))?;
        let mut flow = FlowSettings::default();
        flow.units = before.map_or(flow.units, |m| m.architecture.units);
        let (jobs, id, old) = (self.jobs.clone(), record.id.clone(), simulator.clone());
        let work = move || -> Result<_, String> {
            // The fits are not stored: the same data and seed give them again.
            let (data, outcome) = study(&jobs, &id, &old, &measurements, &request)?;
            let extended = extend(&old, &data, &outcome).map_err(|e| e.to_string())?;
            let simulator = Simulator::new(extended.definition.clone()).map_err(|e| e.to_string())?;
            let settings = TrainSettings { epochs, seed: request.seed, ..TrainSettings::default() };
            let trained = train(&simulator, samples, noise_range, &flow, &settings, |epoch| {
                jobs.say(&id, format!("training: epoch {} of {epochs}", epoch.epoch));
            });
            jobs.say(&id, "switching");
            Ok((extended, simulator, trained.map_err(|e| e.to_string())?))
        };
        let done = tokio::task::spawn_blocking(work).await.map_err(|_| "the extension panicked".to_owned())?;
        let (extended, extended_simulator, trained) = done?;
        let accepted = training.accept_uncalibrated && self.usable(&trained.baseline).is_err();
        if !accepted {
            let refused = |_| {
                let failures = &trained.baseline.manifest().calibration.failures;
                format!(
                    "the new flow failed its calibration ({}): ask again with more samples or epochs, or with \
                     \"accept_uncalibrated\": true to use it all the same, which every answer will say",
                    failures.join("; ")
                )
            };
            self.usable(&trained.baseline).map_err(refused)?;
        }
        let Trained { baseline, manifest_json, weights } = trained;
        let version = NewVersion {
            digest: extended_simulator.digest().clone(),
            definition_json: extended_simulator.definition().canonical_json(),
            parent: Some(simulator.digest().clone()),
            diagnosis: Some(record.id.clone()),
            baseline: Some(StoredBaseline {
                model_digest: baseline.digest().to_string(),
                manifest: manifest_json,
                weights,
                accepted,
            }),
        };
        let model_digest = baseline.digest().to_string();
        let undamaged_version =
            self.switch(structure, simulator.digest(), version, extended_simulator.clone(), Arc::new(baseline)).await;
        let result = ExtensionResult {
            added: extended.added,
            left_out: extended.left_out,
            structure_digest: extended_simulator.digest().to_string(),
            parent_digest: simulator.digest().to_string(),
            model_digest,
            undamaged_version: undamaged_version.map_err(|e| said(&e))?,
        };
        info!(structure.id = %structure, diagnosis = %record.id, "Extended {structure}: {}", result.added.join("; "));
        Ok(serde_json::to_string(&result).expect("a result is plain data"))
    }

    /// One step back: the version that the present one extends, with its baseline; all batches are assessed again.
    ///
    /// # Errors
    /// [`Error::NoStepBack`] when the present version extends none.
    pub async fn step_back(&self, structure: &StructureId) -> Result<Digest, Error> {
        let (monitor, structure) = (self.clone(), structure.clone());
        // A task of its own: a client that goes away must not stop it half-way.
        let task = tokio::spawn(async move { monitor.step_back_here(&structure).await });
        task.await.map_err(|_| Error::Panicked)?
    }

    async fn step_back_here(&self, structure: &StructureId) -> Result<Digest, Error> {
        let watched = self.structure(structure)?;
        let none = || Error::NoStepBack(structure.clone());
        let present = watched.simulator.digest().clone();
        let (_, parent) = self.store.structures().structure_version(structure, &present).await?.ok_or_else(none)?;
        let parent = parent.ok_or_else(none)?;
        let (definition, grandparent) =
            self.store.structures().structure_version(structure, &parent).await?.ok_or_else(none)?;
        let simulator = Simulator::new(StructureDefinition::parse_json(&definition)?)?;
        let missing = |reason| Error::NoModel { structure: structure.clone(), reason };
        let baseline = self.baseline_for(&simulator).await?.map_err(missing)?;
        let version = NewVersion {
            digest: parent.clone(),
            definition_json: definition,
            parent: grandparent,
            diagnosis: None,
            baseline: None,
        };
        self.switch(structure, &present, version, simulator, baseline).await?;
        info!(structure.id = %structure, "Went back to version {parent} of {structure}");
        Ok(parent)
    }

    /// Puts another version in the place of `expected`; the undamaged batches are taken as that under it too. Version of the
    /// undamaged state.
    async fn switch(
        &self,
        structure: &StructureId,
        expected: &Digest,
        version: NewVersion,
        simulator: Simulator,
        baseline: Arc<Baseline>,
    ) -> Result<Option<u32>, Error> {
        if !self.store.structures().switch_version(structure, expected, version, Timestamp::now()).await? {
            return Err(Error::VersionChanged(structure.clone()));
        }
        let watched = Arc::new(Watched { simulator, baseline: Ok(baseline) });
        self.watched.write().expect("no holder of this lock panics").insert(structure.clone(), watched);
        self.tell_structure(structure);
        let taken = self.retake_undamaged(structure).await;
        self.resume_later(structure.clone());
        Ok(taken)
    }
}

/// Data and outcome of a request.
fn study(
    jobs: &Jobs,
    id: &str,
    simulator: &Simulator,
    measurements: &[ModalMeasurement],
    request: &DiagnosisRequest,
) -> Result<(Data, Outcome), String> {
    let data = Data::new(simulator, measurements);
    let progress = |step: Step| jobs.say(id, step.to_string());
    let outcome = diagnose(simulator, &data, &request.holdout, request.seed, &progress).map_err(|e| e.to_string())?;
    Ok((data, outcome))
}
