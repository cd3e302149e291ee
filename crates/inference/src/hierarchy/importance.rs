//! Draws of (μ, σ) by importance sampling: points of a normal distribution about the most probable population, weighted by
//! the likelihood.
//!
//! The points are independent and need one evaluation of the likelihood each, whereas a Markov chain needs several steps
//! per independent draw. Where the posterior is far from normal, the effective sample size is small and the Markov chain
//! (`gibbs`) is used instead.

use nalgebra::{DMatrix, DVector};
use rand::Rng as _;
use rand_distr::StandardNormal;
use rayon::prelude::*;

use super::population::DRAWS;
use super::problem::{Problem, State, Weights};
use super::widths::Widths;
use structures::stats;

/// Number of weighted points.
const POINTS: usize = 512;

/// Fewest points per task.
const LEAST_PER_TASK: usize = 64;

/// Widths of the components of the proposal mixture, and the component of each of eight consecutive points.
const WIDTHS: [f64; 2] = [1.1, 2.5];
const TURNS: [usize; 8] = [0, 0, 0, 0, 0, 0, 0, 1];

/// Smallest accepted effective sample size, as a share of the points. For a noise-dominated parameter the 400 correlated
/// draws of the chain are worth less than that.
const EFFECTIVE: f64 = 0.3;

/// Fewest measurements. With fewer, the tails of σ are heavier than those of the mixture, which the weights need not
/// reveal.
pub(super) const FEWEST: usize = 8;

/// [`DRAWS`] states near `point`, the most probable one; `None` where the posterior is too far from normal.
///
/// ```text
///  θ = ((μ_k − μ̂_k)/σ̂_k, ln σ_k/σ̂_k),    θ_i ~ Σ_w share_w N(θ̂, w² H⁻¹),    weight_i = L(θ_i) Π σ_ik / r(θ_i),
///  θ̂ = H⁻¹ (∇ ln L + (0, 1)),    H = −∇∇ᵀ ln L   at the point
/// ```
pub(super) fn draws(problem: &Problem, point: &State, seed: u64) -> Option<Vec<State>> {
    if problem.measurements < FEWEST {
        return None;
    }
    let mut at_point = problem.buffers();
    problem.weigh(point, &mut at_point);
    let (gradient, information) = derivatives(problem, point, &at_point);
    let d = point.mean.len();
    let covariance = information.cholesky()?.inverse();
    let prior = DVector::from_fn(2 * d, |row, _| if row < d { 0.0 } else { 1.0 });
    let centre = &covariance * (gradient + prior);
    let factor = covariance.cholesky()?.unpack();
    let mut stream = stats::stream(seed, "population draws");
    let widths = Widths::new(WIDTHS, TURNS, POINTS, 2 * d);
    let z = DMatrix::from_fn(2 * d, POINTS, |_, place| widths.of(place) * stream.sample::<f64, _>(StandardNormal));
    let theta = &factor * &z;
    let state = |place: usize| {
        let (theta, centre) = (theta.column(place), &centre);
        let mean = (0..d).map(|k| point.mean[k] + point.std[k] * (centre[k] + theta[k]));
        let std = (d..2 * d).map(|row| point.std[row - d] * (centre[row] + theta[row]).exp());
        State { mean: mean.collect(), std: std.collect() }
    };
    let log_weight = |weights: &mut Weights, place: usize| {
        let state = state(place);
        if !(0..d).all(|k| problem.is_possible(&state, k)) {
            return f64::NEG_INFINITY;
        }
        let log_density = widths.log_density(z.column(place).norm_squared());
        // The same initial divisors for every point, so that the bits do not depend on the number of threads.
        weights.blocks.clone_from(&at_point.blocks);
        problem.weigh(&state, weights);
        // The last sum is the factor Π σ of the weight.
        problem.log_likelihood(&state, weights) + theta.column(place).rows(d, d).sum() - log_density
    };
    let all = (0..POINTS).into_par_iter().with_min_len(LEAST_PER_TASK);
    let log_weights: Vec<f64> = all.map_init(|| problem.buffers(), log_weight).collect();
    let weights = stats::weights(&log_weights, EFFECTIVE)?;
    Some(stats::systematic(&weights, DRAWS, &mut stream).into_iter().map(state).collect())
}

/// Gradient of ln L, `[2d]`, and observed information −∇∇ᵀ ln L, `[2d, 2d]`, with respect to (μ_k/σ̂_k, ln σ_k) at `point`,
/// the means first. `weights`: those at `point`.
///
/// ```text
///  ∇ ln L = Σ_j E_j c,    H = Σ_j E_j [I_c] − Cov_j c,    c = (z_k, z_k² − 1),    I_c: 1, 2 z_k; 2 z_k, 2 z_k² of each k
/// ```
///
/// with z_k = (x_k − μ_k)/σ_k and E_j the mean over the weighted samples of measurement j.
///
/// Source: T. A. Louis (1982), Finding the observed information matrix when using the EM algorithm, J. R. Stat. Soc. B 44,
/// 226–233.
fn derivatives(problem: &Problem, point: &State, weights: &Weights) -> (DVector<f64>, DMatrix<f64>) {
    let d = point.mean.len();
    // √w·c of each sample, one column each.
    let mut scores = DMatrix::zeros(2 * d, problem.measurements * problem.draws);
    let (mut gradient, mut information) = (DVector::zeros(2 * d), DMatrix::zeros(2 * d, 2 * d));
    let mut mean = DVector::zeros(2 * d);
    for (block, weighed) in problem.blocks.iter().zip(&weights.blocks) {
        for (measurement, lanes) in block.lanes() {
            let sum = weighed.sum.of(lanes);
            let centres = problem.centres(measurement);
            mean.fill(0.0);
            for draw in 0..problem.draws {
                let (place, lane) = block.place(measurement, draw);
                let weight = f64::from(weights.values[place].0[lane]) / sum;
                let mut scores = scores.column_mut(measurement * problem.draws + draw);
                for k in 0..d {
                    let z =
                        (centres[k] + f64::from(problem.deviations[k][place].0[lane]) - point.mean[k]) / point.std[k];
                    (scores[k], scores[d + k]) = (z, z * z - 1.0);
                }
                mean.axpy(weight, &scores, 1.0);
                scores *= weight.sqrt();
            }
            gradient += &mean;
            information.ger(1.0, &mean, &mean, 1.0);
        }
    }
    information -= &scores * scores.transpose();
    for k in 0..d {
        // The gradient contains Σ_j E_j z and Σ_j E_j z².
        let (first, second) = (gradient[k], gradient[d + k] + problem.measurements as f64);
        information[(k, k)] += problem.measurements as f64;
        information[(d + k, d + k)] += 2.0 * second;
        information[(k, d + k)] += 2.0 * first;
        information[(d + k, k)] += 2.0 * first;
    }
    (gradient, information)
}

#[cfg(test)]
mod tests {
    use super::super::gibbs;
    use super::*;
    use crate::posterior::PosteriorSamples;
    use structures::parameter::{DamageDirection, Parameter, ParameterSpace, PriorForm};

    /// Normal posteriors of three parameters with standard deviations `within`, from a population with standard deviation
    /// `std`.
    fn problem(measurements: usize, within: [f64; 3], std: f64) -> Problem {
        let parameter = |name: &str| Parameter {
            name: name.to_owned(),
            unit: "N/m".to_owned(),
            lower: 0.0,
            upper: 1.0,
            damage: DamageDirection::Decrease,
            form: PriorForm::Uniform,
        };
        let space = ParameterSpace::new(["a", "b", "c"].map(parameter).to_vec());
        let (draws, mut stream) = (64, stats::stream(3, "test: populations"));
        let mut theta = DMatrix::zeros(measurements * draws, 3);
        for measurement in 0..measurements {
            for k in 0..3 {
                let mut normal = |spread: f64| spread * stream.sample::<f64, _>(StandardNormal);
                let measured = 0.5 + normal(std) + normal(within[k]);
                (0..draws).for_each(|draw| theta[(measurement * draws + draw, k)] = measured + normal(within[k]));
            }
        }
        Problem::new(&PosteriorSamples::new(theta, draws), None, &space)
    }

    #[test]
    fn gradient_and_information_are_those_of_finite_differences() {
        let problem = problem(20, [0.01, 0.03, 0.05], 0.05);
        let point = State { mean: vec![0.5, 0.51, 0.49], std: vec![0.05, 0.04, 0.06] };
        let likelihood = |steps: &[(usize, f64)]| {
            let mut state = point.clone();
            for (row, step) in steps {
                let k = row % 3;
                if *row < 3 {
                    state.mean[k] += step * point.std[k];
                } else {
                    state.std[k] *= step.exp();
                }
            }
            let mut weights = problem.buffers();
            problem.weigh(&state, &mut weights);
            problem.log_likelihood(&state, &weights)
        };
        let mut weights = problem.buffers();
        problem.weigh(&point, &mut weights);
        let (gradient, information) = derivatives(&problem, &point, &weights);
        let step = 0.05;
        for row in 0..6 {
            let slope = (likelihood(&[(row, step)]) - likelihood(&[(row, -step)])) / (2.0 * step);
            // Single precision gives errors of about 1e-5; third derivatives are at most 8·20, and enter with h²/6.
            assert!((gradient[row] - slope).abs() < 0.1, "{row}: {}, by differences {slope}", gradient[row]);
            for column in 0..6 {
                let both = |a: f64, b: f64| likelihood(&[(row, a * step), (column, b * step)]);
                let bend = both(1.0, 1.0) - both(1.0, -1.0) - both(-1.0, 1.0) + both(-1.0, -1.0);
                let (found, expected) = (information[(row, column)], -bend / (4.0 * step * step));
                // Fourth derivatives are at most 16·20, and enter with h²/3 where row and column are equal.
                assert!((found - expected).abs() < 0.4, "{row}, {column}: {found}, by differences {expected}");
            }
        }
    }

    #[test]
    fn draws_have_the_same_distribution_as_those_of_the_chain() {
        const SEEDS: u64 = 25;
        for (measurements, within) in [(20, [0.001, 0.02, 0.04]), (50, [0.01, 0.03, 0.05]), (50, [0.03, 0.1, 0.04])] {
            let problem = problem(measurements, within, 0.05);
            let point = problem.maximise();
            let numbers = |state: &State| [0, 1, 2].map(|k| [state.mean[k], state.std[k].ln()]).concat();
            let by_weights = (0..SEEDS).flat_map(|seed| draws(&problem, &point, seed).expect("it is close to normal"));
            let by_weights: Vec<Vec<f64>> = by_weights.map(|state| numbers(&state)).collect();
            let by_chain = (0..SEEDS).flat_map(|seed| gibbs::draws(&problem, &point, seed));
            let by_chain: Vec<Vec<f64>> = by_chain.map(|state| numbers(&state)).collect();
            for number in 0..6 {
                let column = |all: &[Vec<f64>]| -> Vec<f64> { all.iter().map(|draw| draw[number]).collect() };
                let (own, chain) = (column(&by_weights), column(&by_chain));
                let std = stats::sample_std(&chain).unwrap();
                let shift = (stats::mean(&own) - stats::mean(&chain)) / std;
                // 10,000 draws each; the chain has an effective sample size of at least 1,000, the weighted points of
                // 5,000. The standard errors are 0.035 for a mean and 0.025 for a spread; the bounds are 3.5 times that.
                assert!(shift.abs() < 0.12, "{measurements}, {number}: {shift} standard deviations apart");
                let ratio = stats::sample_std(&own).unwrap() / std;
                assert!((ratio - 1.0).abs() < 0.09, "{measurements}, {number}: spreads differ by {ratio}");
                for level in [0.05, 0.95] {
                    let apart = (stats::quantile(&own, level) - stats::quantile(&chain, level)) / std;
                    // The standard error of these quantiles is twice that of the mean.
                    assert!(apart.abs() < 0.24, "{measurements}, {number}: {apart} at {level}");
                }
            }
        }
    }

    #[test]
    fn posteriors_far_from_normal_give_no_importance_draws() {
        // With noise of ten times the spread, any spread from zero up to a part of the noise is equally likely.
        let noise_dominated = problem(20, [0.2, 0.2, 0.2], 0.02);
        assert!(draws(&noise_dominated, &noise_dominated.maximise(), 1).is_none());
        let few = problem(FEWEST - 1, [0.001, 0.02, 0.04], 0.05);
        assert!(draws(&few, &few.maximise(), 1).is_none());
    }
}
