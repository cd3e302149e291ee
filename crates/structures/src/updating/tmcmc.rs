//! Transitional Markov chain Monte Carlo (TMCMC): samples a posterior and estimates the evidence by tempering from the prior.

use nalgebra::{DMatrix, DVector};
use rand::Rng as _;
use rand_distr::StandardNormal;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::weights::{next_exponent, Weights};
use crate::stats::{self, Stream};

/// Largest number of stages.
const MOST_STAGES: usize = 300;

/// A parameter has collapsed if its standard deviation is below this share of that over the prior.
const COLLAPSED: f64 = 1e-9;

/// Added to the diagonal of the correlation matrix of the proposal, so that it is regular for exactly dependent parameters.
const CORRELATION_FLOOR: f64 = 1e-12;

/// Range of the proposal scale β, much wider than tuning needs, so that β cannot diverge.
const SCALES: (f64, f64) = (1e-6, 10.0);

/// A posterior to be sampled: a prior that can be drawn from, and a likelihood.
///
/// The methods are called from several threads at once. They must be deterministic: a likelihood that simulates must use the same
/// random numbers at every θ.
pub trait Target: Sync {
    /// Number of dimensions d of θ.
    fn dimensions(&self) -> usize;

    /// Draws one θ from the prior, `[d]`.
    fn draw_prior(&self, stream: &mut Stream) -> Vec<f64>;

    /// Logarithm of the prior density, −∞ outside its support. A constant factor may be omitted, because it changes neither the
    /// samples nor the evidence.
    fn log_prior(&self, theta: &[f64]) -> f64;

    /// Logarithm of the likelihood; −∞ where it is zero, as for a structure that is a mechanism. It is only evaluated inside the
    /// support of the prior. NaN and +∞ are bugs and end the run with an error.
    fn log_likelihood(&self, theta: &[f64]) -> f64;
}

/// Settings of [`tmcmc`].
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Number of samples of each stage and of the result; at least 2.
    pub samples: usize,
    /// Target for the coefficient of variation of the weights in each stage, above 0. A smaller value gives more stages.
    pub weight_variation: f64,
    /// In each stage the samples move until the correlation of every parameter with its start is at most this, from 0 to 1. With
    /// fewer steps, copies of the same sample would remain and the uncertainty of the results would be underestimated.
    pub correlation: f64,
    /// Largest number of Metropolis steps of a sample in one stage; at least 1. It is reached for a posterior with separate
    /// modes, for which the correlation remains high.
    pub most_steps: usize,
}

impl Default for Settings {
    fn default() -> Self {
        Self { samples: 1_000, weight_variation: 1.0, correlation: 0.3, most_steps: 30 }
    }
}

impl Settings {
    /// Checks the ranges of the settings.
    fn check(&self) -> Result<(), Error> {
        let settings = [
            ("samples", self.samples as f64, self.samples >= 2),
            (
                "weight_variation",
                self.weight_variation,
                self.weight_variation > 0.0 && self.weight_variation.is_finite(),
            ),
            ("correlation", self.correlation, (0.0..=1.0).contains(&self.correlation)),
            ("most_steps", self.most_steps as f64, self.most_steps >= 1),
        ];
        match settings.into_iter().find(|(_, _, legal)| !legal) {
            Some((name, value, _)) => Err(Error::Setting { name, value }),
            None => Ok(()),
        }
    }
}

/// One stage of tempering between the prior and the posterior.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Stage {
    /// Exponent of the likelihood at the end of the stage; 0 if the stage only discarded samples with zero likelihood.
    pub exponent: f64,
    /// Logarithm of the mean weight, nats.
    pub log_evidence_increment: f64,
    /// Effective sample size 1/Σ W² of the weighted samples before resampling, where W are the normalised weights.
    pub effective_sample_size: f64,
    /// Number of Metropolis steps of each sample.
    pub steps: usize,
    /// Acceptance rate of the proposals.
    pub acceptance: f64,
    /// Largest remaining correlation between a parameter and its start.
    pub correlation: f64,
    /// Number of evaluations of the likelihood. The first stage includes those of the prior draws.
    pub evaluations: usize,
}

/// Equally weighted samples of the posterior.
#[derive(Debug, Clone, PartialEq)]
pub struct Samples {
    /// The samples, `[n, d]`.
    pub theta: DMatrix<f64>,
    /// Log-likelihood of each sample, nats, `[n]`.
    pub log_likelihood: Vec<f64>,
    /// Logarithm of the evidence, ∫ prior × likelihood, nats.
    pub log_evidence: f64,
    /// Monte Carlo standard error of `log_evidence`, estimated from this run, nats.
    pub log_evidence_std_error: f64,
    /// The stages, of which the last has the exponent 1.
    pub stages: Vec<Stage>,
    /// Number of evaluations of the likelihood.
    pub evaluations: usize,
}

/// Why sampling failed.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// A setting is outside its range, see [`Settings`].
    #[error("the setting {name} is {value}, which is outside its range")]
    Setting {
        /// Field of [`Settings`].
        name: &'static str,
        /// Value given.
        value: f64,
    },
    /// θ is empty.
    #[error("there is no parameter to sample")]
    NoParameters,
    /// The likelihood is zero at all draws from the prior.
    #[error("the likelihood is zero at all {draws} draws from the prior")]
    ZeroLikelihood {
        /// Number of draws from the prior.
        draws: usize,
    },
    /// The target returned a value that is not the logarithm of a density: a bug of the target.
    #[error("the logarithm of the {density} is {value} at {theta:?}")]
    NotADensity {
        /// Prior or likelihood.
        density: &'static str,
        /// NaN or +∞, or −∞ for a prior at a point that was drawn from it.
        value: f64,
        /// The point, `[d]`.
        theta: Vec<f64>,
    },
    /// The exponent did not reach 1, because the likelihood is concentrated in too small a part of the prior.
    #[error("the exponent of the likelihood reached only {exponent} in {stages} stages, and must reach 1")]
    TooManyStages {
        /// Number of stages.
        stages: usize,
        /// Exponent reached.
        exponent: f64,
    },
}

/// Samples the posterior in stages, from the prior at exponent 0 to the posterior at 1.
///
/// ```text
///  target of stage s:      prior(θ) · L(θ)^p_s,    0 = p_0 < p_1 < … < p_S = 1
///  weights:                w_i = L(θ_i)^(p_s − p_s−1)
///  exponent:               p_s where the coefficient of variation of w is the one wanted, or 1
///  log-evidence:           Σ_s ln mean_i w_i
///  proposal of a step:     θ + β·N(0, C),    C the covariance of the θ_i weighted by w_i
///  accepted with:          min(1, prior(θ')·L(θ')^p_s / prior(θ)·L(θ)^p_s)
/// ```
///
/// In each stage every sample is drawn from the weighted samples of the stage before and moves from there. All samples take the
/// same number of steps, until the correlation of every parameter with its start is at most [`Settings::correlation`]. β is tuned
/// after each step towards an acceptance rate of 0.21/d + 0.23. If zeros of the likelihood alone make the coefficient of
/// variation too large, the first stage stays at exponent 0 and only discards the samples with zero likelihood. A parameter that
/// has collapsed (all samples have the same value) is proposed with its standard deviation over the prior. Adding 1e-12 to the
/// diagonal of the correlation matrix keeps the proposal regular for exactly dependent parameters.
///
/// The standard error is computed from families, which are samples that descend from the same draw from the prior:
///
/// ```text
///  SE² = 1 − (n/(n − 1))^S · (1 − Σ_families (Σ_i∈family W_i)²),    W the normalised weights of the last stage
/// ```
///
/// It is at least the square root of the sum of the variances of the stages, Σ (1/ESS − 1/n). Unlike that sum, it accounts for
/// samples that remain similar over several stages, as in a mode that the samples cannot leave. The estimate of the evidence is
/// nearly unbiased; its logarithm is too low by SE²/2 on average.
///
/// The same seed gives the same bits on any number of threads, because every sample has its own random stream in every stage.
/// `progress` is called after each stage.
///
/// Source: Ching & Chen (2007) for stages, weights and evidence. Betz et al. (2016) for β, and for moving each resampled copy by
/// several steps: in the original method, copies of the same sample form one chain, which is biased. Lee & Whiteley (2018) for
/// the standard error, which requires multinomial resampling.
///
/// # Errors
/// [`Error`] for settings outside their range, and for a target that cannot be sampled.
pub fn tmcmc<T: Target>(
    target: &T,
    settings: &Settings,
    seed: u64,
    progress: &(dyn Fn(&Stage) + Sync),
) -> Result<Samples, Error> {
    settings.check()?;
    let d = target.dimensions();
    if d == 0 {
        return Err(Error::NoParameters);
    }
    let n = settings.samples;
    let mut chains =
        (0..n).into_par_iter().map(|i| Chain::from_prior(target, seed, i)).collect::<Result<Vec<_>, _>>()?;
    if chains.iter().all(|c| c.point.log_likelihood.is_infinite()) {
        return Err(Error::ZeroLikelihood { draws: n });
    }
    let prior_stds = prior_stds(&chains);
    let mut scale = 2.4 / (d as f64).sqrt();
    let mut exponent = 0.0;
    let mut stages: Vec<Stage> = Vec::new();
    loop {
        if stages.len() == MOST_STAGES {
            return Err(Error::TooManyStages { stages: MOST_STAGES, exponent });
        }
        let log_likelihood: Vec<f64> = chains.iter().map(|c| c.point.log_likelihood).collect();
        let next = next_exponent(&log_likelihood, exponent, settings.weight_variation);
        let weights = Weights::new(&log_likelihood, next - exponent);
        exponent = next;
        let factor = proposal_factor(&covariance(&chains, &weights.normalised), &prior_stds);
        let families = weights.family_sum_of_squares(chains.iter().map(|c| c.family));
        chains = resampled(&chains, &weights.normalised, seed, stages.len() + 1);
        let walk = walk(target, settings, exponent, &factor, &prior_stds, &mut chains, &mut scale)?;
        let stage = Stage {
            exponent,
            log_evidence_increment: weights.log_mean,
            effective_sample_size: weights.effective_sample_size,
            evaluations: walk.evaluations + if stages.is_empty() { n } else { 0 },
            ..walk
        };
        progress(&stage);
        stages.push(stage);
        if exponent >= 1.0 {
            return Ok(Samples {
                theta: DMatrix::from_fn(n, d, |i, k| chains[i].point.theta[k]),
                log_likelihood: chains.iter().map(|c| c.point.log_likelihood).collect(),
                log_evidence: stages.iter().map(|s| s.log_evidence_increment).sum(),
                log_evidence_std_error: std_error(&stages, families, n as f64),
                evaluations: stages.iter().map(|s| s.evaluations).sum(),
                stages,
            });
        }
    }
}

// ---- Samples that move ----

#[derive(Debug, Clone)]
struct Point {
    theta: Vec<f64>,
    log_prior: f64,
    log_likelihood: f64,
}

impl Point {
    /// `None` outside the support of the prior.
    fn at<T: Target>(target: &T, theta: Vec<f64>) -> Result<Option<Self>, Error> {
        let checked = |density, value: f64| {
            if value < f64::INFINITY {
                Ok(value)
            } else {
                Err(Error::NotADensity { density, value, theta: theta.clone() })
            }
        };
        let log_prior = checked("prior", target.log_prior(&theta))?;
        if log_prior.is_infinite() {
            return Ok(None);
        }
        let log_likelihood = checked("likelihood", target.log_likelihood(&theta))?;
        Ok(Some(Self { theta, log_prior, log_likelihood }))
    }
}

/// A sample that moves.
struct Chain {
    point: Point,
    /// θ at the beginning of the stage, `[d]`.
    start: Vec<f64>,
    /// Index of the draw from the prior that it descends from.
    family: usize,
    stream: Stream,
}

impl Chain {
    fn from_prior<T: Target>(target: &T, seed: u64, index: usize) -> Result<Self, Error> {
        let mut stream = stream(seed, 0, index);
        let start = target.draw_prior(&mut stream);
        let excluded = || Error::NotADensity { density: "prior", value: f64::NEG_INFINITY, theta: start.clone() };
        let point = Point::at(target, start.clone())?.ok_or_else(excluded)?;
        Ok(Self { point, start, family: index, stream })
    }

    /// Takes one Metropolis step; whether it was accepted, and the number of evaluations.
    fn step<T: Target>(&mut self, target: &T, exponent: f64, factor: &DMatrix<f64>) -> Result<Counts, Error> {
        let normal = DVector::from_fn(self.start.len(), |_, _| self.stream.sample::<f64, _>(StandardNormal));
        let step = factor * normal;
        // Always drawn, so that the state of the random stream does not depend on the outcome.
        let threshold = self.stream.random::<f64>().ln();
        let proposed = self.point.theta.iter().zip(&step).map(|(x, s)| x + s).collect();
        let Some(proposed) = Point::at(target, proposed)? else { return Ok(Counts::default()) };
        // The target of the stage is tempered, so that L^p is compared instead of L. A likelihood of zero is zero at exponent 0,
        // too.
        let log_ratio = if proposed.log_likelihood.is_infinite() {
            f64::NEG_INFINITY
        } else {
            proposed.log_prior - self.point.log_prior + exponent * (proposed.log_likelihood - self.point.log_likelihood)
        };
        let accepted = threshold < log_ratio;
        if accepted {
            self.point = proposed;
        }
        Ok(Counts { accepted: usize::from(accepted), evaluations: 1 })
    }
}

#[derive(Clone, Copy, Default)]
struct Counts {
    accepted: usize,
    evaluations: usize,
}

fn stream(seed: u64, stage: usize, chain: usize) -> Stream {
    stats::stream(seed, &format!("tmcmc stage {stage} chain {chain}"))
}

/// Multinomial resampling: every new sample draws its parent by the weights and starts there.
fn resampled(chains: &[Chain], weights: &[f64], seed: u64, stage: usize) -> Vec<Chain> {
    let cumulative: Vec<f64> = weights
        .iter()
        .scan(0.0, |sum, w| {
            *sum += w;
            Some(*sum)
        })
        .collect();
    let total = cumulative[cumulative.len() - 1];
    let one = |index| {
        let mut stream = stream(seed, stage, index);
        // The level is strictly below the total, and the first sum above it is taken, so that no sample of weight zero is drawn.
        let level = stream.random::<f64>() * total;
        let parent = &chains[cumulative.partition_point(|sum| *sum <= level).min(chains.len() - 1)];
        Chain { point: parent.point.clone(), start: parent.point.theta.clone(), family: parent.family, stream }
    };
    (0..chains.len()).into_par_iter().map(one).collect()
}

/// Moves all samples until their correlation with their starts is small enough. Returns the stage without the results of its
/// weights.
fn walk<T: Target>(
    target: &T,
    settings: &Settings,
    exponent: f64,
    factor: &DMatrix<f64>,
    prior_stds: &DVector<f64>,
    chains: &mut [Chain],
    scale: &mut f64,
) -> Result<Stage, Error> {
    let wanted = 0.21 / prior_stds.len() as f64 + 0.23;
    let mut total = Counts::default();
    let mut steps = 0;
    loop {
        let scaled = factor * *scale;
        let add = |a: Counts, b: Counts| Counts {
            accepted: a.accepted + b.accepted,
            evaluations: a.evaluations + b.evaluations,
        };
        let counts = chains
            .par_iter_mut()
            .map(|c| c.step(target, exponent, &scaled))
            .try_reduce(Counts::default, |a, b| Ok(add(a, b)))?;
        total = add(total, counts);
        steps += 1;
        // The acceptance rate is averaged over all samples, so that it is accurate enough for the full correction.
        let acceptance = counts.accepted as f64 / chains.len() as f64;
        *scale = (*scale * (acceptance - wanted).exp()).clamp(SCALES.0, SCALES.1);
        let correlation = correlation_with_start(chains, prior_stds);
        if correlation <= settings.correlation || steps == settings.most_steps {
            return Ok(Stage {
                exponent,
                log_evidence_increment: 0.0,
                effective_sample_size: 0.0,
                steps,
                acceptance: total.accepted as f64 / (steps * chains.len()) as f64,
                correlation,
                evaluations: total.evaluations,
            });
        }
    }
}

/// Largest correlation with the start over the parameters that are not fixed by the prior; 1 for a collapsed parameter.
fn correlation_with_start(chains: &[Chain], prior_stds: &DVector<f64>) -> f64 {
    let n = chains.len() as f64;
    let one = |k: usize| {
        let mean = |value: &dyn Fn(&Chain) -> f64| chains.iter().map(value).sum::<f64>() / n;
        let (before, now) = (mean(&|c| c.start[k]), mean(&|c| c.point.theta[k]));
        let product = mean(&|c| (c.start[k] - before) * (c.point.theta[k] - now));
        let std_before = mean(&|c| (c.start[k] - before).powi(2)).sqrt();
        let std_now = mean(&|c| (c.point.theta[k] - now).powi(2)).sqrt();
        if std_before.min(std_now) <= COLLAPSED * prior_stds[k] {
            1.0
        } else {
            product / (std_before * std_now)
        }
    };
    (0..prior_stds.len()).filter(|k| prior_stds[*k] > 0.0).map(one).fold(0.0, f64::max)
}

// ---- Error and proposal ----

/// Standard error of the log-evidence; `families` is Σ_families (Σ W)² of the weights of the last stage.
fn std_error(stages: &[Stage], families: f64, n: f64) -> f64 {
    let by_families = 1.0 - (n / (n - 1.0)).powi(stages.len() as i32) * (1.0 - families);
    let by_stages: f64 = stages.iter().map(|s| 1.0 / s.effective_sample_size - 1.0 / n).sum();
    by_families.max(by_stages).max(0.0).sqrt()
}

/// Standard deviation of each parameter over draws from the prior, `[d]`; exactly 0 for a parameter that is fixed.
fn prior_stds(chains: &[Chain]) -> DVector<f64> {
    let weights = vec![1.0 / chains.len() as f64; chains.len()];
    let mut stds = covariance(chains, &weights).diagonal().map(f64::sqrt);
    for (k, std) in stds.iter_mut().enumerate() {
        if chains.iter().all(|c| c.point.theta[k].total_cmp(&chains[0].point.theta[k]).is_eq()) {
            *std = 0.0;
        }
    }
    stds
}

/// Weighted covariance of θ, `[d, d]`; the weights have the sum 1.
fn covariance(chains: &[Chain], weights: &[f64]) -> DMatrix<f64> {
    let d = chains[0].start.len();
    let mut mean = DVector::zeros(d);
    for (chain, weight) in chains.iter().zip(weights) {
        mean.axpy(*weight, &DVector::from_column_slice(&chain.point.theta), 1.0);
    }
    let mut covariance = DMatrix::zeros(d, d);
    for (chain, weight) in chains.iter().zip(weights) {
        let centred = DVector::from_column_slice(&chain.point.theta) - &mean;
        covariance.syger(*weight, &centred, &centred, 1.0);
    }
    covariance.fill_upper_triangle_with_lower_triangle();
    covariance
}

/// Factor F of the proposal covariance C = F·Fᵀ, `[d, d]`, which has full rank except for parameters that the prior fixes.
fn proposal_factor(covariance: &DMatrix<f64>, prior_stds: &DVector<f64>) -> DMatrix<f64> {
    let d = prior_stds.len();
    let stds = covariance.diagonal().map(f64::sqrt);
    let collapsed: Vec<bool> = (0..d).map(|k| prior_stds[k] <= 0.0 || stds[k] <= COLLAPSED * prior_stds[k]).collect();
    let correlation = DMatrix::from_fn(d, d, |i, j| {
        if i == j {
            1.0 + CORRELATION_FLOOR
        } else if collapsed[i] || collapsed[j] {
            0.0
        } else {
            covariance[(i, j)] / (stds[i] * stds[j])
        }
    });
    let widths = DVector::from_fn(d, |k, _| if collapsed[k] { prior_stds[k] } else { stds[k] });
    // For about a hundred exactly dependent parameters, rounding errors can exceed the floor; independent proposals always work.
    let factor = correlation.cholesky().map_or_else(|| DMatrix::identity(d, d), |c| c.l());
    DMatrix::from_diagonal(&widths) * factor
}
