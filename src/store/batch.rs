//! Batches and their measurements.

use std::future::Future;

use sqlx::sqlite::SqliteConnection;
use sqlx::FromRow;
use tokio::sync::oneshot;

use super::rows::{parts, InsertStatements};
use super::{bad_row, from_blob, timestamp, to_blob, Error, Store};
use crate::assessment::BatchState;
use crate::measurement::{MeasurementBatch, ModalMeasurement};
use crate::quantity::{Digest, Hertz, StructureId, Timestamp};

/// What became of a batch.
#[derive(Debug, Clone, PartialEq)]
pub enum InsertBatch {
    /// It is stored.
    Inserted {
        /// Digest of what was measured.
        content_digest: Digest,
        /// Frequencies of the last measurement of its source before it.
        previous: Option<Vec<Option<Hertz>>>,
    },
    /// It had been stored before under this id.
    Replayed(String),
    /// Its key belongs to a batch of other content; nothing was stored.
    KeyConflict {
        /// That batch.
        batch_id: String,
    },
    /// One of its measurements is in a batch of other content; nothing was stored.
    MeasurementConflict {
        /// Index of the measurement.
        ordinal: usize,
        /// Its time.
        measured_at: Timestamp,
        /// The batch that has it.
        batch_id: String,
    },
}

/// A stored batch.
#[derive(Debug, Clone, PartialEq)]
pub struct BatchRecord {
    /// Its id.
    pub batch_id: String,
    /// What was measured.
    pub batch: MeasurementBatch,
    /// Digest of what was measured.
    pub content_digest: Digest,
    /// When it arrived.
    pub received_at: Timestamp,
    /// How far it has come.
    pub state: BatchState,
    /// Why its assessment failed.
    pub failure: Option<String>,
}

#[derive(FromRow)]
struct BatchRow {
    source: String,
    idempotency_key: Option<String>,
    content_digest: String,
    received_at_us: i64,
    state: String,
    failure: Option<String>,
}

#[derive(FromRow)]
pub(super) struct MeasurementRow {
    measured_at_us: i64,
    frequency_hz: Vec<u8>,
    std_hz: Option<Vec<u8>>,
    mode_shapes: Option<String>,
    covariates: String,
    settings: String,
}

impl Store {
    /// Stores a batch, whole or not at all, unless it is there already.
    ///
    /// A known key decides; without one, the measurements do, which are known by source and time.
    ///
    /// # Errors
    /// [`Error::UnknownStructure`], [`Error::Sqlite`].
    pub async fn insert_batch(
        &self,
        batch: &MeasurementBatch,
        batch_id: &str,
        received_at: Timestamp,
    ) -> Result<InsertBatch, Error> {
        let (foreseen, _) = oneshot::channel();
        self.insert_batch_foreseen(batch, batch_id, received_at, foreseen).await
    }

    /// As [`Self::insert_batch`]; what will become of the batch if nothing fails is `foreseen` before it is on the disk, for what
    /// can be begun meanwhile.
    ///
    /// # Errors
    /// As [`Self::insert_batch`].
    pub fn insert_batch_foreseen(
        &self,
        batch: &MeasurementBatch,
        batch_id: &str,
        received_at: Timestamp,
        foreseen: oneshot::Sender<InsertBatch>,
    ) -> impl Future<Output = Result<InsertBatch, Error>> + Send + 'static {
        let (batch, id) = (batch.clone(), batch_id.to_owned());
        self.write(move |connection| {
            Box::pin(async move {
                let digest = batch.content_digest();
                let found = find_stored(connection, &batch, digest).await?;
                // Nobody may wait for it.
                let _ = foreseen.send(found.clone());
                if let InsertBatch::Inserted { content_digest, .. } = &found {
                    insert(connection, &batch, content_digest, &id, received_at).await?;
                }
                Ok(found)
            })
        })
    }

    /// One batch with its measurements.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn batch(&self, structure: &StructureId, batch_id: &str) -> Result<Option<BatchRecord>, Error> {
        let row: Option<BatchRow> = sqlx::query_as(
            "select source, idempotency_key, content_digest, received_at_us, state, failure
             from measurement_batch where structure_id = ? and batch_id = ?",
        )
        .bind(structure.as_str())
        .bind(batch_id)
        .fetch_optional(&self.reader)
        .await?;
        let Some(row) = row else { return Ok(None) };
        fault_point!("store::read", |_| Err(bad_row("batch")(&"a fault")));
        let measurements: Vec<MeasurementRow> = sqlx::query_as(
            "select measured_at_us, frequency_hz, std_hz, mode_shapes, covariates, settings
             from measurement where structure_id = ? and batch_id = ? order by ordinal",
        )
        .bind(structure.as_str())
        .bind(batch_id)
        .fetch_all(&self.reader)
        .await?;
        let batch = MeasurementBatch {
            structure: structure.clone(),
            source: row.source,
            idempotency_key: row.idempotency_key,
            measurements: measurements.into_iter().map(measurement).collect::<Result<_, _>>()?,
        };
        let content_digest = Digest::from_stored(row.content_digest);
        // SQLite has no checksums: a bit that fell over on the disk would come back as a measurement nobody made.
        if batch.measurements.is_empty() || batch.content_digest() != content_digest {
            let detail = "its measurements are not those that its digest was taken of: the database is damaged";
            return Err(bad_row("batch")(&detail));
        }
        Ok(Some(BatchRecord {
            batch_id: batch_id.to_owned(),
            batch,
            content_digest,
            received_at: timestamp("batch", row.received_at_us)?,
            state: batch_state(&row.state)?,
            failure: row.failure,
        }))
    }

    /// Frequencies of the last measurement of a source before a time.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn frequencies_before(
        &self,
        structure: &StructureId,
        source: &str,
        before: Timestamp,
    ) -> Result<Option<Vec<Option<Hertz>>>, Error> {
        fault_point!("store::read", |_| Err(bad_row("measurement")(&"a fault")));
        let row: Option<(Vec<u8>,)> = sqlx::query_as(
            "select frequency_hz from measurement where structure_id = ? and source = ? and measured_at_us < ?
             order by measured_at_us desc limit 1",
        )
        .bind(structure.as_str())
        .bind(source)
        .bind(before.micros())
        .fetch_optional(&self.reader)
        .await?;
        row.map(|(blob,)| frequencies("measurement", &blob)).transpose()
    }

    /// Batches of a structure that wait for their assessment, oldest first.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn pending(&self, structure: &StructureId, limit: usize) -> Result<Vec<String>, Error> {
        let rows: Vec<(String,)> = sqlx::query_as(
            "select batch_id from measurement_batch where structure_id = ? and state = 'received'
             order by received_at_us, batch_id limit ?",
        )
        .bind(structure.as_str())
        .bind(limit as i64)
        .fetch_all(&self.reader)
        .await?;
        Ok(rows.into_iter().map(|(id,)| id).collect())
    }

    /// Marks a batch whose assessment failed, unless the structure has another version by now. Whether it was marked.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub fn mark_failed(
        &self,
        structure: &StructureId,
        batch_id: &str,
        version: &Digest,
        reason: &str,
    ) -> impl Future<Output = Result<bool, Error>> + Send + 'static {
        let (structure, id, reason) = (structure.to_string(), batch_id.to_owned(), reason.to_owned());
        let version = version.clone();
        self.write(move |connection| {
            Box::pin(async move {
                if !super::structure::is_present(connection, &structure, &version).await? {
                    return Ok(false);
                }
                sqlx::query(
                    "update measurement_batch set state = 'failed', failure = ? where structure_id = ? and batch_id = ?",
                )
                .bind(reason)
                .bind(structure)
                .bind(id)
                .execute(&mut *connection)
                .await?;
                Ok(true)
            })
        })
    }
}

/// What is stored of a batch that came in.
#[derive(FromRow)]
struct FoundRow {
    structure_is_known: bool,
    /// The batch of its key.
    key_batch: Option<String>,
    key_digest: Option<String>,
    /// The batch that has one of its measurements, and which.
    ordinal: Option<i64>,
    holder_batch: Option<String>,
    holder_digest: Option<String>,
    /// Frequencies of the last measurement of its source before it.
    previous: Option<Vec<u8>>,
}

/// What becomes of a batch; one that is to be inserted is not stored yet.
async fn find_stored(
    connection: &mut SqliteConnection,
    batch: &MeasurementBatch,
    digest: Digest,
) -> Result<InsertBatch, Error> {
    let structure = batch.structure.as_str();
    let times: Vec<i64> = batch.measurements.iter().map(|m| m.measured_at.micros()).collect();
    let found: FoundRow = sqlx::query_as(
        "select exists (select 1 from structure where structure_id = ?1) as structure_is_known,
                k.batch_id as key_batch, k.content_digest as key_digest,
                h.ordinal, h.batch_id as holder_batch, h.content_digest as holder_digest,
                (select frequency_hz from measurement where structure_id = ?1 and source = ?2 and measured_at_us < ?5
                    order by measured_at_us desc limit 1) as previous
         from (select 1)
         left join measurement_batch k on k.structure_id = ?1 and k.idempotency_key = ?4
         left join (select t.key as ordinal, b.batch_id, b.content_digest from json_each(?3) t
                    cross join measurement m on m.structure_id = ?1 and m.source = ?2 and m.measured_at_us = t.value
                    join measurement_batch b on b.structure_id = m.structure_id and b.batch_id = m.batch_id
                    order by t.key limit 1) h on true",
    )
    .bind(structure)
    .bind(&batch.source)
    .bind(serde_json::to_string(&times).map_err(|e| bad_row("batch")(&e))?)
    .bind(&batch.idempotency_key)
    .bind(batch.time_span().0.micros())
    .fetch_one(&mut *connection)
    .await?;
    if !found.structure_is_known {
        return Err(Error::UnknownStructure(structure.to_owned()));
    }
    if let (Some(batch_id), Some(content)) = (found.key_batch, found.key_digest) {
        let same = content == digest.as_str();
        return Ok(if same { InsertBatch::Replayed(batch_id) } else { InsertBatch::KeyConflict { batch_id } });
    }
    if let (Some(ordinal), Some(batch_id), Some(content)) = (found.ordinal, found.holder_batch, found.holder_digest) {
        // Equal digests mean equal measurements: if one of them is in that batch, all are.
        if content == digest.as_str() {
            return Ok(InsertBatch::Replayed(batch_id));
        }
        let ordinal = ordinal as usize;
        let measured_at = batch.measurements[ordinal].measured_at;
        return Ok(InsertBatch::MeasurementConflict { ordinal, measured_at, batch_id });
    }
    // What comes in is stored, whatever became of what is there.
    let readable = |blob: Vec<u8>| frequencies("measurement", &blob).inspect_err(|e| tracing::warn!("{e}")).ok();
    let previous = found.previous.and_then(readable);
    Ok(InsertBatch::Inserted { content_digest: digest, previous })
}

/// Statements that insert measurements; structure, batch and source are common to all rows.
static INSERT_MEASUREMENTS: InsertStatements = InsertStatements::new("insert into measurement", 10, &[0, 1, 3]);

async fn insert(
    connection: &mut SqliteConnection,
    batch: &MeasurementBatch,
    digest: &Digest,
    batch_id: &str,
    received_at: Timestamp,
) -> Result<(), Error> {
    let (from, to) = batch.time_span();
    sqlx::query(
        "insert into measurement_batch (structure_id, batch_id, source, idempotency_key, content_digest, received_at_us,
             measured_from_us, measured_to_us, measurement_count, state)
         values (?, ?, ?, ?, ?, ?, ?, ?, ?, 'received')",
    )
    .bind(batch.structure.as_str())
    .bind(batch_id)
    .bind(&batch.source)
    .bind(&batch.idempotency_key)
    .bind(digest.as_str())
    .bind(received_at.micros())
    .bind(from.micros())
    .bind(to.micros())
    .bind(batch.measurements.len() as i64)
    .execute(&mut *connection)
    .await?;
    let json = |value: Result<String, serde_json::Error>| value.map_err(|e| bad_row("measurement")(&e));
    for rows in parts(batch.measurements.len()) {
        let mut insert = sqlx::query(INSERT_MEASUREMENTS.of(rows.len()))
            .bind(batch.structure.as_str())
            .bind(batch_id)
            .bind(&batch.source);
        for ordinal in rows {
            let m = &batch.measurements[ordinal];
            let frequencies = m.frequencies_hz.iter().map(|f| f.map_or(f64::NAN, Hertz::get));
            let std = m.std_hz.as_ref().map(|stds| to_blob(stds.iter().map(|s| s.unwrap_or(f64::NAN))));
            insert = insert
                .bind(ordinal as i64)
                .bind(m.measured_at.micros())
                .bind(to_blob(frequencies))
                .bind(std)
                .bind(json(serde_json::to_string(&m.covariates))?)
                .bind(json(serde_json::to_string(&m.settings))?)
                .bind(m.mode_shapes.as_ref().map(|s| json(serde_json::to_string(s))).transpose()?);
        }
        insert.execute(&mut *connection).await?;
        fault_point!("store::measurement", |_| Err(sqlx::Error::Io(std::io::Error::other("a fault")).into()));
    }
    Ok(())
}

/// Stores a batch of an archive under its own id; whether it was new.
pub(super) async fn import(
    connection: &mut SqliteConnection,
    batch_id: &str,
    batch: &MeasurementBatch,
    received_at: Timestamp,
) -> Result<bool, Error> {
    let digest = batch.content_digest();
    let other = |there: &str| bad_row("batch of the archive")(&format!("batch {batch_id} is here as {there}"));
    let holder: Option<(String,)> =
        sqlx::query_as("select content_digest from measurement_batch where structure_id = ? and batch_id = ?")
            .bind(batch.structure.as_str())
            .bind(batch_id)
            .fetch_optional(&mut *connection)
            .await?;
    if let Some((content,)) = holder {
        return if content == digest.as_str() { Ok(false) } else { Err(other("a batch of other content")) };
    }
    match find_stored(connection, batch, digest).await? {
        InsertBatch::Inserted { content_digest, .. } => {
            insert(connection, batch, &content_digest, batch_id, received_at).await.map(|()| true)
        }
        InsertBatch::Replayed(there)
        | InsertBatch::KeyConflict { batch_id: there }
        | InsertBatch::MeasurementConflict { batch_id: there, .. } => Err(other(&there)),
    }
}

/// The measurement of a row.
pub(super) fn measurement(row: MeasurementRow) -> Result<ModalMeasurement, Error> {
    let what = "measurement";
    let std = row.std_hz.map(|blob| from_blob(what, &blob)).transpose()?;
    Ok(ModalMeasurement {
        measured_at: timestamp(what, row.measured_at_us)?,
        frequencies_hz: frequencies(what, &row.frequency_hz)?,
        std_hz: std.map(|values| values.into_iter().map(|s| Some(s).filter(|s| !s.is_nan())).collect()),
        mode_shapes: mode_shapes(row.mode_shapes.as_deref())?,
        covariates: serde_json::from_str(&row.covariates).map_err(|e| bad_row(what)(&e))?,
        settings: serde_json::from_str(&row.settings).map_err(|e| bad_row(what)(&e))?,
    })
}

/// The mode shapes of a row.
pub(super) fn mode_shapes(json: Option<&str>) -> Result<Option<Vec<Option<Vec<f64>>>>, Error> {
    json.map(|text| serde_json::from_str(text).map_err(|e| bad_row("mode shapes")(&e))).transpose()
}

fn frequencies(what: &'static str, blob: &[u8]) -> Result<Vec<Option<Hertz>>, Error> {
    let frequency = |value: f64| match value {
        missing if missing.is_nan() => Ok(None),
        value => Hertz::new(value).map(Some).map_err(|e| bad_row(what)(&e)),
    };
    from_blob(what, blob)?.into_iter().map(frequency).collect()
}

/// The state of its name.
pub(super) fn batch_state(name: &str) -> Result<BatchState, Error> {
    let states = [BatchState::Received, BatchState::Assessed, BatchState::Failed];
    states.into_iter().find(|s| s.as_str() == name).ok_or_else(|| bad_row("batch")(&name))
}
