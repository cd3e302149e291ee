//! The value of a measurement: the expected probability of the right candidate after it.
//!
//! ```text
//!  U = Σ_i p_i E[ Σ_{k ∈ c(i)} p_k N(y; m_k, S_k) / Σ_j p_j N(y; m_j, S_j) ],    y ~ N(m_i, S_i),    S_i = J C Jᵀ + L + W/R
//! ```
//!
//! i, j: candidates with one of their laws; c(i): those of the same candidate; p: their probabilities; m, S: the prediction of each
//! (see [`Prediction`]). The expectations are means over simulated measurements. All experiments use the same standard normal
//! numbers, so that their values differ by the experiments and not by chance.
//!
//! Source: Lindley (1956), On a measure of the information provided by an experiment, Ann. Math. Statist. 27, 986–1005, for the
//! value of an experiment as an expectation over its outcomes; the probability of the right candidate takes the place of
//! information here.

use rand::Rng as _;
use rand_distr::StandardNormal;

use super::predict::Prediction;
use crate::stats;

/// Simulated measurements of a probable candidate, and of one with a probability below [`SELDOM`], which contributes little.
pub(super) const DRAWS: usize = 64;
pub(super) const FEWER_DRAWS: usize = 16;
const SELDOM: f64 = 0.1;

/// Seed of the simulated measurements. It is fixed, so that the ranking depends on nothing but the data.
const SEED: u64 = 1;

/// Added to the variance of every quantity, as a share of it, so that its covariance can be factored.
const RIDGE: f64 = 1e-9;

/// Expected probability that a further measurement should reach.
pub(super) const WANTED: f64 = 0.95;

/// Greatest number of repeats that is considered.
pub(super) const MOST_REPEATS: usize = 100;

/// The value of a measurement.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Value {
    /// Expected probability of the right candidate.
    pub(super) probability: f64,
    /// Its standard error from the number of simulated measurements.
    pub(super) standard_error: f64,
}

/// A candidate with one of its laws.
#[derive(Debug, Clone, Copy)]
pub(super) struct Member<'a> {
    /// Number of the candidate.
    pub(super) candidate: usize,
    /// Probability of the candidate with this law.
    pub(super) probability: f64,
    pub(super) prediction: &'a Prediction,
}

/// Standard normal numbers for the simulated measurements of each member.
pub(super) struct Normals {
    /// Quantities of one simulated measurement.
    width: usize,
    /// `[candidates][draws][width]`
    values: Vec<Vec<f64>>,
}

impl Normals {
    /// Numbers for measurements of at most `width` quantities.
    pub(super) fn new(candidates: usize, width: usize) -> Self {
        let own = |candidate: usize| {
            let mut stream = stats::stream(SEED, &format!("next measurement of candidate {candidate}"));
            (0..DRAWS * width).map(|_| stream.sample(StandardNormal)).collect()
        };
        Self { width, values: (0..candidates).map(own).collect() }
    }

    fn draw(&self, candidate: usize, draw: usize) -> &[f64] {
        &self.values[candidate][draw * self.width..(draw + 1) * self.width]
    }
}

/// A prediction for a number of repeats, with its covariance factored: S = L Lᵀ.
struct Factored<'a> {
    mean: &'a [f64],
    /// L, by columns, `[q][q]`.
    lower: Vec<f64>,
    half_log_det: f64,
}

impl<'a> Factored<'a> {
    fn new(prediction: &'a Prediction, repeats: usize) -> Option<Self> {
        let mut covariance = &prediction.lasting + &prediction.of_row / repeats as f64;
        for place in 0..covariance.nrows() {
            covariance[(place, place)] *= 1.0 + RIDGE;
        }
        let lower = covariance.cholesky()?.l();
        let half_log_det = lower.diagonal().iter().map(|l| l.ln()).sum();
        let lower = lower.as_slice().to_vec();
        Some(Self { mean: prediction.mean.as_slice(), lower, half_log_det })
    }

    /// Writes m + L z to `y`. Columns are added one after another, which the compiler turns into vector instructions.
    fn simulate(&self, z: &[f64], y: &mut [f64]) {
        let q = y.len();
        y.copy_from_slice(self.mean);
        for (column, z) in z.iter().enumerate() {
            let below = &self.lower[column * q + column..(column + 1) * q];
            y[column..].iter_mut().zip(below).for_each(|(y, l)| *y += l * z);
        }
    }

    /// ln N(y; m, S) without the factor of 2π; `left` is overwritten.
    fn log_density(&self, y: &[f64], left: &mut [f64]) -> f64 {
        let q = y.len();
        for (left, (y, mean)) in left.iter_mut().zip(y.iter().zip(self.mean)) {
            *left = y - mean;
        }
        let mut distance = 0.0;
        for column in 0..q {
            let own = &self.lower[column * q + column..(column + 1) * q];
            let white = left[column] / own[0];
            distance += white * white;
            left[column + 1..].iter_mut().zip(&own[1..]).for_each(|(left, l)| *left -= l * white);
        }
        -0.5 * distance - self.half_log_det
    }
}

/// The value of a measurement with `repeats` rows in each condition, from at most `draws` simulated measurements of each member; the
/// probabilities of the members sum to 1. `None` if a covariance is not positive definite.
pub(super) fn value(members: &[Member<'_>], repeats: usize, draws: usize, normals: &Normals) -> Option<Value> {
    let factored = members.iter().map(|m| Factored::new(m.prediction, repeats)).collect::<Option<Vec<_>>>()?;
    let q = members.first()?.prediction.mean.len();
    let (mut y, mut left) = (vec![0.0; q], vec![0.0; q]);
    let mut logs = vec![0.0; factored.len()];
    let (mut expected, mut variance) = (0.0, 0.0);
    for (truth, own) in factored.iter().enumerate() {
        let (mut sum, mut squares) = (0.0, 0.0);
        let draws = if members[truth].probability < SELDOM { FEWER_DRAWS.min(draws) } else { draws };
        for draw in 0..draws {
            own.simulate(&normals.draw(truth, draw)[..q], &mut y);
            for (log, (other, member)) in logs.iter_mut().zip(factored.iter().zip(members)) {
                *log = other.log_density(&y, &mut left) + member.probability.ln();
            }
            let largest = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let (mut total, mut of_truth) = (0.0, 0.0);
            for (log, member) in logs.iter().zip(members) {
                let weight = (log - largest).exp();
                total += weight;
                if member.candidate == members[truth].candidate {
                    of_truth += weight;
                }
            }
            let right = of_truth / total;
            sum += right;
            squares += right * right;
        }
        let (n, p) = (draws as f64, members[truth].probability);
        let mean = sum / n;
        expected += p * mean;
        variance += p * p * (squares / n - mean * mean).max(0.0) / (n - 1.0);
    }
    Some(Value { probability: expected, standard_error: variance.sqrt() })
}

/// The smallest number of repeats with which the value reaches [`WANTED`], by bisection between a number with which it does not and
/// one with which it does; `None` if it does not with the larger one. `value_with`: the value as a function of the number of
/// repeats.
pub(super) fn repeats_to_wanted(
    value_with: impl Fn(usize) -> Option<Value>,
    (mut too_few, mut sufficient): (usize, usize),
) -> Option<usize> {
    let enough = |repeats: usize| value_with(repeats).is_some_and(|v| v.probability >= WANTED);
    if !enough(sufficient) {
        return None;
    }
    while sufficient - too_few > 1 {
        let middle = usize::midpoint(too_few, sufficient);
        if enough(middle) {
            sufficient = middle;
        } else {
            too_few = middle;
        }
    }
    Some(sufficient)
}

#[cfg(test)]
mod tests {
    use nalgebra::{DMatrix, DVector};

    use super::*;

    fn normal(mean: f64, variance_of_row: f64) -> Prediction {
        Prediction {
            mean: DVector::from_element(1, mean),
            lasting: DMatrix::zeros(1, 1),
            of_row: DMatrix::from_element(1, 1, variance_of_row),
        }
    }

    fn members(predictions: [&Prediction; 2], probabilities: [f64; 2]) -> Vec<Member<'_>> {
        let member = |place: usize| Member {
            candidate: place,
            probability: probabilities[place],
            prediction: predictions[place],
        };
        vec![member(0), member(1)]
    }

    /// U of two normal densities with equal variances and probabilities, by the trapezoidal rule.
    fn by_quadrature(distance: f64) -> f64 {
        let density = |y: f64, mean: f64| (-0.5 * (y - mean).powi(2)).exp() / std::f64::consts::TAU.sqrt();
        let h = 1e-3;
        let at = |i: i32| {
            let y = f64::from(i) * h;
            let (a, b) = (density(y, 0.0), density(y, distance));
            if a + b > 0.0 {
                0.5 * (a * a + b * b) / (a + b) * h
            } else {
                0.0
            }
        };
        (-10_000..20_000).map(at).sum()
    }

    #[test]
    fn the_value_of_two_normal_predictions_equals_the_integral() {
        let normals = Normals::new(2, 3);
        for distance in [0.0, 0.5, 1.0, 2.0, 4.0] {
            let (a, b) = (normal(0.0, 1.0), normal(distance, 1.0));
            let found = value(&members([&a, &b], [0.5, 0.5]), 1, DRAWS, &normals).unwrap();
            let exact = by_quadrature(distance);
            // Four standard errors of the simulation; 1e-12 where all draws agree.
            let allowed = 4.0 * found.standard_error + 1e-12;
            assert!((found.probability - exact).abs() <= allowed, "{distance}: {found:?}, exactly {exact}");
        }
    }

    #[test]
    fn n_repeats_have_the_value_of_a_distance_larger_by_the_root_of_n_and_equal_predictions_have_none() {
        let normals = Normals::new(2, 1);
        let (a, near, far) = (normal(0.0, 1.0), normal(1.0, 1.0), normal(3.0, 1.0));
        let repeated = value(&members([&a, &near], [0.3, 0.7]), 9, DRAWS, &normals).unwrap();
        let distant = value(&members([&a, &far], [0.3, 0.7]), 1, DRAWS, &normals).unwrap();
        assert!((repeated.probability - distant.probability).abs() < 1e-9, "{repeated:?} {distant:?}");
        // Without information the expected probability is Σ p².
        let none = value(&members([&a, &a], [0.3, 0.7]), 5, DRAWS, &normals).unwrap();
        assert!((none.probability - 0.58).abs() < 1e-12 && none.standard_error < 1e-9, "{none:?}");
    }

    #[test]
    fn two_laws_of_one_candidate_need_not_be_told_apart() {
        let normals = Normals::new(3, 1);
        let (a, b, c) = (normal(0.0, 1.0), normal(0.0, 1.0), normal(1.0, 1.0));
        let of = |candidates: [usize; 3]| {
            let one = |(place, prediction)| Member {
                candidate: candidates[place],
                probability: [0.25, 0.25, 0.5][place],
                prediction,
            };
            let members: Vec<Member<'_>> = [&a, &b, &c].into_iter().enumerate().map(one).collect();
            value(&members, 4, DRAWS, &normals).unwrap().probability
        };
        let one = value(&members([&a, &c], [0.5, 0.5]), 4, DRAWS, &Normals::new(2, 1)).unwrap();
        // The laws are the same, so that their candidate is as probable as with one law. Four standard errors.
        assert!((of([0, 0, 1]) - one.probability).abs() < 4.0 * one.standard_error, "{one:?}");
        assert!(of([0, 1, 2]) < of([0, 0, 1]) - 0.1);
    }

    #[test]
    fn the_number_of_repeats_is_the_smallest_that_suffices() {
        let normals = Normals::new(2, 1);
        let (a, b) = (normal(0.0, 1.0), normal(1.0, 1.0));
        let with = |repeats: usize| value(&members([&a, &b], [0.5, 0.5]), repeats, DRAWS, &normals);
        let repeats = repeats_to_wanted(with, (0, MOST_REPEATS)).unwrap();
        assert!(with(repeats).unwrap().probability >= WANTED && with(repeats - 1).unwrap().probability < WANTED);
        let never = |_| value(&members([&a, &a], [0.5, 0.5]), 1, DRAWS, &normals);
        assert_eq!(repeats_to_wanted(never, (0, MOST_REPEATS)), None);
    }
}
