//! The densities of the parameters of a batch, and the frequencies that they predict for each mode.

use super::samples::{BatchSamples, Error};
use crate::baseline::Baseline;
use crate::damage::UndamagedReference;
use structures::measurement::ModalMeasurement;
use structures::parameter::Parameter;
use structures::plot::density;
use structures::quantity::{Digest, Hertz};
use structures::simulator::shape_comparison::ShapeComparison;
use structures::stats;

/// Measured values shown for each mode, evenly spaced in the batch.
const SHOWN_MEASUREMENTS: usize = 200;

/// Posterior samples that are simulated for a prediction.
const SIMULATIONS: usize = 1_000;

/// Grid points over the whole prior, and over the part of it where the densities are concentrated.
const GRID_POINTS: [usize; 2] = [60, 140];

/// Margin on each side of the prior, as a share of its width.
const MARGIN: f64 = 0.05;

/// Standard deviations about a mean within which the grid is fine.
const REACH: f64 = 4.5;

/// The densities of the parameters of a batch, and the frequencies that they predict.
#[derive(Debug, Clone, PartialEq)]
pub struct BatchDetail {
    /// Digest of the trained baseline that drew the samples.
    pub model_digest: Digest,
    /// Number of measurements of the batch.
    pub measurements: usize,
    /// Measurements whose values are shown.
    pub shown: usize,
    /// Number of posterior samples that were simulated.
    pub simulations: usize,
    /// One entry for each parameter.
    pub parameters: Vec<ParameterDetail>,
    /// One entry for each mode.
    pub modes: Vec<ModeDetail>,
    /// Measured mode shapes beside those at the mean of the posterior samples; `None` if the batch has no shapes.
    pub shapes: Option<ShapeComparison>,
}

/// Densities of one parameter, all on the same grid, in 1/unit.
#[derive(Debug, Clone, PartialEq)]
pub struct ParameterDetail {
    /// Its name.
    pub name: String,
    /// Its unit.
    pub unit: String,
    /// Grid points in the unit of the parameter, ascending; closer together where the densities are concentrated.
    pub grid: Vec<f64>,
    /// Density of the prior.
    pub prior: Vec<f64>,
    /// Density of the pooled posterior samples of the batch.
    pub posterior: Vec<f64>,
    /// Normal density of the population behind the undamaged reference.
    pub undamaged: Option<Vec<f64>>,
    /// Damage threshold δ, in the unit of the parameter.
    pub threshold: Option<f64>,
}

/// Frequencies of one mode: measured, and predicted by the posterior samples, the mean of the learned discrepancy and the usual misfit of the
/// reference, without noise.
#[derive(Debug, Clone, PartialEq)]
pub struct ModeDetail {
    /// Frequencies of the measurements shown, Hz.
    pub measured_hz: Vec<Option<Hertz>>,
    /// Mean of the predicted frequencies, Hz.
    pub predicted_mean_hz: f64,
    /// 5 % and 95 % quantiles of the predicted frequencies, Hz.
    pub predicted_interval_hz: [f64; 2],
}

/// The detail of a batch by the samples of its assessment; the pool has `per_measurement` samples of each measurement.
///
/// # Errors
/// [`Error::Simulation`] when the simulation fails inside the prior.
pub fn detail(
    baseline: &Baseline,
    measurements: &[ModalMeasurement],
    samples: &BatchSamples,
    per_measurement: usize,
    undamaged: Option<&UndamagedReference>,
) -> Result<BatchDetail, Error> {
    let pooled = samples.posterior.first(per_measurement.min(samples.posterior.draws()));
    let parameter = |(column, parameter): (usize, &Parameter)| {
        let reference = undamaged.and_then(|undamaged| undamaged.quantities.iter().find(|q| q.name == parameter.name));
        let population = reference.map(|q| (q.mean, q.std)).filter(|(_, std)| *std > 0.0);
        let pool = pooled.column(column);
        let grid = grid(parameter, &pool, population);
        ParameterDetail {
            name: parameter.name.clone(),
            unit: parameter.unit.clone(),
            prior: grid.iter().map(|x| parameter.prior_density(*x)).collect(),
            // Samples that are all equal have no density.
            posterior: density::kernel_at(&pool, &grid).unwrap_or_else(|| vec![0.0; grid.len()]),
            undamaged: population.map(|(mean, std)| grid.iter().map(|x| density::normal(*x, mean, std)).collect()),
            threshold: reference.and_then(|q| q.threshold),
            grid,
        }
    };
    let mut discrepancy = mean_discrepancy(baseline, measurements);
    if let Some(process) = undamaged.and_then(|undamaged| undamaged.process.as_ref()) {
        discrepancy.iter_mut().zip(&process.usual_ln).for_each(|(sum, usual)| *sum += usual);
    }
    let rows = evenly(pooled.theta().nrows(), SIMULATIONS);
    let mut predicted = vec![Vec::with_capacity(rows.len()); baseline.simulator().modes()];
    for &row in &rows {
        let theta: Vec<f64> = pooled.theta().row(row).iter().copied().collect();
        let simulator = samples.asked[row / pooled.draws()].simulator(baseline.simulator());
        for (mode, frequency_hz) in simulator.frequencies_hz(&theta)?.into_iter().enumerate() {
            predicted[mode].push(frequency_hz * discrepancy[mode].exp());
        }
    }
    let shown = evenly(measurements.len(), SHOWN_MEASUREMENTS);
    let mode = |(mode, predicted): (usize, Vec<f64>)| ModeDetail {
        measured_hz: shown.iter().map(|&index| measurements[index].frequencies_hz[mode]).collect(),
        predicted_mean_hz: stats::mean(&predicted),
        predicted_interval_hz: [0.05, 0.95].map(|level| stats::quantile(&predicted, level)),
    };
    let means: Vec<f64> = (0..baseline.space().len()).map(|column| stats::mean(&pooled.column(column))).collect();
    Ok(BatchDetail {
        shapes: baseline.simulator().compare_shapes(&means, measurements)?,
        model_digest: baseline.digest().clone(),
        measurements: measurements.len(),
        shown: shown.len(),
        simulations: rows.len(),
        parameters: baseline.space().iter().enumerate().map(parameter).collect(),
        modes: predicted.into_iter().enumerate().map(mode).collect(),
    })
}

/// Mean over some measurements of the mean of the learned discrepancy of each mode, a difference in ln f, `[m]`; 0 without one.
fn mean_discrepancy(baseline: &Baseline, measurements: &[ModalMeasurement]) -> Vec<f64> {
    let mut sum = vec![0.0; baseline.simulator().modes()];
    let Some(discrepancy) = baseline.simulator().discrepancy() else { return sum };
    for measurement in measurements {
        let inputs = discrepancy.inputs(&measurement.covariates, &measurement.settings);
        for (sum, moments) in sum.iter_mut().zip(discrepancy.at(inputs.u.as_deref())) {
            *sum += moments.mean / measurements.len() as f64;
        }
    }
    sum
}

/// Grid points over the prior and at its bounds, closer together where the samples and the undamaged population are.
fn grid(parameter: &Parameter, pool: &[f64], population: Option<(f64, f64)>) -> Vec<f64> {
    let width = parameter.upper - parameter.lower;
    let (low, high) = (parameter.lower - MARGIN * width, parameter.upper + MARGIN * width);
    let own = stats::sample_std(pool).map(|std| (stats::mean(pool), std));
    let reach = || own.into_iter().chain(population);
    let from = reach().map(|(mean, std)| mean - REACH * std).fold(high, f64::min).max(low);
    let to = reach().map(|(mean, std)| mean + REACH * std).fold(low, f64::max).min(high);
    let spread =
        |from: f64, to: f64, count: usize| (0..count).map(move |i| from + (to - from) * i as f64 / (count - 1) as f64);
    let mut points: Vec<f64> = spread(low, high, GRID_POINTS[0]).chain([parameter.lower, parameter.upper]).collect();
    if from < to {
        points.extend(spread(from, to, GRID_POINTS[1]));
    }
    points.sort_by(f64::total_cmp);
    points.dedup();
    points
}

/// At most `most` of `count` indices, evenly spaced.
fn evenly(count: usize, most: usize) -> Vec<usize> {
    let taken = count.min(most);
    (0..taken).map(|i| i * count / taken).collect()
}
