//! Sensitivity-based model updating: finds the parameters whose frequencies are the measured ones, one measurement at a time.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use crate::parameter::Parameter;
use crate::physics;
use crate::simulator::Simulator;

/// Largest number of iterations of an update.
const MOST_ITERATIONS: usize = 60;

/// Root mean square of the relative residuals below which the frequencies are matched.
const MATCHED_RESIDUAL: f64 = 1e-9;

/// Step in the unit box below which the search has converged.
const CONVERGED_STEP: f64 = 1e-9;

/// Result of updating the parameters by one measurement.
#[derive(Debug, Clone, PartialEq)]
pub struct Update {
    /// Parameters, `[d]`, parameter units, inside the prior box.
    pub theta: Vec<f64>,
    /// Root mean square of ln f/f(θ) over the measured modes.
    pub residual: f64,
    /// Number of iterations over all starts.
    pub iterations: usize,
    /// Number of starts, of which the best result is kept.
    pub starts: usize,
    /// Whether the search converged: to matched frequencies, to a minimum of the misfit, or to a bound of the prior.
    pub converged: bool,
}

impl Update {
    /// Whether the frequencies at θ match the measured ones: the residual is at most 1e-9.
    pub fn is_met(&self) -> bool {
        self.residual <= MATCHED_RESIDUAL
    }
}

/// Updates the parameters by one measurement, starting from `start` (`[d]`, parameter units).
///
/// ```text
///  minimise Σ_i (ln f_i − ln f_i(θ))²   over the prior box
///  (SᵀS + μ diag SᵀS) Δu = Sᵀ r,    r_i = ln f_i/f_i(θ),    S_ij = ∂ln f_i/∂u_j,    u: θ in the unit box
/// ```
///
/// The Levenberg–Marquardt method with analytic derivatives of the eigenvalues, constrained to the box: a parameter at a bound
/// whose step points outwards is fixed for this step. `frequencies_hz` has one entry for each mode, `[m]`, which is `None` if the
/// mode was not measured.
///
/// Source: Friswell & Mottershead (1995), Finite Element Model Updating in Structural Dynamics, chapter 8; the derivatives of
/// Nelson (1976).
///
/// # Errors
/// [`physics::Error`], which cannot occur inside a checked prior.
pub fn update(simulator: &Simulator, frequencies_hz: &[Option<f64>], start: &[f64]) -> Result<Update, physics::Error> {
    let parameters = simulator.space().as_slice();
    let present: Vec<(usize, f64)> = frequencies_hz.iter().enumerate().filter_map(|(i, f)| Some((i, (*f)?))).collect();
    let d = parameters.len();
    let theta = |u: &DVector<f64>| -> Vec<f64> { parameters.iter().zip(u).map(|(p, u)| p.from_unit(*u)).collect() };
    let linearised = |u: &DVector<f64>| -> Result<(DVector<f64>, DMatrix<f64>), physics::Error> {
        let (f, jacobian) = simulator.frequencies_and_jacobian(&theta(u))?;
        let residual = present.iter().map(|(mode, measured)| (measured / f[*mode]).ln());
        let slope = |row: usize, column: usize| {
            let mode = present[row].0;
            jacobian[(mode, column)] * (parameters[column].upper - parameters[column].lower) / f[mode]
        };
        Ok((DVector::from_iterator(present.len(), residual), DMatrix::from_fn(present.len(), d, slope)))
    };
    let mut u = DVector::from_iterator(d, parameters.iter().zip(start).map(|(p, x)| p.to_unit(*x).clamp(0.0, 1.0)));
    let (mut residual, mut slopes) = linearised(&u)?;
    let mut damping = 1e-3;
    let (mut iterations, mut converged) = (0, false);
    while iterations < MOST_ITERATIONS && !converged {
        iterations += 1;
        let descent = slopes.tr_mul(&residual);
        let held = |i: usize| (u[i] <= 0.0 && descent[i] < 0.0) || (u[i] >= 1.0 && descent[i] > 0.0);
        let mut normal = slopes.tr_mul(&slopes);
        let mut right = descent.clone();
        for i in 0..d {
            normal[(i, i)] *= 1.0 + damping;
            // Keeps the matrix regular if a parameter does not affect any frequency; that parameter then does not change.
            normal[(i, i)] += 1e-14;
            if held(i) {
                normal.row_mut(i).fill(0.0);
                normal.column_mut(i).fill(0.0);
                normal[(i, i)] = 1.0;
                right[i] = 0.0;
            }
        }
        let Some(factor) = normal.cholesky() else { break };
        let next = (&u + factor.solve(&right)).map(|u| u.clamp(0.0, 1.0));
        let moved = (&next - &u).amax();
        let (next_residual, next_slopes) = linearised(&next)?;
        let better = next_residual.norm_squared() < residual.norm_squared();
        if better {
            (u, residual, slopes) = (next, next_residual, next_slopes);
            damping = (damping / 10.0).max(1e-12);
        } else {
            damping *= 10.0;
        }
        let matched = root_mean_square(&residual) <= MATCHED_RESIDUAL;
        converged = matched || moved <= CONVERGED_STEP || damping > 1e10;
    }
    Ok(Update { theta: theta(&u), residual: root_mean_square(&residual), iterations, starts: 1, converged })
}

/// [`update`] for many measurements (`[n][m]`) in parallel. Each starts from the median of the prior; while its frequencies are
/// not matched, it starts again from the next of `further_starts` (`[starts][d]`), and the best result is kept.
///
/// # Errors
/// As [`update`].
pub fn update_all(
    simulator: &Simulator,
    measurements: &[Vec<Option<f64>>],
    further_starts: &[Vec<f64>],
) -> Result<Vec<Update>, physics::Error> {
    let middle: Vec<f64> = simulator.space().iter().map(Parameter::prior_median).collect();
    let one = |frequencies: &Vec<Option<f64>>| {
        let mut best = update(simulator, frequencies, &middle)?;
        for start in further_starts {
            if best.is_met() {
                break;
            }
            let other = update(simulator, frequencies, start)?;
            let (iterations, starts) = (best.iterations + other.iterations, best.starts + 1);
            if other.residual < best.residual {
                best = other;
            }
            (best.iterations, best.starts) = (iterations, starts);
        }
        Ok(best)
    };
    measurements.par_iter().map(one).collect()
}

/// Further starts for [`update_all`]: a lattice of at most 64 interior points of the prior box, at equal steps of probability, over the
/// first six parameters, with the others at the medians of their priors, `[starts][d]`.
pub fn prior_lattice(simulator: &Simulator) -> Vec<Vec<f64>> {
    const MOST: usize = 64;
    let space = simulator.space().as_slice();
    let spanned = space.len().min(6);
    let steps = (2..=8).rev().find(|steps: &usize| steps.pow(spanned as u32) <= MOST).unwrap_or(2);
    let at = |point: usize, k: usize| match k {
        k if k < spanned => ((point / steps.pow(k as u32) % steps) as f64 + 0.5) / steps as f64,
        _ => 0.5,
    };
    let start = |point: usize| space.iter().enumerate().map(|(k, p)| p.at_level(at(point, k))).collect();
    (0..steps.pow(spanned as u32)).map(start).collect()
}

fn root_mean_square(residual: &DVector<f64>) -> f64 {
    (residual.norm_squared() / residual.len().max(1) as f64).sqrt()
}
