//! Tables of measurements for a diagnosis: columns are recognised, rows that cannot be used are left out, and everything that was
//! assumed is noted.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

use anyhow::Context as _;

use crate::clock;
use crate::discrepancy::data::MOST_LEVELS;
use crate::discrepancy::declared::{mistake, WEIGHED_KG};
use crate::measurement::check::{check_each, Expectation, FieldPath, Problem, Purpose, RawMeasurement};
use crate::measurement::csv::{self, CsvOptions, Offered, SettingColumn, Times};
use crate::measurement::order::Ordered;
use crate::measurement::times::{number, TimeReading, TimeUnit};
use crate::measurement::{Covariate, CovariateKind, ModalMeasurement};
use crate::quantity::Timestamp;
use crate::simulator::Simulator;

/// Largest number of rows that a note names.
const ROWS_NAMED: usize = 5;

/// Largest number of rows that an error names.
const ROWS_REFUSED: usize = 20;

/// A column of times is read as numbers if it has no dates, and at least this many times as many numbers as other cells.
const MOSTLY_NUMBERS: usize = 9;

/// A setting that is missing in at most one of this many rows, or in a single one, is needed in all of them: a parameter is only
/// known if it is set in every row.
const SELDOM_MISSING: usize = 10;

/// Measurements read from tables.
pub struct Tables {
    /// All rows that can be used.
    pub measurements: Vec<ModalMeasurement>,
    /// The assumptions made in reading the tables, and the rows that were left out, as text.
    pub notes: Vec<String>,
    /// Whether the tables have times; if not, the order of the rows is used.
    pub timed: bool,
}

/// Options for reading tables.
#[derive(Debug, Clone, Default)]
pub struct TableArgs<'a> {
    /// Column that holds the time.
    pub time: Option<&'a str>,
    /// Unit of times that are numbers.
    pub time_unit: Option<TimeUnit>,
    /// `PARAMETER=COLUMN`.
    pub settings: &'a [String],
    /// Columns to ignore.
    pub ignore: &'a [String],
    /// Refuse a table with a row that cannot be used.
    pub strict: bool,
}

/// A table that has been read into memory.
type File<'a> = (&'a Path, Vec<u8>);

/// A row with the index of its file.
struct Row {
    file: usize,
    raw: RawMeasurement,
}

/// The rows that are still used, and those that were left out.
#[derive(Default)]
struct Rows {
    /// Number of rows read.
    read: usize,
    /// Files with a column of times.
    timed: BTreeSet<usize>,
    used: Vec<Row>,
    /// Rows that cannot be used, each with the index of its file and the reason.
    left_out: Vec<(usize, Problem)>,
    notes: Vec<String>,
}

/// Reads tables of one structure. Columns that the structure does not declare become covariates, and rows that cannot be used are
/// left out.
///
/// # Errors
/// An invalid header, with its line; tables without a usable row; with [`TableArgs::strict`] also rows that cannot be used.
pub fn read_tables(simulator: &Simulator, paths: &[PathBuf], how: &TableArgs<'_>) -> anyhow::Result<Tables> {
    let read = |path: &PathBuf| std::fs::read(path).with_context(|| format!("cannot read {}", path.display()));
    let files =
        paths.iter().map(|path| Ok((path.as_path(), read(path)?))).collect::<anyhow::Result<Vec<File<'_>>>>()?;
    let mut options = CsvOptions {
        times: Times::Optional,
        ignore: how.ignore.to_vec(),
        time_column: how.time.map(str::to_owned),
        settings: setting_columns(simulator, how.settings)?,
        points: simulator.instrumented_points().map_or_else(Vec::new, |points| points.names.clone()),
    };
    let mut covariates = simulator.covariates().to_vec();
    let mut rows = Rows::default();
    for file in &files {
        rows.notes.extend(add_covariates(file, &mut covariates, &mut options)?);
    }
    if let Some(wrong) = covariates.iter().find_map(|c| mistake(simulator, &c.name)) {
        anyhow::bail!(wrong);
    }
    let expectation = Expectation {
        purpose: Purpose::Diagnosis,
        covariates: &covariates,
        ..simulator.expectation(clock::now(), usize::MAX)
    };
    for (index, file) in files.iter().enumerate() {
        rows.add(index, file, &expectation, &options)?;
    }
    let all = rows.read;
    rows.drop_empty();
    rows.settle_times(&files, how, expectation.now)?;
    rows.drop_unset();
    let measurements = rows.checked(&expectation);
    rows.left_out.sort_by_key(|(file, problem)| (*file, line_of(problem)));
    let named = |most: usize| named(&files, &rows.left_out, &options, most);
    let count = rows.left_out.len();
    if how.strict && count > 0 {
        anyhow::bail!(
            "{count} of {all} rows cannot be used, and --strict refuses them:\n{}",
            named(ROWS_REFUSED).join("\n")
        );
    }
    if measurements.is_empty() {
        anyhow::ensure!(count > 0, "the {} tables hold no measurements", files.len());
        anyhow::bail!("none of {all} rows can be used:\n{}", named(ROWS_REFUSED).join("\n"));
    }
    let mut notes = Vec::new();
    if count > 0 {
        let named = named(ROWS_NAMED).join("; ");
        notes.push(format!(
            "{count} of {all} rows cannot be used and are left out: {named} (--strict refuses such a table)"
        ));
    }
    notes.extend(rows.notes);
    Ok(Tables { measurements, notes, timed: !rows.timed.is_empty() })
}

/// The columns of settings that the user names as `PARAMETER=COLUMN`.
fn setting_columns(simulator: &Simulator, settings: &[String]) -> anyhow::Result<Vec<SettingColumn>> {
    let column = |setting: &String| {
        let (parameter, column) =
            setting.split_once('=').with_context(|| format!("--settings {setting:?} must read PARAMETER=COLUMN"))?;
        let setting = SettingColumn { parameter: parameter.trim().to_owned(), column: column.trim().to_owned() };
        has_parameter(simulator, &setting.parameter).context("--settings")?;
        Ok(setting)
    };
    settings.iter().map(column).collect()
}

fn has_parameter(simulator: &Simulator, name: &str) -> anyhow::Result<()> {
    let names: Vec<&str> = simulator.space().iter().map(|p| p.name.as_str()).collect();
    anyhow::ensure!(
        names.contains(&name),
        "{name:?} is not a parameter of structure {}, which has {}",
        simulator.id(),
        names.join(", ")
    );
    Ok(())
}

fn refused(path: &Path, problems: &[Problem]) -> anyhow::Error {
    let lines: Vec<String> = problems.iter().map(|p| format!("  {}: {}", p.pointer, p.message)).collect();
    anyhow::anyhow!("{} is invalid:\n{}", path.display(), lines.join("\n"))
}

/// Adds the undeclared columns of a table to the covariates, or to the ignored columns; returns a note for each.
fn add_covariates(
    (path, bytes): &File<'_>,
    covariates: &mut Vec<Covariate>,
    options: &mut CsvOptions,
) -> anyhow::Result<Vec<String>> {
    let offers = csv::offered(bytes, covariates, options, MOST_LEVELS).map_err(|p| refused(path, &p))?;
    let mut notes = Vec::new();
    for offer in offers {
        match offer {
            Offered::Covariate(covariate) => {
                let kind = if covariate.kind == CovariateKind::Number { "numeric" } else { "categorical" };
                notes.push(format!("column {} is not declared: it is used as a {kind} covariate", covariate.name));
                covariates.push(covariate);
            }
            Offered::Unnamed { number } => {
                notes.push(format!("column {number} has no name: it is not read"));
                options.ignore.push(String::new());
            }
            Offered::Ignored { name, values } => {
                let more = if values > MOST_LEVELS { "more than " } else { "" };
                notes.push(format!(
                    "column {name} is text with {more}{MOST_LEVELS} different values: it is not used as a covariate"
                ));
                options.ignore.push(name);
            }
        }
    }
    Ok(notes)
}

/// Line of the file that a problem is about.
fn line_of(problem: &Problem) -> u64 {
    let digits = problem.pointer.strip_prefix("line ").unwrap_or_default();
    digits.split(',').next().and_then(|line| line.parse().ok()).unwrap_or_default()
}

/// The first rows that were left out, with their reasons, and the number of the others. The columns have their names in the table.
fn named(files: &[File<'_>], left_out: &[(usize, Problem)], options: &CsvOptions, most: usize) -> Vec<String> {
    let one = |(file, problem): &(usize, Problem)| {
        let mut place = problem.pointer.clone();
        if let Some(time) = &options.time_column {
            place = place.replace(", column measured_at", &format!(", column {time}"));
        }
        for SettingColumn { parameter, column } in &options.settings {
            if place.ends_with(&format!(", column set_{parameter}")) {
                place = place.replace(&format!("set_{parameter}"), column);
            }
        }
        let file = if files.len() > 1 { format!("{}, ", files[*file].0.display()) } else { String::new() };
        format!("{file}{place}: {}", problem.message)
    };
    let mut named: Vec<String> = left_out.iter().take(most).map(one).collect();
    if left_out.len() > most {
        named.push(format!("and {} more", left_out.len() - most));
    }
    named
}

impl Rows {
    /// Adds the rows of a file.
    fn add(
        &mut self,
        index: usize,
        (path, bytes): &File<'_>,
        expectation: &Expectation<'_>,
        options: &CsvOptions,
    ) -> anyhow::Result<()> {
        let table = csv::read_rows(bytes, expectation.modes, expectation.covariates, options);
        let table = table.map_err(|p| refused(path, &p))?;
        if let (Some(column), false) = (&options.time_column, table.timed) {
            anyhow::bail!("{} has no column {column}, which --time requires", path.display());
        }
        for parameter in &table.settings {
            let known = expectation.space.iter().any(|p| p.name == *parameter);
            let names: Vec<&str> = expectation.space.iter().map(|p| p.name.as_str()).collect();
            anyhow::ensure!(
                known,
                "{} has a column set_{parameter}, but {parameter} is not a parameter of the structure, which has {}",
                path.display(),
                names.join(", ")
            );
        }
        // The rows of a table without times follow those of the tables before it.
        let earlier_rows = self.read;
        self.read += table.rows.len();
        for (number, row) in table.rows.into_iter().enumerate() {
            match row {
                Ok(mut raw) => {
                    if !table.timed {
                        let micros = (earlier_rows + number) as i64 * 1_000_000;
                        raw.measured_at = Timestamp::from_micros(micros).ok().map(|time| time.to_string());
                    }
                    self.used.push(Row { file: index, raw });
                }
                Err(problem) => self.left_out.push((index, problem)),
            }
        }
        if table.timed {
            self.timed.insert(index);
        }
        Ok(())
    }

    /// Leaves out the rows for which `reason` gives one.
    fn leave_out(&mut self, mut reason: impl FnMut(&Row) -> Option<Problem>) {
        let left_out = &mut self.left_out;
        self.used.retain(|row| match reason(row) {
            Some(problem) => {
                left_out.push((row.file, problem));
                false
            }
            None => true,
        });
    }

    /// Drops the rows without any frequency: nothing was measured there.
    fn drop_empty(&mut self) {
        let before = self.used.len();
        let has_frequency = |row: &Row| row.raw.frequencies_hz.iter().any(Option::is_some);
        let weighed = |row: &Row| row.raw.covariates.keys().any(|name| name.starts_with(WEIGHED_KG));
        let unused = self.used.iter().filter(|row| weighed(row) && !has_frequency(row)).count();
        if unused > 0 {
            self.notes.push(format!(
                "{unused} weighed masses are not used, because they stand in rows without a frequency: state them in rows of \
                 frequencies that were measured in the same conditions"
            ));
        }
        self.used.retain(has_frequency);
        let empty = before - self.used.len();
        if empty > 0 {
            self.notes.push(format!("{empty} rows without any frequency were ignored"));
        }
    }

    /// Reads times that are numbers and times without an offset, and moves times that occurred before by microseconds.
    fn settle_times(&mut self, files: &[File<'_>], how: &TableArgs<'_>, now: Timestamp) -> anyhow::Result<()> {
        self.read_numeric_times(how, now)?;
        if !self.timed.is_empty() && self.timed.len() < files.len() {
            self.notes
                .push("some tables have no column of times: their rows are put before those of the others".to_owned());
        }
        let mut next: BTreeMap<i64, i64> = BTreeMap::new();
        let mut times = BTreeSet::new();
        let (mut local, mut moved) = (0, 0);
        for row in &mut self.used {
            let Some((time, is_local)) = row.raw.measured_at.as_deref().and_then(date) else { continue };
            let free = next.entry(time.micros()).or_insert(time.micros());
            while !times.insert(*free) {
                *free += 1;
            }
            local += usize::from(is_local);
            moved += usize::from(*free != time.micros());
            row.raw.measured_at = Timestamp::from_micros(*free).ok().map(|time| time.to_string());
        }
        if local > 0 {
            self.notes.push(format!("{local} times have no offset and are read as UTC"));
        }
        if moved > 0 {
            self.notes.push(format!("{moved} times occurred before: each was moved by microseconds"));
        }
        Ok(())
    }

    /// Replaces times that are numbers by those that they mean. The files are read alike, from the numbers of all of them.
    fn read_numeric_times(&mut self, how: &TableArgs<'_>, now: Timestamp) -> anyhow::Result<()> {
        let numeric = self.numeric_files(how.time_unit.is_some());
        let column = how.time.unwrap_or("measured_at");
        let cells = |rows: &[Row]| -> Vec<f64> {
            let of_numeric = rows.iter().filter(|row| numeric.contains(&row.file));
            of_numeric.filter_map(|row| number(row.raw.measured_at.as_deref()?)).collect()
        };
        let values = cells(&self.used);
        if values.is_empty() {
            if let Some(unit) = how.time_unit {
                anyhow::bail!("--time-unit {unit} requires a column of times that are numbers: name it with --time");
            }
            return Ok(());
        }
        let reading = match how.time_unit {
            Some(unit) => TimeReading::in_unit(unit, &values),
            None => TimeReading::guess(&values, now).map_err(|why| anyhow::anyhow!("column {column}: {why}"))?,
        };
        if numeric.len() < self.timed.len() && reading.from_unknown_start() {
            anyhow::bail!(
                "column {column} holds numbers in some tables and dates in others: the numbers have no date; --time-unit names their \
                 unit if they are Unix seconds, serial days or decimal years"
            );
        }
        self.notes.push(reading.note(column, &values, how.time_unit.is_some()));
        let mut settled = Vec::with_capacity(self.used.len());
        for mut row in std::mem::take(&mut self.used) {
            let cell = row.raw.measured_at.as_deref().filter(|_| numeric.contains(&row.file));
            let time = cell.map(|cell| match number(cell) {
                Some(value) => reading.time(value),
                None => Err(format!("{cell:?} is not a number, as the other times are")),
            });
            match time {
                Some(Err(message)) => self.left_out.push((row.file, Problem::new(row.raw.path.of_time(), message))),
                Some(Ok(time)) => {
                    row.raw.measured_at = Some(time.to_string());
                    settled.push(row);
                }
                None => settled.push(row),
            }
        }
        self.used = settled;
        Ok(())
    }

    /// The files whose times are numbers: all but a few of the cells that are not empty, and no dates. If the user names a unit, one
    /// number is enough.
    fn numeric_files(&self, unit_is_known: bool) -> BTreeSet<usize> {
        let is_numeric = |file: &usize| {
            let cells =
                self.used.iter().filter(|row| row.file == *file).filter_map(|row| row.raw.measured_at.as_deref());
            let (mut numbers, mut dates, mut others) = (0, 0, 0);
            for cell in cells {
                match (number(cell), date(cell)) {
                    (Some(_), _) => numbers += 1,
                    (None, Some(_)) => dates += 1,
                    (None, None) => others += 1,
                }
            }
            numbers > 0 && (unit_is_known || (dates == 0 && numbers >= MOSTLY_NUMBERS * others))
        };
        self.timed.iter().filter(|file| is_numeric(file)).copied().collect()
    }

    /// Leaves out rows that lack a setting which nearly all others have.
    fn drop_unset(&mut self) {
        let names: BTreeSet<String> = self.used.iter().flat_map(|row| row.raw.settings.keys().cloned()).collect();
        for name in names {
            let all = self.used.len();
            let set = self.used.iter().filter(|row| row.raw.settings.contains_key(&name)).count();
            let missing = all - set;
            if missing <= (all / SELDOM_MISSING).max(1) {
                self.leave_out(|row| {
                    let lacks = !row.raw.settings.contains_key(&name);
                    let message = || format!("the setting of {name} is missing, which {set} of {all} rows have");
                    lacks.then(|| Problem::new(row.raw.path.of_setting(&name), message()))
                });
            } else {
                self.notes.push(format!(
                    "{name} is set in {set} of {all} rows: it is estimated, as a parameter that is not known, where it is not set"
                ));
            }
        }
    }

    /// The measurements of the rows that satisfy all rules; the others are left out.
    fn checked(&mut self, expectation: &Expectation<'_>) -> Vec<ModalMeasurement> {
        let (origins, raw): (Vec<(usize, FieldPath)>, Vec<RawMeasurement>) =
            std::mem::take(&mut self.used).into_iter().map(|row| ((row.file, row.raw.path), row.raw)).unzip();
        let (mut places, mut measurements) = (Vec::new(), Vec::new());
        for ((file, path), checked) in origins.into_iter().zip(check_each(raw, expectation)) {
            match checked {
                Ok(measurement) => {
                    places.push((file, path));
                    measurements.push(measurement);
                }
                Err(problem) => self.left_out.push((file, problem)),
            }
        }
        let ordered = Ordered::of(&measurements);
        for (index, disorder) in &ordered.left_out {
            let (file, path) = places[*index];
            self.left_out.push((file, Problem::new(path.of_row(), disorder.to_string())));
        }
        self.notes.extend(ordered.notes);
        ordered.kept.iter().map(|index| measurements[*index].clone()).collect()
    }
}

/// A time that is a date, and whether it has no offset and is read as UTC.
fn date(cell: &str) -> Option<(Timestamp, bool)> {
    let exact = Timestamp::parse(cell).map(|time| (time, false));
    let local = |_| Timestamp::parse(&format!("{}Z", cell.trim().replace(' ', "T"))).map(|time| (time, true));
    exact.or_else(local).ok()
}
