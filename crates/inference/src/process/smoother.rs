//! Smoothed states of a process: what all observations together say about each time.

use nalgebra::DMatrix;

use super::estimate::Observation;
use super::filter::{Filter, Innovation, Known};

/// Smoothed states.
pub(super) struct Smoothed {
    /// Log-likelihood of the observations, nats.
    pub(super) log_likelihood: f64,
    /// Mean and covariance of the states at each time.
    pub(super) states: Vec<Known>,
    /// Covariance of the states at each time but the first with those before, `[q + d, q + d]`.
    pub(super) with_before: Vec<DMatrix<f64>>,
}

/// Log-likelihood of the observations, nats; `None` if a covariance is not positive definite.
pub(super) fn log_likelihood(filter: &Filter, observations: &[Observation]) -> Option<f64> {
    let (mut known, mut total) = (filter.start(), 0.0);
    for observation in observations {
        let (before, decay) = filter.predict(&known, observation);
        let (after, innovation) = filter.update((&before, decay), observation)?;
        total += density_of(&innovation);
        known = after;
    }
    Some(total)
}

/// ln of the normal density of an innovation, nats.
fn density_of(innovation: &Innovation) -> f64 {
    let distance = innovation.difference.dot(&(&innovation.precision * &innovation.difference));
    let constant = innovation.informed.len() as f64 * std::f64::consts::TAU.ln();
    -0.5 * (distance + innovation.log_det + constant)
}

/// Smooths the states by the recursion of Rauch, Tung and Striebel. `None` if a covariance is not positive definite.
///
/// ```text
///  J_t = P_t F P_t+1|t⁻¹,    a_t ← a_t + J_t (a_t+1 − a_t+1|t),    P_t ← P_t + J_t (P_t+1 − P_t+1|t) J_tᵀ
///  Cov(s_t+1, s_t) = P_t+1 J_tᵀ
/// ```
///
/// Source: H. E. Rauch, F. Tung, C. T. Striebel (1965), Maximum likelihood estimates of linear dynamic systems, AIAA Journal 3,
/// 1445–1450.
pub(super) fn smooth(filter: &Filter, observations: &[Observation]) -> Option<Smoothed> {
    let (mut predicted, mut states) = (Vec::new(), Vec::new());
    let mut log_likelihood = 0.0;
    let mut known = filter.start();
    for observation in observations {
        let (before, decay) = filter.predict(&known, observation);
        let (after, innovation) = filter.update((&before, decay.clone()), observation)?;
        log_likelihood += density_of(&innovation);
        predicted.push((before, decay));
        known = after.clone();
        states.push(after);
    }
    let mut with_before = vec![DMatrix::zeros(0, 0); states.len().saturating_sub(1)];
    for t in (0..states.len().saturating_sub(1)).rev() {
        let (before, decay) = &predicted[t + 1];
        let mut cross = states[t].covariance.clone();
        for (mut column, decay) in cross.column_iter_mut().zip(decay.iter()) {
            column *= *decay;
        }
        let back = before.covariance.clone().cholesky()?.solve(&cross.transpose()).transpose();
        let (mean, covariance) = {
            let later = &states[t + 1];
            (&back * (&later.mean - &before.mean), &back * (&later.covariance - &before.covariance) * back.transpose())
        };
        with_before[t] = &states[t + 1].covariance * back.transpose();
        states[t].mean += mean;
        states[t].covariance += covariance;
    }
    Some(Smoothed { log_likelihood, states, with_before })
}
