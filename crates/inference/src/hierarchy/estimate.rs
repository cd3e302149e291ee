//! Estimates of the populations behind a batch.

use nalgebra::DMatrix;
use rand::RngCore as _;
use rayon::prelude::*;

use super::correlation::Correlations;
use super::normal::Normal;
use super::population::{interval, PopulationEstimate};
use super::populations::Populations;
use super::problem::{KnownSpread, Problem, State};
use super::{gibbs, importance, joint};
use crate::posterior::PosteriorSamples;
use structures::parameter::{Parameter, ParameterSpace};
use structures::stats;

/// Estimates the populations behind posterior samples, and the correlations of the parameters over the measurements. The point
/// estimate is computed by expectation–maximisation, the draws of (μ, Σ) by importance sampling, or by a Markov chain where their
/// posterior is far from normal.
///
/// ```text
///  E:  w_js ∝ N(x_js; μ, Σ)/p(x_js)
///  M:  μ = 1/n Σ_js w_js x_js,   Σ = 1/n [ Σ_js w_js (x_js − μ)(x_js − μ)ᵀ + Σ − W ],   W = 1/n Σ_j cov_w(x_j)
/// ```
///
/// Priors: μ has the prior of the parameters; each σ_k uniform up to half the width of the prior, with a factor (σ_k² + W_kk)^(−(d−1)/8)
/// for d correlated parameters, where W_kk is the noise of a measurement; each correlation uniform between −1 and 1 (with the
/// distribution of Barnard, McCulloch and Meng for all together). The second term of Σ is ours and corresponds to
/// the restricted likelihood of a normal population: it restores the variance that the fitted mean absorbs, which is Σ/n for data
/// without noise.
///
/// For one parameter, for more than eight, and for fewer than max(8, 2d + 4, 2(d − 1)²) measurements, Σ is diagonal: such a batch hardly
/// determines correlations, and none are reported.
///
/// `samples`: x, `[n·draws, d]` in parameter units, drawn from the posteriors under the priors of `space`. `log_weights`:
/// ln p(y_j | x_js) − ln r_j(x_js), nats, `[n·draws]`, up to a constant for each measurement, if the samples were drawn from densities
/// r_j instead. Their exponentials multiply each w_js and each term of L.
///
/// Source: D. W. Hogg, A. D. Myers, J. Bovy (2010), Inferring the eccentricity distribution, The Astrophysical Journal 725,
/// 2166–2175; prior of σ: A. Gelman (2006), Prior distributions for variance parameters in hierarchical models, Bayesian
/// Analysis 1, 515–533; prior of the correlations: J. Barnard, R. McCulloch, X.-L. Meng (2000), Statistica Sinica 10, 1281–1311.
pub fn populations(
    samples: &PosteriorSamples,
    log_weights: Option<&[f64]>,
    space: &ParameterSpace,
    seed: u64,
) -> Populations {
    populations_with(samples, log_weights, None, space, seed)
}

/// Standard deviations of the population of a healthy structure, which those of a batch with few measurements are likely to be.
#[derive(Debug, Clone)]
pub struct UsualSpread {
    /// σ of each parameter, in its unit.
    pub std: Vec<f64>,
    /// Number of measurements that the knowledge of σ is worth, of each parameter.
    pub degrees: Vec<f64>,
}

/// Most measurements of a batch for which the spread of the healthy structure counts: more show their own.
const MOST_FOR_USUAL_SPREAD: usize = importance::FEWEST - 1;

/// [`populations`] of a structure whose healthy spread is known: where a batch has fewer than eight measurements, the prior of each σ_k is
/// not uniform, but has the factor σ_k^−ν exp(−νs_k²/2σ_k²) for the usual s_k, which is worth ν measurements.
pub fn populations_with(
    samples: &PosteriorSamples,
    log_weights: Option<&[f64]>,
    usual: Option<&UsualSpread>,
    space: &ParameterSpace,
    seed: u64,
) -> Populations {
    let mut problem = Problem::new(samples, log_weights, space);
    if let Some(usual) = usual.filter(|_| problem.measurements <= MOST_FOR_USUAL_SPREAD) {
        let known = |((std, degrees), parameter): ((&f64, &f64), &Parameter)| {
            let std = (std / (parameter.upper - parameter.lower)).max(f64::MIN_POSITIVE);
            KnownSpread { degrees: *degrees, squares: degrees * std * std }
        };
        problem = problem.knowing(usual.std.iter().zip(&usual.degrees).zip(space).map(known).collect());
    }
    if problem.measurements < 2 {
        // The posterior of a single measurement is that of the mean; the spread is unknown.
        let one = |column: usize| {
            let mean_draws: Vec<f64> = samples.column(column);
            PopulationEstimate { mean: stats::mean(&mean_draws), std: None, mean_draws, std_draws: Vec::new() }
        };
        let effective_sample_size = problem.draws as f64;
        let parameters = (0..space.len()).map(one).collect();
        return Populations { parameters, correlations: None, effective_sample_size };
    }
    if let Some(populations) = correlated(&problem, space, seed) {
        return populations;
    }
    let point = problem.maximise();
    let effective_sample_size = problem.effective_sample_size(&point);
    let states = importance::draws(&problem, &point, seed).unwrap_or_else(|| gibbs::draws(&problem, &point, seed));
    let states = under_prior(states, |state| state.mean.as_slice(), space, seed);
    Populations { parameters: in_units(&point, &states, space), correlations: None, effective_sample_size }
}

/// The populations with correlations; `None` where these are not estimated.
fn correlated(problem: &Problem, space: &ParameterSpace, seed: u64) -> Option<Populations> {
    let point = normal(problem)?;
    let effective_sample_size = problem.effective_sample_size_of_normal(&point);
    let draws = under_prior(joint::draws(problem, &point, seed)?, |normal| &normal.mean[..], space, seed);
    let state = |normal: &Normal| State {
        mean: normal.mean[..space.len()].to_vec(),
        std: (0..space.len()).map(|k| normal.std(k)).collect(),
    };
    let states: Vec<State> = draws.iter().map(state).collect();
    let parameters = in_units(&state(&point), &states, space);
    Some(Populations { parameters, correlations: Some(Correlations::of_draws(&draws)), effective_sample_size })
}

/// Draws of a population under a uniform prior of its mean μ, resampled by the priors of the parameters at μ. Unchanged where these are
/// uniform. `mean`: μ in the unit box, `[d]` or longer.
fn under_prior<T: Clone>(draws: Vec<T>, mean: impl Fn(&T) -> &[f64], space: &ParameterSpace, seed: u64) -> Vec<T> {
    if space.is_uniform() {
        return draws;
    }
    let one = |draw: &T| space.iter().zip(mean(draw)).map(|(p, u)| p.log_prior(p.from_unit(*u))).sum::<f64>();
    let log_weights: Vec<f64> = draws.iter().map(one).collect();
    let Some(weights) = stats::weights(&log_weights, 0.0) else { return draws };
    let chosen = stats::systematic(&weights, draws.len(), &mut stats::stream(seed, "prior of the mean"));
    chosen.into_iter().map(|draw| draws[draw].clone()).collect()
}

/// Where the posterior of one measurement is wider than so many spreads of the population, the correlations are hardly determined, and
/// intervals with them would be too narrow: each parameter is estimated by itself.
const MOST_NOISE: f64 = 1.5;

/// The most probable normal population with full covariance; `None` where that is not estimated.
fn normal(problem: &Problem) -> Option<Normal> {
    let estimated = joint::is_estimated(problem.deviations.len(), problem.measurements);
    let point = estimated.then(|| problem.maximise_normal())?;
    let noisy = problem.within.iter().enumerate().any(|(k, within)| *within > MOST_NOISE * point.std(k));
    (!noisy).then_some(point)
}

/// The most probable population and draws, in the unit box, as estimates of each parameter in its unit.
fn in_units(point: &State, states: &[State], space: &ParameterSpace) -> Vec<PopulationEstimate> {
    // With few measurements the most probable σ can lie below the credible interval, and is replaced by the median.
    let within = |point: f64, draws: &[f64]| {
        let [low, high] = interval(draws);
        if (low..=high).contains(&point) {
            point
        } else {
            stats::quantile(draws, 0.5)
        }
    };
    let one = |(column, parameter): (usize, &Parameter)| {
        let width = parameter.upper - parameter.lower;
        let mean_draws: Vec<f64> = states.iter().map(|state| parameter.from_unit(state.mean[column])).collect();
        let std_draws: Vec<f64> = states.iter().map(|state| state.std[column] * width).collect();
        PopulationEstimate {
            mean: within(parameter.from_unit(point.mean[column]), &mean_draws),
            std: Some(within(point.std[column] * width, &std_draws)),
            mean_draws,
            std_draws,
        }
    };
    space.iter().enumerate().map(one).collect()
}

/// Estimates the population of each parameter separately, with those of all others distributed as their priors. With many
/// parameters there are too few samples to weight them by all populations jointly.
///
/// ```text
///  L_k(μ_k, σ_k) ∝ Π_j 1/S Σ_s N(x_jsk; μ_k, σ_k²)/p(x_jsk)
/// ```
///
/// `samples`: `[n·draws, d]`, parameter units. The effective sample size is the smallest of all parameters.
pub fn populations_of_each(samples: &PosteriorSamples, space: &ParameterSpace, seed: u64) -> Populations {
    let one = |(column, parameter): (usize, &Parameter)| {
        let own = DMatrix::from_iterator(samples.theta().nrows(), 1, samples.theta().column(column).iter().copied());
        let seed = stats::stream(seed, &format!("population of {}", parameter.name)).next_u64();
        populations(
            &PosteriorSamples::new(own, samples.draws()),
            None,
            &ParameterSpace::new(vec![parameter.clone()]),
            seed,
        )
    };
    let each: Vec<Populations> = space.as_slice().par_iter().enumerate().map(one).collect();
    let effective_sample_size = each.iter().map(|p| p.effective_sample_size).fold(f64::INFINITY, f64::min);
    let parameters = each.into_iter().flat_map(|p| p.parameters).collect();
    Populations { parameters, correlations: None, effective_sample_size }
}

/// The point estimate of [`populations`] and its effective sample size, without draws of (μ, σ). `samples`: `[n·draws, d]`,
/// parameter units; `log_weights`: `[n·draws]`, nats, as in [`populations`].
pub fn estimate(samples: &PosteriorSamples, log_weights: Option<&[f64]>, space: &ParameterSpace) -> Populations {
    let problem = Problem::new(samples, log_weights, space);
    let found = normal(&problem);
    let (mean, std, effective_sample_size) = if let Some(normal) = &found {
        let std = (0..space.len()).map(|k| normal.std(k)).collect();
        (normal.mean[..space.len()].to_vec(), std, problem.effective_sample_size_of_normal(normal))
    } else {
        let point = problem.maximise();
        let effective_sample_size = problem.effective_sample_size(&point);
        (point.mean, point.std, effective_sample_size)
    };
    let one = |(column, p): (usize, &Parameter)| PopulationEstimate {
        mean: p.from_unit(mean[column]),
        std: Some(std[column] * (p.upper - p.lower)),
        mean_draws: Vec::new(),
        std_draws: Vec::new(),
    };
    let correlations = found.as_ref().map(Correlations::of_point);
    Populations { parameters: space.iter().enumerate().map(one).collect(), correlations, effective_sample_size }
}
