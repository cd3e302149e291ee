//! The trained baselines of a worker, found by their digests.

use std::collections::VecDeque;
use std::path::PathBuf;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use crate::baseline::library::Library;
use crate::baseline::Baseline;
use crate::quantity::{shown, Digest, StructureId};
use crate::simulator::Simulator;
use crate::store::{self, Store};

/// Number of trained baselines that are kept in memory.
const KEPT: usize = 4;

/// After this time, the models folder is read again for one that was not in it.
const READ_AGAIN: Duration = Duration::from_secs(30);

/// Why there is no trained baseline.
#[derive(Debug)]
pub(super) enum Missing {
    /// This process cannot have it.
    Absent(String),
    /// The database could not be asked.
    Store(store::Error),
}

impl From<store::Error> for Missing {
    fn from(error: store::Error) -> Self {
        Self::Store(error)
    }
}

/// The trained baselines that were used last, and where others come from: the database, the program, the models folder.
pub(super) struct WorkerModels {
    store: Store,
    folder: Option<PathBuf>,
    used: Mutex<VecDeque<Arc<Baseline>>>,
    library: tokio::sync::Mutex<Option<(Instant, Arc<Library>)>>,
}

impl WorkerModels {
    pub(super) fn new(store: Store, folder: Option<PathBuf>) -> Self {
        Self { store, folder, used: Mutex::default(), library: tokio::sync::Mutex::default() }
    }

    /// The trained baseline with a digest, for a version of a structure. Its files are checked against their digests, and its self-test has
    /// passed.
    pub(super) async fn find(
        &self,
        structure: &StructureId,
        version: &Digest,
        model: &Digest,
    ) -> Result<Arc<Baseline>, Missing> {
        if let Some(known) = self.used(version, model) {
            return Ok(known);
        }
        let found = match self.store.structures().trained_baseline(structure, version).await? {
            Some(stored) if stored.model_digest == model.as_str() => {
                let simulator = self.version(structure, version).await?;
                let load = move || Baseline::load(&stored.manifest, &stored.weights, &simulator);
                Arc::new(blocking(load).await?.map_err(|refusal| Missing::Absent(format!("it is refused: {refusal}")))?)
            }
            _ => self.of_library(structure, version, model).await?,
        };
        let mut used = self.used.lock().expect("no holder of this lock panics");
        used.push_front(Arc::clone(&found));
        used.truncate(KEPT);
        Ok(found)
    }

    /// One of those in memory, which becomes the last that is forgotten.
    fn used(&self, version: &Digest, model: &Digest) -> Option<Arc<Baseline>> {
        let mut used = self.used.lock().expect("no holder of this lock panics");
        let place = used.iter().position(|own| own.digest() == model && own.simulator().digest() == version)?;
        let found = used.remove(place)?;
        used.push_front(Arc::clone(&found));
        Some(found)
    }

    /// A version of a structure.
    pub(super) async fn version(&self, structure: &StructureId, version: &Digest) -> Result<Simulator, Missing> {
        let present = self.store.structures().structure(structure).await?.filter(|stored| stored.digest == *version);
        let definition = match present {
            Some(stored) => Some(stored.definition_json),
            None => self.store.structures().structure_version(structure, version).await?.map(|(json, _)| json),
        };
        let definition =
            definition.ok_or_else(|| Missing::Absent("its structure is not stored any more".to_owned()))?;
        let parsed = blocking(move || Simulator::parse_json(&definition)).await?;
        parsed.map_err(|problem| Missing::Absent(format!("its structure is refused: {problem}")))
    }

    /// The trained baseline in the program or in the models folder.
    async fn of_library(
        &self,
        structure: &StructureId,
        version: &Digest,
        model: &Digest,
    ) -> Result<Arc<Baseline>, Missing> {
        let mut library = self.library.lock().await;
        let of = |library: &Library| {
            let baseline = library.get(structure)?.baseline.clone()?;
            (baseline.digest() == model && baseline.simulator().digest() == version).then_some(baseline)
        };
        if let Some((read, known)) = &*library {
            match of(known) {
                Some(found) => return Ok(found),
                None if read.elapsed() < READ_AGAIN => return Err(self.absent()),
                None => {}
            }
        }
        let folder = self.folder.clone();
        let read = blocking(move || Library::open(folder.as_deref())).await?;
        let read = Arc::new(read.map_err(|error| Missing::Absent(error.to_string()))?);
        let found = of(&read);
        *library = Some((Instant::now(), read));
        found.ok_or_else(|| self.absent())
    }

    fn absent(&self) -> Missing {
        let folder = match &self.folder {
            Some(folder) => format!("not in {}", shown(&folder.display().to_string())),
            None => "this process has no --models folder".to_owned(),
        };
        Missing::Absent(format!("it is neither in the database nor in the program, and {folder}"))
    }
}

async fn blocking<T: Send + 'static>(work: impl FnOnce() -> T + Send + 'static) -> Result<T, Missing> {
    let done = tokio::task::spawn_blocking(work).await;
    done.map_err(|_| Missing::Absent("reading it panicked".to_owned()))
}
