//! Versions of structures, and the trained baselines that the service made for them.

use sqlx::FromRow;

use super::current::IS_CURRENT;
use super::error::Error;
use super::sql;
use super::structure::{is_present, Structures};
use super::transaction::Transaction;
use crate::quantity::{Digest, StructureId, Timestamp};

/// A new version of a structure, with the trained baseline for it.
#[derive(Debug, Clone, PartialEq)]
pub struct NewVersion {
    /// Digest of the definition.
    pub digest: Digest,
    /// Canonical JSON.
    pub definition_json: String,
    /// Digest of the version that it extends.
    pub parent: Option<Digest>,
    /// Id of the diagnosis from which it was made.
    pub diagnosis: Option<String>,
    /// A trained baseline that is not in the library.
    pub baseline: Option<StoredBaseline>,
}

/// A trained baseline that the service made.
#[derive(Debug, Clone, PartialEq, FromRow)]
pub struct StoredBaseline {
    /// Digest of the manifest.
    pub model_digest: String,
    /// The manifest file.
    pub manifest: Vec<u8>,
    /// The weight file.
    pub weights: Vec<u8>,
    /// True if it is used although it failed its calibration check.
    pub accepted: bool,
}

impl Structures<'_> {
    /// Makes another version the present version of a structure and stores the baseline trained for it. The earlier version and
    /// the assessments for it are kept, and all batches are assessed again for the new one; they keep the undamaged references that they
    /// are compared with. Changes nothing and returns false if
    /// `expected` is not the present version.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn switch_version(
        self,
        structure: &StructureId,
        expected: &Digest,
        version: NewVersion,
        now: Timestamp,
    ) -> Result<bool, Error> {
        let (structure, expected, now) = (structure.to_string(), expected.clone(), now.micros());
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    if !is_present(transaction, &structure, &expected).await? {
                        return Ok(false);
                    }
                    sql::query(
                        "insert into structure_version
                     select structure_id, digest, definition, null, null, created_at_us from structure
                     where structure_id = $1
                     on conflict do nothing",
                    )
                    .bind(&structure)
                    .execute(&mut *transaction)
                    .await?;
                    sql::query("insert into structure_version values ($1, $2, $3, $4, $5, $6) on conflict do nothing")
                        .bind(&structure)
                        .bind(version.digest.as_str())
                        .bind(&version.definition_json)
                        .bind(version.parent.as_ref().map(Digest::as_str))
                        .bind(&version.diagnosis)
                        .bind(now)
                        .execute(&mut *transaction)
                        .await?;
                    if let Some(baseline) = &version.baseline {
                        insert_baseline(transaction, &structure, &version.digest, baseline, now).await?;
                    }
                    sql::query(
                        "update structure set definition = $1, digest = $2, updated_at_us = $3 where structure_id = $4",
                    )
                    .bind(&version.definition_json)
                    .bind(version.digest.as_str())
                    .bind(now)
                    .bind(&structure)
                    .execute(&mut *transaction)
                    .await?;
                    keep_all(transaction, &structure).await?;
                    sql::query(
                        "update measurement_batch set state = 'received', failure = null where structure_id = $1",
                    )
                    .bind(&structure)
                    .execute(&mut *transaction)
                    .await?;
                    Ok(true)
                })
            })
            .await
    }

    /// A version of a structure: its definition, and the digest of the version that it extends.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn structure_version(
        self,
        structure: &StructureId,
        digest: &Digest,
    ) -> Result<Option<(String, Option<Digest>)>, Error> {
        let row: Option<(String, Option<String>)> = sql::query_as(
            "select definition, parent_digest from structure_version where structure_id = $1 and digest = $2",
        )
        .bind(structure.as_str())
        .bind(digest.as_str())
        .fetch_optional(&self.database.reader)
        .await?;
        Ok(row.map(|(definition, parent)| (definition, parent.map(Digest::from_stored))))
    }

    /// The trained baseline that the service made for a version.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn trained_baseline(
        self,
        structure: &StructureId,
        structure_digest: &Digest,
    ) -> Result<Option<StoredBaseline>, Error> {
        Ok(sql::query_as(
            "select model_digest, manifest, weights, accepted from trained_baseline
             where structure_id = $1 and structure_digest = $2",
        )
        .bind(structure.as_str())
        .bind(structure_digest.as_str())
        .fetch_optional(&self.database.reader)
        .await?)
    }
}

/// Stores the baseline trained for a version in place of an earlier one.
async fn insert_baseline(
    transaction: &mut Transaction<'_>,
    structure: &str,
    version: &Digest,
    baseline: &StoredBaseline,
    now_us: i64,
) -> Result<(), Error> {
    sql::query(
        "insert into trained_baseline values ($1, $2, $3, $4, $5, $6, $7)
         on conflict (structure_id, structure_digest) do update
         set model_digest = excluded.model_digest, manifest = excluded.manifest, weights = excluded.weights,
             accepted = excluded.accepted, created_at_us = excluded.created_at_us",
    )
    .bind(structure)
    .bind(version.as_str())
    .bind(&baseline.model_digest)
    .bind(&baseline.manifest)
    .bind(&baseline.weights)
    .bind(baseline.accepted)
    .bind(now_us)
    .execute(&mut *transaction)
    .await?;
    Ok(())
}

/// All batches of a structure are to be assessed again: those that are compared with another reference than the newest keep theirs.
async fn keep_all(transaction: &mut Transaction<'_>, structure: &str) -> Result<(), Error> {
    sql::query("delete from kept_comparison where structure_id = $1")
        .bind(structure)
        .execute(&mut *transaction)
        .await?;
    let insert = format!(
        "insert into kept_comparison
         select a.structure_id, a.batch_id, 0, a.undamaged_version from assessment a
         where a.structure_id = $1 and a.undamaged_version > 0
           and a.undamaged_version < (select max(version) from undamaged_state where structure_id = $1) and {IS_CURRENT}"
    );
    sql::query(sqlx::AssertSqlSafe(insert)).bind(structure).execute(&mut *transaction).await?;
    Ok(())
}
