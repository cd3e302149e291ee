//! Posterior density of the unknowns of a process, with its gradient.

use nalgebra::{DMatrix, DVector};

use super::estimate::Observation;
use super::filter::Filter;
use super::model::{Numbers, Sizes};
use super::smoother::{log_likelihood, smooth, Smoothed};

/// Normal priors in standardised units, mean and standard deviation. They are weak: the standard deviation of the reference is 1.
const MEAN: [f64; 2] = [0.0, 3.0];
const SLOPE: [f64; 2] = [0.0, 1.0];
const LOADING: [f64; 2] = [0.0, 2.0];
/// Factors last for some steps of a day: φ = 0.88, between 0.28 and 0.993 with 95 % probability.
const LOGIT_OF_FACTOR: [f64; 2] = [2.0, 1.5];
/// What each parameter does by itself may be white or last.
const LOGIT_OF_QUANTITY: [f64; 2] = [0.0, 1.5];
/// ln s: 0.3 of the scatter, within a factor of 20.
const LN_STD: [f64; 2] = [-1.2, 1.5];
/// ln κ: noise as stated, within a factor of 4 of its variance.
const LN_NOISE: [f64; 2] = [0.0, 0.7];

/// Prior mean and standard deviation of each unknown.
///
/// What lasts for a time τ has the logit ln(τ/Δ) for steps Δ that are short against it. The priors are those of steps of a day; for other
/// steps they allow for causes that last as many steps as those, and for causes that last as many days.
pub(super) fn priors(sizes: Sizes) -> Vec<[f64; 2]> {
    let Sizes { quantities: d, covariates: m, factors: q, log_steps_per_day } = sizes;
    let lasting = |[mean, std]: [f64; 2]| [mean + 0.5 * log_steps_per_day, std.hypot(0.5 * log_steps_per_day)];
    let kinds = [
        (MEAN, d),
        (SLOPE, d * m),
        (LOADING, d * q),
        (lasting(LOGIT_OF_FACTOR), q),
        (lasting(LOGIT_OF_QUANTITY), d),
        (LN_STD, d),
        (LN_NOISE, 1),
    ];
    kinds.into_iter().flat_map(|(prior, count)| std::iter::repeat_n(prior, count)).collect()
}

/// ln of the posterior density of the unknowns, without the evidence, and its gradient; `None` where it cannot be computed.
///
/// The gradient of the likelihood is the mean, over the smoothed states, of the gradient of the joint density of states and
/// observations (Fisher's identity), which needs one pass of the smoother for all unknowns together.
///
/// Source: D. Koopman, N. Shephard (1992), Exact score for time series models in state space form, Biometrika 79, 823–826.
pub(super) fn log_posterior(unknowns: &[f64], sizes: Sizes, observations: &[Observation]) -> Option<(f64, Vec<f64>)> {
    let filter = Filter::exact(Numbers::of(unknowns, sizes));
    let smoothed = smooth(&filter, observations)?;
    let mut gradient = vec![0.0; sizes.unknowns()];
    of_observations(&mut gradient, &filter, sizes, observations, &smoothed)?;
    of_states(&mut gradient, filter.numbers(), sizes, observations, &smoothed);
    let mut total = smoothed.log_likelihood;
    for ((value, [mean, std]), slope) in unknowns.iter().zip(priors(sizes)).zip(&mut gradient) {
        let z = (value - mean) / std;
        total -= 0.5 * z * z + (std * std::f64::consts::TAU.sqrt()).ln();
        *slope -= z / std;
    }
    (total.is_finite() && gradient.iter().all(|g| g.is_finite())).then_some((total, gradient))
}

/// The density of [`log_posterior`] without its gradient, for which the filter is enough.
pub(super) fn log_density(unknowns: &[f64], sizes: Sizes, observations: &[Observation]) -> Option<f64> {
    let mut total = log_likelihood(&Filter::exact(Numbers::of(unknowns, sizes)), observations)?;
    for (value, [mean, std]) in unknowns.iter().zip(priors(sizes)) {
        let z = (value - mean) / std;
        total -= 0.5 * z * z + (std * std::f64::consts::TAU.sqrt()).ln();
    }
    total.is_finite().then_some(total)
}

/// Adds the derivatives of E ln N(x̂_t; μ + B c + H s_t, κ V_t) by μ, B, Λ and ln κ.
///
/// ```text
///  ∂μ = W E r,    ∂B = W E[r] cᵀ,    ∂Λ = W E[r hᵀ],    ∂ ln κ = ½ (tr W E[r rᵀ] − o),    W = (κ V)⁻¹,    r = x̂ − μ − B c − H s
/// ```
fn of_observations(
    gradient: &mut [f64],
    filter: &Filter,
    sizes: Sizes,
    observations: &[Observation],
    smoothed: &Smoothed,
) -> Option<()> {
    let (numbers, d, q) = (filter.numbers(), sizes.quantities, sizes.factors);
    let (loading, noise) = (sizes.first_loading(), sizes.unknowns() - 1);
    for (observation, state) in observations.iter().zip(&smoothed.states) {
        let informed = &observation.informed;
        let h = filter.contributions().select_rows(informed);
        let all = &numbers.mean + &numbers.slopes * &observation.covariates;
        let left = &observation.mean - all.select_rows(informed) - &h * &state.mean;
        let cross = &h * &state.covariance;
        let precision = (numbers.noise * &observation.covariance).cholesky()?.inverse();
        let weighted = &precision * &left;
        for (place, k) in informed.iter().enumerate() {
            gradient[*k] += weighted[place];
            for (j, c) in observation.covariates.iter().enumerate() {
                gradient[sizes.slope(*k, j)] += weighted[place] * c;
            }
        }
        // E[r hᵀ] = E r E hᵀ − H Cov(s, h).
        let with_factors = &precision * cross.columns(0, q);
        for j in 0..q {
            for (place, k) in informed.iter().enumerate() {
                gradient[loading + j * d + k] += weighted[place] * state.mean[j] - with_factors[(place, j)];
            }
        }
        let spread = (&precision * (&cross * h.transpose())).trace();
        gradient[noise] += 0.5 * (left.dot(&weighted) + spread - informed.len() as f64);
    }
    Some(())
}

/// Adds the derivatives of E ln p(s_t | s_t−1) by the logits of the persistences and ln s.
///
/// ```text
///  ln p = −½ ln Q − (s_t − g s_t−1)²/(2Q),    g = f^Δ,    Q = S (1 − g²)
/// ```
fn of_states(gradient: &mut [f64], numbers: &Numbers, sizes: Sizes, observations: &[Observation], smoothed: &Smoothed) {
    let (first, n, q) = (sizes.first_logit(), sizes.states(), sizes.factors);
    for i in 0..n {
        let (f, s) = (numbers.persistence[i], numbers.variance[i]);
        let square = |t: usize| smoothed.states[t].mean[i].powi(2) + smoothed.states[t].covariance[(i, i)];
        let (mut by_logit, mut by_ln_variance) = (0.0, -0.5 + square(0) / (2.0 * s));
        for (t, observation) in observations.iter().enumerate().skip(1) {
            let g = f.powf(observation.steps);
            let variance = s * (1.0 - g * g);
            // Two batches at the same time have the same state.
            if variance <= 1e-12 * s {
                continue;
            }
            let (before, now) = (&smoothed.states[t - 1], &smoothed.states[t]);
            let product = now.mean[i] * before.mean[i] + smoothed.with_before[t - 1][(i, i)];
            let jump = square(t) - 2.0 * g * product + g * g * square(t - 1);
            let by_decay =
                g * s / variance + (product - g * square(t - 1)) / variance - jump * g * s / variance.powi(2);
            by_logit += by_decay * observation.steps * g * (1.0 - f);
            by_ln_variance += -0.5 + jump / (2.0 * variance);
        }
        gradient[first + i] += by_logit;
        if i >= q {
            gradient[first + n + i - q] += 2.0 * by_ln_variance;
        }
    }
}

/// Observed information: minus the derivatives of the gradient, by central differences.
pub(super) fn information(unknowns: &[f64], sizes: Sizes, observations: &[Observation]) -> Option<DMatrix<f64>> {
    const STEP: f64 = 1e-4;
    let p = unknowns.len();
    let mut found = DMatrix::zeros(p, p);
    for place in 0..p {
        let at = |step: f64| {
            let mut moved = unknowns.to_vec();
            moved[place] += step;
            log_posterior(&moved, sizes, observations).map(|(_, gradient)| DVector::from_vec(gradient))
        };
        found.set_column(place, &((at(-STEP)? - at(STEP)?) / (2.0 * STEP)));
    }
    Some((&found + found.transpose()) * 0.5)
}
