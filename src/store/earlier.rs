//! What was measured before a batch, by which copies and repetitions are found.
//!
//! Batches are in the order of their first measurements and, where these have the same time, of their sources. A source has one measurement at a
//! time, so that no two batches of a structure have the same place, and when they arrived has no influence on it.

use std::collections::BTreeMap;

use super::column::{elements, list};
use super::error::Error;
use super::measurement_row::frequencies;
use super::sql::{self, On};
use super::transaction::Transaction;
use crate::assessment::Earlier;
use crate::quantity::Hertz;

/// Frequencies of a measurement, `[modes]`.
pub(super) type Row = Vec<Option<Hertz>>;

/// The frequencies of a blob. A batch is assessed even if an earlier measurement cannot be decoded.
pub(super) fn readable(blob: &[u8]) -> Option<Row> {
    frequencies("measurement", blob).inspect_err(|e| tracing::warn!("{e}")).ok()
}

/// Frequencies that were measured before a batch of some measurements which begins at `from_us`.
pub(super) async fn earlier<'c>(
    on: impl Into<On<'c>>,
    structure: &str,
    source: &str,
    (from_us, measurements): (i64, usize),
) -> Result<Earlier, Error> {
    // A cross join is read in the order in which it is written: first the batches, in the order of their index.
    let rows: Vec<(bool, Vec<u8>)> = sql::query_as(
        "select is_previous, frequency_hz from (select * from (select 1 = 1 as is_previous, measured_at_us as from_us, source,
                      measured_at_us, frequency_hz from measurement
                  where structure_id = $1 and source = $2 and measured_at_us < $3 order by measured_at_us desc limit 1) p
              union all
              select * from (select 1 = 0 as is_previous, b.measured_from_us as from_us, b.source, m.measured_at_us, m.frequency_hz
                  from measurement_batch b cross join measurement m
                  where b.structure_id = $1 and b.measured_from_us <= $3 and (b.measured_from_us < $3 or b.source < $2)
                      and m.structure_id = $1 and m.batch_id = b.batch_id
                  order by b.measured_from_us desc, b.source desc, m.measured_at_us desc limit $4) r) all_rows
         order by from_us, source, measured_at_us",
    )
    .bind(structure)
    .bind(source)
    .bind(from_us)
    .bind(Earlier::compared_with(measurements) as i64)
    .fetch_all(on)
    .await?;
    let (previous, rows): (Vec<_>, Vec<_>) = rows.into_iter().partition(|(is_previous, _)| *is_previous);
    let decoded = |rows: Vec<(bool, Vec<u8>)>| rows.iter().filter_map(|(_, blob)| readable(blob)).collect::<Vec<_>>();
    Ok(Earlier { previous: decoded(previous).pop(), rows: decoded(rows) })
}

/// The measurements of some batches, by batch and in the order of time.
pub(super) async fn rows_of(
    transaction: &mut Transaction<'_>,
    structure: &str,
    batches: &[&str],
) -> Result<BTreeMap<String, Vec<Row>>, Error> {
    let found: Vec<(String, Vec<u8>)> = sql::query_as(concat!(
        "select batch_id, frequency_hz from measurement where structure_id = $1 and batch_id in (select value from ",
        elements!("$2"),
        ") order by batch_id, measured_at_us",
    ))
    .bind(structure)
    .bind(list(batches))
    .fetch_all(&mut *transaction)
    .await?;
    let mut rows = BTreeMap::<String, Vec<Row>>::new();
    for (batch, blob) in found {
        rows.entry(batch).or_default().extend(readable(&blob));
    }
    Ok(rows)
}
