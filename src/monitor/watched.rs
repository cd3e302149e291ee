//! The structures in use, each with its trained baseline or the reason why there is none.

use std::collections::BTreeMap;
use std::sync::{Arc, RwLockReadGuard};

use super::{Error, Monitor};
use crate::baseline::Baseline;
use crate::quantity::{StructureId, Timestamp};
use crate::simulator::definition::StructureDefinition;
use crate::simulator::Simulator;
use crate::store::PutStructure;

/// A structure in use: its simulator, and its trained baseline or the reason why there is none.
pub struct Watched {
    /// The structure.
    pub simulator: Simulator,
    /// The trained baseline in use, or why there is none.
    pub baseline: Result<Arc<Baseline>, String>,
}

impl Monitor {
    /// Structures with a trained baseline in use.
    pub fn baselines_in_use(&self) -> usize {
        self.lock_read().values().filter(|watched| watched.baseline.is_ok()).count()
    }

    /// A structure in use.
    ///
    /// # Errors
    /// [`Error::UnknownStructure`]; [`Error::DefinitionRefused`] for one whose stored definition does not pass any more.
    pub fn structure(&self, id: &StructureId) -> Result<Arc<Watched>, Error> {
        self.lock_read().get(id).cloned().ok_or_else(|| match self.refused.get(id) {
            Some(reason) => Error::DefinitionRefused { structure: id.clone(), reason: reason.clone() },
            None => Error::UnknownStructure(id.clone()),
        })
    }

    /// Stored structures that this version of the program does not take, with the reason.
    pub fn refused_structures(&self) -> &BTreeMap<StructureId, String> {
        &self.refused
    }

    /// Defines a structure.
    ///
    /// # Errors
    /// [`Error::StructureInUse`] when it has batches under another definition.
    pub async fn put_structure(&self, definition: StructureDefinition) -> Result<PutStructure, Error> {
        let built = tokio::task::spawn_blocking(move || Simulator::new(definition)).await;
        let simulator = built.unwrap_or_else(|e| std::panic::resume_unwind(e.into_panic()))?;
        let (id, json) = (simulator.id().clone(), simulator.definition().canonical_json());
        let outcome = self.store.structures().put_structure(&id, &json, simulator.digest(), Timestamp::now()).await?;
        match outcome {
            PutStructure::Refused => return Err(Error::StructureInUse(id)),
            PutStructure::Created | PutStructure::Replaced => {
                let baseline = self.baseline_for(&simulator).await?;
                self.watch(simulator, baseline);
                self.tell_structure(&id);
            }
            PutStructure::Unchanged => {}
        }
        Ok(outcome)
    }

    pub(super) fn watch(&self, simulator: Simulator, baseline: Result<Arc<Baseline>, String>) {
        let id = simulator.id().clone();
        let watched = Arc::new(Watched { simulator, baseline });
        self.watched.write().expect("no holder of this lock panics").insert(id, watched);
    }

    /// The baseline of a version of a structure: one that the service trained for it, or that of the library.
    pub(super) async fn baseline_for(&self, simulator: &Simulator) -> Result<Result<Arc<Baseline>, String>, Error> {
        let Some(stored) = self.store.structures().trained_baseline(simulator.id(), simulator.digest()).await? else {
            return Ok(self.find_baseline(simulator));
        };
        let loaded = Baseline::load(&stored.manifest, &stored.weights, simulator);
        let refused = |e: crate::baseline::LoadError| format!("the baseline that the service trained is refused: {e}");
        let usable = |baseline: &Baseline| if stored.accepted { Ok(()) } else { self.usable(baseline) };
        Ok(loaded.map_err(refused).and_then(|baseline| usable(&baseline).map(|()| Arc::new(baseline))))
    }

    fn find_baseline(&self, simulator: &Simulator) -> Result<Arc<Baseline>, String> {
        let id = simulator.id();
        let train =
            "train one with `modalwatch train` into a folder of --models and start the service again, or POST its \
                     model/reload";
        let library = self.library();
        let Some(entry) = library.get(id) else {
            return Err(format!("no trained baseline: {train}"));
        };
        if entry.simulator.digest() != simulator.digest() {
            return Err(format!("the trained baseline is for another definition of {id}: {train}"));
        }
        let refused = || library.refusals().iter().find(|r| r.structure.as_ref() == Some(id));
        let baseline = entry.baseline.clone().ok_or_else(|| match refused() {
            Some(refusal) => format!("{} is refused: {}", refusal.file, refusal.reason),
            None => format!("no trained baseline: {train}"),
        })?;
        self.usable(&baseline).map(|()| baseline)
    }

    /// Whether a baseline passed its calibration, or may be used all the same; why not.
    pub(super) fn usable(&self, baseline: &Baseline) -> Result<(), String> {
        let failures = &baseline.manifest().calibration.failures;
        let digest = baseline.digest().as_str();
        if failures.is_empty() || self.settings.accept_uncalibrated.iter().any(|accepted| accepted == digest) {
            return Ok(());
        }
        Err(format!(
            "the trained baseline failed its calibration ({}): train again with more samples or epochs; to use it all the \
             same, and have every answer say so, put its digest {digest} into monitor.accept_uncalibrated",
            failures.join("; ")
        ))
    }

    pub(super) fn lock_read(&self) -> RwLockReadGuard<'_, BTreeMap<StructureId, Arc<Watched>>> {
        self.watched.read().expect("no holder of this lock panics")
    }
}
