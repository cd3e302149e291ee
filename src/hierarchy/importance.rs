//! Draws of (μ, σ) by importance: points of a normal distribution about the most probable population, weighed by the likelihood.
//!
//! Each point is independent of all others and asks for the likelihood once, where a Markov chain takes several steps from one
//! draw to the next that tells more. Where the posterior is far from normal the weights say so, and the chain
//! ([`super::gibbs`]) takes over.

use nalgebra::{DMatrix, DVector};
use rand::Rng as _;
use rand_distr::StandardNormal;
use rayon::prelude::*;

use super::problem::{Problem, State, Weights};
use super::widths::Widths;
use super::DRAWS;
use crate::stats;

/// Points that are weighed.
const POINTS: usize = 512;

/// Points of one task.
const AT_A_TIME: usize = 64;

/// Widths that the points have, and the turns that eight points take among them.
const WIDTHS: [f64; 2] = [1.1, 2.5];
const TURNS: [usize; 8] = [0, 0, 0, 0, 0, 0, 0, 1];

/// Share of the points that the weights must leave effective: the chain's 400 draws of a parameter that noise hides are worth fewer.
const EFFECTIVE: f64 = 0.3;

/// Fewest measurements: of fewer, σ has tails that no normal distribution of ln σ reaches, and the weights need not show it.
const FEWEST: usize = 8;

/// [`DRAWS`] states about `point`, the most probable one; `None` where the posterior is too far from normal.
///
/// ```text
///  θ = ((μ_k − μ̂_k)/σ̂_k, ln σ_k/σ̂_k),    θ_i ~ Σ_w share_w N(θ̂, w² H⁻¹),    weight_i = L(θ_i) Π σ_ik / r(θ_i),
///  θ̂ = H⁻¹ (∇ ln L + (0, 1)),    H = −∇∇ᵀ ln L   at the point
/// ```
pub(super) fn draws(problem: &Problem, point: &State, seed: u64) -> Option<Vec<State>> {
    if problem.measurements < FEWEST {
        return None;
    }
    let mut at_point = problem.room();
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
    let log_weight = |room: &mut Weights, place: usize| {
        let state = state(place);
        if !(0..d).all(|k| problem.is_possible(&state, k)) {
            return f64::NEG_INFINITY;
        }
        let log_density = widths.log_density(z.column(place).norm_squared());
        // From the same divisors whichever point was weighed before: the same bits however many threads there are.
        room.blocks.clone_from(&at_point.blocks);
        problem.weigh(&state, room);
        // σ, the weight's last factor.
        problem.log_likelihood(&state, room) + theta.column(place).rows(d, d).sum() - log_density
    };
    let all = (0..POINTS).into_par_iter().with_min_len(AT_A_TIME);
    let log_weights: Vec<f64> = all.map_init(|| problem.room(), log_weight).collect();
    let weights = stats::weights(&log_weights, EFFECTIVE)?;
    Some(stats::systematic(&weights, DRAWS, &mut stream).into_iter().map(state).collect())
}

/// Gradient of ln L and its information −∇∇ᵀ ln L, in (μ_k/σ̂_k, ln σ_k) at `point`, the means first; `weights` are those there.
///
/// ```text
///  ∇ ln L = Σ_j E_j c,    H = Σ_j E_j [I_c] − Cov_j c,    c = (z_k, z_k² − 1),    I_c: 1, 2 z_k; 2 z_k, 2 z_k² of each k
/// ```
///
/// z_k = (x_k − μ_k)/σ_k, E_j over the weighed samples of measurement j. Source: T. A. Louis (1982), Finding the observed
/// information matrix when using the EM algorithm, J. R. Stat. Soc. B 44, 226–233.
fn derivatives(problem: &Problem, point: &State, weights: &Weights) -> (DVector<f64>, DMatrix<f64>) {
    let d = point.mean.len();
    // √w c of each sample.
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
        // Σ_j E_j z and Σ_j E_j z² are in the gradient.
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
    use crate::parameter::{DamageDirection, Parameter, ParameterSpace};
    use crate::posterior::PosteriorSamples;

    /// Normal posteriors of three parameters, so wide as each of `within`, of a population with the spread `std`.
    fn problem(measurements: usize, within: [f64; 3], std: f64) -> Problem {
        let parameter = |name: &str| Parameter {
            name: name.to_owned(),
            unit: "N/m".to_owned(),
            lower: 0.0,
            upper: 1.0,
            damage: DamageDirection::Decrease,
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
            let mut room = problem.room();
            problem.weigh(&state, &mut room);
            problem.log_likelihood(&state, &room)
        };
        let mut weights = problem.room();
        problem.weigh(&point, &mut weights);
        let (gradient, information) = derivatives(&problem, &point, &weights);
        let step = 0.05;
        for row in 0..6 {
            let slope = (likelihood(&[(row, step)]) - likelihood(&[(row, -step)])) / (2.0 * step);
            // Likelihoods in single precision, some 1e-5; third derivatives of 8·20 at most: h²/6 of them.
            assert!((gradient[row] - slope).abs() < 0.1, "{row}: {}, by differences {slope}", gradient[row]);
            for column in 0..6 {
                let both = |a: f64, b: f64| likelihood(&[(row, a * step), (column, b * step)]);
                let bend = both(1.0, 1.0) - both(1.0, -1.0) - both(-1.0, 1.0) + both(-1.0, -1.0);
                let (found, expected) = (information[(row, column)], -bend / (4.0 * step * step));
                // Fourth derivatives of 16·20 at most: h²/3 of them, where row and column are one.
                assert!((found - expected).abs() < 0.4, "{row}, {column}: {found}, by differences {expected}");
            }
        }
    }

    #[test]
    fn draws_are_of_the_same_distribution_as_those_of_the_chain() {
        const SEEDS: u64 = 25;
        for (measurements, within) in [(20, [0.001, 0.02, 0.04]), (50, [0.01, 0.03, 0.05]), (50, [0.03, 0.1, 0.04])] {
            let problem = problem(measurements, within, 0.05);
            let point = problem.maximise();
            let numbers = |state: &State| [0, 1, 2].map(|k| [state.mean[k], state.std[k].ln()]).concat();
            let by_weights = (0..SEEDS).flat_map(|seed| draws(&problem, &point, seed).expect("it is near to normal"));
            let by_weights: Vec<Vec<f64>> = by_weights.map(|state| numbers(&state)).collect();
            let by_chain = (0..SEEDS).flat_map(|seed| gibbs::draws(&problem, &point, seed));
            let by_chain: Vec<Vec<f64>> = by_chain.map(|state| numbers(&state)).collect();
            for number in 0..6 {
                let column = |all: &[Vec<f64>]| -> Vec<f64> { all.iter().map(|draw| draw[number]).collect() };
                let (own, chain) = (column(&by_weights), column(&by_chain));
                let std = stats::sample_std(&chain).unwrap();
                let shift = (stats::mean(&own) - stats::mean(&chain)) / std;
                // 10,000 draws each; those of the chain tell at worst as much as 1,000 independent ones, the weighed ones as 5,000:
                // 0.035 for a mean, 0.025 for a spread; three and a half times that.
                assert!(shift.abs() < 0.12, "{measurements}, {number}: {shift} standard deviations apart");
                let ratio = stats::sample_std(&own).unwrap() / std;
                assert!((ratio - 1.0).abs() < 0.09, "{measurements}, {number}: spreads differ by {ratio}");
                for level in [0.05, 0.95] {
                    let apart = (stats::quantile(&own, level) - stats::quantile(&chain, level)) / std;
                    // A quantile there is twice as noisy as the mean.
                    assert!(apart.abs() < 0.24, "{measurements}, {number}: {apart} at {level}");
                }
            }
        }
    }

    #[test]
    fn what_is_far_from_normal_is_left_to_the_chain() {
        // Noise of ten times the spread: any spread from nothing up to some of the noise is as likely.
        let hidden = problem(20, [0.2, 0.2, 0.2], 0.02);
        assert!(draws(&hidden, &hidden.maximise(), 1).is_none());
        let few = problem(FEWEST - 1, [0.001, 0.02, 0.04], 0.05);
        assert!(draws(&few, &few.maximise(), 1).is_none());
    }
}
