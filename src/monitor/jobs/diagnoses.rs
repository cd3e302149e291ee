//! Diagnoses as jobs.

use std::collections::{BTreeMap, BTreeSet};

use super::by_worker::Computer;
use super::halt::computed;
use super::queue::{JobStatus, Queue};
use super::runner::Jobs;
use super::study::{read_study, DiagnosisRequest};
use super::task::{delivered_diagnosis, Task};
use crate::clock;
use crate::discrepancy::{Holdout, FEWEST_ROWS};
use crate::monitor::error::{Error, JobError};
use crate::monitor::own_task::in_own_task;
use crate::quantity::{shown, StructureId};
use crate::simulator::Simulator;
use crate::store::{DiagnosisRecord, DiagnosisTrigger, JobKind, NewDiagnosis};

/// Largest number of measurements of one diagnosis.
const MOST_MEASUREMENTS: usize = 200_000;

impl Jobs {
    /// Starts a diagnosis of the requested batches, or of all batches if the request names none. `why`: the reason, and the number of the alarm
    /// because of which it is started without a request.
    ///
    /// # Errors
    /// [`Error::UnknownStructure`], [`Error::UnknownBatch`], [`JobError`].
    pub async fn start_diagnosis(
        &self,
        structure: &StructureId,
        request: DiagnosisRequest,
        why: (DiagnosisTrigger, Option<i64>),
    ) -> Result<DiagnosisRecord, JobError> {
        let (jobs, structure) = (self.clone(), structure.clone());
        in_own_task(async move { jobs.start_diagnosis_here(structure, request, why).await }).await
    }

    /// Why a structure cannot be diagnosed now, as a sentence; `None` where it can.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn no_diagnosis(&self, structure: &StructureId) -> Result<Option<String>, Error> {
        let stored: usize = self.store.batches().batch_sizes(structure).await?.iter().map(|(_, count)| count).sum();
        if stored < FEWEST_ROWS {
            let measurements = if stored == 1 { "measurement is" } else { "measurements are" };
            return Ok(Some(format!("{stored} {measurements} stored: a diagnosis needs at least {FEWEST_ROWS}")));
        }
        Ok(self.queue.check_room().err().map(|full| full.to_string()))
    }

    /// The request for all batches of a structure, or for the newest ones if all have more measurements than a diagnosis can use.
    /// `None` if the structure has too few measurements for a diagnosis.
    pub(in crate::monitor) async fn request_for_all(
        &self,
        structure: &StructureId,
        holdout: Holdout,
    ) -> Result<Option<DiagnosisRequest>, Error> {
        let stored = self.store.batches().batch_sizes(structure).await?;
        let batches = newest(&stored);
        Ok((!batches.is_empty()).then(|| DiagnosisRequest { batches, holdout, ..DiagnosisRequest::default() }))
    }

    async fn start_diagnosis_here(
        self,
        structure: StructureId,
        mut request: DiagnosisRequest,
        (trigger, alarm): (DiagnosisTrigger, Option<i64>),
    ) -> Result<DiagnosisRecord, JobError> {
        // That there is no such structure is said before what is wrong with its batches.
        self.structures.get(&structure)?;
        let stored = self.store.batches().batch_sizes(&structure).await?;
        if request.batches.is_empty() {
            request.batches = stored.iter().map(|(id, _)| id.clone()).collect();
        }
        check_batches(&structure, &stored, &request.batches)?;
        let _change = self.structures.change().await;
        let active = self.structures.get(&structure)?;
        self.queue.check_room()?;
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
        self.store.diagnoses().insert_diagnosis(new, clock::now()).await?;
        run_diagnosis(&self, &id, simulator, request, trigger);
        Ok(self.diagnosis(&id).await?.0)
    }

    /// A diagnosis, and what its job is doing now.
    ///
    /// # Errors
    /// [`JobError::UnknownDiagnosis`], [`Error::Store`].
    pub async fn diagnosis(&self, id: &str) -> Result<(DiagnosisRecord, Option<JobStatus>), JobError> {
        let record = self.store.diagnoses().diagnosis(id).await?;
        let record = record.ok_or_else(|| JobError::UnknownDiagnosis(shown(id)))?;
        Ok((seen(&self.queue, record), self.queue.status(id)))
    }

    /// Diagnoses of a structure, newest first, at most `limit`.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn diagnoses(&self, structure: &StructureId, limit: usize) -> Result<Vec<DiagnosisRecord>, Error> {
        let records = self.store.diagnoses().list(structure, limit).await?;
        Ok(records.into_iter().map(|record| seen(&self.queue, record)).collect())
    }

    /// The report of a diagnosis as HTML; `None` where there is none yet.
    ///
    /// # Errors
    /// [`JobError::UnknownDiagnosis`], [`Error::Store`].
    pub async fn report(&self, id: &str) -> Result<Option<String>, JobError> {
        self.diagnosis(id).await?;
        Ok(self.store.diagnoses().diagnosis_report(id).await?)
    }
}

/// A diagnosis and its extension in the states that people see.
fn seen(queue: &Queue, record: DiagnosisRecord) -> DiagnosisRecord {
    let state = queue.seen_state(&record.id, JobKind::Diagnosis, record.state);
    let of_extension = |stored| queue.seen_state(&record.id, JobKind::Extension, stored);
    let extension_state = record.extension_state.map(of_extension);
    DiagnosisRecord { state, extension_state, ..record }
}

/// Runs a stored diagnosis of the present version of a structure.
pub(super) fn run_diagnosis(
    jobs: &Jobs,
    id: &str,
    simulator: Simulator,
    request: DiagnosisRequest,
    trigger: DiagnosisTrigger,
) {
    let (own, job, structure) = (jobs.clone(), id.to_owned(), simulator.id().clone());
    let diagnose = {
        let structure = structure.clone();
        async move {
            let task = Task::Diagnosis { version: simulator.digest().clone(), request: request.clone() };
            let _place = match own.workers.compute(&job, &structure, JobKind::Diagnosis, &task).await? {
                Computer::Worker(result) => return delivered_diagnosis(result),
                Computer::Here(place) => place,
            };
            let study = read_study(&own.store, &own.queue, job, &structure, simulator, request).await?;
            computed("diagnosis", move || study.diagnose()).await
        }
    };
    jobs.run(id, &structure, (JobKind::Diagnosis, Some(trigger)), diagnose);
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
