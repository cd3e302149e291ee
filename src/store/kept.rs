//! Undamaged references that waiting batches are compared with instead of the newest one.
//!
//! A batch keeps the reference that it was compared with: one that is imported is compared with the same references as where it comes
//! from, and one that is assessed again by another trained model is compared with the same reference, computed again by that model.

use super::error::Error;
use super::transaction::Transaction;

/// Batches that keep one version keep another instead, which is the same reference computed again.
pub(super) async fn replace_kept(
    transaction: &mut Transaction<'_>,
    structure: &str,
    (replaced, by): (u32, u32),
) -> Result<(), Error> {
    sqlx::query("update kept_comparison set undamaged_version = $1 where structure_id = $2 and undamaged_version = $3")
        .bind(by)
        .bind(structure)
        .bind(replaced)
        .execute(transaction.connection())
        .await?;
    Ok(())
}

/// Waiting batches that keep references are compared with a new one after them, as if they had been assessed before it was made: if they
/// are compared with none before, or came after its batches.
pub(super) async fn keep_newer(transaction: &mut Transaction<'_>, structure: &str, version: u32) -> Result<(), Error> {
    sqlx::query(
        "insert into kept_comparison
         select k.structure_id, k.batch_id, k.position + 1, $2
         from kept_comparison k join measurement_batch b using (structure_id, batch_id)
         where k.structure_id = $1
           and k.position = (select max(position) from kept_comparison l where l.structure_id = $1 and l.batch_id = k.batch_id)
           and k.batch_id not in (select batch_id from undamaged_batch where structure_id = $1 and version = $2)
           and (k.undamaged_version = 0
               or b.measured_from_us > (select max(m.measured_to_us) from measurement_batch m
                   join undamaged_batch u using (structure_id, batch_id)
                   where u.structure_id = $1 and u.version = $2))",
    )
    .bind(structure)
    .bind(version)
    .execute(transaction.connection())
    .await?;
    Ok(())
}

/// Stores the references that a batch is compared with, in this order, after those that it keeps already, and lets it wait.
pub(super) async fn keep(
    transaction: &mut Transaction<'_>,
    (structure, batch): (&str, &str),
    versions: &[u32],
) -> Result<(), Error> {
    for version in versions {
        sqlx::query(
            "insert into kept_comparison
             select $1, $2, coalesce(max(position) + 1, 0), $3 from kept_comparison where structure_id = $1 and batch_id = $2",
        )
        .bind(structure)
        .bind(batch)
        .bind(version)
        .execute(transaction.connection())
        .await?;
    }
    if !versions.is_empty() {
        sqlx::query(
            "update measurement_batch set state = 'received', failure = null where structure_id = $1 and batch_id = $2",
        )
        .bind(structure)
        .bind(batch)
        .execute(transaction.connection())
        .await?;
    }
    Ok(())
}

/// A batch was compared with the first reference that it keeps, of the given version.
pub(super) async fn settle_kept(
    transaction: &mut Transaction<'_>,
    (structure, batch): (&str, &str),
    version: u32,
) -> Result<(), Error> {
    sqlx::query(
        "delete from kept_comparison where structure_id = $1 and batch_id = $2 and undamaged_version = $3
             and position = (select min(position) from kept_comparison where structure_id = $1 and batch_id = $2)",
    )
    .bind(structure)
    .bind(batch)
    .bind(version)
    .execute(transaction.connection())
    .await?;
    Ok(())
}
