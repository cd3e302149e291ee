//! What the columns of a table are, by their headers and by what its sender says.

use super::options::{Named, TableOptions};
use super::understood::ColumnRole;
use super::unit::{between_temperatures, suffix, Conversion, FrequencyUnit};
use crate::measurement::csv::{column, Column, CsvOptions};
use crate::measurement::{Covariate, CovariateKind};
use crate::quantity::shown;

/// Longest name of a column that is kept, and longest one that a message repeats as an option, characters.
const LONGEST_NAME: usize = 80;
const LONGEST_REFERENCE: usize = 40;

/// Names of a frequency before its number.
const FREQUENCIES: [&str; 11] = [
    "f",
    "fn",
    "freq",
    "frequency",
    "frequenz",
    "eigenfrequency",
    "eigenfrequenz",
    "natural frequency",
    "mode",
    "frequency of mode",
    "frequency mode",
];
/// Names of a standard deviation before the frequency.
const STANDARD_DEVIATIONS: [&str; 4] = ["std", "sd", "sigma", "standard deviation of"];
/// Ends of the names of covariates that are units: `Temperature` may be `temperature_c`, and not `temperature_deck`.
const UNITS: [&str; 24] = [
    "c", "k", "f", "percent", "m_per_s", "m_s", "mps", "km_per_h", "km_h", "pa", "hpa", "kpa", "mbar", "bar", "n",
    "kn", "kg", "t", "mm", "cm", "m", "deg", "per_s", "w_per_m2",
];
const TIMES: [&str; 10] = [
    "measured at",
    "datetime",
    "date time",
    "timestamp",
    "time stamp",
    "zeitstempel",
    "zeitpunkt",
    "datum uhrzeit",
    "datum zeit",
    "date and time",
];
const DATES: [&str; 2] = ["date", "datum"];
const TIMES_OF_DAY: [&str; 5] = ["time", "uhrzeit", "zeit", "time of day", "clock"];

/// What the cells of a column are.
#[derive(Debug, Clone, PartialEq)]
pub enum Meaning {
    /// Not read.
    Ignored,
    /// A column without a name, which must not have values.
    Unnamed,
    /// Not recognised.
    Unknown,
    /// Times, dates, or times of day.
    Clock(ClockColumn),
    /// A column of the service, by its name such as `f1_hz`.
    Value(String, Column),
}

/// What a column of times contains.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ClockColumn {
    /// Date and time of day.
    Time,
    /// Dates, to which a column of times of day may belong.
    Date,
    /// Times of day, or whole times if no column has dates.
    TimeOfDay,
}

/// A column of a table.
#[derive(Debug, Clone, PartialEq)]
pub struct HeaderColumn {
    /// Text in the header, without control characters and cut to 80 characters.
    pub name: String,
    /// What its cells are.
    pub meaning: Meaning,
    /// How its numbers become those of the service.
    pub conversion: Conversion,
    /// Whether the header says that its times are UTC.
    pub utc: bool,
    /// Why it is this, and in which unit.
    pub reason: String,
}

/// What a table may contain.
#[derive(Debug, Clone, Copy)]
pub struct Layout<'a> {
    /// Number of modes.
    pub modes: usize,
    /// Declared covariates.
    pub covariates: &'a [Covariate],
    /// Instrumented points; empty if the structure has none.
    pub points: &'a [String],
}

impl HeaderColumn {
    fn new(name: &str, meaning: Meaning, reason: impl Into<String>) -> Self {
        let name = name.chars().filter(|c| !c.is_control()).take(LONGEST_NAME).collect();
        let reason = reason.into();
        Self { name, meaning, conversion: Conversion::None, utc: false, reason }
    }

    /// A column of which the mistake has been named.
    pub fn unknown(name: &str) -> Self {
        Self::new(name, Meaning::Unknown, "")
    }

    /// How an option names the column, whose number is given: by its name where that is short and plain.
    pub fn reference(&self, number: usize) -> String {
        let plain = !self.name.contains([',', '=']) && self.name.chars().count() <= LONGEST_REFERENCE;
        if plain {
            self.name.clone()
        } else {
            format!("#{number}")
        }
    }

    fn add_reason(&mut self, more: &str) {
        self.reason.push_str("; ");
        self.reason.push_str(more);
    }

    /// Whether its cells are numbers of the table.
    pub fn is_numeric(&self) -> bool {
        match &self.meaning {
            Meaning::Value(_, Column::Covariate(_, kind)) => *kind == CovariateKind::Number,
            Meaning::Value(..) => true,
            _ => false,
        }
    }

    /// Its role, for the sender.
    pub fn role(&self) -> ColumnRole {
        match &self.meaning {
            Meaning::Ignored | Meaning::Unnamed => ColumnRole::Ignored,
            Meaning::Unknown => ColumnRole::Unknown,
            Meaning::Clock(_) | Meaning::Value(_, Column::Time) => ColumnRole::Time,
            Meaning::Value(_, Column::Covariate(..)) => ColumnRole::Covariate,
            Meaning::Value(_, Column::Setting(_)) => ColumnRole::Setting,
            Meaning::Value(_, Column::Shape(..) | Column::ShapeElsewhere(_)) => ColumnRole::Shape,
            Meaning::Value(..) => ColumnRole::Mode,
        }
    }

    /// What its cells become.
    pub fn target(&self) -> Option<String> {
        match &self.meaning {
            Meaning::Ignored | Meaning::Unnamed | Meaning::Unknown => None,
            Meaning::Clock(ClockColumn::Time) => Some("time".to_owned()),
            Meaning::Clock(ClockColumn::Date) => Some("date".to_owned()),
            Meaning::Clock(ClockColumn::TimeOfDay) => Some("time_of_day".to_owned()),
            Meaning::Value(canonical, _) => Some(canonical.clone()),
        }
    }
}

/// Recognises a column by its header; `number` is that of the column, from 1.
///
/// # Errors
/// A sentence for a unit that is not known, or a target that does not exist.
pub fn recognise(
    name: &str,
    number: usize,
    layout: &Layout<'_>,
    options: &TableOptions,
) -> Result<HeaderColumn, String> {
    let name = name.trim();
    if options.ignore.iter().any(|ignored| ignored.is(name, number)) {
        return Ok(HeaderColumn::new(name, Meaning::Ignored, "ignored as asked"));
    }
    if let Some(assigned) = options.columns.iter().find(|assigned| assigned.column.is(name, number)) {
        return by_target(name, &assigned.target, layout, options);
    }
    if name.is_empty() {
        return Ok(HeaderColumn::new(name, Meaning::Unnamed, "it has neither a name nor values"));
    }
    if let Some(known) = known(name, layout) {
        return Ok(HeaderColumn::new(name, known, "its name is that of the service"));
    }
    let (base, unit) = base_and_unit(name);
    if let Some(clock) = clock(&base) {
        let utc = unit.as_deref().is_some_and(|unit| ["utc", "gmt", "z"].contains(&unit.to_ascii_lowercase().as_str()));
        let mut column = HeaderColumn::new(name, Meaning::Clock(clock), "its name is that of a time");
        if utc {
            column.utc = true;
            column.add_reason("in UTC, as the header says");
        }
        return Ok(column);
    }
    if let Some(found) = frequency(name, &base, unit.as_deref(), options)? {
        return Ok(found);
    }
    Ok(covariate(name, &base, unit.as_deref(), layout)?
        .unwrap_or_else(|| HeaderColumn::new(name, Meaning::Unknown, "its name is not known")))
}

/// Columns that the sender names and the table does not have.
pub fn absent<'a>(header: &[String], options: &'a TableOptions) -> Vec<&'a Named> {
    let named = options.columns.iter().map(|assigned| &assigned.column).chain(&options.ignore);
    let is_there = |named: &Named| header.iter().enumerate().any(|(index, name)| named.is(name, index + 1));
    named.filter(|named| !is_there(named)).collect()
}

/// A column with a name of the service.
fn known(name: &str, layout: &Layout<'_>) -> Option<Meaning> {
    let options = CsvOptions { points: layout.points.to_vec(), ..CsvOptions::default() };
    let found = column(name, layout.covariates, &options)?;
    Some(match &found {
        Column::Time => Meaning::Clock(ClockColumn::Time),
        Column::Covariate(covariate, _) => Meaning::Value(covariate.clone(), found),
        Column::Frequency(_) | Column::Std(_) => Meaning::Value(name.to_ascii_lowercase(), found),
        _ => Meaning::Value(name.to_owned(), found),
    })
}

/// A column that the sender assigned to a target.
fn by_target(name: &str, target: &str, layout: &Layout<'_>, options: &TableOptions) -> Result<HeaderColumn, String> {
    let said = format!("read as {target}, as asked");
    let clock = match target.to_ascii_lowercase().as_str() {
        "time" | "measured_at" => Some(ClockColumn::Time),
        "date" => Some(ClockColumn::Date),
        "time_of_day" => Some(ClockColumn::TimeOfDay),
        _ => None,
    };
    if let Some(clock) = clock {
        return Ok(HeaderColumn::new(name, Meaning::Clock(clock), said));
    }
    let (_, unit) = base_and_unit(name);
    // `f1` and `std_f1` are short for `f1_hz` and `std_f1_hz`.
    let canonical = [target.to_owned(), format!("{target}_hz")].into_iter().find_map(|t| known(&t, layout));
    let Some(meaning) = canonical else {
        let covariates: Vec<&str> = layout.covariates.iter().map(|c| c.name.as_str()).collect();
        let covariates = if covariates.is_empty() { String::new() } else { format!(", {}", covariates.join(", ")) };
        return Err(format!(
            "{} is not a target: a column can be time, date, time_of_day, f1 to f{modes}, std_f1 to std_f{modes}, \
             set_<parameter>{covariates}",
            shown(target),
            modes = layout.modes
        ));
    };
    let mut column = HeaderColumn::new(name, meaning, said);
    match &column.meaning {
        Meaning::Value(_, Column::Frequency(_) | Column::Std(_)) => with_unit(&mut column, unit.as_deref(), options)?,
        Meaning::Value(canonical, Column::Covariate(_, CovariateKind::Number)) => {
            let declared = layout.covariates.iter().find(|c| c.name == *canonical).cloned();
            if let Some(covariate) = declared {
                convert(&mut column, &covariate, unit.as_deref())?;
            }
        }
        _ => {}
    }
    Ok(column)
}

/// A header without its unit, in lower case with single blanks, and the unit in brackets at its end, or `hz` as its last word.
fn base_and_unit(name: &str) -> (String, Option<String>) {
    let name = name.trim();
    let bracketed = [('(', ')'), ('[', ']')].into_iter().find_map(|(open, close)| {
        let inner = name.strip_suffix(close)?;
        let (base, unit) = inner.rsplit_once(open)?;
        (!unit.trim().is_empty()).then(|| (base.to_owned(), unit.trim().to_owned()))
    });
    let comma = || {
        let (base, unit) = name.rsplit_once(" in ")?;
        Some((base.to_owned(), unit.trim().to_owned()))
    };
    let (base, unit) = match bracketed.or_else(comma) {
        Some((base, unit)) => (base, Some(unit)),
        None => (name.to_owned(), None),
    };
    let spaced: String = base.chars().map(|c| if "_-./:".contains(c) { ' ' } else { c }).collect();
    let words: Vec<String> = spaced.split_whitespace().map(str::to_lowercase).collect();
    match (&unit, words.split_last()) {
        (None, Some((last, before))) if !before.is_empty() && FrequencyUnit::parse(last).is_ok() => {
            (before.join(" "), Some(last.clone()))
        }
        _ => (words.join(" "), unit),
    }
}

fn clock(base: &str) -> Option<ClockColumn> {
    let is = |names: &[&str]| names.contains(&base);
    if is(&TIMES) {
        Some(ClockColumn::Time)
    } else if is(&DATES) {
        Some(ClockColumn::Date)
    } else {
        is(&TIMES_OF_DAY).then_some(ClockColumn::TimeOfDay)
    }
}

/// A frequency or its standard deviation: a word for it, and the number of the mode, from 1.
fn frequency(
    name: &str,
    base: &str,
    unit: Option<&str>,
    options: &TableOptions,
) -> Result<Option<HeaderColumn>, String> {
    let std = STANDARD_DEVIATIONS.iter().find_map(|word| base.strip_prefix(word)?.strip_prefix(' '));
    let frequency = std.unwrap_or(base);
    let digits = frequency.trim_end_matches(|c: char| c.is_ascii_digit());
    let number: Option<usize> = frequency[digits.len()..].parse().ok();
    let Some(mode) = number.and_then(|n| n.checked_sub(1)).filter(|_| FREQUENCIES.contains(&digits.trim_end())) else {
        return Ok(None);
    };
    let (canonical, kind) = match std {
        Some(_) => (format!("std_f{}_hz", mode + 1), Column::Std(mode)),
        None => (format!("f{}_hz", mode + 1), Column::Frequency(mode)),
    };
    let mut column = HeaderColumn::new(name, Meaning::Value(canonical, kind), format!("mode {} by its name", mode + 1));
    with_unit(&mut column, unit, options)?;
    Ok(Some(column))
}

/// Sets the conversion of frequencies to Hz, and says in which unit they are read.
fn with_unit(column: &mut HeaderColumn, unit: Option<&str>, options: &TableOptions) -> Result<(), String> {
    let stated =
        unit.map(FrequencyUnit::parse).transpose().map_err(|e| format!("column {}: {e}", shown(&column.name)))?;
    let (unit, why) = match (stated, options.unit) {
        (Some(stated), _) => (stated, "as the header says"),
        (None, Some(unit)) => (unit, "as asked"),
        (None, None) => (FrequencyUnit::Hertz, "because the header names no unit"),
    };
    column.conversion = unit.conversion();
    column.add_reason(&format!("in {}, {why}", unit.symbol()));
    Ok(())
}

/// A declared covariate whose name is that of the header with the unit at its end.
fn covariate(name: &str, base: &str, unit: Option<&str>, layout: &Layout<'_>) -> Result<Option<HeaderColumn>, String> {
    let base = base.replace(' ', "_");
    let stem = |covariate: &Covariate| {
        let lower = covariate.name.to_lowercase();
        let unit = lower.strip_prefix(&base).and_then(|rest| rest.strip_prefix('_'));
        lower == base || unit.is_some_and(|unit| UNITS.contains(&unit))
    };
    let mut found = layout.covariates.iter().filter(|c| stem(c));
    let (Some(covariate), None) = (found.next(), found.next()) else { return Ok(None) };
    let meaning = Meaning::Value(covariate.name.clone(), Column::Covariate(covariate.name.clone(), covariate.kind));
    let mut column = HeaderColumn::new(name, meaning, "a covariate by its name");
    convert(&mut column, covariate, unit)?;
    Ok(Some(column))
}

/// Sets the conversion of a covariate from the unit in the header to the stated one, or else the one in its name.
fn convert(column: &mut HeaderColumn, covariate: &Covariate, unit: Option<&str>) -> Result<(), String> {
    let Some(unit) = unit else {
        column.add_reason("in the unit of the covariate, because the header names none");
        return Ok(());
    };
    let (stated, lower) = (suffix(unit), covariate.name.to_lowercase());
    let own = covariate.unit.as_deref().map(suffix);
    if own.as_ref().map_or_else(|| lower.ends_with(&format!("_{stated}")), |own| *own == stated) {
        column.add_reason(&format!("in {unit}, as the header says"));
        return Ok(());
    }
    let own = own.unwrap_or_else(|| lower.rsplit_once('_').map_or_else(String::new, |(_, own)| own.to_owned()));
    let Some(conversion) = between_temperatures(&stated, &own) else {
        return Err(format!(
            "column {}: its unit {} is not that of the covariate {}; convert the column, or name it without a unit if the \
             numbers are right",
            shown(&column.name),
            shown(unit),
            covariate.name
        ));
    };
    column.conversion = conversion;
    column.add_reason(&format!("converted from {unit}"));
    Ok(())
}
