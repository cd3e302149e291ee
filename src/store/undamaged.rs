//! Undamaged states: versions that never change.

use std::sync::Arc;

use sqlx::FromRow;

use super::assessment::CURRENT_FIRST;
use super::{bad_row, from_blob, timestamp, to_blob, Error, Store};
use crate::damage::{ChartReference, UndamagedQuantity, UndamagedState};
use crate::quantity::{Digest, StructureId, Timestamp};

/// A stored undamaged state.
#[derive(Debug, Clone, PartialEq)]
pub struct UndamagedRecord {
    /// The state.
    pub state: UndamagedState,
    /// Digest of the trained baseline whose samples it was taken from.
    pub model_digest: Digest,
    /// When it was declared.
    pub created_at: Timestamp,
    /// Its batches.
    pub batches: Vec<String>,
}

impl Store {
    /// Stores an undamaged state under the next version, which is returned.
    ///
    /// In the same transaction, batches outside it that were compared with none, or came after it, go back to be assessed.
    ///
    /// # Errors
    /// [`Error::UnknownBatch`], [`Error::Sqlite`].
    pub async fn insert_undamaged(
        &self,
        structure: &StructureId,
        state: &UndamagedState,
        model_digest: &Digest,
        batch_ids: &[String],
        now: Timestamp,
    ) -> Result<u32, Error> {
        let (id, state) = (structure, state.clone());
        let structure = structure.to_string();
        let (digest, batches) = (model_digest.to_string(), batch_ids.to_vec());
        let written = self.write(move |connection| {
            Box::pin(async move {
                let (version,): (u32,) =
                    sqlx::query_as("select coalesce(max(version), 0) + 1 from undamaged_state where structure_id = ?")
                        .bind(&structure)
                        .fetch_one(&mut *connection)
                        .await?;
                let json = |value: Result<String, serde_json::Error>| value.map_err(|e| bad_row("undamaged state")(&e));
                sqlx::query("insert into undamaged_state values (?, ?, ?, ?, ?, ?, ?, ?)")
                    .bind(&structure)
                    .bind(version)
                    .bind(&digest)
                    .bind(now.micros())
                    .bind(state.threshold_probability)
                    .bind(state.measurements as i64)
                    .bind(json(serde_json::to_string(&state.conditions))?)
                    .bind(json(serde_json::to_string(&state.doubts))?)
                    .execute(&mut *connection)
                    .await?;
                for batch in &batches {
                    let inserted = sqlx::query(
                        "insert into undamaged_batch
                         select structure_id, ?, batch_id from measurement_batch where structure_id = ? and batch_id = ?",
                    )
                    .bind(version)
                    .bind(&structure)
                    .bind(batch)
                    .execute(&mut *connection)
                    .await?;
                    if inserted.rows_affected() == 0 {
                        return Err(Error::UnknownBatch { structure, batch: batch.clone() });
                    }
                }
                for (position, q) in state.quantities.iter().enumerate() {
                    sqlx::query("insert into undamaged_quantity values (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)")
                        .bind(&structure)
                        .bind(version)
                        .bind(&q.name)
                        .bind(position as i64)
                        .bind(q.mean)
                        .bind(q.std)
                        .bind(q.threshold)
                        .bind(json(serde_json::to_string(q))?)
                        .bind(to_blob(q.mean_draws.iter().copied()))
                        .bind(to_blob(q.std_draws.iter().copied()))
                        .execute(&mut *connection)
                        .await?;
                }
                // Alarms were set against the state before: what they say is asked anew.
                sqlx::query(
                    "update alarm_episode set ended_at_us = ? where structure_id = ? and kind = 'damage' and ended_at_us is null",
                )
                .bind(now.micros())
                .bind(&structure)
                .execute(&mut *connection)
                .await?;
                // Those that were never compared (the current assessment decides: one compared under an earlier baseline
                // says nothing under this one), and all that came after the undamaged batches: the charts begin anew.
                let requeue = format!(
                    "update measurement_batch set state = 'received'
                     where structure_id = ?1 and state = 'assessed'
                       and batch_id not in (select batch_id from undamaged_batch where structure_id = ?1 and version = ?2)
                       and (0 = (select undamaged_version from assessment a
                               where a.structure_id = ?1 and a.batch_id = measurement_batch.batch_id
                               order by {CURRENT_FIRST} limit 1)
                           or measured_from_us > (select max(b.measured_to_us) from measurement_batch b
                               join undamaged_batch u using (structure_id, batch_id)
                               where u.structure_id = ?1 and u.version = ?2))"
                );
                sqlx::query(sqlx::AssertSqlSafe(requeue))
                    .bind(&structure)
                    .bind(version)
                    .execute(&mut *connection)
                    .await?;
                Ok(version)
            })
        });
        let version = written.await?;
        // The next who asks is told of this one.
        self.undamaged.lock().expect("no holder of this lock panics").remove(id);
        Ok(version)
    }

    /// The newest undamaged state of a structure. Read once: a version never changes.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn undamaged(&self, structure: &StructureId) -> Result<Option<Arc<UndamagedRecord>>, Error> {
        fault_point!("store::read", |_| Err(bad_row("undamaged state")(&"a fault")));
        let (newest,): (Option<u32>,) =
            sqlx::query_as("select max(version) from undamaged_state where structure_id = ?")
                .bind(structure.as_str())
                .fetch_one(&self.reader)
                .await?;
        let Some(newest) = newest else { return Ok(None) };
        if let Some(record) = self.known_undamaged(structure).filter(|record| record.state.version == newest) {
            return Ok(Some(record));
        }
        let Some(record) = self.read_undamaged(structure).await?.map(Arc::new) else { return Ok(None) };
        let mut all = self.undamaged.lock().expect("no holder of this lock panics");
        all.insert(structure.clone(), Arc::clone(&record));
        Ok(Some(record))
    }

    /// As [`Self::undamaged`], but a state that was read already is not asked for again. It can be that another was declared since
    /// by a transaction that has not returned: whoever stores what was made of this one is told
    /// ([`super::StoredAssessment::newest_undamaged`]).
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn undamaged_as_read(&self, structure: &StructureId) -> Result<Option<Arc<UndamagedRecord>>, Error> {
        match self.known_undamaged(structure) {
            Some(record) => Ok(Some(record)),
            None => self.undamaged(structure).await,
        }
    }

    fn known_undamaged(&self, structure: &StructureId) -> Option<Arc<UndamagedRecord>> {
        self.undamaged.lock().expect("no holder of this lock panics").get(structure).map(Arc::clone)
    }

    async fn read_undamaged(&self, structure: &StructureId) -> Result<Option<UndamagedRecord>, Error> {
        let row: Option<(u32, String, i64, f64, i64, String, String)> = sqlx::query_as(
            "select version, model_digest, created_at_us, threshold_probability, measurement_count, conditions, doubts
             from undamaged_state where structure_id = ? order by version desc limit 1",
        )
        .bind(structure.as_str())
        .fetch_optional(&self.reader)
        .await?;
        let Some((version, model_digest, created, threshold_probability, measurements, conditions, doubts)) = row
        else {
            return Ok(None);
        };
        let batches: Vec<(String,)> = sqlx::query_as(
            "select batch_id from undamaged_batch where structure_id = ? and version = ? order by batch_id",
        )
        .bind(structure.as_str())
        .bind(version)
        .fetch_all(&self.reader)
        .await?;
        let quantities: Vec<QuantityRow> = sqlx::query_as(
            "select quantity, mean, std, threshold, detail, mean_draws, std_draws from undamaged_quantity
             where structure_id = ? and version = ? order by position",
        )
        .bind(structure.as_str())
        .bind(version)
        .fetch_all(&self.reader)
        .await?;
        let bad = bad_row("undamaged state");
        let quantity = |row| quantity(row, measurements as usize);
        Ok(Some(UndamagedRecord {
            state: UndamagedState {
                version,
                threshold_probability,
                measurements: measurements as usize,
                quantities: quantities.into_iter().map(quantity).collect::<Result<_, _>>()?,
                conditions: serde_json::from_str(&conditions).map_err(|e| bad(&e))?,
                doubts: serde_json::from_str(&doubts).map_err(|e| bad(&e))?,
            },
            model_digest: Digest::from_stored(model_digest),
            created_at: timestamp("undamaged state", created)?,
            batches: batches.into_iter().map(|(id,)| id).collect(),
        }))
    }
}

#[derive(FromRow)]
struct QuantityRow {
    quantity: String,
    mean: f64,
    std: f64,
    threshold: Option<f64>,
    detail: Option<String>,
    mean_draws: Option<Vec<u8>>,
    std_draws: Option<Vec<u8>>,
}

fn quantity(row: QuantityRow, measurements: usize) -> Result<UndamagedQuantity, Error> {
    let what = "undamaged quantity";
    let Some(detail) = row.detail else {
        // From before populations: nothing is known of the uncertainty.
        let reference = ChartReference {
            mean: row.mean,
            std: row.std,
            within: 0.0,
            measurements,
            batches: 1,
            degrees_of_freedom: measurements.saturating_sub(1),
            between_batches_std: 0.0,
        };
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
