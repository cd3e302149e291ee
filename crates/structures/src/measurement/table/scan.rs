//! The first pass over a table: its header, its rows, and what its cells say about the way they are written.

use super::clock::{Evidence, Written};
use super::header::{ClockColumn, HeaderColumn, Meaning};
use crate::measurement::check::Problem;
use crate::measurement::csv;

/// Cells that stand for a value that is missing, in lower case.
const MISSING: [&str; 14] =
    ["", "n/a", "na", "nan", "null", "none", "-", "--", "–", "—", "#n/a", "#nv", "n.a.", "missing"];

/// Number of cells shown for each column, and their longest text, characters.
const EXAMPLES: usize = 3;
const LONGEST_EXAMPLE: usize = 40;

/// Largest number of columns: each is described in the answer.
const MOST_COLUMNS: usize = 1_000;

/// Beginning of a workbook, which is a ZIP archive.
const WORKBOOK: &[u8] = b"PK\x03\x04";

/// Whether a cell stands for a value that is missing.
pub fn is_missing(cell: &str) -> bool {
    MISSING.contains(&cell.trim().to_lowercase().as_str())
}

/// A table as text.
pub struct Text<'a> {
    text: &'a str,
    /// Separator of its cells.
    pub separator: u8,
    /// Its header.
    pub header: ::csv::StringRecord,
    /// Line of the header, from 1.
    pub header_line: u64,
    /// Number of records up to and including the header.
    before: usize,
}

impl<'a> Text<'a> {
    /// Finds the separator and the header.
    ///
    /// # Errors
    /// Text that is not UTF-8, a workbook, or a table without a header.
    pub fn of(bytes: &'a [u8]) -> Result<Self, Problem> {
        if bytes.starts_with(WORKBOOK) {
            let message =
                "this is a workbook and not a table of text: save its sheet as CSV (UTF-8), and send that file";
            return Err(Problem::new("line 1", message));
        }
        let text = csv::text(bytes).map_err(|mut problems| problems.remove(0))?;
        let separator = csv::separator(text);
        let named = usize::from(csv::named_separator(text).is_some());
        let mut records = csv::reader(text, separator).into_records().skip(named);
        let header = match records.next() {
            Some(Ok(header)) => header,
            Some(Err(error)) => return Err(unreadable(&error)),
            None => return Err(Problem::new("line 1", "the table is empty: its first line must name the columns")),
        };
        let header_line = csv::line_of(text, &header);
        if header.len() > MOST_COLUMNS {
            let message = format!("the header has {} columns: at most {MOST_COLUMNS} are read", header.len());
            return Err(Problem::new(format!("line {header_line}"), message));
        }
        Ok(Self { text, separator, header, header_line, before: named + 1 })
    }

    /// The rows that are not empty, with their lines.
    pub fn rows(&self) -> impl Iterator<Item = Result<(u64, ::csv::StringRecord), Problem>> + '_ {
        let records = csv::reader(self.text, self.separator).into_records().skip(self.before);
        let with_line = |record: Result<::csv::StringRecord, ::csv::Error>| match record {
            Ok(record) if record.iter().all(str::is_empty) => None,
            Ok(record) => Some(Ok((csv::line_of(self.text, &record), record))),
            Err(error) => Some(Err(unreadable(&error))),
        };
        records.filter_map(with_line)
    }
}

fn unreadable(error: &::csv::Error) -> Problem {
    let line = error.position().map_or(1, ::csv::Position::line);
    Problem::new(format!("line {line}"), error.to_string())
}

/// Line and text of a cell.
type Place = Option<(u64, String)>;

/// What the cells say.
pub struct Scan {
    /// Number of rows that are not empty.
    pub rows: usize,
    /// What the times say.
    pub times: Evidence,
    /// The first number with a comma.
    pub comma: Place,
    /// The first number with a point.
    pub point: Place,
    /// The first cells of each column.
    pub examples: Vec<Vec<String>>,
}

impl Scan {
    /// Looks at all cells.
    ///
    /// # Errors
    /// Text that is not a table, with its line.
    pub fn of(text: &Text<'_>, columns: &[HeaderColumn]) -> Result<Self, Problem> {
        let mut scan = Self {
            rows: 0,
            times: Evidence::default(),
            comma: None,
            point: None,
            examples: vec![Vec::new(); columns.len()],
        };
        let numeric: Vec<bool> = columns.iter().map(HeaderColumn::is_numeric).collect();
        let position = |wanted: ClockColumn| columns.iter().position(|c| c.meaning == Meaning::Clock(wanted));
        let dates = position(ClockColumn::Time).or(position(ClockColumn::Date));
        let of_day = position(ClockColumn::TimeOfDay);
        for row in text.rows() {
            let (line, record) = row?;
            scan.rows += 1;
            if record.len() != columns.len() {
                continue;
            }
            for (index, cell) in record.iter().enumerate().filter(|(_, cell)| !cell.is_empty()) {
                let examples = &mut scan.examples[index];
                if examples.len() < EXAMPLES {
                    examples.push(cell.chars().take(LONGEST_EXAMPLE).collect());
                }
                if numeric[index] && !is_missing(cell) {
                    scan.add_number(line, cell);
                }
            }
            if let Some(time) = dates.or(of_day) {
                scan.add_time(line, &record[time], of_day.filter(|index| *index != time).map(|index| &record[index]));
            }
        }
        Ok(scan)
    }

    fn add_number(&mut self, line: u64, cell: &str) {
        let place = if cell.contains(',') {
            &mut self.comma
        } else if cell.contains('.') {
            &mut self.point
        } else {
            return;
        };
        if place.is_none() {
            *place = Some((line, cell.to_owned()));
        }
    }

    fn add_time(&mut self, line: u64, cell: &str, of_day: Option<&str>) {
        if is_missing(cell) {
            return;
        }
        let Ok(mut written) = Written::parse(cell, true) else { return };
        if let Some(time) = of_day.filter(|cell| !is_missing(cell)) {
            match Written::parse(time, true).and_then(|time| written.with_time_of_day(time)) {
                Ok(joined) => written = joined,
                Err(_) => return,
            }
        }
        self.times.add(line, cell, &written);
    }
}
