//! The process that is most probable for the batches of an undamaged reference.

use std::sync::atomic::AtomicUsize;

use nalgebra::{DMatrix, DVector};
use rand::Rng as _;
use rand_distr::StandardNormal;
use rayon::prelude::*;

use super::choice::misfits_help;
use super::coverage::Coverage;
use super::estimate::{BatchEstimate, Observation, Scale};
use super::likelihood::log_density;
use super::model::{Modes, Process, Sizes};
use super::search::{most_probable, Candidate};
pub use super::search::{Progress, Watch};
use crate::parameter::DamageDirection;
use crate::stats;

/// Fewest batches of a reference from which a process is learned.
pub const FEWEST_BATCHES: usize = 20;

/// Posterior draws that are kept, and those among which they are chosen by importance.
pub const DRAWS: usize = 100;
const PROPOSED: usize = 1_000;

/// Largest weight of a proposed draw, as a multiple of the mean weight: a few draws in a tail of the posterior, where the proposal is
/// too small, do not take the place of all others.
const LARGEST_WEIGHT: f64 = 20.0;

/// Seed of the draws. It is fixed, so that the process depends on nothing but the batches.
const SEED: u64 = 1;

/// The quantities of a process.
#[derive(Debug, Clone, PartialEq)]
pub struct Quantities {
    /// Their names, `[d]`.
    pub names: Vec<String>,
    /// Their units.
    pub units: Vec<String>,
    /// Which change of each indicates damage.
    pub directions: Vec<DamageDirection>,
    /// ∂ ln f/∂quantity of each mode at the mean of the reference, `[modes, quantities]`; `None` if it is not known, or if the estimates
    /// are based on more than the frequencies.
    pub effects: Option<DMatrix<f64>>,
}

/// Why no process could be fitted.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// Too few batches.
    #[error(
        "{batches} batches: a reference needs at least {FEWEST_BATCHES}, so that the correlation of successive batches can be learned"
    )]
    TooFewBatches {
        /// Batches given.
        batches: usize,
    },
    /// Quantities that too few batches inform.
    #[error("{informed} of {batches} batches inform {quantity}, and at least {FEWEST_BATCHES} are needed")]
    Uninformed {
        /// Its name.
        quantity: String,
        /// Batches that inform it.
        informed: usize,
        /// Batches given.
        batches: usize,
    },
    /// All batches have the same time.
    #[error(
        "the batches were all measured at the same time, so that they do not show how the structure changes in time"
    )]
    NoTime,
    /// The density could not be computed anywhere near the start.
    #[error("the correlation of the batches could not be fitted: {0}")]
    Search(String),
}

/// Fits the process to the estimates of the batches of a reference, in the order of their times. The number of common factors is that
/// with the largest evidence by Laplace's method.
///
/// # Errors
/// [`Error`], see its variants.
pub fn fit(
    quantities: &Quantities,
    covariates: &[String],
    estimates: &[BatchEstimate],
    watch: Watch<'_>,
) -> Result<Process, Error> {
    let batches = estimates.len();
    if batches < FEWEST_BATCHES {
        return Err(Error::TooFewBatches { batches });
    }
    let mut process = unfitted(quantities, covariates, estimates)?;
    let evaluations = AtomicUsize::new(0);
    if let Some(effects) = &quantities.effects {
        if misfits_help(&process, effects, estimates, &evaluations, watch) {
            process.modes = modes(&process, effects, estimates);
        }
    }
    process.usual_errors = usual_errors(&process, estimates).as_slice().to_vec();
    let observations = observations(&process, estimates);
    let best = most_probable(process.sizes(), &observations, &evaluations, watch).map_err(Error::Search)?;
    process.factors = best.factors;
    process.draws = draws(&best, process.sizes(), &observations);
    process.unknowns = best.unknowns;
    Ok(process)
}

/// Draws from the posterior of the unknowns: proposals of Laplace's method, chosen by importance. The method alone would allow values
/// that the batches exclude, such as a large s where they only say that it is small.
fn draws(best: &Candidate, sizes: Sizes, observations: &[Observation]) -> Vec<Vec<f64>> {
    let propose = |place: usize| {
        let mut stream = stats::stream(SEED, &format!("process {place}"));
        let z = DVector::from_fn(best.unknowns.len(), |_, _| stream.sample::<f64, _>(StandardNormal));
        let unknowns = DVector::from_column_slice(&best.unknowns) + &best.factor * &z;
        let density = log_density(unknowns.as_slice(), sizes, observations).unwrap_or(f64::NEG_INFINITY);
        (unknowns.as_slice().to_vec(), density + 0.5 * z.norm_squared())
    };
    let proposed: Vec<(Vec<f64>, f64)> = (0..PROPOSED).into_par_iter().map(propose).collect();
    let largest = proposed.iter().map(|(_, log)| *log).fold(f64::NEG_INFINITY, f64::max);
    let relative: Vec<f64> = proposed.iter().map(|(_, log)| (log - largest).exp()).collect();
    let most = LARGEST_WEIGHT * stats::mean(&relative);
    let bounded: Vec<f64> = relative.iter().map(|weight| weight.min(most)).collect();
    let total: f64 = bounded.iter().sum();
    let weights: Vec<f64> = bounded.iter().map(|weight| weight / total).collect();
    let chosen = stats::systematic(&weights, DRAWS, &mut stats::stream(SEED, "draws of a process"));
    chosen.into_iter().map(|place| proposed[place].0.clone()).collect()
}

/// The estimates as observations of a process.
pub fn observations(process: &Process, estimates: &[BatchEstimate]) -> Vec<Observation> {
    let before = std::iter::once(None).chain(estimates.iter().map(|e| Some(e.at)));
    estimates.iter().zip(before).map(|(estimate, before)| process.observation(estimate, before)).collect()
}

/// Names, scales and step of a process, without its unknowns.
fn unfitted(quantities: &Quantities, covariates: &[String], estimates: &[BatchEstimate]) -> Result<Process, Error> {
    let names = &quantities.names;
    let batches = estimates.len();
    let d = names.len();
    let scale = |(k, name): (usize, &String)| {
        let known: Vec<f64> = estimates.iter().filter_map(|e| e.mean[k]).collect();
        if known.len() < FEWEST_BATCHES {
            return Err(Error::Uninformed { quantity: name.clone(), informed: known.len(), batches });
        }
        let errors: Vec<f64> =
            estimates.iter().filter(|e| e.mean[k].is_some()).map(|e| e.covariance[k * d + k].sqrt()).collect();
        // Batches that agree better than their errors allow do not shrink the unit below the error.
        Ok(Scale::of(&known, stats::mean(&errors)))
    };
    let scales = names.iter().enumerate().map(scale).collect::<Result<Vec<_>, _>>()?;
    let covariate_scale = |j: usize| {
        let known: Vec<f64> = estimates.iter().filter_map(|e| e.covariates[j]).collect();
        Scale::of(&known, 1e-9)
    };
    let mut gaps: Vec<f64> = estimates
        .windows(2)
        .map(|pair| (pair[1].at.micros() - pair[0].at.micros()) as f64 / 1e6)
        .filter(|gap| *gap > 0.0)
        .collect();
    gaps.sort_by(f64::total_cmp);
    let step_s = gaps.get(gaps.len() / 2).copied().ok_or(Error::NoTime)?;
    Ok(Process {
        quantities: names.clone(),
        units: quantities.units.clone(),
        scales,
        covariate_scales: (0..covariates.len()).map(covariate_scale).collect(),
        covariates: covariates.to_vec(),
        step_s,
        factors: 0,
        unknowns: Vec::new(),
        draws: Vec::new(),
        usual_errors: Vec::new(),
        batches,
        period: [estimates[0].at, estimates[batches - 1].at],
        coverage: Some(Coverage::of(covariates.len(), estimates)),
        modes: None,
    })
}

/// The modes of some estimates as coordinates; `None` if a mode is informed by too few batches.
fn modes(process: &Process, effects: &DMatrix<f64>, estimates: &[BatchEstimate]) -> Option<Modes> {
    let scale = |mode: usize| {
        let own =
            |e: &BatchEstimate| e.frequencies.as_ref().and_then(|f| Some((f.ln_ratio[mode]?, f.variance[mode].sqrt())));
        let (known, errors): (Vec<f64>, Vec<f64>) = estimates.iter().filter_map(own).unzip();
        (known.len() >= FEWEST_BATCHES).then(|| Scale::of(&known, stats::mean(&errors)))
    };
    let scales = (0..effects.nrows()).map(scale).collect::<Option<Vec<_>>>()?;
    let standardised = |mode: usize, k: usize| effects[(mode, k)] * process.scales[k].unit / scales[mode].unit;
    let effects = DMatrix::from_fn(effects.nrows(), effects.ncols(), standardised).as_slice().to_vec();
    Some(Modes { scales, effects })
}

/// Mean covariance of the errors of the batches that inform all coordinates; of the variances alone if there is no such batch.
fn usual_errors(process: &Process, estimates: &[BatchEstimate]) -> DMatrix<f64> {
    let d = process.sizes().quantities;
    let all = observations(process, estimates);
    let complete: Vec<&Observation> = all.iter().filter(|o| o.informed.len() == d).collect();
    if !complete.is_empty() {
        let mut sum = DMatrix::zeros(d, d);
        for observation in &complete {
            sum += &observation.covariance;
        }
        return sum / complete.len() as f64;
    }
    let variance = |k: usize| {
        let of_batch =
            |o: &Observation| o.informed.iter().position(|i| *i == k).map(|place| o.covariance[(place, place)]);
        stats::mean(&all.iter().filter_map(of_batch).collect::<Vec<_>>())
    };
    DMatrix::from_fn(d, d, |i, j| if i == j { variance(i) } else { 0.0 })
}
