//! A monitor with its own database, for targets that store something.

use std::cell::RefCell;
use std::path::Path;

use modalwatch::baseline::library::{find_structure, Library};
use modalwatch::monitor::{Monitor, MonitorSettings};
use modalwatch::simulator::definition::StructureDefinition;
use modalwatch::simulator::Simulator;
use modalwatch::store::Store;
use tempfile::TempDir;
use tokio::runtime::{Builder, Runtime};

/// Inputs after which the database begins anew, so that it stays small.
const INPUTS: usize = 500;

/// A monitor with the structures of the program, and one, `plain`, for which there is no trained model.
pub struct World {
    pub monitor: Monitor,
    pub store: Store,
    #[allow(dead_code, reason = "not every target writes files")]
    pub folder: TempDir,
    inputs: usize,
}

impl World {
    async fn new() -> Self {
        // In memory, where there is such a folder: the time of a sync says nothing here.
        let place = Path::new("/dev/shm");
        let folder = if place.is_dir() { tempfile::tempdir_in(place) } else { tempfile::tempdir() }.unwrap();
        let store = Store::open(folder.path()).await.unwrap();
        let monitor =
            Monitor::open(store.clone(), Library::open(None).unwrap(), MonitorSettings::default()).await.unwrap();
        let json = find_structure("three-dof").unwrap().definition().canonical_json();
        let json = json.replace("\"id\":\"three-dof\"", "\"id\":\"plain\"");
        let plain = Simulator::new(StructureDefinition::parse_json(&json).unwrap()).unwrap();
        monitor.structures().put(plain).await.unwrap();
        Self { monitor, store, folder, inputs: 0 }
    }
}

/// Runs one input on the monitor of this thread.
pub fn with(input: impl AsyncFnOnce(&World)) {
    thread_local! {
        static RUNTIME: Runtime = Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
        static WORLD: RefCell<Option<World>> = const { RefCell::new(None) };
    }
    RUNTIME.with(|runtime| {
        WORLD.with(|place| {
            runtime.block_on(async {
                let mut place = place.borrow_mut();
                if let Some(old) = place.take_if(|world| world.inputs >= INPUTS) {
                    old.store.close().await;
                }
                if place.is_none() {
                    *place = Some(World::new().await);
                }
                let world = place.as_mut().unwrap();
                world.inputs += 1;
                input(world).await;
            });
        });
    });
}
