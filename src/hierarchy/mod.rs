//! The population behind a batch: mean and spread of the parameters over its measurements, free of the noise of each.
//!
//! A flow answers for each measurement j with samples of q(x | y_j) ∝ p(y_j | x) under a uniform prior. The likelihood of
//! a normal population (μ, σ) needs nothing more:
//!
//! ```text
//!  L(μ, σ) = Π_j ∫ p(y_j | x) N(x; μ, diag σ²) dx ∝ Π_j 1/S Σ_s N(x_js; μ, diag σ²)
//! ```
//!
//! The pool of all samples counts the noise twice, once in where each posterior sits and once in its width; here it
//! counts not at all. Source: Hogg, Myers & Bovy (2010).

mod block;
mod gibbs;
mod importance;
mod kernel;
mod near;
mod problem;
mod widths;

use nalgebra::DMatrix;
use rayon::prelude::*;

pub use self::near::proposals;
use self::problem::Problem;
use crate::parameter::ParameterSpace;
use crate::posterior::PosteriorSamples;
use crate::stats;

/// Probability of every credible interval of the crate.
pub const INTERVAL: f64 = 0.90;

/// Draws of (μ, σ) that are kept.
pub const DRAWS: usize = 400;

/// Largest standard deviation considered, as a share of the prior's width: a uniform spread over the prior has 0.29.
const WIDEST: f64 = 0.5;

/// Mean and spread of one quantity over the population behind a batch.
#[derive(Debug, Clone, PartialEq)]
pub struct PopulationEstimate {
    /// Mean μ, in the quantity's unit.
    pub mean: f64,
    /// Standard deviation σ, in the quantity's unit; `None` for one measurement, which says nothing of it.
    pub std: Option<f64>,
    /// Posterior draws of μ.
    pub mean_draws: Vec<f64>,
    /// Posterior draws of σ, paired with those of μ; empty for one measurement.
    pub std_draws: Vec<f64>,
}

/// The population of all parameters.
#[derive(Debug, Clone, PartialEq)]
pub struct Populations {
    /// One entry a parameter, in the order of the space.
    pub parameters: Vec<PopulationEstimate>,
    /// Mean over the measurements of the effective number of samples each contributes, (Σw)²/Σw² with weights under the
    /// estimated population.
    pub effective_sample_size: f64,
}

impl PopulationEstimate {
    /// Credible interval of μ.
    pub fn mean_interval(&self) -> [f64; 2] {
        interval(&self.mean_draws)
    }

    /// Credible interval of σ.
    pub fn std_interval(&self) -> Option<[f64; 2]> {
        (!self.std_draws.is_empty()).then(|| interval(&self.std_draws))
    }

    /// The population of a monotone function of the quantity.
    ///
    /// ```text
    ///  mean and standard deviation of g(x), x ~ N(μ, σ²), at the normal quantiles of equal probability
    /// ```
    #[must_use]
    pub fn through(&self, function: impl Fn(f64) -> f64) -> Self {
        const NODES: usize = 41;
        let nodes: Vec<f64> = (0..NODES).map(|i| stats::normal_quantile((i as f64 + 0.5) / NODES as f64)).collect();
        // The nodes' own spread falls short of 1 by what lies beyond the outermost.
        let scale = 1.0 / (nodes.iter().map(|z| z * z).sum::<f64>() / NODES as f64).sqrt();
        let moments = |mean: f64, std: f64| {
            let values: Vec<f64> = nodes.iter().map(|z| function(mean + std * scale * z)).collect();
            let centre = stats::mean(&values);
            let variance = values.iter().map(|v| (v - centre).powi(2)).sum::<f64>() / NODES as f64;
            (centre, variance.sqrt())
        };
        let Some(std) = self.std else {
            let mean_draws: Vec<f64> = self.mean_draws.iter().map(|x| function(*x)).collect();
            return Self { mean: stats::mean(&mean_draws), std: None, mean_draws, std_draws: Vec::new() };
        };
        let (mean, std) = moments(self.mean, std);
        let draws = self.mean_draws.iter().zip(&self.std_draws).map(|(m, s)| moments(*m, *s));
        let (mean_draws, std_draws) = draws.unzip();
        Self { mean, std: Some(std), mean_draws, std_draws }
    }
}

impl PopulationEstimate {
    /// The population of the mean of several quantities, whose spreads are independent.
    #[must_use]
    pub fn average(parts: &[&Self]) -> Self {
        let count = parts.len() as f64;
        let mean_of = |draw: usize| parts.iter().map(|p| p.mean_draws[draw]).sum::<f64>() / count;
        let std_of = |draw: usize| parts.iter().map(|p| p.std_draws[draw].powi(2)).sum::<f64>().sqrt() / count;
        let draws = parts.iter().map(|p| p.mean_draws.len()).min().unwrap_or(0);
        let spread = parts.iter().all(|p| p.std.is_some());
        Self {
            mean: parts.iter().map(|p| p.mean).sum::<f64>() / count,
            std: spread.then(|| parts.iter().filter_map(|p| p.std).map(|s| s * s).sum::<f64>().sqrt() / count),
            mean_draws: (0..draws).map(mean_of).collect(),
            std_draws: if spread { (0..draws).map(std_of).collect() } else { Vec::new() },
        }
    }
}

/// The central interval of [`INTERVAL`].
pub fn interval(draws: &[f64]) -> [f64; 2] {
    [stats::quantile(draws, 0.5 * (1.0 - INTERVAL)), stats::quantile(draws, 0.5 * (1.0 + INTERVAL))]
}

/// Estimates the population behind posterior samples: point by expectation–maximisation, draws by importance, or by a Markov chain
/// where the posterior of (μ, σ) is far from normal.
///
/// ```text
///  E:  w_js ∝ N(x_js; μ, diag σ²)
///  M:  μ = 1/n Σ_js w_js x_js,   σ² = 1/n [ Σ_js w_js (x_js − μ)² + (1 − B) σ² ],   B = 1/n Σ_j var_w(x_j)/σ²
/// ```
///
/// Priors: μ uniform in the prior box, σ uniform up to half the width of the prior (Gelman 2006). The second
/// term of σ² is ours, the restricted likelihood of a normal population: it gives back what the fitted mean has absorbed,
/// σ²/n for data without noise.
///
/// `log_weights`: where the samples were drawn from another density r_j than q(· | y_j), ln q(x_js | y_j) − ln r_j(x_js) up to a
/// constant for each measurement; they go with each w_js and into L.
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
        // The posterior of the one measurement is that of the mean, and nothing is known of a spread.
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
    // Of few measurements the most probable σ can lie below all that is probable: the median then stands for it.
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

/// The population of each parameter by itself, those of all others flat over the prior: for many parameters, of which the
/// samples are too few to be weighed by all populations at once.
///
/// ```text
///  L_k(μ_k, σ_k) ∝ Π_j 1/S Σ_s N(x_jsk; μ_k, σ_k²)
/// ```
pub fn populations_of_each(samples: &PosteriorSamples, space: &ParameterSpace, seed: u64) -> Populations {
    use rand::RngCore as _;
    let one = |(column, parameter): (usize, &crate::parameter::Parameter)| {
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
    // The least tells whether some parameter stands on few samples.
    let effective_sample_size = each.iter().map(|p| p.effective_sample_size).fold(f64::INFINITY, f64::min);
    Populations { parameters: each.into_iter().flat_map(|p| p.parameters).collect(), effective_sample_size }
}

/// The point estimate of [`populations`] alone, without draws, and its effective sample size.
pub fn estimate(samples: &PosteriorSamples, log_weights: Option<&[f64]>, space: &ParameterSpace) -> Populations {
    let problem = Problem::new(samples, log_weights, space);
    let point = problem.maximise();
    let effective_sample_size = problem.effective_sample_size(&point);
    let one = |(column, p): (usize, &crate::parameter::Parameter)| PopulationEstimate {
        mean: p.from_unit(point.mean[column]),
        std: Some(point.std[column] * (p.upper - p.lower)),
        mean_draws: Vec::new(),
        std_draws: Vec::new(),
    };
    Populations { parameters: space.iter().enumerate().map(one).collect(), effective_sample_size }
}
