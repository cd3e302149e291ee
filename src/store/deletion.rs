//! Deleting a structure with all its data, in several transactions, so that batches of others are stored in between.

use super::database::Database;
use super::error::Error;
use super::retention::delete_batches;
use super::sql;
use super::transaction::Transaction;
use super::undamaged::Known;
use crate::quantity::{StructureId, Timestamp};

/// Batches deleted in one transaction.
const AT_A_TIME: i64 = 100;

/// Tables of a structure without data of batches, in an order that respects foreign keys. The audit keeps what was done, and tokens keep
/// the structures to which they are limited.
const OF_STRUCTURE: [&str; 16] = [
    "imported_action",
    "alarm_action",
    "outbox_event",
    "alarm_episode",
    "note",
    "maintenance_window",
    "undamaged_process",
    "undamaged_quantity",
    "undamaged_state",
    "diagnosis",
    "training",
    "trained_baseline",
    "structure_version",
    "structure_summary",
    "structure_deletion",
    "structure",
];

/// What was deleted of a structure.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Removed {
    /// Batches.
    pub batches: u64,
    /// Their measurements.
    pub measurements: u64,
    /// Whether nothing is left.
    pub complete: bool,
}

/// Deletion of structures.
#[derive(Clone, Copy)]
pub struct Deletions<'s> {
    pub(super) database: &'s Database,
    pub(super) known: &'s Known,
}

impl Deletions<'_> {
    /// Marks a structure as being deleted: it takes no more batches. Returns whether there is such a structure.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn begin(self, structure: &StructureId, now: Timestamp) -> Result<bool, Error> {
        let structure = structure.to_string();
        self.database
            .write_without_floor(move |transaction| {
                Box::pin(async move {
                    sql::query(
                        "insert into structure_deletion select structure_id, $2 from structure where structure_id = $1
                         on conflict do nothing",
                    )
                    .bind(&structure)
                    .bind(now.micros())
                    .execute(&mut *transaction)
                    .await?;
                    let (marked,): (bool,) =
                        sql::query_as("select exists (select 1 from structure_deletion where structure_id = $1)")
                            .bind(&structure)
                            .fetch_one(&mut *transaction)
                            .await?;
                    Ok(marked)
                })
            })
            .await
    }

    /// The structures whose deletion was begun and is not complete.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn begun(self) -> Result<Vec<StructureId>, Error> {
        let ids: Vec<(String,)> = sql::query_as("select structure_id from structure_deletion order by structure_id")
            .fetch_all(&self.database.reader)
            .await?;
        let id = |(id,): (String,)| StructureId::parse(&id).map_err(|e| super::column::bad_row("structure")(&e));
        ids.into_iter().map(id).collect()
    }

    /// Deletes the next batches of a structure, or the rest when no batch is left.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn proceed(self, structure: &StructureId) -> Result<Removed, Error> {
        let id = structure.to_string();
        let removed = self
            .database
            .write_without_floor(move |transaction| Box::pin(async move { remove(transaction, &id).await }))
            .await?;
        if removed.complete {
            self.known.newest.lock().expect("no holder of this lock panics").remove(structure);
            self.known.earlier.lock().expect("no holder of this lock panics").retain(|(of, _)| of != structure);
        }
        Ok(removed)
    }
}

async fn remove(transaction: &mut Transaction<'_>, structure: &str) -> Result<Removed, Error> {
    let batches: Vec<(String, i64)> =
        sql::query_as("select batch_id, measurement_count from measurement_batch where structure_id = $1 limit $2")
            .bind(structure)
            .bind(AT_A_TIME)
            .fetch_all(&mut *transaction)
            .await?;
    let mut removed = Removed { complete: batches.is_empty(), ..Removed::default() };
    if !removed.complete {
        // Also those of undamaged references, which retention keeps.
        sql::query("delete from undamaged_batch where structure_id = $1")
            .bind(structure)
            .execute(&mut *transaction)
            .await?;
    }
    removed.batches = batches.len() as u64;
    removed.measurements = batches.iter().map(|(_, measurements)| measurements.unsigned_abs()).sum();
    let batches: Vec<String> = batches.into_iter().map(|(batch, _)| batch).collect();
    delete_batches(transaction, structure, &batches).await?;
    if removed.complete {
        for table in ["webhook_delivery", "mail_delivery"] {
            let delete = format!(
                "delete from {table} where event_id in (select event_id from outbox_event where structure_id = $1)"
            );
            sql::query(sqlx::AssertSqlSafe(delete)).bind(structure).execute(&mut *transaction).await?;
        }
        for table in OF_STRUCTURE {
            let delete = format!("delete from {table} where structure_id = $1");
            sql::query(sqlx::AssertSqlSafe(delete)).bind(structure).execute(&mut *transaction).await?;
        }
    }
    Ok(removed)
}

#[cfg(test)]
mod tests {
    use super::super::retention::TABLES;
    use super::super::Store;
    use super::*;

    #[tokio::test]
    async fn every_table_of_a_structure_is_covered() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).await.unwrap();
        let tables: Vec<(String,)> = sql::query_as(
            "select distinct t.name from sqlite_schema t join pragma_table_info(t.name) c
             where t.type = 'table' and c.name = 'structure_id' order by t.name",
        )
        .fetch_all(&store.database.reader)
        .await
        .unwrap();
        let kept = ["audit_entry", "api_token_structure", "undamaged_batch"];
        let known: Vec<&str> = TABLES.into_iter().chain(OF_STRUCTURE).chain(kept).collect();
        let unknown: Vec<&String> = tables.iter().map(|t| &t.0).filter(|t| !known.contains(&t.as_str())).collect();
        assert!(tables.len() == known.len() && unknown.is_empty(), "a deletion leaves rows behind in {unknown:?}");
    }
}
