//! Bhattacharyya distance between measured and simulated samples, and the likelihood made of it.

use nalgebra::DMatrix;

/// A covariance matrix is singular if a pivot of its Cholesky factor is below this share of the variance.
const SINGULAR: f64 = 1e-12;

/// Mean and covariance of a sample, which define the normal distribution fitted to it.
#[derive(Debug, Clone, PartialEq)]
pub struct Moments {
    mean: Vec<f64>,
    /// Lower triangle, row by row, with divisor n − 1.
    covariance: Vec<f64>,
    /// ln det of the covariance; `None` if it is singular.
    log_determinant: Option<f64>,
}

impl Moments {
    /// Moments of a row-major matrix `[n, columns]`, computed in one pass.
    ///
    /// # Panics
    /// If the length is not a multiple of `columns`.
    pub fn from_rows(values: &[f64], columns: usize) -> Self {
        assert!(columns > 0 && values.len().is_multiple_of(columns), "{} values in rows of {columns}", values.len());
        let rows = (values.len() / columns) as f64;
        let mut mean = vec![0.0; columns];
        let mut covariance = vec![0.0; columns * (columns + 1) / 2];
        let mut shifted = vec![0.0; columns];
        let Some(first) = values.get(..columns) else { return Self { mean, covariance, log_determinant: None } };
        for row in values.chunks_exact(columns) {
            // Relative to the first row, because sums of squares of values far from zero would lose the spread to rounding.
            for ((s, value), origin) in shifted.iter_mut().zip(row).zip(first) {
                *s = value - origin;
            }
            let mut products = covariance.iter_mut();
            for (i, s) in shifted.iter().enumerate() {
                mean[i] += s;
                // In this order, because `zip` takes one more item from its left side when the right side has ended.
                for (other, product) in shifted[..=i].iter().zip(products.by_ref()) {
                    *product += s * other;
                }
            }
        }
        let mut products = covariance.iter_mut();
        for i in 0..columns {
            for j in 0..=i {
                let product = products.next().expect("the triangle has an entry for every pair");
                *product = (*product - mean[i] * mean[j] / rows) / (rows - 1.0);
            }
        }
        for (sum, origin) in mean.iter_mut().zip(first) {
            *sum = origin + *sum / rows;
        }
        let log_determinant = factorise(&mut covariance.clone(), columns);
        Self { mean, covariance, log_determinant }
    }

    /// Moments of the rows of a matrix, `[n, columns]`.
    pub fn from_matrix(rows: &DMatrix<f64>) -> Self {
        Self::from_rows(rows.transpose().as_slice(), rows.ncols())
    }

    /// Mean of each column, `[columns]`.
    pub fn mean(&self) -> &[f64] {
        &self.mean
    }

    /// Covariance with divisor n − 1, `[columns, columns]`.
    pub fn covariance(&self) -> DMatrix<f64> {
        let entry = |i: usize, j: usize| self.covariance[i.max(j) * (i.max(j) + 1) / 2 + i.min(j)];
        DMatrix::from_fn(self.mean.len(), self.mean.len(), entry)
    }

    /// Bhattacharyya distance between the two normal distributions; `None` if a covariance is singular.
    ///
    /// ```text
    ///  D_B = −ln ∫ √(p q) dy = ⅛ Δᵀ Σ̄⁻¹ Δ + ½ ln( det Σ̄ / √(det Σ₁ det Σ₂) ),    Σ̄ = (Σ₁ + Σ₂)/2
    /// ```
    ///
    /// It is 0 for equal distributions, symmetric, and invariant under any invertible linear map of both.
    ///
    /// Source: Bhattacharyya (1943); Kailath (1967) for normal distributions.
    ///
    /// # Panics
    /// If the numbers of columns differ.
    pub fn bhattacharyya(&self, other: &Self) -> Option<f64> {
        let columns = self.mean.len();
        assert_eq!(columns, other.mean.len(), "samples of the same quantities");
        let (own, theirs) = (self.log_determinant?, other.log_determinant?);
        let mut middle: Vec<f64> =
            self.covariance.iter().zip(&other.covariance).map(|(a, b)| f64::midpoint(*a, *b)).collect();
        let log_determinant = factorise(&mut middle, columns)?;
        // Δᵀ Σ̄⁻¹ Δ = |L⁻¹ Δ|².
        let mut y: Vec<f64> = self.mean.iter().zip(&other.mean).map(|(a, b)| a - b).collect();
        for i in 0..columns {
            let row = &middle[i * (i + 1) / 2..];
            let known: f64 = row.iter().zip(&y[..i]).map(|(l, y)| l * y).sum();
            y[i] = (y[i] - known) / row[i];
        }
        let shift: f64 = y.iter().map(|y| y * y).sum();
        // Rounding can make the distance of equal distributions slightly negative.
        Some((shift / 8.0 + 0.5 * (log_determinant - f64::midpoint(own, theirs))).max(0.0))
    }
}

/// [`Moments::bhattacharyya`] of the normal distributions fitted to the rows of two matrices, `[n, m]` and `[N, m]`; `None` if a
/// covariance is singular.
pub fn bhattacharyya(measured: &DMatrix<f64>, simulated: &DMatrix<f64>) -> Option<f64> {
    Moments::from_matrix(measured).bhattacharyya(&Moments::from_matrix(simulated))
}

/// Log-likelihood of a Bhattacharyya distance D_B, nats, up to a constant.
///
/// ```text
///  ln L = −D_B / ε²
/// ```
///
/// Source: Wang et al. (2025), Eq. 5, who write exp(−d²/ε²) for any distance d. Here D_B takes the place of d², because near zero
/// D_B is quadratic in the difference of the populations, like a squared Euclidean or Mahalanobis distance. L is then
/// approximately normal around the truth with a width of order ε. The square of D_B would be of fourth order and give a
/// posterior whose width decreases with n^-¼ instead of n^-½ at the ε² of [`epsilon_squared`].
pub fn log_likelihood(distance: f64, epsilon_squared: f64) -> f64 {
    -distance / epsilon_squared
}

/// The ε² = 1/(4n) for which [`log_likelihood`] is the likelihood of n = `rows` independent normal observations.
///
/// ```text
///  ln L(μ, Σ) relative to the fit N(ȳ, S) of the n observations:    −n·KL(N(ȳ, S) ‖ N(μ, Σ))
///  shift,  μ = ȳ + Δ:          KL = ½ Δᵀ S⁻¹ Δ,             D_B = ⅛ Δᵀ S⁻¹ Δ
///  spread, Σ = (1 + e)·S:      KL = m·(e²/4 + O(e³)),       D_B = m·(e²/16 + O(e³)),    m columns
/// ```
///
/// In both cases KL = 4 D_B, and also for any combination of shift and spread, because to second order both are multiples of the
/// same Fisher information. Hence ln L = −4n D_B near the truth; far from it the two differ.
pub fn epsilon_squared(rows: f64) -> f64 {
    0.25 / rows
}

/// Replaces a lower triangle by its Cholesky factor. Returns ln det of the matrix, or `None` if it is singular.
fn factorise(triangle: &mut [f64], size: usize) -> Option<f64> {
    let mut log_determinant = 0.0;
    for i in 0..size {
        let (above, row) = triangle.split_at_mut(i * (i + 1) / 2);
        for j in 0..i {
            let other = &above[j * (j + 1) / 2..];
            let known: f64 = row[..j].iter().zip(other).map(|(a, b)| a * b).sum();
            row[j] = (row[j] - known) / other[j];
        }
        let variance = row[i];
        let pivot = variance - row[..i].iter().map(|l| l * l).sum::<f64>();
        // This form of the condition also rejects NaN.
        let regular = variance > 0.0 && pivot > SINGULAR * variance && pivot.is_finite();
        if !regular {
            return None;
        }
        row[i] = pivot.sqrt();
        log_determinant += pivot.ln();
    }
    Some(log_determinant)
}
