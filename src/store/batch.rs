//! Batches and their measurements.

use std::future::Future;

use sqlx::FromRow;
use tokio::sync::oneshot;

use super::batch_id::following;
use super::batch_state::batch_state;
use super::column::{bad_row, elements, list, timestamp, to_blob};
use super::database::Database;
use super::earlier::earlier;
use super::error::Error;
use super::late::{outdate, Before};
use super::measurement_row::{measurement, MeasurementRow};
use super::rows::{parts, RowStatements};
use super::sql::{self, Statements, Whole};
use super::transaction::Transaction;
use crate::assessment::{BatchState, Earlier};
use crate::measurement::{MeasurementBatch, ModalMeasurement};
use crate::quantity::{Digest, Hertz, StructureId, Timestamp};

/// The outcome of storing a batch.
#[derive(Debug, Clone, PartialEq)]
pub enum InsertBatch {
    /// The batch is stored.
    Inserted {
        /// Its id: that which was given, unless the clock was set back since the newest batch of its structure was stored.
        batch_id: String,
        /// Digest of its content.
        content_digest: Digest,
        /// Whether it has arrived so late that batches which were assessed wait for another assessment now.
        outdates: bool,
    },
    /// The same batch was already stored under this id.
    Replayed(String),
    /// The present version of its structure is another one than it was checked against; nothing was stored.
    AnotherVersion,
    /// Its idempotency key belongs to a batch of different content; nothing was stored.
    KeyConflict {
        /// The other batch.
        batch_id: String,
    },
    /// One of its measurements is part of a batch of different content; nothing was stored.
    MeasurementConflict {
        /// Index of the measurement in the batch.
        ordinal: usize,
        /// Its time.
        measured_at: Timestamp,
        /// The other batch.
        batch_id: String,
    },
}

/// A stored batch.
#[derive(Debug, Clone, PartialEq)]
pub struct BatchRecord {
    /// Its id.
    pub batch_id: String,
    /// Its measurements.
    pub batch: MeasurementBatch,
    /// Digest of its content.
    pub content_digest: Digest,
    /// When it arrived.
    pub received_at: Timestamp,
    /// Its state.
    pub state: BatchState,
    /// Why its assessment failed.
    pub failure: Option<String>,
    /// Version of the undamaged reference that it is compared with next, instead of the newest one; 0: with none.
    pub kept_reference: Option<u32>,
}

#[derive(FromRow)]
struct BatchRow {
    source: String,
    idempotency_key: Option<String>,
    content_digest: String,
    received_at_us: i64,
    state: String,
    failure: Option<String>,
    kept_reference: Option<Whole<u32>>,
    posted_by: Option<String>,
}

/// Batches and their measurements.
#[derive(Clone, Copy)]
pub struct Batches<'s> {
    pub(super) database: &'s Database,
}

impl Batches<'_> {
    /// Stores a batch completely or not at all, unless it is stored already. Assessed batches whose assessment it can change wait for another one.
    ///
    /// A batch with an idempotency key that is known of its source is identified by the key, any other batch by the source and the times
    /// of its measurements.
    ///
    /// # Errors
    /// [`Error::UnknownStructure`], [`Error::Sqlite`].
    pub async fn insert_batch(
        self,
        batch: &MeasurementBatch,
        batch_id: &str,
        received_at: Timestamp,
    ) -> Result<InsertBatch, Error> {
        let (speculative, _) = oneshot::channel();
        self.insert_batch_speculative(batch, batch_id, received_at, (None, speculative)).await
    }

    /// As [`Self::insert_batch`], only under the version `checked_against`, and sends the `speculative` outcome before the transaction is committed, so that the caller can
    /// begin further work in the meantime. It is the outcome unless the transaction fails.
    ///
    /// # Errors
    /// As [`Self::insert_batch`].
    pub fn insert_batch_speculative(
        self,
        batch: &MeasurementBatch,
        batch_id: &str,
        received_at: Timestamp,
        (checked_against, speculative): (Option<&Digest>, oneshot::Sender<InsertBatch>),
    ) -> impl Future<Output = Result<InsertBatch, Error>> + Send + 'static {
        let (batch, id, version) = (batch.clone(), batch_id.to_owned(), checked_against.cloned());
        self.database.write(move |transaction| {
            Box::pin(async move {
                let digest = batch.content_digest();
                let (mut found, is_followed) =
                    find_stored(transaction, &batch, (&id, digest), version.as_ref()).await?;
                // Sending fails if the receiver was dropped.
                let _ = speculative.send(found.clone());
                if let InsertBatch::Inserted { batch_id, content_digest, outdates } = &mut found {
                    insert(transaction, &batch, content_digest, batch_id, received_at).await?;
                    *outdates = is_followed && outdate(transaction, &batch, batch_id).await?;
                }
                Ok(found)
            })
        })
    }

    /// One batch with its measurements.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn batch(self, structure: &StructureId, batch_id: &str) -> Result<Option<BatchRecord>, Error> {
        match self.read_batch(structure, batch_id).await {
            // A batch that is deleted between the two statements looks like one without measurements, and a page that was read wrongly
            // may be right the next time: only what is wrong twice is damaged.
            Err(Error::Row { .. }) => self.read_batch(structure, batch_id).await,
            read => read,
        }
    }

    /// State and digest of the content of a batch, without its measurements.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn state(self, structure: &StructureId, batch_id: &str) -> Result<Option<(BatchState, Digest)>, Error> {
        fault_point!("store::read", |_| Err(super::error::unreadable()));
        let row: Option<(String, String)> = sql::query_as(
            "select state, content_digest from measurement_batch where structure_id = $1 and batch_id = $2",
        )
        .bind(structure.as_str())
        .bind(batch_id)
        .fetch_optional(&self.database.reader)
        .await?;
        row.map(|(state, digest)| Ok((batch_state(&state)?, Digest::from_stored(digest)))).transpose()
    }

    async fn read_batch(self, structure: &StructureId, batch_id: &str) -> Result<Option<BatchRecord>, Error> {
        let row: Option<BatchRow> = sql::query_as(
            "select source, idempotency_key, content_digest, received_at_us, state, failure, posted_by,
                    (select undamaged_version from kept_comparison k where k.structure_id = $1 and k.batch_id = $2
                        order by position limit 1) as kept_reference
             from measurement_batch where structure_id = $1 and batch_id = $2",
        )
        .bind(structure.as_str())
        .bind(batch_id)
        .fetch_optional(&self.database.reader)
        .await?;
        let Some(row) = row else { return Ok(None) };
        fault_point!("store::read", |_| Err(super::error::unreadable()));
        let measurements: Vec<MeasurementRow> = sql::query_as(
            "select measured_at_us, frequency_hz, std_hz, mode_shapes, covariates, settings
             from measurement where structure_id = $1 and batch_id = $2 order by ordinal",
        )
        .bind(structure.as_str())
        .bind(batch_id)
        .fetch_all(&self.database.reader)
        .await?;
        let batch = MeasurementBatch {
            structure: structure.clone(),
            source: row.source,
            idempotency_key: row.idempotency_key,
            posted_by: row.posted_by,
            measurements: measurements.into_iter().map(measurement).collect::<Result<_, _>>()?,
        };
        let content_digest = Digest::from_stored(row.content_digest);
        // SQLite has no checksums: a flipped bit on the disk would be returned as a measurement.
        if batch.measurements.is_empty() || batch.content_digest() != content_digest {
            let detail = "its measurements do not match its digest: the database is damaged";
            return Err(bad_row("batch")(&detail));
        }
        Ok(Some(BatchRecord {
            batch_id: batch_id.to_owned(),
            batch,
            content_digest,
            received_at: timestamp("batch", row.received_at_us)?,
            state: batch_state(&row.state)?,
            failure: row.failure,
            kept_reference: row.kept_reference.map(|version| version.0),
        }))
    }

    /// Frequencies that were measured before a batch of some measurements which begins at `from`.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn earlier(
        self,
        structure: &StructureId,
        source: &str,
        (from, measurements): (Timestamp, usize),
    ) -> Result<Earlier, Error> {
        fault_point!("store::read", |_| Err(super::error::unreadable()));
        earlier(&self.database.reader, structure.as_str(), source, (from.micros(), measurements)).await
    }

    /// As [`Self::earlier`], for an assessment that is not stored if what was measured before changes meanwhile.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn before(
        self,
        structure: &StructureId,
        source: &str,
        place: (Timestamp, usize),
    ) -> Result<Before, Error> {
        // Read first: a batch that is stored between the two counts as one that was not seen.
        let newest: Option<(String,)> = sql::query_as(
            "select batch_id from measurement_batch where structure_id = $1 order by batch_id desc limit 1",
        )
        .bind(structure.as_str())
        .fetch_optional(&self.database.reader)
        .await?;
        let newest = newest.map(|(id,)| id).unwrap_or_default();
        Ok(Before { earlier: self.earlier(structure, source, place).await?, newest })
    }

    /// Batches of a structure that wait for their assessment, oldest first; before them those that keep an undamaged reference, by its
    /// version.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn pending(self, structure: &StructureId, limit: usize) -> Result<Vec<String>, Error> {
        let kept: Vec<(String,)> = sql::query_as(
            "select b.batch_id from kept_comparison k join measurement_batch b using (structure_id, batch_id)
             where structure_id = $1 and b.state = 'received' and k.position =
                 (select min(position) from kept_comparison f where f.structure_id = $1 and f.batch_id = b.batch_id)
             order by k.undamaged_version, b.received_at_us, b.batch_id limit $2",
        )
        .bind(structure.as_str())
        .bind(limit as i64)
        .fetch_all(&self.database.reader)
        .await?;
        if !kept.is_empty() {
            return Ok(kept.into_iter().map(|(id,)| id).collect());
        }
        let rows: Vec<(String,)> = sql::query_as(
            "select batch_id from measurement_batch where structure_id = $1 and state = 'received'
             order by received_at_us, batch_id limit $2",
        )
        .bind(structure.as_str())
        .bind(limit as i64)
        .fetch_all(&self.database.reader)
        .await?;
        Ok(rows.into_iter().map(|(id,)| id).collect())
    }

    /// All batches of a structure with their numbers of measurements, in the order of their first measurement.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn batch_sizes(self, structure: &StructureId) -> Result<Vec<(String, usize)>, Error> {
        let rows: Vec<(String, i64)> = sql::query_as(
            "select batch_id, measurement_count from measurement_batch where structure_id = $1
             order by measured_from_us, batch_id",
        )
        .bind(structure.as_str())
        .fetch_all(&self.database.reader)
        .await?;
        Ok(rows.into_iter().map(|(id, count)| (id, count.unsigned_abs() as usize)).collect())
    }

    /// Measurements of several batches.
    ///
    /// # Errors
    /// [`Error::UnknownBatch`], [`Error::Sqlite`], [`Error::Row`].
    pub async fn measurements_of(
        self,
        structure: &StructureId,
        batches: &[String],
    ) -> Result<Vec<ModalMeasurement>, Error> {
        let mut all = Vec::new();
        for id in batches {
            let unknown = || Error::UnknownBatch { structure: structure.to_string(), batch: id.clone() };
            all.extend(self.batch(structure, id).await?.ok_or_else(unknown)?.batch.measurements);
        }
        Ok(all)
    }
}

/// What is already stored of a batch that arrives.
#[derive(FromRow)]
struct FoundRow {
    structure_is_known: bool,
    structure_digest: Option<String>,
    /// Id of the batch of the structure that was stored last.
    newest_batch: Option<String>,
    /// Whether batches are stored that were measured after it.
    is_followed: bool,
    /// The batch of its source with its idempotency key.
    key_batch: Option<String>,
    key_digest: Option<String>,
    /// Index of the first of its measurements that is stored, and the batch that contains it.
    ordinal: Option<i64>,
    holder_batch: Option<String>,
    holder_digest: Option<String>,
}

/// Determines the outcome of storing a batch under an id that was made by the clock, without inserting it, and whether batches are stored that were
/// measured after it.
async fn find_stored(
    transaction: &mut Transaction<'_>,
    batch: &MeasurementBatch,
    (own_id, digest): (&str, Digest),
    version: Option<&Digest>,
) -> Result<(InsertBatch, bool), Error> {
    let structure = batch.structure.as_str();
    let times: Vec<i64> = batch.measurements.iter().map(|m| m.measured_at.micros()).collect();
    // Each time is looked up by itself, in the order of the index: as a join, or by equality, a server reads all measurements of the source.
    let found: FoundRow = sql::query_as(concat!(
        "select exists (select 1 from structure s where s.structure_id = $1 and not exists
                    (select 1 from structure_deletion d where d.structure_id = s.structure_id)) as structure_is_known,
                (select s.digest from structure s where s.structure_id = $1) as structure_digest,
                (select n.batch_id from measurement_batch n where n.structure_id = $1 order by n.batch_id desc limit 1) as newest_batch,
                exists (select 1 from measurement_batch a where a.structure_id = $1 and a.measured_from_us >= $5
                    and (a.measured_from_us > $5 or a.source > $2)) as is_followed,
                k.batch_id as key_batch, k.content_digest as key_digest,
                h.ordinal, h.batch_id as holder_batch, h.content_digest as holder_digest
         from (select 1 as one) o
         left join measurement_batch k on k.structure_id = $1 and k.batch_id = case when $4 is null then null else coalesce(
             (select batch_id from measurement_batch where structure_id = $1 and source = $2 and idempotency_key = $4),
             (select f.batch_id from further_key f where f.structure_id = $1 and f.idempotency_key = $4 and $2 =
                  (select b.source from measurement_batch b where b.structure_id = $1 and b.batch_id = f.batch_id) limit 1)) end
         left join (select f.ordinal, f.batch_id,
                        (select content_digest from measurement_batch b where b.structure_id = $1 and b.batch_id = f.batch_id)
                            as content_digest
                    from (select t.key as ordinal,
                              (select case when m.measured_at_us = cast(t.value as bigint) then m.batch_id end from measurement m
                                   where m.structure_id = $1 and m.source = $2 and m.measured_at_us >= cast(t.value as bigint)
                                   order by m.measured_at_us limit 1) as batch_id
                          from ",
        elements!("$3"),
        " t) f
                    where f.batch_id is not null order by f.ordinal limit 1) h on true",
    ))
    .bind(structure)
    .bind(&batch.source)
    .bind(list(&times))
    .bind(&batch.idempotency_key)
    .bind(batch.time_span().0.micros())
    .fetch_one(&mut *transaction)
    .await?;
    if !found.structure_is_known {
        return Err(Error::UnknownStructure(structure.to_owned()));
    }
    let is_followed = found.is_followed;
    if let (Some(batch_id), Some(content)) = (found.key_batch, found.key_digest) {
        let same = content == digest.as_str();
        let outcome = if same { InsertBatch::Replayed(batch_id) } else { InsertBatch::KeyConflict { batch_id } };
        return Ok((outcome, is_followed));
    }
    if let (Some(ordinal), Some(batch_id), Some(content)) = (found.ordinal, found.holder_batch, found.holder_digest) {
        if content == digest.as_str() {
            remember_key(transaction, batch, &batch_id).await?;
            return Ok((InsertBatch::Replayed(batch_id), is_followed));
        }
        let ordinal = ordinal as usize;
        let measured_at = batch.measurements[ordinal].measured_at;
        return Ok((InsertBatch::MeasurementConflict { ordinal, measured_at, batch_id }, is_followed));
    }
    if version.is_some_and(|version| found.structure_digest.as_deref() != Some(version.as_str())) {
        return Ok((InsertBatch::AnotherVersion, is_followed));
    }
    let batch_id = following(found.newest_batch.as_deref(), own_id);
    Ok((InsertBatch::Inserted { batch_id, content_digest: digest, outdates: false }, is_followed))
}

/// Binds the key of a batch that was stored before without it to the stored batch: once answered, a key means this content.
async fn remember_key(transaction: &mut Transaction<'_>, batch: &MeasurementBatch, stored: &str) -> Result<(), Error> {
    let Some(key) = &batch.idempotency_key else { return Ok(()) };
    sql::query("insert into further_key values ($1, $2, $3) on conflict do nothing")
        .bind(batch.structure.as_str())
        .bind(key)
        .bind(stored)
        .execute(&mut *transaction)
        .await?;
    Ok(())
}

/// Statements that insert measurements. Structure, batch and source are the same in all rows.
static INSERT_MEASUREMENTS: RowStatements = RowStatements::new("insert into measurement ", 10, &[0, 1, 3]);

async fn insert(
    transaction: &mut Transaction<'_>,
    batch: &MeasurementBatch,
    digest: &Digest,
    batch_id: &str,
    received_at: Timestamp,
) -> Result<(), Error> {
    let (from, to) = batch.time_span();
    let head = sql::query(
        "insert into measurement_batch (structure_id, batch_id, source, idempotency_key, content_digest, received_at_us,
             measured_from_us, measured_to_us, measurement_count, state, posted_by)
         values ($1, $2, $3, $4, $5, $6, $7, $8, $9, 'received', $10)",
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
    .bind(&batch.posted_by);
    let mut statements = Statements::default().and(head);
    let json = |value: Result<String, serde_json::Error>| value.map_err(|e| bad_row("measurement")(&e));
    for rows in parts(batch.measurements.len()) {
        let mut insert = sql::query(INSERT_MEASUREMENTS.of(rows.len()))
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
        statements = statements.and(insert);
        // A large batch is not one large statement, and a fault may come in its middle.
        std::mem::take(&mut statements).execute(&mut *transaction).await?;
        fault_point!("store::measurement", |_| Err(sqlx::Error::Io(std::io::Error::other("a fault")).into()));
    }
    Ok(())
}

/// Stores a batch of an archive under its own id. Returns whether it was new.
pub(super) async fn import_batch(
    transaction: &mut Transaction<'_>,
    batch_id: &str,
    batch: &MeasurementBatch,
    received_at: Timestamp,
) -> Result<bool, Error> {
    let digest = batch.content_digest();
    let other =
        |there: &str| bad_row("batch of the archive")(&format!("batch {batch_id} is already stored here as {there}"));
    let holder: Option<(String,)> =
        sql::query_as("select content_digest from measurement_batch where structure_id = $1 and batch_id = $2")
            .bind(batch.structure.as_str())
            .bind(batch_id)
            .fetch_optional(&mut *transaction)
            .await?;
    if let Some((content,)) = holder {
        return if content == digest.as_str() { Ok(false) } else { Err(other("a batch of different content")) };
    }
    let (found, is_followed) = find_stored(transaction, batch, (batch_id, digest), None).await?;
    match found {
        InsertBatch::Inserted { content_digest, .. } => {
            // An archive states the ids, which are in the order of arrival where it comes from.
            insert(transaction, batch, &content_digest, batch_id, received_at).await?;
            if is_followed {
                outdate(transaction, batch, batch_id).await?;
            }
            Ok(true)
        }
        InsertBatch::Replayed(there)
        | InsertBatch::KeyConflict { batch_id: there }
        | InsertBatch::MeasurementConflict { batch_id: there, .. } => Err(other(&there)),
        InsertBatch::AnotherVersion => Err(other("a batch of another version")),
    }
}
