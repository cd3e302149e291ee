//! The rules a measurement must keep: raw values in, checked ones out, every mistake with its place.

use std::collections::{BTreeMap, BTreeSet};

use serde::Serialize;

use super::shape::InstrumentedPoints;
use super::{Covariate, CovariateKind, CovariateValue, ModalMeasurement};
use crate::parameter::ParameterSpace;
use crate::quantity::{shown, Hertz, Timestamp};

/// Problems reported of one batch; a table with the wrong separator would have thousands.
const MOST_PROBLEMS: usize = 20;

/// A clock may run ahead of ours by this much, µs.
const CLOCK_SKEW_MICROS: i64 = 5 * 60 * 1_000_000;

/// Longest text of a category, characters.
const LONGEST_CATEGORY: usize = 64;

/// Where a measurement stood.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Place {
    /// In the list `measurements` of a JSON body.
    Json {
        /// From 0.
        index: usize,
    },
    /// In a table.
    Csv {
        /// Line of the file, from 1.
        line: u64,
    },
}

/// A measurement as it came.
#[derive(Debug, Clone, PartialEq)]
pub struct RawMeasurement {
    /// Where it stood.
    pub place: Place,
    /// RFC 3339 with an offset.
    pub measured_at: Option<String>,
    /// Hz, `None` for a mode that was not identified.
    pub frequencies_hz: Vec<Option<f64>>,
    /// Standard deviation of each frequency, Hz.
    pub std_hz: Option<Vec<Option<f64>>>,
    /// Shape of each mode.
    pub mode_shapes: Option<Vec<Option<Vec<f64>>>>,
    /// Values of covariates.
    pub covariates: BTreeMap<String, CovariateValue>,
    /// Parameters the experimenter set.
    pub settings: BTreeMap<String, f64>,
}

/// A mistake in the input and its place.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, utoipa::ToSchema)]
#[schema(as = InputProblem)]
pub struct Problem {
    /// JSON pointer, or line and column of a table.
    pub pointer: String,
    /// What is wrong and what would be right.
    pub message: String,
}

impl Problem {
    /// A mistake at a place.
    pub fn new(pointer: impl Into<String>, message: impl Into<String>) -> Self {
        Self { pointer: pointer.into(), message: message.into() }
    }
}

/// What the measurements of a structure must look like.
#[derive(Debug, Clone, Copy)]
pub struct Expectation<'a> {
    /// Number of modes.
    pub modes: usize,
    /// Frequencies outside these limits, Hz, are a mistake of unit or place.
    pub frequency_limits_hz: (f64, f64),
    /// Declared covariates.
    pub covariates: &'a [Covariate],
    /// Points whose motion gives mode shapes; `None` where none are measured.
    pub instrumented: Option<&'a InstrumentedPoints>,
    /// Parameters, whose priors bound the settings.
    pub space: &'a ParameterSpace,
    /// The time now.
    pub now: Timestamp,
    /// Most measurements of a batch.
    pub max_measurements: usize,
}

/// Part of a measurement, for its place in a message.
enum Field<'a> {
    Time,
    Frequencies,
    Frequency(usize),
    Stds,
    Std(usize),
    Shapes,
    Shape(usize),
    Covariate(&'a str),
    Setting(&'a str),
}

impl Place {
    /// Where a covariate of this measurement stands, or should.
    pub fn of_covariate(self, name: &str) -> String {
        self.of(&Field::Covariate(name))
    }

    fn of(self, field: &Field<'_>) -> String {
        match self {
            Self::Json { index } => {
                let path = match field {
                    Field::Time => "/measured_at".to_owned(),
                    Field::Frequencies => "/frequencies_hz".to_owned(),
                    Field::Frequency(mode) => format!("/frequencies_hz/{mode}"),
                    Field::Stds => "/std_hz".to_owned(),
                    Field::Std(mode) => format!("/std_hz/{mode}"),
                    Field::Shapes => "/mode_shapes".to_owned(),
                    Field::Shape(mode) => format!("/mode_shapes/{mode}"),
                    Field::Covariate(name) => format!("/covariates/{}", escaped(name)),
                    Field::Setting(name) => format!("/settings/{}", escaped(name)),
                };
                format!("/measurements/{index}{path}")
            }
            Self::Csv { line } => match field {
                Field::Frequencies | Field::Stds | Field::Shapes | Field::Shape(_) => format!("line {line}"),
                Field::Time => format!("line {line}, column measured_at"),
                Field::Frequency(mode) => format!("line {line}, column f{}_hz", mode + 1),
                Field::Std(mode) => format!("line {line}, column std_f{}_hz", mode + 1),
                Field::Covariate(name) => format!("line {line}, column {name}"),
                Field::Setting(name) => format!("line {line}, column set_{name}"),
            },
        }
    }
}

/// A name as a segment of a JSON pointer, cut to a readable length.
fn escaped(name: &str) -> String {
    name.chars().take(80).collect::<String>().replace('~', "~0").replace('/', "~1")
}

/// The mistakes found so far; those beyond [`MOST_PROBLEMS`] are only counted.
struct Problems {
    found: Vec<Problem>,
    more: usize,
}

impl Problems {
    fn add(&mut self, pointer: String, message: impl Into<String>) {
        if self.found.len() < MOST_PROBLEMS {
            self.found.push(Problem::new(pointer, message));
        } else {
            self.more += 1;
        }
    }

    fn into_result<T>(mut self, value: T) -> Result<T, Vec<Problem>> {
        if self.more > 0 {
            self.found.push(Problem::new("", format!("and {} more problems", self.more)));
        }
        if self.found.is_empty() {
            Ok(value)
        } else {
            Err(self.found)
        }
    }
}

/// Checks the measurements of one batch.
///
/// # Errors
/// Every mistake with its place, at most 20 and the number of the others.
pub fn check_measurements(
    raw: Vec<RawMeasurement>,
    expectation: &Expectation<'_>,
) -> Result<Vec<ModalMeasurement>, Vec<Problem>> {
    if raw.is_empty() {
        return Err(vec![Problem::new("/measurements", "the batch is empty: send at least one measurement")]);
    }
    if raw.len() > expectation.max_measurements {
        let message = format!("{} measurements: at most {} in a batch", raw.len(), expectation.max_measurements);
        return Err(vec![Problem::new("/measurements", message)]);
    }
    let mut problems = Problems { found: Vec::new(), more: 0 };
    let mut times = BTreeSet::new();
    let mut checked = Vec::with_capacity(raw.len());
    for measurement in raw {
        let place = measurement.place;
        let measured_at = check_time(&measurement, expectation.now, &mut problems);
        if measured_at.is_some_and(|time| !times.insert(time)) {
            let message = "another measurement of this batch has the same time: a measurement is known by its time";
            problems.add(place.of(&Field::Time), message);
        }
        let frequencies_hz = check_frequencies(&measurement, expectation, &mut problems);
        check_std(&measurement, expectation.modes, &mut problems);
        check_shapes(&measurement, expectation, &mut problems);
        check_covariates(&measurement, expectation.covariates, &mut problems);
        check_settings(&measurement, expectation.space, &mut problems);
        if let Some(measured_at) = measured_at {
            checked.push(ModalMeasurement {
                measured_at,
                frequencies_hz,
                std_hz: measurement.std_hz,
                mode_shapes: measurement.mode_shapes,
                covariates: measurement.covariates,
                settings: measurement.settings,
            });
        }
    }
    problems.into_result(checked)
}

fn check_time(raw: &RawMeasurement, now: Timestamp, problems: &mut Problems) -> Option<Timestamp> {
    let pointer = || raw.place.of(&Field::Time);
    let Some(text) = &raw.measured_at else {
        problems.add(pointer(), "measured_at is missing: RFC 3339 with an offset, such as 2026-03-01T12:00:00Z");
        return None;
    };
    match Timestamp::parse(text) {
        Err(error) => problems.add(pointer(), error.to_string()),
        Ok(time) if time.micros() < 0 => problems.add(pointer(), format!("{time} is before 1970")),
        Ok(time) if time.micros() > now.micros() + CLOCK_SKEW_MICROS => {
            problems.add(pointer(), format!("{time} is in the future: it is {now} here"));
        }
        Ok(time) => return Some(time),
    }
    None
}

fn check_frequencies(
    raw: &RawMeasurement,
    expectation: &Expectation<'_>,
    problems: &mut Problems,
) -> Vec<Option<Hertz>> {
    let (modes, found) = (expectation.modes, raw.frequencies_hz.len());
    if found != modes {
        let message = format!("{found} frequencies, expected {modes}: send null for a mode that was not identified");
        problems.add(raw.place.of(&Field::Frequencies), message);
        return Vec::new();
    }
    let mut frequencies = Vec::with_capacity(modes);
    let (lowest, highest) = expectation.frequency_limits_hz;
    for (mode, value) in raw.frequencies_hz.iter().enumerate() {
        let pointer = || raw.place.of(&Field::Frequency(mode));
        let hertz = value.map(Hertz::new).transpose().unwrap_or_else(|error| {
            problems.add(pointer(), error.to_string());
            None
        });
        if let Some(outside) = hertz.map(Hertz::get).filter(|f| !(lowest..=highest).contains(f)) {
            let unit = if outside < lowest { "it looks like kHz" } else { "is it in Hz?" };
            let message = format!(
                "{outside} Hz is far from anything this structure has ({lowest:.3e} to {highest:.3e} Hz): {unit}"
            );
            problems.add(pointer(), message);
        }
        frequencies.push(hertz);
    }
    if raw.frequencies_hz.iter().all(Option::is_none) {
        problems.add(raw.place.of(&Field::Frequencies), "all modes are missing: leave the measurement out");
    }
    frequencies
}

fn check_std(raw: &RawMeasurement, modes: usize, problems: &mut Problems) {
    let Some(stds) = &raw.std_hz else { return };
    if stds.len() != modes {
        let message = format!("{} standard deviations, expected {modes}, one for each mode or null", stds.len());
        problems.add(raw.place.of(&Field::Stds), message);
    }
    for (mode, std) in stds.iter().enumerate() {
        if let Some(std) = std.filter(|s| !(s.is_finite() && *s > 0.0)) {
            let message = format!("a standard deviation of {std} Hz: it must be finite and above 0");
            problems.add(raw.place.of(&Field::Std(mode)), message);
        }
    }
}

fn check_shapes(raw: &RawMeasurement, expectation: &Expectation<'_>, problems: &mut Problems) {
    let Some(shapes) = &raw.mode_shapes else { return };
    let Some(instrumented) = expectation.instrumented else {
        let message = "this structure has no instrumented points: declare mode_shapes in its file, or leave them out";
        problems.add(raw.place.of(&Field::Shapes), message);
        return;
    };
    if shapes.len() != expectation.modes {
        let (found, modes) = (shapes.len(), expectation.modes);
        let message = format!("{found} shapes, expected {modes}, one for each mode or null");
        problems.add(raw.place.of(&Field::Shapes), message);
    }
    for (mode, shape) in shapes.iter().enumerate() {
        let Some(shape) = shape else { continue };
        if let Some(mistake) = instrumented.mistake(shape) {
            problems.add(raw.place.of(&Field::Shape(mode)), mistake);
        } else if raw.frequencies_hz.get(mode).is_some_and(Option::is_none) {
            let message = "a shape of a mode without a frequency: send its frequency too, or null for both";
            problems.add(raw.place.of(&Field::Shape(mode)), message);
        }
    }
}

fn check_covariates(raw: &RawMeasurement, declared: &[Covariate], problems: &mut Problems) {
    for (name, value) in &raw.covariates {
        let mut add = |message: String| problems.add(raw.place.of(&Field::Covariate(name)), message);
        let Some(covariate) = declared.iter().find(|c| c.name == *name) else {
            let names: Vec<&str> = declared.iter().map(|c| c.name.as_str()).collect();
            let known = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
            add(format!("{} is no covariate of this structure (declared: {known})", shown(name)));
            continue;
        };
        match (covariate.kind, value) {
            (CovariateKind::Number, CovariateValue::Number(number)) if !number.is_finite() => {
                add(format!("{number} is not finite"));
            }
            (CovariateKind::Number, CovariateValue::Category(text)) => {
                add(format!("{} is no number, and {name} is declared as one", shown(text)));
            }
            (CovariateKind::Category, CovariateValue::Number(number)) => {
                add(format!("{number} is a number, and {name} is declared as a category: send text"));
            }
            (CovariateKind::Category, CovariateValue::Category(text)) => {
                let length = text.chars().count();
                if length == 0 || length > LONGEST_CATEGORY || text.chars().any(char::is_control) {
                    add(format!("{} must have 1 to {LONGEST_CATEGORY} printable characters", shown(text)));
                }
            }
            (CovariateKind::Number, CovariateValue::Number(_)) => {}
        }
    }
}

fn check_settings(raw: &RawMeasurement, space: &ParameterSpace, problems: &mut Problems) {
    for (name, value) in &raw.settings {
        let message = match space.iter().find(|p| p.name == *name) {
            None => format!("{} is no parameter of this structure", shown(name)),
            Some(p) if !(p.lower..=p.upper).contains(value) => {
                format!("{value} {} is outside the prior of {name}, {} to {}", p.unit, p.lower, p.upper)
            }
            Some(_) => continue,
        };
        problems.add(raw.place.of(&Field::Setting(name)), message);
    }
}

/// Checks the name of a source.
///
/// # Errors
/// A [`Problem`] unless it is 1 to 64 of letters, digits, `-`, `_`, `.`, `:`.
pub fn check_source(source: &str) -> Result<(), Problem> {
    let allowed = |c: char| c.is_ascii_alphanumeric() || "-_.:".contains(c);
    let valid = (1..=64).contains(&source.len()) && source.chars().all(allowed);
    let message = || format!("{} must be 1 to 64 of letters, digits, '-', '_', '.', ':'", shown(source));
    valid.then_some(()).ok_or_else(|| Problem::new("/source", message()))
}

/// Checks a client's key.
///
/// # Errors
/// A [`Problem`] unless it is 1 to 128 visible ASCII characters.
pub fn check_idempotency_key(key: &str) -> Result<(), Problem> {
    let valid = (1..=128).contains(&key.len()) && key.bytes().all(|b| b.is_ascii_graphic());
    let message = || format!("{} must be 1 to 128 visible ASCII characters", shown(key));
    valid.then_some(()).ok_or_else(|| Problem::new("header/Idempotency-Key", message()))
}
