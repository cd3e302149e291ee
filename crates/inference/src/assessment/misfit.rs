//! The misfit of a structure: what its frequencies show that no parameters of the simulation give.
//!
//! What is the same in all batches of a reference is taken out of the measurements. What moves about it enters the process behind the
//! reference, by its coordinates.

use nalgebra::DMatrix;
use statrs::distribution::{ChiSquared, ContinuousCDF as _};

use super::batch_mean::{Coordinates, Healthy, Problem};
use crate::baseline::observation::Observation;
use crate::baseline::Baseline;
use crate::process::misfit::MisfitBasis;
use crate::process::reference::ReferenceProcess;
use crate::trust::fit::{Fit, LEVEL};

/// Most coordinates: the time of a reference grows with the third power of the number of all quantities.
const MOST: usize = 4;

/// A combination of parameters that, within the prior, moves the frequencies by less than this, in standard deviations of their noise, is none.
const LEAST_EFFECT: f64 = 1.0;

/// The coordinates of the misfit about a healthy structure; `None` if the modes determine nothing beside the parameters, or where the slopes of
/// the simulation are not computed. `like`: a measurement with the usual effects, modes and noise.
///
/// ```text
///  R^(−½) F⁻¹ J D = U S Wᵀ,    B = F⁻¹ R^½ N,    N: the columns of U beside those with S > 1
/// ```
///
/// J: derivatives of the frequencies by the parameters; D: standard deviations of the prior; R: variances of the noise; F = diag(f). Of more
/// than four coordinates those are taken in which equal relative changes of the frequencies stand out most: the eigenvectors of
/// Nᵀ R⁻¹ F² N with the largest eigenvalues.
pub(super) fn coordinates(baseline: &Baseline, like: &Observation, healthy: &Healthy) -> Option<MisfitBasis> {
    let mut complete = like.clone();
    let usual_hz = like.simulator(baseline.simulator()).frequencies_hz(&healthy.centre).ok()?;
    for (own, usual_hz) in complete.frequencies_hz.iter_mut().zip(&usual_hz) {
        own.get_or_insert(*usual_hz);
    }
    let problem = Problem::new(baseline, std::slice::from_ref(&complete), healthy)?;
    let alike = problem.alike.first()?;
    let slopes = problem.slopes(alike, &problem.centre)?;
    let modes = slopes.frequencies_hz.len();
    let relative_noise = |mode: usize| {
        let hz = slopes.frequencies_hz[mode];
        alike.simulator.std_hz(mode, hz) * complete.noise_multiple[mode] / hz
    };
    let noise: Vec<f64> = (0..modes).map(relative_noise).collect();
    // A mode whose noise is practically infinite is missing, and one without noise has no misfit.
    if noise.iter().any(|own| !own.is_finite() || *own <= 0.0) {
        return None;
    }
    let effect = |mode: usize, k: usize| match k {
        k if k < problem.prior.len() => {
            slopes.slopes[(mode, k)] / slopes.frequencies_hz[mode] / noise[mode] / problem.prior[k].sqrt()
        }
        _ => 0.0,
    };
    // With columns of zeros, U has a column for each mode.
    let whitened = DMatrix::from_fn(modes, problem.prior.len().max(modes), effect);
    let decomposed = whitened.svd(true, false);
    let u = decomposed.u?;
    let beside: Vec<usize> =
        (0..decomposed.singular_values.len()).filter(|j| decomposed.singular_values[*j] <= LEAST_EFFECT).collect();
    if beside.is_empty() {
        return None;
    }
    let null = u.select_columns(&beside);
    let visible = null.tr_mul(&DMatrix::from_fn(modes, beside.len(), |mode, j| null[(mode, j)] / noise[mode].powi(2)));
    let eigen = visible.symmetric_eigen();
    let mut order: Vec<usize> = (0..beside.len()).collect();
    order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
    order.truncate(MOST);
    let chosen = null * eigen.eigenvectors.select_columns(&order);
    let effects = DMatrix::from_fn(modes, order.len(), |mode, j| noise[mode] * chosen[(mode, j)]);
    Some(MisfitBasis { modes, effects: effects.as_slice().to_vec() })
}

/// Largest usual misfit of a mode: a simulation that is further off is not that of the structure.
pub(super) const MOST_LN: f64 = 0.05;

/// Takes the usual misfit out of measurements; `usual_ln` may be empty.
pub(super) fn take_out(observations: &mut [Observation], usual_ln: &[f64]) {
    for observation in observations {
        for (hz, ln) in observation.frequencies_hz.iter_mut().zip(usual_ln) {
            *hz = hz.map(|hz| hz * (-ln).exp());
        }
    }
}

/// Whether the misfit of a batch can be judged by the process behind a reference, so that it does not reject the batch: its coordinates explain
/// all that the measurements show beside the simulation, but for noise and a scatter that is usual, and no frequency is as far off as that of
/// another structure.
pub(super) fn is_judged(shown: &Coordinates, reference: &ReferenceProcess, fit: &Fit) -> bool {
    let Some(basis) = &reference.misfit else { return false };
    let usual = reference.usual_misfit[0].max(1.0);
    let chi_squared = ChiSquared::new(shown.degrees_of_freedom.max(f64::MIN_POSITIVE));
    let fits = shown.degrees_of_freedom < 1.0
        || chi_squared.is_ok_and(|chi_squared| chi_squared.sf(shown.left_over / usual) > LEVEL);
    let of_mode = |mode: usize| basis.columns().zip(shown.mean.iter()).map(|(own, size)| own[mode] * size).sum::<f64>();
    fits && fit.gross.is_empty() && (0..basis.modes).all(|mode| of_mode(mode).abs() < MOST_LN)
}
