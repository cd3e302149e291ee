//! Replacing the trained baseline in use by another, while batches arrive.
//!
//! The new trained baseline is loaded beside the old one, runs its self-test, and must have passed its calibration. Only then does
//! it replace the old one. A batch whose assessment was started with the old one either keeps its result or is assessed again, so
//! that each result was computed with one trained baseline, whose digest it names.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use tracing::{info, warn};

use super::error::{Error, ReloadError};
use super::own_task::in_own_task;
use super::references::References;
use super::replay::Replay;
use super::structures::{is_starting, ActiveStructure, ActiveStructures};
use crate::baseline::library::{Entry, Library};
use crate::baseline::Baseline;
use crate::fault::carried;
use crate::quantity::{Digest, StructureId};
use crate::store::{self, Store};

/// The result of a reload.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Reloaded {
    /// The structure.
    pub structure: StructureId,
    /// The trained baseline in use now.
    pub model_digest: Digest,
    /// The trained baseline that was in use before, if any.
    pub previous_model_digest: Option<Digest>,
    /// False when the files contain the trained baseline that was already in use.
    pub changed: bool,
    /// Version of the undamaged reference that was renewed with it.
    pub undamaged_version: Option<u32>,
    /// True when the undamaged reference was made with another trained baseline and has to be declared again.
    pub reference_outdated: bool,
}

/// Replaces trained baselines.
#[derive(Clone)]
pub struct Models {
    store: Store,
    structures: Arc<ActiveStructures>,
    references: Arc<References>,
    replay: Replay,
    /// Held during a reload.
    reloading: Arc<tokio::sync::Mutex<()>>,
    /// Why the last reload of a structure was refused, until one succeeds.
    refused: Arc<Mutex<BTreeMap<StructureId, String>>>,
}

impl Models {
    pub(super) fn new(
        store: Store,
        structures: Arc<ActiveStructures>,
        references: Arc<References>,
        replay: Replay,
    ) -> Self {
        Self { store, structures, references, replay, reloading: Arc::default(), refused: Arc::default() }
    }

    /// Reads the models folder again and puts its trained baseline for a structure into use; the previous one stays in use when the
    /// new one is refused. With `renew`, the undamaged reference is renewed with the new trained baseline.
    ///
    /// # Errors
    /// [`Error::UnknownStructure`]; [`ReloadError::Refused`] with the reason; [`Error::VersionChanged`].
    pub async fn reload(&self, structure: &StructureId, renew: bool) -> Result<Reloaded, ReloadError> {
        let (models, id) = (self.clone(), structure.clone());
        let reloaded = in_own_task(async move { models.reload_here(&id, renew).await }).await;
        let outcome = match &reloaded {
            Ok(reloaded) if reloaded.changed => "swapped",
            Ok(_) => "unchanged",
            Err(_) => "refused",
        };
        metrics::counter!("modalwatch_model_reloads_total", "outcome" => outcome).increment(1);
        let mut refused = self.refused.lock().expect("no holder of this lock panics");
        match &reloaded {
            Ok(_) => {
                refused.remove(structure);
            }
            Err(ReloadError::Refused { reason, .. }) => {
                warn!(structure.id = %structure, "Refused the new trained model of {structure}: {reason}");
                refused.insert(structure.clone(), reason.clone());
            }
            Err(ReloadError::Monitor(_)) => {}
        }
        drop(refused);
        reloaded
    }

    /// Structures whose last reload was refused, with the reason.
    pub fn refused(&self) -> BTreeMap<StructureId, String> {
        self.refused.lock().expect("no holder of this lock panics").clone()
    }

    async fn reload_here(&self, structure: &StructureId, renew: bool) -> Result<Reloaded, ReloadError> {
        let _turn = self.reloading.lock().await;
        let active = self.structures.get(structure)?;
        let before = active.model_digest().cloned();
        let refused = |reason: String| ReloadError::Refused {
            structure: structure.clone(),
            reason,
            kept: before.as_ref().map(Digest::to_string),
        };
        let stored = self.store.structures().trained_baseline(structure, active.simulator.digest()).await?;
        if stored.is_some_and(|stored| !is_starting(&stored)) {
            let version = self.store.structures().structure_version(structure, active.simulator.digest()).await?;
            let reason = if version.is_some_and(|(_, parent)| parent.is_some()) {
                "the present version is an extension, whose trained model was made by the service and cannot be \
                 replaced by a file: undo the extension first"
            } else {
                "the service trained the model of this structure itself, and a file cannot replace it: train it again by \
                 POST /v1/structures/{id}/trainings, or on the page of the structure"
            };
            return Err(refused(reason.to_owned()));
        }
        let library = self.structures.library();
        let read = tokio::task::spawn_blocking(carried(move || read_again(&library)));
        let library = read.await.map_err(|_| Error::Panicked)?.map_err(refused)?;
        let baseline = candidate(&library, structure, &active).map_err(refused)?;
        self.structures.usable(&baseline).map_err(refused)?;
        let model_digest = baseline.digest().clone();
        let changed = before.as_ref() != Some(&model_digest);
        if changed {
            self.structures.swap_baseline(&active, baseline)?;
            info!(structure.id = %structure, model.digest = %model_digest, "Swapped the trained model of {structure}");
        }
        self.structures.set_library(library);
        let renewed = self.renewed(structure, &model_digest, renew).await;
        // Also if the reference could not be renewed: batches wait for this trained baseline.
        self.replay.resume_with_baseline(structure.clone());
        let (undamaged_version, reference_outdated) = renewed?;
        Ok(Reloaded {
            structure: structure.clone(),
            model_digest,
            previous_model_digest: before,
            changed,
            undamaged_version,
            reference_outdated,
        })
    }

    /// Renews the undamaged reference for the trained baseline in use, if it was made with another one and this is wanted. Returns its
    /// version, and whether it still has to be declared again. A reload that failed here is completed by the next one.
    async fn renewed(&self, structure: &StructureId, used: &Digest, renew: bool) -> Result<(Option<u32>, bool), Error> {
        let newest = match self.store.reference().undamaged(structure).await {
            // It cannot be renewed either: it has to be declared again.
            Err(store::Error::Row { .. }) => return Ok((None, true)),
            newest => newest?,
        };
        if newest.is_none_or(|newest| newest.model_digest == *used) {
            return Ok((None, false));
        }
        let version = if renew { self.references.renew(structure).await? } else { None };
        Ok((version, version.is_none()))
    }
}

/// The embedded models and those of the folder as they are now; otherwise the reason.
fn read_again(library: &Library) -> Result<Library, String> {
    fault_point!("baseline::load", |_| Err("a fault".to_owned()));
    library.read_again().map_err(|e| e.to_string())
}

/// The trained baseline of a library for the present version of a structure, or why there is none. This is stricter than at the
/// start of the service, because a user who requests a reload has just written a file and expects that file to be used.
fn candidate(library: &Library, structure: &StructureId, active: &ActiveStructure) -> Result<Arc<Baseline>, String> {
    // A definition that cannot be read might be that of this structure; a trained baseline that is shipped with the program must
    // not silently be used instead.
    let blocking = |of: Option<&StructureId>| of.is_none() || of == Some(structure);
    if let Some(refusal) = library.refusals().iter().find(|refusal| blocking(refusal.structure.as_ref())) {
        return Err(format!("{}: {}", refusal.file, refusal.reason));
    }
    let Some(Entry { simulator, baseline }) = library.get(structure) else {
        return Err("the models folder does not contain this structure".to_owned());
    };
    if simulator.digest() != active.simulator.digest() {
        let (found, present) = (simulator.digest(), active.simulator.digest());
        return Err(format!(
            "it was trained for another definition of the structure (digest {found}; the present definition has {present})"
        ));
    }
    baseline.clone().ok_or_else(|| "the models folder has the structure, but no trained model for it".to_owned())
}
