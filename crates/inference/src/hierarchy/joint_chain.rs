//! Draws of (μ, Σ) by Markov chains, for populations whose posterior is far from a normal distribution.

use rand::Rng as _;
use rand_distr::{ChiSquared, Gamma, StandardNormal};
use rayon::prelude::*;

use super::coordinates::Coordinates;
use super::normal::Normal;
use super::population::DRAWS;
use super::problem::{Problem, Weights};
use super::small::{SmallMatrix, SmallVector, MOST};
use structures::stats::{self, Stream};

/// Number of Markov chains, which run in parallel.
const CHAINS: usize = 2;

/// Sweeps of each chain before the first draw that is kept. All later draws are kept.
const BURN_IN: usize = 40;

/// Metropolis steps after each sweep.
const STEPS: usize = 2;

/// Sizes of a Metropolis step relative to the standard deviations of the coordinates, of which one is drawn: the width of the
/// likelihood depends on the noise.
const SIZES: [f64; 3] = [0.4, 0.9, 2.0];

/// [`DRAWS`] states of Gibbs samplers that start at `point`.
///
/// ```text
///  s_j ~ w_j,   t_k | Σ ~ Gamma((d + 1)/2, rate (Σ⁻¹)_kk),   Σ | s, t ~ inverse Wishart(n + d, S + 2 diag t) · Π σ_k p(σ_k),
///  μ | Σ, s ~ N(x̄, Σ/n)
/// ```
///
/// s_j: the sample selected for measurement j with probability proportional to its weight; x̄ and S: mean of the selected samples
/// and sum of the products of their deviations from it. t turns the prior of [`Coordinates`] into an inverse Wishart distribution
/// times Π σ_k p(σ_k), and a Metropolis step accepts or rejects Σ by that factor and by the limits of μ and σ.
///
/// For noise-dominated directions the selected samples determine Σ almost completely, so that the sampler hardly moves. Each sweep
/// is therefore followed by Metropolis steps on L(μ, Σ), with the samples summed out, in the coordinates of the measured values.
pub(super) fn draws(problem: &Problem, coordinates: &Coordinates, point: &Normal, seed: u64) -> Vec<Normal> {
    let chain = |chain: usize| {
        let stream = stats::stream(seed, &format!("joint population chain {chain}"));
        let chain = Chain { problem, coordinates, stream, weights: problem.buffers(), others: problem.buffers() };
        chain.run(point, DRAWS / CHAINS)
    };
    (0..CHAINS).into_par_iter().map(chain).collect::<Vec<_>>().concat()
}

/// One Markov chain.
struct Chain<'p> {
    problem: &'p Problem,
    coordinates: &'p Coordinates,
    stream: Stream,
    /// Weights under the present population, before and after each step.
    weights: Weights,
    /// Buffer for those under a proposed population.
    others: Weights,
}

impl Chain<'_> {
    fn run(mut self, point: &Normal, draws: usize) -> Vec<Normal> {
        let mut state = point.clone();
        let mut kept = Vec::with_capacity(draws);
        self.problem.weigh_normal(&state, &mut self.weights);
        for sweep in 0..BURN_IN + draws {
            state = self.sweep(state);
            self.problem.weigh_normal(&state, &mut self.weights);
            for _ in 0..STEPS {
                state = self.step(state);
            }
            if sweep >= BURN_IN {
                kept.push(state.clone());
            }
        }
        kept
    }

    /// One sweep of the Gibbs sampler.
    fn sweep(&mut self, state: Normal) -> Normal {
        let (n, d) = (self.problem.measurements as f64, state.size());
        let (mean, mut scale) = self.selected(d);
        let precision = state.precision();
        for k in 0..d {
            let gamma =
                Gamma::new(0.5 * (d + 1) as f64, 1.0 / precision.rows[k][k]).expect("shape and scale are positive");
            scale.rows[k][k] += 2.0 * self.stream.sample(gamma);
        }
        let proposed =
            self.inverse_wishart(n + d as f64, &scale).and_then(|covariance| Normal::new(state.mean, &covariance));
        let log = |normal: &Normal| self.coordinates.log_prior_of_stds(normal);
        let threshold: f64 = self.stream.random();
        let next = proposed
            .filter(|proposed| self.problem.allows_stds(proposed) && threshold.ln() < log(proposed) - log(&state));
        let next = next.unwrap_or(state);
        let root = next.covariance.cholesky().expect("a population has a positive definite covariance");
        let mut draw = || {
            let shift = root.apply(&self.normals(d));
            let mean: SmallVector = std::array::from_fn(|k| mean[k] + shift[k] / n.sqrt());
            mean
        };
        let inside = (0..20).map(|_| draw()).find(|mean| mean.iter().all(|mean| (0.0..=1.0).contains(mean)));
        Normal { mean: inside.unwrap_or(next.mean), ..next }
    }

    fn normals(&mut self, d: usize) -> SmallVector {
        let mut all = [0.0; MOST];
        all.iter_mut().take(d).for_each(|z| *z = self.stream.sample(StandardNormal));
        all
    }

    /// Mean of one selected sample of each measurement, and sum of the products of their deviations from it.
    fn selected(&mut self, d: usize) -> (SmallVector, SmallMatrix) {
        let (problem, n) = (self.problem, self.problem.measurements as f64);
        // Place and lane of the selected sample of each measurement.
        let mut chosen = Vec::with_capacity(problem.measurements);
        for (block, weighed) in problem.blocks.iter().zip(&self.weights.blocks) {
            block.choose(&self.weights.values, weighed, || self.stream.random(), &mut chosen);
        }
        let value = |measurement: usize, k: usize| {
            let (place, lane) = chosen[measurement];
            problem.centres(measurement)[k] + f64::from(problem.deviations[k][place].0[lane])
        };
        let of_each = |k: usize| (0..problem.measurements).map(|j| value(j, k)).sum::<f64>() / n;
        let mean: SmallVector = std::array::from_fn(|k| if k < d { of_each(k) } else { 0.0 });
        let product = |k: usize, l: usize| {
            (0..problem.measurements).map(|j| (value(j, k) - mean[k]) * (value(j, l) - mean[l])).sum::<f64>()
        };
        (mean, SmallMatrix::from_fn(d, product))
    }

    /// A draw from the inverse Wishart distribution, by Bartlett's decomposition; `None` where `scale` is singular.
    ///
    /// ```text
    ///  Σ = (L A⁻ᵀ)(L A⁻ᵀ)ᵀ,    scale = L Lᵀ,    A lower triangular, A_ii² ~ χ²(ν − i) with i from 0, A_ij ~ N(0, 1)
    /// ```
    fn inverse_wishart(&mut self, degrees_of_freedom: f64, scale: &SmallMatrix) -> Option<SmallMatrix> {
        let d = scale.size;
        let mut factor = SmallMatrix::from_fn(d, |_, _| 0.0);
        for i in 0..d {
            let squared = ChiSquared::new(degrees_of_freedom - i as f64).expect("more degrees of freedom than rows");
            factor.rows[i][i] = self.stream.sample(squared).sqrt();
            for j in 0..i {
                factor.rows[i][j] = self.stream.sample(StandardNormal);
            }
        }
        Some(scale.cholesky()?.times(&factor.lower_inverse().transposed()).squared())
    }

    /// One Metropolis step on the likelihood in the coordinates of one row of U: the mean, the scale and the regression of one
    /// measured value on those before it.
    fn step(&mut self, state: Normal) -> Normal {
        let row = self.stream.random_range(0..state.size());
        let size = SIZES[self.stream.random_range(0..SIZES.len())];
        let threshold: f64 = self.stream.random();
        let Some(theta) = self.coordinates.of(&state) else { return state };
        let own = self.coordinates.of_row(row);
        let n = self.problem.measurements as f64;
        let mut next = theta.clone();
        for (place, information) in &own {
            next[*place] +=
                size * self.stream.sample::<f64, _>(StandardNormal) / (information * n * own.len() as f64).sqrt();
        }
        let Some(proposed) = self.coordinates.population(&next).filter(|proposed| self.problem.allows(proposed)) else {
            return state;
        };
        self.others.blocks.clone_from(&self.weights.blocks);
        self.problem.weigh_normal(&proposed, &mut self.others);
        let log = |normal: &Normal, theta: &[f64], weights: &Weights| {
            self.problem.log_likelihood_of_normal(normal, weights) + self.coordinates.log_prior(theta, normal)
        };
        let gain = log(&proposed, &next, &self.others) - log(&state, &theta, &self.weights);
        if threshold.ln() < gain {
            std::mem::swap(&mut self.weights, &mut self.others);
            return proposed;
        }
        state
    }
}
