//! A Gaussian process over inputs u, represented at support points.
//!
//! ```text
//!  k(u, u') = σ² ρ(r),   ρ(r) = (1 + √5 r + 5r²/3) exp(−√5 r),   r² = Σ_d ((u_d − u'_d)/ℓ_d)²
//!  R = ρ(Z, Z) = L Lᵀ,   φ(u) = L⁻¹ ρ(Z, u),   g(u) = σ φ(u)ᵀ v + σ √(1 − |φ(u)|²) ξ(u)
//! ```
//!
//! Z: support points; v: coefficients, N(0, 1) before and N(w, F Fᵀ) after the data; ξ: independent standard normal at each u. Before
//! the data, g has exactly the variance σ² everywhere. Far from the support points φ is 0: the mean returns to 0 and the variance to
//! σ².
//!
//! Source: Rasmussen and Williams (2006), Gaussian Processes for Machine Learning, §4.2 (Matérn); Quiñonero-Candela and Rasmussen
//! (2005), JMLR 6, 1939, for support points with the exact prior variance (fully independent training conditional).

use nalgebra::{DMatrix, DVector};

/// Added to the diagonal of R: points that are close together make it singular.
const JITTER: f64 = 1e-8;

/// Points of the inputs at which processes are represented, and which inputs are categories.
#[derive(Debug, Clone, PartialEq)]
pub struct Support {
    /// Z, standardised; a category as its index, `[points, inputs]`.
    points: DMatrix<f64>,
    /// Whether each input is a category, `[inputs]`: two values then differ by 1 or by 0.
    categories: Vec<bool>,
}

/// Matérn 5/2 correlation ρ, and −dρ/d(r²)·2, at a squared distance r².
fn matern(squared: f64) -> (f64, f64) {
    let s = (5.0 * squared).sqrt();
    let decay = (-s).exp();
    ((1.0 + s + s * s / 3.0) * decay, 5.0 / 3.0 * (1.0 + s) * decay)
}

impl Support {
    /// Support points Z, `[points, inputs]`.
    pub fn new(points: DMatrix<f64>, categories: Vec<bool>) -> Self {
        Self { points, categories }
    }

    /// The points, `[points, inputs]`.
    pub fn points(&self) -> &DMatrix<f64> {
        &self.points
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.points.nrows()
    }

    /// Whether there is no point.
    pub fn is_empty(&self) -> bool {
        self.points.nrows() == 0
    }

    /// Difference of two values of one input, before it is divided by the length.
    fn difference(&self, input: usize, a: f64, b: f64) -> f64 {
        if self.categories[input] {
            f64::from(u8::from((a - b).abs() > 0.5))
        } else {
            a - b
        }
    }

    /// Squared distance r² of two points, `[inputs]` each, for correlation lengths `[inputs]`.
    pub fn squared_distance(&self, a: &[f64], b: &[f64], lengths: &[f64]) -> f64 {
        let one = |(input, length): (usize, &f64)| (self.difference(input, a[input], b[input]) / length).powi(2);
        lengths.iter().enumerate().map(one).sum()
    }

    /// ρ(Z, u), `[points]`.
    fn correlations(&self, u: &[f64], lengths: &[f64]) -> DVector<f64> {
        DVector::from_fn(self.len(), |point, _| {
            let one =
                |input: usize| (self.difference(input, self.points[(point, input)], u[input]) / lengths[input]).powi(2);
            matern((0..lengths.len()).map(one).sum()).0
        })
    }

    /// ρ(Z, U), `[points, rows]`, and its derivative by the logarithm of each length, `[inputs]` such matrices. `rows`: U,
    /// `[rows][inputs]`.
    pub fn correlations_of(&self, rows: &[&[f64]], lengths: &[f64]) -> (DMatrix<f64>, Vec<DMatrix<f64>>) {
        let (points, inputs) = (self.len(), lengths.len());
        let mut values = DMatrix::zeros(points, rows.len());
        let mut slopes = vec![DMatrix::zeros(points, rows.len()); inputs];
        let mut squares = vec![0.0; inputs];
        for (column, u) in rows.iter().enumerate() {
            for point in 0..points {
                for (input, square) in squares.iter_mut().enumerate() {
                    *square = (self.difference(input, self.points[(point, input)], u[input]) / lengths[input]).powi(2);
                }
                let (value, slope) = matern(squares.iter().sum());
                values[(point, column)] = value;
                for (slopes, square) in slopes.iter_mut().zip(&squares) {
                    slopes[(point, column)] = slope * square;
                }
            }
        }
        (values, slopes)
    }

    /// ρ(Z, Z) and its derivatives, as [`Self::correlations_of`], with the addition that keeps it positive definite.
    pub fn own_correlations(&self, lengths: &[f64]) -> (DMatrix<f64>, Vec<DMatrix<f64>>) {
        let rows: Vec<Vec<f64>> = self.points.row_iter().map(|row| row.iter().copied().collect()).collect();
        let rows: Vec<&[f64]> = rows.iter().map(Vec::as_slice).collect();
        let (mut values, slopes) = self.correlations_of(&rows, lengths);
        for point in 0..self.len() {
            values[(point, point)] += JITTER;
        }
        (values, slopes)
    }

    /// L, `[points, points]`; `None` if the correlations are not finite.
    fn factor(&self, lengths: &[f64]) -> Option<DMatrix<f64>> {
        Some(self.own_correlations(lengths).0.cholesky()?.l())
    }
}

/// The process of one mode, after the data.
#[derive(Debug, Clone, PartialEq)]
pub struct Process {
    /// σ: prior standard deviation of g.
    std: f64,
    lengths: Vec<f64>,
    /// L, `[points, points]`.
    basis: DMatrix<f64>,
    /// w: mean of the coefficients, `[points]`.
    weights: DVector<f64>,
    /// F: lower triangular factor of their covariance, `[points, points]`.
    factor: DMatrix<f64>,
}

/// Mean and variance of g at one u.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Moments {
    /// Mean of g, a difference in ln f.
    pub mean: f64,
    /// Variance of g.
    pub variance: f64,
}

impl Process {
    /// A process over `support`, with coefficients of mean `weights`, `[points]`, and covariance F Fᵀ, F = `factor`,
    /// `[points, points]`. `None` if a length is not valid.
    pub fn new(
        support: &Support,
        std: f64,
        lengths: Vec<f64>,
        weights: DVector<f64>,
        factor: DMatrix<f64>,
    ) -> Option<Self> {
        let basis = support.factor(&lengths)?;
        Some(Self { std, lengths, basis, weights, factor })
    }

    /// σ: prior standard deviation of g.
    pub fn std(&self) -> f64 {
        self.std
    }

    /// Basis φ(u), `[points]`.
    fn basis(&self, support: &Support, u: &[f64]) -> DVector<f64> {
        let correlations = support.correlations(u, &self.lengths);
        self.basis.solve_lower_triangular(&correlations).expect("a Cholesky factor has no zero on its diagonal")
    }

    /// Share of the prior variance that the support points do not determine: 1 − |φ|².
    fn remaining(basis: &DVector<f64>) -> f64 {
        (1.0 - basis.norm_squared()).max(0.0)
    }

    /// Mean and variance of g at u, `[inputs]`.
    ///
    /// ```text
    ///  E g = σ φᵀw,    var g = σ² (1 − |φ|² + |Fᵀφ|²)
    /// ```
    pub fn at(&self, support: &Support, u: &[f64]) -> Moments {
        let basis = self.basis(support, u);
        let known = self.factor.tr_mul(&basis).norm_squared();
        Moments {
            mean: self.std * basis.dot(&self.weights),
            variance: self.std.powi(2) * (Self::remaining(&basis) + known),
        }
    }

    /// g where u is not known: mean 0 and the prior variance.
    pub fn unknown(&self) -> Moments {
        Moments { mean: 0.0, variance: self.std.powi(2) }
    }

    /// Coefficients v = w + F z of one function drawn from the posterior, for standard normal `z`, `[points]`.
    pub fn coefficients(&self, z: &DVector<f64>) -> DVector<f64> {
        &self.weights + &self.factor * z
    }

    /// The function with coefficients v at u, with the standard normal `xi` for what the support points do not determine.
    pub fn value(&self, support: &Support, u: &[f64], coefficients: &DVector<f64>, xi: f64) -> f64 {
        let basis = self.basis(support, u);
        self.std * (basis.dot(coefficients) + Self::remaining(&basis).sqrt() * xi)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn line(points: usize) -> Support {
        Support::new(DMatrix::from_fn(points, 1, |i, _| i as f64), vec![false])
    }

    /// Mean and variance with observed values at the support points, by the textbook formula with dense matrices, which the
    /// representation by coefficients must reproduce.
    #[test]
    fn moments_are_those_of_gaussian_process_regression() {
        let (support, std, length, noise) = (line(5), 0.3, 1.7, 0.1);
        let y = DVector::from_vec(vec![0.2, -0.1, 0.4, 0.3, -0.2]);
        let k = |a: f64, b: f64| {
            let s = 5.0_f64.sqrt() * (a - b).abs() / length;
            std * std * (1.0 + s + s * s / 3.0) * (-s).exp()
        };
        let dense = DMatrix::from_fn(5, 5, |i, j| k(i as f64, j as f64) + if i == j { noise * noise } else { 0.0 });
        let inverse = dense.try_inverse().unwrap();
        // The coefficients v after the data: y = σ L v + noise.
        let design = support.factor(&[length]).unwrap() * std;
        let precision = design.tr_mul(&design) / (noise * noise) + DMatrix::identity(5, 5);
        let covariance = precision.try_inverse().unwrap();
        let weights = &covariance * design.tr_mul(&y) / (noise * noise);
        let factor = covariance.cholesky().unwrap().l();
        let process = Process::new(&support, std, vec![length], weights, factor).unwrap();
        for u in [-3.0, 0.0, 0.4, 2.5, 7.0] {
            let across = DVector::from_fn(5, |i, _| k(i as f64, u));
            let (mean, variance) =
                ((across.transpose() * &inverse * &y)[0], k(u, u) - (across.transpose() * &inverse * &across)[0]);
            let found = process.at(&support, &[u]);
            // The addition to the diagonal of R is 1e-8.
            assert!((found.mean - mean).abs() < 1e-6 && (found.variance - variance).abs() < 1e-7, "{u}: {found:?}");
        }
    }

    #[test]
    fn far_from_the_support_points_the_prior_returns() {
        let support = line(4);
        let weights = DVector::from_element(4, 1.0);
        let process = Process::new(&support, 0.2, vec![1.0], weights, DMatrix::zeros(4, 4)).unwrap();
        let far = process.at(&support, &[60.0]);
        assert!(far.mean.abs() < 1e-12 && (far.variance - 0.04).abs() < 1e-12, "{far:?}");
        assert_eq!(process.unknown(), Moments { mean: 0.0, variance: 0.2 * 0.2 });
        assert!(process.at(&support, &[1.0]).variance < 1e-6);
    }

    #[test]
    fn derivatives_by_the_lengths_are_those_of_finite_differences() {
        let points = DMatrix::from_row_slice(3, 2, &[0.0, 0.0, 0.7, 1.0, -1.2, 2.0]);
        let support = Support::new(points, vec![false, true]);
        let (lengths, rows): ([f64; 2], [&[f64]; 2]) = ([0.8, 1.5], [&[0.3, 1.0], &[-0.4, 0.0]]);
        let (_, slopes) = support.correlations_of(&rows, &lengths);
        for (input, slope) in slopes.iter().enumerate() {
            let moved = |by: f64| {
                let mut lengths = lengths;
                lengths[input] *= by.exp();
                support.correlations_of(&rows, &lengths).0
            };
            let difference = (moved(1e-5) - moved(-1e-5)) / 2e-5;
            assert!((difference - slope).amax() < 1e-8, "input {input}");
        }
    }
}
