//! Pages of measurements in the order of the first measurement of their batch, and within a batch in the order of arrival.

use sqlx::FromRow;

use super::batch::Batches;
use super::column::timestamp;
use super::damaged::Page;
use super::error::Error;
use super::measurement_row::{measurement, MeasurementRow};
use super::sql::{self, Row, Whole};
use crate::measurement::ModalMeasurement;
use crate::quantity::{StructureId, Timestamp};

/// Selects measurements.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct MeasurementQuery {
    /// Taken at or after this time.
    pub from: Option<Timestamp>,
    /// Taken before this time.
    pub to: Option<Timestamp>,
    /// Largest number of measurements.
    pub limit: usize,
    /// Measurements after this position.
    pub after: Option<MeasurementPlace>,
}

/// Position of a measurement in the order of the pages.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MeasurementPlace {
    /// Time of the first measurement of its batch.
    pub batch_from: Timestamp,
    /// Its batch.
    pub batch_id: String,
    /// Its index in the batch, from 0.
    pub ordinal: u32,
}

/// A stored measurement with its source.
#[derive(Debug, Clone, PartialEq)]
pub struct StoredMeasurement {
    /// Its position.
    pub place: MeasurementPlace,
    /// Source of its batch.
    pub source: String,
    /// The measurement.
    pub measurement: ModalMeasurement,
}

#[derive(FromRow)]
struct StoredMeasurementRow {
    batch_id: String,
    measured_from_us: i64,
    ordinal: Whole<u32>,
    source: String,
    #[sqlx(flatten)]
    measurement: MeasurementRow,
}

impl Batches<'_> {
    /// A page of measurements. There is no transaction across pages: batches that arrive while a reader goes through the pages
    /// are returned if they are after the position it has reached.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn measurements(
        self,
        structure: &StructureId,
        query: &MeasurementQuery,
    ) -> Result<Vec<StoredMeasurement>, Error> {
        let after = query.after.as_ref();
        let page = Page {
            limit: query.limit,
            behind: (
                after.map_or("", |place| &place.batch_id).to_owned(),
                after.map_or(i64::MIN, |place| place.batch_from.micros()),
                after.map_or(-1, |place| i64::from(place.ordinal)),
            ),
            names: 1,
        };
        let select =
            "select b.batch_id, b.measured_from_us, m.ordinal, m.source, m.measured_at_us, m.frequency_hz, m.std_hz,
                    m.mode_shapes, m.covariates, m.settings
             from measurement_batch b
             join measurement m using (structure_id, batch_id)
             where b.structure_id = $1 and b.measured_from_us >= $2 and b.measured_from_us < $3
               and b.measured_to_us >= $4 and m.measured_at_us >= $4 and m.measured_at_us < $3
               and (b.measured_from_us, b.batch_id, m.ordinal) > ($2, $5, $6)
             order by b.measured_from_us, b.batch_id, m.ordinal limit $7";
        let statement = |(batch, from, ordinal): &(String, i64, i64), limit: i64| {
            sql::query_as(select)
                .bind(structure.as_str())
                .bind(*from)
                .bind(query.to.map_or(i64::MAX, Timestamp::micros))
                .bind(query.from.map_or(i64::MIN, Timestamp::micros))
                .bind(batch)
                .bind(*ordinal)
                .bind(limit)
        };
        let place = |row: &Row| Ok((row.get(0)?, row.get(1)?, row.get(2)?));
        let stored = |row: StoredMeasurementRow| {
            let batch_from = timestamp("batch", row.measured_from_us)?;
            let place = MeasurementPlace { batch_from, batch_id: row.batch_id, ordinal: row.ordinal.0 };
            Ok(StoredMeasurement { place, source: row.source, measurement: measurement(row.measurement)? })
        };
        self.database.damaged.page(&self.database.reader, page, statement, place, stored).await
    }
}
