//! Deleting a structure with all its data.

use std::sync::Arc;
use std::time::Duration;

use serde::Serialize;
use tracing::{info, warn};

use super::error::{DeleteError, Error};
use super::events::Events;
use super::jobs::Jobs;
use super::own_task::in_own_task;
use super::structures::ActiveStructures;
use crate::clock;
use crate::quantity::StructureId;
use crate::store::Store;

/// Pause after a transaction that failed, for example on a busy disk.
const BETWEEN_ATTEMPTS: Duration = Duration::from_secs(2);

/// A structure that was deleted.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, utoipa::ToSchema)]
pub struct DeletedStructure {
    /// The structure.
    pub structure: StructureId,
    /// Its batches.
    pub batches: u64,
    /// Their measurements.
    pub measurements: u64,
}

/// Deletes structures.
#[derive(Clone)]
pub struct Deletions {
    store: Store,
    structures: Arc<ActiveStructures>,
    jobs: Jobs,
    events: Events,
}

impl Deletions {
    pub(super) fn new(store: Store, structures: Arc<ActiveStructures>, jobs: Jobs, events: Events) -> Self {
        Self { store, structures, jobs, events }
    }

    /// Deletes a structure with its batches, references, alarms, notes, diagnoses, and the models that the service trained for it. If the
    /// service stops meanwhile, the next start goes on.
    ///
    /// # Errors
    /// [`Error::UnknownStructure`]; [`DeleteError::HasJobs`].
    pub async fn delete(&self, structure: &StructureId) -> Result<DeletedStructure, DeleteError> {
        let (deletions, structure) = (self.clone(), structure.clone());
        in_own_task(async move {
            deletions.begin(&structure).await?;
            Ok(deletions.proceed(structure).await?)
        })
        .await
    }

    /// From here on the structure is not in use, and takes no definition, job or batch.
    async fn begin(&self, structure: &StructureId) -> Result<(), DeleteError> {
        let _change = self.structures.change().await;
        let jobs = self.jobs.of_structure(structure);
        if !jobs.is_empty() {
            return Err(DeleteError::HasJobs { structure: structure.clone(), jobs });
        }
        if !self.store.deletions().begin(structure, clock::now()).await.map_err(Error::from)? {
            return Err(Error::UnknownStructure(structure.clone()).into());
        }
        self.structures.deactivate(structure);
        Ok(())
    }

    /// Goes on with deletions that a stop of the service interrupted, in the background.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn resume(&self) -> Result<(), Error> {
        for structure in self.store.deletions().begun().await? {
            let deletions = self.clone();
            tokio::spawn(async move {
                while let Err(error) = deletions.proceed(structure.clone()).await {
                    if deletions.store.file().is_closed() {
                        return;
                    }
                    warn!(structure.id = %structure, %error, "Could not go on deleting {structure}, trying again: {error}");
                    tokio::time::sleep(BETWEEN_ATTEMPTS).await;
                }
            });
        }
        Ok(())
    }

    async fn proceed(&self, structure: StructureId) -> Result<DeletedStructure, Error> {
        let mut done = DeletedStructure { structure, batches: 0, measurements: 0 };
        loop {
            // Each step is one write, between which those of others are stored.
            let removed = self.store.deletions().proceed(&done.structure).await?;
            done.batches += removed.batches;
            done.measurements += removed.measurements;
            if removed.complete {
                break;
            }
        }
        let DeletedStructure { structure, batches, .. } = &done;
        self.structures.forget_refused(structure);
        info!(structure.id = %structure, batches, "Deleted structure {structure} with {batches} batches");
        self.events.structure_changed(structure);
        Ok(done)
    }
}
