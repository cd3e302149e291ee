//! An effect whose sizes have a mixture of normal priors, of which a fit uses a single wide one.
//!
//! With the posterior N(ẑ, P) under the prior N(0, T) of the fit, the data hold the information A = P⁻¹ − T⁻¹ and b = P⁻¹ẑ on the sizes z,
//! and for another prior N(0, Z) the evidence follows in closed form:
//!
//! ```text
//!  ln E(Z) = const + ½ bᵀ (I + Z A)⁻¹ Z b − ½ ln|I + Z A|
//! ```

use nalgebra::{DMatrix, DVector};

/// Priors of the sizes of an effect, of which each is equally probable.
#[derive(Debug, Clone, PartialEq)]
pub struct Mixture {
    /// Standard deviation √T of each size in a fit.
    pub(super) std: f64,
    /// Smallest standard deviation of a size in the priors, about.
    pub(super) least_std: f64,
    /// Covariances Z, `[z, z]` each.
    pub(super) priors: Vec<DMatrix<f64>>,
}

impl Mixture {
    /// Log evidence of the mixture minus that of the prior in the fit, nats. `psi` and `covariance`: posterior mean and covariance of
    /// the sizes in the fit. `None` if the posterior is singular.
    pub(super) fn log_ratio(&self, psi: &[f64], covariance: &DMatrix<f64>) -> Option<f64> {
        let known = Known::new(self, psi, covariance)?;
        let in_fit = known.log_evidence(&(DMatrix::identity(psi.len(), psi.len()) * self.std.powi(2)))?;
        let all = self.priors.iter().map(|prior| known.log_evidence(prior)).collect::<Option<Vec<f64>>>()?;
        Some(log_sum(all.iter().copied()) - (all.len() as f64).ln() - in_fit)
    }

    /// Log density of the deviation that a fit needs, up to a constant that is the same for all fits, nats:
    ///
    /// ```text
    ///  ln mean_Z ∫ N(z; 0, Z) N(ẑ; z, A⁻¹) dz
    /// ```
    ///
    /// where the prior of the fit is counted to the data, so that A + T⁻¹ = P⁻¹ has an inverse. Unlike the evidence it does not contain
    /// how well the fit explains the scatter of the rows. `None` if the posterior is singular.
    pub(super) fn log_density(&self, psi: &[f64], covariance: &DMatrix<f64>) -> Option<f64> {
        let known = Known::new(self, psi, covariance)?;
        let factor = ((covariance + covariance.transpose()) * 0.5).cholesky()?;
        let half_log_det: f64 = factor.l_dirty().diagonal().iter().map(|l| l.ln()).sum();
        let distance = known.score.dot(&DVector::from_column_slice(psi));
        let all = self.priors.iter().map(|prior| known.log_evidence(prior)).collect::<Option<Vec<f64>>>()?;
        Some(log_sum(all.iter().copied()) - 0.5 * distance - half_log_det)
    }

    /// Posterior mean and covariance of the sizes under the most probable prior of the mixture; `None` if the posterior is singular.
    pub(super) fn posterior(&self, psi: &[f64], covariance: &DMatrix<f64>) -> Option<(DVector<f64>, DMatrix<f64>)> {
        let known = Known::new(self, psi, covariance)?;
        let evidence = |prior: &DMatrix<f64>| known.log_evidence(prior).unwrap_or(f64::NEG_INFINITY);
        let best = self.priors.iter().max_by(|a, b| evidence(a).total_cmp(&evidence(b)))?;
        Some((known.mean(best)?, known.grown(best).lu().solve(best)?))
    }

    /// Upper bound of [`Self::log_ratio`], nats.
    pub(super) fn most_nats(&self) -> f64 {
        let sizes = self.priors.first().map_or(0, DMatrix::nrows);
        sizes as f64 * (self.std / self.least_std).ln()
    }
}

/// What data say about the sizes z.
struct Known {
    /// A, `[z, z]`.
    information: DMatrix<f64>,
    /// b, `[z]`.
    score: DVector<f64>,
}

impl Known {
    fn new(mixture: &Mixture, psi: &[f64], covariance: &DMatrix<f64>) -> Option<Self> {
        let inverse = ((covariance + covariance.transpose()) * 0.5).try_inverse()?;
        let mut score = &inverse * DVector::from_column_slice(psi);
        let mut information = inverse - DMatrix::identity(psi.len(), psi.len()) * mixture.std.powi(-2);
        // Second derivatives of a few rows may let data seem to hold less than nothing on a direction: they then hold nothing on it.
        let eigen = information.clone().symmetric_eigen();
        for (direction, value) in
            eigen.eigenvectors.column_iter().zip(&eigen.eigenvalues).filter(|(_, value)| **value < 0.0)
        {
            information -= direction * direction.transpose() * *value;
            score -= direction * direction.dot(&score);
        }
        Some(Self { information, score })
    }

    /// Log evidence under the prior N(0, Z), up to a constant, nats.
    fn log_evidence(&self, prior: &DMatrix<f64>) -> Option<f64> {
        let explained = 0.5 * self.score.dot(&self.mean(prior)?);
        let determinant = self.grown(prior).determinant();
        (determinant > 0.0).then(|| explained - 0.5 * determinant.ln())
    }

    /// Posterior mean of the sizes under the prior N(0, Z): (I + Z A)⁻¹ Z b.
    fn mean(&self, prior: &DMatrix<f64>) -> Option<DVector<f64>> {
        self.grown(prior).lu().solve(&(prior * &self.score))
    }

    /// I + Z A
    fn grown(&self, prior: &DMatrix<f64>) -> DMatrix<f64> {
        DMatrix::identity(prior.nrows(), prior.nrows()) + prior * &self.information
    }
}

/// ln Σ exp(values); −∞ for no values.
pub(super) fn log_sum(values: impl Iterator<Item = f64>) -> f64 {
    let values: Vec<f64> = values.collect();
    let largest = values.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    if largest.is_finite() {
        largest + values.iter().map(|v| (v - largest).exp()).sum::<f64>().ln()
    } else {
        f64::NEG_INFINITY
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn mixture(stds: &[f64], sizes: usize) -> Mixture {
        let prior = |std: &f64| DMatrix::identity(sizes, sizes) * std.powi(2);
        Mixture { std: 0.5, least_std: stds[0], priors: stds.iter().map(prior).collect() }
    }

    #[test]
    fn the_evidence_of_a_mixture_is_that_by_integration() {
        // One size with the likelihood N(z; 0.03, 0.01²).
        let (likelihood, stds) = (|z: f64| (-0.5 * ((z - 0.03) / 0.01).powi(2)).exp(), [0.01, 0.05, 0.2]);
        let density = |z: f64, std: f64| (-0.5 * (z / std).powi(2)).exp() / std / std::f64::consts::TAU.sqrt();
        let integral = |std: f64| -> f64 {
            let step = 1e-5;
            (-20_000..20_000).map(|i| f64::from(i) * step).map(|z| likelihood(z) * density(z, std) * step).sum()
        };
        let wanted = (stds.iter().map(|std| integral(*std)).sum::<f64>() / 3.0 / integral(0.5)).ln();
        let precision = 0.01_f64.powi(-2) + 0.5_f64.powi(-2);
        let covariance = DMatrix::from_element(1, 1, 1.0 / precision);
        let found = mixture(&stds, 1).log_ratio(&[0.03 * 0.01_f64.powi(-2) / precision], &covariance).unwrap();
        assert!((found - wanted).abs() < 1e-6, "{found} {wanted}");
    }

    #[test]
    fn a_direction_with_less_information_than_none_counts_as_one_without_data() {
        let stds = [0.01, 0.05];
        let own = DMatrix::from_element(1, 1, 1e-4);
        let alone = mixture(&stds, 1).log_ratio(&[0.04], &own).unwrap();
        // The posterior of the second size is wider than its prior in the fit.
        let both = DMatrix::from_diagonal(&DVector::from_column_slice(&[1e-4, 0.3]));
        let found = mixture(&stds, 2).log_ratio(&[0.04, 0.1], &both).unwrap();
        assert!((found - alone).abs() < 1e-9, "{found} {alone}");
    }
}
