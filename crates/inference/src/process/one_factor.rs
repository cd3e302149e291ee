//! All frequencies off by one factor: an instrument whose clock or calibration is wrong, or stiffnesses or masses that change alike.
//!
//! The simulation turns such a factor into changes of the quantities, the same ones each time it occurs. That it explains a change is
//! therefore a hypothesis with one unknown, alone or with one quantity that has changed as well, beside those of [`parts`](super::parts):
//!
//! ```text
//!  δ = δ(a) + ε,    a = ln factor ~ N(0, 0.01²),    ε ~ N(0, E),  E = diag(w_k² for a quantity that has changed, e_k² for the others)
//!  p(a | b, I) ∝ p(a) det(E A)^(−1/2) exp(bᵀδ(a) − ½ δ(a)ᵀ I δ(a) + ½ b̃ᵀA⁻¹b̃),    b̃ = b − I δ(a),    A = I + E⁻¹
//! ```
//!
//! b, I: score and information of a step, see [`Score`]; w_k, e_k: as in [`parts`](super::parts).

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

use super::score::Score;

/// Standard deviation of ln factor before batches are looked at.
const USUAL: f64 = 0.01;

/// Steps of the search for the most probable factor, how often one that leads downhill is halved, and the difference of ln factor by which
/// slopes are taken.
const STEPS: usize = 30;
const HALVINGS: usize = 20;
const DIFFERENCE: f64 = 1e-5;

/// What one factor of all frequencies does to the estimates of the quantities.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct FactorPoint {
    /// a, not 0.
    pub ln_factor: f64,
    /// Change of each quantity, in its unit or standardised, `[d]`.
    pub changes: Vec<f64>,
}

/// What the hypothesis that all frequencies are off by one factor says of a change.
pub(super) struct OneFactor {
    /// Mean and variance of a.
    pub ln_factor: [f64; 2],
    /// Logarithm of the evidence.
    pub log_evidence: f64,
    /// Mean of the change of all quantities, standardised, `[d]`.
    pub change: DVector<f64>,
    /// Mean and variances of what is beside the factor, ε, `[d]`.
    pub mean: DVector<f64>,
    pub variance: DVector<f64>,
}

/// δ(a) between some points, in ascending order: δ(a)/a is the parabola through the three nearest.
fn changes(points: &[FactorPoint], ln_factor: f64) -> Option<DVector<f64>> {
    let [first, _, .., last] = points else { return None };
    if !(first.ln_factor..=last.ln_factor).contains(&ln_factor) {
        return None;
    }
    let above = points.iter().position(|point| point.ln_factor >= ln_factor)?;
    let begin = above.saturating_sub(1).min(points.len() - 3);
    let near = &points[begin..begin + 3];
    let weight = |i: usize| -> f64 {
        let others = (0..3).filter(|j| *j != i).map(|j| near[j].ln_factor);
        others.map(|other| (ln_factor - other) / (near[i].ln_factor - other)).product()
    };
    let weights = [0, 1, 2].map(weight);
    Some(DVector::from_fn(first.changes.len(), |k, _| {
        near.iter().zip(weights).map(|(point, weight)| weight * point.changes[k] * ln_factor / point.ln_factor).sum()
    }))
}

/// The hypothesis that all frequencies are off by one factor, with changes of variances E, `[d]`. `points`: standardised, in ascending order. `None` where nothing is known of such a factor.
pub(super) fn hypothesis(points: &[FactorPoint], score: &Score, variances: &DVector<f64>) -> Option<OneFactor> {
    score.elapsed?;
    let (given, information) = score.of_step();
    let factored = (&information + DMatrix::from_diagonal(&variances.map(f64::recip))).cholesky()?;
    let left = |changes: &DVector<f64>| &given - &information * changes;
    let log_density = |ln_factor: f64| {
        let Some(changes) = changes(points, ln_factor) else { return f64::NEG_INFINITY };
        let left = left(&changes);
        let explained = 0.5 * (given.dot(&changes) + left.dot(&changes) + left.dot(&factored.solve(&left)));
        explained - 0.5 * (ln_factor / USUAL).powi(2)
    };
    // Slope of δ(a), slope of the log density, and its curvature where δ(a) is taken for linear.
    let slopes = |at: f64| {
        let beyond = changes(points, at + DIFFERENCE).map(|changes| (changes, DIFFERENCE));
        let beyond = beyond.or_else(|| Some((changes(points, at - DIFFERENCE)?, -DIFFERENCE)))?;
        let here = changes(points, at)?;
        let along = (beyond.0 - &here) / beyond.1;
        let left = left(&here);
        let slope = along.dot(&(&left - &information * factored.solve(&left))) - at / USUAL.powi(2);
        let informs = &information * &along;
        let curvature = along.dot(&(&informs - &information * factored.solve(&informs))) + USUAL.powi(-2);
        Some((along, slope, curvature))
    };
    let mut at = points.iter().map(|p| p.ln_factor).max_by(|a, b| log_density(*a).total_cmp(&log_density(*b)))?;
    for _ in 0..STEPS {
        let (_, slope, curvature) = slopes(at)?;
        let higher = |halvings: usize| {
            let next = at + slope / curvature * 0.5_f64.powi(halvings as i32);
            (log_density(next) > log_density(at)).then_some(next)
        };
        let Some(next) = (0..HALVINGS).find_map(higher) else { break };
        at = next;
    }
    let (along, _, curvature) = slopes(at)?;
    let log_det: f64 = factored.l_dirty().diagonal().iter().map(|l| 2.0 * l.ln()).sum();
    let log_evidence = log_density(at) - 0.5 * (log_det + variances.iter().map(|e| e.ln()).sum::<f64>());
    // By Laplace's method; the constant of the prior and that of the integral cancel but for their standard deviations.
    let log_evidence = log_evidence - USUAL.ln() - 0.5 * curvature.ln();
    // The changes beside those of the factor, and how they follow it.
    let here = changes(points, at)?;
    let mean = factored.solve(&left(&here));
    let follows = factored.solve(&(&information * along));
    let variance = factored.inverse().diagonal() + follows.component_mul(&follows) / curvature;
    Some(OneFactor { ln_factor: [at, 1.0 / curvature], log_evidence, change: here + &mean, mean, variance })
}
