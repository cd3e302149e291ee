//! The versions of an undamaged reference, those that waiting batches keep, and the alarms during which batches were measured.

use std::sync::Arc;

use sqlx::FromRow;

use super::column::{bad_row, timestamp};
use super::error::Error;
use super::reference_content::{batches_of, stored_origin};
use super::sql::{self, Whole};
use super::undamaged::{ReferenceRecord, References};
use crate::damage::ReferenceOrigin;
use crate::quantity::{Digest, StructureId, Timestamp};

/// Versions other than the newest that are kept in memory. Batches are compared with them one version after the other.
const KNOWN: usize = 8;

/// A version of the undamaged reference, in short.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ReferenceVersion {
    /// Its number.
    pub version: u32,
    /// When it was stored.
    pub created_at: Timestamp,
    /// Number of measurements.
    pub measurements: usize,
    /// Number of batches.
    pub batches: usize,
    /// Time of the first measurement.
    pub measured_from: Timestamp,
    /// Time of the last measurement.
    pub measured_to: Timestamp,
    /// Where it comes from.
    pub origin: ReferenceOrigin,
}

#[derive(FromRow)]
struct VersionRow {
    version: Whole<u32>,
    created_at_us: i64,
    measurement_count: i64,
    origin: Option<String>,
    batches: i64,
    measured_from_us: i64,
    measured_to_us: i64,
}

impl References<'_> {
    /// The ids of the batches of a version, in alphabetical order; none if there is no such version.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn batches_of(self, structure: &StructureId, version: u32) -> Result<Vec<String>, Error> {
        batches_of(self.database, structure, version).await
    }

    /// All versions of the undamaged reference of a structure, the newest first. An origin that cannot be read is that of a reference that was
    /// declared by itself.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn versions(self, structure: &StructureId) -> Result<Vec<ReferenceVersion>, Error> {
        let statement = sql::query_as(
            "select version, s.created_at_us, s.measurement_count, origin, count(*) as batches,
                    min(measured_from_us) as measured_from_us, max(measured_to_us) as measured_to_us
             from undamaged_state s join undamaged_batch u using (structure_id, version)
             join measurement_batch b using (structure_id, batch_id)
             where structure_id = $1 group by structure_id, version, s.created_at_us, s.measurement_count, origin order by version desc",
        )
        .bind(structure.as_str());
        let what = "undamaged reference";
        let readable =
            |origin: Option<&str>| stored_origin(origin).inspect_err(|e| tracing::warn!("{e}")).unwrap_or_default();
        let version = |row: VersionRow| {
            Ok(ReferenceVersion {
                version: row.version.0,
                created_at: timestamp(what, row.created_at_us)?,
                measurements: row.measurement_count as usize,
                batches: row.batches as usize,
                measured_from: timestamp(what, row.measured_from_us)?,
                measured_to: timestamp(what, row.measured_to_us)?,
                origin: readable(row.origin.as_deref()),
            })
        };
        self.database.damaged.leave_out(statement, &self.database.reader, 1, version).await
    }

    /// The damage alarms during which batches were measured, that were not withdrawn: batch and number of the alarm. Only alarms of
    /// the undamaged reference of version `first` and later ones count: what an earlier one showed may have been repaired.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn alarms_during(
        self,
        structure: &StructureId,
        first: u32,
        batches: &[String],
    ) -> Result<Vec<(String, i64)>, Error> {
        let ids = serde_json::to_string(batches).map_err(|e| bad_row("batch")(&e))?;
        Ok(sql::query_as(
            "select b.batch_id, min(a.episode) from measurement_batch b join alarm_episode a using (structure_id)
             where structure_id = $1 and b.batch_id in (select value from json_each($2))
               and a.kind = 'damage' and a.withdrawn = 0 and a.undamaged_version >= $3 and a.opened_at_us <= b.measured_to_us
               and (a.ended_at_us is null or a.ended_at_us > b.measured_to_us)
             group by b.batch_id, b.measured_to_us order by b.measured_to_us",
        )
        .bind(structure.as_str())
        .bind(ids)
        .bind(first)
        .fetch_all(&self.database.reader)
        .await?)
    }

    /// A version of the undamaged reference of a structure.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn version(self, structure: &StructureId, version: u32) -> Result<Option<Arc<ReferenceRecord>>, Error> {
        let is =
            |(id, record): &&(StructureId, Arc<ReferenceRecord>)| id == structure && record.state.version == version;
        let known = self.known.earlier.lock().expect("no holder of this lock panics").iter().find(is).cloned();
        if let Some((_, record)) = known {
            return Ok(Some(record));
        }
        let Some(record) = self.read_undamaged(structure, Some(version)).await?.map(Arc::new) else { return Ok(None) };
        let mut earlier = self.known.earlier.lock().expect("no holder of this lock panics");
        if earlier.len() >= KNOWN {
            earlier.remove(0);
        }
        earlier.push((structure.clone(), Arc::clone(&record)));
        Ok(Some(record))
    }

    /// Versions that waiting batches keep and that were made with another trained baseline than `model`, ascending.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn kept_of_other_models(self, structure: &StructureId, model: &Digest) -> Result<Vec<u32>, Error> {
        let versions: Vec<(Whole<u32>,)> = sql::query_as(
            "select distinct undamaged_version from kept_comparison k join undamaged_state s
                 on s.structure_id = k.structure_id and s.version = k.undamaged_version
             where k.structure_id = $1 and s.model_digest <> $2 order by undamaged_version",
        )
        .bind(structure.as_str())
        .bind(model.as_str())
        .fetch_all(&self.database.reader)
        .await?;
        Ok(versions.into_iter().map(|(version,)| version.0).collect())
    }

    /// Batches that keep a reference of another trained baseline than `model` are compared with none. Returns their number.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn keep_none_of_other_models(self, structure: &StructureId, model: &Digest) -> Result<u64, Error> {
        let (structure, model) = (structure.to_string(), model.to_string());
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    let update = "update kept_comparison set undamaged_version = 0
                         where structure_id = $1 and undamaged_version in
                             (select version from undamaged_state where structure_id = $1 and model_digest <> $2)";
                    let update = sql::query(update).bind(&structure).bind(&model);
                    Ok(update.execute(&mut *transaction).await?.rows_affected())
                })
            })
            .await
    }

    /// Pretends that all references were made by another trained baseline.
    #[cfg(test)]
    pub(crate) async fn made_by_another_model(self, structure: &StructureId) {
        let structure = structure.to_string();
        let written = self.database.write(move |transaction| {
            Box::pin(async move {
                let update = sql::query("update undamaged_state set model_digest = 'another' where structure_id = $1");
                update.bind(structure).execute(&mut *transaction).await?;
                Ok(())
            })
        });
        written.await.expect("the database can be written");
        self.known.newest.lock().expect("no holder of this lock panics").clear();
        self.known.earlier.lock().expect("no holder of this lock panics").clear();
    }
}
