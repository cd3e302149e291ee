//! Measurements as CSV tables.
//!
//! The columns are `measured_at`, `f1_hz` …, and optionally `std_f1_hz` …, the declared covariates by name, `set_<parameter>`, and
//! `phi<mode>_<point>` for the component of a mode's shape at an instrumented point. An empty cell is a missing value; of a shape,
//! all components are missing or none. [`read`] refuses a table with a mistake; [`read_rows`] gives the rows one by one, so that
//! those with a mistake can be left out. The separator is `,`, `;` or tab; it is detected from the header or read
//! from a first line `sep=;`. With `;` or tab, decimal commas are accepted. Additions by spreadsheets are accepted: a byte order
//! mark, CRLF, blanks around cells, empty lines, and columns with neither a name nor values.

use std::collections::BTreeMap;

use super::check::{FieldPath, Problem, RawMeasurement};
use super::csv_text::unguarded;
use super::{Covariate, CovariateKind, CovariateValue};
use crate::quantity::{shown, Timestamp};

/// How the times of measurements are found.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Times {
    /// The column `measured_at` is required.
    #[default]
    Required,
    /// Without a column `measured_at`, the rows have no times.
    Optional,
    /// Without a column `measured_at`, row i (from 0) gets the time 1970-01-01T00:00:00Z plus i seconds. This is for files whose
    /// times do not matter.
    RowNumber,
}

/// How a table is read.
#[derive(Debug, Clone, Default)]
pub struct CsvOptions {
    /// How times are found.
    pub times: Times,
    /// Columns that are not read.
    pub ignore: Vec<String>,
    /// Name of the time column, if it is not `measured_at`.
    pub time_column: Option<String>,
    /// Columns of settings that are not named `set_<parameter>`.
    pub settings: Vec<SettingColumn>,
    /// Names of the instrumented points, at which mode shapes are measured; empty if the structure has none.
    pub points: Vec<String>,
}

/// A column that holds the values of a setting.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SettingColumn {
    /// The parameter.
    pub parameter: String,
    /// Name of the column.
    pub column: String,
}

/// A table whose header is valid.
#[derive(Debug, Clone, PartialEq)]
pub struct Table {
    /// Whether it has a column of times.
    pub timed: bool,
    /// The parameters of its columns of settings.
    pub settings: Vec<String>,
    /// Its rows; of a row that cannot be read, its first mistake.
    pub rows: Vec<Result<RawMeasurement, Problem>>,
}

/// A column that the structure does not declare, and its probable meaning.
#[derive(Debug, Clone, PartialEq)]
pub enum Offered {
    /// A covariate of this kind.
    Covariate(Covariate),
    /// A column with values and without a name, such as the numbers of the rows in tables written by data frames. The name `""` in
    /// [`CsvOptions::ignore`] ignores it.
    Unnamed {
        /// Number of the column, from 1.
        number: usize,
    },
    /// Text with too many different values for a category.
    Ignored {
        /// Name of the column.
        name: String,
        /// Number of different values.
        values: usize,
    },
}

/// Guesses the kind of the columns that a structure does not declare: numbers if nearly all cells are numbers, categories if the
/// text has at most `most_categories` different values.
///
/// # Errors
/// As [`read`], for text that is not a table.
pub fn offered(
    bytes: &[u8],
    covariates: &[Covariate],
    options: &CsvOptions,
    most_categories: usize,
) -> Result<Vec<Offered>, Vec<Problem>> {
    let text = text(bytes)?;
    let separator = separator(text);
    let problem = |error: &csv::Error| {
        let line = error.position().map_or(1, csv::Position::line);
        vec![Problem::new(format!("line {line}"), error.to_string())]
    };
    let mut records = reader(text, separator).into_records().skip(usize::from(named_separator(text).is_some()));
    let Some(header) = records.next() else { return Ok(Vec::new()) };
    let header = header.map_err(|e| problem(&e))?;
    let is_unknown = |name: &str| matches!(column(name, covariates, options), None | Some(Column::Unnamed));
    let unknown: Vec<usize> = (0..header.len()).filter(|i| is_unknown(&header[*i])).collect();
    let mut cells: Vec<std::collections::BTreeSet<String>> = vec![std::collections::BTreeSet::new(); unknown.len()];
    let (mut numbers, mut others) = (vec![0; unknown.len()], vec![0; unknown.len()]);
    for record in records {
        let record = record.map_err(|e| problem(&e))?;
        for (position, index) in unknown.iter().enumerate() {
            let Some(cell) = record.get(*index).filter(|cell| !cell.is_empty()) else { continue };
            let counted = if number(cell, separator != b',').is_ok() { &mut numbers } else { &mut others };
            counted[position] += 1;
            if cells[position].len() <= most_categories {
                cells[position].insert(cell.to_owned());
            }
        }
    }
    let offer = |(position, index): (usize, &usize)| {
        let (name, values) = (header[*index].to_owned(), cells[position].len());
        if name.is_empty() {
            return (values > 0).then_some(Offered::Unnamed { number: index + 1 });
        }
        // A few cells that are not numbers do not make the column text: `read` then reports them with their lines.
        Some(if numbers[position] >= 9 * others[position] {
            Offered::Covariate(Covariate::new(name, CovariateKind::Number))
        } else if values <= most_categories {
            Offered::Covariate(Covariate::new(name, CovariateKind::Category))
        } else {
            Offered::Ignored { name, values }
        })
    };
    Ok(unknown.iter().enumerate().filter_map(offer).collect())
}

pub(super) fn text(bytes: &[u8]) -> Result<&str, Vec<Problem>> {
    let text = std::str::from_utf8(bytes).map_err(|e| {
        let line = bytes[..e.valid_up_to()].split(|b| *b == b'\n').count();
        vec![Problem::new(format!("line {line}"), "not UTF-8: save the table as UTF-8")]
    })?;
    Ok(text.strip_prefix('\u{feff}').unwrap_or(text))
}

/// The separator in a first line such as `sep=;`, which some spreadsheets write.
pub(super) fn named_separator(text: &str) -> Option<u8> {
    let line = text.lines().next()?.trim_matches('"');
    let separator = line.get(..4).filter(|start| start.eq_ignore_ascii_case("sep=")).and(line.get(4..))?;
    [b',', b';', b'\t'].into_iter().find(|s| separator.as_bytes() == [*s])
}

/// Line of a record in the file, from 1. The position of the reader is where it started to look for the record, before line ends
/// and empty lines that precede it.
pub(super) fn line_of(text: &str, record: &csv::StringRecord) -> u64 {
    let Some(position) = record.position() else { return 1 };
    let rest = text.as_bytes().get(position.byte() as usize..).unwrap_or_default();
    let passed = rest.iter().take_while(|b| b"\r\n".contains(b)).filter(|b| **b == b'\n').count();
    position.line() + passed as u64
}

pub(super) fn reader(text: &str, separator: u8) -> csv::Reader<&[u8]> {
    csv::ReaderBuilder::new()
        .delimiter(separator)
        .has_headers(false)
        .flexible(true)
        .trim(csv::Trim::All)
        .from_reader(text.as_bytes())
}

/// Meaning of a column.
#[derive(Debug, Clone, PartialEq)]
pub(super) enum Column {
    Ignored,
    /// A column without a name, which spreadsheets append. It must not have values.
    Unnamed,
    Time,
    Frequency(usize),
    Std(usize),
    Covariate(String, CovariateKind),
    Setting(String),
    /// Component of the shape of a mode at a point, by their indices.
    Shape(usize, usize),
    /// A component at a point that is not instrumented.
    ShapeElsewhere(String),
}

/// Reads a table of a structure with `modes` modes.
///
/// # Errors
/// The mistakes of the header, or those of the first wrong row, with line and column.
pub fn read(
    bytes: &[u8],
    modes: usize,
    covariates: &[Covariate],
    options: &CsvOptions,
) -> Result<Vec<RawMeasurement>, Vec<Problem>> {
    let table = read_rows(bytes, modes, covariates, options)?;
    table.rows.into_iter().collect::<Result<_, _>>().map_err(|problem| vec![problem])
}

/// Reads a table of a structure with `modes` modes, each row by itself.
///
/// # Errors
/// The mistakes of the header, with its line; text that is not a table.
pub fn read_rows(
    bytes: &[u8],
    modes: usize,
    covariates: &[Covariate],
    options: &CsvOptions,
) -> Result<Table, Vec<Problem>> {
    let text = text(bytes)?;
    let separator = separator(text);
    let mut reader = reader(text, separator);
    let mut records = reader.records().skip(usize::from(named_separator(text).is_some()));
    let mut next = || match records.next() {
        None => Ok(None),
        Some(Ok(record)) => Ok(Some(record)),
        Some(Err(error)) => {
            let line = error.position().map_or(1, csv::Position::line);
            Err(vec![Problem::new(format!("line {line}"), error.to_string())])
        }
    };
    let Some(header) = next()? else {
        return Err(vec![Problem::new("line 1", "the table is empty: its first line must name the columns")]);
    };
    let columns = columns(&header, line_of(text, &header), modes, covariates, options)?;
    let mut rows = Vec::new();
    while let Some(record) = next()? {
        let line = line_of(text, &record);
        if record.iter().all(str::is_empty) {
            continue;
        }
        rows.push(row(&record, line, &columns, modes, separator != b',', rows.len(), options.times));
    }
    let parameter = |column: &Column| match column {
        Column::Setting(parameter) => Some(parameter.clone()),
        _ => None,
    };
    let settings = columns.iter().filter_map(parameter).collect();
    Ok(Table { timed: columns.contains(&Column::Time), settings, rows })
}

/// The separator that the table specifies, or else the most frequent one in its header.
pub(super) fn separator(text: &str) -> u8 {
    if let Some(named) = named_separator(text) {
        return named;
    }
    let header = text.lines().find(|line| !line.trim().is_empty()).unwrap_or_default();
    let count = |c: u8| header.bytes().filter(|b| *b == c).count();
    [b',', b';', b'\t'].into_iter().rev().max_by_key(|c| count(*c)).unwrap_or(b',')
}

fn columns(
    header: &csv::StringRecord,
    line: u64,
    modes: usize,
    covariates: &[Covariate],
    options: &CsvOptions,
) -> Result<Vec<Column>, Vec<Problem>> {
    let mut problems = Vec::new();
    let mut add = |message: String| problems.push(Problem::new(format!("line {line}"), message));
    let mut columns: Vec<Column> = Vec::new();
    for name in header {
        let column = column(name, covariates, options);
        match &column {
            None => {
                let known: Vec<&str> = covariates.iter().map(|c| c.name.as_str()).collect();
                let known = if known.is_empty() { String::new() } else { format!(", {}", known.join(", ")) };
                let shapes = if options.points.is_empty() { "" } else { ", phi<mode>_<point>" };
                add(format!(
                    "unknown column {}: the known columns are measured_at, f1_hz to f{modes}_hz, std_f1_hz to std_f{modes}_hz, \
                     set_<parameter>{shapes}{known}; declare a covariate in the structure file, or ignore the column",
                    shown(name)
                ));
            }
            Some(Column::Frequency(mode) | Column::Std(mode) | Column::Shape(mode, _)) if *mode >= modes => {
                add(format!("column {}: the structure has {modes} modes", shown(name)));
            }
            Some(Column::ShapeElsewhere(point)) => {
                add(format!(
                    "column {}: {} is not an instrumented point of the structure; mode_shapes.points lists {}",
                    shown(name),
                    shown(point),
                    options.points.join(", ")
                ));
            }
            Some(other) if ![Column::Ignored, Column::Unnamed].contains(other) && columns.contains(other) => {
                add(format!("column {} appears twice: remove one", shown(name)));
            }
            Some(_) => {}
        }
        columns.push(column.unwrap_or(Column::Ignored));
    }
    let missing: Vec<String> = (0..modes)
        .filter(|mode| !columns.contains(&Column::Frequency(*mode)))
        .map(|mode| format!("f{}_hz", mode + 1))
        .collect();
    if !missing.is_empty() {
        add(format!("missing column {}: the structure has {modes} modes", missing.join(", ")));
    }
    for mode in 0..modes {
        let lacks = |point: &usize| !columns.contains(&Column::Shape(mode, *point));
        let missing: Vec<usize> = (0..options.points.len()).filter(lacks).collect();
        if !missing.is_empty() && missing.len() < options.points.len() {
            let names: Vec<String> =
                missing.iter().map(|point| format!("phi{}_{}", mode + 1, options.points[*point])).collect();
            add(format!("missing column {}: a shape needs a component at each point", names.join(", ")));
        }
    }
    if options.times == Times::Required && !columns.contains(&Column::Time) {
        add("missing column measured_at: RFC 3339 with an offset, such as 2026-03-01T12:00:00Z".to_owned());
    }
    for SettingColumn { parameter, column } in &options.settings {
        if !header.iter().any(|name| name.eq_ignore_ascii_case(column)) {
            add(format!("missing column {}, which holds the settings of {parameter}", shown(column)));
        }
    }
    if problems.is_empty() {
        Ok(columns)
    } else {
        Err(problems)
    }
}

pub(super) fn column(name: &str, covariates: &[Covariate], options: &CsvOptions) -> Option<Column> {
    let lower = name.to_ascii_lowercase();
    let mode = |text: &str| {
        let number: usize = text.strip_prefix('f')?.strip_suffix("_hz")?.parse().ok()?;
        number.checked_sub(1)
    };
    if options.ignore.iter().any(|ignored| ignored.eq_ignore_ascii_case(name)) {
        return Some(Column::Ignored);
    }
    if name.is_empty() {
        return Some(Column::Unnamed);
    }
    if let Some(setting) = options.settings.iter().find(|setting| setting.column.eq_ignore_ascii_case(name)) {
        return Some(Column::Setting(setting.parameter.clone()));
    }
    if options.time_column.as_ref().map_or(lower == "measured_at", |column| column.eq_ignore_ascii_case(name)) {
        return Some(Column::Time);
    }
    if let Some(covariate) = covariates.iter().find(|c| c.name.eq_ignore_ascii_case(name)) {
        return Some(Column::Covariate(covariate.name.clone(), covariate.kind));
    }
    if let Some(mode) = mode(&lower) {
        return Some(Column::Frequency(mode));
    }
    if let Some(mode) = lower.strip_prefix("std_").and_then(mode) {
        return Some(Column::Std(mode));
    }
    // The names of parameters and points are case-sensitive.
    if lower.starts_with("set_") {
        return Some(Column::Setting(name["set_".len()..].to_owned()));
    }
    let number = lower.strip_prefix("phi").filter(|_| !options.points.is_empty())?.split('_').next()?;
    let mode = number.parse::<usize>().ok()?.checked_sub(1)?;
    let point = name.get("phi".len() + number.len() + 1..)?;
    let place = options.points.iter().position(|known| known == point);
    Some(place.map_or_else(|| Column::ShapeElsewhere(point.to_owned()), |place| Column::Shape(mode, place)))
}

pub(super) fn row(
    record: &csv::StringRecord,
    line: u64,
    columns: &[Column],
    modes: usize,
    decimal_comma: bool,
    index: usize,
    times: Times,
) -> Result<RawMeasurement, Problem> {
    if record.len() != columns.len() {
        let message = format!("{} cells, but the header has {}", record.len(), columns.len());
        return Err(Problem::new(format!("line {line}"), message));
    }
    let mut raw = RawMeasurement {
        path: FieldPath::Csv { line },
        measured_at: None,
        frequencies_hz: vec![None; modes],
        std_hz: columns.iter().any(|c| matches!(c, Column::Std(_))).then(|| vec![None; modes]),
        mode_shapes: None,
        covariates: BTreeMap::new(),
        settings: BTreeMap::new(),
    };
    let mut shapes: Vec<Vec<Option<f64>>> = Vec::new();
    for (column, cell) in columns.iter().zip(record).filter(|(_, cell)| !cell.is_empty()) {
        let number = |name: String| {
            number(cell, decimal_comma).map_err(|message| Problem::new(format!("line {line}, column {name}"), message))
        };
        match column {
            Column::Ignored | Column::ShapeElsewhere(_) => {}
            Column::Unnamed => {
                let message =
                    format!("{} is in a column without a name: name the column in the first line", shown(cell));
                return Err(Problem::new(format!("line {line}"), message));
            }
            Column::Time => {
                let is_number = decimal_comma && self::number(cell, decimal_comma).is_ok();
                raw.measured_at = Some(if is_number { cell.replace(',', ".") } else { cell.to_owned() });
            }
            Column::Frequency(mode) => raw.frequencies_hz[*mode] = Some(number(format!("f{}_hz", mode + 1))?),
            Column::Std(mode) => {
                let value = number(format!("std_f{}_hz", mode + 1))?;
                raw.std_hz.get_or_insert_with(|| vec![None; modes])[*mode] = Some(value);
            }
            Column::Covariate(name, CovariateKind::Number) => {
                raw.covariates.insert(name.clone(), CovariateValue::Number(number(name.clone())?));
            }
            Column::Covariate(name, CovariateKind::Category) => {
                raw.covariates.insert(name.clone(), CovariateValue::Category(unguarded(cell)));
            }
            Column::Setting(name) => {
                raw.settings.insert(name.clone(), number(format!("set_{name}"))?);
            }
            Column::Shape(mode, point) => {
                if shapes.is_empty() {
                    shapes = vec![vec![None; points(columns)]; modes];
                }
                shapes[*mode][*point] = Some(number(format!("phi{}, component {}", mode + 1, point + 1))?);
            }
        }
    }
    raw.mode_shapes = whole_shapes(shapes).map_err(|message| Problem::new(format!("line {line}"), message))?;
    // A row without any standard deviation gets `None`, as if the table had no such columns.
    raw.std_hz = raw.std_hz.filter(|stds| stds.iter().any(Option::is_some));
    if times == Times::RowNumber && !columns.contains(&Column::Time) {
        let time = Timestamp::from_micros(index as i64 * 1_000_000)
            .expect("a table has far fewer rows than the calendar has seconds");
        raw.measured_at = Some(time.to_string());
    }
    Ok(raw)
}

/// Number of points at which the columns state shapes; the columns of a mode state all points or none.
fn points(columns: &[Column]) -> usize {
    let number = |column: &Column| if let Column::Shape(_, point) = column { point + 1 } else { 0 };
    columns.iter().map(number).max().unwrap_or(0)
}

/// The shapes of a row; `None` if it has none.
///
/// # Errors
/// The mode whose shape has only some of its components.
fn whole_shapes(shapes: Vec<Vec<Option<f64>>>) -> Result<Option<Vec<Option<Vec<f64>>>>, String> {
    let mut whole = Vec::with_capacity(shapes.len());
    for (mode, components) in shapes.into_iter().enumerate() {
        let (count, given) = (components.len(), components.iter().flatten().count());
        let shape: Option<Vec<f64>> = components.into_iter().collect();
        if given > 0 && given < count {
            return Err(format!(
                "the shape of mode {0} has {given} of {count} components: fill all columns phi{0}_…, or leave all of them empty",
                mode + 1
            ));
        }
        whole.push(shape.filter(|_| given > 0));
    }
    Ok(whole.iter().any(Option::is_some).then_some(whole))
}

pub(super) fn number(cell: &str, decimal_comma: bool) -> Result<f64, String> {
    let text = if decimal_comma { cell.replace(',', ".") } else { cell.to_owned() };
    match text.parse::<f64>() {
        Ok(value) if value.is_finite() => Ok(value),
        Ok(_) => Err(format!("{} is not finite: leave the cell empty for a missing value", shown(cell))),
        Err(_) if !decimal_comma && cell.contains(',') => {
            Err(format!("{} is not a number: a decimal comma needs ';' or tab as separator", shown(cell)))
        }
        Err(_) => Err(format!("{} is not a number", shown(cell))),
    }
}
