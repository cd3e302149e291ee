//! Deleting batches that are older than somebody asked to keep; never done unless it was asked for.

use serde::Serialize;

use super::{timestamp, Error, Store};
use crate::quantity::Timestamp;

/// Tables that hold something of a batch, those that refer to others first.
const TABLES: [&str; 5] = ["quantity_assessment", "assessment", "chart_point", "measurement", "measurement_batch"];

/// What may go: measured before a time, worked off, part of no undamaged state, and measured in no alarm.
///
/// The batches of an undamaged state are what every later batch is compared with; those of an alarm are its evidence.
const EXPIRED: &str = "from measurement_batch b
     where b.measured_to_us < ?1 and b.state <> 'received'
       and not exists (select 1 from undamaged_batch u where u.structure_id = b.structure_id and u.batch_id = b.batch_id)
       and not exists (select 1 from alarm_episode e where e.structure_id = b.structure_id and e.kind <> 'silence'
           and (e.opened_batch = b.batch_id or (e.withdrawn = 0 and b.measured_to_us >= e.opened_at_us
               and (e.ended_at_us is null or b.measured_to_us <= e.ended_at_us))))";

/// What would go of one structure.
#[derive(Debug, Clone, PartialEq, Serialize, utoipa::ToSchema)]
pub struct Expired {
    /// The structure.
    pub structure: String,
    /// Batches.
    pub batches: u64,
    /// Measurements in them.
    pub measurements: u64,
    /// Beginning of the oldest.
    pub oldest: Timestamp,
    /// End of the newest.
    pub newest: Timestamp,
}

/// What went.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, utoipa::ToSchema)]
pub struct Deleted {
    /// Batches.
    pub batches: u64,
    /// Measurements in them.
    pub measurements: u64,
}

impl Store {
    /// What would go if everything measured before a time were deleted.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn expired(&self, before: Timestamp) -> Result<Vec<Expired>, Error> {
        let select = format!(
            "select b.structure_id, count(*), sum(b.measurement_count), min(b.measured_from_us), max(b.measured_to_us)
             {EXPIRED} group by b.structure_id order by b.structure_id"
        );
        let rows: Vec<(String, i64, i64, i64, i64)> =
            sqlx::query_as(sqlx::AssertSqlSafe(select)).bind(before.micros()).fetch_all(&self.reader).await?;
        let expired = |(structure, batches, measurements, oldest, newest): (String, i64, i64, i64, i64)| {
            Ok(Expired {
                structure,
                batches: batches.unsigned_abs(),
                measurements: measurements.unsigned_abs(),
                oldest: timestamp("batch", oldest)?,
                newest: timestamp("batch", newest)?,
            })
        };
        rows.into_iter().map(expired).collect()
    }

    /// Deletes at most `most` of the batches that [`Self::expired`] counts, oldest first, in one small transaction; none left
    /// when nothing is returned as deleted. It is done on a full disk too: the pages that it frees are written again.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn delete_expired(&self, before: Timestamp, most: usize) -> Result<Deleted, Error> {
        self.write_without_floor(move |connection| {
            Box::pin(async move {
                let select = format!(
                    "select b.structure_id, b.batch_id, b.measurement_count {EXPIRED} order by b.measured_to_us limit ?2"
                );
                let rows: Vec<(String, String, i64)> = sqlx::query_as(sqlx::AssertSqlSafe(select))
                    .bind(before.micros())
                    .bind(most as i64)
                    .fetch_all(&mut *connection)
                    .await?;
                let mut deleted = Deleted::default();
                for (structure, batch, measurements) in rows {
                    for table in TABLES {
                        let delete = format!("delete from {table} where structure_id = ? and batch_id = ?");
                        sqlx::query(sqlx::AssertSqlSafe(delete))
                            .bind(&structure)
                            .bind(&batch)
                            .execute(&mut *connection)
                            .await?;
                    }
                    deleted.batches += 1;
                    deleted.measurements += measurements.unsigned_abs();
                }
                Ok(deleted)
            })
        })
        .await
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn every_table_that_refers_to_a_batch_is_thought_of() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).await.unwrap();
        let tables: Vec<(String,)> = sqlx::query_as(
            "select distinct t.name from sqlite_schema t join pragma_table_info(t.name) c
             where t.type = 'table' and c.name = 'batch_id' order by t.name",
        )
        .fetch_all(&store.reader)
        .await
        .unwrap();
        // Batches of undamaged states are kept, so nothing of them is deleted.
        let known: Vec<&str> = TABLES.into_iter().chain(["undamaged_batch"]).collect();
        let unknown: Vec<&String> = tables.iter().map(|t| &t.0).filter(|t| !known.contains(&t.as_str())).collect();
        assert!(tables.len() >= known.len() && unknown.is_empty(), "retention leaves rows behind in {unknown:?}");
    }
}
