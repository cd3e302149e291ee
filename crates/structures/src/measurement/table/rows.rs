//! The second pass over a table: its rows as measurements. They are handed on one by one, because all together would take many times the
//! memory of the table.

use super::clock::{Clock, Written};
use super::header::{ClockColumn, HeaderColumn, Meaning};
use super::record::{Record, Records};
use super::refused::Refused;
use super::scan::{is_missing, Text};
use crate::measurement::check::{Problem, RawMeasurement};
use crate::measurement::csv::{self, Column, Times};
use crate::quantity::{shown, Timestamp};

/// A row that can be read.
#[derive(Debug, Clone, PartialEq)]
pub struct FoundRow {
    /// Where it is in the table.
    pub place: RowPlace,
    /// Its values, not checked yet.
    pub raw: RawMeasurement,
}

/// Where a row begins.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RowPlace {
    /// Index of its first byte in the table.
    start: u32,
    /// Its line, from 1.
    pub line: u32,
}

impl RowPlace {
    fn of(record: &Record) -> Self {
        // A table has fewer than 2^32 bytes, and not more lines.
        Self { start: record.start() as u32, line: record.line() as u32 }
    }
}

/// Reads the rows of a table.
#[derive(Debug, Clone)]
pub struct RowReader {
    separator: u8,
    /// Index and line of the byte behind the header.
    body: (usize, u64),
    columns: Vec<HeaderColumn>,
    /// Meaning of the columns after the times have been put into the first column of times.
    plain: Vec<Column>,
    modes: usize,
    comma: bool,
    clock: Clock,
    /// Index of the column of times or dates, and of a column of times of day beside it.
    time: usize,
    time_of_day: Option<usize>,
}

impl RowReader {
    /// A reader of a table whose header and times have been understood.
    pub fn new(text: &Text<'_>, columns: Vec<HeaderColumn>, modes: usize, comma: bool, clock: Clock) -> Self {
        let position = |wanted: ClockColumn| columns.iter().position(|c| c.meaning == Meaning::Clock(wanted));
        let dates = position(ClockColumn::Time).or(position(ClockColumn::Date));
        let of_day = position(ClockColumn::TimeOfDay);
        // A single column named `time` holds whole times.
        let time = dates.or(of_day).expect("a table without a column of times has been refused");
        let plain = |(index, column): (usize, &HeaderColumn)| match &column.meaning {
            Meaning::Clock(_) if index == time => Column::Time,
            Meaning::Value(_, column) => column.clone(),
            Meaning::Unnamed => Column::Unnamed,
            _ => Column::Ignored,
        };
        let plain = columns.iter().enumerate().map(plain).collect();
        let time_of_day = of_day.filter(|index| *index != time);
        let (separator, body) = (text.separator, text.body);
        Self { separator, body, columns, plain, modes, comma, clock, time, time_of_day }
    }

    /// Gives the rows that can be read to `take`, in the order of the file, and adds the others to those that are refused.
    pub fn each(&self, table: &[u8], refused: &mut Refused, mut take: impl FnMut(FoundRow, &mut Refused)) {
        let mut records = Records::new(table, self.separator);
        records.go_to(self.body.0, self.body.1);
        while let Some(record) = records.next_row() {
            if record.count() != self.columns.len() {
                refused.add(|| self.uneven(record));
                continue;
            }
            match self.row(record) {
                Ok(raw) => take(FoundRow { place: RowPlace::of(record), raw }, refused),
                Err(problem) => refused.add(|| problem),
            }
        }
    }

    /// Rows that were read before, from their places.
    pub fn again<'a>(&'a self, table: &'a [u8], places: &'a [RowPlace]) -> impl Iterator<Item = RawMeasurement> + 'a {
        let mut records = Records::new(table, self.separator);
        places.iter().map(move |place| {
            records.go_to(place.start as usize, place.line.into());
            let record = records.read_next().expect("a row is where it was before");
            self.row(record).expect("a row that could be read before can be read again")
        })
    }

    fn uneven(&self, record: &Record) -> Problem {
        let message = format!("{} cells, but the header has {}", record.count(), self.columns.len());
        Problem::new(format!("line {}", record.line()), message)
    }

    /// A row with as many cells as the header.
    fn row(&self, record: &Record) -> Result<RawMeasurement, Problem> {
        let line = record.line();
        let mut plain = ::csv::StringRecord::new();
        for (index, (column, cell)) in self.columns.iter().zip(record.cells()).enumerate() {
            let at = |message: String| Problem::new(format!("line {line}, column {}", column.name), message);
            if index == self.time {
                plain.push_field(&self.time(record).map_err(at)?.map_or_else(String::new, |time| time.to_string()));
            } else if column.is_numeric() {
                plain.push_field(&self.number(column, cell).map_err(at)?);
            } else {
                plain.push_field(cell);
            }
        }
        csv::row(&plain, line, &self.plain, self.modes, false, 0, Times::Required)
    }

    /// The time of a row; `None` for an empty cell.
    fn time(&self, record: &Record) -> Result<Option<Timestamp>, String> {
        let cell = record.cell(self.time);
        if is_missing(cell) {
            return Ok(None);
        }
        // Numbers of times may have a decimal comma, whatever the other numbers have.
        let parse = |cell: &str| Written::parse(cell, true);
        let mut written = parse(cell)?;
        if let Some(of_day) = self.time_of_day.map(|index| record.cell(index)).filter(|cell| !is_missing(cell)) {
            written = written.with_time_of_day(parse(of_day)?)?;
        }
        self.clock.instant(written).map(Some)
    }

    /// A number in the unit of the service, with a decimal point; empty if it is missing.
    fn number(&self, column: &HeaderColumn, cell: &str) -> Result<String, String> {
        if is_missing(cell) {
            return Ok(String::new());
        }
        if self.comma && cell.contains('.') {
            return Err(format!("{} is not a number: the numbers of this table have a decimal comma", shown(cell)));
        }
        let value = csv::number(cell, self.comma)?;
        Ok(column.conversion.of(value).to_string())
    }
}
