//! The application: batches are taken, stored and assessed; undamaged references are declared; diagnoses run as jobs.
//!
//! [`Monitor`] owns the parts and hands them out. Each part is a cheap handle:
//!
//! | part | what it does |
//! |---|---|
//! | [`ActiveStructures`] | the structures in use with their trained baselines |
//! | [`Ingest`] | check, store and assess a batch |
//! | [`Replay`] | declare an undamaged reference, assess stored batches that wait |
//! | [`Records`] | read batches, assessments and series |
//! | [`Alarms`] | read and acknowledge alarms, charts, maintenance |
//! | [`Jobs`], [`Versions`] | diagnose, train, extend a structure, undo an extension |
//! | [`Models`] | replace a trained baseline |
//! | [`Upkeep`] | health, gauges, backups, retention, silence, diagnoses that nobody requested |
//! | [`Archive`] | export and import a structure |
//!
//! [`Worker`] computes assessments and jobs for the monitor of another process.

mod alarms;
pub mod archive;
mod assessor;
pub mod automatic_diagnoses;
pub mod automatic_trainings;
mod backups;
mod computation;
pub mod compute;
mod deletion;
mod details;
mod error;
pub mod events;
mod ingest;
mod jobs;
mod metrics;
mod models;
mod own_task;
mod patience;
mod probe;
mod program;
mod readers;
mod reason;
mod records;
mod references;
mod replay;
pub mod retention;
mod roles;
mod settings;
mod sharing;
mod silence;
#[cfg(test)]
mod simulation;
pub mod stored;
mod structures;
mod supervise;
#[cfg(test)]
mod tests;
mod upkeep;
mod versions;
mod worker;

use std::sync::Arc;
use std::time::{Duration, Instant};

pub use self::alarms::Alarms;
use self::archive::Archive;
use self::assessor::Assessor;
use self::automatic_diagnoses::AutomaticDiagnoses;
use self::automatic_trainings::AutomaticTrainings;
pub use self::backups::Backups;
use self::compute::Compute;
pub use self::deletion::{DeletedStructure, Deletions};
pub use self::error::{
    BackupError, DeclareError, DeleteError, Error, IngestError, JobError, LeftOutBatch, ReloadError,
};
use self::events::Events;
pub use self::ingest::{Ingest, Ingested, DEFAULT_SOURCE};
pub use self::jobs::{
    DiagnosisRequest, ExtensionResult, ExtensionTraining, JobStatus, Jobs, TrainingRequest, TrainingResult,
};
pub use self::metrics::declare_metrics;
pub use self::models::{Models, Reloaded};
use self::probe::WriterProbe;
pub use self::readers::{Readers, TooManyReaders};
pub use self::reason::Reason;
pub use self::records::{BatchView, FoundBatch, FoundReference, Missing, Records, Series};
use self::references::References;
pub use self::references::{DeclaredReference, ExtensionRequest, ReferenceChoice, ReferenceRequest};
pub use self::replay::Replay;
use self::retention::Retention;
pub use self::roles::{Roles, RolesError};
pub use self::settings::{MissingCovariate, MonitorSettings, TrainingStart};
pub use self::silence::Silence;
pub use self::structures::{ActiveStructure, ActiveStructures};
pub use self::upkeep::{Health, Upkeep};
pub use self::versions::Versions;
pub use self::worker::{Worker, WorkerHealth, WorkerSettings};
use crate::baseline::library::Library;
use crate::quantity::StructureId;
use crate::store::{Audit, Engine, Outbox, Quarantine, Store, Webhooks};

/// The application. It gives access to its parts; cloning it is cheap.
#[derive(Clone)]
pub struct Monitor {
    store: Store,
    events: Events,
    structures: Arc<ActiveStructures>,
    alarms: Arc<Alarms>,
    records: Records,
    readers: Readers,
    checks: Readers,
    ingest: Ingest,
    replay: Replay,
    versions: Versions,
    jobs: Jobs,
    models: Models,
    upkeep: Upkeep,
    archive: Archive,
    deletions: Deletions,
}

impl Monitor {
    /// Stores the structures of the library that are not stored yet, and activates all stored structures.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn open(store: Store, library: Library, mut settings: MonitorSettings) -> Result<Self, Error> {
        settings.alarm.smallest_percent.get_or_insert(settings.severity.moderate_percent);
        let events = Events::default();
        let trained = (settings.accept_uncalibrated.clone(), settings.training);
        let structures = ActiveStructures::open(store.clone(), library, events.clone(), trained).await?;
        let structures = Arc::new(structures);
        let alarms = Arc::new(Alarms::new(store.clone(), events.clone(), settings.severity));
        for structure in structures.ids() {
            // Alarms of an earlier run are not published again.
            alarms.changes(&structure).await;
        }
        let compute = Compute::new(settings.compute);
        let (silence_after_s, training) = (settings.alarm.silence_after_s, settings.training);
        let assessor = Arc::new(Assessor {
            store: store.clone(),
            structures: Arc::clone(&structures),
            compute: compute.clone(),
            known_limits: Arc::default(),
            alarms: Arc::clone(&alarms),
            events: events.clone(),
            settings,
        });
        let references = Arc::new(References::new(Arc::clone(&assessor)));
        let replay = Replay::new(Arc::clone(&assessor), Arc::clone(&references));
        let readers = Readers::of_details();
        let records = Records::new(Arc::clone(&assessor), readers.clone());
        let versions = Versions::new(store.clone(), Arc::clone(&structures), Arc::clone(&references), replay.clone());
        let jobs = Jobs::new(store.clone(), Arc::clone(&structures), versions.clone(), events.clone());
        let deletions = Deletions::new(store.clone(), Arc::clone(&structures), jobs.clone(), events.clone());
        let models = Models::new(store.clone(), Arc::clone(&structures), references, replay.clone());
        let upkeep = Upkeep {
            store: store.clone(),
            structures: Arc::clone(&structures),
            models: models.clone(),
            compute,
            probe: WriterProbe::new(store.clone()),
            backups: Backups::new(store.clone(), Arc::clone(&structures)),
            retention: Retention::new(store.clone()),
            diagnoses: AutomaticDiagnoses::new(store.clone(), Arc::clone(&structures), jobs.clone()),
            trainings: AutomaticTrainings::new(
                store.clone(),
                Arc::clone(&structures),
                jobs.clone(),
                events.clone(),
                training,
            ),
            silence: Silence::new(store.clone(), Arc::clone(&structures), Arc::clone(&alarms), silence_after_s),
            sources: Arc::default(),
            unreadable: Arc::default(),
            started: Instant::now(),
        };
        let ingest = Ingest::new(Arc::clone(&assessor), replay.clone(), records.clone());
        let checks = Readers::of_checks();
        let archive = Archive::new(assessor, replay.clone());
        Ok(Self {
            store,
            events,
            structures,
            alarms,
            records,
            readers,
            checks,
            ingest,
            replay,
            versions,
            jobs,
            models,
            upkeep,
            archive,
            deletions,
        })
    }

    /// Shares computations with workers from now on: waiting batches and jobs. `own` is the worker in this process, empty if there is none, and
    /// `lease` is how long they may not be heard of.
    ///
    /// # Errors
    /// [`Error::Store`] if what an earlier service has left behind cannot be removed.
    pub async fn share(&self, own: String, lease: Duration) -> Result<(), Error> {
        self.jobs.share(self.replay.share(own, lease).await?);
        Ok(())
    }

    /// Whether a structure without a model is answered from its first batch on, and then trained, without a request.
    pub fn trains_by_itself(&self, simulator: &crate::simulator::Simulator) -> bool {
        self.structures.trains_by_itself(simulator)
    }

    /// A structure in use.
    ///
    /// # Errors
    /// [`Error::UnknownStructure`], [`Error::DefinitionRefused`].
    pub fn structure(&self, id: &StructureId) -> Result<Arc<ActiveStructure>, Error> {
        self.structures.get(id)
    }

    /// The structures in use, with their trained baselines and the library on disk.
    pub fn structures(&self) -> &ActiveStructures {
        &self.structures
    }

    /// Checks, stores and assesses new batches.
    pub fn ingest(&self) -> &Ingest {
        &self.ingest
    }

    /// Declares undamaged references, and assesses stored batches that wait.
    pub fn replay(&self) -> &Replay {
        &self.replay
    }

    /// Reads stored batches, their assessments, and time series.
    pub fn records(&self) -> &Records {
        &self.records
    }

    /// Turns for what has to be computed for a reader.
    pub fn readers(&self) -> &Readers {
        &self.readers
    }

    /// Turns for the check of a definition.
    pub fn checks(&self) -> &Readers {
        &self.checks
    }

    /// Reads and acknowledges alarms, and reads alarm charts and maintenance windows.
    pub fn alarms(&self) -> &Alarms {
        &self.alarms
    }

    /// Starts diagnoses, extensions and trainings, and reads their results.
    pub fn jobs(&self) -> &Jobs {
        &self.jobs
    }

    /// Undoes extensions of structures.
    pub fn versions(&self) -> &Versions {
        &self.versions
    }

    /// Replaces trained baselines by those of the models folder.
    pub fn models(&self) -> &Models {
        &self.models
    }

    /// The health of the service, its gauges, backups, retention, alarms of silence, and diagnoses that nobody requested.
    pub fn upkeep(&self) -> &Upkeep {
        &self.upkeep
    }

    /// Deletes structures.
    pub fn deletions(&self) -> &Deletions {
        &self.deletions
    }

    /// Exports a structure as an archive, and imports archives.
    pub fn archive(&self) -> &Archive {
        &self.archive
    }

    /// The event bus, for subscribers to changes of batches, alarms, jobs and structures.
    pub fn events(&self) -> &Events {
        &self.events
    }

    /// The registered webhooks.
    pub fn webhooks(&self) -> Webhooks<'_> {
        self.store.webhooks()
    }

    /// The deliveries to webhooks.
    pub fn outbox(&self) -> Outbox<'_> {
        self.store.outbox()
    }

    /// Messages from the broker that could not become a batch.
    pub fn quarantine(&self) -> Quarantine<'_> {
        self.store.quarantine()
    }

    /// The audit log.
    pub fn audit(&self) -> Audit<'_> {
        self.store.audit()
    }

    /// The program behind the database, and its version.
    pub fn database(&self) -> (Engine, &str) {
        (self.store.file().engine(), self.store.file().version())
    }

    /// Number of the last migration of the database.
    pub fn schema_version(&self) -> i64 {
        self.store.file().schema_version()
    }

    /// The store, for the command line and tests, which open and close it.
    pub fn store(&self) -> &Store {
        &self.store
    }
}
