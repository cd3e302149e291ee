//! Jobs that had not ended when the service last stopped.

use tracing::{info, warn};

use super::diagnoses::run_diagnosis;
use super::extensions::run_extension;
use super::runner::Jobs;
use super::study::{DiagnosisRequest, ExtensionTraining};
use super::trainings::{run_training, TrainingRequest};
use crate::clock;
use crate::monitor::error::{Error, JobError};
use crate::quantity::StructureId;
use crate::store::{self, JobEnd, TrainingJobRecord};

impl Jobs {
    /// Begins the diagnoses, trainings and extensions again that were running or waiting when the service last stopped.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn resume(&self) -> Result<(), Error> {
        let interrupted = self.store.diagnoses().end_interrupted_jobs(clock::now()).await?;
        if interrupted.failed > 0 {
            let failed = interrupted.failed;
            warn!("Marked {failed} jobs as failed, because the service ended unexpectedly several times while they were running");
        }
        for id in interrupted.diagnoses {
            if let Err(failure) = resume_diagnosis(self, &id).await {
                let end = not_resumed(failure)?;
                self.store.diagnoses().finish_diagnosis(&id, end, clock::now()).await?;
            }
        }
        for (id, request) in interrupted.extensions {
            if let Err(failure) = resume_extension(self, &id, &request).await {
                let end = not_resumed(failure)?;
                self.store.diagnoses().finish_extension(&id, end, clock::now()).await?;
            }
        }
        for record in self.store.trainings().unfinished().await? {
            if let Err(failure) = resume_training(self, &record) {
                let end = JobEnd::Failed(format!("it could not begin again after a stop of the service: {failure}"));
                self.store.trainings().finish(&record.id, end, clock::now()).await?;
            }
        }
        Ok(())
    }
}

/// The end of a job that cannot begin again.
fn not_resumed<T>(failure: JobError) -> Result<JobEnd<T>, Error> {
    match failure {
        // A read that failed for a moment is no reason to give up a job: the start fails and is repeated.
        JobError::Monitor(Error::Store(failure)) if !matches!(failure, store::Error::Row { .. }) => Err(failure.into()),
        failure => Ok(JobEnd::Failed(format!("it could not begin again after a stop of the service: {failure}"))),
    }
}

async fn resume_diagnosis(jobs: &Jobs, id: &str) -> Result<(), JobError> {
    let (record, _) = jobs.diagnosis(id).await?;
    let active = jobs.structures.get(&record.structure)?;
    let request: Result<DiagnosisRequest, _> = serde_json::from_str(&record.request);
    let request = request.map_err(|e| Error::from(store::Error::Row { what: "diagnosis", detail: e.to_string() }))?;
    if record.structure_digest != *active.simulator.digest() {
        return Err(Error::VersionChanged(record.structure).into());
    }
    say("diagnosis", id, &record.structure);
    run_diagnosis(jobs, id, active.simulator.clone(), request, record.trigger);
    Ok(())
}

async fn resume_extension(jobs: &Jobs, id: &str, request: &str) -> Result<(), JobError> {
    let (record, _) = jobs.diagnosis(id).await?;
    let active = jobs.structures.get(&record.structure)?;
    let refuse = |reason: String| JobError::NoExtension { diagnosis: id.to_owned(), reason };
    let training: ExtensionTraining = serde_json::from_str(request).map_err(|e| refuse(e.to_string()))?;
    if record.structure_digest != *active.simulator.digest() {
        return Err(refuse("the structure has another version now: diagnose the present version".to_owned()));
    }
    say("extension", id, &record.structure);
    run_extension(jobs, record, active, training);
    Ok(())
}

fn resume_training(jobs: &Jobs, record: &TrainingJobRecord) -> Result<(), String> {
    let request: TrainingRequest = serde_json::from_str(&record.request).map_err(|e| e.to_string())?;
    say("training", &record.id, &record.structure);
    run_training(jobs, record, request);
    Ok(())
}

fn say(what: &str, id: &str, structure: &StructureId) {
    info!(structure.id = %structure, job = %id, "The {what} {id} of {structure}, which a stop interrupted, begins again");
}
