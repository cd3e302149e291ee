//! Draws from the posterior of the unknowns of a process: what the reference leaves possible.

use nalgebra::{Cholesky, DMatrix, DVector};
use rand::Rng as _;
use rand_distr::{ChiSquared, StandardNormal};
use rayon::prelude::*;

use structures::stats::{self, Stream};

/// Draws that are kept.
const DRAWS: usize = 100;

/// Draws that are proposed in each round, and rounds.
const PROPOSED: usize = 250;
const ROUNDS: usize = 5;

/// Degrees of freedom of the proposals: their tails are somewhat wider than those of a normal distribution. Far wider ones would leave few
/// effective draws among the twenty unknowns and more that a process has.
const DEGREES_OF_FREEDOM: f64 = 60.0;

/// Largest weight of a proposed draw, as a multiple of the mean weight: a few draws in a tail of the posterior, where the proposals are
/// too small, do not take the place of all others.
const LARGEST_WEIGHT: f64 = 20.0;

/// Seed of the draws. It is fixed, so that the process depends on nothing but the batches.
const SEED: u64 = 1;

/// A multivariate t distribution from which draws are proposed.
struct Proposal {
    mean: DVector<f64>,
    covariance: DMatrix<f64>,
    cholesky: Cholesky<f64, nalgebra::Dyn>,
}

impl Proposal {
    /// `None` if the covariance is not positive definite.
    fn new(mean: DVector<f64>, covariance: DMatrix<f64>) -> Option<Self> {
        let cholesky = covariance.clone().cholesky()?;
        Some(Self { mean, covariance, cholesky })
    }

    fn draw(&self, stream: &mut Stream) -> DVector<f64> {
        let z = DVector::from_fn(self.mean.len(), |_, _| stream.sample::<f64, _>(StandardNormal));
        let chi_squared = ChiSquared::new(DEGREES_OF_FREEDOM).expect("the degrees of freedom are positive");
        let widened = (DEGREES_OF_FREEDOM / stream.sample(chi_squared)).sqrt();
        &self.mean + self.cholesky.l_dirty().lower_triangle() * z * widened
    }

    /// ln of the density up to a constant that all proposals share, nats.
    fn log_density(&self, unknowns: &DVector<f64>) -> f64 {
        let factor = self.cholesky.l_dirty();
        let z = factor.solve_lower_triangular(&(unknowns - &self.mean)).expect("the diagonal is positive");
        let log_det: f64 = factor.diagonal().iter().map(|own| own.ln()).sum();
        let p = unknowns.len() as f64;
        -log_det - 0.5 * (DEGREES_OF_FREEDOM + p) * (z.norm_squared() / DEGREES_OF_FREEDOM).ln_1p()
    }

    /// The proposal of the next round, from weighted draws; this one is the first. A covariance of few effective draws would have empty
    /// directions: mean and covariance of the first proposal count as many draws as there are unknowns.
    fn adapted(&self, draws: &[Proposed], weights: &[f64]) -> Option<Self> {
        let total: f64 = weights.iter().sum();
        let shares = || draws.iter().zip(weights).map(|(own, weight)| (&own.unknowns, weight / total));
        let p = self.mean.len();
        let mean = shares().fold(DVector::zeros(p), |sum, (unknowns, share)| sum + unknowns * share);
        let mut covariance = DMatrix::zeros(p, p);
        for (unknowns, share) in shares() {
            let error = unknowns - &mean;
            covariance.ger(share, &error, &error, 1.0);
        }
        let effective = stats::effective_number(weights);
        let own = p as f64 / (p as f64 + effective);
        Self::new(mean * (1.0 - own) + &self.mean * own, covariance * (1.0 - own) + &self.covariance * own)
    }
}

/// A proposed draw.
struct Proposed {
    unknowns: DVector<f64>,
    /// ln of the posterior density, nats.
    log_posterior: f64,
    /// ln of the density of each proposal so far, up to a constant that all share, nats.
    log_proposals: Vec<f64>,
}

/// Draws from the posterior of the unknowns, `[DRAWS][p]`, from their most probable values, `[p]`, and their covariance by Laplace's method,
/// `[p, p]`. `log_posterior` is the logarithm of their density up to a constant, nats; `None` where it cannot be computed. `None` if the
/// covariance is not positive definite.
///
/// That method alone would allow values that the batches exclude, such as a large s where they only say that it is small, and has too
/// small a tail where they do not say how long a factor lasts. The draws are proposed in rounds, each from the mean and covariance of
/// all draws before, and weighted by the posterior density over the mean density of all proposals.
///
/// Source: J.-M. Cornuet, J.-M. Marin, A. Mira, C. P. Robert (2012), Adaptive multiple importance sampling, Scandinavian Journal of
/// Statistics 39, 798–812.
pub(super) fn draws(
    most_probable: &[f64],
    covariance: DMatrix<f64>,
    log_posterior: impl Fn(&[f64]) -> Option<f64> + Sync,
) -> Option<Vec<Vec<f64>>> {
    let mut proposals = vec![Proposal::new(DVector::from_column_slice(most_probable), covariance)?];
    let mut proposed: Vec<Proposed> = Vec::new();
    let mut weights: Vec<f64> = Vec::new();
    for round in 0..ROUNDS {
        let newest = proposals.last().expect("there is a first one");
        let propose = |place: usize| {
            let mut stream = stats::stream(SEED, &format!("process {round} {place}"));
            let unknowns = newest.draw(&mut stream);
            let log_posterior = log_posterior(unknowns.as_slice()).unwrap_or(f64::NEG_INFINITY);
            let log_proposals = proposals[..round].iter().map(|own| own.log_density(&unknowns)).collect();
            Proposed { unknowns, log_posterior, log_proposals }
        };
        let new: Vec<Proposed> = (0..PROPOSED).into_par_iter().map(propose).collect();
        proposed.extend(new);
        for own in &mut proposed {
            own.log_proposals.push(newest.log_density(&own.unknowns));
        }
        weights = bounded_weights(&proposed);
        if round + 1 < ROUNDS {
            let Some(next) = proposals[0].adapted(&proposed, &weights) else { break };
            proposals.push(next);
        }
    }
    let chosen = stats::systematic(&weights, DRAWS, &mut stats::stream(SEED, "draws of a process"));
    Some(chosen.into_iter().map(|place| proposed[place].unknowns.as_slice().to_vec()).collect())
}

impl Proposed {
    /// ln of the posterior density over the mean density of the proposals, up to a constant, nats.
    fn log_weight(&self) -> f64 {
        let largest = self.log_proposals.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let sum: f64 = self.log_proposals.iter().map(|own| (own - largest).exp()).sum();
        self.log_posterior - largest - sum.ln()
    }
}

/// Importance weights of the draws, none above [`LARGEST_WEIGHT`] times their mean before.
fn bounded_weights(proposed: &[Proposed]) -> Vec<f64> {
    let log_weights: Vec<f64> = proposed.iter().map(Proposed::log_weight).collect();
    let largest = log_weights.iter().copied().fold(f64::NEG_INFINITY, f64::max);
    let relative: Vec<f64> = log_weights.iter().map(|log| (log - largest).exp()).collect();
    let most = LARGEST_WEIGHT * stats::mean(&relative);
    relative.iter().map(|weight| weight.min(most)).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn draws_have_the_moments_of_a_posterior_with_a_long_tail() {
        // The logarithm y of an exponential variable has the density exp(y − e^y): its mode is 0 with a curvature of 1, its mean −γ, its
        // variance π²/6, its kurtosis 27/5.
        const UNKNOWNS: usize = 14;
        let log_density = |y: &[f64]| Some(y.iter().map(|y| y - y.exp()).sum());
        let found = draws(&[0.0; UNKNOWNS], DMatrix::identity(UNKNOWNS, UNKNOWNS), log_density).unwrap();
        assert_eq!(found.len(), DRAWS);
        let variance = std::f64::consts::PI.powi(2) / 6.0;
        let all: Vec<f64> = found.into_iter().flatten().collect();
        let moments = |power: i32| stats::mean(&all.iter().map(|y| (y + 0.577_216).powi(power)).collect::<Vec<_>>());
        // Four standard errors; draws that occur more than once are at least half as many that differ.
        let tolerance = 4.0 / (0.5 * all.len() as f64).sqrt();
        let (mean, square) = (moments(1), moments(2));
        assert!(mean.abs() < tolerance * variance.sqrt(), "the mean is off by {mean:.3}");
        assert!((square - variance).abs() < tolerance * variance * 4.4_f64.sqrt(), "the variance is {square:.3}");
    }
}
