//! Tables as people export them from spreadsheets and loggers, and the batches that they become.
//!
//! [`read`] recognises the columns, the times and the numbers of a table, says what it understood, and asks for what the table does
//! not say: it guesses nothing that could be wrong unnoticed. [`plan::plan`] cuts the rows into batches.
//!
//! A table is in memory as its bytes. Its rows are read from them one by one, first to check them and again for the batch that is stored:
//! all of them as measurements would take ten times the memory of the table, and those that are refused without an end.
//!
//! | in the table | read as |
//! |---|---|
//! | `f1`, `f1_hz`, `Mode 1 (Hz)`, `Frequency 1 [Hz]` | frequency of mode 1; in Hz unless the header or an option states another unit |
//! | `date` and `time`, `Datum`, `Uhrzeit`, `timestamp` | the time, from one column or two |
//! | `2026-03-01T12:00Z`, `2026-03-01 12:00`, `01.03.2026 12:00`, `3/1/2026 2:30 PM` | a time; without an offset the zone is asked for |
//! | 03/04/2026 | asked for, unless another date of the table has only one reading |
//! | `n/a`, `NaN`, `-`, an empty cell | a value that is missing |
//! | `0,41` in a table with `;` or tabs | 0.41; a table with both signs is asked about |

pub mod clock;
mod header;
pub mod options;
pub mod plan;
mod record;
pub mod refused;
mod rows;
mod scan;
pub mod split;
pub mod understood;
pub mod unit;
pub mod zone;

use std::collections::BTreeSet;

pub use self::header::Layout;
pub use self::rows::{FoundRow, RowPlace};

use self::clock::Clock;
use self::header::{absent, recognise, ClockColumn, HeaderColumn, Meaning};
use self::options::TableOptions;
use self::refused::Refused;
use self::rows::RowReader;
use self::scan::{Scan, Text};
use self::understood::{ColumnRole, Need, Understood, UnderstoodColumn};
use self::zone::Zone;
use super::check::Problem;
use super::csv::Column;
use crate::quantity::shown;

/// A table whose header and conventions were read. Its rows are read when they are wanted, see [`Self::each_row`].
#[derive(Debug, Clone)]
pub struct Reading<'a> {
    /// What was understood; the numbers of accepted and refused rows and of batches are not known yet.
    pub understood: Understood,
    /// What keeps the table from being read. Then there are no rows.
    pub problems: Vec<Problem>,
    /// The options that the table needs.
    pub needs: BTreeSet<Need>,
    /// Zone of local times, in which days begin.
    pub zone: Zone,
    table: &'a [u8],
    rows: Option<RowReader>,
}

impl Reading<'_> {
    /// A table of which nothing is understood.
    fn refused(problem: Problem) -> Self {
        let understood = Understood {
            separator: ',',
            decimal_sign: '.',
            zone: None,
            date_order: None,
            columns: Vec::new(),
            rows: 0,
            accepted: 0,
            refused: 0,
            refused_rows: Vec::new(),
            batches: 0,
        };
        let (needs, zone) = (BTreeSet::new(), Zone::utc());
        Self { understood, problems: vec![problem], needs, zone, table: &[], rows: None }
    }

    /// Reads the rows in the order of the file: gives those that can be read to `take`, and adds the others to those that are refused.
    /// Only one is in memory at a time.
    pub fn each_row(&self, refused: &mut Refused, take: impl FnMut(FoundRow, &mut Refused)) {
        if let Some(rows) = &self.rows {
            rows.each(self.table, refused, take);
        }
    }

    /// A problem that names a column as the table does, instead of as the service does.
    pub fn in_its_words(&self, mut problem: Problem) -> Problem {
        if let Some((line, canonical)) = problem.pointer.split_once(", column ") {
            let is_it = |column: &&UnderstoodColumn| match canonical {
                "measured_at" => column.role == ColumnRole::Time,
                _ => column.target.as_deref().is_some_and(|target| target.eq_ignore_ascii_case(canonical)),
            };
            if let Some(column) = self.understood.columns.iter().find(is_it) {
                problem.pointer = format!("{line}, column {}", column.name);
            }
        }
        problem
    }
}

/// Reads what a table of a structure says before its rows are read as measurements.
pub fn read<'a>(bytes: &'a [u8], layout: &Layout<'_>, options: &TableOptions) -> Reading<'a> {
    let text = match Text::of(bytes) {
        Ok(text) => text,
        Err(problem) => return Reading::refused(problem),
    };
    let place = format!("line {}", text.header_line);
    let mut findings = Findings { place, problems: Vec::new(), needs: BTreeSet::new() };
    let columns = findings.columns(&text, layout, options);
    let scan = Scan::of(&text, &columns);
    let comma = findings.decimal_comma(&text, &scan, options);
    let clock = findings.clock(&columns, &scan, options);
    let understood = understood(&text, &columns, &scan, (&clock, comma));
    let Findings { problems, needs, .. } = findings;
    let zone = clock.zone.clone().unwrap_or_else(Zone::utc);
    let rows = problems.is_empty().then(|| RowReader::new(&text, columns, layout.modes, comma, clock));
    Reading { understood, problems, needs, zone, table: text.table, rows }
}

fn understood(text: &Text<'_>, columns: &[HeaderColumn], scan: &Scan, (clock, comma): (&Clock, bool)) -> Understood {
    let of_time = scan.times.without_zone.is_some() || scan.times.number.is_some();
    let order = clock.order.filter(|_| scan.times.unordered.is_some() || scan.times.dotted);
    let dotted = scan.times.dotted.then_some(clock::DateOrder::DayMonthYear);
    let column = |(index, column): (usize, &HeaderColumn)| UnderstoodColumn {
        number: index + 1,
        name: column.name.clone(),
        role: column.role(),
        target: column.target(),
        reason: column.reason.clone(),
        examples: scan.examples[index].clone(),
    };
    Understood {
        separator: char::from(text.separator),
        decimal_sign: if comma { ',' } else { '.' },
        zone: clock.zone.as_ref().filter(|_| of_time).map(ToString::to_string),
        date_order: order.or(dotted),
        columns: columns.iter().enumerate().map(column).collect(),
        rows: scan.rows,
        accepted: 0,
        refused: 0,
        refused_rows: Vec::new(),
        batches: 0,
    }
}

/// The problems found so far, and the options that would solve them.
struct Findings {
    /// Line of the header.
    place: String,
    problems: Vec<Problem>,
    needs: BTreeSet<Need>,
}

impl Findings {
    fn add(&mut self, need: Option<Need>, message: String) {
        self.needs.extend(need);
        self.problems.push(Problem::new(self.place.clone(), message));
    }

    fn columns(&mut self, text: &Text<'_>, layout: &Layout<'_>, options: &TableOptions) -> Vec<HeaderColumn> {
        let mut columns = Vec::new();
        for (index, name) in text.header.iter().enumerate() {
            columns.push(recognise(name, index + 1, layout, options).unwrap_or_else(|message| {
                self.add(Some(Need::Columns), message);
                HeaderColumn::unknown(name)
            }));
        }
        for named in absent(&text.header, options) {
            self.add(Some(Need::Columns), format!("the table has no column {}", shown(&named.text())));
        }
        for (index, column) in columns.iter().enumerate() {
            self.check_column(column, &columns[..index], layout);
        }
        let has = |wanted: &Column| columns.iter().any(|c| matches!(&c.meaning, Meaning::Value(_, c) if c == wanted));
        let missing: Vec<usize> = (0..layout.modes).filter(|mode| !has(&Column::Frequency(*mode))).collect();
        if let Some(first) = missing.first() {
            let names: Vec<String> = missing.iter().map(|mode| format!("f{}_hz", mode + 1)).collect();
            let message = format!(
                "missing column {}: the structure has {} modes; columns=f{}=NAME says which column it is",
                names.join(", "),
                layout.modes,
                first + 1
            );
            self.add(Some(Need::Columns), message);
        }
        for mode in 0..layout.modes {
            let lacks = |point: &usize| !has(&Column::Shape(mode, *point));
            let missing: Vec<usize> = (0..layout.points.len()).filter(lacks).collect();
            if !missing.is_empty() && missing.len() < layout.points.len() {
                let names: Vec<String> =
                    missing.iter().map(|point| format!("phi{}_{}", mode + 1, layout.points[*point])).collect();
                self.add(None, format!("missing column {}: a shape needs a component at each point", names.join(", ")));
            }
        }
        columns
    }

    /// Checks a column against those before it.
    fn check_column(&mut self, column: &HeaderColumn, before: &[HeaderColumn], layout: &Layout<'_>) {
        let name = shown(&column.name);
        let same = |target: &String| before.iter().find(|c| c.target().as_ref() == Some(target));
        let twice = column.target().and_then(|target| Some((same(&target)?, target)));
        if let Some((first, target)) = twice {
            let message = if first.name.eq_ignore_ascii_case(&column.name) {
                format!("column {name} appears twice: remove one, or write ignore=#{}", before.len() + 1)
            } else {
                format!(
                    "columns {} and {name} both mean {target}: write ignore=NAME for one of them",
                    shown(&first.name)
                )
            };
            self.add(Some(Need::Columns), message);
        }
        match &column.meaning {
            // The mistake in its unit or target has been named already.
            Meaning::Unknown if column.reason.is_empty() => {}
            Meaning::Unknown => {
                let covariates: Vec<&str> = layout.covariates.iter().map(|c| c.name.as_str()).collect();
                let covariates =
                    if covariates.is_empty() { String::new() } else { format!(", {}", covariates.join(", ")) };
                let message = format!(
                    "unknown column {name}: write ignore={0} to leave it out, or columns=TARGET={0} to say what it is: time, f1_hz \
                     to f{1}_hz, std_f1_hz to std_f{1}_hz, set_<parameter>{covariates}; a covariate is declared in the structure file",
                    column.reference(before.len() + 1),
                    layout.modes
                );
                self.add(Some(Need::Columns), message);
            }
            Meaning::Value(_, Column::Frequency(mode) | Column::Std(mode) | Column::Shape(mode, _))
                if *mode >= layout.modes =>
            {
                let message =
                    format!("column {name}: the structure has {} modes; write ignore= to leave it out", layout.modes);
                self.add(Some(Need::Columns), message);
            }
            Meaning::Value(_, Column::ShapeElsewhere(point)) => {
                let message = format!(
                    "column {name}: {} is not an instrumented point of the structure; mode_shapes.points lists {}",
                    shown(point),
                    layout.points.join(", ")
                );
                self.add(Some(Need::Columns), message);
            }
            _ => {}
        }
    }

    fn decimal_comma(&mut self, text: &Text<'_>, scan: &Scan, options: &TableOptions) -> bool {
        if let Some(comma) = options.decimal_comma {
            return comma;
        }
        match (&scan.comma, &scan.point) {
            _ if text.separator == b',' => false,
            (Some((line, cell)), Some((other, point))) => {
                self.needs.insert(Need::Decimal);
                let message = format!(
                    "{} has a comma and {} in line {other} a point: write decimal=comma or decimal=point",
                    shown(cell),
                    shown(point)
                );
                self.problems.push(Problem::new(format!("line {line}"), message));
                false
            }
            (comma, _) => comma.is_some(),
        }
    }

    /// How the times are read, from the options and the table.
    fn clock(&mut self, columns: &[HeaderColumn], scan: &Scan, options: &TableOptions) -> Clock {
        let clocks = columns.iter().filter_map(|column| match column.meaning {
            Meaning::Clock(clock) => Some((clock, column)),
            _ => None,
        });
        let clocks: Vec<(ClockColumn, &HeaderColumn)> = clocks.collect();
        let kinds: Vec<ClockColumn> = clocks.iter().map(|(clock, _)| *clock).collect();
        if kinds.is_empty() {
            let message =
                "missing column measured_at, time or date: the time of each row, such as 2026-03-01T12:00:00Z; \
                           columns=time=NAME says which column it is";
            self.add(Some(Need::Columns), message.to_owned());
        } else if kinds.contains(&ClockColumn::Time) && kinds.len() > 1 {
            let names: Vec<String> = clocks.iter().map(|(_, column)| shown(&column.name)).collect();
            let message =
                format!("columns {} could all be the time: write ignore=NAME for the others", names.join(", "));
            self.add(Some(Need::Columns), message);
        }
        let mut clock = Clock { zone: options.zone.clone(), order: options.date_order, unit: options.time_unit };
        if clocks.iter().any(|(_, column)| column.utc) {
            if clock.zone.as_ref().is_some_and(|zone| *zone != Zone::utc()) {
                self.add(
                    None,
                    "the header says that times are UTC, and zone names another zone: leave zone out".to_owned(),
                );
            }
            clock.zone = Some(Zone::utc());
        }
        let times = &scan.times;
        let name = clocks.first().map_or("", |(_, column)| column.name.as_str());
        let mut ask = |need: Need, (line, cell): &(u64, String), message: &str| {
            self.needs.insert(need);
            let message = format!("{} {message}", shown(cell));
            self.problems.push(Problem::new(format!("line {line}, column {name}"), message));
        };
        if let (Some(first), None) = (&times.without_zone, &clock.zone) {
            let message = "has no zone: write zone=Europe/Berlin or another zone of the IANA database (--zone on the command line), \
                           zone=UTC, or times with an offset such as 2026-03-01T12:00:00+01:00";
            ask(Need::Zone, first, message);
        }
        if let (Some(first), None, false) = (&times.number, clock.unit, times.with_zone || times.without_zone.is_some())
        {
            let message =
                "is a number: write time_unit=seconds (Unix time), milliseconds, serial-days (of a spreadsheet) or \
                           decimal-year, or times in RFC 3339 with an offset";
            ask(Need::TimeUnit, first, message);
        }
        if clock.order.is_none() {
            clock.order = times.order();
            if let (Some(first), None) = (&times.unordered, clock.order) {
                let message =
                    "may begin with the day or the month: write date_order=dmy for 31/12/2026 or date_order=mdy for \
                               12/31/2026";
                ask(Need::DateOrder, first, message);
            }
        }
        clock
    }
}
