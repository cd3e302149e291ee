//! Undamaged states: versions that never change.

use super::assessment::CURRENT_FIRST;
use super::{timestamp, Error, Store};
use crate::damage::{UndamagedQuantity, UndamagedState};
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
    /// In the same transaction, batches outside it whose current assessment compares with none go back to be assessed.
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
        let (structure, state) = (structure.to_string(), state.clone());
        let (digest, batches) = (model_digest.to_string(), batch_ids.to_vec());
        self.write(move |connection| {
            Box::pin(async move {
                let (version,): (u32,) =
                    sqlx::query_as("select coalesce(max(version), 0) + 1 from undamaged_state where structure_id = ?")
                        .bind(&structure)
                        .fetch_one(&mut *connection)
                        .await?;
                sqlx::query("insert into undamaged_state values (?, ?, ?, ?, ?, ?)")
                    .bind(&structure)
                    .bind(version)
                    .bind(&digest)
                    .bind(now.micros())
                    .bind(state.threshold_probability)
                    .bind(state.measurements as i64)
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
                    sqlx::query("insert into undamaged_quantity values (?, ?, ?, ?, ?, ?, ?)")
                        .bind(&structure)
                        .bind(version)
                        .bind(&q.name)
                        .bind(position as i64)
                        .bind(q.mean)
                        .bind(q.std)
                        .bind(q.threshold)
                        .execute(&mut *connection)
                        .await?;
                }
                // The current one decides: one compared under an earlier baseline says nothing under this one.
                let requeue = format!(
                    "update measurement_batch set state = 'received'
                     where structure_id = ?1 and state = 'assessed'
                       and batch_id not in (select batch_id from undamaged_batch where structure_id = ?1 and version = ?2)
                       and 0 = (select undamaged_version from assessment a
                           where a.structure_id = ?1 and a.batch_id = measurement_batch.batch_id
                           order by {CURRENT_FIRST} limit 1)"
                );
                sqlx::query(sqlx::AssertSqlSafe(requeue))
                    .bind(&structure)
                    .bind(version)
                    .execute(&mut *connection)
                    .await?;
                Ok(version)
            })
        })
        .await
    }

    /// The newest undamaged state of a structure.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn undamaged(&self, structure: &StructureId) -> Result<Option<UndamagedRecord>, Error> {
        let row: Option<(u32, String, i64, f64, i64)> = sqlx::query_as(
            "select version, model_digest, created_at_us, threshold_probability, measurement_count
             from undamaged_state where structure_id = ? order by version desc limit 1",
        )
        .bind(structure.as_str())
        .fetch_optional(&self.reader)
        .await?;
        let Some((version, model_digest, created, threshold_probability, measurements)) = row else {
            return Ok(None);
        };
        let batches: Vec<(String,)> = sqlx::query_as(
            "select batch_id from undamaged_batch where structure_id = ? and version = ? order by batch_id",
        )
        .bind(structure.as_str())
        .bind(version)
        .fetch_all(&self.reader)
        .await?;
        let quantities: Vec<(String, f64, f64, Option<f64>)> = sqlx::query_as(
            "select quantity, mean, std, threshold from undamaged_quantity
             where structure_id = ? and version = ? order by position",
        )
        .bind(structure.as_str())
        .bind(version)
        .fetch_all(&self.reader)
        .await?;
        let quantity = |(name, mean, std, threshold)| UndamagedQuantity { name, mean, std, threshold };
        Ok(Some(UndamagedRecord {
            state: UndamagedState {
                version,
                threshold_probability,
                measurements: measurements as usize,
                quantities: quantities.into_iter().map(quantity).collect(),
            },
            model_digest: Digest::from_stored(model_digest),
            created_at: timestamp("undamaged state", created)?,
            batches: batches.into_iter().map(|(id,)| id).collect(),
        }))
    }
}
