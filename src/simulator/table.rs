//! The user's own finite-element runs as a simulation.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use nalgebra::DMatrix;

use super::definition::{DefinitionProblem, StructureDefinition};
use crate::emulator::{Emulator, FitError, Runs};
use crate::parameter::ParameterSpace;
use crate::quantity::{shown, Digest};

/// How far beyond the runs a prior may reach, as a share of their range: a Latin hypercube leaves that much of its edges
/// empty.
const BEYOND: f64 = 0.02;

/// Most runs, and most parameters and modes: fitting grows with the products.
const MOST_RUNS: usize = 5_000;
const MOST_COLUMNS: usize = 50;

/// Column that may stand beside parameters and frequencies, to number the runs.
const RUN_COLUMN: &str = "run";

/// Emulators kept in memory: a definition is read several times, and fitting thousands of runs takes a while.
const MOST_KEPT: usize = 16;

static KEPT: Mutex<BTreeMap<String, Arc<Emulator>>> = Mutex::new(BTreeMap::new());

/// An emulator of all frequencies in a table, of which a structure measures the first few.
#[derive(Debug, Clone)]
pub struct Table {
    emulator: Arc<Emulator>,
    runs: usize,
}

impl Table {
    /// The emulator.
    pub fn emulator(&self) -> &Emulator {
        &self.emulator
    }

    /// Number of runs it was made of.
    pub fn runs(&self) -> usize {
        self.runs
    }

    /// All frequencies of the table at `theta`, Hz.
    ///
    /// Polynomials run wild beyond the points they were fitted to: beyond the runs' range ln f goes on as a straight line.
    pub fn frequencies_hz(&self, theta: &[f64]) -> Vec<f64> {
        if self.within(theta) {
            return self.emulator.frequencies_hz(theta);
        }
        self.frequencies_and_jacobian(theta).0
    }

    /// The same with derivatives, Hz per parameter unit, `[m, d]`.
    pub fn frequencies_and_jacobian(&self, theta: &[f64]) -> (Vec<f64>, DMatrix<f64>) {
        if self.within(theta) {
            return self.emulator.frequencies_and_jacobian(theta);
        }
        let edge: Vec<f64> =
            theta.iter().zip(self.emulator.ranges()).map(|(x, [low, high])| x.clamp(low, high)).collect();
        let (mut frequencies, mut jacobian) = self.emulator.frequencies_and_jacobian(&edge);
        for (mode, f) in frequencies.iter_mut().enumerate() {
            let slope: f64 = (0..edge.len()).map(|k| jacobian[(mode, k)] / *f * (theta[k] - edge[k])).sum();
            jacobian.row_mut(mode).scale_mut(slope.exp());
            *f *= slope.exp();
        }
        (frequencies, jacobian)
    }

    /// Whether there are no runs at `theta`: beyond their range by more than a Latin hypercube leaves empty, or in a corner
    /// without any.
    pub fn is_outside(&self, theta: &[f64]) -> bool {
        let ranges = || theta.iter().zip(self.emulator.ranges());
        let beyond = |(x, [low, high]): (&f64, [f64; 2])| {
            let margin = BEYOND * (high - low);
            !(low - margin..=high + margin).contains(x)
        };
        let edge: Vec<f64> = ranges().map(|(x, [low, high])| x.clamp(low, high)).collect();
        ranges().any(beyond) || self.emulator.is_outside(&edge)
    }

    fn within(&self, theta: &[f64]) -> bool {
        theta.iter().zip(self.emulator.ranges()).all(|(x, [low, high])| (low..=high).contains(x))
    }

    /// Frequencies in the middle of the prior, Hz.
    pub(super) fn nominal_frequencies_hz(&self, space: &ParameterSpace, modes: usize) -> Vec<f64> {
        let middle: Vec<f64> = space.iter().map(|p| f64::midpoint(p.lower, p.upper)).collect();
        let mut frequencies = self.frequencies_hz(&middle);
        frequencies.truncate(modes);
        frequencies
    }

    /// What a user should know of it before relying on it.
    pub(super) fn warnings(&self, modes: usize) -> Vec<String> {
        let emulator = &self.emulator;
        let crossing = |c: &crate::emulator::Crossing| {
            format!(
                "modes {} and {} of the runs cross or veer: {:.2} % apart in run {}; the emulator is least sure there, and a \
                 measurement can have the two the other way round",
                c.lower_mode + 1,
                c.lower_mode + 2,
                100.0 * c.gap,
                c.run + 1
            )
        };
        let crossings = emulator.crossings().iter().filter(|c| c.lower_mode < modes).map(crossing);
        let poor = (0..modes).filter(|mode| emulator.r_squared(*mode) < 0.9).map(|mode| {
            format!(
                "mode {}: the emulator foretells only {:.0} % of what a run left out varies by (error {:.2} %): take more \
                 runs, or fewer parameters",
                mode + 1,
                100.0 * emulator.r_squared(mode).max(0.0),
                100.0 * emulator.relative_error(mode)
            )
        });
        crossings.chain(poor).collect()
    }
}

/// The emulator of a definition's table.
pub(super) fn emulate(definition: &StructureDefinition, space: &ParameterSpace) -> Result<Table, DefinitionProblem> {
    let wrong = |pointer: &str, message: String| DefinitionProblem::new(pointer, message);
    let Some(table) = &definition.table else {
        return Err(wrong("/table", "a simulation \"table\" needs its runs: [table] with file or csv".to_owned()));
    };
    let Some(csv) = &table.csv else {
        let message = "a file is read beside a structure file on disk only: send its text as csv";
        return Err(wrong("/table/file", message.to_owned()));
    };
    if table.file.is_some() {
        return Err(wrong("/table/file", "give file or csv, not both".to_owned()));
    }
    let runs = read_runs(csv, space, definition.modes).map_err(|message| wrong("/table/csv", message))?;
    let names: Vec<&str> = space.iter().map(|p| p.name.as_str()).collect();
    let key = Digest::of(&[csv.as_bytes(), names.join("\n").as_bytes()]).to_string();
    let emulator = kept_or_fitted(key, &runs).map_err(|e| wrong("/table/csv", e.to_string()))?;
    let count = runs.parameters.nrows();
    for (column, parameter) in space.iter().enumerate() {
        let (lower, upper) = (runs.parameters.column(column).min(), runs.parameters.column(column).max());
        let margin = BEYOND * (upper - lower);
        if parameter.lower < lower - margin || parameter.upper > upper + margin {
            let message = format!(
                "the prior of {} reaches from {} to {}, the runs from {lower} to {upper}: an emulator does not extrapolate",
                parameter.name, parameter.lower, parameter.upper
            );
            return Err(wrong(&format!("/parameter/{column}/prior/uniform"), message));
        }
    }
    Ok(Table { emulator, runs: count })
}

fn kept_or_fitted(key: String, runs: &Runs) -> Result<Arc<Emulator>, FitError> {
    let kept = || KEPT.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(emulator) = kept().get(&key) {
        return Ok(emulator.clone());
    }
    let emulator = Arc::new(Emulator::fit(runs)?);
    let mut all = kept();
    if all.len() >= MOST_KEPT {
        all.clear();
    }
    all.insert(key, emulator.clone());
    Ok(emulator)
}

/// A column for each parameter, then `f1_hz`, `f2_hz`, … in any order of columns.
fn read_runs(csv: &str, space: &ParameterSpace, modes: usize) -> Result<Runs, String> {
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).comment(Some(b'#')).from_reader(csv.as_bytes());
    let headers: Vec<String> = reader.headers().map_err(|e| e.to_string())?.iter().map(str::to_owned).collect();
    let place = |name: &str| headers.iter().position(|h| h == name);
    let mut wanted = Vec::new();
    for parameter in space {
        let name = shown(&parameter.name);
        wanted
            .push(place(&parameter.name).ok_or_else(|| format!("there is no column {name} for the parameter {name}"))?);
    }
    let mode_columns: Vec<usize> = (1..).map_while(|mode| place(&format!("f{mode}_hz"))).collect();
    if mode_columns.len() < modes {
        return Err(format!("columns f1_hz to f{modes}_hz are needed; f{}_hz is missing", mode_columns.len() + 1));
    }
    wanted.extend(&mode_columns);
    if let Some(unknown) = (0..headers.len()).find(|c| !wanted.contains(c) && headers[*c] != RUN_COLUMN) {
        let name = shown(&headers[unknown]);
        return Err(format!(
            "the column {name} is no parameter, no frequency (f1_hz, f2_hz, …) and not \"{RUN_COLUMN}\""
        ));
    }
    if space.len() > MOST_COLUMNS || mode_columns.len() > MOST_COLUMNS {
        let (parameters, modes) = (space.len(), mode_columns.len());
        return Err(format!("{parameters} parameters and {modes} modes: at most {MOST_COLUMNS} of each"));
    }
    let mut rows: Vec<Vec<f64>> = Vec::new();
    for record in reader.records() {
        let record = record.map_err(|e| e.to_string())?;
        if rows.len() == MOST_RUNS {
            return Err(format!("more than {MOST_RUNS} runs: choose among them, a few hundred usually do"));
        }
        let line = record.position().map_or(0, csv::Position::line);
        let cell = |column: &usize| {
            let text = record.get(*column).unwrap_or_default();
            let value: Option<f64> = text.parse().ok().filter(|v: &f64| v.is_finite());
            value.ok_or_else(|| format!("line {line}, column {}: {} is no number", headers[*column], shown(text)))
        };
        rows.push(wanted.iter().map(cell).collect::<Result<_, _>>()?);
    }
    let d = space.len();
    Ok(Runs {
        parameters: DMatrix::from_fn(rows.len(), d, |run, k| rows[run][k]),
        frequencies_hz: DMatrix::from_fn(rows.len(), mode_columns.len(), |run, mode| rows[run][d + mode]),
    })
}
