//! The estimate of a batch that enters the process.

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

use structures::quantity::Timestamp;

/// Unit of a parameter that is the logarithm of a factor.
pub(super) const LOGARITHM: &str = "ln";

/// Estimate of the parameters from one batch.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct BatchEstimate {
    /// Time of the last measurement of the batch.
    pub at: Timestamp,
    /// Mean of each quantity over the batch, in its unit, `[d]`; `None` for one that the measurements do not inform.
    pub mean: Vec<Option<f64>>,
    /// Covariance of the errors of the means, `[d, d]`, row by row; rows of quantities without a mean are not used.
    pub covariance: Vec<f64>,
    /// Mean of each covariate over the batch, `[m]`; `None` where none was measured.
    pub covariates: Vec<Option<f64>>,
}

/// The estimate in standardised units, without the quantities that the batch does not inform.
#[derive(Debug, Clone, PartialEq)]
pub struct Observation {
    /// Time since the observation before, in steps of the process; 0 for the first.
    pub steps: f64,
    /// Indices of the quantities that are informed, ascending, `[o]`.
    pub informed: Vec<usize>,
    /// Their standardised means, `[o]`.
    pub mean: DVector<f64>,
    /// Covariance of their errors as stated, `[o, o]`.
    pub covariance: DMatrix<f64>,
    /// Standardised covariates, `[m]`; 0, their mean, where none was measured.
    pub covariates: DVector<f64>,
    /// Indices of the covariates that were not measured, ascending.
    pub missing: Vec<usize>,
}

/// Origin and unit of standardised values: (value − origin)/unit.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Scale {
    /// Value that becomes 0.
    pub origin: f64,
    /// Difference that becomes 1, positive.
    pub unit: f64,
}

impl Scale {
    /// Mean and standard deviation of some values; the unit is `least` if they scatter less.
    pub fn of(values: &[f64], least: f64) -> Self {
        let unit = structures::stats::sample_std(values).unwrap_or(0.0).max(least);
        Self { origin: structures::stats::mean(values), unit }
    }

    /// The standardised value.
    pub fn standardised(&self, value: f64) -> f64 {
        (value - self.origin) / self.unit
    }
}

impl BatchEstimate {
    /// The estimate in standardised units, `steps` after the one before.
    pub fn standardised(&self, quantities: &[Scale], covariates: &[Scale], steps: f64) -> Observation {
        // A batch that was compared with another reference may lack the quantities at the end.
        let is_informed = |k: &usize| self.mean.get(*k).is_some_and(Option::is_some);
        let informed: Vec<usize> = (0..quantities.len()).filter(is_informed).collect();
        let (o, d) = (informed.len(), self.mean.len());
        let value = |place: usize, _: usize| {
            let k = informed[place];
            quantities[k].standardised(self.mean[k].unwrap_or(quantities[k].origin))
        };
        let element = |i: usize, j: usize| {
            let (a, b) = (informed[i], informed[j]);
            self.covariance[a * d + b] / (quantities[a].unit * quantities[b].unit)
        };
        let covariate = |j: usize, _: usize| self.covariates[j].map_or(0.0, |c| covariates[j].standardised(c));
        Observation {
            steps,
            mean: DVector::from_fn(o, value),
            covariance: DMatrix::from_fn(o, o, element),
            covariates: DVector::from_fn(covariates.len(), covariate),
            missing: (0..covariates.len()).filter(|j| self.covariates[*j].is_none()).collect(),
            informed,
        }
    }
}

/// A difference of a quantity as a share of its mean. A quantity that is the logarithm of a factor (unit `ln`) has a mean that may be 0,
/// and is stated as the change of the factor, exp(difference) − 1.
pub fn relative(unit: &str, mean: f64, difference: f64) -> f64 {
    if unit == LOGARITHM {
        difference.exp_m1()
    } else {
        difference / mean
    }
}

/// [`relative`] in per cent.
pub(super) fn percent(unit: &str, mean: f64, difference: f64) -> f64 {
    100.0 * relative(unit, mean, difference)
}
