//! The region covered by the runs, outside which the emulator would extrapolate.

use nalgebra::DMatrix;

use super::regression::{dot, Regression};

/// The leverage is that of a quadratic function if there are at least this many runs per term, otherwise of a linear one.
const RUNS_PER_TERM: usize = 10;

/// Tolerance for rounding errors of the box and of the largest leverage.
const ROUNDING: f64 = 1e-9;

/// The region covered by the runs: their box, restricted to points of small leverage h.
///
/// ```text
///  h(x) = φ(x)ᵀ (ΦᵀΦ)⁻¹ φ(x) ≤ max_i h_i/(1 − h_i)
/// ```
///
/// φ is quadratic if there are ten runs per term, and otherwise linear: with few runs per term all leverages are near 1 and
/// contain no information. h_i/(1 − h_i) is the leverage of run i in a table without it, which is comparable to that of a new
/// point. The source compares with max h_i instead. For many runs both are the same, but with two runs per term most points
/// between the runs exceed max h_i.
///
/// Source: Montgomery, Peck & Vining (2012), §3.8, the regressor variable hull.
#[derive(Debug, Clone)]
pub(super) struct Hull {
    quadratic: bool,
    /// Indices of the entries of φ that are linearly independent at the runs. The square of a parameter that has only two values,
    /// for example, is not.
    kept: Vec<usize>,
    /// Columns of R⁻¹, where Φ = QR.
    inverse: Vec<Vec<f64>>,
    /// max h_i/(1 − h_i).
    greatest: f64,
}

impl Hull {
    /// The region covered by the runs `x`, `[n, d]`, scaled to [−1, 1].
    pub fn new(x: &DMatrix<f64>) -> Self {
        let (runs, d) = x.shape();
        let quadratic = runs >= RUNS_PER_TERM * (d + 1) * (d + 2) / 2;
        let rows: Vec<Vec<f64>> = x.row_iter().map(|row| regressors(quadratic, d, |i| row[i])).collect();
        let mut regression = Regression::new(&vec![0.0; runs]);
        let mut kept = Vec::new();
        for term in 0..rows[0].len() {
            let column: Vec<f64> = rows.iter().map(|row| row[term]).collect();
            if regression.push(&column, None).is_some() {
                kept.push(term);
            }
        }
        let greatest = regression.leverage().iter().map(|h| h / (1.0 - h).max(f64::MIN_POSITIVE)).fold(0.0, f64::max);
        Self { quadratic, kept, inverse: regression.into_inverse(), greatest }
    }

    /// Whether a point `x`, `[d]`, scaled to [−1, 1], is outside; a point with NaN is.
    pub fn is_outside(&self, x: &[f64]) -> bool {
        let in_box = x.iter().all(|x| x.abs() <= 1.0 + ROUNDING);
        if !in_box {
            return true;
        }
        let all = regressors(self.quadratic, x.len(), |i| x[i]);
        let row: Vec<f64> = self.kept.iter().map(|&term| all[term]).collect();
        let leverage: f64 = self.inverse.iter().map(|column| dot(column, &row[..column.len()]).powi(2)).sum();
        leverage > self.greatest * (1.0 + ROUNDING)
    }
}

/// φ(x): 1, all x_i, and all x_i x_j if quadratic.
fn regressors(quadratic: bool, d: usize, x: impl Fn(usize) -> f64) -> Vec<f64> {
    let mut row: Vec<f64> = std::iter::once(1.0).chain((0..d).map(&x)).collect();
    if quadratic {
        row.extend((0..d).flat_map(|i| (0..=i).map(move |j| (i, j))).map(|(i, j)| x(i) * x(j)));
    }
    row
}
