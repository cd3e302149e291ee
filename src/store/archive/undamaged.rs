//! Undamaged references in an archive.

use std::collections::BTreeMap;

use super::super::column::bad_row;
use super::super::error::Error;
use super::super::reference_content::{stored_origin, stored_process};
use super::super::sql;
use super::super::transaction::Transaction;
use super::super::undamaged::{insert_batches, quantity, ReferenceQuantityRow};
use super::record::{Undamaged, UndamagedQuantity};
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
        let joint: Option<JointReference> =
            self.joint.as_deref().map(serde_json::from_str).transpose().map_err(|e| bad(&e))?;
        if let Some(defect) = joint.as_ref().and_then(JointReference::defect) {
            return Err(bad(&defect));
        }
        stored_origin(self.origin.as_deref())?;
        self.process.as_deref().map(stored_process).transpose()?;
        if self.quantities.is_empty() {
            return Err(bad(&"it has no quantities"));
        }
        self.quantities.iter().try_for_each(|q| q.check(self.measurements))
    }

    /// The texts in it whose length nothing else limits.
    ///
    /// # Errors
    /// [`Error::Row`] if one cannot be read.
    pub fn texts(&self) -> Result<Vec<String>, Error> {
        let bad = bad_row("undamaged reference of the archive");
        let doubts: Vec<String> = serde_json::from_str(&self.doubts).map_err(|e| bad(&e))?;
        let names = self.quantities.iter().map(|q| q.quantity.clone());
        let reasons = [self.without_process.clone(), stored_origin(self.origin.as_deref())?.reason];
        Ok([self.model_digest.clone()]
            .into_iter()
            .chain(reasons.into_iter().flatten())
            .chain(doubts)
            .chain(names)
            .collect())
    }
}

impl UndamagedQuantity {
    /// Checks the numbers of a quantity of a reference with this number of measurements.
    fn check(&self, measurements: i64) -> Result<(), Error> {
        let what = shown(&self.quantity);
        let bad = |why: &str| Err(bad_row("undamaged reference of the archive")(&format!("{what}: {why}")));
        let row = ReferenceQuantityRow {
            quantity: self.quantity.clone(),
            mean: self.mean,
            std: self.std,
            threshold: self.threshold,
            detail: self.detail.clone(),
            mean_draws: self.mean_draws.clone(),
            std_draws: self.std_draws.clone(),
        };
        let read = quantity(row, usize::try_from(measurements).unwrap_or_default())?;
        if read.name != self.quantity {
            return bad("its details are those of another quantity");
        }
        let spreads = [self.std, read.std].into_iter().chain(read.std_draws.iter().copied());
        if !spreads.into_iter().all(|spread| spread.is_finite() && spread >= 0.0) {
            return bad("a standard deviation is not finite, or is negative");
        }
        let others = [self.mean, read.mean].into_iter().chain(read.mean_draws.iter().copied()).chain(self.threshold);
        if !others.into_iter().all(f64::is_finite) {
            return bad("a value is not finite");
        }
        // Intervals of a batch are those of its differences from the draws.
        if read.mean_draws.is_empty() || read.mean_draws.len() != read.std_draws.len() {
            return bad("it has no draws, or different numbers of them");
        }
        read.reference.defect().map_or(Ok(()), bad)
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
