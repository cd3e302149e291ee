//! Pages of batches and of exceedances. They are found by key and not by offset, so that late pages cost as much as early ones.

use sqlx::FromRow;

use super::assessment::Assessments;
use super::batch_state::batch_state;
use super::column::timestamp;
use super::current::CURRENT_FIRST;
use super::damaged::Page;
use super::database::Database;
use super::error::Error;
use super::sql::{self, Row, Whole};
use crate::assessment::{Assessment, BatchState};
use crate::quantity::{Digest, StructureId, Timestamp};

/// Selects part of the history.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct HistoryQuery {
    /// Batches that begin at or after this time.
    pub from: Option<Timestamp>,
    /// Batches that begin before this time.
    pub to: Option<Timestamp>,
    /// Only this quantity.
    pub parameter: Option<String>,
    /// Largest number of items.
    pub limit: usize,
    /// Items after this position: time of the first measurement and id of the last batch of the previous page.
    pub after: Option<(Timestamp, String)>,
    /// The quantity of the last item of the previous page, for exceedances, of which a batch can have several.
    pub after_quantity: Option<String>,
}

/// A batch of the history.
#[derive(Debug)]
pub struct HistoryEntry {
    /// Its id.
    pub batch_id: String,
    /// Its source.
    pub source: String,
    /// Time of its first measurement.
    pub measured_from: Timestamp,
    /// Time of its last measurement.
    pub measured_to: Timestamp,
    /// When it arrived.
    pub received_at: Timestamp,
    /// Number of its measurements.
    pub measurement_count: usize,
    /// Its state.
    pub state: BatchState,
    /// Why its assessment failed.
    pub failure: Option<String>,
    /// Its current assessment; `None` if there is none, or it cannot be read.
    pub assessment: Option<Assessment>,
    /// Why its current assessment cannot be read.
    pub unreadable: Option<Error>,
}

/// A probability of damage above that of the undamaged reference, in the current assessment of a batch.
#[derive(Debug, Clone, PartialEq)]
pub struct Exceedance {
    /// The batch.
    pub batch_id: String,
    /// Time of its first measurement.
    pub measured_from: Timestamp,
    /// Time of its last measurement.
    pub measured_to: Timestamp,
    /// The quantity.
    pub quantity: String,
    /// Its unit.
    pub unit: String,
    /// Its probability of damage.
    pub probability_of_damage: f64,
    /// The probability that is exceeded.
    pub threshold_probability: f64,
    /// Threshold δ, in the unit of the quantity.
    pub threshold: f64,
    /// (μ − μ_ud)/μ_ud, with the mean μ_ud of the undamaged reference.
    pub relative_change: f64,
    /// Version of the undamaged reference.
    pub undamaged_version: u32,
    /// Digest of the trained baseline.
    pub model_digest: Digest,
}

#[derive(FromRow)]
struct EntryRow {
    batch_id: String,
    source: String,
    measured_from_us: i64,
    measured_to_us: i64,
    received_at_us: i64,
    measurement_count: i64,
    state: String,
    failure: Option<String>,
}

#[derive(FromRow)]
struct ExceedanceRow {
    batch_id: String,
    measured_from_us: i64,
    measured_to_us: i64,
    quantity: String,
    unit: String,
    probability_of_damage: f64,
    threshold_probability: f64,
    threshold: f64,
    relative_change: f64,
    undamaged_version: Whole<u32>,
    model_digest: String,
}

/// Pages of batches and of exceedances.
#[derive(Clone, Copy)]
pub struct History<'s> {
    pub(super) database: &'s Database,
}

impl History<'_> {
    /// A page of batches with their current assessments, by (first measurement, id), oldest first.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn page(self, structure: &StructureId, query: &HistoryQuery) -> Result<Vec<HistoryEntry>, Error> {
        let behind = query.after.clone().map(|(time, batch)| (time.micros(), batch));
        let page = Page { limit: query.limit, behind, names: 1 };
        let select = "select batch_id, source, measured_from_us, measured_to_us, received_at_us, measurement_count, state, failure
             from measurement_batch
             where structure_id = $1 and measured_from_us >= $2 and measured_from_us < $3
               and (measured_from_us, batch_id) > ($4, $5)
             order by measured_from_us, batch_id limit $6";
        let statement = |after: &Option<(i64, String)>, limit: i64| {
            let after_time = after.as_ref().map_or(i64::MIN, |(time, _)| *time);
            sql::query_as(select)
                .bind(structure.as_str())
                // SQLite uses only one lower bound to search the index. Without this one it would read all earlier pages again.
                .bind(query.from.map_or(i64::MIN, Timestamp::micros).max(after_time))
                .bind(query.to.map_or(i64::MAX, Timestamp::micros))
                .bind(after_time)
                .bind(after.as_ref().map_or("", |(_, batch)| batch))
                .bind(limit)
        };
        let place = |row: &Row| Ok(Some((row.get(2)?, row.get(0)?)));
        let damaged = &self.database.damaged;
        let mut entries = damaged.page(&self.database.reader, page, statement, place, entry).await?;
        let ids: Vec<String> = entries.iter().map(|entry| entry.batch_id.clone()).collect();
        let mut assessments = Assessments { database: self.database }
            .current_assessments(structure, &ids, query.parameter.as_deref())
            .await?;
        for entry in &mut entries {
            match assessments.remove(&entry.batch_id) {
                Some(Ok(assessment)) => entry.assessment = Some(assessment),
                Some(Err(error)) => entry.unreadable = Some(error),
                None => {}
            }
        }
        Ok(entries)
    }

    /// A page of exceedances in current assessments, by (first measurement, id, quantity), newest first.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn exceedances(self, structure: &StructureId, query: &HistoryQuery) -> Result<Vec<Exceedance>, Error> {
        let quantity = query.after_quantity.clone().unwrap_or_default();
        let behind = query.after.clone().map(|(time, batch)| (time.micros(), batch, quantity));
        let page = Page { limit: query.limit, behind, names: 1 };
        let select = format!(
            "select b.batch_id, b.measured_from_us, b.measured_to_us, q.quantity, q.unit, q.probability_of_damage,
                    u.threshold_probability, q.threshold, q.relative_change, q.undamaged_version, q.model_digest
             from measurement_batch b
             join quantity_assessment q using (structure_id, batch_id)
             join undamaged_state u on u.structure_id = q.structure_id and u.version = q.undamaged_version
             where b.structure_id = $1 and b.measured_from_us >= $2 and b.measured_from_us < $3 and q.exceeds = 1
               and ($4 is null or (b.measured_from_us, b.batch_id, q.quantity) < ($4, $5, $6))
               and ($7 is null or q.quantity = $7)
               and (q.model_digest, q.undamaged_version) = (
                   select model_digest, undamaged_version from assessment a
                   where a.structure_id = b.structure_id and a.batch_id = b.batch_id
                   order by {CURRENT_FIRST} limit 1)
             order by b.measured_from_us desc, b.batch_id desc, q.quantity desc limit $8"
        );
        let statement = |before: &Option<(i64, String, String)>, limit: i64| {
            // As in `page`, plus one microsecond, because a batch with the same time can follow.
            let end = before.as_ref().map_or(i64::MAX, |(time, ..)| time.saturating_add(1));
            let to = query.to.map_or(i64::MAX, Timestamp::micros).min(end);
            sql::query_as(sqlx::AssertSqlSafe(select.clone()))
                .bind(structure.as_str())
                .bind(query.from.map_or(i64::MIN, Timestamp::micros))
                .bind(to)
                .bind(before.as_ref().map(|(time, ..)| *time))
                .bind(before.as_ref().map_or("", |(_, batch, _)| batch))
                .bind(before.as_ref().map_or("", |(.., quantity)| quantity))
                .bind(query.parameter.clone())
                .bind(limit)
        };
        let place = |row: &Row| Ok(Some((row.get(1)?, row.get(0)?, row.get(3)?)));
        let exceedance = |row: ExceedanceRow| {
            Ok(Exceedance {
                batch_id: row.batch_id,
                measured_from: timestamp("batch", row.measured_from_us)?,
                measured_to: timestamp("batch", row.measured_to_us)?,
                quantity: row.quantity,
                unit: row.unit,
                probability_of_damage: row.probability_of_damage,
                threshold_probability: row.threshold_probability,
                threshold: row.threshold,
                relative_change: row.relative_change,
                undamaged_version: row.undamaged_version.0,
                model_digest: Digest::from_stored(row.model_digest),
            })
        };
        self.database.damaged.page(&self.database.reader, page, statement, place, exceedance).await
    }
}

/// The batch of a row, without its assessment.
fn entry(row: EntryRow) -> Result<HistoryEntry, Error> {
    Ok(HistoryEntry {
        batch_id: row.batch_id,
        source: row.source,
        measured_from: timestamp("batch", row.measured_from_us)?,
        measured_to: timestamp("batch", row.measured_to_us)?,
        received_at: timestamp("batch", row.received_at_us)?,
        measurement_count: row.measurement_count as usize,
        state: batch_state(&row.state)?,
        failure: row.failure,
        assessment: None,
        unreadable: None,
    })
}
