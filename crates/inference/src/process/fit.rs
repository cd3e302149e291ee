//! The process that is most probable for the batches of an undamaged reference.

use std::cell::RefCell;
use std::sync::atomic::{AtomicUsize, Ordering};

use argmin::core::{CostFunction, Error as SearchError, Executor, Gradient, State as _};
use argmin::solver::linesearch::MoreThuenteLineSearch;
use argmin::solver::quasinewton::LBFGS;
use nalgebra::{DMatrix, SymmetricEigen};
use rayon::prelude::*;

use super::coverage::Coverage;
use super::direction::ChangeDirection;
use super::draws::draws;
use super::estimate::{BatchEstimate, Observation, Scale};
use super::likelihood::{information, log_density, log_posterior};
use super::misfit::MisfitBasis;
use super::model::{Process, Sizes};
use structures::stats;

/// Fewest batches of a reference from which a process is learned.
pub const FEWEST_BATCHES: usize = 20;

/// Most common factors.
const MOST_FACTORS: usize = 3;

/// Steps of the search, and the vectors that it remembers.
const ITERATIONS: u64 = 300;
const REMEMBERED: usize = 10;

/// A search ends when a step lowers its cost, minus the log density for each observation, by less than this, nats.
const LEAST_GAIN: f64 = 1e-11;

/// Cost where the density cannot be computed. The line search needs finite numbers.
const IMPOSSIBLE: f64 = 1e6;

/// Least eigenvalue of the information: an unknown is never known less well than its prior says, whose widest standard deviation is 3.
const LEAST_INFORMATION: f64 = 0.1;

/// The quantities of a process.
#[derive(Debug, Clone, PartialEq)]
pub struct Quantities {
    /// Their names, `[d]`.
    pub names: Vec<String>,
    /// Their units.
    pub units: Vec<String>,
    /// In which direction a change of each is looked for.
    pub directions: Vec<ChangeDirection>,
    /// The misfit whose coordinates the last of them are, if there are any.
    pub misfit: Option<MisfitBasis>,
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

/// What a fit has done, for those who wait for it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Progress {
    /// Evaluations of the density in the search for the most probable process; their number is not known before.
    Search {
        /// Evaluations so far.
        evaluations: usize,
    },
    /// Operations that were simulated for the limits.
    Limits {
        /// Operations so far.
        done: usize,
        /// Operations in total.
        all: usize,
    },
}

/// Is called from several threads while a process is fitted.
pub type Watch<'a> = &'a (dyn Fn(Progress) + Sync);

/// The density, nats, and its gradient.
type Density = (f64, Vec<f64>);

/// A batch whose errors have this multiple of the usual variance is not a usual one: it lacks a mode.
const MOST_ERROR: f64 = 4.0;

/// What the search minimises: minus the log density for each observation, so that its slopes are of the order of 1.
struct Target<'a> {
    sizes: Sizes,
    observations: &'a [Observation],
    /// The last point and its density: the search asks for cost and gradient of the same point one after the other.
    last: RefCell<Option<(Vec<f64>, Option<Density>)>>,
    evaluations: &'a AtomicUsize,
    watch: Watch<'a>,
}

impl Target<'_> {
    /// The density at some unknowns, with its gradient; `None` where it cannot be computed.
    fn density(&self, unknowns: &[f64]) -> Option<Density> {
        if let Some((point, density)) = self.last.borrow().as_ref() {
            if point == unknowns {
                return density.clone();
            }
        }
        let found = log_posterior(unknowns, self.sizes, self.observations);
        *self.last.borrow_mut() = Some((unknowns.to_vec(), found.clone()));
        let evaluations = self.evaluations.fetch_add(1, Ordering::Relaxed) + 1;
        (self.watch)(Progress::Search { evaluations });
        found
    }
}

impl CostFunction for Target<'_> {
    type Param = Vec<f64>;
    type Output = f64;

    fn cost(&self, unknowns: &Vec<f64>) -> Result<f64, SearchError> {
        Ok(self.density(unknowns).map_or(IMPOSSIBLE, |(density, _)| -density / self.observations.len() as f64))
    }
}

impl Gradient for Target<'_> {
    type Param = Vec<f64>;
    type Gradient = Vec<f64>;

    fn gradient(&self, unknowns: &Vec<f64>) -> Result<Vec<f64>, SearchError> {
        let (_, gradient) = self.density(unknowns).ok_or_else(|| SearchError::msg("the density cannot be computed"))?;
        Ok(gradient.into_iter().map(|slope| -slope / self.observations.len() as f64).collect())
    }
}

/// A fit with a number of factors.
struct Candidate {
    factors: usize,
    unknowns: Vec<f64>,
    /// Their covariance by Laplace's method.
    covariance: DMatrix<f64>,
    log_evidence: f64,
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
    Fit::of(quantities, covariates, estimates, watch)?.with_draws()
}

/// The most probable process for some batches, before draws are made from its posterior.
pub(super) struct Fit {
    /// The process, without draws.
    pub process: Process,
    observations: Vec<Observation>,
    /// Covariance of the unknowns by Laplace's method.
    covariance: DMatrix<f64>,
    /// Logarithm of the evidence for the process by Laplace's method, nats.
    pub log_evidence: f64,
}

impl Fit {
    /// See [`fit`].
    pub fn of(
        quantities: &Quantities,
        covariates: &[String],
        estimates: &[BatchEstimate],
        watch: Watch<'_>,
    ) -> Result<Self, Error> {
        let batches = estimates.len();
        if batches < FEWEST_BATCHES {
            return Err(Error::TooFewBatches { batches });
        }
        let mut process = unfitted(quantities, covariates, estimates)?;
        let observations = observations(&process, estimates);
        let d = quantities.names.len();
        let most = if d == 1 { 0 } else { MOST_FACTORS.min(d - 1) };
        let evaluations = AtomicUsize::new(0);
        let search = |factors: usize| {
            let sizes = Sizes { factors, ..process.sizes() };
            let last = RefCell::new(None);
            candidate(Target { sizes, observations: &observations, last, evaluations: &evaluations, watch })
        };
        let found: Vec<Result<Candidate, String>> = (0..=most).into_par_iter().map(search).collect();
        let failure = found.iter().find_map(|c| c.as_ref().err().cloned()).unwrap_or_default();
        let best = found.into_iter().flatten().max_by(|a, b| a.log_evidence.total_cmp(&b.log_evidence));
        let best = best.ok_or(Error::Search(failure))?;
        process.factors = best.factors;
        process.unknowns = best.unknowns;
        Ok(Self { process, observations, covariance: best.covariance, log_evidence: best.log_evidence })
    }

    /// Standard deviations of the unknowns by Laplace's method, in their order.
    pub fn stds(&self) -> Vec<f64> {
        self.covariance.diagonal().iter().map(|variance| variance.sqrt()).collect()
    }

    /// The process with draws from its posterior.
    ///
    /// # Errors
    /// [`Error::Search`] if the covariance of the unknowns is not positive definite.
    pub fn with_draws(self) -> Result<Process, Error> {
        let Self { mut process, observations, covariance, .. } = self;
        let sizes = process.sizes();
        let draws = draws(&process.unknowns, covariance, |own| log_density(own, sizes, &observations));
        let singular = || Error::Search("the covariance of its unknowns is not positive definite".to_owned());
        process.draws = draws.ok_or_else(singular)?;
        Ok(process)
    }
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
        Ok(Scale::of(&known, stats::quantile(&errors, 0.5)))
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
    let mut process = Process {
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
    };
    process.usual_errors = usual_errors(&process, estimates).as_slice().to_vec();
    Ok(process)
}

/// Mean covariance of the errors of the batches that inform all quantities, those that inform them far less than usual left out; of the
/// variances alone if there is no such batch.
fn usual_errors(process: &Process, estimates: &[BatchEstimate]) -> DMatrix<f64> {
    let d = process.quantities.len();
    let all = observations(process, estimates);
    let complete: Vec<&Observation> = all.iter().filter(|o| o.informed.len() == d).collect();
    if !complete.is_empty() {
        let sizes: Vec<f64> = complete.iter().map(|o| o.covariance.trace()).collect();
        let most = MOST_ERROR * stats::quantile(&sizes, 0.5);
        let usual = complete.iter().zip(&sizes).filter(|(_, size)| **size <= most).map(|(o, _)| &o.covariance);
        let (sum, count) = usual.fold((DMatrix::zeros(d, d), 0.0), |(sum, count), own| (sum + own, count + 1.0));
        return sum / count;
    }
    let variance = |k: usize| {
        let of_batch =
            |o: &Observation| o.informed.iter().position(|i| *i == k).map(|place| o.covariance[(place, place)]);
        stats::mean(&all.iter().filter_map(of_batch).collect::<Vec<_>>())
    };
    DMatrix::from_fn(d, d, |i, j| if i == j { variance(i) } else { 0.0 })
}

fn candidate(target: Target<'_>) -> Result<Candidate, String> {
    let Target { sizes, observations, .. } = target;
    let solver: LBFGS<_, Vec<f64>, Vec<f64>, f64> = LBFGS::new(MoreThuenteLineSearch::new(), REMEMBERED);
    let solver = solver.with_tolerance_cost(LEAST_GAIN).map_err(|e| e.to_string())?;
    let executor =
        Executor::new(target, solver).configure(|state| state.param(start(sizes, observations)).max_iters(ITERATIONS));
    let result = executor.run().map_err(|e| e.to_string())?;
    let unknowns = result.state().get_best_param().cloned().ok_or("the search has no result")?;
    let singular = || "the density cannot be computed at the best fit".to_owned();
    let (density, _) = log_posterior(&unknowns, sizes, observations).ok_or_else(singular)?;
    let eigen = SymmetricEigen::new(information(&unknowns, sizes, observations).ok_or_else(singular)?);
    let values = eigen.eigenvalues.map(|value| value.max(LEAST_INFORMATION));
    let vectors = eigen.eigenvectors;
    let covariance = &vectors * DMatrix::from_diagonal(&values.map(f64::recip)) * vectors.transpose();
    let log_det: f64 = values.iter().map(|value| value.ln()).sum();
    let log_evidence = density + 0.5 * (unknowns.len() as f64 * std::f64::consts::TAU.ln() - log_det);
    Ok(Candidate { factors: sizes.factors, unknowns, covariance, log_evidence })
}

/// Start of the search: factors along the principal directions of the estimates, the rest at the means of the priors.
fn start(sizes: Sizes, observations: &[Observation]) -> Vec<f64> {
    let d = sizes.quantities;
    let mut unknowns: Vec<f64> = super::likelihood::priors(sizes).iter().map(|[mean, _]| *mean).collect();
    let mut moments = DMatrix::zeros(d, d);
    let complete: Vec<&Observation> = observations.iter().filter(|o| o.informed.len() == d).collect();
    for o in &complete {
        moments.ger(1.0 / complete.len() as f64, &o.mean, &o.mean, 1.0);
    }
    let eigen = SymmetricEigen::new(moments);
    let mut order: Vec<usize> = (0..d).collect();
    order.sort_by(|a, b| eigen.eigenvalues[*b].total_cmp(&eigen.eigenvalues[*a]));
    for (j, direction) in order.iter().take(sizes.factors).enumerate() {
        for k in 0..d {
            unknowns[sizes.first_loading() + j * d + k] =
                eigen.eigenvectors[(k, *direction)] * eigen.eigenvalues[*direction].max(0.01).sqrt();
        }
        // Factors with the same persistence could be rotated into one another.
        unknowns[sizes.first_logit() + j] = 2.5 - j as f64;
    }
    unknowns
}
