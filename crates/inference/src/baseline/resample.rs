//! Sampling–importance resampling: draws of a flow, weighted by the exact likelihood of the simulation.

use nalgebra::DMatrix;
use rayon::prelude::*;

use super::observation::Observation;
use structures::simulator::Simulator;
use structures::stats;

/// Smallest effective sample size, as a share of the proposals, for which the first proposals are resampled. Where the flow differs
/// more from the posterior (few accurate frequencies of many parameters give a thin curved posterior), a few draws would
/// dominate and the sample would be too narrow.
const EFFECTIVE: f64 = 0.5;

/// Fewest observations per task, so that the cost of scheduling stays small.
const LEAST_PER_TASK: usize = 8;

/// Draws of a flow as importance proposals.
pub(super) struct Proposals {
    /// Draws, the same number for each observation, `[n·draws, d]`, parameter units.
    pub theta: DMatrix<f64>,
    /// Log-density of each draw under the flow, in parameter units, up to a constant; nats.
    pub log_density: Vec<f64>,
    /// Whether draws of an observation were moved to the bounds of the prior, which invalidates their densities.
    pub moved: Vec<bool>,
}

/// Samples of a posterior, and which of them the simulation has corrected.
pub(super) struct Resampled {
    /// `[n·draws, d]`, parameter units.
    pub theta: DMatrix<f64>,
    /// Whether the draws of each observation were weighted by their likelihood, `[n]`; the others are draws of the flow.
    pub weighted: Vec<bool>,
}

/// Resamples `draws` of the proposals of each observation by their importance weights, `[n·draws, d]`.
///
/// ```text
///  w_s = p(y | x_s) p(x_s)/q(x_s | y),    ln p(y | x) = −Σ_i ½((y_i − f_i(x))/s_i)² + ln s_i,   s_i the noise at f_i(x)
/// ```
///
/// with the prior p(x); the sum is over the modes present. Resampling is systematic, followed by a shuffle, so that any
/// first few draws are a sample too. Spurious modes of the flow, such as bridges between two modes of the posterior, are
/// removed. Where the effective sample size is less than [`EFFECTIVE`], the flow's draws are kept unchanged.
///
/// Source: D. B. Rubin (1988), Using the SIR algorithm to simulate posterior distributions, Bayesian Statistics 3, 395–402.
pub(super) fn resample(
    simulator: &Simulator,
    observations: &[Observation],
    proposals: &Proposals,
    draws: usize,
    seed: u64,
) -> Resampled {
    let d = proposals.theta.ncols();
    let many = proposals.theta.nrows() / observations.len().max(1);
    let log_posteriors = log_posteriors(simulator, observations, &proposals.theta);
    let choose = |row: usize| -> (Vec<usize>, bool) {
        let rows = row * many..(row + 1) * many;
        if proposals.moved[row] {
            return (rows.take(draws).collect(), false);
        }
        // Non-finite weights are set to zero.
        let log_weight = |row: usize| {
            let weight = log_posteriors[row] - proposals.log_density[row];
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
                let chosen = stats::systematic(&weights, draws, &mut stream);
                (chosen.into_iter().map(|i| rows.start + i).collect(), true)
            }
            None => (rows.take(draws).collect(), false),
        }
    };
    let rows = (0..observations.len()).into_par_iter().with_min_len(LEAST_PER_TASK);
    let found: Vec<(Vec<usize>, bool)> = rows.map(choose).collect();
    let chosen: Vec<usize> = found.iter().flat_map(|(chosen, _)| chosen.iter().copied()).collect();
    let weighted = found.iter().map(|(_, weighted)| *weighted).collect();
    let theta = DMatrix::from_fn(chosen.len(), d, |row, column| proposals.theta[(chosen[row], column)]);
    Resampled { theta, weighted }
}

/// ln p(y | x) p(x) up to a constant for each row of `theta` `[n·k, d]`, k rows for each of the n observations, with the prior p(x) in
/// the unit box; nats.
pub(super) fn log_posteriors(simulator: &Simulator, observations: &[Observation], theta: &DMatrix<f64>) -> Vec<f64> {
    let mut all = log_likelihoods(simulator, observations, theta);
    let space = simulator.space();
    if !space.is_uniform() {
        all.iter_mut().zip(theta.row_iter()).for_each(|(log, row)| *log += space.log_prior(row.iter()));
    }
    all
}

/// ln p(y | x) up to a constant for each row of `theta` `[n·k, d]`, k rows for each of the n observations; nats.
pub(super) fn log_likelihoods(simulator: &Simulator, observations: &[Observation], theta: &DMatrix<f64>) -> Vec<f64> {
    let each = theta.nrows() / observations.len().max(1);
    let of = |(row, observation): (usize, &Observation)| {
        let simulator = observation.simulator(simulator);
        let near_hz = &observation.frequencies_hz;
        let frequencies_hz = simulator.frequencies_near_hz(theta, row * each..(row + 1) * each, near_hz);
        let runs = frequencies_hz.chunks_exact(simulator.modes());
        runs.map(|frequencies_hz| log_likelihood(&simulator, observation, frequencies_hz)).collect::<Vec<f64>>()
    };
    observations.par_iter().with_min_len(LEAST_PER_TASK).enumerate().flat_map_iter(of).collect()
}

/// ln p(y | x) up to a constant, nats. `frequencies_hz`: the simulated frequencies of x, Hz, `[m]`; if the simulation failed, those of
/// the modes present are NaN, and the result is −∞.
fn log_likelihood(simulator: &Simulator, observation: &Observation, frequencies_hz: &[f64]) -> f64 {
    let one = |(mode, measured): (usize, &Option<f64>)| {
        let f = frequencies_hz[mode];
        let std_hz = simulator.std_hz(mode, f) * observation.noise_multiple[mode];
        measured.map_or(0.0, |y| -0.5 * ((y - f) / std_hz).powi(2) - std_hz.ln())
    };
    let sum: f64 = observation.frequencies_hz.iter().enumerate().map(one).sum();
    if sum.is_nan() {
        f64::NEG_INFINITY
    } else {
        sum
    }
}
