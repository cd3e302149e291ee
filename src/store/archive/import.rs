//! Storing an archive, in one transaction.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::Arc;

use tokio::sync::mpsc::Receiver;

use super::super::batch::import_batch;
use super::super::column::{bad_row, list};
use super::super::comparison::{keep, requeue};
use super::super::error::Error;
use super::super::note::insert_note;
use super::super::sql::{self, Whole};
use super::super::structure::{put_definition, PutStructure};
use super::super::transaction::Transaction;
use super::export::Archive;
use super::record::{ArchivedModel, Head, Maintenance, Record, Undamaged, Version};
use super::undamaged::import_undamaged;
use crate::access::TokenId;
use crate::clock;
use crate::measurement::MeasurementBatch;
use crate::quantity::{Digest, StructureId, Timestamp};

/// The first format that states what batches were compared with.
const STATES_COMPARISONS: u32 = 3;

/// A batch of an archive whose content was checked.
#[derive(Debug, Clone, PartialEq)]
pub struct CheckedBatch {
    /// Its id.
    pub id: String,
    /// Its measurements.
    pub batch: MeasurementBatch,
    /// When it arrived.
    pub received_at: Timestamp,
    /// The undamaged references that it was compared with.
    pub compared_with: Option<Vec<u32>>,
}

/// A line of an archive whose content was checked.
#[derive(Debug)]
pub enum Checked {
    /// A batch.
    Batch(Box<CheckedBatch>),
    /// Any other record.
    Record(Box<Record>),
}

/// What was stored of an archive.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Stored {
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
    /// Notes that were new.
    pub notes: u64,
}

impl Archive<'_> {
    /// Stores the records of an archive in one transaction: all or nothing. What is stored already is left as it is. The number of the line
    /// that is being stored is written to `line`. A trained baseline `known_model` is not stored.
    ///
    /// # Errors
    /// [`Error::Row`] if a record contradicts what is stored here, or if the last record is missing.
    pub async fn import(
        self,
        structure: &StructureId,
        known_model: Option<Digest>,
        mut records: Receiver<(u64, Checked)>,
        line: Arc<AtomicU64>,
    ) -> Result<Stored, Error> {
        let structure = structure.to_string();
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    let mut import = Import::begin(transaction, structure, known_model).await?;
                    while let Some((number, record)) = records.recv().await {
                        line.store(number, Ordering::Relaxed);
                        if import.take(transaction, record).await? {
                            return import.finish(transaction).await;
                        }
                    }
                    Err(bad_row("archive")(&"its last line is missing"))
                })
            })
            .await
    }
}

/// A batch of the archive: its id, first measurement and arrival in µs, whether it was new, and what it was compared with.
struct Placed {
    id: String,
    measured_from_us: i64,
    received_at_us: i64,
    new: bool,
    compared_with: Option<Vec<u32>>,
}

/// An undamaged reference of the archive.
struct State {
    version: u32,
    model: String,
    created_us: i64,
    batches: BTreeSet<String>,
    new: bool,
}

/// A running import.
struct Import {
    structure: String,
    known_model: Option<Digest>,
    states_comparisons: bool,
    batches: Vec<Placed>,
    states: Vec<State>,
    actions: i64,
    done: Stored,
}

impl Import {
    async fn begin(
        transaction: &mut Transaction<'_>,
        structure: String,
        known_model: Option<Digest>,
    ) -> Result<Self, Error> {
        sql::query("delete from imported_action where structure_id = $1")
            .bind(&structure)
            .execute(&mut *transaction)
            .await?;
        let (batches, states, done) = (Vec::new(), Vec::new(), Stored::default());
        Ok(Self { structure, known_model, states_comparisons: false, batches, states, actions: 0, done })
    }

    /// Stores a record. Returns whether it was the last one.
    async fn take(&mut self, transaction: &mut Transaction<'_>, checked: Checked) -> Result<bool, Error> {
        let record = match checked {
            Checked::Batch(batch) => return self.take_batch(transaction, *batch).await.map(|()| false),
            Checked::Record(record) => *record,
        };
        let structure = &self.structure;
        match record {
            Record::End(_) => return Ok(true),
            Record::Archive(Head { format, .. }) => self.states_comparisons = format >= STATES_COMPARISONS,
            Record::Structure(present) => {
                let now = clock::now().micros();
                let put = put_definition(transaction, structure, (&present.definition, &present.digest), now);
                if put.await? == PutStructure::Refused {
                    let detail = format!("{structure} has batches under another definition here");
                    return Err(bad_row("structure of the archive")(&detail));
                }
            }
            Record::Version(version) => {
                self.done.versions += u64::from(insert_version(transaction, structure, version).await?);
            }
            Record::Model(model) => {
                if self.known_model.as_ref().is_none_or(|known| known.as_str() != model.model_digest) {
                    self.done.models += u64::from(insert_model(transaction, structure, model).await?);
                }
            }
            Record::UndamagedReference(state) => self.take_state(transaction, state).await?,
            Record::Maintenance(window) => {
                self.done.maintenance_windows += u64::from(insert_window(transaction, structure, window).await?);
            }
            Record::Note(note) => {
                let note = note.check()?;
                self.done.notes += u64::from(insert_note(transaction, structure, note).await?);
            }
            action @ (Record::Acknowledgement(_) | Record::AlarmAction(_)) => {
                let text = serde_json::to_string(&action).map_err(|e| bad_row("action of the archive")(&e))?;
                sql::query("insert into imported_action values ($1, $2, $3)")
                    .bind(structure)
                    .bind(self.actions)
                    .bind(text)
                    .execute(&mut *transaction)
                    .await?;
                self.actions += 1;
            }
            Record::Batch(_) => return Err(bad_row("batch of the archive")(&"it was not checked")),
        }
        Ok(false)
    }

    async fn take_batch(&mut self, transaction: &mut Transaction<'_>, batch: CheckedBatch) -> Result<(), Error> {
        let CheckedBatch { id, batch, received_at, compared_with } = batch;
        if batch.posted_by.as_deref().is_some_and(|token| TokenId::parse(token).is_err()) {
            let detail = format!("batch {id}: posted_by is not the id of a token");
            return Err(bad_row("batch of the archive")(&detail));
        }
        let new = import_batch(transaction, &id, &batch, received_at).await?;
        self.done.batches += 1;
        self.done.batches_new += u64::from(new);
        let measured_from_us = batch.time_span().0.micros();
        self.batches.push(Placed { id, measured_from_us, received_at_us: received_at.micros(), new, compared_with });
        Ok(())
    }

    async fn take_state(&mut self, transaction: &mut Transaction<'_>, state: Undamaged) -> Result<(), Error> {
        let new = import_undamaged(transaction, &self.structure, &state).await?;
        self.done.undamaged_states += u64::from(new);
        let created =
            Timestamp::parse(&state.created_at).map_err(|e| bad_row("undamaged reference of the archive")(&e));
        self.states.push(State {
            version: state.version,
            model: state.model_digest,
            created_us: created?.micros(),
            batches: state.batches.into_iter().collect(),
            new,
        });
        Ok(())
    }

    /// Stores what the batches are compared with, after all references are stored.
    async fn finish(self, transaction: &mut Transaction<'_>) -> Result<Stored, Error> {
        let structure = &self.structure;
        let known: BTreeSet<u32> = self.states.iter().map(|state| state.version).collect();
        let rules = if self.states_comparisons { Vec::new() } else { self.rules(transaction).await? };
        for batch in &self.batches {
            let mut versions = match &batch.compared_with {
                Some(versions) => versions.clone(),
                None => compared_by_rule(batch, &rules),
            };
            if let Some(missing) = versions.iter().find(|version| **version > 0 && !known.contains(version)) {
                let detail = format!(
                    "batch {} was compared with undamaged reference {missing}, which the archive does not have",
                    batch.id
                );
                return Err(bad_row("batch of the archive")(&detail));
            }
            if !batch.new {
                // What it was compared with here stays; only later references are new to it.
                let newest = newest_comparison(transaction, (structure, &batch.id)).await?;
                versions.retain(|version| *version > newest);
            }
            keep(transaction, (structure, &batch.id), &versions).await?;
        }
        // Batches that only this installation has are compared with the new references as with ones that are declared.
        let archived = list(&self.batches.iter().map(|batch| &batch.id).collect::<Vec<_>>());
        for state in self.states.iter().filter(|state| state.new) {
            requeue(transaction, (structure, state.version), &archived).await?;
        }
        Ok(self.done)
    }

    /// The references of the trained baseline of the newest one, each with its last measurement in µs.
    async fn rules(&self, transaction: &mut Transaction<'_>) -> Result<Vec<(&State, i64)>, Error> {
        let mut rules = Vec::new();
        let Some(newest) = self.states.iter().max_by_key(|state| state.version) else { return Ok(rules) };
        for state in self.states.iter().filter(|state| state.model == newest.model) {
            let (last,): (i64,) = sql::query_as(
                "select coalesce(max(measured_to_us), 0) from measurement_batch join undamaged_batch using (structure_id, batch_id)
                 where structure_id = $1 and version = $2",
            )
            .bind(&self.structure)
            .bind(state.version)
            .fetch_one(&mut *transaction)
            .await?;
            rules.push((state, last));
        }
        rules.sort_by_key(|(state, _)| state.version);
        Ok(rules)
    }
}

/// What a batch was compared with, for archives that do not state it: the newest reference at its arrival, and then those that were declared
/// later and whose measurements are all before it, or that were the first.
fn compared_by_rule(batch: &Placed, rules: &[(&State, i64)]) -> Vec<u32> {
    let mut versions = Vec::new();
    for (state, last_us) in rules.iter().filter(|(state, _)| !state.batches.contains(&batch.id)) {
        if state.created_us <= batch.received_at_us {
            versions.clear();
            versions.push(state.version);
        } else if versions.is_empty() || batch.measured_from_us > *last_us {
            versions.push(state.version);
        }
    }
    versions
}

/// The newest reference that a batch is or will be compared with here; 0 if there is none.
async fn newest_comparison(transaction: &mut Transaction<'_>, (structure, batch): (&str, &str)) -> Result<u32, Error> {
    let (Whole(newest),): (Whole<u32>,) = sql::query_as(
        "select coalesce(max(undamaged_version), 0) from (
             select undamaged_version from assessment where structure_id = $1 and batch_id = $2
             union all select undamaged_version from kept_comparison where structure_id = $1 and batch_id = $2) compared",
    )
    .bind(structure)
    .bind(batch)
    .fetch_one(&mut *transaction)
    .await?;
    Ok(newest)
}

async fn insert_version(transaction: &mut Transaction<'_>, structure: &str, version: Version) -> Result<bool, Error> {
    let created = Timestamp::parse(&version.created_at).map_err(|e| bad_row("version of the archive")(&e))?;
    let inserted = sql::query("insert into structure_version values ($1, $2, $3, $4, null, $5) on conflict do nothing")
        .bind(structure)
        .bind(&version.digest)
        .bind(&version.definition)
        .bind(&version.parent_digest)
        .bind(created.micros())
        .execute(&mut *transaction)
        .await?;
    Ok(inserted.rows_affected() > 0)
}

async fn insert_model(transaction: &mut Transaction<'_>, structure: &str, model: ArchivedModel) -> Result<bool, Error> {
    let weights = model.weights().map_err(|e| bad_row("model of the archive")(&e))?;
    let inserted =
        sql::query("insert into trained_baseline values ($1, $2, $3, $4, $5, $6, $7) on conflict do nothing")
            .bind(structure)
            .bind(&model.structure_digest)
            .bind(&model.model_digest)
            .bind(model.manifest.into_bytes())
            .bind(weights)
            .bind(model.accepted)
            .bind(clock::now().micros())
            .execute(&mut *transaction)
            .await?;
    Ok(inserted.rows_affected() > 0)
}

async fn insert_window(transaction: &mut Transaction<'_>, structure: &str, window: Maintenance) -> Result<bool, Error> {
    let (from, to, created) = window.check()?;
    let inserted = sql::query("insert into maintenance_window values ($1, $2, $3, $4, $5) on conflict do nothing")
        .bind(structure)
        .bind(from.micros())
        .bind(to.micros())
        .bind(&window.reason)
        .bind(created.micros())
        .execute(&mut *transaction)
        .await?;
    Ok(inserted.rows_affected() > 0)
}

impl Maintenance {
    /// Beginning, end and time of storage, checked.
    ///
    /// # Errors
    /// [`Error::Row`] with what is wrong.
    pub fn check(&self) -> Result<(Timestamp, Timestamp, Timestamp), Error> {
        let bad = bad_row("maintenance window of the archive");
        let time = |text: &str| Timestamp::parse(text).map_err(|e| bad(&e));
        let (from, to, created) = (time(&self.from)?, time(&self.to)?, time(&self.created_at)?);
        if to <= from {
            return Err(bad(&"its end is not after its beginning"));
        }
        Ok((from, to, created))
    }
}
