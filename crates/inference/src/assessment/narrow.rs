//! The population of a batch whose single measurements say far less than all of them together, where it is narrow against the curvature of
//! the simulation.

use nalgebra::{DMatrix, DVector};

use super::batch_mean::{Healthy, Problem};
use crate::baseline::observation::Observation;
use crate::baseline::Baseline;
use crate::hierarchy::{LinearBatch, LinearMeasurements, Populations, Spread};

/// A measurement is vague if its standard deviation of some parameter exceeds this multiple of the spread of the healthy structure, or this
/// share of the standard deviation of the prior. Samples of vague measurements hardly show where a narrow population lies.
const VAGUE_BESIDE_SPREAD: f64 = 0.5;
const VAGUE_BESIDE_PRIOR: f64 = 0.1;

/// A population is narrow if the simulation, two of its standard deviations away from its mean in any principal direction, differs from the
/// linearised one by less than this share of the standard deviation of a measured frequency, from noise and spread. What the curvature adds to
/// a mean frequency, a quarter of the difference, is taken into account.
const CURVATURE: f64 = 0.2;

/// The structure that a batch is compared with.
pub(super) struct Usual {
    pub healthy: Healthy,
    /// Number of measurements that the knowledge of its spread is worth.
    pub worth: f64,
}

/// The population behind some measurements, at least two, if one of them is vague and the population is narrow; `None` otherwise. Without a
/// `usual` structure the spread is unknown, and that of the batch itself tells whether it is narrow.
pub(super) fn population(
    baseline: &Baseline,
    observations: &[Observation],
    usual: Option<&Usual>,
    seed: u64,
) -> Option<Populations> {
    let own;
    let healthy = if let Some(usual) = usual {
        &usual.healthy
    } else {
        own = Healthy::of_batches(baseline, &[observations])?;
        &own
    };
    let problem = Problem::new(baseline, observations, healthy)?;
    let about = problem.solved()?.at;
    let curved_hz = curvature_hz(&problem, &about)?;
    let alike = linearised(&problem, &about, &curved_hz)?;
    let alike: Vec<LinearMeasurements> = alike.into_iter().map(|(_, alike)| alike).collect();
    if !alike.iter().any(|alike| is_vague(&problem, &alike.information)) {
        return None;
    }
    let spread = usual
        .map_or(Spread::Unknown, |usual| Spread::Usual { covariance: problem.scatter.clone(), degrees: usual.worth });
    let prior_mean = &problem.centre - &about;
    let batch = LinearBatch { alike, about, prior_mean, prior_precision: problem.prior.clone(), spread };
    batch.populations(baseline.space(), seed)
}

/// The measurements with their places in the batch, linearised about a point of the unit box; `None` where the simulation fails.
/// `curved_hz`: what the curvature adds to each mean frequency, `[modes]`.
pub(super) fn linearised(
    problem: &Problem<'_>,
    about: &DVector<f64>,
    curved_hz: &[f64],
) -> Option<Vec<(Vec<usize>, LinearMeasurements)>> {
    let mut all = Vec::new();
    for effects in &problem.alike {
        let simulated = problem.slopes(effects, about)?;
        for own in &effects.groups {
            let first = own[0].1;
            let present = (0..simulated.frequencies_hz.len()).filter(|mode| first.frequencies_hz[*mode].is_some());
            let present: Vec<usize> = present.collect();
            let std_hz = |mode: &usize| {
                effects.simulator.std_hz(*mode, simulated.frequencies_hz[*mode]) * first.noise_multiple[*mode]
            };
            let stds_hz: Vec<f64> = present.iter().map(std_hz).collect();
            let mut slopes = simulated.slopes.select_rows(&present);
            slopes.row_iter_mut().zip(&stds_hz).for_each(|(mut row, std_hz)| row /= *std_hz);
            let residual = |row: usize, column: usize| {
                let mode = present[row];
                let expected_hz = simulated.frequencies_hz[mode] + curved_hz[mode];
                own[column].1.frequencies_hz[mode].map_or(0.0, |f| (f - expected_hz) / stds_hz[row])
            };
            let residuals = DMatrix::from_fn(present.len(), own.len(), residual);
            let information = slopes.tr_mul(&slopes);
            let places = own.iter().map(|(place, _)| *place).collect();
            all.push((places, LinearMeasurements { information, gradients: slopes.tr_mul(&residuals) }));
        }
    }
    Some(all)
}

/// Whether a measurement with this information on the parameters is vague.
fn is_vague(problem: &Problem<'_>, information: &DMatrix<f64>) -> bool {
    let Some(factor) = (information + DMatrix::from_diagonal(&problem.prior)).cholesky() else { return false };
    let variances = factor.inverse().diagonal();
    variances.iter().enumerate().any(|(k, variance)| {
        let spread = VAGUE_BESIDE_SPREAD * problem.scatter[(k, k)].sqrt();
        let prior = VAGUE_BESIDE_PRIOR * problem.prior[k].powf(-0.5);
        variance.sqrt() > if spread > 0.0 { spread.min(prior) } else { prior }
    })
}

/// What the curvature of the simulation adds to the mean of each frequency over the population, Hz, `[modes]`; `None` where the population is
/// not narrow, and where the simulation fails.
///
/// ```text
///  E f(x) − f(m) ≈ ½ Σ_j s_j² ∂²f/∂v_j² ≈ Σ_j ¼ (f(m + 2 s_j v_j) − f(m) − J 2 s_j v_j),    S = Σ_j s_j² v_j v_jᵀ
/// ```
fn curvature_hz(problem: &Problem<'_>, about: &DVector<f64>) -> Option<Vec<f64>> {
    let effects = problem.alike.first()?;
    let simulated = problem.slopes(effects, about)?;
    let spreads = &simulated.slopes * &problem.scatter * simulated.slopes.transpose();
    let principal = problem.scatter.clone().symmetric_eigen();
    let mut curved_hz = vec![0.0; simulated.frequencies_hz.len()];
    for (variance, direction) in principal.eigenvalues.iter().zip(principal.eigenvectors.column_iter()) {
        let off = direction * (2.0 * variance.max(0.0).sqrt());
        let inside = (about + &off).iter().all(|u| (0.0..=1.0).contains(u));
        let off = if inside { off } else { -off };
        let beyond = problem.slopes(effects, &(about + &off).map(|u| u.clamp(0.0, 1.0)))?;
        let linear = &simulated.slopes * &off;
        for (mode, frequency_hz) in simulated.frequencies_hz.iter().enumerate() {
            let bent_hz = beyond.frequencies_hz[mode] - frequency_hz - linear[mode];
            let noise_hz = effects.simulator.std_hz(mode, *frequency_hz);
            if bent_hz.abs() > CURVATURE * (spreads[(mode, mode)] + noise_hz.powi(2)).sqrt() {
                return None;
            }
            curved_hz[mode] += 0.25 * bent_hz;
        }
    }
    Some(curved_hz)
}
