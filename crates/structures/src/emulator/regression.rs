//! Least squares regression that grows by one column at a time and gives its error at runs left out at every size.

use std::ops::Range;

/// A column is linearly dependent if less than this share of its length is orthogonal to the columns before it.
const DEPENDENT: f64 = 1e-7;

/// A column is orthogonalised a second time if less than this share of its squared length remains.
const CANCELLED: f64 = 0.5;

/// If 1 − h is below this, the run alone determines a coefficient and cannot be left out.
const DECISIVE: f64 = 1e-9;

/// y = Φβ + e by Gram–Schmidt, Φ = QR, with the diagonal h of the hat matrix QQᵀ.
#[derive(Debug)]
pub(super) struct Regression {
    /// Rows that are predicted but not fitted.
    held_out: Range<usize>,
    /// Columns of Q, one after the other.
    orthonormal: Vec<f64>,
    /// Columns of R⁻¹.
    inverse: Vec<Vec<f64>>,
    /// ‖R⁻¹‖²_F = tr (ΦᵀΦ)⁻¹.
    inverse_trace: f64,
    /// Qᵀy.
    projections: Vec<f64>,
    residual: Vec<f64>,
    leverage: Vec<f64>,
}

impl Regression {
    /// A regression of `y`, `[n]`, without columns yet.
    pub fn new(y: &[f64]) -> Self {
        Self::without(y, 0..0)
    }

    /// As [`Self::new`], but the rows `held_out` of `y`, `[n]`, are only predicted and not fitted.
    pub fn without(y: &[f64], held_out: Range<usize>) -> Self {
        Self {
            held_out,
            orthonormal: Vec::new(),
            inverse: Vec::new(),
            inverse_trace: 0.0,
            projections: Vec::new(),
            residual: y.to_vec(),
            leverage: vec![0.0; y.len()],
        }
    }

    /// Adds a column of Φ, `[n]`. `products` is Qᵀ times this column, if it is known already. Returns the new column of R, or
    /// `None` if the column is linearly dependent on those before it, in which case it is not added.
    ///
    /// Gram–Schmidt is repeated where digits cancel, so that Q is orthogonal to rounding error.
    ///
    /// Source: Daniel, Gragg, Kaufman & Stewart (1976).
    pub fn push(&mut self, column: &[f64], products: Option<Vec<f64>>) -> Option<Vec<f64>> {
        let n = self.residual.len();
        let length = self.fitted_dot(column, column);
        let project =
            |column: &[f64]| self.orthonormal.chunks_exact(n).map(|q| self.fitted_dot(q, column)).collect::<Vec<f64>>();
        let mut upper = products.unwrap_or_else(|| project(column));
        let mut q = column.to_vec();
        self.subtract(&mut q, &upper);
        let mut left = self.fitted_dot(&q, &q);
        if left < CANCELLED * length {
            let again = project(&q);
            self.subtract(&mut q, &again);
            upper.iter_mut().zip(&again).for_each(|(r, correction)| *r += correction);
            left = self.fitted_dot(&q, &q);
        }
        // This form of the condition also rejects NaN.
        let independent = left > DEPENDENT * DEPENDENT * length;
        if !independent {
            return None;
        }
        let diagonal = left.sqrt();
        for value in &mut q {
            *value /= diagonal;
        }
        let projection = self.fitted_dot(&q, &self.residual);
        for ((residual, leverage), q) in self.residual.iter_mut().zip(&mut self.leverage).zip(&q) {
            *residual -= projection * q;
            *leverage += q * q;
        }
        self.extend_inverse(&upper, diagonal);
        self.projections.push(projection);
        self.orthonormal.extend_from_slice(&q);
        upper.push(diagonal);
        Some(upper)
    }

    /// Number of columns.
    pub fn terms(&self) -> usize {
        self.projections.len()
    }

    /// The last entry of Qᵀy.
    pub fn last_projection(&self) -> f64 {
        self.projections.last().copied().unwrap_or(0.0)
    }

    /// Coefficients β = R⁻¹ Qᵀy of the columns, `[P]`.
    pub fn coefficients(&self) -> Vec<f64> {
        let mut coefficients = vec![0.0; self.terms()];
        for (column, projection) in self.inverse.iter().zip(&self.projections) {
            for (coefficient, inverse) in coefficients.iter_mut().zip(column) {
                *coefficient += inverse * projection;
            }
        }
        coefficients
    }

    /// y minus the prediction at the runs held out, `[held_out]`.
    pub fn held_out_residual(&self) -> &[f64] {
        &self.residual[self.held_out.clone()]
    }

    /// Residual of each run in a fit to all other runs, e_i/(1 − h_i), `[n]`; infinite if the other runs do not determine the
    /// fit.
    pub fn leave_one_out(&self) -> Vec<f64> {
        let one = |(e, h): (&f64, &f64)| if 1.0 - h > DECISIVE { e / (1.0 - h) } else { f64::INFINITY };
        self.residual.iter().zip(&self.leverage).map(one).collect()
    }

    /// Corrected leave-one-out mean square error.
    ///
    /// ```text
    ///  ε = T · 1/n Σ (e_i/(1 − h_i))²,    T = n/(n − P) · (1 + tr (ΦᵀΦ)⁻¹)
    /// ```
    ///
    /// The factor T of Chapelle, Vapnik & Bengio (2002) corrects for choosing the P terms with the same runs.
    ///
    /// Source: Blatman & Sudret (2011), eqs. 15–17, where the trace is that of (ΦᵀΦ/n)⁻¹, divided by n.
    pub fn corrected_error(&self) -> f64 {
        let (n, terms) = (self.residual.len(), self.terms());
        if terms >= n {
            return f64::INFINITY;
        }
        let mut sum = 0.0;
        for (e, h) in self.residual.iter().zip(&self.leverage) {
            if 1.0 - h <= DECISIVE {
                return f64::INFINITY;
            }
            let missed = e / (1.0 - h);
            sum += missed * missed;
        }
        sum / (n - terms) as f64 * (1.0 + self.inverse_trace)
    }

    /// Leverage h of each run, `[n]`.
    pub fn leverage(&self) -> &[f64] {
        &self.leverage
    }

    /// Columns of R⁻¹, `[P][row]`, each from its first row to the diagonal.
    pub fn into_inverse(self) -> Vec<Vec<f64>> {
        self.inverse
    }

    /// The scalar product over the runs that are not held out.
    fn fitted_dot(&self, a: &[f64], b: &[f64]) -> f64 {
        let Range { start, end } = self.held_out;
        dot(&a[..start], &b[..start]) + dot(&a[end..], &b[end..])
    }

    /// `column` − Q·`products`.
    fn subtract(&self, column: &mut [f64], products: &[f64]) {
        subtract_multiples(column, &self.orthonormal, products);
    }

    /// Extends R⁻¹ by the column that belongs to a new column (`upper`, `diagonal`) of R.
    fn extend_inverse(&mut self, upper: &[f64], diagonal: f64) {
        let mut next = vec![0.0; upper.len() + 1];
        for (column, r) in self.inverse.iter().zip(upper) {
            subtract_multiple(&mut next[..column.len()], column, r / diagonal);
        }
        next[upper.len()] = 1.0 / diagonal;
        self.inverse_trace += dot(&next, &next);
        self.inverse.push(next);
    }
}

/// Scalar product by four independent partial sums, so that the processor does not wait for each addition.
pub(super) fn dot(a: &[f64], b: &[f64]) -> f64 {
    let (a_four, b_four) = (a.chunks_exact(4), b.chunks_exact(4));
    let rest: f64 = a_four.remainder().iter().zip(b_four.remainder()).map(|(a, b)| a * b).sum();
    let mut sums = [0.0; 4];
    for (a, b) in a_four.zip(b_four) {
        for lane in 0..4 {
            sums[lane] += a[lane] * b[lane];
        }
    }
    rest + (sums[0] + sums[1]) + (sums[2] + sums[3])
}

/// Subtracts from `a` each column of `columns` times its factor, four columns at a time, to read `a` less often.
pub(super) fn subtract_multiples(a: &mut [f64], columns: &[f64], factors: &[f64]) {
    let n = a.len();
    let (fours, rest) = (columns.chunks_exact(4 * n), columns.chunks_exact(4 * n).remainder());
    let done = fours.len() * 4;
    for (four, factor) in fours.zip(factors.chunks_exact(4)) {
        let (first, second) = four.split_at(2 * n);
        let ((b0, b1), (b2, b3)) = (first.split_at(n), second.split_at(n));
        for ((((a, b0), b1), b2), b3) in a.iter_mut().zip(b0).zip(b1).zip(b2).zip(b3) {
            *a -= (factor[0] * b0 + factor[1] * b1) + (factor[2] * b2 + factor[3] * b3);
        }
    }
    for (column, factor) in rest.chunks_exact(n).zip(&factors[done..]) {
        subtract_multiple(a, column, *factor);
    }
}

/// `a` − `factor`·`b`.
fn subtract_multiple(a: &mut [f64], b: &[f64], factor: f64) {
    for (a, b) in a.iter_mut().zip(b) {
        *a -= factor * b;
    }
}

#[cfg(test)]
mod tests {
    use rand::Rng as _;

    use super::*;
    use crate::stats;

    fn regression(columns: &[Vec<f64>], y: &[f64], skip: Option<usize>) -> Regression {
        let without = |values: &[f64]| -> Vec<f64> {
            values.iter().enumerate().filter(|(i, _)| Some(*i) != skip).map(|(_, v)| *v).collect()
        };
        let mut regression = Regression::new(&without(y));
        for column in columns {
            regression.push(&without(column), None).unwrap();
        }
        regression
    }

    #[test]
    fn the_leave_one_out_formula_equals_a_fit_without_the_run() {
        let mut stream = stats::stream(3, "regression test");
        let (n, terms) = (25, 7);
        // Powers of one variable: far from orthogonal, so that R matters.
        let x: Vec<f64> = (0..n).map(|_| stream.random_range(0.0..1.0)).collect();
        let columns: Vec<Vec<f64>> = (0..terms).map(|k| x.iter().map(|x| x.powi(k)).collect()).collect();
        let y: Vec<f64> = x.iter().map(|x| (5.0 * x).sin() + stream.random_range(-0.1..0.1)).collect();
        let formula = regression(&columns, &y, None).leave_one_out();
        let held_out = |run: usize| {
            let mut regression = Regression::without(&y, run..run + 1);
            for column in &columns {
                regression.push(column, None).unwrap();
            }
            regression.held_out_residual()[0]
        };
        for left_out in 0..n {
            let coefficients = regression(&columns, &y, Some(left_out)).coefficients();
            let predicted: f64 = coefficients.iter().zip(&columns).map(|(b, column)| b * column[left_out]).sum();
            let missed = y[left_out] - predicted;
            for other in [formula[left_out], held_out(left_out)] {
                assert!((missed - other).abs() < 1e-9 * (1.0 + missed.abs()), "{missed} {other}");
            }
        }
    }

    #[test]
    fn leverages_add_up_to_the_number_of_terms() {
        let columns = [vec![1.0; 5], vec![0.0, 1.0, 2.0, 5.0, 9.0]];
        let regression = regression(&columns, &[0.0; 5], None);
        assert!((regression.leverage().iter().sum::<f64>() - 2.0).abs() < 1e-14);
    }

    #[test]
    fn a_linearly_dependent_column_is_not_added() {
        let mut regression = Regression::new(&[1.0, 2.0, 4.0]);
        assert!(regression.push(&[1.0, 2.0, 3.0], None).is_some());
        assert!(regression.push(&[2.0, 4.0, 6.0], None).is_none());
        assert_eq!(regression.terms(), 1);
    }
}
