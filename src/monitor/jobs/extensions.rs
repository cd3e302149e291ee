//! Extensions of structures by diagnoses, as jobs.

use std::sync::Arc;

use serde::{Deserialize, Serialize};
use tracing::info;

use super::by_worker::Computer;
use super::halt::{computed, Halt};
use super::runner::{switch, JobOutput, Jobs};
use super::study::{read_study, DiagnosisRequest, ExtensionTraining};
use super::task::{delivered_extension, Task};
use crate::baseline::train::Trained;
use crate::clock;
use crate::monitor::error::JobError;
use crate::monitor::own_task::in_own_task;
use crate::monitor::structures::ActiveStructure;
use crate::store::{DiagnosisRecord, JobKind, JobState, NewVersion, StoredBaseline};

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

impl Jobs {
    /// Starts to extend a structure by the causes of a diagnosis: a new version of the structure and a trained baseline for it. All
    /// batches are assessed again.
    ///
    /// # Errors
    /// [`JobError::UnknownDiagnosis`]; [`JobError::NoExtension`] when the diagnosis is not done, when the structure has changed since,
    /// or when an extension by it is running; [`JobError::TooManyJobs`].
    pub async fn start_extension(&self, id: &str, training: ExtensionTraining) -> Result<DiagnosisRecord, JobError> {
        let (jobs, id) = (self.clone(), id.to_owned());
        in_own_task(async move { jobs.start_extension_here(&id, training).await }).await
    }

    async fn start_extension_here(&self, id: &str, training: ExtensionTraining) -> Result<DiagnosisRecord, JobError> {
        let _change = self.structures.change().await;
        let (record, _) = self.diagnosis(id).await?;
        let active = self.structures.get(&record.structure)?;
        let refuse = |why: &str| JobError::NoExtension { diagnosis: id.to_owned(), reason: why.to_owned() };
        if record.state != JobState::Done {
            return Err(refuse("the diagnosis has not finished"));
        }
        if record.structure_digest != *active.simulator.digest() {
            return Err(refuse("the structure has another version now: diagnose the present version"));
        }
        let runs = || refuse("an extension by this diagnosis is running");
        // While one is ending, too, whose end is stored already.
        if record.extension_state == Some(JobState::Running) {
            return Err(runs());
        }
        self.queue.check_room()?;
        let request = serde_json::to_string(&training).expect("a request is plain data");
        if !self.store.diagnoses().begin_extension(id, request, clock::now()).await? {
            return Err(runs());
        }
        let begun = self.diagnosis(id).await?.0;
        run_extension(self, record, active, training);
        Ok(begun)
    }
}

pub(super) fn run_extension(
    jobs: &Jobs,
    record: DiagnosisRecord,
    active: Arc<ActiveStructure>,
    training: ExtensionTraining,
) {
    let (own, id, structure) = (jobs.clone(), record.id.clone(), record.structure.clone());
    let extend = async move { extend(&own, &record, active, training).await };
    jobs.run(&id, &structure, (JobKind::Extension, None), extend);
}

/// Extends a structure and puts the extension into use; the result as JSON.
async fn extend(
    jobs: &Jobs,
    record: &DiagnosisRecord,
    active: Arc<ActiveStructure>,
    training: ExtensionTraining,
) -> JobOutput {
    let text = |e: &dyn std::fmt::Display| e.to_string();
    let (structure, parent) = (&record.structure, active.simulator.digest().clone());
    if *jobs.structures.get(structure).map_err(|e| text(&e))?.simulator.digest() != parent {
        let changed =
            "the structure changed to another version while the extension waited: diagnose the present version";
        return Err(Halt::Failed(changed.to_owned()));
    }
    let request: DiagnosisRequest = serde_json::from_str(&record.request).map_err(|e| text(&e))?;
    let before = active.baseline.as_ref().ok().map(|baseline| baseline.digest().clone());
    let task = Task::Extension { version: parent.clone(), request: request.clone(), training, before };
    let extended = match jobs.workers.compute(&record.id, structure, JobKind::Extension, &task).await? {
        Computer::Worker(result) => delivered_extension(result).await?,
        Computer::Here(_place) => {
            let (store, queue, simulator) = (&jobs.store, &jobs.queue, active.simulator.clone());
            let study = read_study(store, queue, record.id.clone(), structure, simulator, request).await?;
            let work = move || study.extend(active.baseline.as_ref().ok().map(Arc::as_ref), training);
            computed("extension", work).await?
        }
    };
    let accepted = accepted(jobs, &extended.trained, training)?;
    jobs.queue.begin_storing(&record.id)?;
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
    let switched = switch(jobs, &parent, version, extended.simulator, Arc::new(baseline)).await;
    let result = ExtensionResult {
        added: extended.added,
        left_out: extended.left_out,
        structure_digest: structure_digest.to_string(),
        parent_digest: parent.to_string(),
        model_digest,
        trained_from,
        undamaged_version: switched?,
    };
    info!(structure.id = %structure, diagnosis = %record.id, "Extended {structure}: {}", result.added.join("; "));
    Ok((serde_json::to_string(&result).expect("a result is plain data"), None))
}

/// Returns true if an overconfident model is accepted by the request, and false if the model may be used without that; an error with the
/// next request if the model may not be used.
fn accepted(jobs: &Jobs, trained: &Trained, training: ExtensionTraining) -> Result<bool, String> {
    match jobs.structures.usable(&trained.baseline) {
        Ok(()) => Ok(false),
        Err(_) if training.accept_uncalibrated => Ok(true),
        Err(_) => {
            let manifest = trained.baseline.manifest();
            let next = serde_json::json!({ "from_scratch": true, "epochs": 2 * manifest.training.settings.epochs });
            Err(format!(
                "the extended model failed its calibration: some of its intervals are too narrow ({}), so that alarms would come too often or \
                 too late, and it is not used. Next: train it anew and for longer, by the same request with {next}. To use it as it \
                 is, add \"accept_uncalibrated\": true; each assessment then says so",
                manifest.calibration.failures.join("; ")
            ))
        }
    }
}
