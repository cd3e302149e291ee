//! What happens to a batch: store it, assess it, store the result; declare undamaged states; resume after a restart.

pub mod archive;
pub mod compute;
mod detail;
mod diagnoses;
pub mod events;
mod intake;
mod models;
mod probe;
mod replay;
pub mod retention;
mod silence;
mod task;
#[cfg(test)]
mod tests;
mod undamaged;
pub mod upkeep;
mod watched;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, RwLock};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use tokio::sync::oneshot;
use tracing::{error, warn, Instrument as _};

use crate::alarm::AlarmSettings;
use crate::assessment::{Assessment, BatchState, Draws, KnownLimits};
use crate::baseline::library::{Library, Refusal};
use crate::baseline::Baseline;
use crate::damage;
use crate::measurement::MeasurementBatch;
use crate::quantity::{Digest, StructureId, Timestamp};
use crate::simulator::definition::{DefinitionError, StructureDefinition};
use crate::simulator::Simulator;
use crate::store::{self, BatchRecord, InsertBatch, PutStructure, Store, StoredChartPoint};
use compute::{Compute, ComputeSettings, QueueFull};
pub use diagnoses::{DiagnosisRequest, ExtensionResult, ExtensionTraining};
use events::{Events, KnownAlarms};
pub use models::Reloaded;
use task::Task;
pub use watched::Watched;

/// How batches are taken and assessed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MonitorSettings {
    /// Posterior samples drawn for each measurement (paper §5.2: 10).
    pub draws_per_measurement: usize,
    /// Posterior samples drawn for each measurement to find the population behind a batch: a quarter of them at first, all where
    /// noise hides it or samples near it serve no better.
    pub draws_for_population: usize,
    /// Most measurements of one batch.
    pub max_measurements: usize,
    /// Digests of trained baselines that may be used although they did not pass their calibration; every answer says so.
    pub accept_uncalibrated: Vec<String>,
    /// What becomes of measurements that lack a covariate which the simulation depends on.
    pub missing_covariate: MissingCovariate,
    /// How alarms are raised.
    pub alarm: AlarmSettings,
    /// The queue in front of the processor.
    pub compute: ComputeSettings,
}

/// What becomes of measurements that lack a covariate which the simulation depends on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MissingCovariate {
    /// They are taken at all values that the effect was learnt from, flagged, and raise no alarm.
    Marginalise,
    /// They are refused with 422.
    Refuse,
}

impl Default for MonitorSettings {
    fn default() -> Self {
        Self {
            draws_per_measurement: Draws::PER_MEASUREMENT,
            draws_for_population: Draws::FOR_POPULATION,
            max_measurements: 5_000,
            accept_uncalibrated: Vec::new(),
            missing_covariate: MissingCovariate::Marginalise,
            alarm: AlarmSettings::default(),
            compute: ComputeSettings::default(),
        }
    }
}

/// Why the monitor could not do what it was asked.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// No such structure.
    #[error("there is no structure {0}")]
    UnknownStructure(StructureId),
    /// No such batch of that structure.
    #[error("structure {structure} has no batch {batch}")]
    UnknownBatch {
        /// The structure.
        structure: StructureId,
        /// The batch asked for.
        batch: String,
    },
    /// The structure has no trained baseline in use.
    #[error("structure {structure} has no trained baseline in use: {reason}")]
    NoModel {
        /// The structure.
        structure: StructureId,
        /// Why, and the next step.
        reason: String,
    },
    /// The queue is full; nothing was stored.
    #[error(transparent)]
    QueueFull(#[from] QueueFull),
    /// The key was used for other content.
    #[error("the idempotency key was used for batch {batch} with other content")]
    KeyConflict {
        /// The batch stored under that key.
        batch: String,
    },
    /// A measurement of this source and time is stored already, with other content around it.
    #[error(
        "measurement {ordinal} at {measured_at} of this source is already in batch {batch}, which has other content"
    )]
    MeasurementConflict {
        /// Index in the batch that was posted.
        ordinal: usize,
        /// Its time.
        measured_at: Timestamp,
        /// The batch that has it.
        batch: String,
    },
    /// Another definition of a structure that has batches.
    #[error("structure {0} has batches that were measured under another definition; use another id for the new one")]
    StructureInUse(StructureId),
    /// The same batch named twice.
    #[error("batch {0} is named twice")]
    RepeatedBatch(String),
    /// The batches make no undamaged state.
    #[error(transparent)]
    Undamaged(#[from] damage::Error),
    /// An inference failed.
    #[error("batch {batch} could not be used: {source}")]
    Assess {
        /// The batch.
        batch: String,
        /// The cause.
        source: crate::assessment::Error,
    },
    /// A batch that is not to be trusted cannot be part of an undamaged state.
    #[error("batch {batch} cannot be part of an undamaged state: {reason}")]
    UnfitForUndamaged {
        /// The batch.
        batch: String,
        /// What was found in it.
        reason: String,
    },
    /// More measurements than a diagnosis takes.
    #[error("{found} measurements are more than the {most} that one diagnosis takes: name fewer batches")]
    TooManyMeasurements {
        /// Measurements asked for.
        found: usize,
        /// Most.
        most: usize,
    },
    /// A batch without a current assessment.
    #[error("batch {batch} is not assessed: {reason}")]
    NotAssessed {
        /// The batch.
        batch: String,
        /// Why.
        reason: String,
    },
    /// No such diagnosis.
    #[error("there is no diagnosis {0}")]
    UnknownDiagnosis(String),
    /// A diagnosis that no extension can be made of.
    #[error("diagnosis {diagnosis} cannot be extended: {reason}")]
    NoExtension {
        /// The diagnosis.
        diagnosis: String,
        /// Why.
        reason: String,
    },
    /// Another version came in between.
    #[error("structure {0} became another version in the meantime: nothing was changed")]
    VersionChanged(StructureId),
    /// A structure whose present version extends none.
    #[error("structure {0} extends no earlier version: there is no step back")]
    NoStepBack(StructureId),
    /// A baseline that may not take the place of the one in use.
    #[error("the trained baseline for {structure} is refused, {}: {reason}", match kept {
        Some(digest) => format!("{digest} stays in use"),
        None => "there is none in use".to_owned(),
    })]
    ModelRefused {
        /// The structure.
        structure: StructureId,
        /// Why.
        reason: String,
        /// Digest of the one that stays in use.
        kept: Option<String>,
    },
    /// A backup is being made.
    #[error("a backup is being made: ask again when it is done")]
    BackupRunning,
    /// No backup was made.
    #[error(transparent)]
    Backup(#[from] store::backup::Error),
    /// A definition that does not pass.
    #[error("the definition of a structure is refused: {0}")]
    Definition(#[from] DefinitionError),
    /// A stored definition does not pass any more: the database was written by another version of the program.
    #[error(
        "the stored definition of structure {structure} is refused by this version of the program: {reason}; its batches are \
         kept: run the version that wrote it, or define the structure under another id"
    )]
    DefinitionRefused {
        /// The structure.
        structure: StructureId,
        /// Why.
        reason: String,
    },
    /// The database failed.
    #[error(transparent)]
    Store(#[from] store::Error),
    /// A computation or an owned task panicked: a bug.
    #[error("a task panicked")]
    Panicked,
}

/// A batch with all that is known of it.
pub struct BatchView {
    /// The batch as stored.
    pub record: BatchRecord,
    /// Its current assessment.
    pub assessment: Option<Assessment>,
    /// Its points on the alarm charts.
    pub charts: Vec<StoredChartPoint>,
    /// Why there is no assessment, or no comparison with an undamaged state; and what to do next.
    pub next_step: Option<String>,
}

/// What was done for a batch while it was being stored.
enum Begun {
    Computed(Box<task::Computed>),
    Not(compute::Place),
}

/// A batch taken in.
pub struct Ingested {
    /// The batch.
    pub view: BatchView,
    /// True when it had been posted before.
    pub replayed: bool,
}

/// The office: a cheap handle on store, baselines and queue.
#[derive(Clone)]
pub struct Monitor {
    store: Store,
    library: Arc<RwLock<Arc<Library>>>,
    watched: Arc<RwLock<BTreeMap<StructureId, Arc<Watched>>>>,
    /// Stored structures that this version of the program does not take, with the reason.
    refused: Arc<BTreeMap<StructureId, String>>,
    known_limits: Arc<KnownLimits>,
    /// Alarms that this process has logged.
    reported: Arc<Mutex<BTreeSet<(StructureId, i64)>>>,
    compute: Compute,
    events: Events,
    known_alarms: KnownAlarms,
    jobs: diagnoses::Jobs,
    /// Held while unassessed batches of a structure are worked off.
    resuming: Arc<Mutex<BTreeMap<StructureId, Arc<tokio::sync::Mutex<()>>>>>,
    /// Structures whose unassessed batches are tried again and again.
    recovering: Arc<Mutex<BTreeSet<StructureId>>>,
    settings: MonitorSettings,
    upkeep: Arc<upkeep::Upkeep>,
    probe: probe::WriterProbe,
}

impl Monitor {
    /// Puts the structures of the library into the store, where they are not yet, and takes up those stored.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn open(store: Store, library: Library, settings: MonitorSettings) -> Result<Self, Error> {
        for refusal in library.refusals() {
            error!(file = %refusal.file, "Refused {}: {}", refusal.file, refusal.reason);
        }
        let events = Events::default();
        let mut monitor = Self {
            probe: probe::WriterProbe::new(store.clone()),
            store,
            library: Arc::new(RwLock::new(Arc::new(library))),
            watched: Arc::default(),
            refused: Arc::default(),
            known_limits: Arc::default(),
            reported: Arc::default(),
            compute: Compute::new(settings.compute),
            jobs: diagnoses::Jobs::new(events.clone()),
            events,
            known_alarms: KnownAlarms::default(),
            resuming: Arc::default(),
            recovering: Arc::default(),
            settings,
            upkeep: Arc::default(),
        };
        for (id, entry) in monitor.library().iter() {
            let json = entry.simulator.definition().canonical_json();
            let outcome = monitor.store.put_structure(id, &json, entry.simulator.digest(), Timestamp::now()).await?;
            if outcome == PutStructure::Refused {
                warn!(structure.id = %id, "Kept the stored definition of {id}: it has batches and the library's differs");
            }
        }
        let interrupted = monitor.store.end_interrupted_jobs(Timestamp::now()).await?;
        if interrupted > 0 {
            warn!("{interrupted} diagnoses or extensions were interrupted by the end of the service before: marked as failed");
        }
        let mut refused = BTreeMap::new();
        for summary in monitor.store.structures().await? {
            if let Some(record) = monitor.store.structure(&summary.id).await? {
                let built = StructureDefinition::parse_json(&record.definition_json).and_then(Simulator::new);
                let simulator = match built {
                    Ok(simulator) => simulator,
                    // One structure must not keep the others from being watched.
                    Err(reason) => {
                        error!(structure.id = %summary.id, "Refused the stored definition of {}: {reason}", summary.id);
                        refused.insert(summary.id, reason.to_string());
                        continue;
                    }
                };
                let baseline = monitor.baseline_for(&simulator).await?;
                monitor.watch(simulator, baseline);
                // Alarms of an earlier run are no news.
                monitor.look_at_alarms(&summary.id).await;
            }
        }
        monitor.refused = Arc::new(refused);
        Ok(monitor)
    }

    /// The store, for what is only read.
    pub fn store(&self) -> &Store {
        &self.store
    }

    /// How batches are taken.
    pub fn settings(&self) -> &MonitorSettings {
        &self.settings
    }

    /// Files of the library that were refused.
    pub fn refusals(&self) -> Vec<Refusal> {
        self.library().refusals().to_vec()
    }

    /// Places left in the queue.
    pub fn free_places(&self) -> usize {
        self.compute.free()
    }

    /// Stores a batch, assesses it and stores the result.
    ///
    /// It runs in a task of its own: a client that goes away does not stop it half-way.
    ///
    /// # Errors
    /// [`Error::QueueFull`] with nothing stored; the conflicts of [`InsertBatch`]; [`Error::Store`].
    pub async fn ingest(&self, batch: MeasurementBatch) -> Result<Ingested, Error> {
        let place = self.compute.reserve()?;
        self.ingest_with(batch, place).await
    }

    /// As [`Self::ingest`], but waits at most `patience` for a place: for many batches in a row, each of which should neither
    /// crowd others out nor be sent back.
    ///
    /// # Errors
    /// As [`Self::ingest`].
    pub async fn ingest_in_turn(&self, batch: MeasurementBatch, patience: Duration) -> Result<Ingested, Error> {
        let place = tokio::time::timeout(patience, self.compute.wait()).await.map_err(|_| QueueFull)?;
        self.ingest_with(batch, place).await
    }

    async fn ingest_with(&self, batch: MeasurementBatch, place: compute::Place) -> Result<Ingested, Error> {
        let (monitor, structure) = (self.clone(), batch.structure.clone());
        let task = tokio::spawn(async move { monitor.ingest_here(batch, place).await }.in_current_span());
        task.await.unwrap_or_else(|_| {
            // It may have been stored before.
            self.resume_until_done(structure);
            Err(Error::Panicked)
        })
    }

    async fn ingest_here(&self, batch: MeasurementBatch, place: compute::Place) -> Result<Ingested, Error> {
        let structure = batch.structure.clone();
        let watched = self.structure(&structure)?;
        let (batch_id, received_at) = (uuid::Uuid::now_v7().to_string(), Timestamp::now());
        let (foreseen, outcome) = oneshot::channel();
        let insert = self.store.insert_batch_foreseen(&batch, &batch_id, received_at, foreseen);
        let record = |batch: MeasurementBatch, content_digest: Digest| BatchRecord {
            batch_id: batch_id.clone(),
            batch,
            content_digest,
            received_at,
            state: BatchState::Received,
            failure: None,
        };
        // While it is on its way to the disk. Nothing of it is stored or told before the batch is there.
        let compute = async {
            match outcome.await {
                Ok(InsertBatch::Inserted { content_digest, previous }) if watched.baseline.is_ok() => {
                    let task = Task::new(Arc::clone(&watched), record(batch.clone(), content_digest), previous, place)?;
                    Ok(Begun::Computed(Box::new(self.compute(task).await?)))
                }
                _ => Ok(Begun::Not(place)),
            }
        };
        let (inserted, begun) = tokio::join!(insert, compute);
        match inserted? {
            InsertBatch::Inserted { content_digest, .. } => {
                metrics::counter!("modalwatch_batches_received_total").increment(1);
                metrics::counter!("modalwatch_measurements_received_total").increment(batch.measurements.len() as u64);
                // What was stored, without reading all of it back.
                let record = record(batch, content_digest);
                let stands = match begun {
                    Ok(Begun::Computed(computed)) => self.finish_computed(*computed).await,
                    Ok(Begun::Not(_)) => {
                        self.tell_batch(&structure, &batch_id, record.state);
                        return Ok(Ingested { view: self.view(record).await?, replayed: false });
                    }
                    Err(failure) => Err(failure),
                };
                let view = match self.or_resumed(&structure, stands)? {
                    Some((assessment, charts)) => {
                        let record = BatchRecord { state: BatchState::Assessed, ..record };
                        self.view_of(record, Some(assessment), charts).await?
                    }
                    None => self.batch(&structure, &batch_id).await?,
                };
                Ok(Ingested { view, replayed: false })
            }
            InsertBatch::Replayed(id) => {
                let record = self.stored(&structure, &id).await?;
                if let (BatchState::Received, true, Ok(Begun::Not(place))) =
                    (record.state, watched.baseline.is_ok(), begun)
                {
                    let stands = async { self.finish(self.task(watched, record, place).await?).await }.await;
                    self.or_resumed(&structure, stands)?;
                    return Ok(Ingested { view: self.batch(&structure, &id).await?, replayed: true });
                }
                Ok(Ingested { view: self.view(record).await?, replayed: true })
            }
            InsertBatch::KeyConflict { batch_id } => Err(Error::KeyConflict { batch: batch_id }),
            InsertBatch::MeasurementConflict { ordinal, measured_at, batch_id } => {
                Err(Error::MeasurementConflict { ordinal, measured_at, batch: batch_id })
            }
        }
    }

    /// The result of a stored batch. Where there is none, the batch is tried again later: whoever sent it may not send it again.
    fn or_resumed<T>(&self, structure: &StructureId, result: Result<T, Error>) -> Result<T, Error> {
        result.inspect_err(|_| self.resume_until_done(structure.clone()))
    }

    /// One batch with its current assessment.
    ///
    /// # Errors
    /// [`Error::UnknownBatch`], [`Error::UnknownStructure`].
    pub async fn batch(&self, structure: &StructureId, batch_id: &str) -> Result<BatchView, Error> {
        self.view(self.stored(structure, batch_id).await?).await
    }

    /// A batch with what was made of it.
    async fn view(&self, record: BatchRecord) -> Result<BatchView, Error> {
        let (structure, batch_id) = (&record.batch.structure, record.batch_id.as_str());
        let assessment = self.store.assessment(structure, batch_id).await?;
        let charts = self.store.chart_points(structure, batch_id).await?;
        self.view_of(record, assessment, charts).await
    }

    /// A batch with this made of it.
    async fn view_of(
        &self,
        record: BatchRecord,
        assessment: Option<Assessment>,
        charts: Vec<StoredChartPoint>,
    ) -> Result<BatchView, Error> {
        let (structure, batch_id) = (&record.batch.structure, record.batch_id.as_str());
        let watched = self.structure(structure)?;
        let in_use = watched.baseline.as_ref().ok().map(|baseline| baseline.digest());
        let next_step = match (&assessment, &watched.baseline) {
            (None, Err(reason)) => Some(reason.clone()),
            (Some(a), _) if a.undamaged_version.is_none() => {
                Some(self.why_not_compared(structure, batch_id, in_use).await?)
            }
            _ => None,
        };
        Ok(BatchView { record, assessment, charts, next_step })
    }

    async fn why_not_compared(
        &self,
        structure: &StructureId,
        batch_id: &str,
        model_digest: Option<&Digest>,
    ) -> Result<String, Error> {
        Ok(match self.store.undamaged(structure).await? {
            Some(undamaged) if undamaged.batches.iter().any(|id| id == batch_id) => {
                format!("part of the undamaged state, version {}: not compared with itself", undamaged.state.version)
            }
            Some(undamaged) if model_digest.is_some_and(|digest| *digest != undamaged.model_digest) => format!(
                "the undamaged state, version {}, was taken with another trained baseline: name undamaged batches again \
                 by POST /v1/structures/{structure}/baseline",
                undamaged.state.version
            ),
            Some(_) => "not compared with the undamaged state yet".to_owned(),
            None => format!(
                "no undamaged state: name undamaged batches by POST /v1/structures/{structure}/baseline \
                 {{\"batches\": [\"{batch_id}\"]}}"
            ),
        })
    }

    /// Logs alarms that were raised since the last look, each once, and tells of all that changed.
    async fn report_episodes(&self, structure: &StructureId) {
        for episode in self.tell_alarms(structure).await {
            let key = (structure.clone(), episode.number);
            if !self.reported.lock().expect("no holder of this lock panics").insert(key) {
                continue;
            }
            metrics::counter!("modalwatch_alarms_total", "kind" => episode.kind.clone()).increment(1);
            warn!(
                structure.id = %structure, episode = episode.number, kind = %episode.kind, series = %episode.series,
                "Alarm {} of {structure}: {} ({}), since {}", episode.number, episode.kind, episode.series, episode.opened_at
            );
        }
    }

    async fn stored(&self, structure: &StructureId, batch_id: &str) -> Result<BatchRecord, Error> {
        let unknown = || Error::UnknownBatch { structure: structure.clone(), batch: crate::quantity::shown(batch_id) };
        self.store.batch(structure, batch_id).await?.ok_or_else(unknown)
    }
}

fn baseline_of(structure: &StructureId, watched: &Watched) -> Result<Arc<Baseline>, Error> {
    let missing = |reason: &String| Error::NoModel { structure: structure.clone(), reason: reason.clone() };
    watched.baseline.as_ref().map(Arc::clone).map_err(missing)
}
