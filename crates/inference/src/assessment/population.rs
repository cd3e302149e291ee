//! The population behind the posterior samples of a batch, by an importance proposal.

use nalgebra::DMatrix;
use rand::RngCore as _;

use super::batch_mean::Healthy;
use super::narrow;
use crate::baseline::observation::Observation;
use crate::baseline::{Baseline, InferenceError};
use crate::damage::UndamagedReference;
use crate::hierarchy::{
    estimate, populations, populations_of_each, populations_with, proposals, Populations, UsualSpread,
};
use crate::posterior::PosteriorSamples;
use structures::parameter::Parameter;
use structures::stats;

/// Samples of each measurement from the importance proposal, which concentrates where the posterior of the measurement and the
/// population overlap. The logarithm of a mean of few weights is biased downwards, and the more so the narrower the population:
/// samples far from the overlap would make σ too large.
const PROPOSAL_DRAWS: usize = 64;

/// The same for noise-dominated batches, where few of the samples carry weight.
const PROPOSAL_DRAWS_NOISE_DOMINATED: usize = 128;

/// A batch is noise-dominated below this effective share of the pilot sample: the moments of so few samples of each measurement
/// are then not good enough for a proposal, and σ would be estimated too large.
const NOISE_DOMINATED: f64 = 0.56;

/// The posterior samples themselves are used instead of the proposal's when their effective share is larger by this factor: the
/// proposal is normal, and a posterior may be far from normal.
const POSTERIOR_BETTER: f64 = 2.0;

/// Estimates the population behind posterior samples, either from an importance proposal whose samples are weighted by their
/// likelihood, or from `draws` samples of each posterior if these have the larger effective share. Where single measurements say little, for
/// want of modes or for noise, all are inferred together instead, see [`narrow`]. Returns the posterior samples, with those drawn in
/// addition, and the population.
///
/// # Errors
/// [`InferenceError`] when the flow fails on further samples.
pub(super) fn population_behind(
    baseline: &Baseline,
    posterior: PosteriorSamples,
    observations: &[Observation],
    undamaged: Option<&UndamagedReference>,
    draws: usize,
    seed: u64,
) -> Result<(PosteriorSamples, Populations), InferenceError> {
    let space = baseline.space();
    if posterior.measurements() < 2 {
        let mut one = populations(&posterior, None, space, seed);
        for (column, estimate) in one.parameters.iter_mut().enumerate() {
            conform(baseline, column, &observations[0], &mut estimate.mean_draws);
        }
        return Ok((posterior, one));
    }
    if baseline.starts_at_fit() {
        let populations = populations_of_each(&posterior, space, seed);
        return Ok((posterior, populations));
    }
    let usual = undamaged.and_then(|undamaged| usual_spread(baseline, undamaged));
    let compared = undamaged.zip(usual.as_ref()).and_then(|(undamaged, usual)| {
        let worth = usual.degrees.iter().copied().fold(MOST_DEGREES, f64::min);
        let mut healthy = Healthy::of_reference(baseline, undamaged)?;
        healthy.scatter = usual_covariance(baseline, undamaged, &usual.std);
        (worth >= LEAST_DEGREES).then_some(narrow::Usual { healthy, worth })
    });
    if let Some(found) = narrow::population(baseline, observations, compared.as_ref(), seed) {
        return Ok((posterior, found));
    }
    let complete = |posterior: PosteriorSamples| match draws.saturating_sub(posterior.draws()) {
        0 => Ok(posterior),
        missing => {
            let further = stats::stream(seed, "further draws").next_u64();
            baseline.infer(observations, missing, further).map(|samples| posterior.joined(&samples))
        }
    };
    let effective_share = |populations: &Populations, draws: usize| populations.effective_sample_size / draws as f64;
    let mut found = estimate(&posterior, None, space);
    let mut posterior = posterior;
    let mut proposal_draws = PROPOSAL_DRAWS;
    if effective_share(&found, posterior.draws()) < NOISE_DOMINATED {
        posterior = complete(posterior)?;
        found = estimate(&posterior, None, space);
        proposal_draws = PROPOSAL_DRAWS_NOISE_DOMINATED;
    }
    let (samples, log_density) = proposals(&posterior, &found, space, proposal_draws, seed);
    let log_likelihood = baseline.log_likelihood_of_draws(samples.theta(), observations)?;
    let log_weights: Vec<f64> = log_likelihood.iter().zip(&log_density).map(|(l, r)| l - r).collect();
    let proposed = populations_with(&samples, Some(&log_weights), usual.as_ref(), space, seed);
    if effective_share(&found, posterior.draws()) <= POSTERIOR_BETTER * effective_share(&proposed, proposal_draws) {
        return Ok((posterior, proposed));
    }
    let posterior = complete(posterior)?;
    let populations = populations_with(&posterior, None, usual.as_ref(), space, seed);
    Ok((posterior, populations))
}

/// Most measurements that the knowledge of the spread of a healthy structure counts for: a batch whose own spread is another one can show
/// it.
pub(super) const MOST_DEGREES: f64 = 30.0;

/// Least eigenvalue of the correlations of a healthy structure: what is not known must not count as known to be 0.
const LEAST_EIGENVALUE: f64 = 0.05;

/// The covariance of the parameters of a healthy structure with these standard deviations, and with the correlations that its reference has
/// estimated.
fn usual_covariance(baseline: &Baseline, undamaged: &UndamagedReference, stds: &[f64]) -> DMatrix<f64> {
    let names: Vec<&str> = baseline.space().iter().map(|p| p.name.as_str()).collect();
    let pairs = undamaged.joint.as_ref().map_or(&[][..], |joint| &joint.correlations);
    let mut correlations = DMatrix::identity(names.len(), names.len());
    for pair in pairs {
        let place = |name: &String| names.iter().position(|own| own == name);
        if let (Some(i), Some(j)) = (place(&pair.first), place(&pair.second)) {
            correlations[(i, j)] = pair.correlation;
            correlations[(j, i)] = pair.correlation;
        }
    }
    let mut eigen = correlations.symmetric_eigen();
    eigen.eigenvalues.apply(|value| *value = value.max(LEAST_EIGENVALUE));
    let positive = eigen.recompose();
    DMatrix::from_fn(names.len(), names.len(), |i, j| {
        positive[(i, j)] / (positive[(i, i)] * positive[(j, j)]).sqrt() * stds[i] * stds[j]
    })
}

/// Fewest measurements that the knowledge of a healthy spread must be worth to take the place of an unknown one where all measurements are
/// inferred together.
const LEAST_DEGREES: f64 = 8.0;

/// The spread of the healthy structure of a reference, worth as many measurements as its draws are certain; `None` where a parameter has
/// none.
///
/// ```text
///  ν = ½ (mean/standard deviation)² of the draws of σ,    from the variance σ²/2ν of a standard deviation
/// ```
fn usual_spread(baseline: &Baseline, undamaged: &UndamagedReference) -> Option<UsualSpread> {
    let of_parameter = |p: &Parameter| {
        let quantity = undamaged.quantities.iter().find(|q| q.name == p.name)?;
        let uncertainty = stats::sample_std(&quantity.std_draws)?;
        let degrees = 0.5 * (stats::mean(&quantity.std_draws) / uncertainty).powi(2);
        Some((quantity.std, degrees.min(MOST_DEGREES)))
    };
    let (std, degrees) = baseline.space().iter().map(of_parameter).collect::<Option<Vec<_>>>()?.into_iter().unzip();
    Some(UsualSpread { std, degrees })
}

/// Stretches the draws of one measurement about their median by the factor that gave 90 % intervals their coverage in the
/// calibration (conformal prediction), within the prior.
fn conform(baseline: &Baseline, column: usize, observation: &Observation, draws: &mut [f64]) {
    let noise = observation.mean_noise_multiple();
    let complete = observation.modes_present() == baseline.simulator().modes();
    let scale = baseline.manifest().calibration.interval_scale(column, noise, complete, observation.has_shapes());
    let (median, prior) = (stats::quantile(draws, 0.5), &baseline.space().as_slice()[column]);
    for draw in draws {
        *draw = (median + scale * (*draw - median)).clamp(prior.lower, prior.upper);
    }
}
