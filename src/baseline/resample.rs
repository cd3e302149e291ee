//! Draws of a flow set right by the simulation: sampling, importance, resampling.

use nalgebra::DMatrix;
use rayon::prelude::*;

use super::observation::Observation;
use crate::simulator::Simulator;
use crate::stats;

/// Share of the proposals that the weights must leave effective. Where the flow is further from the posterior (few sharp
/// frequencies of many parameters: a thread through the box), a few draws would stand for all, and the sample would be narrower
/// than it should: there the flow's own draws stay, which its calibration vouches for.
const EFFECTIVE: f64 = 0.5;

/// Observations of one task: fewer cost more in handing over than they take.
const AT_A_TIME: usize = 8;

/// Draws of a flow, and what they are weighed by.
pub(super) struct Proposals {
    /// The same number for each observation, `[n·draws, d]`, parameter units.
    pub theta: DMatrix<f64>,
    /// Log-density of each under the flow, in parameter units, up to a constant; nats.
    pub log_density: Vec<f64>,
    /// Observations some of whose draws were moved to an edge of the prior: their densities mean nothing.
    pub moved: Vec<bool>,
}

/// Draws `draws` of the proposals of each observation, by their weights.
///
/// ```text
///  w_s = p(y | x_s)/q(x_s | y),    ln p(y | x) = −Σ_i ½((y_i − f_i(x))/s_i)² + ln s_i,   s_i the noise at f_i(x)
/// ```
///
/// under the uniform prior, over the modes present; systematic resampling, then a shuffle, so that any first few are a sample
/// too. A flow that bridges two humps leaves draws between them and in humps that are none: here they go. Where the weights
/// leave fewer than half of the proposals effective, the flow's draws are kept as they are.
///
/// Source: D. B. Rubin (1988), Using the SIR algorithm to simulate posterior distributions, Bayesian Statistics 3, 395–402.
pub(super) fn resample(
    simulator: &Simulator,
    observations: &[Observation],
    proposals: &Proposals,
    draws: usize,
    seed: u64,
) -> DMatrix<f64> {
    let d = proposals.theta.ncols();
    let many = proposals.theta.nrows() / observations.len().max(1);
    let log_likelihoods = log_likelihoods(simulator, observations, &proposals.theta);
    let choose = |row: usize| -> Vec<usize> {
        let rows = row * many..(row + 1) * many;
        if proposals.moved[row] {
            return rows.take(draws).collect();
        }
        // What has no number has no weight.
        let log_weight = |place: usize| {
            let weight = log_likelihoods[place] - proposals.log_density[place];
            if weight.is_finite() {
                weight
            } else {
                f64::NEG_INFINITY
            }
        };
        let log_weights: Vec<f64> = rows.clone().map(log_weight).collect();
        let mut stream = stats::stream(seed, &format!("resampling {row}"));
        match stats::weights(&log_weights, EFFECTIVE) {
            Some(weights) => {
                stats::systematic(&weights, draws, &mut stream).into_iter().map(|i| rows.start + i).collect()
            }
            None => rows.take(draws).collect(),
        }
    };
    let rows = (0..observations.len()).into_par_iter().with_min_len(AT_A_TIME);
    let places: Vec<usize> = rows.flat_map_iter(choose).collect();
    DMatrix::from_fn(places.len(), d, |row, column| proposals.theta[(places[row], column)])
}

/// ln p(y | x) of each row of `theta`, the same number of rows for each observation.
pub(super) fn log_likelihoods(simulator: &Simulator, observations: &[Observation], theta: &DMatrix<f64>) -> Vec<f64> {
    let each = theta.nrows() / observations.len().max(1);
    let of = |(row, observation): (usize, &Observation)| {
        let simulator = observation.simulator(simulator);
        let frequencies_hz = simulator.frequencies_of_rows_hz(theta, row * each..(row + 1) * each);
        let runs = frequencies_hz.chunks_exact(simulator.modes());
        runs.map(|frequencies_hz| log_likelihood(&simulator, observation, frequencies_hz)).collect::<Vec<f64>>()
    };
    observations.par_iter().with_min_len(AT_A_TIME).enumerate().flat_map_iter(of).collect()
}

/// `frequencies_hz`: of one run, NaN where there are none.
fn log_likelihood(simulator: &Simulator, observation: &Observation, frequencies_hz: &[f64]) -> f64 {
    if frequencies_hz.iter().any(|f| f.is_nan()) {
        return f64::NEG_INFINITY;
    }
    let one = |(mode, measured): (usize, &Option<f64>)| {
        let f = frequencies_hz[mode];
        let std_hz = simulator.std_hz(mode, f) * observation.noise_multiple[mode];
        measured.map_or(0.0, |y| -0.5 * ((y - f) / std_hz).powi(2) - std_hz.ln())
    };
    observation.frequencies_hz.iter().enumerate().map(one).sum()
}
