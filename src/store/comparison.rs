//! Which undamaged references batches are compared with: the newest one, or those that a batch keeps.
//!
//! A batch keeps the reference that it was compared with: one that is imported is compared with the same references as where it comes
//! from, and one that is assessed again by another trained model is compared with the same reference, computed again by that model.

use super::column::elements;
use super::current::CURRENT_FIRST;
use super::error::Error;
use super::sql::{self, Whole};
use super::transaction::Transaction;
use crate::assessment::{Assessment, BatchState};

/// Marks a batch as waiting if the newest undamaged reference would be compared with it otherwise than its assessment was.
pub(super) async fn wait_for_comparison(
    transaction: &mut Transaction<'_>,
    structure: &str,
    batch_id: &str,
    a: &Assessment,
) -> Result<(), Error> {
    sql::query(
        "update measurement_batch set state = 'received'
         where structure_id = $1 and batch_id = $2
           and $4 <> coalesce((select version from undamaged_state u
               where u.structure_id = $1 and u.model_digest = $3
                 and u.version = (select max(version) from undamaged_state where structure_id = $1)
                 and not exists (select 1 from undamaged_batch b
                     where b.structure_id = $1 and b.version = u.version and b.batch_id = $2)), 0)",
    )
    .bind(structure)
    .bind(batch_id)
    .bind(a.model_digest.as_str())
    .bind(a.undamaged_version.unwrap_or(0))
    .execute(&mut *transaction)
    .await?;
    Ok(())
}

/// Marks batches to be assessed again: those that were never compared with a reference, and all that came after the batches of
/// the new reference, because its charts begin there. The current assessment decides whether a batch was compared, since one
/// with an earlier trained baseline is not comparable. Batches of the list `except` are left as they are.
pub(super) async fn requeue(
    transaction: &mut Transaction<'_>,
    (structure, version): (&str, u32),
    except: &str,
) -> Result<(), Error> {
    let update = format!(
        "update measurement_batch set state = 'received'
         where structure_id = $1 and state = 'assessed'
           and batch_id not in (select batch_id from undamaged_batch where structure_id = $1 and version = $2)
           and (0 = (select undamaged_version from assessment a
                   where a.structure_id = $1 and a.batch_id = measurement_batch.batch_id
                   order by {CURRENT_FIRST} limit 1)
               or measured_from_us > (select max(b.measured_to_us) from measurement_batch b
                   join undamaged_batch u using (structure_id, batch_id)
                   where u.structure_id = $1 and u.version = $2))
           and batch_id not in (select value from {})",
        elements!("$3")
    );
    let update = sql::query(sqlx::AssertSqlSafe(update)).bind(structure).bind(version).bind(except);
    update.execute(&mut *transaction).await?;
    Ok(())
}

/// Batches that keep one version keep another instead, which is the same reference computed again.
pub(super) async fn replace_kept(
    transaction: &mut Transaction<'_>,
    structure: &str,
    (replaced, by): (u32, u32),
) -> Result<(), Error> {
    sql::query("update kept_comparison set undamaged_version = $1 where structure_id = $2 and undamaged_version = $3")
        .bind(by)
        .bind(structure)
        .bind(replaced)
        .execute(&mut *transaction)
        .await?;
    Ok(())
}

/// Waiting batches that keep references are compared with a new one after them, as if they had been assessed before it was made: if they
/// are compared with none before, or came after its batches.
pub(super) async fn keep_newer(transaction: &mut Transaction<'_>, structure: &str, version: u32) -> Result<(), Error> {
    sql::query(
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
    .execute(&mut *transaction)
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
        sql::query(
            "insert into kept_comparison
             select $1, $2, coalesce(max(position) + 1, 0), $3 from kept_comparison where structure_id = $1 and batch_id = $2",
        )
        .bind(structure)
        .bind(batch)
        .bind(version)
        .execute(&mut *transaction)
        .await?;
    }
    if !versions.is_empty() {
        sql::query(
            "update measurement_batch set state = 'received', failure = null where structure_id = $1 and batch_id = $2",
        )
        .bind(structure)
        .bind(batch)
        .execute(&mut *transaction)
        .await?;
    }
    Ok(())
}

/// The references that a batch is compared with when all that is stored of its assessments is computed again: those of its assessments by the
/// trained baseline of the current one, in their order, and those that it keeps. `assessed`: reference and trained baseline of its assessments,
/// the current one first.
pub(super) fn all_comparisons(assessed: Vec<(u32, String)>, kept: Vec<u32>) -> Vec<u32> {
    let model = assessed.first().map(|(_, model)| model.clone());
    let of_model = assessed.into_iter().rev().filter(|(_, of)| Some(of) == model.as_ref());
    let mut all: Vec<u32> = of_model.map(|(version, _)| version).chain(kept).collect();
    let last = all.last().copied();
    // That it was compared with none before is of no interest.
    all.retain(|version| *version > 0);
    if last == Some(0) {
        all.push(0);
    }
    all
}

/// Lets a batch that was assessed, or whose assessment failed, wait for another one, with the same comparisons. Returns false, and lets it be as it
/// is, if it was compared by a trained baseline that is not that of the newest reference: it could not be compared again.
pub(super) async fn assess_again(
    transaction: &mut Transaction<'_>,
    (structure, batch): (&str, &str),
    state: &str,
) -> Result<bool, Error> {
    if state == BatchState::Failed.as_str() {
        let update =
            "update measurement_batch set state = 'received', failure = null where structure_id = $1 and batch_id = $2";
        sql::query(update).bind(structure).bind(batch).execute(&mut *transaction).await?;
        return Ok(true);
    }
    let select = format!(
        "select undamaged_version, model_digest, coalesce(model_digest =
             (select model_digest from undamaged_state u where u.structure_id = $1 order by version desc limit 1), false)
         from assessment where structure_id = $1 and batch_id = $2 order by {CURRENT_FIRST}"
    );
    let found: Vec<(Whole<u32>, String, bool)> =
        sql::query_as(sqlx::AssertSqlSafe(select)).bind(structure).bind(batch).fetch_all(&mut *transaction).await?;
    if found.first().is_some_and(|(version, _, is_comparable)| version.0 > 0 && !is_comparable) {
        return Ok(false);
    }
    let assessed = found.into_iter().map(|(version, model, _)| (version.0, model)).collect();
    let versions = all_comparisons(assessed, Vec::new());
    keep(transaction, (structure, batch), &versions).await?;
    Ok(!versions.is_empty())
}

/// A batch was compared with the first reference that it keeps, of the given version.
pub(super) async fn settle_kept(
    transaction: &mut Transaction<'_>,
    (structure, batch): (&str, &str),
    version: u32,
) -> Result<(), Error> {
    sql::query(
        "delete from kept_comparison where structure_id = $1 and batch_id = $2 and undamaged_version = $3
             and position = (select min(position) from kept_comparison where structure_id = $1 and batch_id = $2)",
    )
    .bind(structure)
    .bind(batch)
    .bind(version)
    .execute(&mut *transaction)
    .await?;
    Ok(())
}
