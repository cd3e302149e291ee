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

use super::predict::Prediction;
use super::simulated::{Factored, Normals, LANES};

/// Simulated measurements of a probable candidate in blocks of [`LANES`]: for the value that is reported, for the number of repeats
/// that suffices, and for a first comparison or a candidate with a probability below [`SELDOM`], which contributes little.
pub(super) const BLOCKS: usize = 4;
pub(super) const SOME_BLOCKS: usize = 2;
pub(super) const FEWER_BLOCKS: usize = 1;
const SELDOM: f64 = 0.1;

/// Densities below exp(−40) of the largest are counted as zero.
const NEGLIGIBLE_NATS: f64 = 40.0;

/// Expected probability that a further measurement should reach.
pub(super) const WANTED: f64 = 0.95;

/// Numbers of repeats that are considered.
const REPEATS_CONSIDERED: [usize; 13] = [1, 2, 3, 5, 7, 10, 15, 20, 30, 40, 60, 80, 100];

/// Greatest number of repeats that is considered.
pub(super) const MOST_REPEATS: usize = REPEATS_CONSIDERED[REPEATS_CONSIDERED.len() - 1];

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

/// The value of a measurement with `repeats` rows in each condition, from at most `blocks` blocks of simulated measurements of each
/// member; the probabilities of the members sum to 1. `None` if a covariance is not positive definite.
pub(super) fn value(members: &[Member<'_>], repeats: usize, blocks: usize, normals: &Normals) -> Option<Value> {
    let factored = members.iter().map(|m| Factored::new(m.prediction, repeats)).collect::<Option<Vec<_>>>()?;
    let log_probabilities: Vec<f64> = members.iter().map(|m| m.probability.ln()).collect();
    let q = members.first()?.prediction.mean.len();
    let (mut y, mut left) = (vec![[0.0; LANES]; q], vec![[0.0; LANES]; q]);
    let mut logs = vec![[0.0; LANES]; members.len()];
    let (mut expected, mut variance) = (0.0, 0.0);
    for (truth, own) in factored.iter().enumerate() {
        let (mut sum, mut squares) = (0.0, 0.0);
        let blocks = if members[truth].probability < SELDOM { FEWER_BLOCKS.min(blocks) } else { blocks };
        for block in 0..blocks {
            own.simulate(normals.block(truth, block, q), &mut y);
            for ((logs, other), log_probability) in logs.iter_mut().zip(&factored).zip(&log_probabilities) {
                *logs = other.log_densities(&y, &mut left).map(|log| log + log_probability);
            }
            let lanes = 0..LANES;
            for right in lanes.map(|lane| share_of(members[truth].candidate, members, |member| logs[member][lane])) {
                sum += right;
                squares += right * right;
            }
        }
        let (n, p) = ((blocks * LANES) as f64, members[truth].probability);
        let mean = sum / n;
        expected += p * mean;
        variance += p * p * (squares / n - mean * mean).max(0.0) / (n - 1.0);
    }
    Some(Value { probability: expected, standard_error: variance.sqrt() })
}

/// Probability of a candidate, given the logarithms of the probability of each member to some factor.
fn share_of(candidate: usize, members: &[Member<'_>], log: impl Fn(usize) -> f64) -> f64 {
    let largest = (0..members.len()).map(&log).fold(f64::NEG_INFINITY, f64::max);
    let (mut total, mut of_candidate) = (0.0, 0.0);
    for (place, member) in members.iter().enumerate() {
        let nats = log(place) - largest;
        if nats > -NEGLIGIBLE_NATS {
            let weight = nats.exp();
            total += weight;
            if member.candidate == candidate {
                of_candidate += weight;
            }
        }
    }
    of_candidate / total
}

/// The smallest number of repeats, of those considered, with which the value reaches [`WANTED`], by bisection between a number with
/// which it does not, or 0, and one with which it does; `None` if it does not with the larger one. `value_with`: the value as a
/// function of the number of repeats.
pub(super) fn repeats_to_wanted(
    value_with: impl Fn(usize) -> Option<Value>,
    (too_few, sufficient): (usize, usize),
) -> Option<usize> {
    let enough = |repeats: usize| value_with(repeats).is_some_and(|v| v.probability >= WANTED);
    if !enough(sufficient) {
        return None;
    }
    let first = REPEATS_CONSIDERED.partition_point(|repeats| *repeats <= too_few);
    let last = REPEATS_CONSIDERED.partition_point(|repeats| *repeats < sufficient);
    let between = &REPEATS_CONSIDERED[first..last];
    let place = between.partition_point(|repeats| !enough(*repeats));
    Some(between.get(place).copied().unwrap_or(sufficient))
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
        let normals = Normals::new(2, BLOCKS, 3);
        for distance in [0.0, 0.5, 1.0, 2.0, 4.0] {
            let (a, b) = (normal(0.0, 1.0), normal(distance, 1.0));
            let found = value(&members([&a, &b], [0.5, 0.5]), 1, BLOCKS, &normals).unwrap();
            let exact = by_quadrature(distance);
            // Four standard errors of the simulation; 1e-12 where all draws agree.
            let allowed = 4.0 * found.standard_error + 1e-12;
            assert!((found.probability - exact).abs() <= allowed, "{distance}: {found:?}, exactly {exact}");
        }
    }

    #[test]
    fn n_repeats_have_the_value_of_a_distance_larger_by_the_root_of_n_and_equal_predictions_have_none() {
        let normals = Normals::new(2, BLOCKS, 1);
        let (a, near, far) = (normal(0.0, 1.0), normal(1.0, 1.0), normal(3.0, 1.0));
        let repeated = value(&members([&a, &near], [0.3, 0.7]), 9, BLOCKS, &normals).unwrap();
        let distant = value(&members([&a, &far], [0.3, 0.7]), 1, BLOCKS, &normals).unwrap();
        assert!((repeated.probability - distant.probability).abs() < 1e-9, "{repeated:?} {distant:?}");
        // Without information the expected probability is Σ p².
        let none = value(&members([&a, &a], [0.3, 0.7]), 5, BLOCKS, &normals).unwrap();
        assert!((none.probability - 0.58).abs() < 1e-12 && none.standard_error < 1e-9, "{none:?}");
    }

    #[test]
    fn two_laws_of_one_candidate_need_not_be_told_apart() {
        let normals = Normals::new(3, BLOCKS, 1);
        let (a, b, c) = (normal(0.0, 1.0), normal(0.0, 1.0), normal(1.0, 1.0));
        let of = |candidates: [usize; 3]| {
            let one = |(place, prediction)| Member {
                candidate: candidates[place],
                probability: [0.25, 0.25, 0.5][place],
                prediction,
            };
            let members: Vec<Member<'_>> = [&a, &b, &c].into_iter().enumerate().map(one).collect();
            value(&members, 4, BLOCKS, &normals).unwrap().probability
        };
        let one = value(&members([&a, &c], [0.5, 0.5]), 4, BLOCKS, &Normals::new(2, BLOCKS, 1)).unwrap();
        // The laws are the same, so that their candidate is as probable as with one law. Four standard errors.
        assert!((of([0, 0, 1]) - one.probability).abs() < 4.0 * one.standard_error, "{one:?}");
        assert!(of([0, 1, 2]) < of([0, 0, 1]) - 0.1);
    }

    #[test]
    fn the_number_of_repeats_is_the_smallest_that_suffices() {
        let normals = Normals::new(2, BLOCKS, 1);
        let (a, b) = (normal(0.0, 1.0), normal(1.0, 1.0));
        let with = |repeats: usize| value(&members([&a, &b], [0.5, 0.5]), repeats, BLOCKS, &normals);
        let repeats = repeats_to_wanted(with, (0, MOST_REPEATS)).unwrap();
        let fewer = *REPEATS_CONSIDERED.iter().rfind(|considered| **considered < repeats).unwrap();
        assert!(with(repeats).unwrap().probability >= WANTED && with(fewer).unwrap().probability < WANTED);
        let never = |_| value(&members([&a, &a], [0.5, 0.5]), 1, BLOCKS, &normals);
        assert_eq!(repeats_to_wanted(never, (0, MOST_REPEATS)), None);
    }
}
