//! The estimate of a batch that enters the process behind an undamaged reference.

use nalgebra::DMatrix;

use super::chart_points::charted_columns;
use crate::baseline::Baseline;
use crate::damage::{Hyperparameters, QuantitySamples};
use crate::process::estimate::BatchEstimate;
use crate::process::fit::Quantities;
use crate::trust::fit::Misfit;
use structures::measurement::{CovariateValue, ModalMeasurement};
use structures::stats;

/// A batch informs a quantity if the mean posterior variance of a measurement is below this share of the variance of the prior.
const INFORMED: f64 = 0.5;

/// The quantities that enter the process of a structure: parameters that the modes can distinguish, and groups of the others.
pub(super) struct ProcessQuantities {
    pub quantities: Quantities,
    /// Variance of the prior of each, in its unit squared.
    prior_variances: Vec<f64>,
}

impl ProcessQuantities {
    pub fn of(baseline: &Baseline) -> Self {
        let space = baseline.space().as_slice();
        let mut quantities = Quantities { names: Vec::new(), units: Vec::new(), directions: Vec::new() };
        let mut prior_variances = Vec::new();
        for (name, columns) in charted_columns(baseline) {
            quantities.names.push(name);
            quantities.units.push(space[columns[0]].unit.clone());
            quantities.directions.push(space[columns[0]].damage);
            // The mean of independent parameters.
            let sum: f64 = columns.iter().map(|column| space[*column].prior_variance()).sum();
            prior_variances.push(sum / (columns.len() as f64).powi(2));
        }
        Self { quantities, prior_variances }
    }

    /// Whether the measurements behind some samples say more about quantity k than its prior.
    fn informs(&self, k: usize, samples: &QuantitySamples) -> bool {
        Hyperparameters::from_pool(&samples.pool, samples.draws).within < INFORMED * self.prior_variances[k]
    }

    /// Names of the quantities that some samples do not inform.
    pub fn not_informed(&self, samples: &[QuantitySamples]) -> Vec<String> {
        let lacks = |(k, name): &(usize, &String)| {
            samples.iter().find(|s| s.name == **name).is_some_and(|samples| !self.informs(*k, samples))
        };
        self.quantities.names.iter().enumerate().filter(lacks).map(|(_, name)| name.clone()).collect()
    }

    /// The estimate from the samples of a batch: mean and covariance of the draws of the mean of its population.
    ///
    /// Where the simulation fits the batch less well than its noise explains, the errors are larger than the draws show: their
    /// covariance is multiplied by the larger `misfit`, that of the single measurements or that of their mean, if it is above 1.
    ///
    /// The draws are those of independent measurements, also where successive ones are correlated. The mean of a batch is an estimate of
    /// the state of its time, with the error of its measurements; how slowly the state moves, within a batch as well as from one to the
    /// next, is what the process describes. Widening the error by the effective number of measurements would count that movement twice.
    ///
    /// Source: R. T. Birge (1932), The calculation of errors by the method of least squares, Physical Review 40, 207–227.
    pub fn estimate(
        &self,
        samples: &[QuantitySamples],
        measurements: &[ModalMeasurement],
        covariates: &[String],
        misfit: Option<Misfit>,
    ) -> Option<BatchEstimate> {
        let d = self.quantities.names.len();
        let of_name = |name: &String| samples.iter().find(|s| s.name == *name);
        let own = self.quantities.names.iter().map(of_name).collect::<Option<Vec<_>>>()?;
        let draws = own.iter().map(|s| s.population.mean_draws.len()).min().filter(|draws| *draws > 1)?;
        let centres: Vec<f64> = own.iter().map(|s| stats::mean(&s.population.mean_draws[..draws])).collect();
        let off = DMatrix::from_fn(draws, d, |draw, k| own[k].population.mean_draws[draw] - centres[k]);
        let larger = misfit.map_or(1.0, |[each, of_mean]| each.max(of_mean).max(1.0));
        let covariance = off.tr_mul(&off) * (larger / (draws as f64 - 1.0));
        let at = measurements.iter().map(|m| m.measured_at).max()?;
        Some(BatchEstimate {
            at,
            mean: (0..d).map(|k| self.informs(k, own[k]).then_some(centres[k])).collect(),
            covariance: covariance.as_slice().to_vec(),
            covariates: covariates.iter().map(|name| mean_covariate(measurements, name)).collect(),
        })
    }
}

/// Mean of a numeric covariate over the measurements that have it.
fn mean_covariate(measurements: &[ModalMeasurement], name: &str) -> Option<f64> {
    let number = |m: &ModalMeasurement| match m.covariates.get(name) {
        Some(CovariateValue::Number(value)) => Some(*value),
        _ => None,
    };
    let known: Vec<f64> = measurements.iter().filter_map(number).collect();
    (!known.is_empty()).then(|| stats::mean(&known))
}

/// Numeric covariates that every batch of a reference has, and that vary, in alphabetical order.
pub(super) fn process_covariates(batches: &[&[ModalMeasurement]]) -> Vec<String> {
    let Some(first) = batches.first() else { return Vec::new() };
    let mut names: Vec<&String> = first.iter().flat_map(|m| m.covariates.keys()).collect();
    names.sort();
    names.dedup();
    let varies = |name: &&&String| {
        let means: Option<Vec<f64>> = batches.iter().map(|batch| mean_covariate(batch, name)).collect();
        means.is_some_and(|means| stats::sample_std(&means).is_some_and(|std| std > 1e-9))
    };
    names.iter().filter(varies).map(|name| (*name).clone()).collect()
}
