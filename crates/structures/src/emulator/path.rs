//! Forward selection of terms, one at a time.

use std::ops::Range;

use super::regression::{dot, subtract_multiples, Regression};
use super::search::Search;

/// A candidate is no longer chosen if less than this share of its squared length is orthogonal to the chosen terms.
const SPENT: f64 = 1e-6;

/// State of a forward selection. Each step takes the candidate that reduces the residual e most.
///
/// ```text
///  maximise (φ_jᵀ e)² / ‖φ_j − QQᵀφ_j‖²
/// ```
///
/// Products of the candidates with the orthonormal columns Q are computed from the Gram matrix, so that a step needs no pass over
/// candidates × runs. Their rounding errors can only affect which term is chosen.
///
/// Source: Chen, Billings & Luo (1989), orthogonal least squares.
#[derive(Debug)]
pub(super) struct Path<'a> {
    search: &'a Search<'a>,
    set: &'a [usize],
    held_out: Range<usize>,
    regression: Regression,
    /// φ_jᵀe of each candidate.
    correlation: Vec<f64>,
    /// ‖φ_j‖² of each candidate.
    length: Vec<f64>,
    /// ‖φ_j − QQᵀφ_j‖² of each candidate.
    left: Vec<f64>,
    /// Whether each candidate can still be chosen.
    open: Vec<bool>,
    /// Φᵀq of each chosen term, one after the other.
    products: Vec<f64>,
    terms: Vec<usize>,
}

impl<'a> Path<'a> {
    /// A selection from `set` (indices of candidates) that has no terms yet, fitted to `y`, `[n]`, at all runs except
    /// `held_out`. `set` begins with the constant, which is chosen first; `correlations` holds φ_jᵀy of all candidates over all
    /// runs, `[candidates]`.
    pub fn new(
        search: &'a Search<'a>,
        set: &'a [usize],
        y: &[f64],
        correlations: &[f64],
        held_out: Range<usize>,
    ) -> Self {
        let part = |column: usize| &search.column(column)[held_out.clone()];
        let correlation = set.iter().map(|&i| correlations[i] - dot(part(i), &y[held_out.clone()])).collect();
        let length: Vec<f64> = set.iter().map(|&i| search.gram[(i, i)] - dot(part(i), part(i))).collect();
        Self {
            search,
            set,
            regression: Regression::without(y, held_out.clone()),
            held_out,
            correlation,
            left: length.clone(),
            length,
            open: vec![true; set.len()],
            products: Vec::new(),
            terms: Vec::new(),
        }
    }

    /// Adds one term; false if no term is left that reduces the residual.
    pub fn advance(&mut self) -> bool {
        while let Some(chosen) = self.next() {
            self.open[chosen] = false;
            let known = self.products.chunks_exact(self.set.len()).map(|column| column[chosen]).collect();
            let column = self.search.column(self.set[chosen]);
            if let Some(upper) = self.regression.push(column, Some(known)) {
                self.terms.push(self.set[chosen]);
                self.update(self.set[chosen], &upper);
                return true;
            }
        }
        false
    }

    /// y minus the prediction at the runs held out, `[held_out]`.
    pub fn held_out_residual(&self) -> &[f64] {
        self.regression.held_out_residual()
    }

    /// The terms in the order in which they were chosen.
    pub fn into_terms(self) -> Vec<usize> {
        self.terms
    }

    /// Index in the set of the best candidate.
    fn next(&self) -> Option<usize> {
        if self.terms.is_empty() {
            return Some(0);
        }
        let (mut next, mut gain) = (None, 0.0);
        for i in 0..self.set.len() {
            let square = self.correlation[i] * self.correlation[i];
            if self.open[i] && self.left[i] > SPENT * self.length[i] && square > gain * self.left[i] {
                gain = square / self.left[i];
                next = Some(i);
            }
        }
        next
    }

    /// Removes the component along the new orthonormal column from all candidates; `upper` is the new column of R.
    fn update(&mut self, term: usize, upper: &[f64]) {
        let gram = self.search.gram.column(term);
        let held_out = &self.search.column(term)[self.held_out.clone()];
        let fitted = |&i: &usize| gram[i] - dot(&self.search.column(i)[self.held_out.clone()], held_out);
        let mut product: Vec<f64> = self.set.iter().map(fitted).collect();
        let (diagonal, upper) = upper.split_last().expect("R has a diagonal");
        subtract_multiples(&mut product, &self.products, upper);
        let projection = self.regression.last_projection();
        for (i, product) in product.iter_mut().enumerate() {
            *product /= diagonal;
            self.correlation[i] -= *product * projection;
            self.left[i] -= *product * *product;
        }
        self.products.extend_from_slice(&product);
    }
}
