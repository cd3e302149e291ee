//! Selection of the terms of an expansion: all terms up to a degree, or forward selection among candidates, compared by
//! cross-validation.

use std::ops::Range;

use super::path::Path;
use super::regression::{dot, Regression};
use super::search::Search;
use crate::stats;

/// Largest number of selected terms.
const TERMS: usize = 300;

/// A set of up to this many candidates is also tried as a whole, if there are at least twice as many runs.
const FULL: usize = 250;

/// A selection ends after this many steps without a smaller error: a share of the largest number of terms, and at least
/// `PATIENCE`.
const PATIENCE_SHARE: f64 = 0.1;
const PATIENCE: usize = 10;

/// Rounding error as a share of the largest value.
const ROUNDING: f64 = 1e-14;

/// A fitted expansion and its error.
#[derive(Debug, Clone)]
pub(super) struct Fit {
    /// Indices of the candidates; the constant comes first.
    pub terms: Vec<usize>,
    /// Their coefficients, in the same order.
    pub coefficients: Vec<f64>,
    /// y minus the prediction of a fit without the run, `[n]`.
    pub held_out: Vec<f64>,
    /// Expected mean square error at a new point.
    pub error: f64,
}

/// The terms of an expansion that was tried, and its error.
#[derive(Debug)]
struct Choice<'a> {
    set: &'a [usize],
    /// Number of terms selected from the set; `None` for all of them.
    selected: Option<usize>,
    held_out: Vec<f64>,
    error: f64,
}

impl Search<'_> {
    /// The expansion of `y`, `[n]`, with the smallest error at runs left out.
    ///
    /// Under each truncation the degree is increased until the error has grown twice in a row. The error of a set that is used
    /// as a whole is its corrected leave-one-out error. For selected terms that error is far too small, because the selection
    /// has seen all runs (by a factor of ten for 200 of 1,771 candidates and 300 runs). The error of a selection is therefore
    /// found by cross-validation, in which each fold is predicted by terms selected without it.
    ///
    /// Source: Blatman & Sudret (2011), §4, with forward selection in place of least angle regression; Hastie, Tibshirani &
    /// Friedman (2009), §7.10.2, for the cross-validation.
    pub fn fit(&self, y: &[f64]) -> Fit {
        let mean = stats::mean(y);
        let centred: Vec<f64> = self.order.iter().map(|&run| y[run] - mean).collect();
        let rounding = ROUNDING * y.iter().fold(0.0_f64, |largest, y| largest.max(y.abs()));
        let enough = rounding * rounding;
        let correlations: Vec<f64> =
            (0..self.design.ncols()).map(|column| dot(self.column(column), &centred)).collect();
        let mut best: Option<Choice> = None;
        for ladder in &self.candidates.ladders {
            let (mut before, mut grown) = (f64::INFINITY, 0);
            for set in ladder {
                let mut choice = self.select(set, &centred, &correlations, enough);
                if set.len() <= FULL.min(y.len() / 2) {
                    choice = self.whole(set, &centred).filter(|whole| whole.error < choice.error).unwrap_or(choice);
                }
                grown = if choice.error > before { grown + 1 } else { 0 };
                before = choice.error;
                if best.as_ref().is_none_or(|best| choice.error < best.error) {
                    best = Some(choice);
                }
                if grown == 2 || before <= enough {
                    break;
                }
            }
        }
        let best = best.expect("degree 1 is a set of every ladder: there are more runs than parameters");
        self.build(&best, &centred, mean, &correlations)
    }

    /// Finds how many terms of a set to select. The selections without each fold advance by one term at a time, until the error
    /// over all folds rises.
    fn select<'s>(&self, set: &'s [usize], y: &[f64], correlations: &[f64], enough: f64) -> Choice<'s> {
        let longest = self.folds.iter().map(Range::len).max().unwrap_or(0);
        let most = set.len().min(2 * (y.len() - longest) / 3).min(TERMS);
        let patience = PATIENCE.max((PATIENCE_SHARE * most as f64) as usize);
        let mut paths: Vec<Path> =
            self.folds.iter().map(|fold| Path::new(self, set, y, correlations, fold.clone())).collect();
        let mut best = Choice { set, selected: Some(1), held_out: y.to_vec(), error: f64::INFINITY };
        for terms in 1..=most {
            // All selections must advance; `any` would stop at the first one that does.
            let moved = paths.iter_mut().map(Path::advance).fold(false, |any, moved| any | moved);
            if !moved {
                break;
            }
            let squares = paths.iter().flat_map(Path::held_out_residual).map(|e| e * e);
            let error = squares.sum::<f64>() / y.len() as f64;
            if error < best.error {
                let held_out = paths.iter().flat_map(Path::held_out_residual).copied().collect();
                best = Choice { selected: Some(terms), held_out, error, ..best };
            }
            if best.selected.is_some_and(|selected| terms >= selected + patience) || error <= enough {
                break;
            }
        }
        best
    }

    /// The whole set, if its terms are linearly independent.
    fn whole<'s>(&self, set: &'s [usize], y: &[f64]) -> Option<Choice<'s>> {
        let mut regression = Regression::new(y);
        for &term in set {
            regression.push(self.column(term), None)?;
        }
        Some(Choice { set, selected: None, held_out: regression.leave_one_out(), error: regression.corrected_error() })
    }

    /// Least squares fit of the chosen terms to all runs; `mean` was subtracted from `y`.
    fn build(&self, choice: &Choice, y: &[f64], mean: f64, correlations: &[f64]) -> Fit {
        let terms = choice.selected.map_or_else(
            || choice.set.to_vec(),
            |count| {
                let mut path = Path::new(self, choice.set, y, correlations, 0..0);
                // A selection that ends early has no residual left to fit.
                (0..count).for_each(|_| _ = path.advance());
                path.into_terms()
            },
        );
        // Fitted again, so that the coefficients contain no rounding errors of the selection.
        let mut regression = Regression::new(y);
        let terms: Vec<usize> =
            terms.into_iter().filter(|&term| regression.push(self.column(term), None).is_some()).collect();
        let mut coefficients = regression.coefficients();
        coefficients[0] += mean;
        let mut held_out = vec![0.0; y.len()];
        for (&run, missed) in self.order.iter().zip(&choice.held_out) {
            held_out[run] = *missed;
        }
        Fit { terms, coefficients, held_out, error: choice.error }
    }
}
