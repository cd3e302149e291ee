//! The search for the most probable unknowns of a process and the number of its factors.

use std::cell::RefCell;
use std::sync::atomic::{AtomicUsize, Ordering};

use argmin::core::{CostFunction, Error as SearchError, Executor, Gradient, State as _};
use argmin::solver::linesearch::MoreThuenteLineSearch;
use argmin::solver::quasinewton::LBFGS;
use nalgebra::{DMatrix, SymmetricEigen};
use rayon::prelude::*;

use super::estimate::Observation;
use super::likelihood::{information, log_posterior};
use super::model::Sizes;

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
pub(super) struct Candidate {
    pub(super) factors: usize,
    pub(super) unknowns: Vec<f64>,
    /// A factor L of their covariance L Lᵀ by Laplace's method.
    pub(super) factor: DMatrix<f64>,
    log_evidence: f64,
}

/// The most probable unknowns for some observations. The number of common factors, that of `sizes` is not used, is the one with the
/// largest evidence by Laplace's method.
///
/// # Errors
/// In words, if the density cannot be computed near any start.
pub(super) fn most_probable(
    sizes: Sizes,
    observations: &[Observation],
    evaluations: &AtomicUsize,
    watch: Watch<'_>,
) -> Result<Candidate, String> {
    let d = sizes.quantities;
    let most = if d == 1 { 0 } else { MOST_FACTORS.min(d - 1) };
    let search = |factors: usize| {
        let sizes = Sizes { factors, ..sizes };
        candidate(Target { sizes, observations, last: RefCell::new(None), evaluations, watch })
    };
    let found: Vec<Result<Candidate, String>> = (0..=most).into_par_iter().map(search).collect();
    let failure = found.iter().find_map(|c| c.as_ref().err().cloned()).unwrap_or_default();
    let best = found.into_iter().flatten().max_by(|a, b| a.log_evidence.total_cmp(&b.log_evidence));
    best.ok_or(failure)
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
    let mut factor = eigen.eigenvectors;
    for (mut column, value) in factor.column_iter_mut().zip(values.iter()) {
        column /= value.sqrt();
    }
    let log_det: f64 = values.iter().map(|value| value.ln()).sum();
    let log_evidence = density + 0.5 * (unknowns.len() as f64 * std::f64::consts::TAU.ln() - log_det);
    Ok(Candidate { factors: sizes.factors, unknowns, factor, log_evidence })
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
