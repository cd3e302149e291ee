//! Trainings that the service starts by itself: with the first batch of a structure without a model.
//!
//! Only structures are trained of which a model that is made in a second gives right answers meanwhile, and each version once: one whose training
//! failed or was ended is trained again on request.

use std::sync::Arc;

use tokio::sync::broadcast::error::RecvError;
use tracing::{error, info, warn};

use super::error::{Error, JobError};
use super::events::{Events, News};
use super::jobs::{answer_at_once, Jobs, TrainingRequest};
use super::settings::TrainingStart;
use super::structures::ActiveStructures;
use super::supervise::supervise;
use crate::assessment::BatchState;
use crate::baseline::manifest::Outcome;
use crate::baseline::starting::is_corrected_by_simulation;
use crate::clock;
use crate::quantity::StructureId;
use crate::store::{NewAuditEntry, Store};

/// Starts trainings without a request.
#[derive(Clone)]
pub struct AutomaticTrainings {
    store: Store,
    structures: Arc<ActiveStructures>,
    jobs: Jobs,
    events: Events,
    start: TrainingStart,
}

impl AutomaticTrainings {
    pub(super) fn new(
        store: Store,
        structures: Arc<ActiveStructures>,
        jobs: Jobs,
        events: Events,
        start: TrainingStart,
    ) -> Self {
        Self { store, structures, jobs, events, start }
    }

    /// Starts a training whenever a batch waits for a model, for as long as the service runs, in the background.
    pub fn watch(&self) {
        if self.start == TrainingStart::OnRequest {
            return;
        }
        let automatic = self.clone();
        supervise("trainings", move || {
            let automatic = automatic.clone();
            async move {
                let Some(mut news) = automatic.events.watch() else { return };
                automatic.check_all().await;
                loop {
                    match news.recv().await {
                        Ok(News::Batch { structure, state: BatchState::Received, .. }) => {
                            automatic.check_and_log(&structure).await;
                        }
                        // There is room for another one.
                        Ok(News::Job { progress: None, .. }) | Err(RecvError::Lagged(_)) => automatic.check_all().await,
                        Ok(_) => {}
                        Err(RecvError::Closed) => return,
                    }
                }
            }
        });
    }

    async fn check_all(&self) {
        for structure in self.structures.ids() {
            self.check_and_log(&structure).await;
        }
    }

    async fn check_and_log(&self, structure: &StructureId) {
        match self.check(structure).await {
            Ok(()) | Err(JobError::TrainingRuns { .. } | JobError::Monitor(Error::UnknownStructure(_))) => {}
            Err(failure) => {
                error!(structure.id = %structure, error = %failure, "Could not start the training of {structure}: {failure}");
            }
        }
    }

    /// If a batch of a structure waits for a model, makes one in a second. Starts the training of a structure with such a model, unless a job of it,
    /// or too many of others, run or wait: then it is looked at again when one ends.
    async fn check(&self, structure: &StructureId) -> Result<(), JobError> {
        let active = self.structures.get(structure)?;
        let made = match &active.baseline {
            Ok(baseline) if baseline.manifest().calibration.outcome() == Outcome::NotMeasured => true,
            Ok(_) => return Ok(()),
            Err(_) => false,
        };
        if !is_corrected_by_simulation(&active.simulator) {
            return Ok(());
        }
        if !made {
            if self.store.batches().pending(structure, 1).await.map_err(Error::from)?.is_empty() {
                return Ok(());
            }
            if let Err(reason) = answer_at_once(&self.jobs, &active.simulator).await {
                // The training will say the same where people look for it.
                warn!(structure.id = %structure, "The batches of {structure} wait for its training: {reason}");
            }
        }
        if self.jobs.is_busy(structure) {
            return Ok(());
        }
        let latest = self.jobs.trainings(structure, 1).await?;
        if latest.first().is_some_and(|latest| latest.structure_digest == *active.simulator.digest()) {
            return Ok(());
        }
        let entry = NewAuditEntry {
            structure: Some(structure.to_string()),
            ..NewAuditEntry::local(
                clock::now(),
                "start training (first batch)".to_owned(),
                Some(format!("/v1/structures/{structure}/trainings")),
            )
        };
        let start = self.jobs.start_training(structure, TrainingRequest::default());
        let record = self.store.audit().audited(entry, start).await?;
        info!(structure.id = %structure, training = %record.id, "Started the training of {structure}, whose first batch has arrived");
        Ok(())
    }
}
