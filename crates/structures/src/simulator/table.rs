//! Simulation by an emulator of the user's own finite-element runs.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use nalgebra::DMatrix;

use super::definition::{DefinitionProblem, StructureDefinition};
use crate::emulator::{Emulator, FitError, Runs};
use crate::parameter::{Parameter, ParameterSpace};
use crate::quantity::{shown, Digest};

/// Share of the range of the runs by which a prior may extend beyond them: a Latin hypercube does not sample its edges.
const BEYOND: f64 = 0.02;

/// Largest number of runs, and of parameters and modes: the time for fitting grows with their product.
const MOST_RUNS: usize = 5_000;
const MOST_COLUMNS: usize = 50;

/// Optional column that numbers the runs.
const RUN_COLUMN: &str = "run";

/// Factor by which a frequency in the middle of the priors may lie outside the frequencies of the runs.
const PLAUSIBLE: f64 = 2.0;

/// Largest number of emulators in the cache. A definition is read several times, and fitting thousands of runs takes long.
const MOST_CACHED: usize = 16;

static CACHE: Mutex<BTreeMap<String, Arc<Emulator>>> = Mutex::new(BTreeMap::new());

/// An emulator of all frequencies in a table, of which the lowest are measured.
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

    /// Number of runs that it was fitted to.
    pub fn runs(&self) -> usize {
        self.runs
    }

    /// All frequencies of the table at parameters `theta` (`[d]`), Hz, `[modes]`.
    ///
    /// Polynomials diverge outside the points that they were fitted to. Outside the range of the runs, ln f is therefore
    /// extrapolated linearly from the nearest point of that range.
    pub fn frequencies_hz(&self, theta: &[f64]) -> Vec<f64> {
        if self.within(theta) {
            return self.emulator.frequencies_hz(theta);
        }
        self.frequencies_and_jacobian(theta).0
    }

    /// [`Self::frequencies_hz`], `[modes]`, and their derivatives, Hz per parameter unit, `[modes, d]`.
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

    /// Whether the emulator would extrapolate at parameters `theta` (`[d]`): they lie outside the range of the runs by more
    /// than the edge that a Latin hypercube leaves unsampled, or in a part of that range without runs
    /// ([`Emulator::is_outside`]).
    pub fn is_outside(&self, theta: &[f64]) -> bool {
        let ranges = || theta.iter().zip(self.emulator.ranges());
        let beyond = |(x, [low, high]): (&f64, [f64; 2])| {
            let margin = BEYOND * (high - low);
            !(low - margin..=high + margin).contains(x)
        };
        let edge: Vec<f64> = ranges().map(|(x, [low, high])| x.clamp(low, high)).collect();
        ranges().any(beyond) || self.emulator.is_outside(&edge)
    }

    /// Whether the parameters are inside the range of the runs.
    fn within(&self, theta: &[f64]) -> bool {
        theta.iter().zip(self.emulator.ranges()).all(|(x, [low, high])| (low..=high).contains(x))
    }

    /// Frequencies at the medians of the priors, Hz, `[modes]`.
    pub(super) fn nominal_frequencies_hz(&self, space: &ParameterSpace, modes: usize) -> Vec<f64> {
        let middle: Vec<f64> = space.iter().map(Parameter::prior_median).collect();
        let mut frequencies = self.frequencies_hz(&middle);
        frequencies.truncate(modes);
        frequencies
    }

    /// Warnings about crossing modes and about modes that the emulator predicts poorly.
    pub(super) fn warnings(&self, modes: usize) -> Vec<String> {
        let emulator = &self.emulator;
        let crossing = |c: &crate::emulator::Crossing| {
            format!(
                "modes {} and {} of the runs cross or veer: they are {:.2} % apart in run {}; the emulator is least accurate \
                 there, and a measurement can have the two modes in the opposite order",
                c.lower_mode + 1,
                c.lower_mode + 2,
                100.0 * c.gap,
                c.run + 1
            )
        };
        let crossings = emulator.crossings().iter().filter(|c| c.lower_mode < modes).map(crossing);
        let poor = (0..modes).filter(|mode| emulator.r_squared(*mode) < 0.9).map(|mode| {
            format!(
                "mode {}: in cross-validation the emulator explains only {:.0} % of the variance of the runs (error {:.2} %): \
                 add runs, or use fewer parameters",
                mode + 1,
                100.0 * emulator.r_squared(mode).max(0.0),
                100.0 * emulator.relative_error(mode)
            )
        });
        crossings.chain(poor).collect()
    }
}

/// Reads the runs in the table of a definition, checks them and fits the emulator.
pub(super) fn emulate(definition: &StructureDefinition, space: &ParameterSpace) -> Result<Table, DefinitionProblem> {
    let wrong = |pointer: &str, message: String| DefinitionProblem::new(pointer, message);
    let Some(table) = &definition.table else {
        return Err(wrong("/table", "a simulation \"table\" needs runs: add [table] with file or csv".to_owned()));
    };
    let Some(csv) = &table.csv else {
        let message = "a file can only be read next to a structure file on disk: otherwise send its text as csv";
        return Err(wrong("/table/file", message.to_owned()));
    };
    if table.file.is_some() {
        return Err(wrong("/table/file", "give file or csv, not both".to_owned()));
    }
    let runs = read_runs(csv, space, definition.modes).map_err(|message| wrong("/table/csv", message))?;
    let names: Vec<&str> = space.iter().map(|p| p.name.as_str()).collect();
    let key = Digest::of(&[csv.as_bytes(), names.join("\n").as_bytes()]).to_string();
    let emulator = cached_or_fitted(key, &runs).map_err(|e| wrong("/table/csv", e.to_string()))?;
    let count = runs.parameters.nrows();
    for (column, parameter) in space.iter().enumerate() {
        let (lower, upper) = (runs.parameters.column(column).min(), runs.parameters.column(column).max());
        let margin = BEYOND * (upper - lower);
        if parameter.lower < lower - margin || parameter.upper > upper + margin {
            let message = format!(
                "the prior of {} extends from {} to {}, the runs only from {lower} to {upper}: an emulator does not extrapolate",
                parameter.name, parameter.lower, parameter.upper
            );
            return Err(wrong(&definition.parameters[column].prior.pointer(column), message));
        }
    }
    let emulated = Table { emulator, runs: count };
    for (mode, f) in emulated.nominal_frequencies_hz(space, definition.modes).into_iter().enumerate() {
        let (low, high) = (runs.frequencies_hz.column(mode).min(), runs.frequencies_hz.column(mode).max());
        if !(low / PLAUSIBLE..=high * PLAUSIBLE).contains(&f) {
            let message = format!(
                "in the middle of the priors the emulator gives {f} Hz for mode {}, but the runs have {low} to {high} Hz: spread the \
                 runs over the whole ranges of the parameters",
                mode + 1
            );
            return Err(wrong("/table/csv", message));
        }
    }
    Ok(emulated)
}

/// The emulator with this key from the cache; if it is not there, it is fitted and added.
fn cached_or_fitted(key: String, runs: &Runs) -> Result<Arc<Emulator>, FitError> {
    let cache = || CACHE.lock().unwrap_or_else(PoisonError::into_inner);
    if let Some(emulator) = cache().get(&key) {
        return Ok(emulator.clone());
    }
    let emulator = Arc::new(Emulator::fit(runs)?);
    let mut all = cache();
    if all.len() >= MOST_CACHED {
        all.clear();
    }
    all.insert(key, emulator.clone());
    Ok(emulator)
}

/// Reads a table with a column for each parameter and columns `f1_hz`, `f2_hz`, …, in any order.
fn read_runs(csv: &str, space: &ParameterSpace, modes: usize) -> Result<Runs, String> {
    let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).comment(Some(b'#')).from_reader(csv.as_bytes());
    let headers: Vec<String> = reader.headers().map_err(|e| e.to_string())?.iter().map(str::to_owned).collect();
    let column = |name: &str| headers.iter().position(|h| h == name);
    let mut wanted = Vec::new();
    for parameter in space {
        let name = shown(&parameter.name);
        wanted.push(
            column(&parameter.name).ok_or_else(|| format!("there is no column {name} for the parameter {name}"))?,
        );
    }
    let mode_columns: Vec<usize> = (1..).map_while(|mode| column(&format!("f{mode}_hz"))).collect();
    if mode_columns.len() < modes {
        return Err(format!("columns f1_hz to f{modes}_hz are needed; f{}_hz is missing", mode_columns.len() + 1));
    }
    wanted.extend(&mode_columns);
    if let Some(unknown) = (0..headers.len()).find(|c| !wanted.contains(c) && headers[*c] != RUN_COLUMN) {
        let name = shown(&headers[unknown]);
        return Err(format!(
            "the column {name} is neither a parameter nor a frequency (f1_hz, f2_hz, …) nor \"{RUN_COLUMN}\": remove or rename it"
        ));
    }
    if space.len() > MOST_COLUMNS || mode_columns.len() > MOST_COLUMNS {
        let (parameters, modes) = (space.len(), mode_columns.len());
        return Err(format!("{parameters} parameters and {modes} modes: at most {MOST_COLUMNS} of each are allowed"));
    }
    let mut rows: Vec<Vec<f64>> = Vec::new();
    for record in reader.records() {
        let record = record.map_err(|e| e.to_string())?;
        if rows.len() == MOST_RUNS {
            return Err(format!("more than {MOST_RUNS} runs: select some of them, a few hundred are usually enough"));
        }
        let line = record.position().map_or(0, csv::Position::line);
        let cell = |column: &usize| {
            let text = record.get(*column).unwrap_or_default();
            let value: Option<f64> = text.parse().ok().filter(|v: &f64| v.is_finite());
            value.ok_or_else(|| {
                format!("line {line}, column {}: {} is not a finite number", headers[*column], shown(text))
            })
        };
        rows.push(wanted.iter().map(cell).collect::<Result<_, _>>()?);
    }
    let d = space.len();
    Ok(Runs {
        parameters: DMatrix::from_fn(rows.len(), d, |run, k| rows[run][k]),
        frequencies_hz: DMatrix::from_fn(rows.len(), mode_columns.len(), |run, mode| rows[run][d + mode]),
    })
}
