//! Pairs of neighbouring modes that veer or cross, emulated by their mean and squared gap, which are smooth.

use nalgebra::DMatrix;
use rayon::prelude::*;

use super::crossing::Gap;
use super::search::Search;
use super::select::Fit;

/// A pair whose mean and squared gap are expanded instead of its two modes.
#[derive(Debug, Clone)]
pub(super) struct Pair {
    /// The lower one of the two modes, from 0.
    pub lower: usize,
    /// Lower limit of the predicted squared gap: the root mean square error of its expansion.
    floor: f64,
}

/// Expansions of the mean and the squared gap of a pair, and the resulting errors of its two modes.
#[derive(Debug)]
pub(super) struct PairFit {
    pub pair: Pair,
    pub mean: Fit,
    pub squared_gap: Fit,
    /// ln f minus its prediction without the run, for the lower and the upper mode, `[n]` each.
    pub held_out: [Vec<f64>; 2],
    /// Expected mean square error at a new point, for the lower and the upper mode.
    pub errors: [f64; 2],
}

impl Pair {
    /// Replaces the mean and the squared gap D of the pair in `values`, `[m]`, by ln f of its two modes.
    ///
    /// ```text
    ///  ln f = mean ∓ √D / 2
    /// ```
    pub fn separate(&self, values: &mut [f64]) {
        let (mean, half) = (values[self.lower], self.half_gap(values[self.lower + 1]));
        values[self.lower] = mean - half;
        values[self.lower + 1] = mean + half;
    }

    /// [`Self::separate`] for the gradients, `[m, d]`; `values` still contains the mean and the squared gap.
    pub fn separate_gradients(&self, values: &[f64], gradients: &mut DMatrix<f64>) {
        let squared_gap = values[self.lower + 1];
        // d(√D/2) = dD/(4√D), and 0 where D is at its floor.
        let rate = if squared_gap > self.floor { 0.125 / self.half_gap(squared_gap) } else { 0.0 };
        for mut column in gradients.column_iter_mut() {
            let (mean, half) = (column[self.lower], rate * column[self.lower + 1]);
            column[self.lower] = mean - half;
            column[self.lower + 1] = mean + half;
        }
    }

    fn half_gap(&self, squared: f64) -> f64 {
        0.5 * squared.max(self.floor).sqrt()
    }
}

/// Expands the mean and the squared gap of the pairs in `gaps`; `ln_frequencies`: `[m][n]`.
///
/// Where two modes interact only with each other, their eigenvalues are the roots of a quadratic equation with smooth
/// coefficients. Each root has a kink where the modes cross and a sharp bend where they veer, but their sum and the square of
/// their difference are smooth, and so are those of their logarithms.
pub(super) fn fit_pairs(search: &Search, gaps: &[Gap], ln_frequencies: &[Vec<f64>]) -> Vec<PairFit> {
    let fit = |gap: &Gap| {
        let modes = [&ln_frequencies[gap.lower_mode], &ln_frequencies[gap.lower_mode + 1]];
        let mean: Vec<f64> = modes[0].iter().zip(modes[1]).map(|(lower, upper)| 0.5 * (lower + upper)).collect();
        let (mean_fit, gap_fit) = rayon::join(|| search.fit(&mean), || search.fit(&gap.squared));
        let pair = Pair { lower: gap.lower_mode, floor: gap_fit.error.sqrt() };
        let half_gaps: Vec<f64> =
            gap.squared.iter().zip(&gap_fit.held_out).map(|(d, missed)| pair.half_gap(d - missed)).collect();
        let held_out = [-1.0, 1.0].map(|sign| {
            let truth = if sign < 0.0 { modes[0] } else { modes[1] };
            let predicted =
                mean.iter().zip(&mean_fit.held_out).zip(&half_gaps).map(|((m, r), half)| m - r + sign * half);
            truth.iter().zip(predicted).map(|(y, predicted)| y - predicted).collect::<Vec<f64>>()
        });
        // The larger correction for the number of terms applies to both modes.
        let correction = correction(&mean_fit).max(correction(&gap_fit));
        let errors = [0, 1].map(|mode| correction * mean_square(&held_out[mode]));
        PairFit { pair, mean: mean_fit, squared_gap: gap_fit, held_out, errors }
    };
    gaps.par_iter().map(fit).collect()
}

/// The pairs with a smaller error than their two modes expanded separately, by ascending mode. No two of them share a mode.
pub(super) fn choose(mut pairs: Vec<PairFit>, alone: &[Fit]) -> Vec<PairFit> {
    let gain = |pair: &PairFit| {
        let lower = pair.pair.lower;
        (alone[lower].error + alone[lower + 1].error) / (pair.errors[0] + pair.errors[1])
    };
    pairs.retain(|pair| gain(pair) > 1.0);
    pairs.sort_by(|a, b| gain(b).total_cmp(&gain(a)));
    let mut chosen: Vec<PairFit> = Vec::new();
    for pair in pairs {
        if chosen.iter().all(|other| other.pair.lower.abs_diff(pair.pair.lower) > 1) {
            chosen.push(pair);
        }
    }
    chosen.sort_by_key(|pair| pair.pair.lower);
    chosen
}

/// Ratio of the expected error of a fit to the mean square of its held-out residuals, at least 1.
fn correction(fit: &Fit) -> f64 {
    let plain = mean_square(&fit.held_out);
    // An exact expansion needs no correction.
    if plain > 0.0 {
        (fit.error / plain).max(1.0)
    } else {
        1.0
    }
}

fn mean_square(values: &[f64]) -> f64 {
    values.iter().map(|value| value * value).sum::<f64>() / values.len() as f64
}
