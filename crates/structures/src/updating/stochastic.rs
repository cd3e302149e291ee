//! Stochastic model updating: finds the mean and the standard deviation of the parameters for which simulated frequencies have
//! the same distribution as the measured ones.

use nalgebra::DMatrix;
use rand::{Rng as _, RngCore as _};
use serde::Serialize;

use super::distance::{self, Moments};
use super::tmcmc::{tmcmc, Samples, Settings, Stage, Target};
use crate::simulator::Simulator;
use crate::stats::{self, Stream};

/// Smallest default number of simulated measurements at each θ.
const SIMULATED: usize = 128;

/// Default number of simulated measurements at each θ for a batch of n = `measurements` measurements. They are points of a Sobol'
/// sequence, and their number is a power of two, chosen so that the error of their moments changes ln L by less than ½. This
/// error of ln L is 4n times the square of the error of the moments, which decreases inversely with the number of points.
pub fn simulated_for(measurements: usize) -> usize {
    let needed = SIMULATED as f64 * (measurements as f64 / 500.0).sqrt();
    (needed.ceil() as usize).clamp(SIMULATED, MOST_POINTS).next_power_of_two()
}

/// Settings for `samples` samples when each evaluation of the likelihood takes about a hundred model runs. In each stage the
/// samples move only until their correlation with their starting points has fallen to 0.5. This halves the number of evaluations
/// and increases the standard error of the log-evidence by a third.
pub fn settings(samples: usize) -> Settings {
    Settings { samples, correlation: 0.5, ..Settings::default() }
}

/// Largest number of points of a scrambled Sobol' sequence.
const MOST_POINTS: usize = 1 << 16;

/// The posterior of the mean μ and the standard deviation σ of a population, given a batch.
///
/// ```text
///  θ = (μ, σ),    x ~ N(μ, diag σ²),    y = M(x) + noise
///  ln L(θ) = −D_B(measured, simulated at θ)/ε²,    ε² = 1/(4n)          (paper Eq. 5)
///  μ ~ prior,    σ ~ U(0, standard deviation of the prior)
/// ```
///
/// The simulated measurements are computed from the same normal scores at every θ, which makes the likelihood smooth. The scores
/// come from a scrambled Sobol' sequence, of which a few hundred points give moments as accurate as thousands of random points.
///
/// Source: Wang et al. (2025), Eq. 5.
#[derive(Debug)]
pub struct Population<'a> {
    simulator: &'a Simulator,
    modes: Vec<usize>,
    measured: Moments,
    /// Normal scores of the parameters and of the noise, `[simulated, d + m]`.
    scores: DMatrix<f64>,
    noise_multiple: f64,
    epsilon_squared: f64,
}

/// Why the posterior of a population cannot be sampled.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// There are too few complete measurements for a covariance.
    #[error("{found} complete measurements: at least {needed} are needed for the covariance of {modes} frequencies")]
    TooFew {
        /// Number of complete measurements.
        found: usize,
        /// Smallest number needed.
        needed: usize,
        /// Frequencies used.
        modes: usize,
    },
    /// The covariance of the measured frequencies is singular.
    #[error("the measured frequencies do not vary independently: their covariance is singular")]
    Singular,
    /// There are too few or too many simulated measurements, or too many dimensions for the sequence.
    #[error(
        "{points} simulated measurements in {dimensions} dimensions: at least two more than modes are needed, and at most \
         {MOST_POINTS} in {} dimensions are possible",
        sobol_burley::NUM_DIMENSIONS
    )]
    Points {
        /// Points asked for.
        points: usize,
        /// Number of parameters, plus the number of modes if there is noise.
        dimensions: usize,
    },
    /// The sampling failed.
    #[error(transparent)]
    Sampling(#[from] super::tmcmc::Error),
}

/// Posterior mean and standard deviation of each parameter of a population, in parameter units.
#[derive(Debug, Clone, Serialize)]
pub struct Estimate {
    /// Posterior mean of μ, `[d]`.
    pub mean: Vec<f64>,
    /// 90 % credible interval of μ, `[d]`.
    pub mean_interval: Vec<[f64; 2]>,
    /// Posterior mean of σ, `[d]`.
    pub std: Vec<f64>,
    /// 90 % credible interval of σ, `[d]`.
    pub std_interval: Vec<[f64; 2]>,
    /// Log-evidence, nats, and its standard error.
    pub log_evidence: [f64; 2],
    /// Number of evaluations of the likelihood.
    pub evaluations: usize,
    /// Number of simulated measurements.
    pub model_runs: usize,
    /// Smallest Bhattacharyya distance to the measurements over the samples. About (m + m(m + 1)/2)/4n of it is due to chance.
    pub least_distance: f64,
}

impl<'a> Population<'a> {
    /// The posterior for the complete measurements `measured_hz`, Hz, `[n, m]`, of which the columns `modes` are used.
    /// `noise_multiple` is the noise of the measurements as a multiple of that of the structure; `simulated` is the number of
    /// simulated measurements at each θ.
    ///
    /// # Errors
    /// [`Error`] for too few or dependent measurements, and for a number of simulated measurements that is not possible.
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
        // Beyond these limits the crate returns unspecified numbers, and checks only in debug builds.
        if !(modes.len() + 2..=MOST_POINTS).contains(&simulated) || dimensions > sobol_burley::NUM_DIMENSIONS as usize {
            return Err(Error::Points { points: simulated, dimensions });
        }
        let scramble = stats::stream(seed, "scrambling of simulated measurements").next_u32();
        let score = |row: usize, column: usize| {
            let uniform = f64::from(sobol_burley::sample(row as u32, column as u32, scramble));
            // The smallest step of the sequence, because 0 and 1 have no finite score.
            stats::normal_quantile(uniform.clamp(f64::from(f32::EPSILON), 1.0 - f64::from(f32::EPSILON)))
        };
        let scores = standardised(DMatrix::from_fn(simulated, dimensions, score))
            .ok_or(Error::Points { points: simulated, dimensions })?;
        let epsilon_squared = distance::epsilon_squared(found as f64);
        let noise_multiple = if noisy { noise_multiple } else { 0.0 };
        Ok(Self { simulator, modes: modes.to_vec(), measured, scores, noise_multiple, epsilon_squared })
    }

    /// Samples the posterior by [`tmcmc`]. Returns the samples of (μ, σ), `[n, 2d]`, and their summary.
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

    /// Moments of the simulated frequencies at θ; `None` if the frequencies cannot be computed.
    fn simulate(&self, theta: &[f64]) -> Option<Moments> {
        let (d, m) = (self.simulator.space().len(), self.modes.len());
        let mut rows = Vec::with_capacity(self.scores.nrows() * m);
        let mut x = vec![0.0; d];
        for point in 0..self.scores.nrows() {
            for (k, value) in x.iter_mut().enumerate() {
                *value = theta[k] + theta[d + k] * self.scores[(point, k)];
            }
            let frequencies = self.simulator.frequencies_hz(&x).ok()?;
            for (column, &mode) in self.modes.iter().enumerate() {
                let f = frequencies[mode];
                let noise = if self.noise_multiple > 0.0 {
                    self.noise_multiple * self.simulator.std_hz(mode, f) * self.scores[(point, d + column)]
                } else {
                    0.0
                };
                rows.push(f + noise);
            }
        }
        Some(Moments::from_rows(&rows, m))
    }
}

/// Transforms the scores `[points, dimensions]` to have exactly mean 0 and covariance I. Their images under a linear map then
/// have the exact moments, and only the curvature of the map causes an error. `None` for too few points for a covariance.
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
        let mut theta: Vec<f64> = space.iter().map(|p| p.at_level(stream.random())).collect();
        theta.extend(space.iter().map(|p| p.prior_std() * stream.random::<f64>()));
        theta
    }

    fn log_prior(&self, theta: &[f64]) -> f64 {
        let parameters = self.simulator.space().as_slice();
        let (means, stds) = theta.split_at(parameters.len());
        let inside = parameters
            .iter()
            .zip(means)
            .zip(stds)
            .all(|((p, mean), std)| (p.lower..=p.upper).contains(mean) && (0.0..=p.prior_std()).contains(std));
        if inside {
            self.simulator.space().log_prior(means)
        } else {
            f64::NEG_INFINITY
        }
    }

    fn log_likelihood(&self, theta: &[f64]) -> f64 {
        let found = self.simulate(theta).and_then(|simulated| self.measured.bhattacharyya(&simulated));
        found.map_or(f64::NEG_INFINITY, |d| distance::log_likelihood(d, self.epsilon_squared))
    }
}
