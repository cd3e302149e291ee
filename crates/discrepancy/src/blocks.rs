//! Blocks of rows that are left out together, and predictions of rows by fits without their block.

use rayon::prelude::*;

use super::data::Data;
use super::fit::{Fit, Start};
use super::model::RowView;
use super::study::Study;

/// Number of blocks of successive rows.
const SUCCESSIVE: usize = 20;

/// Number of folds that the blocks are assigned to in turn.
pub(super) const FOLDS: usize = 5;

/// With fewer rows than this, rows with the same settings form a block: leaving out one of several repetitions of a setting would
/// not test whether another setting can be predicted.
const FEW_ROWS: usize = 40;

/// Assignment of rows to blocks.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Blocks {
    /// Block of each row.
    of: Vec<usize>,
    count: usize,
}

impl Blocks {
    /// At most 20 blocks of `rows` successive rows.
    pub(super) fn successive(rows: usize) -> Self {
        Self { of: (0..rows).map(|place| place * SUCCESSIVE / rows).collect(), count: SUCCESSIVE }
    }

    /// Blocks for cross-validation: of successive rows, or for few rows of rows with the same settings if there are at least as
    /// many combinations of settings as folds.
    pub(super) fn new(data: &Data, rows: &[usize]) -> Self {
        let mut different: Vec<Vec<Option<u64>>> = Vec::new();
        let of = |row: &usize| {
            let settings: Vec<Option<u64>> = data.settings[*row].iter().map(|s| s.map(f64::to_bits)).collect();
            different.iter().position(|d| *d == settings).unwrap_or_else(|| {
                different.push(settings);
                different.len() - 1
            })
        };
        if rows.len() < FEW_ROWS {
            let of: Vec<usize> = rows.iter().map(of).collect();
            if different.len() >= FOLDS {
                return Self { of, count: different.len() };
            }
        }
        Self::successive(rows.len())
    }

    /// Number of blocks, some of which may be empty.
    pub(super) fn count(&self) -> usize {
        self.count
    }

    /// Rows of a block, as places among the rows.
    pub(super) fn places(&self, block: usize) -> impl Iterator<Item = usize> + '_ {
        self.of.iter().enumerate().filter(move |(_, b)| **b == block).map(|(place, _)| place)
    }

    /// Standard error of the mean of `values`, one for each row, from the sums over blocks of their deviations from the mean.
    pub(super) fn standard_error(&self, values: &[f64], mean: f64) -> f64 {
        let sum = |block: usize| self.places(block).map(|place| values[place] - mean).sum::<f64>();
        (0..self.count).map(|block| sum(block).powi(2)).sum::<f64>().sqrt() / values.len() as f64
    }

    /// The places that a fold leaves out, and those that it keeps.
    pub(super) fn fold(&self, number: usize) -> (Vec<usize>, Vec<usize>) {
        (0..self.of.len()).partition(|place| self.of[*place] % FOLDS == number)
    }

    /// Each of `rows` as a fit with the effects of `fit` to the rows of the other folds predicts it, `[rows]`. `None` if the
    /// frequencies cannot be computed in some row.
    pub(super) fn predicted(&self, study: &Study<'_>, rows: &[usize], fit: &Fit) -> Option<Vec<RowView>> {
        let fold = |number: usize| {
            let (left, kept) = self.fold(number);
            let kept: Vec<usize> = kept.iter().map(|p| rows[*p]).collect();
            let out: Vec<usize> = left.iter().map(|p| rows[*p]).collect();
            let refitted = study.fit(&kept, &fit.effects, Some(&Start::at(fit)))?;
            Some(left.into_iter().zip(study.view(&out, &refitted)?).collect::<Vec<_>>())
        };
        let mut views: Vec<(usize, RowView)> =
            (0..FOLDS).into_par_iter().map(fold).collect::<Option<Vec<_>>>()?.into_iter().flatten().collect();
        views.sort_by_key(|(place, _)| *place);
        Some(views.into_iter().map(|(_, view)| view).collect())
    }
}
