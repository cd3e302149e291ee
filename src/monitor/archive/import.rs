//! Import of a structure from an archive.

use std::path::Path;
use std::sync::Arc;

use serde::Serialize;
use tokio::sync::mpsc::channel;

use super::error::{invalid, ImportError};
use super::lines::{check_whole, each_line};
use crate::baseline::Baseline;
use crate::measurement::check::{check_measurements, FieldPath, RawMeasurement};
use crate::measurement::MeasurementBatch;
use crate::monitor::assessor::Assessor;
use crate::monitor::error::Error;
use crate::monitor::replay::Replay;
use crate::quantity::{shown, Digest, StructureId, Timestamp};
use crate::simulator::Simulator;
use crate::store::archive::{Acknowledged, ArchivedAction, ArchivedModel, Batch, Record};

/// Lines buffered between the file and the store.
const BUFFERED: usize = 64;

/// Batches stored in one transaction.
const AT_A_TIME: usize = 100;

/// The result of an import.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Imported {
    /// The structure.
    pub structure: StructureId,
    /// Versions that were new.
    pub versions: u64,
    /// Trained baselines that were new.
    pub models: u64,
    /// All batches of the archive.
    pub batches: u64,
    /// Batches of the archive that were not stored before.
    pub batches_new: u64,
    /// Undamaged references that were new.
    pub undamaged_states: u64,
    /// Maintenance windows that were new.
    pub maintenance_windows: u64,
    /// Acknowledgements whose alarm exists and was not acknowledged before.
    pub acknowledgements: u64,
    /// Comments, assignments, closings and reopenings of alarms that were new.
    pub alarm_actions: u64,
    /// Notes that were new.
    pub notes: u64,
    /// Warnings for the user.
    pub warnings: Vec<String>,
}

/// Imports an archive.
pub(super) async fn import(assessor: &Assessor, replay: &Replay, path: &Path) -> Result<Imported, ImportError> {
    let file = path.to_owned();
    let checked = tokio::task::spawn_blocking(move || {
        let mut simulator = None;
        check_whole(&file, |head, record| check_record(&head.structure, record, &mut simulator))
    });
    let checked = checked.await;
    let head = checked.map_err(|_| Error::Panicked)??;
    let mut import = Import {
        assessor,
        replay,
        acknowledgements: Vec::new(),
        actions: Vec::new(),
        waiting: Vec::new(),
        simulator: None,
        done: Imported {
            structure: head.structure.clone(),
            versions: 0,
            models: 0,
            batches: 0,
            batches_new: 0,
            undamaged_states: 0,
            maintenance_windows: 0,
            acknowledgements: 0,
            alarm_actions: 0,
            notes: 0,
            warnings: Vec::new(),
        },
    };
    if head.settings != assessor.settings.of_answers() {
        let warning = format!(
            "the archive was written with settings that differ from those of this service ({}): assessments may differ",
            head.settings
        );
        import.done.warnings.push(warning);
    }
    // A separate thread reads the lines, so that a large file neither fills the memory nor blocks an async thread.
    let (sender, mut lines) = channel(BUFFERED);
    let file = path.to_owned();
    let reader = tokio::task::spawn_blocking(move || {
        each_line(&file, |number, record| sender.blocking_send((number, record)).map_err(|_| stopped(number)))
    });
    while let Some((number, record)) = lines.recv().await {
        import.take(record).await.map_err(|error| error.at_line(number))?;
    }
    reader.await.map_err(|_| Error::Panicked)??;
    import.finish().await
}

/// The error that ends the reading thread when the import has stopped.
fn stopped(line: u64) -> ImportError {
    ImportError::Line { line, reason: "the import was stopped".to_owned() }
}

/// A running import.
struct Import<'a> {
    assessor: &'a Assessor,
    replay: &'a Replay,
    simulator: Option<Simulator>,
    waiting: Vec<(String, MeasurementBatch, Timestamp)>,
    acknowledgements: Vec<Acknowledged>,
    actions: Vec<ArchivedAction>,
    done: Imported,
}

impl Import<'_> {
    async fn take(&mut self, record: Record) -> Result<(), ImportError> {
        if !matches!(record, Record::Batch(_)) {
            self.store_waiting().await?;
        }
        let (store, structure) = (&self.assessor.store, self.done.structure.clone());
        match record {
            Record::Archive(_) | Record::End(_) => {}
            Record::Structure(present) => {
                let simulator = simulator_of(&structure, &present.digest, &present.definition)?;
                self.assessor.structures.put(simulator.clone()).await?;
                self.simulator = Some(simulator);
            }
            Record::Version(version) => {
                simulator_of(&structure, &version.digest, &version.definition)?;
                self.done.versions += u64::from(store.archive().import_version(&structure, version).await?);
            }
            Record::Model(model) => self.take_model(model).await?,
            Record::Batch(batch) => {
                let simulator =
                    self.simulator.as_ref().ok_or_else(|| invalid(&"a batch comes before the structure"))?;
                let (measured, received_at) = checked_batch(&batch, simulator)?;
                self.done.batches += 1;
                self.waiting.push((batch.batch, measured, received_at));
                if self.waiting.len() >= AT_A_TIME {
                    self.store_waiting().await?;
                }
            }
            Record::UndamagedReference(state) => {
                self.done.undamaged_states += u64::from(store.archive().import_undamaged(&structure, state).await?);
            }
            Record::Maintenance(window) => {
                self.done.maintenance_windows +=
                    u64::from(store.archive().import_maintenance(&structure, window).await?);
            }
            Record::Acknowledgement(note) => self.acknowledgements.push(note),
            Record::AlarmAction(action) => self.actions.push(action),
            Record::Note(note) => {
                self.done.notes += u64::from(store.archive().import_note(&structure, note).await?);
            }
        }
        Ok(())
    }

    async fn store_waiting(&mut self) -> Result<(), ImportError> {
        if !self.waiting.is_empty() {
            let waiting = std::mem::take(&mut self.waiting);
            self.done.batches_new += self.assessor.store.archive().import_batches(waiting).await?;
        }
        Ok(())
    }

    /// Stores a trained baseline that is not stored yet, after its self-test.
    async fn take_model(&mut self, model: ArchivedModel) -> Result<(), ImportError> {
        let structure = self.done.structure.clone();
        let library = self.assessor.structures.library();
        let in_library = library.get(&structure).and_then(|entry| entry.baseline.as_ref());
        if in_library.is_some_and(|baseline| baseline.digest().as_str() == model.model_digest) {
            return Ok(());
        }
        let version = Digest::from_stored(model.structure_digest.clone());
        let stored = self.assessor.store.structures().structure_version(&structure, &version).await?;
        let simulator = match (&self.simulator, stored) {
            (Some(present), _) if *present.digest() == version => present.clone(),
            (_, Some((definition, _))) => simulator_of(&structure, version.as_str(), &definition)?,
            _ => {
                return Err(
                    invalid(&format!("a trained model is for version {version}, which the archive lacks")).into()
                )
            }
        };
        let weights = model.weights().map_err(|e| invalid(&e))?;
        let manifest = model.manifest.clone().into_bytes();
        let loaded = tokio::task::spawn_blocking(move || Baseline::load(&manifest, &weights, &simulator)).await;
        let loaded = loaded.map_err(|_| Error::Panicked)?.map_err(|e| invalid(&e))?;
        if loaded.digest().as_str() != model.model_digest {
            return Err(invalid(&"a trained model does not match its digest").into());
        }
        self.done.models +=
            u64::from(self.assessor.store.archive().import_model(&structure, model, Timestamp::now()).await?);
        Ok(())
    }

    /// Assesses the batches with the imported trained baseline, and stores what people did with the alarms that this raises.
    async fn finish(mut self) -> Result<Imported, ImportError> {
        self.store_waiting().await?;
        let structure = self.done.structure.clone();
        let simulator = self.simulator.ok_or_else(|| invalid(&"the archive has no structure"))?;
        let baseline = self.assessor.structures.baseline_for(&simulator).await?;
        if let Err(reason) = &baseline {
            self.done.warnings.push(format!("batches wait for their assessment: {reason}"));
        }
        let in_use = baseline.as_ref().ok().map(|baseline: &Arc<Baseline>| baseline.digest().clone());
        self.assessor.structures.activate(simulator, baseline);
        if let Some(state) = self.assessor.store.reference().undamaged(&structure).await? {
            if in_use.as_ref().is_some_and(|digest| *digest != state.model_digest) {
                self.done.warnings.push(format!(
                    "the undamaged reference {} was made with the trained model {}, which is not in use here: batches are not \
                     compared with it",
                    state.state.version, state.model_digest
                ));
            }
        }
        self.replay.resume(&structure).await?;
        let acknowledgements = std::mem::take(&mut self.acknowledgements);
        for acknowledgement in acknowledgements {
            self.done.acknowledgements +=
                u64::from(self.assessor.store.archive().import_acknowledgement(&structure, acknowledgement).await?);
        }
        let mut lost = 0;
        for action in std::mem::take(&mut self.actions) {
            match self.assessor.store.archive().import_action(&structure, action).await? {
                Some(new) => self.done.alarm_actions += u64::from(new),
                None => lost += 1,
            }
        }
        if lost > 0 {
            let warning =
                format!("{lost} comments and other actions have no alarm here: alarms are computed again on import");
            self.done.warnings.push(warning);
        }
        Ok(self.done)
    }
}

/// Checks the content of one record before anything of the archive is stored; `simulator` is that of the structure, once its record has
/// come.
fn check_record(
    structure: &StructureId,
    record: &Record,
    simulator: &mut Option<Simulator>,
) -> Result<(), ImportError> {
    let time = |text: &str| Timestamp::parse(text).map(drop).map_err(|e| invalid(&format!("{}: {e}", shown(text))));
    match record {
        Record::Archive(_) | Record::End(_) => {}
        Record::Acknowledgement(note) => time(&note.at)?,
        Record::AlarmAction(action) => {
            [Some(&action.at), Some(&action.opened_at), action.ended_at.as_ref()]
                .into_iter()
                .flatten()
                .try_for_each(|text| time(text))?;
        }
        Record::Structure(present) => *simulator = Some(simulator_of(structure, &present.digest, &present.definition)?),
        Record::Version(version) => {
            simulator_of(structure, &version.digest, &version.definition)?;
            time(&version.created_at)?;
        }
        Record::Model(model) => drop(model.weights().map_err(|e| invalid(&e))?),
        Record::Batch(batch) => {
            let simulator = simulator.as_ref().ok_or_else(|| invalid(&"a batch comes before the structure"))?;
            checked_batch(batch, simulator)?;
        }
        Record::UndamagedReference(state) => state.check()?,
        Record::Maintenance(window) => {
            [&window.from, &window.to, &window.created_at].into_iter().try_for_each(|text| time(text))?;
        }
        Record::Note(note) => {
            [Some(&note.from), note.to.as_ref(), Some(&note.created_at)]
                .into_iter()
                .flatten()
                .try_for_each(|text| time(text))?;
        }
    }
    Ok(())
}

fn simulator_of(structure: &StructureId, digest: &str, definition: &str) -> Result<Simulator, ImportError> {
    let simulator = Simulator::parse_json(definition).map_err(Error::from)?;
    if simulator.id() != structure || simulator.digest().as_str() != digest {
        return Err(invalid(&format!("the definition of {structure} does not match its digest {digest}")).into());
    }
    Ok(simulator)
}

/// Checks a batch of the archive in the same way as a batch that is sent to the service.
fn checked_batch(batch: &Batch, simulator: &Simulator) -> Result<(MeasurementBatch, Timestamp), Error> {
    let raw = |(index, m): (usize, &crate::store::archive::Measurement)| RawMeasurement {
        path: FieldPath::Json { index },
        measured_at: Some(m.measured_at.clone()),
        frequencies_hz: m.frequencies_hz.clone(),
        std_hz: m.std_hz.clone(),
        mode_shapes: m.mode_shapes.clone(),
        covariates: m.covariates.clone(),
        settings: m.settings.clone(),
    };
    let expectation = simulator.expectation(Timestamp::now(), usize::MAX);
    let raw = batch.measurements.iter().enumerate().map(raw).collect();
    let measurements = check_measurements(raw, &expectation).map_err(|problems| {
        let first = problems.first().map_or_else(String::new, |p| format!("{}: {}", p.pointer, p.message));
        invalid(&format!("batch {}: {first}", batch.batch))
    })?;
    if uuid::Uuid::parse_str(&batch.batch).is_err() {
        return Err(invalid(&format!("{} is not a valid batch id", crate::quantity::shown(&batch.batch))));
    }
    let measured = MeasurementBatch {
        structure: simulator.id().clone(),
        source: batch.source.clone(),
        idempotency_key: batch.idempotency_key.clone(),
        measurements,
    };
    if measured.content_digest().as_str() != batch.content_digest {
        return Err(invalid(&format!("batch {} does not match its digest", batch.batch)));
    }
    let received_at = Timestamp::parse(&batch.received_at).map_err(|e| invalid(&e))?;
    Ok((measured, received_at))
}
