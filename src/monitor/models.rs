//! Putting another trained baseline in the place of the one in use, while batches come in.
//!
//! The new one is loaded beside the old one, runs its self-test, and must have passed its calibration. Only then the pointer
//! is swapped. A batch that was begun with the old one ends with it, or is assessed again: a result names one digest.

use std::sync::Arc;

use serde::Serialize;
use tracing::{info, warn};

use super::{Error, Monitor, Watched};
use crate::baseline::library::{Entry, Library};
use crate::baseline::Baseline;
use crate::quantity::{Digest, StructureId};

/// What a reload did.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, utoipa::ToSchema)]
pub struct Reloaded {
    /// The structure.
    pub structure: StructureId,
    /// The baseline in use now.
    pub model_digest: Digest,
    /// The one before.
    #[schema(required)]
    pub previous_model_digest: Option<Digest>,
    /// False when the files are those in use.
    pub changed: bool,
    /// The undamaged state taken anew with it.
    #[schema(required)]
    pub undamaged_version: Option<u32>,
    /// What is left to do.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub next_step: Option<String>,
}

impl Monitor {
    /// Reads the models folder again and puts the baseline that it has for a structure in the place of the one in use, which
    /// stays when the new one is refused. With `retake`, the undamaged batches are taken as that under the new one too.
    ///
    /// # Errors
    /// [`Error::UnknownStructure`]; [`Error::ModelRefused`] with the reason; [`Error::VersionChanged`].
    pub async fn reload_model(&self, structure: &StructureId, retake: bool) -> Result<Reloaded, Error> {
        let (monitor, id) = (self.clone(), structure.clone());
        let task = tokio::spawn(async move { monitor.reload_model_here(&id, retake).await });
        let reloaded = task.await.map_err(|_| Error::Panicked)?;
        let outcome = match &reloaded {
            Ok(reloaded) if reloaded.changed => "swapped",
            Ok(_) => "unchanged",
            Err(_) => "refused",
        };
        metrics::counter!("modalwatch_model_reloads_total", "outcome" => outcome).increment(1);
        let mut refused = self.upkeep.refused_reloads.lock().expect("no holder of this lock panics");
        match &reloaded {
            Ok(_) => {
                refused.remove(structure);
            }
            Err(Error::ModelRefused { reason, .. }) => {
                warn!(structure.id = %structure, "Kept the trained baseline of {structure}: {reason}");
                refused.insert(structure.clone(), reason.clone());
            }
            Err(_) => {}
        }
        drop(refused);
        reloaded
    }

    async fn reload_model_here(&self, structure: &StructureId, retake: bool) -> Result<Reloaded, Error> {
        let _turn = self.upkeep.reloading.lock().await;
        let watched = self.structure(structure)?;
        let before = watched.baseline.as_ref().ok().map(|baseline| baseline.digest().clone());
        let refused = |reason: String| Error::ModelRefused {
            structure: structure.clone(),
            reason,
            kept: before.as_ref().map(Digest::to_string),
        };
        if self.store.structures().trained_baseline(structure, watched.simulator.digest()).await?.is_some() {
            let reason =
                "its present version was trained by the service itself, which no file replaces: go back by DELETE \
                          …/extension first";
            return Err(refused(reason.to_owned()));
        }
        let library = self.library();
        let read = tokio::task::spawn_blocking(move || library.read_again()).await.map_err(|_| Error::Panicked)?;
        let library = read.map_err(|e| refused(e.to_string()))?;
        let baseline = candidate(&library, structure, &watched).map_err(refused)?;
        self.usable(&baseline).map_err(refused)?;
        let model_digest = baseline.digest().clone();
        let changed = before.as_ref() != Some(&model_digest);
        if changed {
            self.swap(structure, &watched, baseline)?;
            info!(structure.id = %structure, model.digest = %model_digest, "Swapped the trained baseline of {structure}");
        }
        *self.library.write().expect("no holder of this lock panics") = Arc::new(library);
        let (mut undamaged_version, mut next_step) = (None, None);
        if changed && self.store.reference().undamaged(structure).await?.is_some() {
            if retake {
                undamaged_version = self.take_again(structure).await;
            }
            next_step = undamaged_version.is_none().then(|| {
                format!(
                    "the undamaged state was taken with another baseline, so batches are compared with none: name undamaged \
                     batches again by POST /v1/structures/{structure}/reference"
                )
            });
        }
        if changed {
            self.resume_later(structure.clone());
        }
        Ok(Reloaded {
            structure: structure.clone(),
            model_digest,
            previous_model_digest: before,
            changed,
            undamaged_version,
            next_step,
        })
    }

    /// Swaps the pointer, unless the structure became another version while the new baseline was loaded.
    fn swap(&self, structure: &StructureId, expected: &Watched, baseline: Arc<Baseline>) -> Result<(), Error> {
        let mut all = self.watched.write().expect("no holder of this lock panics");
        let present = all.get(structure).ok_or_else(|| Error::UnknownStructure(structure.clone()))?;
        if present.simulator.digest() != expected.simulator.digest() {
            return Err(Error::VersionChanged(structure.clone()));
        }
        let watched = Watched { simulator: present.simulator.clone(), baseline: Ok(baseline) };
        all.insert(structure.clone(), Arc::new(watched));
        Ok(())
    }

    /// What is known of structures and trained baselines on disk.
    pub fn library(&self) -> Arc<Library> {
        Arc::clone(&self.library.read().expect("no holder of this lock panics"))
    }
}

/// The baseline of a library for the present version of a structure, or why it has none. Stricter than at the start: who asks
/// for a reload has put a file there and means that one.
fn candidate(library: &Library, structure: &StructureId, watched: &Watched) -> Result<Arc<Baseline>, String> {
    // A definition that cannot be read might be that of this structure; what is shipped must not slip in its place.
    let blocking = |of: Option<&StructureId>| of.is_none() || of == Some(structure);
    if let Some(refusal) = library.refusals().iter().find(|refusal| blocking(refusal.structure.as_ref())) {
        return Err(format!("{}: {}", refusal.file, refusal.reason));
    }
    let Some(Entry { simulator, baseline }) = library.get(structure) else {
        return Err("the models folder has none for it".to_owned());
    };
    if simulator.digest() != watched.simulator.digest() {
        let (found, present) = (simulator.digest(), watched.simulator.digest());
        return Err(format!(
            "it is for another definition of the structure (digest {found}, the present one is {present})"
        ));
    }
    baseline.clone().ok_or_else(|| "the models folder has the structure, but no trained baseline of it".to_owned())
}
