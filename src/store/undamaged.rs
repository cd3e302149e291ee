//! Undamaged references. A stored version never changes.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex};

use serde::Serialize;
use sqlx::FromRow;

use super::batch_state::batch_state;
use super::column::{bad_row, from_blob, timestamp, to_blob};
use super::comparison::{keep_newer, replace_kept, requeue};
use super::current::CURRENT_FIRST;
use super::database::Database;
use super::error::Error;
use super::reference_content::{batches_of, stored_origin, stored_process};
use super::sql::{self, Whole};
use super::transaction::Transaction;
use crate::assessment::BatchState;
use crate::damage::{ChartReference, UndamagedQuantity, UndamagedReference};
use crate::process::reference::ReferenceProcess;
use crate::quantity::{Digest, StructureId, Timestamp};

/// A stored undamaged reference.
#[derive(Debug, Clone, PartialEq)]
pub struct ReferenceRecord {
    /// The reference.
    pub state: UndamagedReference,
    /// Digest of the trained baseline with which it was computed.
    pub model_digest: Digest,
    /// When it was stored.
    pub created_at: Timestamp,
    /// Ids of its batches.
    pub batches: Vec<String>,
}

/// A batch with measurements in a period.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MeasuredBatch {
    /// Its id.
    pub batch_id: String,
    /// Time of its first measurement.
    pub measured_from: Timestamp,
    /// Time of its last measurement.
    pub measured_to: Timestamp,
    /// Its state.
    pub state: BatchState,
    /// Why its assessment failed.
    pub failure: Option<String>,
    /// Whether it was assessed at any time.
    pub assessed: bool,
    /// Reason of a maintenance window in which a part of it was measured.
    pub maintenance: Option<String>,
}

#[derive(FromRow)]
struct MeasuredRow {
    batch_id: String,
    measured_from_us: i64,
    measured_to_us: i64,
    state: String,
    failure: Option<String>,
    assessed: bool,
    maintenance: Option<String>,
}

/// Undamaged references that were read. A stored version never changes.
#[derive(Default)]
pub(super) struct Known {
    /// The newest ones, by structure.
    pub newest: Mutex<BTreeMap<StructureId, Arc<ReferenceRecord>>>,
    /// Earlier versions that batches are compared with.
    pub earlier: Mutex<Vec<(StructureId, Arc<ReferenceRecord>)>>,
}

/// A reference to store.
#[derive(Debug, Clone, PartialEq)]
pub struct NewReference {
    /// The reference.
    pub state: UndamagedReference,
    /// Ids of its batches.
    pub batches: Vec<String>,
    /// The version of which this is the same reference, computed again: batches that keep that one keep this one instead.
    pub replaces: Option<u32>,
}

/// Undamaged references.
#[derive(Clone, Copy)]
pub struct References<'s> {
    pub(super) database: &'s Database,
    pub(super) known: &'s Known,
}

impl References<'_> {
    /// Stores an undamaged reference under the next version, which is returned.
    ///
    /// In the same transaction, batches outside it that were compared with no reference, or came after it, are marked to be
    /// assessed again.
    ///
    /// # Errors
    /// [`Error::UnknownBatch`], [`Error::Sqlite`].
    pub async fn insert_undamaged(
        self,
        structure: &StructureId,
        state: &UndamagedReference,
        model_digest: &Digest,
        batch_ids: &[String],
        now: Timestamp,
    ) -> Result<u32, Error> {
        let new = NewReference { state: state.clone(), batches: batch_ids.to_vec(), replaces: None };
        self.insert_all_undamaged(structure, vec![new], model_digest, now).await
    }

    /// As [`Self::insert_undamaged`], for several references in one transaction. Returns the version of the last one.
    ///
    /// # Errors
    /// As [`Self::insert_undamaged`].
    pub async fn insert_all_undamaged(
        self,
        structure: &StructureId,
        references: Vec<NewReference>,
        model_digest: &Digest,
        now: Timestamp,
    ) -> Result<u32, Error> {
        let (id, digest) = (structure.to_string(), model_digest.clone());
        let written = self.database.write(move |transaction| {
            Box::pin(async move {
                let mut last = 0;
                for new in references {
                    last = insert_reference(transaction, &id, &new, (&digest, now)).await?;
                }
                Ok(last)
            })
        });
        let version = written.await?;
        // The next call of `undamaged_as_read` reads the new reference.
        self.known.newest.lock().expect("no holder of this lock panics").remove(structure);
        Ok(version)
    }

    /// Marks batches outside the newest reference, whose version is given, that are compared with none. Returns whether there are any.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn requeue_uncompared(self, structure: &StructureId, version: u32) -> Result<bool, Error> {
        let uncompared = format!(
            "structure_id = $1 and state = 'assessed'
               and batch_id not in (select batch_id from undamaged_batch where structure_id = $1 and version = $2)
               and 0 = (select undamaged_version from assessment a
                   where a.structure_id = $1 and a.batch_id = measurement_batch.batch_id
                   order by {CURRENT_FIRST} limit 1)"
        );
        let select = format!("select exists (select 1 from measurement_batch where {uncompared})");
        let (any,): (bool,) = sql::query_as(sqlx::AssertSqlSafe(select))
            .bind(structure.as_str())
            .bind(version)
            .fetch_one(&self.database.reader)
            .await?;
        if !any {
            return Ok(false);
        }
        let id = structure.to_string();
        let written = self.database.write(move |transaction| {
            Box::pin(async move {
                let update = format!("update measurement_batch set state = 'received' where {uncompared}");
                let update = sql::query(sqlx::AssertSqlSafe(update)).bind(id).bind(version);
                update.execute(&mut *transaction).await?;
                Ok(())
            })
        });
        written.await.map(|()| true)
    }

    /// The batches with measurements from `from` on and before `to`, by their first measurement.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn batches_in(
        self,
        structure: &StructureId,
        from: Timestamp,
        to: Timestamp,
    ) -> Result<Vec<MeasuredBatch>, Error> {
        let statement = sql::query_as(
            "select batch_id, measured_from_us, measured_to_us, state, failure,
                    exists (select 1 from assessment a where a.structure_id = b.structure_id and a.batch_id = b.batch_id) as assessed,
                    (select reason from maintenance_window w where w.structure_id = b.structure_id
                        and w.from_us <= b.measured_to_us and w.to_us > b.measured_from_us
                        order by w.from_us limit 1) as maintenance
             from measurement_batch b
             where b.structure_id = $1 and b.measured_from_us < $3 and b.measured_to_us >= $2
             order by b.measured_from_us, b.batch_id",
        )
        .bind(structure.as_str())
        .bind(from.micros())
        .bind(to.micros());
        let batch = |row: MeasuredRow| {
            Ok(MeasuredBatch {
                batch_id: row.batch_id,
                measured_from: timestamp("batch", row.measured_from_us)?,
                measured_to: timestamp("batch", row.measured_to_us)?,
                state: batch_state(&row.state)?,
                failure: row.failure,
                assessed: row.assessed,
                maintenance: row.maintenance,
            })
        };
        self.database.damaged.leave_out(statement, &self.database.reader, 1, batch).await
    }

    /// The newest undamaged reference of a structure. Each version is read only once, because it never changes. It is known by the time of its
    /// creation as well: another process may have deleted the structure, and made a first version again.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn undamaged(self, structure: &StructureId) -> Result<Option<Arc<ReferenceRecord>>, Error> {
        fault_point!("store::read", |_| Err(super::error::unreadable()));
        let known = self.known_undamaged(structure);
        let newest: Option<(Whole<u32>, bool)> = sql::query_as(
            "select version, coalesce(created_at_us = $2, false) from undamaged_state where structure_id = $1
             order by version desc limit 1",
        )
        .bind(structure.as_str())
        .bind(known.as_ref().map(|record| record.created_at.micros()))
        .fetch_optional(&self.database.reader)
        .await?;
        let Some((Whole(newest), is_of_known_time)) = newest else { return Ok(None) };
        if let Some(record) = known.filter(|record| is_of_known_time && record.state.version == newest) {
            return Ok(Some(record));
        }
        let Some(record) = self.read_undamaged(structure, None).await?.map(Arc::new) else { return Ok(None) };
        let mut all = self.known.newest.lock().expect("no holder of this lock panics");
        all.insert(structure.clone(), Arc::clone(&record));
        Ok(Some(record))
    }

    /// As [`Self::undamaged`], but without checking that a reference that was read earlier is still the newest. A transaction that
    /// has not returned yet may have stored a newer one; storing an assessment reports this in
    /// `StoredAssessment::newest_undamaged`.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn undamaged_as_read(self, structure: &StructureId) -> Result<Option<Arc<ReferenceRecord>>, Error> {
        match self.known_undamaged(structure) {
            Some(record) => Ok(Some(record)),
            None => self.undamaged(structure).await,
        }
    }

    fn known_undamaged(self, structure: &StructureId) -> Option<Arc<ReferenceRecord>> {
        self.known.newest.lock().expect("no holder of this lock panics").get(structure).map(Arc::clone)
    }

    /// The process of a reference, or why there is none; neither for a reference of an earlier version of the program.
    async fn process(
        self,
        structure: &StructureId,
        version: u32,
    ) -> Result<(Option<Arc<ReferenceProcess>>, Option<String>), Error> {
        let row: Option<(Option<String>, Option<String>)> =
            sql::query_as("select process, reason from undamaged_process where structure_id = $1 and version = $2")
                .bind(structure.as_str())
                .bind(version)
                .fetch_optional(&self.database.reader)
                .await?;
        let Some((process, without)) = row else { return Ok((None, None)) };
        Ok((process.map(|text| stored_process(&text)).transpose()?.map(Arc::new), without))
    }

    /// A version of the reference; `None`: the newest.
    pub(super) async fn read_undamaged(
        self,
        structure: &StructureId,
        version: Option<u32>,
    ) -> Result<Option<ReferenceRecord>, Error> {
        let row: Option<StateRow> = sql::query_as(
            "select version, model_digest, created_at_us, threshold_probability, measurement_count, conditions, doubts, joint,
                    origin
             from undamaged_state where structure_id = $1 and ($2 is null or version = $2) order by version desc limit 1",
        )
        .bind(structure.as_str())
        .bind(version)
        .fetch_optional(&self.database.reader)
        .await?;
        let Some(row) = row else { return Ok(None) };
        let Whole(version) = row.0;
        let batches = batches_of(self.database, structure, version).await?;
        let quantities: Vec<ReferenceQuantityRow> = sql::query_as(
            "select quantity, mean, std, threshold, detail, mean_draws, std_draws from undamaged_quantity
             where structure_id = $1 and version = $2 order by position",
        )
        .bind(structure.as_str())
        .bind(version)
        .fetch_all(&self.database.reader)
        .await?;
        let process = self.process(structure, version).await?;
        record(row, batches, quantities, process).map(Some)
    }
}

/// The reference whose rows were read, with its batches and its process. It is not part of the asynchronous function that reads them, which is
/// compiled once for each of its callers.
fn record(
    row: StateRow,
    batches: Vec<String>,
    quantities: Vec<ReferenceQuantityRow>,
    (process, without_process): (Option<Arc<ReferenceProcess>>, Option<String>),
) -> Result<ReferenceRecord, Error> {
    let (Whole(version), model_digest, created, threshold_probability, measurements, conditions, doubts, joint, origin) =
        row;
    let bad = bad_row("undamaged reference");
    let quantity = |row| quantity(row, measurements as usize);
    Ok(ReferenceRecord {
        state: UndamagedReference {
            version,
            threshold_probability,
            measurements: measurements as usize,
            quantities: quantities.into_iter().map(quantity).collect::<Result<_, _>>()?,
            conditions: serde_json::from_str(&conditions).map_err(|e| bad(&e))?,
            doubts: serde_json::from_str(&doubts).map_err(|e| bad(&e))?,
            process,
            without_process,
            joint: joint.map(|joint| serde_json::from_str(&joint)).transpose().map_err(|e| bad(&e))?,
            origin: stored_origin(origin.as_deref())?,
        },
        model_digest: Digest::from_stored(model_digest),
        created_at: timestamp("undamaged reference", created)?,
        batches,
    })
}

/// Stores a reference under the next version, which is returned, and marks batches to be assessed again.
async fn insert_reference(
    transaction: &mut Transaction<'_>,
    id: &str,
    NewReference { state, batches, replaces }: &NewReference,
    (digest, now): (&Digest, Timestamp),
) -> Result<u32, Error> {
    let (Whole(version),): (Whole<u32>,) =
        sql::query_as("select coalesce(max(version), 0) + 1 from undamaged_state where structure_id = $1")
            .bind(id)
            .fetch_one(&mut *transaction)
            .await?;
    insert_state(transaction, (id, version), state, digest, now).await?;
    insert_batches(transaction, (id, version), batches).await?;
    insert_quantities(transaction, (id, version), &state.quantities).await?;
    insert_process(transaction, (id, version), state).await?;
    // The open alarms refer to the earlier reference: the new charts raise them again where they persist.
    sql::query(
        "update alarm_episode set ended_at_us = $1 where structure_id = $2 and kind = 'damage' and ended_at_us is null",
    )
    .bind(now.micros())
    .bind(id)
    .execute(&mut *transaction)
    .await?;
    match replaces {
        Some(replaced) => replace_kept(transaction, id, (*replaced, version)).await?,
        None => keep_newer(transaction, id, version).await?,
    }
    requeue(transaction, (id, version), "[]").await?;
    Ok(version)
}

/// Stores the process of a reference, or why there is none.
async fn insert_process(
    transaction: &mut Transaction<'_>,
    (structure, version): Key<'_>,
    state: &UndamagedReference,
) -> Result<(), Error> {
    sql::query("insert into undamaged_process values ($1, $2, $3, $4)")
        .bind(structure)
        .bind(version)
        .bind(state.process.as_deref().map(to_json).transpose()?)
        .bind(&state.without_process)
        .execute(&mut *transaction)
        .await?;
    Ok(())
}

/// Version, model digest, time, threshold probability, number of measurements, conditions, doubts, joint probability, origin.
type StateRow = (Whole<u32>, String, i64, f64, i64, String, String, Option<String>, Option<String>);

/// Structure and version of a reference.
type Key<'k> = (&'k str, u32);

fn to_json<T: Serialize>(value: &T) -> Result<String, Error> {
    serde_json::to_string(value).map_err(|e| bad_row("undamaged reference")(&e))
}

async fn insert_state(
    transaction: &mut Transaction<'_>,
    (structure, version): Key<'_>,
    state: &UndamagedReference,
    model_digest: &Digest,
    now: Timestamp,
) -> Result<(), Error> {
    sql::query("insert into undamaged_state values ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10)")
        .bind(structure)
        .bind(version)
        .bind(model_digest.as_str())
        .bind(now.micros())
        .bind(state.threshold_probability)
        .bind(state.measurements as i64)
        .bind(to_json(&state.conditions)?)
        .bind(to_json(&state.doubts)?)
        .bind(state.joint.as_ref().map(to_json).transpose()?)
        .bind(to_json(&state.origin)?)
        .execute(&mut *transaction)
        .await?;
    Ok(())
}

pub(super) async fn insert_batches(
    transaction: &mut Transaction<'_>,
    (structure, version): Key<'_>,
    batches: &[String],
) -> Result<(), Error> {
    for batch in batches {
        let inserted = sql::query(
            "insert into undamaged_batch
             select structure_id, $1, batch_id from measurement_batch where structure_id = $2 and batch_id = $3",
        )
        .bind(version)
        .bind(structure)
        .bind(batch)
        .execute(&mut *transaction)
        .await?;
        if inserted.rows_affected() == 0 {
            return Err(Error::UnknownBatch { structure: structure.to_owned(), batch: batch.clone() });
        }
    }
    Ok(())
}

async fn insert_quantities(
    transaction: &mut Transaction<'_>,
    (structure, version): Key<'_>,
    quantities: &[UndamagedQuantity],
) -> Result<(), Error> {
    for (position, q) in quantities.iter().enumerate() {
        sql::query("insert into undamaged_quantity values ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10)")
            .bind(structure)
            .bind(version)
            .bind(&q.name)
            .bind(position as i64)
            .bind(q.mean)
            .bind(q.std)
            .bind(q.threshold)
            .bind(to_json(q)?)
            .bind(to_blob(q.mean_draws.iter().copied()))
            .bind(to_blob(q.std_draws.iter().copied()))
            .execute(&mut *transaction)
            .await?;
    }
    Ok(())
}

#[derive(FromRow)]
pub(super) struct ReferenceQuantityRow {
    pub quantity: String,
    pub mean: f64,
    pub std: f64,
    pub threshold: Option<f64>,
    pub detail: Option<String>,
    pub mean_draws: Option<Vec<u8>>,
    pub std_draws: Option<Vec<u8>>,
}

/// A quantity of a reference from its stored row.
pub(super) fn quantity(row: ReferenceQuantityRow, measurements: usize) -> Result<UndamagedQuantity, Error> {
    let what = "undamaged quantity";
    let Some(detail) = row.detail else {
        // References of versions without the population model have no uncertainty.
        let reference = ChartReference::of_one_batch(row.mean, row.std, 0.0, measurements);
        return Ok(UndamagedQuantity {
            name: row.quantity,
            mean: row.mean,
            std: row.std,
            threshold: row.threshold,
            threshold_interval: None,
            pooled_threshold: row.threshold,
            reference,
            mean_draws: vec![row.mean],
            std_draws: vec![row.std],
        });
    };
    let mut quantity: UndamagedQuantity = serde_json::from_str(&detail).map_err(|e| bad_row(what)(&e))?;
    quantity.mean_draws = from_blob(what, &row.mean_draws.unwrap_or_default())?;
    quantity.std_draws = from_blob(what, &row.std_draws.unwrap_or_default())?;
    Ok(quantity)
}
