//! Diagnoses and extensions as jobs: one at a time, outside the queue of assessments.

mod progress;
mod study;

use std::collections::{BTreeMap, BTreeSet};
use std::future::Future;
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use tokio::sync::Semaphore;
use tracing::{error, info, warn};

use self::progress::Progress;
use self::study::Study;
pub use self::study::{DiagnosisRequest, ExtensionTraining};
use super::compute::QueueFull;
use super::error::{Error, JobError};
use super::events::Events;
use super::own_task::in_own_task;
use super::structures::{ActiveStructure, ActiveStructures};
use super::versions::Versions;
use crate::baseline::train::Trained;
use crate::discrepancy::{Holdout, FEWEST_ROWS};
use crate::quantity::{shown, StructureId, Timestamp};
use crate::simulator::Simulator;
use crate::store::{
    DiagnosisRecord, DiagnosisTrigger, JobKind, JobRecord, JobState, NewDiagnosis, NewVersion, Store, StoredBaseline,
};

/// Largest number of measurements of one diagnosis.
const MOST_MEASUREMENTS: usize = 200_000;

/// Largest number of jobs that run or wait.
const MOST_JOBS: usize = 16;

/// The result of an extension.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct ExtensionResult {
    /// Effects that were added, by name.
    pub added: Vec<String>,
    /// Causes that were left out, and why.
    pub left_out: Vec<String>,
    /// Digest of the new version of the structure.
    pub structure_digest: String,
    /// Digest of the version that it extends.
    pub parent_digest: String,
    /// Digest of the trained baseline for the new version.
    pub model_digest: String,
    /// Digest of the trained baseline whose weights its training started from; `None` for random weights.
    #[serde(default)]
    pub trained_from: Option<String>,
    /// Version of the undamaged reference that was renewed with it.
    pub undamaged_version: Option<u32>,
}

/// Result of a job as JSON, with the report of a diagnosis as HTML; or why it failed.
type JobOutput = Result<(String, Option<String>), String>;

/// Starts jobs and reads their results.
#[derive(Clone)]
pub struct Jobs {
    store: Store,
    structures: Arc<ActiveStructures>,
    versions: Versions,
    one_at_a_time: Arc<Semaphore>,
    progress: Progress,
}

impl Jobs {
    pub(super) fn new(store: Store, structures: Arc<ActiveStructures>, versions: Versions, events: Events) -> Self {
        let one_at_a_time = Arc::new(Semaphore::new(1));
        Self { store, structures, versions, one_at_a_time, progress: Progress::new(events) }
    }

    /// Marks the jobs that were running when the service last stopped as failed.
    pub(super) async fn end_interrupted(&self) -> Result<(), Error> {
        let interrupted = self.store.diagnoses().end_interrupted_jobs(Timestamp::now()).await?;
        if interrupted > 0 {
            warn!("Marked {interrupted} diagnoses or extensions as failed, because they were running when the service stopped");
        }
        Ok(())
    }

    /// Starts a diagnosis of the requested batches, or of all batches if the request names none.
    ///
    /// # Errors
    /// [`Error::UnknownStructure`], [`Error::UnknownBatch`], [`Error::QueueFull`], [`JobError`].
    pub async fn start_diagnosis(
        &self,
        structure: &StructureId,
        request: DiagnosisRequest,
    ) -> Result<DiagnosisRecord, JobError> {
        let (jobs, structure, why) = (self.clone(), structure.clone(), (DiagnosisTrigger::Requested, None));
        in_own_task(async move { jobs.start_diagnosis_here(structure, request, why).await }).await
    }

    /// The request for all batches of a structure, or for the newest ones if all have more measurements than a diagnosis can use.
    /// `None` if the structure has too few measurements for a diagnosis.
    pub(super) async fn request_for_all(
        &self,
        structure: &StructureId,
        holdout: Holdout,
    ) -> Result<Option<DiagnosisRequest>, Error> {
        let stored = self.store.batches().batch_sizes(structure).await?;
        let batches = newest(&stored);
        Ok((!batches.is_empty()).then(|| DiagnosisRequest { batches, holdout, ..DiagnosisRequest::default() }))
    }

    /// Starts a diagnosis that nobody requested; `alarm` is the number of the alarm because of which it is started.
    ///
    /// # Errors
    /// [`Error::UnknownStructure`], [`Error::QueueFull`], [`Error::Store`].
    pub(super) async fn start_automatic_diagnosis(
        &self,
        structure: &StructureId,
        request: DiagnosisRequest,
        trigger: DiagnosisTrigger,
        alarm: Option<i64>,
    ) -> Result<DiagnosisRecord, JobError> {
        let (jobs, structure) = (self.clone(), structure.clone());
        in_own_task(async move { jobs.start_diagnosis_here(structure, request, (trigger, alarm)).await }).await
    }

    async fn start_diagnosis_here(
        self,
        structure: StructureId,
        mut request: DiagnosisRequest,
        (trigger, alarm): (DiagnosisTrigger, Option<i64>),
    ) -> Result<DiagnosisRecord, JobError> {
        let active = self.structures.get(&structure)?;
        let stored = self.store.batches().batch_sizes(&structure).await?;
        if request.batches.is_empty() {
            request.batches = stored.iter().map(|(id, _)| id.clone()).collect();
        }
        check_batches(&structure, &stored, &request.batches)?;
        if self.running() >= MOST_JOBS {
            return Err(Error::QueueFull(QueueFull).into());
        }
        let id = uuid::Uuid::now_v7().to_string();
        let simulator = active.simulator.clone();
        let new = NewDiagnosis {
            id: id.clone(),
            structure: structure.clone(),
            structure_digest: simulator.digest().clone(),
            request: serde_json::to_string(&request).expect("a request is plain data"),
            trigger,
            alarm,
        };
        self.store.diagnoses().insert_diagnosis(new, Timestamp::now()).await?;
        let (jobs, job) = (self.clone(), id.clone());
        let diagnose = async move {
            let _turn = jobs.turn().await;
            let study = jobs.study(job, &structure, simulator, request).await?;
            let diagnosed = tokio::task::spawn_blocking(move || study.diagnose()).await;
            diagnosed.map_err(|_| "the diagnosis panicked".to_owned())?
        };
        self.run(&id, active.simulator.id(), (JobKind::Diagnosis, Some(trigger)), diagnose);
        Ok(self.diagnosis(&id).await?.0)
    }

    /// Starts to extend a structure by the causes of a diagnosis: a new version of the structure and a trained baseline for it. All
    /// batches are assessed again.
    ///
    /// # Errors
    /// [`JobError::UnknownDiagnosis`]; [`JobError::NoExtension`] when the diagnosis is not done, when the structure has changed since,
    /// or when an extension by it is running.
    pub async fn start_extension(&self, id: &str, training: ExtensionTraining) -> Result<DiagnosisRecord, JobError> {
        let (jobs, id) = (self.clone(), id.to_owned());
        in_own_task(async move { jobs.start_extension_here(&id, training).await }).await
    }

    async fn start_extension_here(&self, id: &str, training: ExtensionTraining) -> Result<DiagnosisRecord, JobError> {
        let (record, _) = self.diagnosis(id).await?;
        let active = self.structures.get(&record.structure)?;
        let refuse = |why: &str| JobError::NoExtension { diagnosis: id.to_owned(), reason: why.to_owned() };
        if record.state != JobState::Done {
            return Err(refuse("the diagnosis has not finished"));
        }
        if record.structure_digest != *active.simulator.digest() {
            return Err(refuse("the structure has another version now: diagnose the present version"));
        }
        if !self.store.diagnoses().begin_extension(id, Timestamp::now()).await? {
            return Err(refuse("an extension by this diagnosis is running"));
        }
        let begun = self.diagnosis(id).await?.0;
        let (jobs, structure) = (self.clone(), record.structure.clone());
        let extend = async move { jobs.extend(&record, active, training).await.map(|result| (result, None)) };
        self.run(id, &structure, (JobKind::Extension, None), extend);
        Ok(begun)
    }

    /// Runs a job in the background and stores its result.
    fn run(
        &self,
        id: &str,
        structure: &StructureId,
        (kind, trigger): (JobKind, Option<DiagnosisTrigger>),
        work: impl Future<Output = JobOutput> + Send + 'static,
    ) {
        self.progress.begin(id, structure, kind, trigger);
        let (jobs, id, name) = (self.clone(), id.to_owned(), kind_name(kind));
        tokio::spawn(async move {
            let output = work.await;
            if let Err(failure) = &output {
                warn!(diagnosis = %id, "The {name} {id} failed: {failure}");
            }
            let state = if output.is_ok() { JobState::Done } else { JobState::Failed };
            let stored = match kind {
                JobKind::Diagnosis => jobs.store.diagnoses().finish_diagnosis(&id, output, Timestamp::now()).await,
                JobKind::Extension => {
                    jobs.store
                        .diagnoses()
                        .finish_extension(&id, output.map(|(result, _)| result), Timestamp::now())
                        .await
                }
            };
            if let Err(failure) = stored {
                error!(diagnosis = %id, "Could not store the result of the {name} {id}: {failure}");
            }
            jobs.progress.end(&id, state);
        });
    }

    /// Waits until no other job computes.
    async fn turn(&self) -> tokio::sync::SemaphorePermit<'_> {
        self.one_at_a_time.acquire().await.expect("the semaphore is never closed")
    }

    /// Reads the measurements on which a job computes.
    async fn study(
        &self,
        id: String,
        structure: &StructureId,
        simulator: Simulator,
        request: DiagnosisRequest,
    ) -> Result<Study, String> {
        let batches = self.store.batches();
        let text = |e: &dyn std::fmt::Display| e.to_string();
        let mut measurements = batches.measurements_of(structure, &request.batches).await.map_err(|e| text(&e))?;
        let all = measurements.len();
        measurements.retain(|measurement| request.contains(measurement.measured_at));
        if let (true, Some(period)) = (measurements.len() < FEWEST_ROWS, request.period_in_words()) {
            return Err(format!(
                "{period}, and these are {} of {all}: a diagnosis needs at least {FEWEST_ROWS}",
                measurements.len()
            ));
        }
        let reference = self.store.reference().undamaged(structure).await.map_err(|e| text(&e))?;
        let declared = reference.map_or_else(Vec::new, |reference| reference.batches.clone());
        let declared: Vec<String> = declared.into_iter().filter(|id| request.batches.contains(id)).collect();
        let undamaged = batches.measurements_of(structure, &declared).await.map_err(|e| text(&e))?;
        let undamaged = undamaged.iter().map(|measurement| measurement.measured_at).collect();
        Ok(Study { id, simulator, measurements, undamaged, request, progress: self.progress.clone() })
    }

    /// Extends a structure and puts the extension into use; the result as JSON.
    async fn extend(
        &self,
        record: &DiagnosisRecord,
        active: Arc<ActiveStructure>,
        training: ExtensionTraining,
    ) -> Result<String, String> {
        let text = |e: &dyn std::fmt::Display| e.to_string();
        let (structure, parent) = (&record.structure, active.simulator.digest().clone());
        let _turn = self.turn().await;
        if *self.structures.get(structure).map_err(|e| text(&e))?.simulator.digest() != parent {
            return Err(
                "the structure changed to another version while the extension waited: diagnose the present version"
                    .to_owned(),
            );
        }
        let request: DiagnosisRequest = serde_json::from_str(&record.request).map_err(|e| text(&e))?;
        let study = self.study(record.id.clone(), structure, active.simulator.clone(), request).await?;
        let work = move || study.extend(active.baseline.as_ref().ok().map(Arc::as_ref), training);
        let extended = tokio::task::spawn_blocking(work).await.map_err(|_| "the extension panicked".to_owned())??;
        let accepted = self.accepted(&extended.trained, training)?;
        let Trained { baseline, manifest_json, weights } = extended.trained;
        let trained_from = baseline.manifest().training.parent.as_ref().map(ToString::to_string);
        let (structure_digest, model_digest) = (extended.simulator.digest().clone(), baseline.digest().to_string());
        let version = NewVersion {
            digest: structure_digest.clone(),
            definition_json: extended.simulator.definition().canonical_json(),
            parent: Some(parent.clone()),
            diagnosis: Some(record.id.clone()),
            baseline: Some(StoredBaseline {
                model_digest: model_digest.clone(),
                manifest: manifest_json,
                weights,
                accepted,
            }),
        };
        let switched = self.versions.switch(&parent, version, extended.simulator, Arc::new(baseline)).await;
        let result = ExtensionResult {
            added: extended.added,
            left_out: extended.left_out,
            structure_digest: structure_digest.to_string(),
            parent_digest: parent.to_string(),
            model_digest,
            trained_from,
            undamaged_version: switched.map_err(|e| text(&e))?,
        };
        info!(structure.id = %structure, diagnosis = %record.id, "Extended {structure}: {}", result.added.join("; "));
        Ok(serde_json::to_string(&result).expect("a result is plain data"))
    }

    /// Returns true if an overconfident flow is accepted by the request, and false if the flow may be used without that; an error if
    /// the flow may not be used.
    fn accepted(&self, trained: &Trained, training: ExtensionTraining) -> Result<bool, String> {
        match self.structures.usable(&trained.baseline) {
            Ok(()) => Ok(false),
            Err(_) if training.accept_uncalibrated => Ok(true),
            Err(_) => {
                let failures = &trained.baseline.manifest().calibration.failures;
                Err(format!(
                    "the new flow failed its calibration: it is overconfident ({}): repeat the request with \"from_scratch\": true or a larger number of \
                     \"epochs\"; to use the flow nevertheless, set \"accept_uncalibrated\" to true, and every assessment then has a \
                     finding about it",
                    failures.join("; ")
                ))
            }
        }
    }

    /// A diagnosis, and what its job is doing now.
    ///
    /// # Errors
    /// [`JobError::UnknownDiagnosis`], [`Error::Store`].
    pub async fn diagnosis(&self, id: &str) -> Result<(DiagnosisRecord, Option<String>), JobError> {
        let record = self.store.diagnoses().diagnosis(id).await?;
        let record = record.ok_or_else(|| JobError::UnknownDiagnosis(shown(id)))?;
        Ok((record, self.progress.of(id)))
    }

    /// Diagnoses of a structure, newest first, at most `limit`.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn diagnoses(&self, structure: &StructureId, limit: usize) -> Result<Vec<DiagnosisRecord>, Error> {
        Ok(self.store.diagnoses().list(structure, limit).await?)
    }

    /// The report of a diagnosis as HTML; `None` where there is none yet.
    ///
    /// # Errors
    /// [`JobError::UnknownDiagnosis`], [`Error::Store`].
    pub async fn report(&self, id: &str) -> Result<Option<String>, JobError> {
        self.diagnosis(id).await?;
        Ok(self.store.diagnoses().diagnosis_report(id).await?)
    }

    /// Diagnoses and extensions, newest first, at most `limit`, each with what it is doing now if it runs.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn list(&self, limit: usize) -> Result<Vec<(JobRecord, Option<String>)>, Error> {
        let records = self.store.diagnoses().jobs(limit).await?;
        let with_progress = |record: JobRecord| {
            let running = record.state == JobState::Running;
            let progress = running.then(|| self.progress.of(&record.id)).flatten();
            (record, progress)
        };
        Ok(records.into_iter().map(with_progress).collect())
    }

    /// Whether a job of a structure runs or waits, or no job can be added.
    pub(super) fn is_busy(&self, structure: &StructureId) -> bool {
        self.progress.has(structure) || self.running() >= MOST_JOBS
    }

    /// Number of jobs that run or wait.
    pub fn running(&self) -> usize {
        self.progress.count()
    }
}

/// The newest of the stored batches, given with their sizes in the order of time, that one diagnosis can use; empty if they have too
/// few measurements.
fn newest(stored: &[(String, usize)]) -> Vec<String> {
    let mut found = 0;
    let fits = |(_, count): &&(String, usize)| {
        found += count;
        found <= MOST_MEASUREMENTS
    };
    let mut newest: Vec<(String, usize)> = stored.iter().rev().take_while(fits).cloned().collect();
    newest.reverse();
    let enough = newest.iter().map(|(_, count)| count).sum::<usize>() >= FEWEST_ROWS;
    if enough {
        newest.into_iter().map(|(id, _)| id).collect()
    } else {
        Vec::new()
    }
}

/// Checks the batches of a request against those stored, with their sizes.
fn check_batches(structure: &StructureId, stored: &[(String, usize)], batches: &[String]) -> Result<(), JobError> {
    let sizes: BTreeMap<&String, usize> = stored.iter().map(|(id, count)| (id, *count)).collect();
    let mut seen = BTreeSet::new();
    let mut found = 0;
    for id in batches {
        if !seen.insert(id) {
            return Err(JobError::RepeatedBatch(id.clone()));
        }
        let unknown = || Error::UnknownBatch { structure: structure.clone(), batch: shown(id) };
        found += sizes.get(id).ok_or_else(unknown)?;
    }
    if found > MOST_MEASUREMENTS {
        return Err(JobError::TooManyMeasurements { found, most: MOST_MEASUREMENTS });
    }
    Ok(())
}

const fn kind_name(kind: JobKind) -> &'static str {
    match kind {
        JobKind::Diagnosis => "diagnosis",
        JobKind::Extension => "extension by diagnosis",
    }
}
