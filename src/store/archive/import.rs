//! Storing the lines of an archive.

use std::collections::BTreeMap;

use super::super::batch::import_batch;
use super::super::column::bad_row;
use super::super::error::Error;
use super::super::reference_content::stored_origin;
use super::super::transaction::Transaction;
use super::super::undamaged::{quantity, stored_process, ReferenceQuantityRow};
use super::export::Archive;
use super::record::{Acknowledged, ArchivedModel, Maintenance, Undamaged, Version};
use crate::damage::{JointReference, SeenCovariate};
use crate::measurement::MeasurementBatch;
use crate::quantity::{StructureId, Timestamp};

impl Undamaged {
    /// Checks that the reference can be read once it is stored: every text in it is parsed, and its numbers are finite.
    ///
    /// # Errors
    /// [`Error::Row`] with what cannot be read.
    pub fn check(&self) -> Result<(), Error> {
        let bad = bad_row("undamaged reference of the archive");
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
            let finite = read.mean_draws.iter().all(|draw| draw.is_finite())
                && read.std_draws.iter().all(|draw| draw.is_finite() && *draw >= 0.0);
            if !finite {
                return Err(bad(&format!(
                    "the draws of {} are not finite, or a standard deviation is negative",
                    q.quantity
                )));
            }
        }
        Ok(())
    }
}

impl Archive<'_> {
    /// Stores batches of an archive under their own ids in one transaction. Batches that are stored already are skipped. Returns
    /// the number of new batches.
    ///
    /// # Errors
    /// [`Error::Row`] with the batch if its id or one of its measurements belongs to different content here.
    pub async fn import_batches(self, batches: Vec<(String, MeasurementBatch, Timestamp)>) -> Result<u64, Error> {
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    let mut stored = 0;
                    for (id, batch, received_at) in batches {
                        stored += u64::from(import_batch(transaction, &id, &batch, received_at).await?);
                    }
                    Ok(stored)
                })
            })
            .await
    }

    /// Stores a version of a structure unless it is stored already. Returns whether it was new.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`] if a time cannot be parsed.
    pub async fn import_version(self, structure: &StructureId, version: Version) -> Result<bool, Error> {
        let structure = structure.to_string();
        let created = Timestamp::parse(&version.created_at).map_err(|e| bad_row("version of the archive")(&e))?;
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    let inserted = sqlx::query(
                        "insert into structure_version values ($1, $2, $3, $4, null, $5) on conflict do nothing",
                    )
                    .bind(&structure)
                    .bind(&version.digest)
                    .bind(&version.definition)
                    .bind(&version.parent_digest)
                    .bind(created.micros())
                    .execute(transaction.connection())
                    .await?;
                    Ok(inserted.rows_affected() > 0)
                })
            })
            .await
    }

    /// Stores a trained baseline unless one is stored for its version. Returns whether it was new.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`] if the weights are not base64.
    pub async fn import_model(
        self,
        structure: &StructureId,
        model: ArchivedModel,
        now: Timestamp,
    ) -> Result<bool, Error> {
        let structure = structure.to_string();
        let weights = model.weights().map_err(|e| bad_row("model of the archive")(&e))?;
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    let inserted = sqlx::query(
                        "insert into trained_baseline values ($1, $2, $3, $4, $5, $6, $7) on conflict do nothing",
                    )
                    .bind(&structure)
                    .bind(&model.structure_digest)
                    .bind(&model.model_digest)
                    .bind(model.manifest.into_bytes())
                    .bind(weights)
                    .bind(model.accepted)
                    .bind(now.micros())
                    .execute(transaction.connection())
                    .await?;
                    Ok(inserted.rows_affected() > 0)
                })
            })
            .await
    }

    /// Stores an undamaged reference under its own version unless it is stored already. All batches outside a new reference are
    /// assessed again. Returns whether it was new.
    ///
    /// # Errors
    /// [`Error::Row`] if that version is a different reference here.
    pub async fn import_undamaged(self, structure: &StructureId, state: Undamaged) -> Result<bool, Error> {
        let structure = structure.to_string();
        state.check()?;
        let created =
            Timestamp::parse(&state.created_at).map_err(|e| bad_row("undamaged reference of the archive")(&e))?;
        self.database.write(move |transaction| {
            Box::pin(async move {
                let known: Option<(String, i64)> = sqlx::query_as(
                    "select model_digest, created_at_us from undamaged_state where structure_id = $1 and version = $2",
                )
                .bind(&structure)
                .bind(state.version)
                .fetch_optional(transaction.connection())
                .await?;
                if let Some((model_digest, created_here)) = known {
                    if model_digest == state.model_digest && created_here == created.micros() {
                        return Ok(false);
                    }
                    let detail = format!("{structure} already has a different undamaged reference {} here", state.version);
                    return Err(bad_row("undamaged reference of the archive")(&detail));
                }
                insert_undamaged(transaction, &structure, &state, created).await?;
                sqlx::query(
                    "update measurement_batch set state = 'received' where structure_id = $1 and state = 'assessed'
                       and batch_id not in (select batch_id from undamaged_batch where structure_id = $1 and version = $2)",
                )
                .bind(&structure)
                .bind(state.version)
                .execute(transaction.connection())
                .await?;
                Ok(true)
            })
        })
        .await
    }

    /// Stores a maintenance window unless it is stored already. Returns whether it was new.
    ///
    /// # Errors
    /// [`Error::Row`] if a time cannot be parsed.
    pub async fn import_maintenance(self, structure: &StructureId, window: Maintenance) -> Result<bool, Error> {
        let time = |text: &str| Timestamp::parse(text).map_err(|e| bad_row("maintenance window of the archive")(&e));
        let (from, to, created) = (time(&window.from)?, time(&window.to)?, time(&window.created_at)?);
        let structure = structure.to_string();
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    let inserted = sqlx::query(
                        "insert into maintenance_window values ($1, $2, $3, $4, $5) on conflict do nothing",
                    )
                    .bind(&structure)
                    .bind(from.micros())
                    .bind(to.micros())
                    .bind(&window.reason)
                    .bind(created.micros())
                    .execute(transaction.connection())
                    .await?;
                    Ok(inserted.rows_affected() > 0)
                })
            })
            .await
    }

    /// Stores an acknowledgement with its alarm. Returns whether something changed, which it does not if the alarm does not exist
    /// here or is acknowledged already.
    ///
    /// # Errors
    /// [`Error::Row`] if a time cannot be parsed.
    pub async fn import_acknowledgement(self, structure: &StructureId, note: Acknowledged) -> Result<bool, Error> {
        let at = Timestamp::parse(&note.at).map_err(|e| bad_row("acknowledgement of the archive")(&e))?;
        let structure = structure.to_string();
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    let updated = sqlx::query(
                    "update alarm_episode set acknowledged_at_us = $1, acknowledged_by = $2, acknowledgement_note = $3
                     where structure_id = $4 and kind = $5 and series = $6 and opened_batch = $7 and withdrawn = 0
                       and acknowledged_at_us is null",
                )
                .bind(at.micros())
                .bind(&note.by)
                .bind(&note.note)
                .bind(&structure)
                .bind(&note.kind)
                .bind(&note.series)
                .bind(&note.opened_batch)
                .execute(transaction.connection())
                .await?;
                    Ok(updated.rows_affected() > 0)
                })
            })
            .await
    }
}

/// Stores an undamaged reference with its batches and quantities.
async fn insert_undamaged(
    transaction: &mut Transaction<'_>,
    structure: &str,
    state: &Undamaged,
    created: Timestamp,
) -> Result<(), Error> {
    sqlx::query("insert into undamaged_state values ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10)")
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
        .execute(transaction.connection())
        .await?;
    sqlx::query("insert into undamaged_process values ($1, $2, $3, $4)")
        .bind(structure)
        .bind(state.version)
        .bind(&state.process)
        .bind(&state.without_process)
        .execute(transaction.connection())
        .await?;
    for batch in &state.batches {
        sqlx::query("insert into undamaged_batch values ($1, $2, $3)")
            .bind(structure)
            .bind(state.version)
            .bind(batch)
            .execute(transaction.connection())
            .await?;
    }
    for q in &state.quantities {
        sqlx::query("insert into undamaged_quantity values ($1, $2, $3, $4, $5, $6, $7, $8, $9, $10)")
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
            .execute(transaction.connection())
            .await?;
    }
    Ok(())
}
