//! The first pass over a table: its header, its rows, and what its cells say about the way they are written.

use super::clock::{Evidence, Written};
use super::header::{ClockColumn, HeaderColumn, Meaning};
use super::record::{Records, MOST_CELLS};
use crate::measurement::check::Problem;
use crate::measurement::csv;

/// Cells that stand for a value that is missing, in lower case.
const MISSING: [&str; 14] =
    ["", "n/a", "na", "nan", "null", "none", "-", "--", "–", "—", "#n/a", "#nv", "n.a.", "missing"];

/// Length of the longest of them, bytes.
const MOST_MISSING_BYTES: usize = 7;

/// Number of cells shown for each column, and their longest text, characters.
const EXAMPLES: usize = 3;
const LONGEST_EXAMPLE: usize = 40;

/// Largest number of bytes of a header.
const MOST_HEADER_BYTES: usize = 256 * 1024;

/// Largest number of bytes of a table: places in it are numbers of 32 bits.
const MOST_BYTES: usize = u32::MAX as usize;

/// Beginning of a workbook, which is a ZIP archive.
const WORKBOOK: &[u8] = b"PK\x03\x04";

/// Whether a cell stands for a value that is missing.
pub fn is_missing(cell: &str) -> bool {
    let cell = cell.trim();
    // None of them is longer, in capitals too.
    cell.len() <= MOST_MISSING_BYTES && MISSING.contains(&cell.to_lowercase().as_str())
}

/// A table as text.
pub struct Text<'a> {
    /// Its bytes, which are UTF-8, without a mark before them.
    pub table: &'a [u8],
    /// Separator of its cells.
    pub separator: u8,
    /// Its header.
    pub header: Vec<String>,
    /// Line of the header, from 1.
    pub header_line: u64,
    /// Index and line of the byte behind the header.
    pub body: (usize, u64),
}

impl<'a> Text<'a> {
    /// Finds the separator and the header.
    ///
    /// # Errors
    /// Text that is not UTF-8, a workbook, or a table without a header or with one that is too long.
    pub fn of(bytes: &'a [u8]) -> Result<Self, Problem> {
        if bytes.starts_with(WORKBOOK) {
            let message =
                "this is a workbook and not a table of text: save its sheet as CSV (UTF-8), and send that file";
            return Err(Problem::new("line 1", message));
        }
        if bytes.len() > MOST_BYTES {
            return Err(Problem::new("line 1", "the table has 4 GiB or more: send it in parts"));
        }
        let text = csv::text(bytes).map_err(|mut problems| problems.remove(0))?;
        let separator = csv::separator(text);
        let table = text.as_bytes();
        let mut records = Records::new(table, separator);
        if csv::named_separator(text).is_some() {
            records.read_next();
        }
        let Some(record) = records.read_next() else {
            return Err(Problem::new("line 1", "the table is empty: its first line must name the columns"));
        };
        let header_line = record.line();
        let refused = |message: String| Err(Problem::new(format!("line {header_line}"), message));
        if record.count() > MOST_CELLS {
            return refused(format!("the header has {} columns: at most {MOST_CELLS} are read", record.count()));
        }
        if record.length() > MOST_HEADER_BYTES {
            return refused(format!(
                "the header has {} bytes: at most {MOST_HEADER_BYTES} are read; is a quotation mark missing?",
                record.length()
            ));
        }
        let header = record.cells().map(str::to_owned).collect();
        Ok(Self { table, separator, header, header_line, body: records.place() })
    }

    /// The records behind the header.
    fn rows(&self) -> Records<'a> {
        let mut records = Records::new(self.table, self.separator);
        records.go_to(self.body.0, self.body.1);
        records
    }
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
    pub fn of(text: &Text<'_>, columns: &[HeaderColumn]) -> Self {
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
        let mut rows = text.rows();
        while let Some(record) = rows.next_row() {
            let line = record.line();
            scan.rows += 1;
            if record.count() != columns.len() {
                continue;
            }
            for (index, cell) in record.cells().enumerate().filter(|(_, cell)| !cell.is_empty()) {
                let examples = &mut scan.examples[index];
                if examples.len() < EXAMPLES {
                    examples.push(cell.chars().take(LONGEST_EXAMPLE).collect());
                }
                if numeric[index] && !is_missing(cell) {
                    scan.add_number(line, cell);
                }
            }
            if let Some(time) = dates.or(of_day) {
                let of_day = of_day.filter(|index| *index != time).map(|index| record.cell(index));
                scan.add_time(line, record.cell(time), of_day);
            }
        }
        scan
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
