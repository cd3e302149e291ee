//! What is stored of a batch beside its measurements.

use sqlx::FromRow;

use super::batch::Batches;
use super::batch_state::batch_state;
use super::column::timestamp;
use super::error::Error;
use crate::assessment::BatchState;
use crate::quantity::{Digest, StructureId, Timestamp};

/// A stored batch without its measurements, which can be read although a measurement is damaged.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct BatchHeader {
    /// Its id.
    pub batch_id: String,
    /// Its structure.
    pub structure: StructureId,
    /// Where its measurements come from.
    pub source: String,
    /// Digest of its content.
    pub content_digest: Digest,
    /// When it arrived.
    pub received_at: Timestamp,
    /// Time of its first measurement.
    pub measured_from: Timestamp,
    /// Time of its last measurement.
    pub measured_to: Timestamp,
    /// Number of its measurements.
    pub measurement_count: usize,
    /// Its state.
    pub state: BatchState,
    /// Id of the token with which it was posted.
    pub posted_by: Option<String>,
}

#[derive(FromRow)]
struct HeaderRow {
    source: String,
    content_digest: String,
    received_at_us: i64,
    measured_from_us: i64,
    measured_to_us: i64,
    measurement_count: i64,
    state: String,
    posted_by: Option<String>,
}

impl Batches<'_> {
    /// A batch without its measurements.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn header(self, structure: &StructureId, batch_id: &str) -> Result<Option<BatchHeader>, Error> {
        let row: Option<HeaderRow> = super::sql::query_as(
            "select source, content_digest, received_at_us, measured_from_us, measured_to_us, measurement_count, state,
                    posted_by
             from measurement_batch where structure_id = $1 and batch_id = $2",
        )
        .bind(structure.as_str())
        .bind(batch_id)
        .fetch_optional(&self.database.reader)
        .await?;
        let header = |row: HeaderRow| {
            Ok(BatchHeader {
                batch_id: batch_id.to_owned(),
                structure: structure.clone(),
                source: row.source,
                content_digest: Digest::from_stored(row.content_digest),
                received_at: timestamp("batch", row.received_at_us)?,
                measured_from: timestamp("batch", row.measured_from_us)?,
                measured_to: timestamp("batch", row.measured_to_us)?,
                measurement_count: row.measurement_count.unsigned_abs() as usize,
                state: batch_state(&row.state)?,
                posted_by: row.posted_by,
            })
        };
        row.map(header).transpose()
    }
}
