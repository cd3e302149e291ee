//! Forward selection, one term at a time.

use std::ops::Range;

use super::regression::{dot, subtract_multiples, Regression};
use super::select::Search;

/// A candidate that keeps less than this share of its squared length beyond the chosen ones is not chosen.
const SPENT: f64 = 1e-6;

/// A forward selection on its way: each step takes the candidate that lowers the residual most.
///
/// ```text
///  maximise (φ_jᵀ e)² / ‖φ_j − QQᵀφ_j‖²
/// ```
///
/// Products of the candidates with the orthonormal columns follow from the Gram matrix, so that a step costs no pass over
/// candidates × runs. Their rounding can only change which term is chosen.
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
    /// ‖φ_j‖² and what of it is beyond the chosen ones.
    length: Vec<f64>,
    left: Vec<f64>,
    open: Vec<bool>,
    /// Φᵀq of each chosen term, one after the other.
    products: Vec<f64>,
    terms: Vec<usize>,
}

impl<'a> Path<'a> {
    /// No term yet. `set` begins with the constant, which is the first; `correlations`: φ_jᵀy of all candidates, all runs.
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

    /// Takes one more term; false where none is left that would help.
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

    /// y less the fit at the runs held out.
    pub fn held_out_residual(&self) -> &[f64] {
        self.regression.held_out_residual()
    }

    /// The terms in the order in which they were chosen.
    pub fn into_terms(self) -> Vec<usize> {
        self.terms
    }

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

    /// Takes the new orthonormal column out of all candidates; `upper` is the column of R that made it.
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
