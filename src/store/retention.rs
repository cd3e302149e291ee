//! Deletion of old batches, which happens only if it is configured or requested.

use serde::Serialize;

use super::column::{elements, list, timestamp};
use super::database::Database;
use super::error::Error;
use super::sql;
use super::transaction::Transaction;
use crate::quantity::{StructureId, Timestamp};

/// Tables with data of batches, in an order that respects foreign keys.
pub(super) const TABLES: [&str; 8] = [
    "quantity_assessment",
    "assessment",
    "chart_point",
    "process_point",
    "kept_comparison",
    "further_key",
    "measurement",
    "measurement_batch",
];

/// Batches that may be deleted: measured before a time, not waiting for an assessment, not part of an undamaged reference, and not
/// measured during an alarm.
///
/// Later batches are compared with those of the undamaged reference, and the batches of an alarm are its evidence.
const EXPIRED: &str = "from measurement_batch b
     where b.measured_to_us < $1 and b.state <> 'received'
       and not exists (select 1 from undamaged_batch u where u.structure_id = b.structure_id and u.batch_id = b.batch_id)
       and not exists (select 1 from alarm_episode e where e.structure_id = b.structure_id and e.kind not in ('silence', 'not_assessed')
           and (e.opened_batch = b.batch_id or (e.withdrawn = 0 and b.measured_to_us >= e.opened_at_us
               and (e.ended_at_us is null or b.measured_to_us <= e.ended_at_us))))";

/// The batches of one structure that would be deleted.
#[derive(Debug, Clone, PartialEq, Serialize, utoipa::ToSchema)]
pub struct Expired {
    /// The structure.
    pub structure: String,
    /// Number of batches.
    pub batches: u64,
    /// Number of their measurements.
    pub measurements: u64,
    /// First measurement of the oldest batch.
    pub oldest: Timestamp,
    /// Last measurement of the newest batch.
    pub newest: Timestamp,
}

/// What was deleted.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, utoipa::ToSchema)]
pub struct Deleted {
    /// Number of batches.
    pub batches: u64,
    /// Number of their measurements.
    pub measurements: u64,
}

/// Deletion of old batches.
#[derive(Clone, Copy)]
pub struct Retention<'s> {
    pub(super) database: &'s Database,
}

impl Retention<'_> {
    /// The batches that would be deleted among those measured before a time, by structure.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn expired(self, before: Timestamp) -> Result<Vec<Expired>, Error> {
        let select = format!(
            "select b.structure_id, count(*), cast(sum(b.measurement_count) as bigint), min(b.measured_from_us), max(b.measured_to_us)
             {EXPIRED} group by b.structure_id order by b.structure_id"
        );
        let rows: Vec<(String, i64, i64, i64, i64)> =
            sql::query_as(sqlx::AssertSqlSafe(select)).bind(before.micros()).fetch_all(&self.database.reader).await?;
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

    /// Deletes at most `most` of the batches of a structure that [`Self::expired`] counts, oldest first, in one small transaction. When it
    /// returns no deleted batches, none are left. It also works on a full disk, because SQLite uses the freed pages again.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn delete_expired(
        self,
        structure: &StructureId,
        before: Timestamp,
        most: usize,
    ) -> Result<Deleted, Error> {
        let structure = structure.to_string();
        self.database.write_without_floor(move |transaction| {
            Box::pin(async move {
                // Read in the order of an index and no further than needed: other writes wait meanwhile. A batch does not begin after its end.
                let select = format!(
                    "select b.batch_id, b.measurement_count {EXPIRED} and b.structure_id = $2 and b.measured_from_us < $1
                     order by b.measured_from_us, b.batch_id limit $3"
                );
                let rows: Vec<(String, i64)> = sql::query_as(sqlx::AssertSqlSafe(select))
                    .bind(before.micros())
                    .bind(&structure)
                    .bind(most as i64)
                    .fetch_all(&mut *transaction)
                    .await?;
                let measurements = rows.iter().map(|(_, measurements)| measurements.unsigned_abs()).sum();
                let batches: Vec<String> = rows.into_iter().map(|(batch, _)| batch).collect();
                delete_batches(transaction, &structure, &batches).await?;
                Ok(Deleted { batches: batches.len() as u64, measurements })
            })
        })
        .await
    }
}

/// Deletes batches of a structure with all that belongs to them.
pub(super) async fn delete_batches(
    transaction: &mut Transaction<'_>,
    structure: &str,
    batches: &[String],
) -> Result<(), Error> {
    if batches.is_empty() {
        return Ok(());
    }
    let batches = list(batches);
    for table in TABLES {
        let delete = format!(
            "delete from {table} where structure_id = $1 and batch_id in (select value from {})",
            elements!("$2")
        );
        sql::query(sqlx::AssertSqlSafe(delete)).bind(structure).bind(&batches).execute(&mut *transaction).await?;
    }
    Ok(())
}

/// Removes a batch over a connection of its own, as retention does between two calls of somebody else.
#[cfg(test)]
pub(crate) async fn remove_beside(database: &std::path::Path, structure: &str, batch: &str) {
    use sqlx::Connection as _;
    let options = sqlx_sqlite::SqliteConnectOptions::new().filename(database);
    let mut connection = sqlx_sqlite::SqliteConnection::connect_with(&options).await.expect("the database opens");
    let mut transaction = connection.begin_with("begin immediate").await.expect("the writer waits");
    for table in TABLES {
        let delete = format!("delete from {table} where structure_id = $1 and batch_id = $2");
        let delete = sqlx::query(sqlx::AssertSqlSafe(delete)).bind(structure).bind(batch);
        delete.execute(&mut *transaction).await.expect("no other table refers to the batch");
    }
    transaction.commit().await.expect("the disk has space");
    connection.close().await.expect("the connection closes");
}

#[cfg(test)]
mod tests {
    use super::super::Store;
    use super::*;

    #[tokio::test]
    async fn every_table_that_refers_to_a_batch_is_covered() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).await.unwrap();
        let tables: Vec<(String,)> = sql::query_as(
            "select distinct t.name from sqlite_schema t join pragma_table_info(t.name) c
             where t.type = 'table' and c.name = 'batch_id' order by t.name",
        )
        .fetch_all(&store.database.reader)
        .await
        .unwrap();
        // The batches of undamaged references are kept.
        let known: Vec<&str> = TABLES.into_iter().chain(["undamaged_batch"]).collect();
        let unknown: Vec<&String> = tables.iter().map(|t| &t.0).filter(|t| !known.contains(&t.as_str())).collect();
        assert!(tables.len() >= known.len() && unknown.is_empty(), "retention leaves rows behind in {unknown:?}");
    }
}
