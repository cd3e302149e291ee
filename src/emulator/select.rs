//! Which terms an expansion has: all of a degree, or forward selection among candidates, judged by runs left out.

use std::ops::Range;

use nalgebra::DMatrix;
use rand::seq::SliceRandom as _;

use super::basis::Candidates;
use super::path::Path;
use super::regression::{dot, Regression};
use crate::stats;

/// Most terms of an expansion.
const TERMS: usize = 300;

/// A set of no more candidates is also taken as a whole, if there are twice as many runs.
const FULL: usize = 250;

/// Parts of the runs that are left out in turn: many of a short table, where each part is missed.
const FOLDS_OF_FEW: usize = 10;
const FOLDS_OF_MANY: usize = 5;
const FEW: usize = 500;

/// Steps without a better error after which a selection ends: this share of the most terms, and no fewer than `PATIENCE`.
const PATIENCE_SHARE: f64 = 0.1;
const PATIENCE: usize = 10;

/// Error, as a share of the largest value, that is rounding.
const ROUNDING: f64 = 1e-14;

/// An expansion found: which candidates, with which coefficients, and how well it does.
#[derive(Debug, Clone)]
pub(super) struct Fit {
    /// Indices of the candidates; the constant comes first.
    pub terms: Vec<usize>,
    /// Their coefficients, in the same order.
    pub coefficients: Vec<f64>,
    /// y less the prediction of a fit without the run, `[n]`.
    pub held_out: Vec<f64>,
    /// Mean square error to be expected at a new point.
    pub error: f64,
}

/// Candidates at the runs, which are shuffled: of a grid, say, written row by row, no whole row is then left out at once.
#[derive(Debug)]
pub(super) struct Search<'a> {
    candidates: &'a Candidates,
    /// Run of each row.
    order: Vec<usize>,
    folds: Vec<Range<usize>>,
    /// `[n, candidates]`.
    pub(super) design: DMatrix<f64>,
    pub(super) gram: DMatrix<f64>,
}

/// What to build an expansion of, and how well that does.
#[derive(Debug)]
struct Choice<'a> {
    set: &'a [usize],
    /// How many of the set are selected; `None` takes all of them.
    selected: Option<usize>,
    held_out: Vec<f64>,
    error: f64,
}

impl<'a> Search<'a> {
    /// `x`: the runs, `[n, d]`, scaled to [−1, 1].
    pub fn new(candidates: &'a Candidates, x: &DMatrix<f64>) -> Self {
        let runs = x.nrows();
        let mut order: Vec<usize> = (0..runs).collect();
        order.shuffle(&mut stats::stream(0, "emulator folds"));
        let folds = if runs <= FEW { FOLDS_OF_FEW.min(runs) } else { FOLDS_OF_MANY };
        let design = candidates.design(&x.select_rows(&order));
        Self {
            candidates,
            order,
            folds: (0..folds).map(|fold| fold * runs / folds..(fold + 1) * runs / folds).collect(),
            gram: design.transpose() * &design,
            design,
        }
    }

    /// The expansion of `y`, `[n]`, that does best at runs left out.
    ///
    /// Under each truncation the degree rises until the error has grown twice in a row. A set that is taken as a whole is
    /// judged by its corrected leave-one-out error. That error is far too small for terms that were selected with the run
    /// left out (tenfold for 200 of 1,771 candidates by 300 runs): a selection is judged by cross-validation, in which each
    /// part of the runs is predicted by terms selected without it.
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

    pub(super) fn column(&self, index: usize) -> &[f64] {
        let n = self.design.nrows();
        &self.design.as_slice()[index * n..(index + 1) * n]
    }

    /// How many terms of a set to select: all parts of the runs go up in step, until the error over all of them rises.
    fn select<'s>(&self, set: &'s [usize], y: &[f64], correlations: &[f64], enough: f64) -> Choice<'s> {
        let longest = self.folds.iter().map(Range::len).max().unwrap_or(0);
        let most = set.len().min(2 * (y.len() - longest) / 3).min(TERMS);
        let patience = PATIENCE.max((PATIENCE_SHARE * most as f64) as usize);
        let mut paths: Vec<Path> =
            self.folds.iter().map(|fold| Path::new(self, set, y, correlations, fold.clone())).collect();
        let mut best = Choice { set, selected: Some(1), held_out: y.to_vec(), error: f64::INFINITY };
        for terms in 1..=most {
            // Not `any`, which would stop at the first that moves.
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

    /// The whole set, if its terms are independent.
    fn whole<'s>(&self, set: &'s [usize], y: &[f64]) -> Option<Choice<'s>> {
        let mut regression = Regression::new(y);
        for &term in set {
            regression.push(self.column(term), None)?;
        }
        Some(Choice { set, selected: None, held_out: regression.leave_one_out(), error: regression.corrected_error() })
    }

    /// Least squares on the terms of a choice, made with all runs; `mean` is what `y` was centred by.
    fn build(&self, choice: &Choice, y: &[f64], mean: f64, correlations: &[f64]) -> Fit {
        let terms = choice.selected.map_or_else(
            || choice.set.to_vec(),
            |count| {
                let mut path = Path::new(self, choice.set, y, correlations, 0..0);
                // A path that ends early has nothing left to fit.
                (0..count).for_each(|_| _ = path.advance());
                path.into_terms()
            },
        );
        // Anew, so that no rounding of the path is left in the coefficients.
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
