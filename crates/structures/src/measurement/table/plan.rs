//! From the rows of a table to batches: each row is accepted or refused by itself, and the accepted ones are cut by time.

use std::collections::BTreeSet;

use super::split::{Split, LONGEST_UNSPLIT_MICROS};
use super::understood::{Need, RefusedRow, Understood, MOST_REFUSED};
use super::Reading;
use crate::measurement::check::{FieldPath, Problem, RawMeasurement};
use crate::measurement::ModalMeasurement;

/// Largest number of batches of one table: each has an entry in the answer.
pub const MOST_BATCHES: usize = 10_000;

/// A batch of a table.
#[derive(Debug, Clone, PartialEq)]
pub struct PlannedBatch {
    /// Line in the file of its first measurement, from 1.
    pub line: usize,
    /// Its measurements in the order of time.
    pub measurements: Vec<ModalMeasurement>,
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
    /// The batches in the order of time. If there are problems, they show what would be made of the rows.
    pub batches: Vec<PlannedBatch>,
    /// The refused rows as problems, in the order of the file.
    pub refused: Vec<Problem>,
}

/// Checks the rows by `check`, which answers each of them in order, and cuts those that are accepted.
pub fn plan(
    mut reading: Reading,
    split: Option<Split>,
    most_measurements: usize,
    check: impl FnOnce(Vec<RawMeasurement>) -> Vec<Result<ModalMeasurement, Problem>>,
) -> Plan {
    let (mut raw, mut refused) = (Vec::new(), Vec::new());
    for row in std::mem::take(&mut reading.rows) {
        match row {
            Ok(row) => raw.push(row),
            Err(problem) => refused.push(problem),
        }
    }
    let lines: Vec<usize> = raw.iter().map(|row| line(row.path)).collect();
    let mut accepted = Vec::with_capacity(raw.len());
    for (line, checked) in lines.into_iter().zip(check(raw)) {
        match checked {
            Ok(measurement) => accepted.push((line, measurement)),
            Err(problem) => refused.push(reading.in_its_words(problem)),
        }
    }
    refused.sort_by_key(line_of);
    let Reading { mut understood, mut problems, mut needs, zone, .. } = reading;
    let times: Vec<_> = accepted.iter().map(|(_, measurement)| measurement.measured_at).collect();
    let pieces = split.unwrap_or(Split::None).pieces(&times, &zone);
    let mut slots: Vec<Option<(usize, ModalMeasurement)>> = accepted.into_iter().map(Some).collect();
    let mut batch = |piece: Vec<usize>| {
        let rows = piece.into_iter().map(|index| slots[index].take().expect("a measurement is in one batch"));
        let (lines, measurements): (Vec<usize>, Vec<ModalMeasurement>) = rows.unzip();
        PlannedBatch { line: lines[0], measurements }
    };
    let batches: Vec<PlannedBatch> = pieces.into_iter().map(&mut batch).collect();
    understood.accepted = times.len();
    understood.refused = refused.len();
    understood.refused_rows = refused.iter().take(MOST_REFUSED).map(refused_row).collect();
    understood.batches = batches.len();
    if problems.is_empty() {
        if let (None, Some(problem)) = (split, too_long(&batches)) {
            needs.insert(Need::Split);
            problems.push(problem);
        }
        problems.extend(unsuitable(&understood, &batches, most_measurements, &refused));
    }
    Plan { understood, problems, needs, batches, refused }
}

/// A problem if a batch that its sender did not ask for spans more than 48 h.
pub fn too_long(batches: &[PlannedBatch]) -> Option<Problem> {
    let times: Vec<_> = batches.iter().flat_map(|batch| &batch.measurements).map(|m| m.measured_at).collect();
    let (first, last) = (times.iter().min()?, times.iter().max()?);
    let span = last.micros() - first.micros();
    (span > LONGEST_UNSPLIT_MICROS).then(|| {
        let days = span as f64 / 86_400e6;
        let message = format!(
            "the {} measurements span {days:.1} days, from {first} to {last}, and a batch shows one state of the structure: write \
             split=1d for a batch a day, split=6h for shorter ones, split=gap:2h for a new batch after each pause of two hours, or \
             split=none for a single batch",
            times.len()
        );
        Problem::new("query/split", message)
    })
}

/// Problems of the batches as a whole.
fn unsuitable(
    understood: &Understood,
    batches: &[PlannedBatch],
    most_measurements: usize,
    refused: &[Problem],
) -> Vec<Problem> {
    let mut problems = Vec::new();
    if batches.is_empty() {
        let (pointer, message) = match refused.first() {
            Some(first) => {
                let rows = understood.rows;
                (first.pointer.clone(), format!("none of the {rows} rows can be used; the first: {}", first.message))
            }
            None => ("/measurements".to_owned(), "the table is empty: send at least one row".to_owned()),
        };
        problems.push(Problem::new(pointer, message));
    }
    if let Some(large) = batches.iter().find(|batch| batch.measurements.len() > most_measurements) {
        let message = format!(
            "the batch from {} has {} measurements, and a batch may contain at most {most_measurements}: split more finely",
            large.measurements[0].measured_at,
            large.measurements.len()
        );
        problems.push(Problem::new("query/split", message));
    }
    if batches.len() > MOST_BATCHES {
        let message = format!("{} batches: at most {MOST_BATCHES} are taken at once; split less finely", batches.len());
        problems.push(Problem::new("query/split", message));
    }
    problems
}

fn line(path: FieldPath) -> usize {
    match path {
        FieldPath::Csv { line } => line as usize,
        FieldPath::Json { index } => index + 1,
    }
}

fn line_of(problem: &Problem) -> u64 {
    refused_row(problem).line
}

fn refused_row(problem: &Problem) -> RefusedRow {
    let (line, column) = match problem.pointer.split_once(", column ") {
        Some((line, column)) => (line, Some(column.to_owned())),
        None => (problem.pointer.as_str(), None),
    };
    let line = line.trim_start_matches("line ").parse().unwrap_or_default();
    RefusedRow { line, column, reason: problem.message.clone() }
}
