//! How far the runs reach: where the emulator would extrapolate.

use nalgebra::DMatrix;

use super::regression::{dot, Regression};

/// Runs per term from which the leverage is that of a quadratic function; below, of a linear one.
const RUNS_PER_TERM: usize = 10;

/// Excess over the box or over the greatest leverage that is rounding.
const ROUNDING: f64 = 1e-9;

/// The box of the runs, and within it the region that their leverages tell.
///
/// ```text
///  h(x) = φ(x)ᵀ (ΦᵀΦ)⁻¹ φ(x) ≤ max_i h_i/(1 − h_i)
/// ```
///
/// φ is quadratic where there are ten runs per term of it, and linear otherwise: with few runs per term all leverages come
/// near 1 and say nothing. h_i/(1 − h_i) is the leverage run i has on a table without it, as a fresh point has; the source
/// compares with max h_i itself, which many runs make the same, and which with two runs per term lies below most points
/// between the runs.
///
/// Source: Montgomery, Peck & Vining (2012), §3.8, the regressor variable hull.
#[derive(Debug, Clone)]
pub(super) struct Hull {
    quadratic: bool,
    /// Which entries of φ are independent at the runs: the square of a parameter run at two values is not.
    kept: Vec<usize>,
    /// Columns of R⁻¹, Φ = QR.
    inverse: Vec<Vec<f64>>,
    greatest: f64,
}

impl Hull {
    /// `x`: the runs, `[n, d]`, scaled to [−1, 1].
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

    /// Whether a point, `[d]`, scaled to [−1, 1], lies outside; one that is not a number does.
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
