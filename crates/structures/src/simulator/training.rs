//! Simulated training sets and measurements.

use nalgebra::DMatrix;
use rand::Rng as _;
use rand_distr::StandardNormal;
use rayon::prelude::*;

use super::effect;
use super::model::Binding;
use super::simulate::{Error, Simulator, NOISE_TRIES};
use crate::parameter::{Parameter, ParameterSpace};
use crate::stats;

/// Margin of the training box on each side, as a share of the prior's width.
const MARGIN: f64 = 0.1;

/// Simulated parameters with their exact frequencies, from which a flow is trained.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainingSet {
    /// Parameters, drawn from their priors in a box, `[n, d]`, parameter units.
    pub theta: DMatrix<f64>,
    /// Frequencies without noise, Hz, `[n, m]`.
    pub frequencies_hz: DMatrix<f64>,
    /// Mode shapes of unit norm at the instrumented points, `[points, m]` for each row; empty if there are no such points.
    pub shapes: Vec<DMatrix<f64>>,
    /// Sizes of the effects under the covariates of each row, computed with the mean coefficients of their laws, `[n][sizes]`.
    /// The frequencies are simulated with coefficients drawn from their distribution.
    pub effect_sizes: Vec<Vec<f64>>,
    /// Seed of the draws.
    pub seed: u64,
}

impl Simulator {
    /// The box in which a flow is trained: a uniform prior with a margin on each side. A density is hardest to learn at the edge of its
    /// support, and the margin keeps the bounds of the prior away from that edge.
    ///
    /// The margin is a tenth of the width of the prior. It is smaller where a stiffness would fall below half its smallest value
    /// in the prior, and zero for a table, which must not be extrapolated, and for a prior with tails, whose density has no edge.
    pub fn training_space(&self) -> ParameterSpace {
        if self.table().is_some() {
            return self.space().clone();
        }
        let padded = |(column, parameter): (usize, &Parameter)| {
            if !parameter.is_uniform() {
                return parameter.clone();
            }
            let width = parameter.upper - parameter.lower;
            let bindings = || self.bindings().iter().filter(move |b| b.parameter == column);
            let margin = |bound: f64, outwards: f64| {
                let stiff = |value: f64, b: &Binding| {
                    let least = b.stiffness(parameter.lower).min(b.stiffness(parameter.upper));
                    least > 0.0 && b.stiffness(value) >= 0.5 * least && b.stiffness(value).is_finite()
                };
                let tries = (0..12).map(|halvings| MARGIN * width * 0.5_f64.powi(halvings));
                let fits = |margin: &f64| bindings().all(|b| stiff(bound + outwards * margin, b));
                { tries }.find(fits).unwrap_or(0.0)
            };
            // What a mass or a deviation of no single part may be ends where the prior does, at 0 for most of them.
            let bounded = self.size_bindings().iter().any(|b| b.parameter == column);
            let margin = |bound: f64, outwards: f64| if bounded { 0.0 } else { margin(bound, outwards) };
            let (below, above) = (margin(parameter.lower, -1.0), margin(parameter.upper, 1.0));
            Parameter { lower: parameter.lower - below, upper: parameter.upper + above, ..parameter.clone() }
        };
        ParameterSpace::new(self.space().iter().enumerate().map(padded).collect())
    }

    /// Simulates `samples` rows of parameters drawn from the prior. The same seed gives the same bits on any number of threads.
    ///
    /// # Errors
    /// As [`Self::pairs`].
    pub fn training_set(&self, samples: usize, seed: u64) -> Result<TrainingSet, Error> {
        self.pairs(self.space(), samples, seed)
    }

    /// Simulates `samples` rows of parameters drawn from the priors of the box `space`. The same seed gives the same bits on any number
    /// of threads, and a longer set begins with the rows of a shorter one.
    ///
    /// # Errors
    /// [`Error::Physics`]. The prior of a checked definition contains no mechanism, so that this occurs only if its stiffnesses
    /// differ by twelve orders of magnitude.
    pub fn pairs(&self, space: &ParameterSpace, samples: usize, seed: u64) -> Result<TrainingSet, Error> {
        let mut stream = stats::stream(seed, "prior");
        // Drawn row by row, so that a longer set begins with the rows of a shorter one.
        let rows: Vec<Vec<f64>> =
            (0..samples).map(|_| space.iter().map(|p| p.at_level(stream.random::<f64>())).collect()).collect();
        let theta = DMatrix::from_fn(samples, space.len(), |row, column| rows[row][column]);
        let mut stream = stats::stream(seed, "covariates");
        let mut effect_sizes = vec![Vec::new(); samples];
        let mut drawn = vec![Vec::new(); samples];
        if !self.effects().is_empty() {
            for (known, drawn) in effect_sizes.iter_mut().zip(&mut drawn) {
                let covariates = effect::draw_covariates(self.effects(), &mut stream);
                *known = self.effect_sizes(&covariates).values;
                *drawn = effect::draw_sizes(self.effects(), &covariates, &mut stream);
            }
        }
        let with_shapes = self.shape_points() > 0;
        let simulate = |(theta, sizes): (&Vec<f64>, &Vec<f64>)| {
            let simulator = if self.effects().is_empty() { self.clone() } else { self.under(sizes) };
            let found = if with_shapes {
                simulator.frequencies_and_shapes(theta)
            } else {
                simulator.frequencies_hz(theta).map(|frequencies_hz| (frequencies_hz, DMatrix::zeros(0, 0)))
            };
            found.map_err(|source| Error::Physics { parameters: theta.clone(), source })
        };
        let both = rows.par_iter().zip(&drawn).map(simulate).collect::<Result<Vec<_>, _>>()?;
        let (exact, mut shapes): (Vec<_>, Vec<_>) = both.into_iter().unzip();
        if !with_shapes {
            shapes.clear();
        }
        let frequencies_hz = DMatrix::from_fn(samples, self.modes(), |row, mode| exact[row][mode]);
        Ok(TrainingSet { theta, frequencies_hz, shapes, effect_sizes, seed })
    }

    /// Frequencies without noise at each row of parameters, Hz, `[n][m]`.
    fn exact(&self, rows: &[Vec<f64>]) -> Result<Vec<Vec<f64>>, Error> {
        let simulate = |theta: &Vec<f64>| {
            self.frequencies_hz(theta).map_err(|source| Error::Physics { parameters: theta.clone(), source })
        };
        rows.par_iter().map(simulate).collect()
    }

    /// Frequencies at each row of parameters (`[n][d]`) with the measurement noise of the structure, Hz, `[n, m]`.
    ///
    /// # Errors
    /// [`Error`] for a negative stiffness or a mechanism, and for noise that leaves no positive frequency.
    pub fn measured(&self, rows: &[Vec<f64>], seed: u64) -> Result<DMatrix<f64>, Error> {
        self.measure(rows, 1.0, seed)
    }

    /// [`Self::measured`] with `noise_multiple` times the measurement noise.
    pub(super) fn measure(&self, rows: &[Vec<f64>], noise_multiple: f64, seed: u64) -> Result<DMatrix<f64>, Error> {
        self.with_noise(&self.exact(rows)?, noise_multiple, seed)
    }

    /// The frequencies `exact`, Hz, `[n][m]`, with `noise_multiple` times the measurement noise of the structure, Hz, `[n, m]`.
    pub(super) fn with_noise(&self, exact: &[Vec<f64>], noise_multiple: f64, seed: u64) -> Result<DMatrix<f64>, Error> {
        let mut stream = stats::stream(seed, "measurement noise");
        let mut noisy = DMatrix::zeros(exact.len(), self.modes());
        for (row, frequencies) in exact.iter().enumerate() {
            for (mode, &frequency_hz) in frequencies.iter().enumerate() {
                let std_hz = noise_multiple * self.std_hz(mode, frequency_hz);
                let mut draw = || frequency_hz + std_hz * stream.sample::<f64, _>(StandardNormal);
                let value = (0..NOISE_TRIES).map(|_| draw()).find(|f| *f > 0.0);
                noisy[(row, mode)] = value.ok_or(Error::Noise { frequency_hz, std_hz })?;
            }
        }
        Ok(noisy)
    }
}
