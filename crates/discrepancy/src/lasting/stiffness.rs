//! The stiffness, or other parameter, whose change looks like a step of the frequencies.
//!
//! ```text
//!  δ = d s + ε,   ε ~ N(0, Σ),    s = dᵀΣ⁻¹δ/(dᵀΣ⁻¹d),    share explained = (dᵀΣ⁻¹δ)²/(dᵀΣ⁻¹d · δᵀΣ⁻¹δ)
//! ```
//!
//! δ: steps of ln f of each mode; d: derivatives of ln f by ln k; Σ: standard errors of the steps with the correlation of the residuals.

use nalgebra::{DMatrix, DVector};

use super::found::StiffnessChange;
use super::series::{Quantity, Series};
use super::step::{Stepped, Tested};
use crate::fit::Fit;
use crate::model::RowView;
use crate::study::Study;
use structures::physics::effect::Target;
use structures::stats;

/// Share of the steps of all modes that a stiffness must explain to be named.
const EXPLAINED: f64 = 0.9;

/// A further stiffness is named if it leaves less than this more than the best one: as a χ², and as a share of the whole.
const NEARLY: (f64, f64) = (6.0, 0.02);

/// Greatest number of stiffnesses that are named.
const MOST_NAMED: usize = 3;

/// Greatest number of springs that are compared one by one; of a larger structure only the parameters are.
const MOST_SPRINGS: usize = 200;

/// Number of rows whose derivatives are averaged.
const AVERAGED: usize = 60;

/// Two stiffnesses whose derivatives have a larger squared cosine are the same.
const SAME: f64 = 1.0 - 1e-9;

/// Share of the correlation of residuals that is used, so that Σ can be inverted.
const SHRINK: f64 = 0.98;

/// The stiffnesses whose change explains the steps of the modes, the best first; empty if none does. `None` if the frequencies cannot be
/// computed.
pub fn candidates(
    study: &Study<'_>,
    rows: &[usize],
    fit: &Fit,
    views: &[RowView],
    sizes: &[(&Series, &Tested, Stepped)],
) -> Option<Vec<StiffnessChange>> {
    let modes: Vec<(usize, &Tested, Stepped)> = sizes
        .iter()
        .filter_map(|(series, tested, step)| match series.quantity {
            Quantity::Mode(mode) => Some((mode, *tested, *step)),
            Quantity::Parameter(_) => None,
        })
        .collect();
    if modes.len() < 2 {
        return Some(Vec::new());
    }
    let steps = DVector::from_iterator(modes.len(), modes.iter().map(|(_, _, step)| step.size));
    let Some(precision) = covariance(&modes).cholesky() else { return Some(Vec::new()) };
    let weighed = precision.solve(&steps);
    let whole = steps.dot(&weighed);
    let every = rows.len().div_ceil(AVERAGED);
    let mut found: Vec<(f64, StiffnessChange)> = Vec::new();
    for (name, is_stiffness, by) in directions(study, rows, fit, views, every)? {
        let by = DVector::from_iterator(modes.len(), modes.iter().map(|(mode, ..)| by[*mode]));
        let information = by.dot(&precision.solve(&by));
        if information <= 0.0 {
            continue;
        }
        let size = by.dot(&weighed) / information;
        let explained = size * size * information;
        if explained >= EXPLAINED * whole {
            let standard_error_percent = 100.0 * information.sqrt().recip();
            found.push((
                whole - explained,
                StiffnessChange { name, percent: 100.0 * size.exp_m1(), standard_error_percent, is_stiffness },
            ));
        }
    }
    found.sort_by(|a, b| a.0.total_cmp(&b.0));
    let best = found.first().map_or(0.0, |f| f.0);
    let near = found.into_iter().take_while(|f| f.0 <= best + NEARLY.0.max(NEARLY.1 * whole));
    Some(near.take(MOST_NAMED).map(|f| f.1).collect())
}

/// Σ, `[modes, modes]`.
fn covariance(modes: &[(usize, &Tested, Stepped)]) -> DMatrix<f64> {
    let residuals: Vec<Vec<f64>> =
        modes.iter().map(|(_, tested, step)| tested.residual(step.place, step.size)).collect();
    let correlation = |a: usize, b: usize| {
        let (first, second) = (modes[a].1, modes[b].1);
        let (mut sum, mut squares) = (0.0, [0.0, 0.0]);
        let mut other = 0;
        for place in 0..residuals[a].len() {
            while other < residuals[b].len() && second.bin(other) < first.bin(place) {
                other += 1;
            }
            if other < residuals[b].len() && second.bin(other) == first.bin(place) {
                let (x, y) = (residuals[a][place], residuals[b][other]);
                sum += x * y;
                squares[0] += x * x;
                squares[1] += y * y;
            }
        }
        SHRINK * sum / (squares[0] * squares[1]).sqrt().max(f64::MIN_POSITIVE)
    };
    DMatrix::from_fn(modes.len(), modes.len(), |a, b| {
        let of_two = if a == b { 1.0 } else { correlation(a.min(b), a.max(b)) };
        of_two * modes[a].2.standard_error * modes[b].2.standard_error
    })
}

/// Name, whether it is a stiffness, and derivative of ln f of each mode by its logarithm, `[m]`, of every parameter that is never 0 and of
/// every spring. Each is the mean over every `every`-th row.
fn directions(
    study: &Study<'_>,
    rows: &[usize],
    fit: &Fit,
    views: &[RowView],
    every: usize,
) -> Option<Vec<(String, bool, Vec<f64>)>> {
    let modes = study.simulator.modes();
    let mut found: Vec<(String, bool, Vec<f64>)> = Vec::new();
    let mut add = |name: String, is_stiffness: bool, by: Vec<f64>| {
        if !found.iter().any(|(_, _, other)| stats::squared_cosine(other, &by) > SAME) {
            found.push((name, is_stiffness, by));
        }
    };
    let mean_of = |values: &[f64]| if values.is_empty() { 0.0 } else { stats::mean(values) };
    let parameters = study.simulator.space().as_slice();
    let has_logarithm = |k: &&usize| study.simulator.is_stiffness(**k) || parameters[**k].has_share();
    for k in study.free().iter().filter(has_logarithm) {
        let share = study.simulator.stiffness_share(*k, fit.mean[*k]);
        let of_mode = |mode: usize| {
            let one = |view: &RowView| {
                let place = view.present[..view.frequencies].iter().position(|present| *present == mode)?;
                Some(view.by_parameter[(place, *k)] / share)
            };
            mean_of(&views.iter().step_by(every).filter_map(one).collect::<Vec<f64>>())
        };
        add(parameters[*k].name.clone(), study.simulator.is_stiffness(*k), (0..modes).map(of_mode).collect());
    }
    let springs = study.simulator.structure().map_or(&[][..], |structure| structure.springs());
    if springs.len() <= MOST_SPRINGS && !springs.is_empty() {
        let targets: Vec<Target> = (0..springs.len()).map(|spring| Target::Springs(vec![spring])).collect();
        let some: Vec<usize> = rows.iter().step_by(every).copied().collect();
        let slopes = study.directions(&some, fit, &targets)?;
        for (column, spring) in springs.iter().enumerate() {
            let of_mode = |mode: usize| mean_of(&slopes.iter().map(|s| s[(mode, column)]).collect::<Vec<f64>>());
            add(spring.name.clone(), true, (0..modes).map(of_mode).collect());
        }
    }
    Some(found)
}
