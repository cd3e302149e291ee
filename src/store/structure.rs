//! Structures.

use super::{timestamp, Error, Store};
use crate::quantity::{Digest, StructureId, Timestamp};

/// What became of a definition.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PutStructure {
    /// It is new.
    Created,
    /// It was there already.
    Unchanged,
    /// It took the place of another, which had no batches.
    Replaced,
    /// Another definition has batches; nothing was changed.
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
    /// When it was first put.
    pub created_at: Timestamp,
    /// When it was last changed.
    pub updated_at: Timestamp,
}

/// A line of the list of structures.
#[derive(Debug, Clone, PartialEq)]
pub struct StructureSummary {
    /// Its id.
    pub id: StructureId,
    /// Digest of the definition.
    pub digest: Digest,
    /// When it was first put.
    pub created_at: Timestamp,
    /// Batches stored.
    pub batches: u64,
    /// Time of the latest measurement.
    pub last_measured_at: Option<Timestamp>,
}

/// Whether a definition is the present one of its structure.
pub(super) async fn is_present(
    connection: &mut sqlx::SqliteConnection,
    structure: &str,
    digest: &Digest,
) -> Result<bool, Error> {
    let (present,): (bool,) =
        sqlx::query_as("select exists (select 1 from structure where structure_id = ? and digest = ?)")
            .bind(structure)
            .bind(digest.as_str())
            .fetch_one(&mut *connection)
            .await?;
    Ok(present)
}

impl Store {
    /// Stores a definition, unless another definition of the same id has batches.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn put_structure(
        &self,
        id: &StructureId,
        definition_json: &str,
        digest: &Digest,
        now: Timestamp,
    ) -> Result<PutStructure, Error> {
        let (id, json, digest, now) = (id.to_string(), definition_json.to_owned(), digest.to_string(), now.micros());
        self.write(move |connection| {
            Box::pin(async move {
                let stored: Option<(String,)> = sqlx::query_as("select digest from structure where structure_id = ?")
                    .bind(&id)
                    .fetch_optional(&mut *connection)
                    .await?;
                let Some((stored,)) = stored else {
                    sqlx::query("insert into structure values (?, ?, ?, ?, ?)")
                        .bind(&id)
                        .bind(&json)
                        .bind(&digest)
                        .bind(now)
                        .bind(now)
                        .execute(&mut *connection)
                        .await?;
                    return Ok(PutStructure::Created);
                };
                if stored == digest {
                    return Ok(PutStructure::Unchanged);
                }
                let (in_use,): (bool,) =
                    sqlx::query_as("select exists (select 1 from measurement_batch where structure_id = ?)")
                        .bind(&id)
                        .fetch_one(&mut *connection)
                        .await?;
                if in_use {
                    return Ok(PutStructure::Refused);
                }
                sqlx::query(
                    "update structure set definition = ?, digest = ?, updated_at_us = ? where structure_id = ?",
                )
                .bind(&json)
                .bind(&digest)
                .bind(now)
                .bind(&id)
                .execute(&mut *connection)
                .await?;
                Ok(PutStructure::Replaced)
            })
        })
        .await
    }

    /// A stored structure.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn structure(&self, id: &StructureId) -> Result<Option<StructureRecord>, Error> {
        let row: Option<(String, String, i64, i64)> = sqlx::query_as(
            "select definition, digest, created_at_us, updated_at_us from structure where structure_id = ?",
        )
        .bind(id.as_str())
        .fetch_optional(&self.reader)
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

    /// All structures, by id.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn structures(&self) -> Result<Vec<StructureSummary>, Error> {
        let rows: Vec<(String, String, i64, i64, Option<i64>)> = sqlx::query_as(
            "select s.structure_id, s.digest, s.created_at_us, coalesce(c.batches, 0), c.last_measured_us
             from structure s left join structure_summary c using (structure_id) order by s.structure_id",
        )
        .fetch_all(&self.reader)
        .await?;
        let summary = |(id, digest, created, batches, last): (String, String, i64, i64, Option<i64>)| {
            Ok(StructureSummary {
                id: StructureId::parse(&id).map_err(|e| super::bad_row("structure")(&e))?,
                digest: Digest::from_stored(digest),
                created_at: timestamp("structure", created)?,
                batches: batches.unsigned_abs(),
                last_measured_at: last.map(|last| timestamp("structure", last)).transpose()?,
            })
        };
        rows.into_iter().map(summary).collect()
    }
}
