//! The distributions from which adaptive importance sampling draws in the latent space of the flow.

use nalgebra::{Cholesky, DMatrix, DVector};
use rand::Rng as _;
use rand_distr::{ChiSquared, Distribution as _, StandardNormal};
use statrs::function::gamma::ln_gamma;

use structures::stats::Stream;

/// Degrees of freedom ν of the proposals: their heavy tails keep the weights bounded where the fit is too narrow.
const DEGREES_OF_FREEDOM: f64 = 5.0;

/// Distribution of z from which a stage draws.
pub(super) struct Proposal {
    pub(super) mean: DVector<f64>,
    /// Lower Cholesky factor of S.
    root: DMatrix<f64>,
    /// Logarithm of the density at the mean, plus that of the number of draws.
    log_peak: f64,
    /// ν of a Student distribution; `None` for a normal one.
    degrees_of_freedom: Option<f64>,
}

impl Proposal {
    /// N(0, I).
    pub(super) fn of_flow(d: usize) -> Self {
        let log_peak = -0.5 * d as f64 * (2.0 * std::f64::consts::PI).ln();
        Self { mean: DVector::zeros(d), root: DMatrix::identity(d, d), log_peak, degrees_of_freedom: None }
    }

    /// t_ν(m, S); `None` where S is not positive definite.
    pub(super) fn student(mean: DVector<f64>, covariance: DMatrix<f64>) -> Option<Self> {
        let d = mean.len() as f64;
        let nu = DEGREES_OF_FREEDOM;
        let root = Cholesky::new(covariance)?.unpack();
        let log_volume: f64 = root.diagonal().iter().map(|entry| entry.ln()).sum();
        let log_peak =
            ln_gamma(0.5 * (nu + d)) - ln_gamma(0.5 * nu) - 0.5 * d * (nu * std::f64::consts::PI).ln() - log_volume;
        log_peak.is_finite().then_some(Self { mean, root, log_peak, degrees_of_freedom: Some(nu) })
    }

    /// Logarithm of the density at z, nats.
    pub(super) fn log_density(&self, z: &[f64]) -> f64 {
        let d = self.mean.len();
        let mut squares = 0.0;
        let mut standard = [0.0; super::start::MANY_PARAMETERS];
        for i in 0..d {
            let known: f64 = (0..i).map(|j| self.root[(i, j)] * standard[j]).sum();
            standard[i] = (z[i] - self.mean[i] - known) / self.root[(i, i)];
            squares += standard[i] * standard[i];
        }
        match self.degrees_of_freedom {
            None => self.log_peak - 0.5 * squares,
            Some(nu) => self.log_peak - 0.5 * (nu + d as f64) * (squares / nu).ln_1p(),
        }
    }

    pub(super) fn draw(&self, stream: &mut Stream) -> DVector<f64> {
        let d = self.mean.len();
        let normal = DVector::from_fn(d, |_, _| stream.sample::<f64, _>(StandardNormal));
        let stretch = self.degrees_of_freedom.map_or(1.0, |nu| {
            let chi_squared: f64 = ChiSquared::new(nu).expect("ν is positive").sample(stream);
            (nu / chi_squared).sqrt()
        });
        &self.mean + &self.root * normal * stretch
    }
}

#[cfg(test)]
mod tests {
    use statrs::distribution::{Continuous as _, StudentsT};

    use super::*;

    #[test]
    fn the_density_of_a_proposal_is_that_of_the_student_distribution() {
        let proposal = Proposal::student(DVector::from_element(1, 2.0), DMatrix::from_element(1, 1, 0.09)).unwrap();
        let student = StudentsT::new(2.0, 0.3, DEGREES_OF_FREEDOM).unwrap();
        for z in [-1.0, 1.7, 2.0, 2.4, 9.0] {
            assert!((proposal.log_density(&[z]) - student.ln_pdf(z)).abs() < 1e-10, "{z}");
        }
        // Two independent directions under a rotation: |z − m| in the metric of S is what counts.
        let covariance = DMatrix::from_row_slice(2, 2, &[1.0, 0.6, 0.6, 1.0]);
        let proposal = Proposal::student(DVector::zeros(2), covariance.clone()).unwrap();
        let at = |z: [f64; 2]| {
            let z = DVector::from_row_slice(&z);
            let distance = z.dot(&(covariance.clone().try_inverse().unwrap() * &z));
            // For two dimensions the normaliser is 1/(2π √|S|).
            -(2.0 * std::f64::consts::PI).ln()
                - 0.5 * covariance.determinant().ln()
                - 0.5 * (DEGREES_OF_FREEDOM + 2.0) * (distance / DEGREES_OF_FREEDOM).ln_1p()
        };
        for z in [[0.0, 0.0], [1.0, -1.0], [3.0, 2.0]] {
            assert!((proposal.log_density(&z) - at(z)).abs() < 1e-10, "{z:?}");
        }
    }
}
