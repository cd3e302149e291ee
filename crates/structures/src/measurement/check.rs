//! Checks raw measurements and locates every mistake in the input.

use std::collections::{BTreeMap, HashSet};

use serde::Serialize;

use super::shape::InstrumentedPoints;
use super::{Covariate, CovariateKind, CovariateValue, ModalMeasurement};
use crate::parameter::ParameterSpace;
use crate::quantity::{shown, Hertz, Timestamp};

/// Largest number of problems reported for one batch: a table with the wrong separator would have thousands.
const MOST_PROBLEMS: usize = 20;

/// A client's clock may be ahead of the clock of the service by this much, µs.
const CLOCK_SKEW_MICROS: i64 = 5 * 60 * 1_000_000;

/// Largest length of the text of a category, characters.
const LONGEST_CATEGORY: usize = 64;

/// Where a measurement is in the input.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FieldPath {
    /// In the list `measurements` of a JSON body.
    Json {
        /// Index in the list, from 0.
        index: usize,
    },
    /// In a CSV table.
    Csv {
        /// Line of the file, from 1.
        line: u64,
    },
}

/// A measurement as received, not checked yet.
#[derive(Debug, Clone, PartialEq)]
pub struct RawMeasurement {
    /// Where the measurement is in the input.
    pub path: FieldPath,
    /// Time of the measurement, RFC 3339 with an offset.
    pub measured_at: Option<String>,
    /// Frequency of each mode, Hz; `None` for a mode that was not identified.
    pub frequencies_hz: Vec<Option<f64>>,
    /// Standard deviation of each frequency, Hz.
    pub std_hz: Option<Vec<Option<f64>>>,
    /// Shape of each mode at the instrumented points.
    pub mode_shapes: Option<Vec<Option<Vec<f64>>>>,
    /// Values of covariates.
    pub covariates: BTreeMap<String, CovariateValue>,
    /// Values of parameters that the experimenter set.
    pub settings: BTreeMap<String, f64>,
}

/// A mistake in the input.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, utoipa::ToSchema)]
#[schema(as = InputProblem)]
pub struct Problem {
    /// JSON pointer, or line and column of a table.
    pub pointer: String,
    /// What is wrong, and what would be right.
    pub message: String,
}

impl Problem {
    /// A mistake at a JSON pointer, or at a line and column.
    pub fn new(pointer: impl Into<String>, message: impl Into<String>) -> Self {
        Self { pointer: pointer.into(), message: message.into() }
    }
}

/// What measurements are used for.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Purpose {
    /// They are stored and assessed by a trained model: settings must lie within their priors, and times after 1970.
    #[default]
    Assessment,
    /// They show where the simulation is wrong: settings beyond their priors are then a result and not a mistake, and only the
    /// differences of the times matter.
    Diagnosis,
}

/// What the measurements of a structure must satisfy.
#[derive(Debug, Clone, Copy)]
pub struct Expectation<'a> {
    /// What they are used for.
    pub purpose: Purpose,
    /// Number of modes.
    pub modes: usize,
    /// Limits of plausible frequencies, Hz. A frequency outside them is in a wrong unit or in a wrong column.
    pub frequency_limits_hz: (f64, f64),
    /// Declared covariates.
    pub covariates: &'a [Covariate],
    /// Instrumented points; `None` if mode shapes are not measured.
    pub instrumented: Option<&'a InstrumentedPoints>,
    /// Parameters, whose priors bound the settings.
    pub space: &'a ParameterSpace,
    /// The time now.
    pub now: Timestamp,
    /// Largest number of measurements in a batch.
    pub max_measurements: usize,
}

/// Part of a measurement, for the pointer in a message.
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

impl FieldPath {
    /// Pointer to a covariate of this measurement, whether it is present or missing.
    pub fn of_covariate(self, name: &str) -> String {
        self.of(&Field::Covariate(name))
    }

    /// Pointer to the time of this measurement.
    pub fn of_time(self) -> String {
        self.of(&Field::Time)
    }

    /// Pointer to a setting of this measurement, whether it is present or missing.
    pub fn of_setting(self, name: &str) -> String {
        self.of(&Field::Setting(name))
    }

    /// Pointer to the whole measurement.
    pub fn of_row(self) -> String {
        self.of(&Field::Frequencies)
    }

    /// Pointer to a part of this measurement.
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

/// A name as a segment of a JSON pointer, cut to 80 characters.
fn escaped(name: &str) -> String {
    name.chars().take(80).collect::<String>().replace('~', "~0").replace('/', "~1")
}

/// The mistakes found so far; those after the first [`MOST_PROBLEMS`] are only counted.
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

/// The problem of a batch with more measurements than it may have.
pub fn too_many(count: usize, most: usize) -> Problem {
    Problem::new("/measurements", format!("{count} measurements: a batch may contain at most {most}"))
}

/// Checks the measurements of one batch.
///
/// A measurement of which no mode was identified is kept as long as another one has a frequency.
///
/// # Errors
/// The mistakes with their pointers: at most 20, and the number of further ones.
pub fn check_measurements(
    raw: Vec<RawMeasurement>,
    expectation: &Expectation<'_>,
) -> Result<Vec<ModalMeasurement>, Vec<Problem>> {
    if raw.is_empty() {
        return Err(vec![Problem::new("/measurements", "the batch is empty: send at least one measurement")]);
    }
    if raw.len() > expectation.max_measurements {
        return Err(vec![too_many(raw.len(), expectation.max_measurements)]);
    }
    let mut problems = Problems { found: Vec::new(), more: 0 };
    let empty = |raw: &RawMeasurement| {
        raw.frequencies_hz.len() == expectation.modes && raw.frequencies_hz.iter().all(Option::is_none)
    };
    if raw.iter().all(empty) {
        problems.add("/measurements".to_owned(), "no measurement has a frequency: omit the batch");
    }
    let mut times = HashSet::new();
    let checked = raw.into_iter().filter_map(|raw| check_one(raw, expectation, &mut times, &mut problems)).collect();
    problems.into_result(checked)
}

/// Checks measurements one after the other, of which no two may have the same time.
pub struct EachCheck<'a> {
    expectation: Expectation<'a>,
    /// Times of the measurements so far, µs after 1970.
    times: HashSet<i64>,
}

impl<'a> EachCheck<'a> {
    /// A check that has seen no measurement.
    pub fn new(expectation: Expectation<'a>) -> Self {
        Self { expectation, times: HashSet::new() }
    }

    /// Checks the next measurement.
    ///
    /// # Errors
    /// Its first mistake.
    pub fn check(&mut self, raw: RawMeasurement) -> Result<ModalMeasurement, Problem> {
        let mut problems = Problems { found: Vec::new(), more: 0 };
        if raw.frequencies_hz.iter().all(Option::is_none) {
            problems.add(raw.path.of(&Field::Frequencies), "all modes are missing: omit the measurement");
        }
        let checked = check_one(raw, &self.expectation, &mut self.times, &mut problems);
        match problems.found.into_iter().next() {
            Some(problem) => Err(problem),
            None => Ok(checked.expect("a measurement without problems has a time")),
        }
    }
}

/// Checks measurements one by one: each of them, or its first mistake.
pub fn check_each(raw: Vec<RawMeasurement>, expectation: &Expectation<'_>) -> Vec<Result<ModalMeasurement, Problem>> {
    let mut each = EachCheck::new(*expectation);
    raw.into_iter().map(|raw| each.check(raw)).collect()
}

/// Checks one measurement; `times` are those of the measurements before it, µs after 1970. `None` if its time is not valid.
fn check_one(
    raw: RawMeasurement,
    expectation: &Expectation<'_>,
    times: &mut HashSet<i64>,
    problems: &mut Problems,
) -> Option<ModalMeasurement> {
    let measured_at = check_time(&raw, expectation, problems);
    if measured_at.is_some_and(|time| !times.insert(time.micros())) {
        let message = "another measurement of this batch has the same time: a measurement is identified by its time";
        problems.add(raw.path.of(&Field::Time), message);
    }
    let frequencies_hz = check_frequencies(&raw, expectation, problems);
    check_std(&raw, expectation.modes, problems);
    check_shapes(&raw, expectation, problems);
    check_covariates(&raw, expectation.covariates, problems);
    check_settings(&raw, expectation, problems);
    Some(ModalMeasurement {
        measured_at: measured_at?,
        frequencies_hz,
        std_hz: raw.std_hz,
        mode_shapes: raw.mode_shapes,
        covariates: raw.covariates,
        settings: raw.settings,
    })
}

fn check_time(raw: &RawMeasurement, expectation: &Expectation<'_>, problems: &mut Problems) -> Option<Timestamp> {
    let Expectation { purpose, now, .. } = *expectation;
    let pointer = || raw.path.of(&Field::Time);
    let Some(text) = &raw.measured_at else {
        problems.add(pointer(), "measured_at is missing: RFC 3339 with an offset, such as 2026-03-01T12:00:00Z");
        return None;
    };
    match Timestamp::parse(text) {
        Err(error) => problems.add(pointer(), error.to_string()),
        Ok(time) if purpose == Purpose::Assessment && time.micros() < 0 => {
            problems.add(pointer(), format!("{time} is before 1970: it must be later"));
        }
        Ok(time) if time.micros() > now.micros() + CLOCK_SKEW_MICROS => {
            problems.add(pointer(), format!("{time} is in the future: the clock of the service shows {now}"));
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
        problems.add(raw.path.of(&Field::Frequencies), message);
        return Vec::new();
    }
    let mut frequencies = Vec::with_capacity(modes);
    let (lowest, highest) = expectation.frequency_limits_hz;
    for (mode, value) in raw.frequencies_hz.iter().enumerate() {
        let pointer = || raw.path.of(&Field::Frequency(mode));
        let hertz = value.map(Hertz::new).transpose().unwrap_or_else(|error| {
            problems.add(pointer(), error.to_string());
            None
        });
        if let Some(outside) = hertz.map(Hertz::get).filter(|f| !(lowest..=highest).contains(f)) {
            let unit = if outside < lowest { "it seems to be in kHz" } else { "it must be in Hz" };
            let message = format!(
                "{outside} Hz is far outside the range of this structure ({lowest:.3e} to {highest:.3e} Hz): {unit}"
            );
            problems.add(pointer(), message);
        }
        frequencies.push(hertz);
    }
    frequencies
}

fn check_std(raw: &RawMeasurement, modes: usize, problems: &mut Problems) {
    let Some(stds) = &raw.std_hz else { return };
    if stds.len() != modes {
        let message = format!("{} standard deviations, expected {modes}: one for each mode, or null", stds.len());
        problems.add(raw.path.of(&Field::Stds), message);
    }
    for (mode, std) in stds.iter().enumerate() {
        let Some(std) = *std else { continue };
        let frequency_hz = raw.frequencies_hz.get(mode).copied().flatten();
        let message = match frequency_hz {
            _ if !(std.is_finite() && std > 0.0) => {
                format!("a standard deviation of {std} Hz: it must be finite and above 0")
            }
            Some(frequency_hz) if std >= frequency_hz => format!(
                "a standard deviation of {std} Hz for a frequency of {frequency_hz} Hz: it must be smaller than the frequency, in Hz as well"
            ),
            _ => continue,
        };
        problems.add(raw.path.of(&Field::Std(mode)), message);
    }
}

fn check_shapes(raw: &RawMeasurement, expectation: &Expectation<'_>, problems: &mut Problems) {
    let Some(shapes) = &raw.mode_shapes else { return };
    let Some(instrumented) = expectation.instrumented else {
        let message =
            "this structure has no instrumented points: declare mode_shapes in its structure file, or omit them here";
        problems.add(raw.path.of(&Field::Shapes), message);
        return;
    };
    if shapes.len() != expectation.modes {
        let (found, modes) = (shapes.len(), expectation.modes);
        let message = format!("{found} shapes, expected {modes}: one for each mode, or null");
        problems.add(raw.path.of(&Field::Shapes), message);
    }
    for (mode, shape) in shapes.iter().enumerate() {
        let Some(shape) = shape else { continue };
        if let Some(mistake) = instrumented.mistake(shape) {
            problems.add(raw.path.of(&Field::Shape(mode)), mistake);
        } else if raw.frequencies_hz.get(mode).is_some_and(Option::is_none) {
            let message = "this mode has a shape but no frequency: send both, or null for both";
            problems.add(raw.path.of(&Field::Shape(mode)), message);
        }
    }
}

fn check_covariates(raw: &RawMeasurement, declared: &[Covariate], problems: &mut Problems) {
    for (name, value) in &raw.covariates {
        let mut add = |message: String| problems.add(raw.path.of(&Field::Covariate(name)), message);
        let Some(covariate) = declared.iter().find(|c| c.name == *name) else {
            let names: Vec<&str> = declared.iter().map(|c| c.name.as_str()).collect();
            let known = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
            add(format!("{} is not a covariate of this structure (declared: {known})", shown(name)));
            continue;
        };
        match (covariate.kind, value) {
            (CovariateKind::Number, CovariateValue::Number(number)) if !number.is_finite() => {
                add(format!("{name} is {number}: it must be finite"));
            }
            (CovariateKind::Number, CovariateValue::Category(text)) => {
                add(format!("{} is text, and {name} is declared as a number: send a number", shown(text)));
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

fn check_settings(raw: &RawMeasurement, expectation: &Expectation<'_>, problems: &mut Problems) {
    for (name, value) in &raw.settings {
        let message = match expectation.space.iter().find(|p| p.name == *name) {
            None => format!("{} is not a parameter of this structure", shown(name)),
            Some(_) if !value.is_finite() => format!("{value} is not finite: omit a setting that is not known"),
            Some(p) if expectation.purpose == Purpose::Assessment && !(p.lower..=p.upper).contains(value) => {
                format!("{value} {} is outside the prior of {name}, {} to {}", p.unit, p.lower, p.upper)
            }
            Some(_) => continue,
        };
        problems.add(raw.path.of(&Field::Setting(name)), message);
    }
}

/// Checks the name of the source of a batch.
///
/// # Errors
/// A [`Problem`] unless it is 1 to 64 of letters, digits, `-`, `_`, `.`, `:`.
pub fn check_source(source: &str) -> Result<(), Problem> {
    let allowed = |c: char| c.is_ascii_alphanumeric() || "-_.:".contains(c);
    let valid = (1..=64).contains(&source.len()) && source.chars().all(allowed);
    let message = || format!("{} must be 1 to 64 of letters, digits, '-', '_', '.', ':'", shown(source));
    valid.then_some(()).ok_or_else(|| Problem::new("/source", message()))
}

/// Checks an idempotency key.
///
/// # Errors
/// A [`Problem`] unless it is 1 to 128 visible ASCII characters.
pub fn check_idempotency_key(key: &str) -> Result<(), Problem> {
    let valid = (1..=128).contains(&key.len()) && key.bytes().all(|b| b.is_ascii_graphic());
    let message = || format!("{} must be 1 to 128 visible ASCII characters", shown(key));
    valid.then_some(()).ok_or_else(|| Problem::new("header/Idempotency-Key", message()))
}
