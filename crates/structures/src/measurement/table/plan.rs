//! From the rows of a table to batches: each row is accepted or refused by itself, and the accepted ones are cut by time.

use std::collections::BTreeSet;

use super::record::without_mark;
use super::refused::Refused;
use super::rows::{FoundRow, RowPlace, RowReader};
use super::split::{Split, LONGEST_UNSPLIT_MICROS};
use super::understood::{Need, RefusedRow, Understood, MOST_REFUSED};
use super::Reading;
use crate::measurement::check::{Problem, RawMeasurement};
use crate::measurement::ModalMeasurement;
use crate::quantity::Timestamp;

/// Largest number of batches of one table: each has an entry in the answer.
pub const MOST_BATCHES: usize = 10_000;

/// A batch of a table. Its measurements are read from the table when they are wanted: [`Plan::measurements`].
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct PlannedBatch {
    /// Line in the file of its first measurement, from 1.
    pub line: usize,
    /// Earliest time.
    pub from: Timestamp,
    /// Latest time.
    pub to: Timestamp,
    /// Its rows in the order of time.
    rows: Vec<RowPlace>,
}

impl PlannedBatch {
    /// Rows in the order of time, of which there is at least one.
    fn of(rows: &[AcceptedRow]) -> Self {
        let (first, last) = (&rows[0], &rows[rows.len() - 1]);
        let places = rows.iter().map(|row| row.place).collect();
        Self { line: first.place.line as usize, from: first.time(), to: last.time(), rows: places }
    }

    /// Number of its measurements.
    pub fn count(&self) -> usize {
        self.rows.len()
    }
}

/// The batches of a table.
#[derive(Debug, Clone)]
pub struct Plan {
    /// What was understood.
    pub understood: Understood,
    /// What keeps the table from being stored.
    pub problems: Vec<Problem>,
    /// The options that the table needs.
    pub needs: BTreeSet<Need>,
    /// The first 10,000 batches in the order of time. If there are problems, they show what would be made of the rows.
    pub batches: Vec<PlannedBatch>,
    /// The refused rows in the order of the file.
    pub refused: Refused,
    reader: Option<RowReader>,
}

impl Plan {
    /// The measurements of a batch in the order of time, read from the bytes of the table of which this is the plan. `check` decides as
    /// the one with which the plan was made.
    pub fn measurements(
        &self,
        table: &[u8],
        batch: &PlannedBatch,
        mut check: impl FnMut(RawMeasurement) -> Result<ModalMeasurement, Problem>,
    ) -> Vec<ModalMeasurement> {
        let again = self.reader.iter().flat_map(|reader| reader.again(without_mark(table), &batch.rows));
        again.map(|raw| check(raw).expect("a row that was accepted before is accepted again")).collect()
    }
}

/// A row that is accepted. There may be millions, so that only what the cutting needs is kept.
struct AcceptedRow {
    interval: i64,
    micros: i64,
    place: RowPlace,
}

impl AcceptedRow {
    fn time(&self) -> Timestamp {
        Timestamp::from_micros(self.micros).expect("these are the microseconds of a time")
    }
}

/// Checks the rows one by one by `check`, and cuts those that are accepted. No two accepted rows have the same time.
pub fn plan(
    reading: Reading<'_>,
    split: Option<Split>,
    most_measurements: usize,
    mut check: impl FnMut(RawMeasurement) -> Result<ModalMeasurement, Problem>,
) -> Plan {
    let rule = split.unwrap_or(Split::None);
    let (mut accepted, mut refused) = (Vec::new(), Refused::new(MOST_REFUSED));
    reading.each_row(&mut refused, |FoundRow { place, raw }, refused| match check(raw) {
        Ok(measurement) => {
            let time = measurement.measured_at;
            accepted.push(AcceptedRow { interval: rule.interval(time, &reading.zone), micros: time.micros(), place });
        }
        Err(problem) => refused.add(|| reading.in_its_words(problem)),
    });
    accepted.sort_unstable_by_key(|row| (row.interval, row.micros));
    let joined = |a: &AcceptedRow, b: &AcceptedRow| a.interval == b.interval && rule.joins(a.micros, b.micros);
    let (mut batches, mut count, mut too_large) = (Vec::new(), 0, None);
    for rows in accepted.chunk_by(joined) {
        count += 1;
        if count <= MOST_BATCHES {
            batches.push(PlannedBatch::of(rows));
        }
        if rows.len() > most_measurements && too_large.is_none() {
            too_large = Some((rows[0].time(), rows.len()));
        }
    }
    let Reading { mut understood, mut problems, mut needs, rows: reader, .. } = reading;
    understood.accepted = accepted.len();
    understood.refused = refused.count();
    understood.refused_rows = refused.first().iter().map(refused_row).collect();
    understood.batches = count;
    if problems.is_empty() {
        let span = accepted.first().zip(accepted.last()).filter(|_| split.is_none());
        if let Some(problem) = span.and_then(|(first, last)| too_long(accepted.len(), (first.time(), last.time()))) {
            needs.insert(Need::Split);
            problems.push(problem);
        }
        problems.extend(unsuitable(&understood, &refused, too_large, most_measurements));
    }
    Plan { understood, problems, needs, batches, refused, reader }
}

/// A problem if this number of measurements, a batch that its sender did not ask for, spans more than 48 h.
pub fn too_long(count: usize, (first, last): (Timestamp, Timestamp)) -> Option<Problem> {
    let span = last.micros() - first.micros();
    (span > LONGEST_UNSPLIT_MICROS).then(|| {
        let days = span as f64 / 86_400e6;
        let message = format!(
            "the {count} measurements span {days:.1} days, from {first} to {last}, and a batch shows one state of the structure: write \
             split=1d for a batch a day, split=6h for shorter ones, split=gap:2h for a new batch after each pause of two hours, or \
             split=none for a single batch"
        );
        Problem::new("query/split", message)
    })
}

/// Problems of the batches as a whole. `too_large` is the first with too many measurements: its first time, and their number.
fn unsuitable(
    understood: &Understood,
    refused: &Refused,
    too_large: Option<(Timestamp, usize)>,
    most_measurements: usize,
) -> Vec<Problem> {
    let mut problems = Vec::new();
    if understood.batches == 0 {
        let (pointer, message) = match refused.first().first() {
            Some(first) => {
                let rows = understood.rows;
                (first.pointer.clone(), format!("none of the {rows} rows can be used; the first: {}", first.message))
            }
            None => ("/measurements".to_owned(), "the table is empty: send at least one row".to_owned()),
        };
        problems.push(Problem::new(pointer, message));
    }
    if let Some((first, count)) = too_large {
        let message = format!(
            "the batch from {first} has {count} measurements, and a batch may contain at most {most_measurements}: split more finely"
        );
        problems.push(Problem::new("query/split", message));
    }
    if understood.batches > MOST_BATCHES {
        let message =
            format!("{} batches: at most {MOST_BATCHES} are taken at once; split less finely", understood.batches);
        problems.push(Problem::new("query/split", message));
    }
    problems
}

fn refused_row(problem: &Problem) -> RefusedRow {
    let (line, column) = match problem.pointer.split_once(", column ") {
        Some((line, column)) => (line, Some(column.to_owned())),
        None => (problem.pointer.as_str(), None),
    };
    let line = line.trim_start_matches("line ").parse().unwrap_or_default();
    RefusedRow { line, column, reason: problem.message.clone() }
}
