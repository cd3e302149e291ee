//! Estimates of the populations behind a batch.

use nalgebra::DMatrix;
use rand::RngCore as _;
use rayon::prelude::*;

use super::population::{interval, PopulationEstimate, Populations, DRAWS};
use super::problem::Problem;
use super::{gibbs, importance};
use crate::parameter::{Parameter, ParameterSpace};
use crate::posterior::PosteriorSamples;
use crate::stats;

/// Estimates the populations behind posterior samples. The point estimate is computed by expectation–maximisation, the
/// draws of (μ, σ) by importance sampling, or by a Markov chain where their posterior is far from normal.
///
/// ```text
///  E:  w_js ∝ N(x_js; μ, diag σ²)
///  M:  μ = 1/n Σ_js w_js x_js,   σ² = 1/n [ Σ_js w_js (x_js − μ)² + (1 − B) σ² ],   B = 1/n Σ_j var_w(x_j)/σ²
/// ```
///
/// Priors: μ is uniform in the prior box, σ uniform up to half the width of the prior. The second term of σ² is ours and
/// corresponds to the restricted likelihood of a normal population: it restores the variance that the fitted mean absorbs,
/// which is σ²/n for data without noise.
///
/// `samples`: x, `[n·draws, d]` in parameter units. `log_weights`: ln q(x_js | y_j) − ln r_j(x_js), nats, `[n·draws]`, up to a
/// constant for each measurement, if the samples were drawn from densities r_j instead of q(· | y_j). Their exponentials
/// multiply each w_js and each term of L.
///
/// Source: D. W. Hogg, A. D. Myers, J. Bovy (2010), Inferring the eccentricity distribution, The Astrophysical Journal 725,
/// 2166–2175; prior of σ: A. Gelman (2006), Prior distributions for variance parameters in hierarchical models, Bayesian
/// Analysis 1, 515–533.
pub fn populations(
    samples: &PosteriorSamples,
    log_weights: Option<&[f64]>,
    space: &ParameterSpace,
    seed: u64,
) -> Populations {
    let problem = Problem::new(samples, log_weights, space);
    let dimension = space.len();
    let to_units = |column: usize, u: f64| space.as_slice()[column].from_unit(u);
    let width = |column: usize| space.as_slice()[column].upper - space.as_slice()[column].lower;
    if problem.measurements < 2 {
        // The posterior of a single measurement is that of the mean; the spread is unknown.
        let one = |column: usize| {
            let mean_draws: Vec<f64> = samples.column(column);
            PopulationEstimate { mean: stats::mean(&mean_draws), std: None, mean_draws, std_draws: Vec::new() }
        };
        let effective_sample_size = problem.draws as f64;
        return Populations { parameters: (0..dimension).map(one).collect(), effective_sample_size };
    }
    let point = problem.maximise();
    let effective_sample_size = problem.effective_sample_size(&point);
    let states = importance::draws(&problem, &point, seed).unwrap_or_else(|| gibbs::draws(&problem, &point, seed));
    let (mut means, mut stds) =
        (vec![Vec::with_capacity(DRAWS); dimension], vec![Vec::with_capacity(DRAWS); dimension]);
    for state in &states {
        for column in 0..dimension {
            means[column].push(to_units(column, state.mean[column]));
            stds[column].push(state.std[column] * width(column));
        }
    }
    // With few measurements the most probable σ can lie below the credible interval, and is replaced by the median.
    let within = |point: f64, draws: &[f64]| {
        let [low, high] = interval(draws);
        if (low..=high).contains(&point) {
            point
        } else {
            stats::quantile(draws, 0.5)
        }
    };
    let one = |(column, (mean_draws, std_draws)): (usize, (Vec<f64>, Vec<f64>))| PopulationEstimate {
        mean: within(to_units(column, point.mean[column]), &mean_draws),
        std: Some(within(point.std[column] * width(column), &std_draws)),
        mean_draws,
        std_draws,
    };
    let parameters = means.into_iter().zip(stds).enumerate().map(one).collect();
    Populations { parameters, effective_sample_size }
}

/// Estimates the population of each parameter separately, with those of all others uniform over the prior. With many
/// parameters there are too few samples to weight them by all populations jointly.
///
/// ```text
///  L_k(μ_k, σ_k) ∝ Π_j 1/S Σ_s N(x_jsk; μ_k, σ_k²)
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
    Populations { parameters: each.into_iter().flat_map(|p| p.parameters).collect(), effective_sample_size }
}

/// The point estimate of [`populations`] and its effective sample size, without draws of (μ, σ). `samples`: `[n·draws, d]`,
/// parameter units; `log_weights`: `[n·draws]`, nats, as in [`populations`].
pub fn estimate(samples: &PosteriorSamples, log_weights: Option<&[f64]>, space: &ParameterSpace) -> Populations {
    let problem = Problem::new(samples, log_weights, space);
    let point = problem.maximise();
    let effective_sample_size = problem.effective_sample_size(&point);
    let one = |(column, p): (usize, &Parameter)| PopulationEstimate {
        mean: p.from_unit(point.mean[column]),
        std: Some(point.std[column] * (p.upper - p.lower)),
        mean_draws: Vec::new(),
        std_draws: Vec::new(),
    };
    Populations { parameters: space.iter().enumerate().map(one).collect(), effective_sample_size }
}
