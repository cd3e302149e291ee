//! Transitional Markov chain Monte Carlo: samples of a posterior, and the evidence, from the prior by way of tempering.

use nalgebra::{DMatrix, DVector};
use rand::Rng as _;
use rand_distr::StandardNormal;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::weights::{next_exponent, Weights};
use crate::stats::{self, Stream};

/// Stages after which the exponent will not reach 1 any more.
const MOST_STAGES: usize = 300;

/// Share of its standard deviation over the prior below which a parameter counts as collapsed.
const COLLAPSED: f64 = 1e-9;

/// Added to the diagonal of the correlation matrix of the proposal: parameters in strict dependence stay proposable.
const CORRELATION_FLOOR: f64 = 1e-12;

/// Range of the proposal scale β: far beyond what tuning should need, so that it cannot run away.
const SCALES: (f64, f64) = (1e-6, 10.0);

/// What is sampled: a prior that can be drawn from, and a likelihood.
///
/// All is asked from several threads at once. The same θ must give the same answer every time: a likelihood that simulates
/// draws the same random numbers at every θ.
pub trait Target: Sync {
    /// Length of θ.
    fn dimensions(&self) -> usize;

    /// One draw of the prior, `[d]`.
    fn draw_prior(&self, stream: &mut Stream) -> Vec<f64>;

    /// Logarithm of the prior density, −∞ outside its support. A constant factor, the same everywhere, may be left out: it
    /// changes neither samples nor evidence.
    fn log_prior(&self, theta: &[f64]) -> f64;

    /// Logarithm of the likelihood; −∞ where it is zero, as for a structure that is a mechanism. Only asked inside the
    /// support of the prior. NaN and +∞ are bugs, and end the run.
    fn log_likelihood(&self, theta: &[f64]) -> f64;
}

/// How many samples, and how carefully they move.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Settings {
    /// Samples of each stage, and of the answer; at least 2.
    pub samples: usize,
    /// Coefficient of variation of the weights that each stage goes for, above 0: smaller is more stages.
    pub weight_variation: f64,
    /// Samples move on until no parameter is correlated more than this with its start, between 0 and 1: a short chain would
    /// leave copies that count as samples, which makes the evidence and the spread less certain than they look.
    pub correlation: f64,
    /// Metropolis steps of a sample in one stage, at most; at least 1. Separate modes keep the correlation up, so that it
    /// comes to this many.
    pub most_steps: usize,
}

impl Default for Settings {
    fn default() -> Self {
        Self { samples: 1_000, weight_variation: 1.0, correlation: 0.3, most_steps: 30 }
    }
}

impl Settings {
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

/// One step of the way from the prior to the posterior.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Stage {
    /// Exponent of the likelihood that the samples have reached; 0 when they only left where the likelihood is zero.
    pub exponent: f64,
    /// Logarithm of the mean weight, nats.
    pub log_evidence_increment: f64,
    /// Samples before the stage, counted by their weights: 1/Σ W², W the weights normalised to 1.
    pub effective_sample_size: f64,
    /// Metropolis steps of each sample.
    pub steps: usize,
    /// Share of the proposals that were accepted.
    pub acceptance: f64,
    /// Largest correlation left between a parameter and its start.
    pub correlation: f64,
    /// Calls of the likelihood; those of the prior draws count in the first stage.
    pub evaluations: usize,
}

/// Samples of the posterior, all of the same weight.
#[derive(Debug, Clone, PartialEq)]
pub struct Samples {
    /// `[n, d]`.
    pub theta: DMatrix<f64>,
    /// Log-likelihood of each sample, nats, `[n]`.
    pub log_likelihood: Vec<f64>,
    /// Logarithm of the evidence, ∫ prior × likelihood, nats.
    pub log_evidence: f64,
    /// Its Monte Carlo standard error, estimated from this run, nats.
    pub log_evidence_std_error: f64,
    /// Stages, the last at exponent 1.
    pub stages: Vec<Stage>,
    /// Calls of the likelihood.
    pub evaluations: usize,
}

/// Why there are no samples.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// A setting out of its range.
    #[error("setting {name} cannot be {value}")]
    Setting {
        /// Field of [`Settings`].
        name: &'static str,
        /// What it was.
        value: f64,
    },
    /// θ is empty.
    #[error("there is no parameter to sample")]
    NoParameters,
    /// Nothing to begin with.
    #[error("the likelihood is zero at all {draws} draws of the prior")]
    ZeroLikelihood {
        /// Draws of the prior.
        draws: usize,
    },
    /// A bug of the target.
    #[error("the logarithm of the {density} is {value} at {theta:?}")]
    NotADensity {
        /// Prior or likelihood.
        density: &'static str,
        /// NaN or +∞; also −∞ where a prior excludes its own draw.
        value: f64,
        /// Where, `[d]`.
        theta: Vec<f64>,
    },
    /// The likelihood is too far from the prior.
    #[error("the likelihood has the exponent {exponent} after {stages} stages")]
    TooManyStages {
        /// Stages done.
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
/// In each stage every sample draws a parent by the weights and moves from there, all by the same number of steps:
/// until no parameter is correlated with its start more than [`Settings::correlation`]. β is tuned after each step towards
/// an acceptance of 0.21/d + 0.23. Where the zeros of the likelihood alone vary the weights more than wanted, the first
/// stage only leaves them, at exponent 0. A parameter that has collapsed (all samples in one place) is proposed with its
/// standard deviation over the prior; strict dependence between parameters is loosened by 1e-12 on the diagonal of their
/// correlation matrix.
///
/// The standard error follows the families, the samples with one draw of the prior as ancestor:
///
/// ```text
///  SE² = 1 − (n/(n − 1))^S · (1 − Σ_families (Σ_i∈family W_i)²),    W the normalised weights of the last stage
/// ```
///
/// Unlike the sum of the stages' variances Σ (1/ESS − 1/n), which it is not let below, it sees samples that remain alike
/// through several stages, as in a mode that cannot be left. The estimated evidence is nearly free of bias; its logarithm
/// is low by SE²/2.
///
/// The same seed gives the same bits on any number of threads: every sample has a stream of its own in every stage.
/// `progress` is called after each stage.
///
/// Source: Ching & Chen (2007) for stages, weights and evidence. Betz et al. (2016) for β, and for why the samples move by
/// several steps instead of a chain growing from each as often as it is drawn: such chains are biased. Lee & Whiteley (2018)
/// for the standard error, with multinomial resampling as it needs.
///
/// # Errors
/// [`Error`].
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

struct Chain {
    point: Point,
    /// θ at the beginning of the stage, `[d]`.
    start: Vec<f64>,
    /// Draw of the prior it descends from.
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

    /// One Metropolis step; what it counted.
    fn step<T: Target>(&mut self, target: &T, exponent: f64, factor: &DMatrix<f64>) -> Result<Counts, Error> {
        let normal = DVector::from_fn(self.start.len(), |_, _| self.stream.sample::<f64, _>(StandardNormal));
        let step = factor * normal;
        // Drawn before the outcome is known, so that the stream does not depend on it.
        let threshold = self.stream.random::<f64>().ln();
        let proposed = self.point.theta.iter().zip(&step).map(|(x, s)| x + s).collect();
        let Some(proposed) = Point::at(target, proposed)? else { return Ok(Counts::default()) };
        // Tempered: accepting by L instead of L^p would sample the posterior in the spread of the stage before it. A zero
        // likelihood is zero at exponent 0 too.
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

/// Every new sample draws its parent (multinomial) and starts there.
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
        // Strictly below the total, and the first sum above it: never a weight of zero.
        let level = stream.random::<f64>() * total;
        let parent = &chains[cumulative.partition_point(|sum| *sum <= level).min(chains.len() - 1)];
        Chain { point: parent.point.clone(), start: parent.point.theta.clone(), family: parent.family, stream }
    };
    (0..chains.len()).into_par_iter().map(one).collect()
}

/// Moves all samples until they have forgotten their start; what it took, as a stage without its weights.
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
        // All samples take part in one acceptance: known well enough that the whole difference may count.
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

/// Largest correlation over the parameters that the prior leaves free; 1 for one that had collapsed, or has.
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

/// Standard error of the log-evidence; `families` is Σ_families (Σ W)² of the last weights.
fn std_error(stages: &[Stage], families: f64, n: f64) -> f64 {
    let by_families = 1.0 - (n / (n - 1.0)).powi(stages.len() as i32) * (1.0 - families);
    let by_stages: f64 = stages.iter().map(|s| 1.0 / s.effective_sample_size - 1.0 / n).sum();
    by_families.max(by_stages).max(0.0).sqrt()
}

/// Standard deviation of each parameter over draws of the prior; exactly 0, not rounding, where it is fixed.
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

/// Weighted covariance of θ; the weights sum to 1.
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

/// F with F·Fᵀ = C, of full rank but for parameters that the prior does not leave free.
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
    // Rounding of some hundred parameters in strict dependence can outweigh the floor; each by itself always works.
    let factor = correlation.cholesky().map_or_else(|| DMatrix::identity(d, d), |c| c.l());
    DMatrix::from_diagonal(&widths) * factor
}
