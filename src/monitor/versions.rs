//! Switching between the versions of a structure, by an extension or by undoing one.

use std::sync::Arc;

use tracing::{info, warn};

use super::error::Error;
use super::own_task::in_own_task;
use super::references::References;
use super::replay::Replay;
use super::structures::ActiveStructures;
use crate::baseline::Baseline;
use crate::quantity::{Digest, StructureId};
use crate::simulator::Simulator;
use crate::store::{NewVersion, Store};

/// Switches between the versions of a structure.
#[derive(Clone)]
pub struct Versions {
    store: Store,
    structures: Arc<ActiveStructures>,
    references: Arc<References>,
    replay: Replay,
}

impl Versions {
    pub(super) fn new(
        store: Store,
        structures: Arc<ActiveStructures>,
        references: Arc<References>,
        replay: Replay,
    ) -> Self {
        Self { store, structures, references, replay }
    }

    /// Undoes an extension: the version that the present one extends is put into use with its trained baseline, and all batches are
    /// assessed again. Returns the digest of that version.
    ///
    /// # Errors
    /// [`Error::NoStepBack`] when the present version is not an extension; [`Error::NoEarlierModel`] when the version before has no trained baseline.
    pub async fn step_back(&self, structure: &StructureId) -> Result<Digest, Error> {
        let (versions, structure) = (self.clone(), structure.clone());
        in_own_task(async move { versions.step_back_here(&structure).await }).await
    }

    async fn step_back_here(&self, structure: &StructureId) -> Result<Digest, Error> {
        let active = self.structures.get(structure)?;
        let not_extended = || Error::NoStepBack(structure.clone());
        let present = active.simulator.digest().clone();
        let (_, parent) =
            self.store.structures().structure_version(structure, &present).await?.ok_or_else(not_extended)?;
        let parent = parent.ok_or_else(not_extended)?;
        let (definition, grandparent) =
            self.store.structures().structure_version(structure, &parent).await?.ok_or_else(not_extended)?;
        let simulator = Simulator::parse_json(&definition)?;
        let missing = |reason| Error::NoEarlierModel { structure: structure.clone(), version: parent.clone(), reason };
        let baseline = self.structures.baseline_for(&simulator).await?.map_err(missing)?;
        let version = NewVersion {
            digest: parent.clone(),
            definition_json: definition,
            parent: grandparent,
            diagnosis: None,
            baseline: None,
        };
        self.switch(&present, version, simulator, baseline).await?;
        info!(structure.id = %structure, "Undid the extension of {structure}: version {parent} is in use again");
        Ok(parent)
    }

    /// Replaces the version `expected` by another; the undamaged reference is renewed for it, and all batches are assessed again.
    /// Returns the version of the renewed reference.
    pub(super) async fn switch(
        &self,
        expected: &Digest,
        version: NewVersion,
        simulator: Simulator,
        baseline: Arc<Baseline>,
    ) -> Result<Option<u32>, Error> {
        let structure = simulator.id().clone();
        self.structures.switch_version(expected, version, simulator, baseline).await?;
        let renewed = self.references.renew_if_outdated(&structure).await;
        // Renews the reference as well if that failed now.
        self.replay.resume_later(structure.clone());
        Ok(renewed.unwrap_or_else(|error| {
            warn!(structure.id = %structure, %error, "Could not renew the undamaged reference of {structure}, trying again: {error}");
            None
        }))
    }
}
