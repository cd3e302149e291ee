//! Learning a discrepancy: population and processes in turn.

use nalgebra::{DMatrix, DVector};

use super::change::{change_in_time, ChangeInTime};
use super::hyperparameter::{Hyperparameters, ModeRows};
use super::posterior::{posterior, Basis, Coefficients};
use super::rows::Rows;
use crate::data::Data;
use crate::fit::{Fit, Start};
use crate::study::Study;
use structures::simulator::discrepancy::definition::{DiscrepancyDefinition, InputDefinition, ModeDefinition};
use structures::simulator::discrepancy::input::Discrepancy;
use structures::simulator::discrepancy::process::Support;

/// Greatest number of support points and of rows that are learned from.
const MOST_SUPPORT: usize = 64;
const MOST_ROWS: usize = 1_500;

/// Greatest number of rows from which hyperparameters are estimated: σ and ℓ need fewer rows than the function itself.
const HYPERPARAMETER_ROWS: usize = 400;

/// Steps to which coefficients and support points are rounded, so that the structure file stays small; both are of the order of 1.
const COEFFICIENT_STEP: f64 = 1e-7;
const POINT_STEP: f64 = 1e-6;

/// Rounds of population and processes: the first population contains the discrepancy in its spread and noise.
const ROUNDS: usize = 3;

/// A mode has a discrepancy if it raises the log marginal likelihood by more than this, nats: by chance a variance does so in 1 of
/// 100 modes.
const LEAST_NATS: f64 = 2.7;

/// A learned discrepancy, and the population of the parameters beside it.
#[derive(Debug, Clone)]
pub struct Learned {
    /// The discrepancy.
    pub discrepancy: Discrepancy,
    /// Fit of the simulation to frequencies corrected by the discrepancy.
    pub fit: Fit,
    /// A change of a stiffness in time among the rows.
    pub change: Option<ChangeInTime>,
}

/// Why no discrepancy is learned.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum WhyNot {
    /// The simulation cannot be fitted.
    #[error("the simulation cannot be fitted together with a discrepancy")]
    NoFit,
    /// There is no input, or no row in which all inputs are known.
    #[error("there is no covariate or setting, other than functions of time, that a discrepancy could depend on")]
    NoInput,
    /// No mode deviates as a function of the inputs.
    #[error("no mode deviates from the simulation as a function of {0} inputs")]
    Nothing(usize),
}

/// Learns a discrepancy over `inputs` from the rows with the indices `rows`. `base`: fit of the simulation alone to these rows; `u`:
/// standardised inputs of all rows of the data.
///
/// The population of the parameters (means, spreads, noise) and the processes are estimated in turn: the processes from the residuals
/// of the population, and the population from the frequencies without the mean of the processes.
///
/// # Errors
/// [`WhyNot`].
pub fn learn(
    study: &Study<'_>,
    rows: &[usize],
    base: &Fit,
    inputs: &[InputDefinition],
    u: &[Option<Vec<f64>>],
) -> Result<Learned, WhyNot> {
    let rows: Vec<usize> = rows.iter().step_by(rows.len().div_ceil(MOST_ROWS).max(1)).copied().collect();
    if inputs.is_empty() || rows.iter().all(|row| u[*row].is_none()) {
        return Err(WhyNot::NoInput);
    }
    let mut fit = base.clone();
    let mut weights: Vec<f64> = study.view(&rows, base).ok_or(WhyNot::NoFit)?.iter().map(|view| view.weight).collect();
    let mut modes: Vec<Option<Hyperparameters>> = vec![None; study.simulator.modes()];
    let mut round = 0;
    loop {
        let points = support_points(inputs, &rows, u, &shortest_lengths(inputs.len(), &modes));
        let support = support(inputs, &points);
        let residuals = Rows::new(study, &rows, &fit, u, &weights).ok_or(WhyNot::NoFit)?;
        modes = hyperparameters(&support, &residuals, &modes);
        let basis = Basis::new(&support, &modes, &residuals).ok_or(WhyNot::NoFit)?;
        if basis.modes.is_empty() {
            return Err(WhyNot::Nothing(inputs.len()));
        }
        let coefficients = posterior(&residuals, &basis).ok_or(WhyNot::NoFit)?;
        let definition = definition(inputs, &points, &modes, &coefficients);
        let discrepancy = Discrepancy::new(&definition, modes.len()).map_err(|_| WhyNot::NoFit)?;
        let corrected = without_mean(study.data, &discrepancy, u);
        let corrected = Study::new(study.simulator, &corrected);
        fit = corrected.fit(&rows, &base.effects, Some(&Start::at(&fit))).ok_or(WhyNot::NoFit)?;
        weights = corrected.view(&rows, &fit).ok_or(WhyNot::NoFit)?.iter().map(|view| view.weight).collect();
        round += 1;
        if round == ROUNDS {
            let change = change_in_time(study, &rows, &fit, &residuals, &basis).ok_or(WhyNot::NoFit)?;
            restore_noise(&mut fit, &coefficients, &residuals);
            return Ok(Learned { discrepancy, fit, change });
        }
    }
}

/// The support with these points, `[points][inputs]`.
fn support(inputs: &[InputDefinition], points: &[Vec<f64>]) -> Support {
    let matrix = DMatrix::from_fn(points.len(), inputs.len(), |point, input| points[point][input]);
    Support::new(matrix, inputs.iter().map(InputDefinition::is_category).collect())
}

/// The shortest correlation length of any mode along each input, `[inputs]`; 1 before lengths are known.
fn shortest_lengths(inputs: usize, modes: &[Option<Hyperparameters>]) -> Vec<f64> {
    let of = |input: usize| modes.iter().flatten().map(|own| own.lengths[input]).reduce(f64::min).unwrap_or(1.0);
    (0..inputs).map(of).collect()
}

/// Points for the support among the inputs of the rows: the one nearest to the middle, then always the one farthest from those
/// before, in units of `lengths`, so that they cover what was seen most densely along the inputs that matter. Fewer where the rows
/// have fewer different inputs.
fn support_points(
    inputs: &[InputDefinition],
    rows: &[usize],
    u: &[Option<Vec<f64>>],
    lengths: &[f64],
) -> Vec<Vec<f64>> {
    let known: Vec<&Vec<f64>> = rows.iter().filter_map(|row| u[*row].as_ref()).collect();
    let metric = support(inputs, &[]);
    let middle: Vec<f64> = vec![0.0; inputs.len()];
    let distance = |v: &[f64]| metric.squared_distance(v, &middle, lengths);
    let Some(first) = known.iter().min_by(|a, b| distance(a).total_cmp(&distance(b))) else { return Vec::new() };
    let mut points = vec![(*first).clone()];
    let mut left: Vec<f64> = vec![f64::INFINITY; known.len()];
    while points.len() < MOST_SUPPORT {
        let newest = &points[points.len() - 1];
        for (left, candidate) in left.iter_mut().zip(&known) {
            *left = left.min(metric.squared_distance(candidate, newest, lengths));
        }
        let farthest = (0..known.len()).max_by(|a, b| left[*a].total_cmp(&left[*b]));
        let Some(place) = farthest.filter(|place| left[*place] > 1e-9) else { break };
        points.push(known[place].clone());
    }
    points.iter_mut().flatten().for_each(|value| *value = rounded(*value, POINT_STEP));
    points
}

/// The hyperparameters of each mode, from those of the round before; `None` for a mode without a discrepancy.
fn hyperparameters(support: &Support, rows: &Rows, before: &[Option<Hyperparameters>]) -> Vec<Option<Hyperparameters>> {
    use rayon::prelude::*;
    let one = |mode: usize| {
        let (places, variance) = rows.of_mode(mode);
        let stride = places.len().div_ceil(HYPERPARAMETER_ROWS).max(1);
        let variance: Vec<f64> = variance.iter().step_by(stride).copied().collect();
        let places: Vec<usize> = places.into_iter().step_by(stride).collect();
        let own = ModeRows {
            u: places.iter().filter_map(|place| rows.u[*place].as_deref()).collect(),
            residual: rows.residual[mode].select_rows(&places),
            variance: DVector::from_vec(variance),
        };
        own.fit(support, before[mode].as_ref()).filter(|found| found.nats > LEAST_NATS)
    };
    (0..rows.modes).into_par_iter().map(one).collect()
}

/// The discrepancy as a structure file states it.
fn definition(
    inputs: &[InputDefinition],
    points: &[Vec<f64>],
    modes: &[Option<Hyperparameters>],
    coefficients: &[Coefficients],
) -> DiscrepancyDefinition {
    let mode = |own: &Coefficients| {
        let of_mode = modes[own.mode].as_ref()?;
        Some(ModeDefinition {
            mode: own.mode + 1,
            std: of_mode.std,
            lengths: of_mode.lengths.clone(),
            weights: own.mean.iter().map(|w| rounded(*w, COEFFICIENT_STEP)).collect(),
            factor: (0..points.len())
                .map(|i| (0..=i).map(|j| rounded(own.factor[(i, j)], COEFFICIENT_STEP)).collect())
                .collect(),
        })
    };
    DiscrepancyDefinition {
        description: None,
        inputs: inputs.to_vec(),
        points: points.to_vec(),
        modes: coefficients.iter().filter_map(mode).collect(),
    }
}

fn rounded(value: f64, step: f64) -> f64 {
    // The inverse of a step is exact, so that the decimals are too.
    let per_step = step.recip().round();
    (value * per_step).round() / per_step
}

/// The data with the mean of the discrepancy subtracted. Where the inputs are not known, its prior variance is added to the noise.
pub(super) fn without_mean(data: &Data, discrepancy: &Discrepancy, u: &[Option<Vec<f64>>]) -> Data {
    let mut corrected = data.clone();
    for (row, u) in u.iter().enumerate() {
        for (mode, moments) in discrepancy.at(u.as_deref()).iter().enumerate() {
            corrected.log_frequencies[row][mode] -= moments.mean;
            if u.is_none() {
                corrected.noise[row][mode] = corrected.noise[row][mode].hypot(moments.variance.sqrt());
            }
        }
    }
    corrected
}

/// Restores what the coefficients have taken from the noise: the residuals of n rows about a mean with ν fitted numbers are smaller
/// than the noise by √(1 − ν/n).
fn restore_noise(fit: &mut Fit, coefficients: &[Coefficients], rows: &Rows) {
    for own in coefficients {
        let n = rows.of_mode(own.mode).0.len() as f64;
        let left = (1.0 - own.degrees_of_freedom / n).max(0.25);
        fit.noise_factor[own.mode] /= left.sqrt();
    }
}

impl Learned {
    /// The data for a prediction by [`Self::fit`]: frequencies without the mean of the discrepancy, and its variance added to the
    /// noise.
    pub fn corrected(&self, data: &Data, u: &[Option<Vec<f64>>]) -> Data {
        let mut corrected = data.clone();
        for (row, u) in u.iter().enumerate() {
            for (mode, moments) in self.discrepancy.at(u.as_deref()).iter().enumerate() {
                corrected.log_frequencies[row][mode] -= moments.mean;
                // The fit multiplies the noise by its factor; the variance of the discrepancy is not noise.
                let std = moments.variance.sqrt() / self.fit.noise_factor[mode];
                corrected.noise[row][mode] = corrected.noise[row][mode].hypot(std);
            }
        }
        corrected
    }
}
