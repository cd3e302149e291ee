//! A structure out of one installation and into another.
//!
//! An import stores what was measured and declared; the assessments are computed anew. They are functions of measurements,
//! baseline, undamaged state and seed, all of which came along, so they are the same to the last bit.

#![expect(clippy::result_large_err, reason = "an import fails once, on a command line")]

use std::fs::File;
use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use serde::Serialize;
use serde_json::json;
use sha2::{Digest as _, Sha256};
use tokio::sync::mpsc::{channel, Receiver};

use super::{Error, Monitor};
use crate::baseline::Baseline;
use crate::measurement::check::{check_measurements, Place, RawMeasurement};
use crate::measurement::MeasurementBatch;
use crate::quantity::{Digest, StructureId, Timestamp};
use crate::simulator::definition::StructureDefinition;
use crate::simulator::Simulator;
use crate::store::archive::{Acknowledged, Batch, End, Head, Model, Record, FORMAT, NOT_CARRIED};

/// Lines on their way between store and reader.
const BUFFERED: usize = 64;

/// Batches stored in one transaction.
const AT_A_TIME: usize = 100;

/// Most bytes of a line: a baseline's weights are the longest.
const LONGEST_LINE: usize = 1 << 30;

/// Why an archive is not taken.
#[derive(Debug, thiserror::Error)]
pub enum ImportError {
    /// The file cannot be read.
    #[error("{path} cannot be read: {source}")]
    File {
        /// The file.
        path: PathBuf,
        /// The cause.
        source: std::io::Error,
    },
    /// A line that is none of an archive.
    #[error("line {line}: {reason}")]
    Line {
        /// From 1.
        line: u64,
        /// What is wrong.
        reason: String,
    },
    /// It breaks off, or was changed.
    #[error("the archive is not whole: {0}; nothing was stored")]
    NotWhole(String),
    /// What it holds does not fit what is here.
    #[error(transparent)]
    Monitor(#[from] Error),
}

impl From<crate::store::Error> for ImportError {
    fn from(error: crate::store::Error) -> Self {
        Self::Monitor(error.into())
    }
}

/// What an import did.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Imported {
    /// The structure.
    pub structure: StructureId,
    /// Versions that were new.
    pub versions: u64,
    /// Trained baselines that were new.
    pub models: u64,
    /// Batches of the archive.
    pub batches: u64,
    /// Those of them that were new.
    pub batches_new: u64,
    /// Undamaged states that were new.
    pub undamaged_states: u64,
    /// Maintenance windows that were new.
    pub maintenance_windows: u64,
    /// Acknowledgements that found their alarm.
    pub acknowledgements: u64,
    /// What a reader should know.
    pub warnings: Vec<String>,
}

impl Monitor {
    /// The archive of a structure, line by line, each with its line end; the last of them is an error when it breaks off.
    ///
    /// # Errors
    /// [`Error::UnknownStructure`], [`Error::Store`].
    pub async fn export(&self, structure: &StructureId) -> Result<Receiver<Result<Vec<u8>, Error>>, Error> {
        let watched = self.structure(structure)?;
        let mut models = self.store.trained_models(structure).await?;
        if let Ok(baseline) = &watched.baseline {
            let digest = baseline.digest().clone();
            if !models.iter().any(|model| model.model_digest == digest.as_str()) {
                let library = self.library();
                let wanted = digest.clone();
                let files = tokio::task::spawn_blocking(move || library.files_of(&wanted)).await;
                if let Some(files) = files.map_err(|_| Error::Panicked)?.ok().flatten() {
                    let version = baseline.manifest().structure_digest.to_string();
                    let accepted = !baseline.manifest().calibration.failures.is_empty();
                    models.push(Model::new(&version, digest.as_str(), &files.manifest, &files.weights, accepted));
                }
            }
        }
        let head = Record::Archive(Head {
            format: FORMAT,
            structure: structure.clone(),
            exported_at: Timestamp::now().to_string(),
            program_version: env!("CARGO_PKG_VERSION").to_owned(),
            settings: self.settings_of_answers(),
            not_carried: NOT_CARRIED.to_owned(),
        });
        let (records, mut taken) = channel(BUFFERED);
        let (lines, receiver) = channel(BUFFERED);
        let (store, id) = (self.store.clone(), structure.clone());
        tokio::spawn(async move {
            let sender = records.clone();
            let read = tokio::spawn(async move {
                // A receiver that is gone is noticed by the other task.
                let _ = sender.send(head).await;
                store.export(&id, models, &sender).await
            });
            drop(records);
            let (mut hasher, mut count) = (Sha256::new(), 0_u64);
            while let Some(record) = taken.recv().await {
                let line = line_of(&record);
                hasher.update(&line);
                count += 1;
                if lines.send(Ok(line)).await.is_err() {
                    return;
                }
            }
            let last = match read.await {
                Ok(Ok(())) => Ok(line_of(&Record::End(End { lines: count, sha256: hex(&hasher.finalize()) }))),
                Ok(Err(error)) => Err(Error::Store(error)),
                Err(_) => Err(Error::Panicked),
            };
            let _ = lines.send(last).await;
        });
        Ok(receiver)
    }

    /// Settings that change what is answered for the same measurements.
    fn settings_of_answers(&self) -> serde_json::Value {
        let s = &self.settings;
        json!({
            "draws_per_measurement": s.draws_per_measurement, "draws_for_population": s.draws_for_population, "alarm": s.alarm,
        })
    }

    /// Takes an archive: stores what is new, assesses what waits, and notes the acknowledgements. Taking it again changes
    /// nothing, so an import that was interrupted is finished by repeating it.
    ///
    /// # Errors
    /// [`ImportError`]; a file that is not whole is refused before anything is stored.
    pub async fn import(&self, path: &Path) -> Result<Imported, ImportError> {
        let file = path.to_owned();
        let checked = tokio::task::spawn_blocking(move || check_whole(&file)).await;
        let head = checked.map_err(|_| Error::Panicked)??;
        let mut import = Import {
            monitor: self,
            acknowledgements: Vec::new(),
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
                warnings: Vec::new(),
            },
        };
        if head.settings != self.settings_of_answers() {
            let warning = format!(
                "the archive was written under other settings ({}) than are in force here: answers may differ",
                head.settings
            );
            import.done.warnings.push(warning);
        }
        // Lines come from a thread of their own, so that neither a large file fills the memory nor its reading holds up others.
        let (sender, mut lines) = channel(BUFFERED);
        let file = path.to_owned();
        let reader = tokio::task::spawn_blocking(move || {
            each_line(&file, |number, record| sender.blocking_send((number, record)).map_err(|_| stopped(number)))
        });
        while let Some((number, record)) = lines.recv().await {
            import.take(record).await.map_err(|error| match error {
                ImportError::Monitor(Error::Store(crate::store::Error::Row { what, detail })) => {
                    ImportError::Line { line: number, reason: format!("{what}: {detail}") }
                }
                other => other,
            })?;
        }
        reader.await.map_err(|_| Error::Panicked)??;
        import.finish().await
    }
}

/// The reader of the lines has stopped.
fn stopped(line: u64) -> ImportError {
    ImportError::Line { line, reason: "the import was stopped".to_owned() }
}

/// An import under way.
struct Import<'a> {
    monitor: &'a Monitor,
    simulator: Option<Simulator>,
    waiting: Vec<(String, MeasurementBatch, Timestamp)>,
    acknowledgements: Vec<Acknowledged>,
    done: Imported,
}

impl Import<'_> {
    async fn take(&mut self, record: Record) -> Result<(), ImportError> {
        if !matches!(record, Record::Batch(_)) {
            self.store_waiting().await?;
        }
        let (store, structure) = (&self.monitor.store, self.done.structure.clone());
        match record {
            Record::Archive(_) | Record::End(_) => {}
            Record::Structure(present) => {
                let simulator = simulator_of(&structure, &present.digest, &present.definition)?;
                self.monitor.put_structure(simulator.definition().clone()).await?;
                self.simulator = Some(simulator);
            }
            Record::Version(version) => {
                simulator_of(&structure, &version.digest, &version.definition)?;
                self.done.versions += u64::from(store.import_version(&structure, version).await?);
            }
            Record::Model(model) => self.take_model(model).await?,
            Record::Batch(batch) => {
                let simulator = self.simulator.as_ref().ok_or_else(|| wrong(&"a batch comes before the structure"))?;
                let (measured, received_at) = checked_batch(&batch, simulator)?;
                self.done.batches += 1;
                self.waiting.push((batch.batch, measured, received_at));
                if self.waiting.len() >= AT_A_TIME {
                    self.store_waiting().await?;
                }
            }
            Record::UndamagedState(state) => {
                self.done.undamaged_states += u64::from(store.import_undamaged(&structure, state).await?);
            }
            Record::Maintenance(window) => {
                self.done.maintenance_windows += u64::from(store.import_maintenance(&structure, window).await?);
            }
            Record::Acknowledgement(note) => self.acknowledgements.push(note),
        }
        Ok(())
    }

    async fn store_waiting(&mut self) -> Result<(), ImportError> {
        if !self.waiting.is_empty() {
            let waiting = std::mem::take(&mut self.waiting);
            self.done.batches_new += self.monitor.store.import_batches(waiting).await?;
        }
        Ok(())
    }

    /// Takes a baseline that is not here already, after its self-test.
    async fn take_model(&mut self, model: Model) -> Result<(), ImportError> {
        let structure = self.done.structure.clone();
        let library = self.monitor.library();
        let here = library.get(&structure).and_then(|entry| entry.baseline.as_ref());
        if here.is_some_and(|baseline| baseline.digest().as_str() == model.model_digest) {
            return Ok(());
        }
        let version = Digest::from_stored(model.structure_digest.clone());
        let stored = self.monitor.store.structure_version(&structure, &version).await?;
        let simulator = match (&self.simulator, stored) {
            (Some(present), _) if *present.digest() == version => present.clone(),
            (_, Some((definition, _))) => simulator_of(&structure, version.as_str(), &definition)?,
            _ => {
                return Err(
                    wrong(&format!("a trained baseline is for version {version}, which the archive lacks")).into()
                )
            }
        };
        let weights = model.weights().map_err(|e| wrong(&e))?;
        let manifest = model.manifest.clone().into_bytes();
        let loaded = tokio::task::spawn_blocking(move || Baseline::load(&manifest, &weights, &simulator)).await;
        let loaded = loaded.map_err(|_| Error::Panicked)?.map_err(|e| wrong(&e))?;
        if loaded.digest().as_str() != model.model_digest {
            return Err(wrong(&"a trained baseline is not what its digest says").into());
        }
        self.done.models += u64::from(self.monitor.store.import_model(&structure, model).await?);
        Ok(())
    }

    /// Assesses what waits, under the baseline that came along, and notes who has seen the alarms that this raises.
    async fn finish(mut self) -> Result<Imported, ImportError> {
        self.store_waiting().await?;
        let structure = self.done.structure.clone();
        let simulator = self.simulator.ok_or_else(|| wrong(&"the archive has no structure"))?;
        let baseline = self.monitor.baseline_for(&simulator).await?;
        if let Err(reason) = &baseline {
            self.done.warnings.push(format!("batches wait for their assessment: {reason}"));
        }
        let in_use = baseline.as_ref().ok().map(|baseline: &Arc<Baseline>| baseline.digest().clone());
        self.monitor.watch(simulator, baseline);
        if let Some(state) = self.monitor.store.undamaged(&structure).await? {
            if in_use.as_ref().is_some_and(|digest| *digest != state.model_digest) {
                self.done.warnings.push(format!(
                    "the undamaged state {} was taken with baseline {}, which is not in use here: batches are compared with none",
                    state.state.version, state.model_digest
                ));
            }
        }
        self.monitor.resume_structure(&structure).await?;
        let noted = std::mem::take(&mut self.acknowledgements);
        for note in noted {
            self.done.acknowledgements += u64::from(self.monitor.store.import_acknowledgement(&structure, note).await?);
        }
        Ok(self.done)
    }
}

fn wrong(detail: &dyn std::fmt::Display) -> Error {
    Error::Store(crate::store::Error::Row { what: "record of the archive", detail: detail.to_string() })
}

fn simulator_of(structure: &StructureId, digest: &str, definition: &str) -> Result<Simulator, ImportError> {
    let definition = StructureDefinition::parse_json(definition).map_err(Error::from)?;
    let simulator = Simulator::new(definition).map_err(Error::from)?;
    if simulator.id() != structure || simulator.digest().as_str() != digest {
        return Err(wrong(&format!("the definition of {structure} is not what its digest {digest} says")).into());
    }
    Ok(simulator)
}

/// A batch after the same checks as one that is posted.
fn checked_batch(batch: &Batch, simulator: &Simulator) -> Result<(MeasurementBatch, Timestamp), Error> {
    let raw = |(index, m): (usize, &crate::store::archive::Measurement)| RawMeasurement {
        place: Place::Json { index },
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
        wrong(&format!("batch {}: {first}", batch.batch))
    })?;
    if uuid::Uuid::parse_str(&batch.batch).is_err() {
        return Err(wrong(&format!("{} is no id of a batch", crate::quantity::shown(&batch.batch))));
    }
    let measured = MeasurementBatch {
        structure: simulator.id().clone(),
        source: batch.source.clone(),
        idempotency_key: batch.idempotency_key.clone(),
        measurements,
    };
    if measured.content_digest().as_str() != batch.content_digest {
        return Err(wrong(&format!("batch {} is not what its digest says", batch.batch)));
    }
    let received_at = Timestamp::parse(&batch.received_at).map_err(|e| wrong(&e))?;
    Ok((measured, received_at))
}

fn line_of(record: &Record) -> Vec<u8> {
    let mut line = serde_json::to_vec(record).expect("a record is plain data");
    line.push(b'\n');
    line
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect::<Vec<_>>().concat()
}

/// Reads an archive to its end and gives back its head: first line, last line, number of lines, SHA-256, each line a record.
fn check_whole(path: &Path) -> Result<Head, ImportError> {
    let not_whole = |what: &str| ImportError::NotWhole(what.to_owned());
    let mut head = None;
    let mut ended = false;
    each_line(path, |number, record| {
        if ended {
            return Err(not_whole("something follows its last line"));
        }
        match (number, record) {
            (1, Record::Archive(found)) if found.format == FORMAT => head = Some(found),
            (1, Record::Archive(found)) => {
                let reason = format!("it has format {}, this program reads {FORMAT}", found.format);
                return Err(ImportError::Line { line: 1, reason });
            }
            (1, _) => return Err(not_whole("its first line is missing")),
            (_, Record::End(_)) => ended = true,
            _ => {}
        }
        Ok(())
    })?;
    if !ended {
        return Err(not_whole("its last line is missing"));
    }
    head.ok_or_else(|| not_whole("it is empty"))
}

/// Gives each record of an archive to `take`; the last is checked against all before it.
fn each_line(path: &Path, mut take: impl FnMut(u64, Record) -> Result<(), ImportError>) -> Result<(), ImportError> {
    let failed = |source| ImportError::File { path: path.to_owned(), source };
    let mut reader = BufReader::new(File::open(path).map_err(failed)?);
    let (mut hasher, mut line, mut number) = (Sha256::new(), Vec::new(), 0_u64);
    loop {
        line.clear();
        let read =
            std::io::Read::take(&mut reader, LONGEST_LINE as u64).read_until(b'\n', &mut line).map_err(failed)?;
        if read == 0 {
            return Ok(());
        }
        number += 1;
        let record: Record = serde_json::from_slice(&line)
            .map_err(|e| ImportError::Line { line: number, reason: format!("no record of an archive: {e}") })?;
        if let Record::End(end) = &record {
            let found = hex(&hasher.finalize_reset());
            if end.lines != number - 1 || end.sha256 != found {
                let said = format!(
                    "it has {} lines with SHA-256 {found}, its last line says {} and {}",
                    number - 1,
                    end.lines,
                    end.sha256
                );
                return Err(ImportError::NotWhole(said));
            }
        }
        hasher.update(&line);
        take(number, record)?;
    }
}
