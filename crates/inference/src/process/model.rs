//! The process and its numbers.

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

use super::coverage::Coverage;
use super::estimate::{BatchEstimate, Observation, Scale};
use structures::quantity::Timestamp;

/// Least variance of the level in standardised units, so that its covariance can be factored.
const LEAST_LEVEL_VARIANCE: f64 = 1e-6;

/// Length of a day, s.
const DAY_S: f64 = 86_400.0;

/// Time after which the level is forgotten, in lengths of the reference.
const LEVEL_LASTS: f64 = 10.0;

/// Numbers d of quantities, m of covariates and q of common factors.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Sizes {
    /// Quantities, d.
    pub quantities: usize,
    /// Covariates, m.
    pub covariates: usize,
    /// Common factors, q.
    pub factors: usize,
    /// Logarithm of the number of steps in a day, on which the priors of what lasts depend.
    pub log_steps_per_day: f64,
}

/// The numbers of a process in standardised units; see the [module](super) for the formulas.
#[derive(Debug, Clone, PartialEq)]
pub struct Numbers {
    /// μ, `[d]`.
    pub mean: DVector<f64>,
    /// B, `[d, m]`.
    pub slopes: DMatrix<f64>,
    /// Λ, `[d, q]`.
    pub loadings: DMatrix<f64>,
    /// Correlation over one step: φ of the factors, then ρ of the quantities, `[q + d]`.
    pub persistence: DVector<f64>,
    /// Stationary variance of the states: 1 for each factor, then s², `[q + d]`.
    pub variance: DVector<f64>,
    /// κ.
    pub noise: f64,
}

impl Sizes {
    /// Number of states, q + d.
    pub fn states(&self) -> usize {
        self.factors + self.quantities
    }

    /// Length of the vector of all unknowns: μ, B by columns, Λ by columns, logits of φ and ρ, ln s, ln κ.
    pub fn unknowns(&self) -> usize {
        let Self { quantities: d, covariates: m, factors: q, .. } = *self;
        d + d * m + d * q + q + d + d + 1
    }

    /// Place of the element of B for a quantity and a covariate in the vector of unknowns.
    pub(super) fn slope(&self, quantity: usize, covariate: usize) -> usize {
        self.quantities * (1 + covariate) + quantity
    }

    /// Place of the first element of Λ in the vector of unknowns.
    pub(super) fn first_loading(&self) -> usize {
        self.quantities * (1 + self.covariates)
    }

    /// Place of the first logit in the vector of unknowns.
    pub(super) fn first_logit(&self) -> usize {
        self.first_loading() + self.quantities * self.factors
    }
}

impl Numbers {
    /// The numbers of a vector of unknowns.
    pub fn of(unknowns: &[f64], sizes: Sizes) -> Self {
        let Sizes { quantities: d, covariates: m, factors: q, .. } = sizes;
        let (logit, n) = (sizes.first_logit(), sizes.states());
        let variance = |i: usize, _: usize| if i < q { 1.0 } else { (2.0 * unknowns[logit + n + i - q]).exp() };
        Self {
            mean: DVector::from_column_slice(&unknowns[..d]),
            slopes: DMatrix::from_column_slice(d, m, &unknowns[d..d + d * m]),
            loadings: DMatrix::from_column_slice(d, q, &unknowns[sizes.first_loading()..logit]),
            persistence: DVector::from_fn(n, |i, _| 1.0 / (1.0 + (-unknowns[logit + i]).exp())),
            variance: DVector::from_fn(n, variance),
            noise: unknowns[logit + n + d].exp(),
        }
    }

    /// H = (Λ, I), `[d, q + d]`: what the states contribute to the quantities.
    pub fn contributions(&self) -> DMatrix<f64> {
        let (d, q) = self.loadings.shape();
        let element = |k: usize, i: usize| if i < q { self.loadings[(k, i)] } else { f64::from(u8::from(i - q == k)) };
        DMatrix::from_fn(d, q + d, element)
    }
}

/// The process behind an undamaged reference.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Process {
    /// Names of the quantities, `[d]`.
    pub quantities: Vec<String>,
    /// Their units.
    pub units: Vec<String>,
    /// Their origins and units.
    pub scales: Vec<Scale>,
    /// Names of the covariates, `[m]`.
    pub covariates: Vec<String>,
    /// Their origins and units.
    pub covariate_scales: Vec<Scale>,
    /// Length of a step: the median time between batches of the reference, s.
    pub step_s: f64,
    /// Number of common factors.
    pub factors: usize,
    /// The most probable unknowns; see [`Sizes::unknowns`].
    pub unknowns: Vec<f64>,
    /// Draws from their posterior, `[draws][unknowns]`: what the reference leaves possible.
    pub draws: Vec<Vec<f64>>,
    /// Mean covariance of the errors of the reference's batches in standardised units, `[d, d]`, by columns.
    pub usual_errors: Vec<f64>,
    /// Number of batches it was fitted to.
    pub batches: usize,
    /// Times of the first and the last of them.
    pub period: [Timestamp; 2],
    /// The conditions that they have seen; `None` in references of earlier versions of the program.
    #[serde(default)]
    pub coverage: Option<Coverage>,
}

impl Process {
    /// Its sizes.
    pub fn sizes(&self) -> Sizes {
        Sizes {
            quantities: self.quantities.len(),
            covariates: self.covariates.len(),
            factors: self.factors,
            log_steps_per_day: (DAY_S / self.step_s).ln(),
        }
    }

    /// Its most probable numbers.
    pub fn numbers(&self) -> Numbers {
        Numbers::of(&self.unknowns, self.sizes())
    }

    /// The numbers with which batches after the reference are filtered: those of the process, with the level μ as further factors.
    ///
    /// The reference does not determine the level exactly, the less so the more slowly its factors move, and a season that is longer
    /// than the reference moves it. The level therefore has the covariance over the draws, and forgets slowly.
    pub fn in_operation(&self) -> Numbers {
        let (sizes, mut numbers) = (self.sizes(), self.numbers());
        let (d, q) = (sizes.quantities, sizes.factors);
        let mut covariance = DMatrix::from_diagonal_element(d, d, LEAST_LEVEL_VARIANCE);
        for draw in &self.draws {
            let error = DVector::from_column_slice(&draw[..d]) - &numbers.mean;
            covariance.ger(1.0 / self.draws.len() as f64, &error, &error, 1.0);
        }
        let Some(level) = covariance.cholesky() else { return numbers };
        let forgets = (-1.0 / (LEVEL_LASTS * self.batches as f64)).exp();
        numbers.loadings = DMatrix::from_fn(d, q + d, |k, j| {
            if j < q {
                numbers.loadings[(k, j)]
            } else {
                level.l_dirty()[(k, j - q)] * f64::from(u8::from(k >= j - q))
            }
        });
        let with_level = |own: &DVector<f64>, value: f64| {
            DVector::from_fn(q + d + d, |i, _| match i {
                i if i < q => own[i],
                i if i < q + d => value,
                i => own[i - d],
            })
        };
        numbers.persistence = with_level(&numbers.persistence, forgets);
        numbers.variance = with_level(&numbers.variance, 1.0);
        numbers
    }

    /// Second moments of the errors of the columns of Λ over the draws, `[q]` of `[d, d]`: what the reference leaves unknown about the
    /// factors.
    pub(super) fn loading_covariances(&self) -> Vec<DMatrix<f64>> {
        let sizes = self.sizes();
        let d = sizes.quantities;
        let of_column = |j: usize| {
            let first = sizes.first_loading() + j * d;
            let best = DVector::from_column_slice(&self.unknowns[first..first + d]);
            let mut sum = DMatrix::zeros(d, d);
            for draw in &self.draws {
                let error = DVector::from_column_slice(&draw[first..first + d]) - &best;
                sum.ger(1.0 / self.draws.len() as f64, &error, &error, 1.0);
            }
            sum
        };
        (0..sizes.factors).map(of_column).collect()
    }

    /// An estimate in standardised units, observed after a batch at `before`.
    pub fn observation(&self, estimate: &BatchEstimate, before: Option<Timestamp>) -> Observation {
        let steps = before.map_or(0.0, |before| {
            let seconds = (estimate.at.micros() - before.micros()) as f64 / 1e6;
            (seconds / self.step_s).max(0.0)
        });
        estimate.standardised(&self.scales, &self.covariate_scales, steps)
    }
}
