//! Draws of (μ, Σ) of a normal population with full covariance: by importance sampling about the most probable one, or by a Markov
//! chain where their posterior is far from normal.

use nalgebra::DMatrix;
use rand::Rng as _;
use rand_distr::StandardNormal;
use rayon::prelude::*;

use super::coordinates::Coordinates;
use super::joint_chain;
use super::normal::Normal;
use super::population::DRAWS;
use super::problem::{Problem, Weights};
use super::small::{SmallMatrix, MOST};
use super::widths::Widths;
use structures::stats;

/// Number of weighted points.
const POINTS: usize = 512;

/// Fewest points per task.
const LEAST_PER_TASK: usize = 64;

/// Widths of the components of the proposal mixture, and the component of each of eight consecutive points.
const WIDTHS: [f64; 2] = [1.1, 2.5];
const TURNS: [usize; 8] = [0, 0, 0, 0, 0, 0, 0, 1];

/// Smallest accepted effective sample size, as a share of the points.
const EFFECTIVE: f64 = 0.3;

/// Whether the covariance of `d` parameters is estimated from `measurements` measurements: with fewer, a correlation is hardly
/// determined. The prior of many correlations moves the standard deviations by up to (d − 1)/√(2n) of their standard errors: below
/// ½ from 2 (d − 1)² measurements on.
pub(super) fn is_estimated(d: usize, measurements: usize) -> bool {
    (2..=MOST).contains(&d) && measurements >= (2 * d + 4).max(2 * (d - 1).pow(2)).max(8)
}

/// [`DRAWS`] populations near `point`, the most probable one; `None` where its covariance is too close to singular for them.
pub(super) fn draws(problem: &Problem, point: &Normal, seed: u64) -> Option<Vec<Normal>> {
    let mut at_point = problem.buffers();
    problem.weigh_normal(point, &mut at_point);
    let moments = problem.moments(point, &at_point);
    let n = problem.measurements as f64;
    let within = SmallMatrix::from_fn(point.size(), |k, l| moments.within.rows[k][l] / n);
    let coordinates = Coordinates::about(point, &within)?;
    let approximation = coordinates.approximation(point, &moments, n);
    let found = weighted(problem, &coordinates, &approximation, &at_point, seed);
    Some(found.unwrap_or_else(|| joint_chain::draws(problem, &coordinates, point, seed)))
}

/// Draws by importance sampling; `None` where their effective sample size is too small.
///
/// ```text
///  θ_i ~ Σ_w share_w N(θ̂, w² H⁻¹),    weight_i = L(θ_i) p(θ_i)/r(θ_i)
/// ```
///
/// θ̂ and H: `approximation`, the mean and the standard deviations of the coordinates.
fn weighted(
    problem: &Problem,
    coordinates: &Coordinates,
    approximation: &(Vec<f64>, Vec<f64>),
    at_point: &Weights,
    seed: u64,
) -> Option<Vec<Normal>> {
    let ((mean, std), count) = (approximation, coordinates.count());
    let mut stream = stats::stream(seed, "joint population draws");
    let widths = Widths::new(WIDTHS, TURNS, POINTS, count);
    let z = DMatrix::from_fn(count, POINTS, |_, place| widths.of(place) * stream.sample::<f64, _>(StandardNormal));
    let theta = DMatrix::from_fn(count, POINTS, |row, place| mean[row] + std[row] * z[(row, place)]);
    let populations: Vec<Option<Normal>> =
        theta.column_iter().map(|theta| coordinates.population(theta.as_slice())).collect();
    let log_weight = |weights: &mut Weights, place: usize| {
        let Some(population) = populations[place].as_ref().filter(|population| problem.allows(population)) else {
            return f64::NEG_INFINITY;
        };
        let log_density = widths.log_density(z.column(place).norm_squared());
        // The same initial divisors for every point, so that the bits do not depend on the number of threads.
        weights.blocks.clone_from(&at_point.blocks);
        problem.weigh_normal(population, weights);
        let log_prior = coordinates.log_prior(theta.column(place).as_slice(), population);
        problem.log_likelihood_of_normal(population, weights) + log_prior - log_density
    };
    let all = (0..POINTS).into_par_iter().with_min_len(LEAST_PER_TASK);
    let log_weights: Vec<f64> = all.map_init(|| problem.buffers(), log_weight).collect();
    let weights = stats::weights(&log_weights, EFFECTIVE)?;
    let chosen = stats::systematic(&weights, DRAWS, &mut stream);
    chosen.into_iter().map(|place| populations[place].clone()).collect()
}
