//! The active structures, each with its trained baseline or the reason why it has none.

use std::collections::BTreeMap;
use std::sync::{Arc, RwLock, RwLockReadGuard};

use futures_util::{stream, StreamExt as _, TryStreamExt as _};
use tokio::sync::{Mutex, MutexGuard};
use tracing::{error, warn};

use super::error::Error;
use super::events::Events;
use super::reason::Reason;
use super::settings::TrainingStart;
use crate::baseline::library::Library;
use crate::baseline::manifest::{Manifest, Outcome};
use crate::baseline::starting::is_corrected_by_simulation;
use crate::baseline::{Baseline, LoadError};
use crate::clock;
use crate::quantity::{Digest, StructureId};
use crate::simulator::definition::DefinitionError;
use crate::simulator::Simulator;
use crate::store::{NewVersion, PutStructure, Store, StoredBaseline};
use crate::trust::calibration_in_words;

/// What to do where a structure has no trained baseline.
const TRAIN: &str =
    "train one on the page of the structure, by POST /v1/structures/{id}/trainings, or with `modalwatch train` into the models \
     folder (--models), and then reload it or start the service again";

/// What happens where a structure has no trained baseline and is trained by itself.
const BY_ITSELF: &str =
    "the first batch is answered within seconds by one that is made then, and a trained one follows by itself";

/// A structure in use.
pub struct ActiveStructure {
    /// The structure.
    pub simulator: Simulator,
    /// The trained baseline in use, or why there is none.
    pub baseline: Result<Arc<Baseline>, String>,
}

impl ActiveStructure {
    /// The trained baseline in use.
    ///
    /// # Errors
    /// [`Error::NoModel`].
    pub fn trained_baseline(&self) -> Result<Arc<Baseline>, Error> {
        let missing =
            |reason: &String| Error::NoModel { structure: self.simulator.id().clone(), reason: reason.clone() };
        self.baseline.as_ref().map(Arc::clone).map_err(missing)
    }

    /// Digest of the trained baseline in use.
    pub(super) fn model_digest(&self) -> Option<&Digest> {
        self.baseline.as_ref().ok().map(|baseline| baseline.digest())
    }
}

/// The structures in use and the library of trained baselines on disk.
pub struct ActiveStructures {
    store: Store,
    events: Events,
    accept_uncalibrated: Vec<String>,
    training: TrainingStart,
    library: RwLock<Arc<Library>>,
    active: RwLock<BTreeMap<StructureId, Arc<ActiveStructure>>>,
    refused: RwLock<BTreeMap<StructureId, String>>,
    changes: Mutex<()>,
}

impl ActiveStructures {
    /// Held while a structure is stored and put into use, while its deletion begins, and while a job of it is stored and queued. Each of them
    /// happens wholly before or after the others, so that what is in use is what is stored, and a job has a structure.
    pub(super) async fn change(&self) -> MutexGuard<'_, ()> {
        self.changes.lock().await
    }

    /// Stores the structures of the library that are not stored yet, and activates all stored structures.
    pub(super) async fn open(
        store: Store,
        library: Library,
        events: Events,
        (accept_uncalibrated, training): (Vec<String>, TrainingStart),
    ) -> Result<Self, Error> {
        for refusal in library.refusals() {
            error!(file = %refusal.file, "Refused {}: {}", refusal.file, refusal.reason);
        }
        for (id, entry) in library.iter() {
            let json = entry.simulator.definition().canonical_json();
            // Without a write where it is stored already: the service must start for reading on a full disk.
            let stored = store.structures().structure(id).await?;
            if stored.is_some_and(|stored| stored.digest == *entry.simulator.digest()) {
                continue;
            }
            let put = store.structures().put_structure(id, &json, entry.simulator.digest(), clock::now()).await;
            let outcome = match put {
                Err(full) if full.disk_cause().is_some() => {
                    error!(structure.id = %id, "Could not store {id} of the models folder, until the next start: {full}");
                    continue;
                }
                outcome => outcome?,
            };
            if outcome == PutStructure::Refused {
                warn!(structure.id = %id, "Kept the stored definition of {id}: it has batches, and the library's definition differs");
            }
        }
        let library = RwLock::new(Arc::new(library));
        let (active, refused) = (RwLock::default(), RwLock::default());
        let changes = Mutex::default();
        let structures = Self { store, events, accept_uncalibrated, training, library, active, refused, changes };
        let ids = structures.store.structures().list().await?.into_iter().map(|summary| summary.id);
        let at_a_time = std::thread::available_parallelism().map_or(1, usize::from);
        let read = stream::iter(ids).map(|id| read_stored(&structures, id)).buffered(at_a_time);
        let read: Vec<_> = read.try_collect().await?;
        for (id, simulator) in read.into_iter().flatten() {
            match simulator {
                Ok(simulator) => {
                    let baseline = structures.baseline_for(&simulator).await?;
                    structures.activate(simulator, baseline);
                }
                // One invalid definition must not keep the other structures from being monitored.
                Err(reason) => {
                    error!(structure.id = %id, "Refused the stored definition of {id}: {reason}");
                    structures.refused.write().expect("no holder of this lock panics").insert(id, reason.to_string());
                }
            }
        }
        Ok(structures)
    }

    /// A structure in use.
    ///
    /// # Errors
    /// [`Error::UnknownStructure`]; [`Error::DefinitionRefused`] for one whose stored definition is not valid any more.
    pub fn get(&self, id: &StructureId) -> Result<Arc<ActiveStructure>, Error> {
        self.read().get(id).cloned().ok_or_else(|| match self.refused().get(id) {
            Some(reason) => Error::DefinitionRefused { structure: id.clone(), reason: reason.clone() },
            None => Error::UnknownStructure(id.clone()),
        })
    }

    /// Ids of the structures in use.
    pub fn ids(&self) -> Vec<StructureId> {
        self.read().keys().cloned().collect()
    }

    /// Digests of the trained baselines in use, by structure.
    pub fn models_in_use(&self) -> Vec<(StructureId, Digest)> {
        self.read().iter().filter_map(|(id, active)| Some((id.clone(), active.model_digest()?.clone()))).collect()
    }

    /// Stored structures that this version of the program refuses, with the reason.
    pub fn refused(&self) -> BTreeMap<StructureId, String> {
        self.refused.read().expect("no holder of this lock panics").clone()
    }

    /// Takes a structure out of use.
    pub(super) fn deactivate(&self, id: &StructureId) {
        self.active.write().expect("no holder of this lock panics").remove(id);
    }

    /// A structure whose stored definition was refused is stored no more.
    pub(super) fn forget_refused(&self, id: &StructureId) {
        self.refused.write().expect("no holder of this lock panics").remove(id);
    }

    /// Structures and trained baselines on disk, as last read.
    pub fn library(&self) -> Arc<Library> {
        Arc::clone(&self.library.read().expect("no holder of this lock panics"))
    }

    /// Replaces the library by one that was read again from disk.
    pub(super) fn set_library(&self, library: Library) {
        *self.library.write().expect("no holder of this lock panics") = Arc::new(library);
    }

    /// Defines a structure.
    ///
    /// # Errors
    /// [`Error::StructureInUse`] when it has batches under another definition.
    pub async fn put(&self, simulator: Simulator) -> Result<PutStructure, Error> {
        let _change = self.change().await;
        let (id, json) = (simulator.id().clone(), simulator.definition().canonical_json());
        let outcome = self.store.structures().put_structure(&id, &json, simulator.digest(), clock::now()).await?;
        match outcome {
            PutStructure::Refused => return Err(Error::StructureInUse(id)),
            PutStructure::Created | PutStructure::Replaced => {
                let baseline = self.baseline_for(&simulator).await?;
                self.activate(simulator, baseline);
                self.events.structure_changed(&id);
            }
            // An earlier call may have failed between the store and this.
            PutStructure::Unchanged => self.follow_stored_now(&id).await?,
        }
        Ok(outcome)
    }

    /// Puts the stored version of a structure into use if another one is in use or none, which is the case after a call that failed
    /// although its transaction was committed.
    ///
    /// # Errors
    /// [`Error::Store`], [`Error::Definition`].
    pub(super) async fn follow_stored(&self, id: &StructureId) -> Result<(), Error> {
        let _change = self.change().await;
        self.follow_stored_now(id).await
    }

    /// The same, while [`Self::change`] is held.
    async fn follow_stored_now(&self, id: &StructureId) -> Result<(), Error> {
        let Some(stored) = self.store.structures().structure(id).await? else { return Ok(()) };
        let in_use = |active: &Arc<ActiveStructure>| *active.simulator.digest() == stored.digest;
        if self.refused().contains_key(id) || self.read().get(id).is_some_and(in_use) {
            return Ok(());
        }
        let simulator = Simulator::parse_json(&stored.definition_json)?;
        let baseline = self.baseline_for(&simulator).await?;
        self.activate(simulator, baseline);
        self.events.structure_changed(id);
        Ok(())
    }

    /// Puts a structure into use, in place of its present version if there is one.
    pub(super) fn activate(&self, simulator: Simulator, baseline: Result<Arc<Baseline>, String>) {
        let id = simulator.id().clone();
        if let Ok(baseline) = &baseline {
            warn_of_calibration(&id, baseline);
        }
        let active = Arc::new(ActiveStructure { simulator, baseline });
        self.active.write().expect("no holder of this lock panics").insert(id, active);
    }

    /// Puts another trained baseline into use, unless the structure changed to another version since `expected` was read.
    pub(super) fn swap_baseline(&self, expected: &ActiveStructure, baseline: Arc<Baseline>) -> Result<(), Error> {
        let structure = expected.simulator.id();
        let mut all = self.active.write().expect("no holder of this lock panics");
        let present = all.get(structure).ok_or_else(|| Error::UnknownStructure(structure.clone()))?;
        if present.simulator.digest() != expected.simulator.digest() {
            return Err(Error::VersionChanged(structure.clone()));
        }
        warn_of_calibration(structure, &baseline);
        let swapped = ActiveStructure { simulator: present.simulator.clone(), baseline: Ok(baseline) };
        all.insert(structure.clone(), Arc::new(swapped));
        Ok(())
    }

    /// Puts another version of a structure into use, unless it changed since the version `expected`.
    pub(super) async fn switch_version(
        &self,
        expected: &Digest,
        version: NewVersion,
        simulator: Simulator,
        baseline: Arc<Baseline>,
    ) -> Result<(), Error> {
        let _change = self.change().await;
        let (structure, digest) = (simulator.id().clone(), version.digest.clone());
        let switched = self.store.structures().switch_version(&structure, expected, version, clock::now()).await;
        if !matches!(switched, Ok(true)) {
            // A transaction that was committed may have been reported as failed, to this call or to an earlier one.
            let present = self.store.structures().structure(&structure).await?.map(|stored| stored.digest);
            if digest == *expected || present != Some(digest) {
                switched?;
                return Err(Error::VersionChanged(structure));
            }
        }
        self.activate(simulator, Ok(baseline));
        self.events.structure_changed(&structure);
        Ok(())
    }

    /// The trained baseline for a version of a structure: the one that the service trained for it, otherwise the one of the
    /// library, otherwise one that the service made in a second.
    pub(super) async fn baseline_for(&self, simulator: &Simulator) -> Result<Result<Arc<Baseline>, String>, Error> {
        let Some(stored) = self.store.structures().trained_baseline(simulator.id(), simulator.digest()).await? else {
            return Ok(self.library_baseline(simulator));
        };
        if is_starting(&stored) {
            if let Ok(trained) = self.library_baseline(simulator) {
                return Ok(Ok(trained));
            }
        }
        let loaded = load(&stored, simulator);
        let refused = |e: LoadError| format!("the model trained by the service is refused: {e}");
        let usable = |baseline: &Baseline| if stored.accepted { Ok(()) } else { self.usable(baseline) };
        Ok(loaded.map_err(refused).and_then(|baseline| usable(&baseline).map(|()| Arc::new(baseline))))
    }

    /// Whether a structure without a model is answered from its first batch on, and then trained, without a request.
    pub(super) fn trains_by_itself(&self, simulator: &Simulator) -> bool {
        self.training == TrainingStart::Automatic && is_corrected_by_simulation(simulator)
    }

    fn library_baseline(&self, simulator: &Simulator) -> Result<Arc<Baseline>, String> {
        let id = simulator.id();
        let library = self.library();
        let next = if self.trains_by_itself(simulator) { BY_ITSELF } else { TRAIN };
        let Some(entry) = library.get(id) else {
            return Err(format!("no trained model: {next}"));
        };
        if entry.simulator.digest() != simulator.digest() {
            return Err(format!("the trained model is for another definition of {id}: {next}"));
        }
        let refused = || library.refusals().iter().find(|r| r.structure.as_ref() == Some(id));
        let baseline = entry.baseline.clone().ok_or_else(|| match refused() {
            Some(refusal) => format!("{} is refused: {}", refusal.file, refusal.reason),
            None => format!("no trained model: {next}"),
        })?;
        self.usable(&baseline).map(|()| baseline)
    }

    /// Whether a trained baseline is not overconfident or is accepted by configuration; otherwise why it may not be used.
    pub(super) fn usable(&self, baseline: &Baseline) -> Result<(), String> {
        let calibration = &baseline.manifest().calibration;
        let digest = baseline.digest().as_str();
        if calibration.outcome() < Outcome::Overconfident
            || self.accept_uncalibrated.iter().any(|accepted| accepted == digest)
        {
            return Ok(());
        }
        Err(format!(
            "the trained model failed its calibration: it is overconfident ({}): train it again with `modalwatch train`, with a larger --epochs or --units; to \
             use it nevertheless, add its digest {digest} to monitor.accept_uncalibrated, and every assessment then has a finding \
             about it",
            calibration.failures.join("; ")
        ))
    }

    /// Findings for `/readyz`: baselines in use that did not pass their calibration, each with what this means.
    pub(super) fn calibration_findings(&self) -> Vec<Reason> {
        let of = |(id, active): (&StructureId, &Arc<ActiveStructure>)| {
            let baseline = active.baseline.as_ref().ok()?;
            let (code, message) = doubtful_calibration(id, baseline)?;
            Some(Reason::new(code, message))
        };
        self.read().iter().filter_map(of).collect()
    }

    fn read(&self) -> RwLockReadGuard<'_, BTreeMap<StructureId, Arc<ActiveStructure>>> {
        self.active.read().expect("no holder of this lock panics")
    }
}

/// Whether a stored baseline is one that was made in a second, which any trained one replaces.
pub(super) fn is_starting(stored: &StoredBaseline) -> bool {
    let manifest = serde_json::from_slice::<Manifest>(&stored.manifest);
    manifest.is_ok_and(|manifest| manifest.calibration.outcome() == Outcome::NotMeasured)
}

fn load(stored: &StoredBaseline, simulator: &Simulator) -> Result<Baseline, LoadError> {
    fault_point!("baseline::load", |_| Err(LoadError::SelfTest { difference: 1.0 }));
    Baseline::load(&stored.manifest, &stored.weights, simulator)
}

/// A stored structure, or why this version of the program refuses it; `None` for one that was removed in the meantime. A definition
/// that the library has was checked there.
async fn read_stored(
    structures: &ActiveStructures,
    id: StructureId,
) -> Result<Option<(StructureId, Result<Simulator, DefinitionError>)>, Error> {
    let Some(record) = structures.store.structures().structure(&id).await? else { return Ok(None) };
    let library = structures.library();
    let is_same = |simulator: &Simulator| simulator.definition().canonical_json() == record.definition_json;
    if let Some(entry) = library.get(&id).filter(|entry| is_same(&entry.simulator)) {
        return Ok(Some((id, Ok(entry.simulator.clone()))));
    }
    let parsed = tokio::task::spawn_blocking(move || Simulator::parse_json(&record.definition_json)).await;
    Ok(Some((id, parsed.map_err(|_| Error::Panicked)?)))
}

/// Code and sentence of a finding about a baseline that did not pass its calibration; `None` for one that passed.
fn doubtful_calibration(structure: &StructureId, baseline: &Baseline) -> Option<(&'static str, String)> {
    let calibration = &baseline.manifest().calibration;
    let code = match calibration.outcome() {
        Outcome::Passed | Outcome::NotMeasured => return None,
        Outcome::Cautious => "model_cautious",
        Outcome::Overconfident => "model_overconfident",
    };
    Some((code, format!("{structure}: {}", calibration_in_words(calibration)?)))
}

/// Logs a baseline that is put into use although it did not pass its calibration.
fn warn_of_calibration(structure: &StructureId, baseline: &Baseline) {
    if let Some((code, message)) = doubtful_calibration(structure, baseline) {
        warn!(structure.id = %structure, model.digest = %baseline.digest(), finding = code, "Model of {message}");
    }
}
