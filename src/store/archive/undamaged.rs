//! Undamaged references in an archive.

use std::collections::BTreeMap;

use super::super::column::bad_row;
use super::super::error::Error;
use super::super::reference_content::stored_origin;
use super::super::sql;
use super::super::transaction::Transaction;
use super::super::undamaged::{insert_batches, quantity, stored_process, ReferenceQuantityRow};
use super::record::Undamaged;
use crate::damage::{JointReference, SeenCovariate};
use crate::quantity::{shown, Timestamp};

impl Undamaged {
    /// Checks that the reference can be read once it is stored: every text in it is parsed, and its numbers are finite.
    ///
    /// # Errors
    /// [`Error::Row`] with what cannot be read.
    pub fn check(&self) -> Result<(), Error> {
        let bad = bad_row("undamaged reference of the archive");
        if self.version == 0 || self.measurements <= 0 || self.batches.is_empty() {
            return Err(bad(&"version, measurements and batches must be at least 1"));
        }
        if !(self.threshold_probability > 0.0 && self.threshold_probability <= 0.5) {
            let given = self.threshold_probability;
            return Err(bad(&format!("the threshold probability must be above 0 and at most 0.5, but is {given}")));
        }
        Timestamp::parse(&self.created_at).map_err(|e| bad(&e))?;
        let _: BTreeMap<String, SeenCovariate> = serde_json::from_str(&self.conditions).map_err(|e| bad(&e))?;
        let _: Vec<String> = serde_json::from_str(&self.doubts).map_err(|e| bad(&e))?;
        let _: Option<JointReference> =
            self.joint.as_deref().map(serde_json::from_str).transpose().map_err(|e| bad(&e))?;
        stored_origin(self.origin.as_deref())?;
        self.process.as_deref().map(stored_process).transpose()?;
        for q in &self.quantities {
            let row = ReferenceQuantityRow {
                quantity: q.quantity.clone(),
                mean: q.mean,
                std: q.std,
                threshold: q.threshold,
                detail: q.detail.clone(),
                mean_draws: q.mean_draws.clone(),
                std_draws: q.std_draws.clone(),
            };
            let read = quantity(row, usize::try_from(self.measurements).unwrap_or_default())?;
            let spreads = [q.std, read.std].into_iter().chain(read.std_draws.iter().copied());
            let others = [q.mean, read.mean].into_iter().chain(read.mean_draws.iter().copied()).chain(q.threshold);
            if !spreads.into_iter().all(|spread| spread.is_finite() && spread >= 0.0)
                || !others.into_iter().all(f64::is_finite)
            {
                let what = shown(&q.quantity);
                return Err(bad(&format!("a value of {what} is not finite, or a standard deviation is negative")));
            }
            if read.mean_draws.len() != read.std_draws.len() {
                return Err(bad(&format!("{} has different numbers of draws", shown(&q.quantity))));
            }
        }
        Ok(())
    }
}

/// Stores an undamaged reference under its own version unless it is stored already. Returns whether it was new.
pub(super) async fn import_undamaged(
    transaction: &mut Transaction<'_>,
    structure: &str,
    state: &Undamaged,
) -> Result<bool, Error> {
    let bad = bad_row("undamaged reference of the archive");
    let created = Timestamp::parse(&state.created_at).map_err(|e| bad(&e))?;
    let known: Option<(String, i64)> = sql::query_as(
        "select model_digest, created_at_us from undamaged_state where structure_id = $1 and version = $2",
    )
    .bind(structure)
    .bind(state.version)
    .fetch_optional(&mut *transaction)
    .await?;
    if let Some((model_digest, created_here)) = known {
        if model_digest == state.model_digest && created_here == created.micros() {
            return Ok(false);
        }
        return Err(bad(&format!("{structure} already has a different undamaged reference {} here", state.version)));
    }
    insert_undamaged(transaction, structure, state, created).await?;
    Ok(true)
}

/// Stores an undamaged reference with its batches and quantities.
async fn insert_undamaged(
    transaction: &mut Transaction<'_>,
    structure: &str,
    state: &Undamaged,
    created: Timestamp,
) -> Result<(), Error> {
    sql::query("insert into undamaged_state values ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10)")
        .bind(structure)
        .bind(state.version)
        .bind(&state.model_digest)
        .bind(created.micros())
        .bind(state.threshold_probability)
        .bind(state.measurements)
        .bind(&state.conditions)
        .bind(&state.doubts)
        .bind(&state.joint)
        .bind(&state.origin)
        .execute(&mut *transaction)
        .await?;
    sql::query("insert into undamaged_process values ($1, $2, $3, $4)")
        .bind(structure)
        .bind(state.version)
        .bind(&state.process)
        .bind(&state.without_process)
        .execute(&mut *transaction)
        .await?;
    insert_batches(transaction, (structure, state.version), &state.batches).await?;
    for q in &state.quantities {
        sql::query("insert into undamaged_quantity values ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10)")
            .bind(structure)
            .bind(state.version)
            .bind(&q.quantity)
            .bind(q.position)
            .bind(q.mean)
            .bind(q.std)
            .bind(q.threshold)
            .bind(&q.detail)
            .bind(&q.mean_draws)
            .bind(&q.std_draws)
            .execute(&mut *transaction)
            .await?;
    }
    Ok(())
}
