//! A discrepancy that is a constant for each mode, for a simulation that is off everywhere.
//!
//! ```text
//!  g_i = Σ_j w_j r_ij / Σ_j w_j ± √(Σ_j w_j² V_ji) / Σ_j w_j,      r_ij = ln f_ij − ln M_i(θ̂)
//! ```
//!
//! θ̂: mean of the parameters beside the deviation of all parts; w: weights of the rows under the t distribution; V: noise and spread of the
//! parameters. The parameters are held at θ̂: how much of the deviation belongs to them, frequencies do not tell, and later changes do not
//! depend on it.

use super::learn::{without_mean, Learned, WhyNot};
use crate::fit::{Fit, Start};
use crate::study::Study;
use structures::simulator::discrepancy::definition::{DiscrepancyDefinition, ModeDefinition};
use structures::simulator::discrepancy::input::Discrepancy;

/// The constant discrepancy of each mode that was measured in the rows with the indices `rows`. `with`: the fit with a deviation of all
/// parts.
///
/// # Errors
/// [`WhyNot::NoFit`].
pub fn constant(study: &Study<'_>, rows: &[usize], with: &Fit) -> Result<Learned, WhyNot> {
    let without = without_deviation(with);
    let deviations = study.view(rows, &without).ok_or(WhyNot::NoFit)?;
    let weighted = study.view(rows, with).ok_or(WhyNot::NoFit)?;
    let modes = study.simulator.modes();
    // Σ w, Σ w r and Σ w² V of each mode.
    let mut sums = vec![[0.0; 3]; modes];
    for (deviation, weighted) in deviations.iter().zip(&weighted) {
        let weight = weighted.weight;
        for (place, mode) in deviation.present[..deviation.frequencies].iter().enumerate() {
            let terms =
                [weight, weight * deviation.residual[place], weight.powi(2) * weighted.covariance[(place, place)]];
            sums[*mode].iter_mut().zip(terms).for_each(|(sum, term)| *sum += term);
        }
    }
    let mode = |(mode, [weights, residuals, variances]): (usize, &[f64; 3])| {
        let (mean, error) = (residuals / weights, variances.sqrt() / weights);
        // Any prior that is wide beside the error would do.
        let std = mean.abs().max(2.0 * error);
        (*weights > 0.0).then(|| ModeDefinition {
            mode: mode + 1,
            std,
            lengths: Vec::new(),
            weights: vec![mean / std],
            factor: vec![vec![error / std]],
        })
    };
    let definition = DiscrepancyDefinition {
        description: None,
        inputs: Vec::new(),
        points: vec![Vec::new()],
        modes: sums.iter().enumerate().filter_map(mode).collect(),
    };
    let discrepancy = Discrepancy::new(&definition, modes).map_err(|_| WhyNot::NoFit)?;
    let known = vec![Some(Vec::new()); study.data.rows()];
    let corrected = without_mean(study.data, &discrepancy, &known);
    let fit = Study::new(study.simulator, &corrected).fit(rows, &without.effects, Some(&Start::at(&without)));
    Ok(Learned { discrepancy, fit: fit.ok_or(WhyNot::NoFit)?, change: None })
}

/// The fit with the same parameters, without the deviation of all parts.
fn without_deviation(with: &Fit) -> Fit {
    let mut without = with.clone();
    let kept = |index: &usize| with.effects[*index].mixture.is_none();
    let kept: Vec<usize> = (0..with.effects.len()).filter(kept).collect();
    without.effects = kept.iter().map(|index| with.effects[*index].clone()).collect();
    without.psi = kept.iter().map(|index| with.psi[*index].clone()).collect();
    without
}
