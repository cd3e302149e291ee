//! Candidate terms evaluated at the runs, among which expansions are selected.

use std::ops::Range;

use nalgebra::DMatrix;
use rand::seq::SliceRandom as _;

use super::basis::Candidates;
use crate::stats;

/// Number of folds of the cross-validation: more for few runs, where leaving out a fold costs more accuracy.
const FOLDS_OF_FEW: usize = 10;
const FOLDS_OF_MANY: usize = 5;
const FEW: usize = 500;

/// Candidate terms at the runs. The runs are shuffled, so that a fold of a table written in a regular order, such as a grid row
/// by row, does not leave out a whole region.
#[derive(Debug)]
pub(super) struct Search<'a> {
    /// The candidate terms.
    pub candidates: &'a Candidates,
    /// Index of the run in each row.
    pub order: Vec<usize>,
    /// Rows of each fold.
    pub folds: Vec<Range<usize>>,
    /// Values of the terms Φ, `[n, candidates]`.
    pub design: DMatrix<f64>,
    /// ΦᵀΦ, `[candidates, candidates]`.
    pub gram: DMatrix<f64>,
}

impl<'a> Search<'a> {
    /// Evaluates the candidates at the runs `x`, `[n, d]`, scaled to [−1, 1].
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

    /// Values of one candidate at the shuffled runs, `[n]`.
    pub fn column(&self, index: usize) -> &[f64] {
        let n = self.design.nrows();
        &self.design.as_slice()[index * n..(index + 1) * n]
    }
}
