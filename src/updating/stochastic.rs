//! Stochastic updating of a population: mean and spread of the parameters, such that simulated frequencies are distributed
//! as those measured.

use nalgebra::DMatrix;
use rand::{Rng as _, RngCore as _};
use serde::Serialize;

use super::distance::{self, Moments};
use super::tmcmc::{tmcmc, Samples, Settings, Stage, Target};
use crate::simulator::Simulator;
use crate::stats::{self, Stream};

/// Fewest simulated measurements at each point by default.
const SIMULATED: usize = 128;

/// Simulated measurements at each point for a batch of this size, by default: points of a Sobol' sequence, whose moments move
/// ln L by less than a half. That error is 4n times the square of the moments' own, which falls as one over their number.
pub fn simulated_for(measurements: usize) -> usize {
    let needed = SIMULATED as f64 * (measurements as f64 / 500.0).sqrt();
    (needed.ceil() as usize).clamp(SIMULATED, MOST_POINTS).next_power_of_two()
}

/// Settings for `samples` samples where each evaluation costs a hundred runs of the model: chains that move on until half of
/// the correlation is left, which halves the evaluations and widens the scatter of the evidence by a third.
pub fn settings(samples: usize) -> Settings {
    Settings { samples, correlation: 0.5, ..Settings::default() }
}

/// Points of one scrambled Sobol' sequence.
const MOST_POINTS: usize = 1 << 16;

/// The posterior of a population's mean and spread, given a batch.
///
/// ```text
///  θ = (μ, σ),    x ~ N(μ, diag σ²),    y = M(x) + noise
///  ln L(θ) = −D_B(measured, simulated at θ)/ε²,    ε² = 1/(4n)          (paper Eq. 5)
///  μ ~ U(prior),    σ ~ U(0, width of the prior/√12)
/// ```
///
/// The simulated measurements are the images of the same points at every θ. Their normal scores come from a scrambled Sobol'
/// sequence: a few hundred then give the moments that a random sample of thousands would, and the likelihood is smooth.
#[derive(Debug)]
pub struct Population<'a> {
    simulator: &'a Simulator,
    modes: Vec<usize>,
    measured: Moments,
    /// `[simulated, d + m]`: normal scores of the parameters and of the noise.
    scores: DMatrix<f64>,
    noise_multiple: f64,
    epsilon_squared: f64,
}

/// Why a batch gives no posterior.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Too few complete measurements for a covariance.
    #[error("{found} complete measurements: at least {needed} are needed for the covariance of {modes} frequencies")]
    TooFew {
        /// Complete measurements.
        found: usize,
        /// Fewest.
        needed: usize,
        /// Frequencies used.
        modes: usize,
    },
    /// Frequencies that all measurements have in common, or that go together exactly.
    #[error("the measured frequencies do not vary independently: they have no distribution to compare")]
    Singular,
    /// More points or dimensions than the sequence has.
    #[error(
        "{points} simulated measurements in {dimensions} dimensions: two more than modes at least, {MOST_POINTS} in {} at most",
        sobol_burley::NUM_DIMENSIONS
    )]
    Points {
        /// Points asked for.
        points: usize,
        /// Parameters and noises.
        dimensions: usize,
    },
    /// The sampling failed.
    #[error(transparent)]
    Sampling(#[from] super::tmcmc::Error),
}

/// Mean and spread of each parameter under the posterior.
#[derive(Debug, Clone, Serialize)]
pub struct Estimate {
    /// Posterior mean of μ, `[d]`.
    pub mean: Vec<f64>,
    /// 90 % credible interval of μ.
    pub mean_interval: Vec<[f64; 2]>,
    /// Posterior mean of σ, `[d]`.
    pub std: Vec<f64>,
    /// 90 % credible interval of σ.
    pub std_interval: Vec<[f64; 2]>,
    /// Log-evidence, nats, and its standard error.
    pub log_evidence: [f64; 2],
    /// Calls of the likelihood.
    pub evaluations: usize,
    /// Simulated measurements in all.
    pub model_runs: usize,
    /// Least Bhattacharyya distance to the measurements over the samples: some (m + m(m + 1)/2)/4n of it is chance.
    pub least_distance: f64,
}

impl<'a> Population<'a> {
    /// `measured_hz`: `[n, m]`, complete measurements; `modes`: columns to use; `noise_multiple`: noise of the measurements as
    /// a multiple of the structure's own; `simulated`: points at each θ.
    ///
    /// # Errors
    /// [`Error`] for data without a distribution.
    pub fn new(
        simulator: &'a Simulator,
        measured_hz: &DMatrix<f64>,
        modes: &[usize],
        noise_multiple: f64,
        simulated: usize,
        seed: u64,
    ) -> Result<Self, Error> {
        let (found, needed) = (measured_hz.nrows(), modes.len() + 2);
        if found < needed {
            return Err(Error::TooFew { found, needed, modes: modes.len() });
        }
        let measured = Moments::from_matrix(&measured_hz.select_columns(modes));
        if measured.bhattacharyya(&measured).is_none() {
            return Err(Error::Singular);
        }
        let noisy = simulator.is_noisy() && noise_multiple > 0.0;
        let dimensions = simulator.space().len() + if noisy { modes.len() } else { 0 };
        // Beyond these the crate gives numbers without meaning, and checks only in debug.
        if !(modes.len() + 2..=MOST_POINTS).contains(&simulated) || dimensions > sobol_burley::NUM_DIMENSIONS as usize {
            return Err(Error::Points { points: simulated, dimensions });
        }
        let scramble = stats::stream(seed, "scrambling of simulated measurements").next_u32();
        let score = |row: usize, column: usize| {
            let uniform = f64::from(sobol_burley::sample(row as u32, column as u32, scramble));
            // The least step of the sequence: neither end has a finite score.
            stats::normal_quantile(uniform.clamp(f64::from(f32::EPSILON), 1.0 - f64::from(f32::EPSILON)))
        };
        let scores = standardised(DMatrix::from_fn(simulated, dimensions, score))
            .ok_or(Error::Points { points: simulated, dimensions })?;
        let epsilon_squared = distance::epsilon_squared(found as f64);
        let noise_multiple = if noisy { noise_multiple } else { 0.0 };
        Ok(Self { simulator, modes: modes.to_vec(), measured, scores, noise_multiple, epsilon_squared })
    }

    /// Samples the posterior.
    ///
    /// # Errors
    /// [`Error::Sampling`].
    pub fn sample(
        &self,
        settings: &Settings,
        seed: u64,
        progress: &(dyn Fn(&Stage) + Sync),
    ) -> Result<(Samples, Estimate), Error> {
        let samples = tmcmc(self, settings, seed, progress)?;
        let d = self.simulator.space().len();
        let column = |k: usize| samples.theta.column(k).iter().copied().collect::<Vec<f64>>();
        let mean = |k: usize| stats::mean(&column(k));
        let interval = |k: usize| [0.05, 0.95].map(|level| stats::quantile(&column(k), level));
        let estimate = Estimate {
            mean: (0..d).map(mean).collect(),
            mean_interval: (0..d).map(interval).collect(),
            std: (d..2 * d).map(mean).collect(),
            std_interval: (d..2 * d).map(interval).collect(),
            log_evidence: [samples.log_evidence, samples.log_evidence_std_error],
            evaluations: samples.evaluations,
            model_runs: samples.evaluations * self.scores.nrows(),
            least_distance: -samples.log_likelihood.iter().copied().fold(f64::NEG_INFINITY, f64::max)
                * self.epsilon_squared,
        };
        Ok((samples, estimate))
    }

    /// Moments of the simulated frequencies at θ; `None` where the structure has no frequencies.
    fn simulate(&self, theta: &[f64]) -> Option<Moments> {
        let (d, m) = (self.simulator.space().len(), self.modes.len());
        let mut rows = Vec::with_capacity(self.scores.nrows() * m);
        let mut x = vec![0.0; d];
        for point in 0..self.scores.nrows() {
            for (k, value) in x.iter_mut().enumerate() {
                *value = theta[k] + theta[d + k] * self.scores[(point, k)];
            }
            let frequencies = self.simulator.frequencies_hz(&x).ok()?;
            for (place, &mode) in self.modes.iter().enumerate() {
                let f = frequencies[mode];
                let noise = if self.noise_multiple > 0.0 {
                    self.noise_multiple * self.simulator.std_hz(mode, f) * self.scores[(point, d + place)]
                } else {
                    0.0
                };
                rows.push(f + noise);
            }
        }
        Some(Moments::from_rows(&rows, m))
    }
}

/// The same points with mean 0 and covariance I, exactly: of a linear map their images then have the moments of infinitely
/// many, and only its curvature is left to their number. `None` for fewer points than a covariance needs.
///
/// Source: J. Barraquand (1995), Numerical valuation of high dimensional multivariate European securities, Management Science
/// 41, 1882–1891 (quadratic resampling).
fn standardised(mut scores: DMatrix<f64>) -> Option<DMatrix<f64>> {
    for mut column in scores.column_iter_mut() {
        let mean = column.mean();
        column.add_scalar_mut(-mean);
    }
    let covariance = scores.tr_mul(&scores) / (scores.nrows() as f64 - 1.0);
    let whitened = covariance.cholesky()?.l().solve_lower_triangular(&scores.transpose())?;
    Some(whitened.transpose())
}

impl Target for Population<'_> {
    fn dimensions(&self) -> usize {
        2 * self.simulator.space().len()
    }

    fn draw_prior(&self, stream: &mut Stream) -> Vec<f64> {
        let space = self.simulator.space();
        let means = space.iter().map(|p| (p.lower, p.upper - p.lower));
        let widths = space.iter().map(|p| (0.0, (p.upper - p.lower) / 12.0_f64.sqrt()));
        means.chain(widths).map(|(from, width)| from + width * stream.random::<f64>()).collect()
    }

    fn log_prior(&self, theta: &[f64]) -> f64 {
        let parameters = self.simulator.space().as_slice();
        let (means, stds) = theta.split_at(parameters.len());
        let inside = parameters.iter().zip(means).zip(stds).all(|((p, mean), std)| {
            let widest = (p.upper - p.lower) / 12.0_f64.sqrt();
            (p.lower..=p.upper).contains(mean) && (0.0..=widest).contains(std)
        });
        if inside {
            0.0
        } else {
            f64::NEG_INFINITY
        }
    }

    fn log_likelihood(&self, theta: &[f64]) -> f64 {
        let found = self.simulate(theta).and_then(|simulated| self.measured.bhattacharyya(&simulated));
        found.map_or(f64::NEG_INFINITY, |d| distance::log_likelihood(d, self.epsilon_squared))
    }
}
