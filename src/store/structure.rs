//! Structures and their present definitions.

use super::column::{bad_row, timestamp};
use super::database::Database;
use super::error::Error;
use super::sql;
use super::transaction::Transaction;
use crate::quantity::{Digest, StructureId, Timestamp};

/// The outcome of storing a definition.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PutStructure {
    /// The structure is new.
    Created,
    /// The definition is stored already.
    Unchanged,
    /// It replaced another definition without batches.
    Replaced,
    /// Another definition has batches, or the structure is being deleted, so nothing was changed.
    Refused,
}

/// A stored structure.
#[derive(Debug, Clone, PartialEq)]
pub struct StructureRecord {
    /// Its id.
    pub id: StructureId,
    /// Its definition, canonical JSON.
    pub definition_json: String,
    /// Digest of the definition.
    pub digest: Digest,
    /// When the structure was created.
    pub created_at: Timestamp,
    /// When it was last changed.
    pub updated_at: Timestamp,
}

/// An item of the list of structures.
#[derive(Debug, Clone, PartialEq)]
pub struct StructureSummary {
    /// Its id.
    pub id: StructureId,
    /// Digest of the definition.
    pub digest: Digest,
    /// When the structure was created.
    pub created_at: Timestamp,
    /// Number of stored batches.
    pub batches: u64,
    /// Time of the latest measurement.
    pub last_measured_at: Option<Timestamp>,
}

/// Whether a definition is the present one of its structure.
pub(super) async fn is_present(
    transaction: &mut Transaction<'_>,
    structure: &str,
    digest: &Digest,
) -> Result<bool, Error> {
    let (present,): (bool,) =
        sql::query_as("select exists (select 1 from structure where structure_id = $1 and digest = $2)")
            .bind(structure)
            .bind(digest.as_str())
            .fetch_one(&mut *transaction)
            .await?;
    Ok(present)
}

/// Structures, their versions, and the trained baselines that the service made for them.
#[derive(Clone, Copy)]
pub struct Structures<'s> {
    pub(super) database: &'s Database,
}

impl Structures<'_> {
    /// Stores a definition unless another definition of the same structure has batches.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn put_structure(
        self,
        id: &StructureId,
        definition_json: &str,
        digest: &Digest,
        now: Timestamp,
    ) -> Result<PutStructure, Error> {
        let (id, json, digest, now) = (id.to_string(), definition_json.to_owned(), digest.to_string(), now.micros());
        self.database
            .write(move |transaction| {
                Box::pin(async move { put_definition(transaction, &id, (&json, &digest), now).await })
            })
            .await
    }

    /// A stored structure that is not being deleted.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn structure(self, id: &StructureId) -> Result<Option<StructureRecord>, Error> {
        let row: Option<(String, String, i64, i64)> = sql::query_as(
            "select definition, digest, created_at_us, updated_at_us from structure s
             where structure_id = $1 and not exists (select 1 from structure_deletion d where d.structure_id = s.structure_id)",
        )
        .bind(id.as_str())
        .fetch_optional(&self.database.reader)
        .await?;
        let record = |(definition_json, digest, created, updated)| {
            Ok(StructureRecord {
                id: id.clone(),
                definition_json,
                digest: Digest::from_stored(digest),
                created_at: timestamp("structure", created)?,
                updated_at: timestamp("structure", updated)?,
            })
        };
        row.map(record).transpose()
    }

    /// When a structure that is not being deleted was created. One that is deleted and made anew under the same id is another one by this.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn created_at(self, id: &StructureId) -> Result<Option<Timestamp>, Error> {
        let row: Option<(i64,)> = sql::query_as(
            "select created_at_us from structure s
             where structure_id = $1 and not exists (select 1 from structure_deletion d where d.structure_id = s.structure_id)",
        )
        .bind(id.as_str())
        .fetch_optional(&self.database.reader)
        .await?;
        row.map(|(created,)| timestamp("structure", created)).transpose()
    }

    /// All structures except those that are being deleted, by id.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn list(self) -> Result<Vec<StructureSummary>, Error> {
        let statement = sql::query_as(
            "select s.structure_id, s.digest, s.created_at_us, coalesce(c.batches, 0), c.last_measured_us
             from structure s left join structure_summary c using (structure_id)
             where not exists (select 1 from structure_deletion d where d.structure_id = s.structure_id) order by s.structure_id",
        );
        let summary = |(id, digest, created, batches, last): (String, String, i64, i64, Option<i64>)| {
            Ok(StructureSummary {
                id: StructureId::parse(&id).map_err(|e| bad_row("structure")(&e))?,
                digest: Digest::from_stored(digest),
                created_at: timestamp("structure", created)?,
                batches: batches.unsigned_abs(),
                last_measured_at: last.map(|last| timestamp("structure", last)).transpose()?,
            })
        };
        self.database.damaged.leave_out(statement, &self.database.reader, 1, summary).await
    }
}

/// Stores a definition unless another definition of the same structure has batches.
pub(super) async fn put_definition(
    transaction: &mut Transaction<'_>,
    id: &str,
    (json, digest): (&str, &str),
    now: i64,
) -> Result<PutStructure, Error> {
    let stored: Option<(String,)> = sql::query_as("select digest from structure where structure_id = $1")
        .bind(id)
        .fetch_optional(&mut *transaction)
        .await?;
    let Some((stored,)) = stored else {
        sql::query("insert into structure values ($1, $2, $3, $4, $5)")
            .bind(id)
            .bind(json)
            .bind(digest)
            .bind(now)
            .bind(now)
            .execute(&mut *transaction)
            .await?;
        return Ok(PutStructure::Created);
    };
    let (deleted,): (bool,) = sql::query_as("select exists (select 1 from structure_deletion where structure_id = $1)")
        .bind(id)
        .fetch_one(&mut *transaction)
        .await?;
    if deleted {
        return Ok(PutStructure::Refused);
    }
    if stored == digest {
        return Ok(PutStructure::Unchanged);
    }
    let (in_use,): (bool,) = sql::query_as("select exists (select 1 from measurement_batch where structure_id = $1)")
        .bind(id)
        .fetch_one(&mut *transaction)
        .await?;
    if in_use {
        return Ok(PutStructure::Refused);
    }
    sql::query("update structure set definition = $1, digest = $2, updated_at_us = $3 where structure_id = $4")
        .bind(json)
        .bind(digest)
        .bind(now)
        .bind(id)
        .execute(&mut *transaction)
        .await?;
    Ok(PutStructure::Replaced)
}
