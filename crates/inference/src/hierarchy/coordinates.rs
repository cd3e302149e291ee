//! Coordinates of a normal population about the most probable one, in which its posterior is close to normal.

use nalgebra::DMatrix;

use super::normal::{Moments, Normal};
use super::small::{SmallMatrix, SmallVector};

/// Step of the differences by which the prior is differentiated.
const STEP: f64 = 1e-3;

/// Largest share of the information on any direction that is regarded as missing because of the noise of the measurements.
const MOST_MISSING: f64 = 0.995;

/// Coordinates θ = (a, u, b) of a population N(μ, Σ) about N(μ̂, Σ̂). They are those of the distribution of the measured values,
/// N(μ, M) with M = Σ + W, where W is the covariance of the noise:
///
/// ```text
///  M̂⁻¹ = Σ̂⁻¹ − Σ̂⁻¹ C Σ̂⁻¹,    W = M̂ − Σ̂,    C = 1/n Σ_j cov_w(x_j)    (C_j⁻¹ = W_j⁻¹ + Σ̂⁻¹ for normal posteriors)
///  M = B (Uᵀ U)⁻¹ Bᵀ,    μ = μ̂ + B U⁻¹ a,    M̂ = B Bᵀ,    B lower triangular
///  U lower triangular with U_kk = exp(−u_k), U_kl = b_kl for l < k
/// ```
///
/// θ = 0 is N(μ̂, Σ̂). Where all measurements have the same normal noise, their likelihood is that of values drawn from N(μ, M):
/// a and b are normal, independent of u, with variance 1/n, and each u_k is the logarithm of the root of an inverse gamma
/// variable with variance about 1/2n. This is the regression of each measured value on those before it.
///
/// Prior: each μ_k uniform in the unit box, each standard deviation σ_k uniform where it is small compared with the noise, and the
/// correlation matrix R such that each correlation alone is uniform between −1 and 1:
///
/// ```text
///  p(σ_k) ∝ (σ_k² + W_kk)^(−(d−1)/8),    p(R) ∝ |R|^(d(d−1)/2 − 1) Π_k |R_−k|^(−(d+1)/2)
///  equivalent to   p(Σ) ∝ |Σ|^−(d+1) Π_k (Σ⁻¹)_kk^(−(d+1)/2) σ_k p(σ_k)
/// ```
///
/// R_−k: R without row and column k. With a uniform σ_k, the unknown correlations would make the posterior of σ_k² too large by the
/// factor 1 + (d − 1)(1 − R_k²)/n, where R_k² is the share of the variance of parameter k that the others explain. The exponent is
/// a quarter of that which would remove this for R_k² = 0; more would make the correlations too small. For d = 1 it is 0.
///
/// Source: J. Barnard, R. McCulloch, X.-L. Meng (2000), Modeling covariance matrices in terms of standard deviations and
/// correlations, with application to shrinkage, Statistica Sinica 10, 1281–1311.
pub(super) struct Coordinates {
    size: usize,
    mean: SmallVector,
    /// B.
    scale: SmallMatrix,
    /// W.
    noise: SmallMatrix,
}

impl Coordinates {
    /// Coordinates about `centre`. `within`: C.
    pub fn about(centre: &Normal, within: &SmallMatrix) -> Option<Self> {
        let d = centre.size();
        // In the coordinates in which Σ̂ is the identity, M̂ = (1 − K)⁻¹ with K = V̂ C V̂ᵀ.
        let missing = centre.root.times(within).times(&centre.root.transposed());
        let missing = DMatrix::from_fn(d, d, |i, j| missing.rows[i][j]).symmetric_eigen();
        let gains = missing.eigenvalues.map(|share| 1.0 / (1.0 - share.clamp(0.0, MOST_MISSING)) - 1.0);
        let vectors = &missing.eigenvectors;
        let noise = |i: usize, j: usize| (0..d).map(|m| vectors[(i, m)] * gains[m] * vectors[(j, m)]).sum::<f64>();
        let back = centre.root.lower_inverse();
        let noise = back.times(&SmallMatrix::from_fn(d, noise)).times(&back.transposed());
        let measured = SmallMatrix::from_fn(d, |i, j| centre.covariance.rows[i][j] + noise.rows[i][j]);
        Some(Self { size: d, mean: centre.mean, scale: measured.cholesky()?, noise })
    }

    /// Number of coordinates, d + d + d (d − 1)/2.
    pub fn count(&self) -> usize {
        2 * self.size + self.size * (self.size - 1) / 2
    }

    /// Row of b_kl, l < k.
    fn cross(&self, k: usize, l: usize) -> usize {
        2 * self.size + k * (k - 1) / 2 + l
    }

    /// The population at θ, `[count]`; `None` where its Σ is not positive definite.
    pub fn population(&self, theta: &[f64]) -> Option<Normal> {
        let d = self.size;
        let entry = |k: usize, l: usize| match k.cmp(&l) {
            std::cmp::Ordering::Less => 0.0,
            std::cmp::Ordering::Equal => (-theta[d + k]).exp(),
            std::cmp::Ordering::Greater => theta[self.cross(k, l)],
        };
        let back = self.scale.times(&SmallMatrix::from_fn(d, entry).lower_inverse());
        let shift = back.apply(&std::array::from_fn(|k| if k < d { theta[k] } else { 0.0 }));
        let measured = back.squared();
        let covariance = SmallMatrix::from_fn(d, |k, l| measured.rows[k][l] - self.noise.rows[k][l]);
        Normal::new(std::array::from_fn(|k| self.mean[k] + shift[k]), &covariance)
    }

    /// The coordinates of a population, `[count]`; `None` where its covariance is singular.
    pub fn of(&self, normal: &Normal) -> Option<Vec<f64>> {
        let (d, own) = (self.size, self.scale.lower_inverse());
        let measured = SmallMatrix::from_fn(d, |k, l| normal.covariance.rows[k][l] + self.noise.rows[k][l]);
        let root = own.times(&measured).times(&own.transposed()).cholesky()?.lower_inverse();
        let mean = root.times(&own).apply(&std::array::from_fn(|k| normal.mean[k] - self.mean[k]));
        let mut theta = mean[..d].to_vec();
        theta.extend((0..d).map(|k| -root.rows[k][k].ln()));
        theta.extend((0..d).flat_map(|k| (0..k).map(move |l| (k, l))).map(|(k, l)| root.rows[k][l]));
        Some(theta)
    }

    /// Places of a_k, u_k and b_kl for all l < k, each with its information for one measurement.
    pub fn of_row(&self, k: usize) -> Vec<(usize, f64)> {
        let crosses = (0..k).map(|l| (self.cross(k, l), 1.0));
        [(k, 1.0), (self.size + k, 2.0)].into_iter().chain(crosses).collect()
    }

    /// Logarithm of Π σ_k p(σ_k), up to a constant.
    pub fn log_prior_of_stds(&self, normal: &Normal) -> f64 {
        let exponent = -0.125 * (self.size - 1) as f64;
        let one = |k: usize| {
            let variance = normal.covariance.rows[k][k];
            0.5 * variance.ln() + exponent * (variance + self.noise.rows[k][k]).ln()
        };
        (0..self.size).map(one).sum()
    }

    /// Logarithm of the prior density of θ, up to a constant. `normal`: the population at θ.
    ///
    /// The volume elements are dμ ∝ Π exp(u_k) da and dΣ = dM ∝ Π_k exp((2d + 1 − k) u_k) du db, k from 1.
    pub fn log_prior(&self, theta: &[f64], normal: &Normal) -> f64 {
        let (d, precision) = (self.size, normal.precision());
        // |Σ|^−(d+1) = |V|^(2d+2)
        let mut log = 2.0 * (d + 1) as f64 * normal.log_root + self.log_prior_of_stds(normal);
        for k in 0..d {
            log += (2 * d + 1 - k) as f64 * theta[d + k];
            log -= 0.5 * (d + 1) as f64 * precision.rows[k][k].ln();
        }
        log
    }

    /// Gradient of the log-prior at θ = 0, `[count]`; 0 where the population is not defined on both sides.
    fn prior_gradient(&self) -> Vec<f64> {
        let log_prior = |row: usize, step: f64| {
            let mut theta = vec![0.0; self.count()];
            theta[row] = step;
            self.population(&theta).map(|normal| self.log_prior(&theta, &normal))
        };
        let both = |row: usize| Some(log_prior(row, STEP)? - log_prior(row, -STEP)?);
        (0..self.count()).map(|row| both(row).map_or(0.0, |difference| difference / (2.0 * STEP))).collect()
    }

    /// Mean and standard deviation of each coordinate in normal approximation, both `[count]`. `moments`: those under the weights
    /// of the centre N(μ̂, Σ̂), from n measurements.
    ///
    /// ```text
    ///  θ̂ = H⁻¹ ∇(ln L + ln p),    H = n (a, b), 2n (u)
    ///  ∂ ln L/∂μ = Σ̂⁻¹ Σ_j E_j (x − μ̂),    ∂ ln L/∂Σ = ½ Σ̂⁻¹ [Σ_j E_j (x − μ̂)(x − μ̂)ᵀ − n Σ̂] Σ̂⁻¹
    /// ```
    pub fn approximation(&self, centre: &Normal, moments: &Moments, n: f64) -> (Vec<f64>, Vec<f64>) {
        let (d, precision) = (self.size, centre.precision());
        let excess = |k: usize, l: usize| moments.second.rows[k][l] - n * centre.covariance.rows[k][l];
        let slope = precision.times(&SmallMatrix::from_fn(d, excess)).times(&precision);
        // Derivatives with respect to M = B (1 + 2 diag u − b − bᵀ) Bᵀ at θ = 0.
        let slope = self.scale.transposed().times(&slope).times(&self.scale);
        let of_mean = self.scale.transposed().apply(&precision.apply(&moments.first));
        let (mut gradient, mut information) = (self.prior_gradient(), vec![n; self.count()]);
        for k in 0..d {
            gradient[k] += of_mean[k];
            gradient[d + k] += slope.rows[k][k];
            information[d + k] = 2.0 * n;
            for l in 0..k {
                gradient[self.cross(k, l)] -= slope.rows[k][l];
            }
        }
        let mean = gradient.iter().zip(&information).map(|(g, h)| g / h).collect();
        (mean, information.iter().map(|h| h.sqrt().recip()).collect())
    }
}
