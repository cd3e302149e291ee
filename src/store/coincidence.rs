//! What coincides with the onset of a lasting change, apart from the structure: it may be the cause.

use std::collections::btree_map::{BTreeMap, Entry};
use std::collections::BTreeSet;

use sqlx::FromRow;

use super::column::{from_blob, timestamp};
use super::error::Error;
use super::sql;
use super::transaction::Transaction;
use crate::process::lasting::LastingChange;
use crate::quantity::{shown, Timestamp};

/// Batches before the onset whose rhythm, sources and modes are looked at.
const BEFORE: i64 = 20;

/// Batches from the onset on that are looked at.
const AFTER: i64 = 3;

/// A pause is a gap if it is longer than this multiple of the median of those before it.
const GAP: i64 = 4;

/// A mode is there in at least this share of the measurements, or is missing in as many.
const MOST: f64 = 0.9;

/// Measurements of a batch that show its modes.
const ROWS: i64 = 100;

/// Most notes and maintenance windows that are named.
const NAMED: i64 = 5;

/// Longest text of a note that is repeated, in characters.
const NOTE_LENGTH: usize = 120;

#[derive(FromRow)]
struct BatchRow {
    batch_id: String,
    source: String,
    measured_from_us: i64,
    measured_to_us: i64,
}

/// What coincides with the onsets that were asked for: the changes of successive batches have the same one.
#[derive(Default)]
pub(super) struct Coincidences {
    known: BTreeMap<[i64; 3], Vec<String>>,
}

impl Coincidences {
    /// States in a change of a structure what coincides with its onset: another source of the batches, a pause, modes that are missing or new,
    /// maintenance, and notes.
    pub async fn name(
        &mut self,
        transaction: &mut Transaction<'_>,
        structure: &str,
        change: Option<&mut LastingChange>,
    ) -> Result<(), Error> {
        let Some(change) = change else { return Ok(()) };
        let [from, to] = change.onset_interval.map(Timestamp::micros);
        let place = [from, to, change.onset.micros()];
        let known = match self.known.entry(place) {
            Entry::Occupied(known) => known.into_mut(),
            Entry::Vacant(unknown) => unknown.insert(coinciding(transaction, structure, place).await?),
        };
        change.coinciding.clone_from(known);
        Ok(())
    }
}

/// What coincides with an onset, which lies between two times, each in some words. A row that cannot be decoded is passed over: the batch that
/// shows the change is stored all the same.
async fn coinciding(
    transaction: &mut Transaction<'_>,
    structure: &str,
    [from, to, onset]: [i64; 3],
) -> Result<Vec<String>, Error> {
    let mut before: Vec<BatchRow> = sql::query_as(
        "select batch_id, source, measured_from_us, measured_to_us from measurement_batch
         where structure_id = $1 and measured_from_us < $2 and measured_to_us < $2
         order by measured_from_us desc, batch_id desc limit $3",
    )
    .bind(structure)
    .bind(onset)
    .bind(BEFORE)
    .fetch_all(&mut *transaction)
    .await?;
    before.reverse();
    let after: Vec<BatchRow> = sql::query_as(
        "select batch_id, source, measured_from_us, measured_to_us from measurement_batch
         where structure_id = $1 and measured_from_us > $2 and measured_to_us >= $3
         order by measured_from_us, batch_id limit $4",
    )
    .bind(structure)
    .bind(before.last().map_or(i64::MIN, |batch| batch.measured_from_us))
    .bind(onset)
    .bind(AFTER)
    .fetch_all(&mut *transaction)
    .await?;
    let mut found = Vec::new();
    found.extend(source(&before, &after));
    found.extend(gap(&before, &after, [from, to]));
    found.extend(modes(transaction, structure, &before, &after).await?);
    found.extend(written(transaction, structure, [from, to]).await?);
    Ok(found)
}

/// Batches from another source than those before.
fn source(before: &[BatchRow], after: &[BatchRow]) -> Option<String> {
    let earlier: BTreeSet<&str> = before.iter().map(|batch| batch.source.as_str()).collect();
    let now = after.first().map(|batch| batch.source.as_str()).filter(|now| !earlier.contains(now))?;
    let last = before.last()?;
    Some(format!("the batches come from the source {} instead of {}", shown(now), shown(&last.source)))
}

/// The longest pause between two successive batches about the onset, if it is long.
fn gap(before: &[BatchRow], after: &[BatchRow], [from, to]: [i64; 2]) -> Option<String> {
    let all: Vec<&BatchRow> = before.iter().chain(after).collect();
    let pauses = all.windows(2).map(|pair| (pair[0].measured_to_us, pair[1].measured_from_us));
    let about = |pause: &(i64, i64)| pause.1 >= from && pause.0 <= to;
    let (about, others): (Vec<_>, Vec<_>) = pauses.partition(about);
    let mut usual: Vec<i64> = others.iter().map(|(end, begin)| begin - end).collect();
    usual.sort_unstable();
    let (end, begin) = about.into_iter().max_by_key(|(end, begin)| begin - end)?;
    if begin - end <= GAP * usual.get(usual.len() / 2)? {
        return None;
    }
    let (end, begin) = (timestamp("batch", end).ok()?, timestamp("batch", begin).ok()?);
    Some(format!("no batch was measured from {end} to {begin}"))
}

/// Modes that are missing from the onset on, or that were missing until then.
async fn modes(
    transaction: &mut Transaction<'_>,
    structure: &str,
    before: &[BatchRow],
    after: &[BatchRow],
) -> Result<Option<String>, Error> {
    let (Some(last), Some(first)) = (before.last(), after.first()) else { return Ok(None) };
    let mut shares = Vec::new();
    for batch in [last, first] {
        let rows: Vec<(Vec<u8>,)> =
            sql::query_as("select frequency_hz from measurement where structure_id = $1 and batch_id = $2 limit $3")
                .bind(structure)
                .bind(&batch.batch_id)
                .bind(ROWS)
                .fetch_all(&mut *transaction)
                .await?;
        let mut there: Vec<usize> = Vec::new();
        for (blob,) in &rows {
            let Ok(values) = from_blob("measurement", blob) else { continue };
            there.resize(values.len().max(there.len()), 0);
            values.iter().zip(&mut there).filter(|(value, _)| !value.is_nan()).for_each(|(_, count)| *count += 1);
        }
        shares.push(there.into_iter().map(|count| count as f64 / rows.len().max(1) as f64).collect::<Vec<f64>>());
    }
    let named = |of: &[f64], than: &[f64]| -> Vec<String> {
        let lost = of.iter().zip(than).enumerate().filter(|(_, (a, b))| **a >= MOST && **b <= 1.0 - MOST);
        lost.map(|(mode, _)| format!("mode {}", mode + 1)).collect()
    };
    let (missing, new) = (named(&shares[0], &shares[1]), named(&shares[1], &shares[0]));
    let said = |modes: Vec<String>, what: &str| (!modes.is_empty()).then(|| format!("{what}: {}", modes.join(", ")));
    let parts: Vec<String> =
        [said(missing, "modes are missing from then on"), said(new, "modes are there that were missing before")]
            .into_iter()
            .flatten()
            .collect();
    Ok((!parts.is_empty()).then(|| parts.join("; ")))
}

/// Maintenance and notes of the time about the onset.
async fn written(
    transaction: &mut Transaction<'_>,
    structure: &str,
    [from, to]: [i64; 2],
) -> Result<Vec<String>, Error> {
    let maintenance: Vec<(i64, i64, String)> = sql::query_as(
        "select from_us, to_us, reason from maintenance_window where structure_id = $1 and from_us <= $3 and to_us >= $2
         order by from_us limit $4",
    )
    .bind(structure)
    .bind(from)
    .bind(to)
    .bind(NAMED)
    .fetch_all(&mut *transaction)
    .await?;
    let notes: Vec<(i64, String)> = sql::query_as(
        "select from_us, text from note where structure_id = $1 and from_us <= $3 and coalesce(to_us, from_us) >= $2
         order by from_us, note_id limit $4",
    )
    .bind(structure)
    .bind(from)
    .bind(to)
    .bind(NAMED)
    .fetch_all(&mut *transaction)
    .await?;
    let of_window = |(from, to, reason): (i64, i64, String)| {
        let (from, to) = (timestamp("maintenance window", from).ok()?, timestamp("maintenance window", to).ok()?);
        Some(format!("maintenance from {from} to {to} ({reason})"))
    };
    let of_note = |(at, text): (i64, String)| {
        let text: String = text.chars().take(NOTE_LENGTH).map(|c| if c.is_control() { ' ' } else { c }).collect();
        Some(format!("the note of {} \"{text}\"", timestamp("note", at).ok()?.day()))
    };
    Ok(maintenance.into_iter().filter_map(of_window).chain(notes.into_iter().filter_map(of_note)).collect())
}
