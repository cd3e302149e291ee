//! Checking the records of an archive, before anything of it is stored.

use std::collections::BTreeMap;

use super::error::{invalid, ImportError};
use crate::baseline::Baseline;
use crate::clock;
use crate::measurement::check::{check_idempotency_key, check_measurements, check_source, FieldPath, RawMeasurement};
use crate::measurement::MeasurementBatch;
use crate::monitor::error::Error;
use crate::quantity::{shown, Digest, StructureId, Timestamp};
use crate::simulator::definition::StructureDefinition;
use crate::simulator::Simulator;
use crate::store::archive::{ArchivedModel, Batch, Checked, CheckedBatch, Record};

/// Longest text that a person wrote, characters. The routes accept shorter ones.
const LONGEST_TEXT: usize = 10_000;

/// How far a time at which something was stored may lie ahead of the clock of this machine, µs.
const AHEAD_US: i64 = 86_400_000_000;

/// Checks records in the order of the archive.
pub(super) struct Checker {
    structure: StructureId,
    now: Timestamp,
    /// The present version, once its record has come.
    present: Option<Simulator>,
    /// Other versions by their digest.
    versions: BTreeMap<String, Simulator>,
}

impl Checker {
    pub(super) fn new(structure: StructureId) -> Self {
        Self { structure, now: clock::now(), present: None, versions: BTreeMap::new() }
    }

    /// The present version of the structure.
    pub(super) fn into_present(self) -> Result<Simulator, ImportError> {
        self.present.ok_or_else(|| invalid(&"the archive has no structure").into())
    }

    /// Checks a record, except for the weights of a trained baseline.
    pub(super) fn check(&mut self, record: Record) -> Result<Checked, ImportError> {
        match &record {
            Record::Archive(_) | Record::End(_) | Record::Model(_) => {}
            Record::Structure(present) => {
                self.stored_at(&present.created_at)?;
                self.present = Some(self.simulator_of(&present.digest, &present.definition)?);
            }
            Record::Version(version) => {
                self.stored_at(&version.created_at)?;
                texts([version.parent_digest.as_deref()])?;
                let simulator = self.simulator_of(&version.digest, &version.definition)?;
                self.versions.insert(version.digest.clone(), simulator);
            }
            Record::Batch(batch) => return Ok(Checked::Batch(Box::new(self.batch(batch)?))),
            Record::UndamagedReference(state) => {
                self.stored_at(&state.created_at)?;
                state.check()?;
                texts(state.texts()?.iter().map(|text| Some(text.as_str())))?;
            }
            Record::Maintenance(window) => {
                window.check()?;
                self.stored_at(&window.created_at)?;
                texts([Some(window.reason.as_str())])?;
            }
            Record::Acknowledgement(note) => {
                note.check()?;
                self.stored_at(&note.at)?;
                texts([Some(note.by.as_str()), note.note.as_deref()])?;
            }
            Record::AlarmAction(action) => {
                action.check()?;
                self.stored_at(&action.at)?;
                texts([Some(action.author.as_str()), action.text.as_deref(), action.assignee.as_deref()])?;
            }
            Record::Note(note) => {
                note.check()?;
                self.stored_at(&note.created_at)?;
                texts([Some(note.text.as_str()), Some(note.author.as_str())])?;
            }
        }
        Ok(Checked::Record(Box::new(record)))
    }

    /// Checks the weights of a trained baseline by its self-test.
    pub(super) fn check_model(&self, model: &ArchivedModel) -> Result<(), ImportError> {
        let version = &model.structure_digest;
        let present = self.present.as_ref().filter(|present| present.digest().as_str() == version);
        let lacking =
            || invalid(&format!("a trained baseline is for version {}, which the archive lacks", shown(version)));
        let simulator = present.or_else(|| self.versions.get(version)).ok_or_else(lacking)?;
        let weights = model.weights().map_err(|e| invalid(&e))?;
        let loaded = Baseline::load(model.manifest.as_bytes(), &weights, simulator).map_err(|e| invalid(&e))?;
        if loaded.digest().as_str() == model.model_digest {
            return Ok(());
        }
        Err(invalid(&"a trained baseline does not match its digest").into())
    }

    /// A time at which something was stored, which cannot be in the future.
    fn stored_at(&self, text: &str) -> Result<Timestamp, Error> {
        let at = Timestamp::parse(text).map_err(|e| invalid(&format!("{}: {e}", shown(text))))?;
        if at.micros() > self.now.micros() + AHEAD_US {
            return Err(invalid(&format!("{at} is in the future: the clock of this machine shows {}", self.now)));
        }
        Ok(at)
    }

    fn simulator_of(&self, digest: &str, definition: &str) -> Result<Simulator, ImportError> {
        let structure = &self.structure;
        let definition = StructureDefinition::parse_json(definition).map_err(Error::from)?;
        let simulator = Simulator::new(definition).map_err(Error::from)?;
        if simulator.id() != structure || simulator.digest().as_str() != digest {
            let detail = format!("the definition of {structure} does not match its digest {}", shown(digest));
            return Err(invalid(&detail).into());
        }
        Ok(simulator)
    }

    /// Checks a batch in the same way as a batch that is sent to the service.
    fn batch(&self, batch: &Batch) -> Result<CheckedBatch, Error> {
        let simulator = self.present.as_ref().ok_or_else(|| invalid(&"a batch comes before the structure"))?;
        if uuid::Uuid::parse_str(&batch.batch).is_err() {
            return Err(invalid(&format!("{} is not a valid batch id", shown(&batch.batch))));
        }
        let named = |problem: crate::measurement::check::Problem| {
            invalid(&format!("batch {}: {}: {}", batch.batch, problem.pointer, problem.message))
        };
        check_source(&batch.source).map_err(named)?;
        batch.idempotency_key.as_deref().map_or(Ok(()), check_idempotency_key).map_err(named)?;
        let raw = |(index, m): (usize, &crate::store::archive::Measurement)| RawMeasurement {
            path: FieldPath::Json { index },
            measured_at: Some(m.measured_at.clone()),
            frequencies_hz: m.frequencies_hz.clone(),
            std_hz: m.std_hz.clone(),
            mode_shapes: m.mode_shapes.clone(),
            covariates: m.covariates.clone(),
            settings: m.settings.clone(),
        };
        let expectation = simulator.expectation(self.now, usize::MAX);
        let raw = batch.measurements.iter().enumerate().map(raw).collect();
        let measurements = check_measurements(raw, &expectation).map_err(|problems| {
            problems.into_iter().next().map_or_else(|| invalid(&format!("batch {}", batch.batch)), named)
        })?;
        let measured = MeasurementBatch {
            structure: simulator.id().clone(),
            source: batch.source.clone(),
            idempotency_key: batch.idempotency_key.clone(),
            posted_by: batch.posted_by.clone(),
            measurements,
        };
        if measured.content_digest() != Digest::from_stored(batch.content_digest.clone()) {
            return Err(invalid(&format!("batch {} does not match its digest", batch.batch)));
        }
        let received_at = self.stored_at(&batch.received_at)?;
        let (id, compared_with) = (batch.batch.clone(), batch.compared_with.clone());
        Ok(CheckedBatch { id, batch: measured, received_at, compared_with })
    }
}

/// Checks the lengths of texts.
fn texts<'t>(texts: impl IntoIterator<Item = Option<&'t str>>) -> Result<(), Error> {
    match texts.into_iter().flatten().find(|text| text.chars().count() > LONGEST_TEXT) {
        Some(text) => Err(invalid(&format!("{} has more than {LONGEST_TEXT} characters", shown(text)))),
        None => Ok(()),
    }
}
