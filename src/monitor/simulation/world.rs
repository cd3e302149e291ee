//! The program under simulation: one life of the process after another on the same data folder.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use futures_util::future::join_all;
use tempfile::TempDir;
use tokio::runtime::{Builder, Runtime};

use super::faults::{Mode, Plan};
use super::history::{structure, Action, Client, Content, Round, HEALTHY};
use crate::alarm::AlarmSettings;
use crate::baseline::library::Library;
use crate::clock;
use crate::fault::Faults;
use crate::monitor::compute::ComputeSettings;
use crate::monitor::{
    DeclareError, Error, ExtensionRequest, IngestError, Monitor, MonitorSettings, ReferenceChoice, ReferenceRequest,
    ReloadError,
};
use crate::quantity::{Digest, StructureId, Timestamp};
use crate::store::{self, Acknowledgement, EpisodeQuery, EventFilter, Secret, Store, WebhookRecord, DATABASE_FILE};

/// Longest wait until nothing runs in the background, far more than a busy machine needs.
const PATIENCE: Duration = Duration::from_mins(1);

/// Time after which a batch is forgotten that waits while nothing runs.
const FORGOTTEN: Duration = Duration::from_secs(5);

/// Time of the first round, µs: after the last measurement.
const NOW_US: i64 = 1_770_000_000_000_000;

/// Id of the webhook to which every change of an alarm is addressed.
pub(super) const WEBHOOK: &str = "all";

/// What all seeds share: two trained models that differ in their digest only, and a database that was just made.
pub(super) struct Ground {
    folder: TempDir,
    manifests: [Vec<u8>; 2],
    libraries: [Library; 2],
}

/// A folder in memory where the machine has one: a sync to a disk takes longer than all the rest.
fn fast_folder() -> TempDir {
    let memory = Path::new("/dev/shm");
    let folder = if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() };
    folder.unwrap()
}

impl Ground {
    pub fn new() -> Self {
        let folder = fast_folder();
        let (from, to) =
            (Path::new(env!("CARGO_MANIFEST_DIR")).join("models/three-dof"), folder.path().join("models/one"));
        std::fs::create_dir_all(&to).unwrap();
        for file in ["structure.toml", "baseline.safetensors"] {
            std::fs::copy(from.join(file), to.join(file)).unwrap();
        }
        let manifest = std::fs::read(from.join("baseline.json")).unwrap();
        let manifests = [manifest.clone(), [manifest, b"\n".to_vec()].concat()];
        let library = |manifest: &Vec<u8>| {
            std::fs::write(to.join("baseline.json"), manifest).unwrap();
            Library::open(Some(&folder.path().join("models"))).unwrap()
        };
        let libraries = [library(&manifests[0]), library(&manifests[1])];
        let ground = Self { folder, manifests, libraries };
        let runtime = Builder::new_current_thread().enable_all().build().unwrap();
        runtime.block_on(async {
            let store = Store::open(&ground.template()).await.unwrap();
            let now = clock::now();
            let webhook = WebhookRecord {
                id: WEBHOOK.to_owned(),
                url: "http://localhost/".to_owned(),
                secret: Secret::new("whsec_AA==".to_owned()),
                previous_secret: None,
                filter: EventFilter::default(),
                enabled: true,
                created_at: now,
                updated_at: now,
            };
            assert!(store.webhooks().insert_webhook(webhook, 1).await.unwrap());
            Monitor::open(store.clone(), ground.libraries[0].clone(), settings()).await.unwrap();
            store.close().await;
        });
        ground
    }

    /// The model with a digest.
    pub fn model_of(&self, digest: &Digest) -> usize {
        let has = |library: &Library| {
            library
                .get(&structure())
                .and_then(|entry| entry.baseline.as_ref())
                .is_some_and(|own| own.digest() == digest)
        };
        self.libraries.iter().position(has).expect("there are two models")
    }

    fn template(&self) -> PathBuf {
        self.folder.path().join("template")
    }

    /// Writes one of the models into the models folder.
    fn put_model(&self, model: usize) {
        std::fs::write(self.folder.path().join("models/one/baseline.json"), &self.manifests[model]).unwrap();
    }
}

fn settings() -> MonitorSettings {
    MonitorSettings {
        draws_per_measurement: 2,
        draws_for_population: 12,
        alarm: AlarmSettings { recovery: 2, mean_run_batches: Some(50.0), ..AlarmSettings::default() },
        compute: ComputeSettings { threads: 2, queue: 8 },
        ..MonitorSettings::default()
    }
}

/// A running process.
pub(super) struct Life {
    pub runtime: Runtime,
    pub monitor: Monitor,
    /// Tasks that run while nothing happens.
    resting: usize,
}

impl Life {
    /// Waits until nothing runs in the background.
    pub async fn idle(&self) -> Result<(), String> {
        let (started, mut rest) = (Instant::now(), None);
        loop {
            tokio::time::sleep(Duration::from_micros(200)).await;
            let running = alive().saturating_sub(self.resting);
            if started.elapsed() > PATIENCE {
                return Err(format!("{running} tasks still run after {PATIENCE:?}"));
            }
            if running > 0 {
                rest = None;
                continue;
            }
            let waiting = self.waiting().await;
            if waiting.is_empty() {
                return Ok(());
            }
            // A batch that waits although nothing runs is forgotten.
            if rest.get_or_insert_with(Instant::now).elapsed() > FORGOTTEN {
                return Err(format!("the batches {waiting:?} wait, and nothing runs that would assess them"));
            }
        }
    }

    /// The batches that wait for their assessment.
    async fn waiting(&self) -> Vec<String> {
        let waiting = self.monitor.store().batches().pending(&structure(), 1_000).await;
        waiting.unwrap_or_default()
    }
}

fn alive() -> usize {
    tokio::runtime::Handle::current().metrics().num_alive_tasks()
}

/// What clients have seen.
#[derive(Default)]
pub(super) struct Seen {
    /// Ids under which a batch was acknowledged, in order.
    pub acknowledged: BTreeMap<Content, Vec<String>>,
    /// What may not happen, as sentences.
    pub violations: Vec<String>,
    /// Batches before this place may have been deleted.
    pub retained_from: usize,
    /// Whether another model was put into use.
    pub swapped: bool,
    pub references: u32,
}

/// A data folder, its process, and what clients have seen of it.
pub(super) struct World<'g> {
    ground: &'g Ground,
    faults: &'g Faults,
    plan: &'g Plan,
    folder: TempDir,
    model: usize,
    now_us: i64,
    pub seen: Arc<Mutex<Seen>>,
    pub life: Option<Life>,
}

impl<'g> World<'g> {
    pub fn new(ground: &'g Ground, faults: &'g Faults, plan: &'g Plan, model: usize) -> Self {
        let folder = fast_folder();
        std::fs::copy(ground.template().join(DATABASE_FILE), folder.path().join(DATABASE_FILE)).unwrap();
        ground.put_model(model);
        let (now_us, seen, life) = (NOW_US, Arc::default(), None);
        let mut world = Self { ground, faults, plan, folder, model, now_us, seen, life };
        world.pass(0);
        world.start(Mode::None);
        world
    }

    /// Sets the clock.
    fn pass(&mut self, seconds: i64) {
        self.now_us += seconds * 1_000_000;
        self.faults.set("clock", &format!("return({})", self.now_us));
    }

    /// Starts the process; a start that fails is repeated, at last without faults.
    fn start(&mut self, mode: Mode) {
        for mode in [mode, mode, Mode::None] {
            self.plan.set(mode, None);
            let runtime = Builder::new_current_thread().enable_all().build().unwrap();
            let opened = runtime.block_on(async {
                let store = Store::open(self.folder.path()).await?;
                store.file().set_limits(&limits(false));
                let monitor = Monitor::open(store, self.ground.libraries[self.model].clone(), settings()).await?;
                // Connections go back to their pool in tasks of their own.
                let mut resting = usize::MAX;
                for _ in 0..4 {
                    tokio::time::sleep(Duration::from_millis(1)).await;
                    resting = resting.min(alive());
                }
                monitor.replay().resume_all();
                Ok::<_, Error>((monitor, resting))
            });
            match opened {
                Ok((monitor, resting)) => return self.life = Some(Life { runtime, monitor, resting }),
                Err(error) => assert!(mode != Mode::None, "a start without faults fails: {error}"),
            }
        }
    }

    /// Ends the process at once, and starts it again.
    pub fn kill(&mut self, mode: Mode) {
        drop(self.life.take());
        self.start(mode);
    }

    /// Runs a round.
    pub fn round(&mut self, round: &Round) {
        self.pass(round.seconds);
        for Client { action, .. } in &round.clients {
            if let Action::Reload { model, .. } = action {
                self.ground.put_model(*model);
            }
        }
        self.plan.set(round.faults, round.kill);
        let life = self.life.as_ref().expect("the process runs");
        life.monitor.store().file().set_limits(&limits(round.disk_full));
        let clients = round.clients.iter().map(|client| {
            let (monitor, seen, clean) = (life.monitor.clone(), Arc::clone(&self.seen), round.is_clean());
            act(monitor, seen, client.clone(), clean)
        });
        let idle = life.runtime.block_on(async {
            tokio::select! {
                biased;
                () = self.plan.killed() => return Ok(()),
                _ = join_all(clients) => {}
            }
            // With faults that persist, what waits is attempted for ever.
            if round.quiet && round.is_clean() {
                life.idle().await
            } else {
                Ok(())
            }
        });
        if let Err(violation) = idle {
            self.seen.lock().unwrap().violations.push(violation);
        }
        // A reload that has not ended puts the model into use that is on the disk, as the next start does.
        let model_on_disk =
            |client: &Client| if let Action::Reload { model, .. } = client.action { Some(model) } else { None };
        self.model = round.clients.iter().filter_map(model_on_disk).next_back().unwrap_or(self.model);
        if round.kill.is_some() {
            self.kill(round.faults);
        }
    }

    /// Ends faults and waits until everything is done.
    pub fn calm(&mut self, restart: bool) -> Result<(), String> {
        self.plan.set(Mode::None, None);
        if restart {
            self.kill(Mode::None);
        }
        let life = self.life.as_ref().expect("the process runs");
        life.monitor.store().file().set_limits(&limits(false));
        life.runtime.block_on(life.idle())
    }

    /// Ends the process as a stop does. A transaction that were still open would keep the log from being written back.
    pub fn close(&mut self) -> Result<(), String> {
        let Some(Life { runtime, monitor, .. }) = self.life.take() else { return Ok(()) };
        runtime.block_on(async {
            monitor.store().close().await;
            // A worker of SQLite that has ended its connection removes the log a moment later.
            tokio::time::sleep(Duration::from_millis(1)).await;
        });
        let log = self.folder.path().join(format!("{DATABASE_FILE}-wal"));
        let left = std::fs::metadata(log).map_or(0, |log| log.len());
        if left == 0 {
            Ok(())
        } else {
            Err(format!("{left} bytes are left in the log: a transaction is open"))
        }
    }
}

fn limits(full: bool) -> store::StoreSettings {
    store::StoreSettings { min_free_bytes: if full { u64::MAX } else { 0 }, ..store::StoreSettings::default() }
}

/// What became of an attempt.
enum Attempt {
    Done,
    /// The store failed, so that it is not known whether anything was stored.
    Unknown(String),
    /// It was refused, which clients do not repeat.
    Refused,
    /// It failed as no fault that passes makes it fail.
    Broken(String),
}

/// One client in a round.
async fn act(monitor: Monitor, seen: Arc<Mutex<Seen>>, Client { yields, tries, action }: Client, clean: bool) {
    for _ in 0..yields {
        tokio::task::yield_now().await;
    }
    for _ in 0..tries {
        let attempt = match &action {
            Action::Post { content, key } => post(&monitor, &seen, *content, *key).await,
            Action::Declare { batches } => declare(&monitor, &seen, *batches).await,
            Action::Extend { batches } => extend(&monitor, &seen, *batches).await,
            Action::Reload { renew, .. } => reload(&monitor, &seen, *renew).await,
            Action::Acknowledge => acknowledge(&monitor).await,
            Action::Retain { before } => retain(&monitor, &seen, *before).await,
        };
        match attempt {
            Attempt::Unknown(error) if clean => {
                seen.lock().unwrap().violations.push(format!("{action:?} fails without a fault: {error}"));
            }
            Attempt::Broken(error) => seen.lock().unwrap().violations.push(format!("{action:?}: {error}")),
            Attempt::Unknown(_) => continue,
            Attempt::Done | Attempt::Refused => {}
        }
        return;
    }
}

fn unknown(error: &Error) -> Attempt {
    match error {
        Error::Store(store) if store.is_temporary() => Attempt::Unknown(error.to_string()),
        Error::Store(_) | Error::Panicked => Attempt::Broken(error.to_string()),
        _ => Attempt::Refused,
    }
}

async fn post(monitor: &Monitor, seen: &Mutex<Seen>, content: Content, key: Option<Content>) -> Attempt {
    let taken = match monitor.ingest().take(content.batch(key.map(Content::key))).await {
        Ok(taken) => taken,
        // A batch that was removed meanwhile is stored again.
        Err(IngestError::Monitor(error @ Error::UnknownBatch { .. })) => return Attempt::Broken(error.to_string()),
        Err(IngestError::Monitor(error)) => return unknown(&error),
        Err(_) => return Attempt::Refused,
    };
    let mut seen = seen.lock().unwrap();
    let (id, may_be_deleted) = (taken.view.record.batch_id, content.place < seen.retained_from);
    let ids = seen.acknowledged.entry(content).or_default();
    let same = ids.last().is_none_or(|last| *last == id) || may_be_deleted;
    ids.push(id);
    if taken.view.record.batch.measurements != content.measurements() {
        seen.violations.push(format!("{content:?} is answered with other measurements"));
    }
    if !same {
        seen.violations.push(format!("{content:?} was acknowledged under two ids"));
    }
    Attempt::Done
}

/// Ids of the first batches, if all of them were acknowledged.
fn first(seen: &Mutex<Seen>, batches: usize) -> Option<Vec<String>> {
    let seen = seen.lock().unwrap();
    let id = |place: usize| {
        let mut of_place = seen.acknowledged.iter().filter(|(content, _)| content.place == place);
        of_place.next().and_then(|(_, ids)| ids.last().cloned())
    };
    (0..batches.min(HEALTHY)).map(id).collect()
}

fn made(seen: &Mutex<Seen>, outcome: Result<impl Sized, DeclareError>) -> Attempt {
    match outcome {
        Ok(_) => {
            seen.lock().unwrap().references += 1;
            Attempt::Done
        }
        Err(DeclareError::Monitor(error)) => unknown(&error),
        Err(_) => Attempt::Refused,
    }
}

async fn declare(monitor: &Monitor, seen: &Mutex<Seen>, batches: usize) -> Attempt {
    let Some(ids) = first(seen, batches) else { return Attempt::Refused };
    let choice = ReferenceChoice::Batches(ids);
    let request = ReferenceRequest { choice, leave_out_doubtful: false, threshold_probability: 0.05, reason: None };
    made(seen, monitor.replay().declare_reference(&structure(), request).await)
}

async fn extend(monitor: &Monitor, seen: &Mutex<Seen>, batches: usize) -> Attempt {
    let Some(ids) = first(seen, batches) else { return Attempt::Refused };
    let choice = ReferenceChoice::Batches(ids);
    let request = ExtensionRequest { choice, leave_out_doubtful: false, reason: None, despite_alarms: true };
    made(seen, monitor.replay().extend_reference(&structure(), request).await)
}

async fn reload(monitor: &Monitor, seen: &Mutex<Seen>, renew: bool) -> Attempt {
    seen.lock().unwrap().swapped = true;
    match monitor.models().reload(&structure(), renew).await {
        Ok(_) => Attempt::Done,
        Err(ReloadError::Monitor(error)) => unknown(&error),
        // A model that could not be loaded.
        Err(refused @ ReloadError::Refused { .. }) => Attempt::Unknown(refused.to_string()),
    }
}

async fn acknowledge(monitor: &Monitor) -> Attempt {
    let query = EpisodeQuery { before: None, open_only: true, superseded: true, limit: 100 };
    let open = match monitor.alarms().episodes(&structure(), query).await {
        Ok(open) => open,
        Err(error) => return unknown(&error),
    };
    for episode in open {
        let acknowledgement = Acknowledgement { at: clock::now(), by: "somebody".to_owned(), note: None };
        if let Err(error) = monitor.alarms().acknowledge(&structure(), episode.number, acknowledgement).await {
            return unknown(&error);
        }
    }
    Attempt::Done
}

async fn retain(monitor: &Monitor, seen: &Mutex<Seen>, before: usize) -> Attempt {
    {
        let mut seen = seen.lock().unwrap();
        seen.retained_from = seen.retained_from.max(before);
    }
    let before = Timestamp::from_micros(Content::from_us(before)).unwrap();
    let retention = monitor.store().retention();
    let expired = match retention.expired(before).await {
        Ok(expired) => expired,
        Err(error) => return unknown(&error.into()),
    };
    for structure in expired {
        let structure = StructureId::parse(&structure.structure).unwrap();
        loop {
            match retention.delete_expired(&structure, before, 2).await {
                Ok(deleted) if deleted.batches == 0 => break,
                Ok(_) => {}
                Err(error) => return unknown(&error.into()),
            }
        }
    }
    Attempt::Done
}
