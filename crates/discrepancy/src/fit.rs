//! The result of a fit, and the point where a fit starts.

use nalgebra::DMatrix;

use super::effect::FittedEffect;
use super::outside::Outside;

/// The posterior maximum of the model (see `model.rs`) for one set of effects.
#[derive(Debug, Clone)]
pub struct Fit {
    /// The effects.
    pub effects: Vec<FittedEffect>,
    /// Mean μ of each parameter, `[d]`; the middle of the prior for one that is set in every row.
    pub mean: Vec<f64>,
    /// Standard deviation σ of each parameter between rows, `[d]`; 0 for one that is set in every row.
    pub spread: Vec<f64>,
    /// Factor s on the stated noise of the frequency of each mode, `[m]`.
    pub noise_factor: Vec<f64>,
    /// Factor on the stated noise of the shape of each mode, `[m]`; empty if no shapes were measured.
    pub shape_noise_factor: Vec<f64>,
    /// Numbers ψ of each effect.
    pub psi: Vec<Vec<f64>>,
    /// Degrees of freedom ν of the t distribution; infinite for a normal distribution.
    pub tails: f64,
    /// Posterior covariance of the free means and all ψ, in that order and in their own units.
    pub covariance: DMatrix<f64>,
    /// Indices of the free parameters, in the order of `covariance`.
    pub free: Vec<usize>,
    /// ln p(y) at the maximum, nats.
    pub log_likelihood: f64,
    /// ln ∫ p(y) by Laplace's method, nats.
    pub log_evidence: f64,
    /// Posterior standard deviation of ln s of each mode, `[m]`.
    pub noise_factor_ln_std: Vec<f64>,
    /// Settings outside their priors.
    pub outside: Outside,
    /// Number of unknowns: means, ψ, spreads and noise factors.
    pub unknowns: usize,
}

impl Fit {
    /// Covariance of the numbers of effect `index`, `[ψ, ψ]`, in their own units.
    pub fn psi_covariance(&self, index: usize) -> DMatrix<f64> {
        let first = self.free.len() + self.psi[..index].iter().map(Vec::len).sum::<usize>();
        let size = self.psi[index].len();
        self.covariance.view((first, first), (size, size)).into_owned()
    }
}

/// The point where a fit starts: another fit, with the given numbers for the effects.
pub struct Start<'a> {
    /// The other fit.
    pub fit: &'a Fit,
    /// Numbers of each effect; `None` for the mean of their prior.
    pub psi: Vec<Option<Vec<f64>>>,
    /// Whether the first steps take the noise as it is stated. Otherwise a mode that the other fit does not explain, and so takes as noisy,
    /// may be given up by this one too.
    pub noise_as_stated: bool,
}

impl<'a> Start<'a> {
    /// A start at the numbers of the fit itself.
    pub(super) fn at(fit: &'a Fit) -> Self {
        Self { fit, psi: fit.psi.iter().cloned().map(Some).collect(), noise_as_stated: false }
    }

    /// As [`Self::with`], for a constant effect: the first steps take the noise as it is stated.
    pub(super) fn with_constant(fit: &'a Fit, further: Option<Vec<f64>>) -> Self {
        Self { noise_as_stated: true, ..Self::with(fit, further) }
    }

    /// A start at the numbers of the fit, with those of one further effect.
    pub(super) fn with(fit: &'a Fit, further: Option<Vec<f64>>) -> Self {
        let psi = fit.psi.iter().cloned().map(Some).chain([further]).collect();
        Self { fit, psi, noise_as_stated: false }
    }
}
