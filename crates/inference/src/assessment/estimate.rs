//! The estimate of a batch that enters the process behind an undamaged reference.

use nalgebra::DMatrix;

use super::batch_mean::{batch_mean, BatchMean, Coordinates, Healthy, Problem};
use super::chart_points::charted_columns;
use super::samples::BatchSamples;
use crate::baseline::observation::Observation;
use crate::baseline::Baseline;
use crate::damage::{Hyperparameters, QuantitySamples};
use crate::process::direction::ChangeDirection;
use crate::process::estimate::BatchEstimate;
use crate::process::fit::Quantities;
use crate::process::misfit::MisfitBasis;
use crate::process::one_factor::FactorPoint;
use structures::measurement::{CovariateValue, ModalMeasurement};
use structures::stats;

/// A batch informs a quantity if the mean posterior variance of a measurement is below this share of the variance of the prior.
const INFORMED: f64 = 0.5;

/// Factors of all frequencies whose estimates are computed: so many on either side of 1, at this distance of their logarithms, each from so many
/// measurements.
const FACTOR_STEPS: i32 = 12;
const FACTOR_STEP: f64 = 0.0025;
const FACTOR_ROWS: usize = 25;

/// Unit of a coordinate of the misfit: the standard deviation of the noise of a measurement.
const NOISE_UNIT: &str = "σ";

/// Share of the batches of a reference that have a covariate whose influence is learned. Those that lack it are not learned from.
const MOST_BATCHES: f64 = 0.9;

/// The quantities that enter the process of a structure: parameters that the modes can distinguish, groups of the others, and the coordinates of
/// the misfit.
pub(super) struct ProcessQuantities {
    pub quantities: Quantities,
    /// Columns of the parameters whose mean each is.
    columns: Vec<Vec<usize>>,
    /// Variance of the prior of each, in its unit squared.
    prior_variances: Vec<f64>,
}

impl ProcessQuantities {
    /// `misfit`: its coordinates, where they are computed.
    pub fn of(baseline: &Baseline, misfit: Option<&MisfitBasis>) -> Self {
        let space = baseline.space().as_slice();
        let mut quantities =
            Quantities { names: Vec::new(), units: Vec::new(), directions: Vec::new(), misfit: misfit.cloned() };
        let (mut prior_variances, mut all_columns) = (Vec::new(), Vec::new());
        for (name, columns) in charted_columns(baseline) {
            quantities.names.push(name);
            quantities.units.push(space[columns[0]].unit.clone());
            quantities.directions.push(space[columns[0]].damage.into());
            // The mean of independent parameters.
            let sum: f64 = columns.iter().map(|column| space[*column].prior_variance()).sum();
            prior_variances.push(sum / (columns.len() as f64).powi(2));
            all_columns.push(columns);
        }
        for name in misfit.iter().flat_map(|misfit| misfit.names()) {
            quantities.names.push(name);
            quantities.units.push(NOISE_UNIT.to_owned());
            quantities.directions.push(ChangeDirection::Either);
        }
        Self { quantities, columns: all_columns, prior_variances }
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

    /// The estimate of a batch about a healthy structure.
    ///
    /// It is that of [`batch_mean`] where this is computed: its error contains what single measurements scatter, and it knows which
    /// combinations of the quantities a batch with missing modes informs. Otherwise it is the mean and the covariance of the draws of the
    /// population behind the samples, to which a single measurement adds the scatter that it cannot show.
    ///
    /// Where the simulation fits the batch less well than its noise explains, the errors are larger than that: their covariance is
    /// multiplied by the larger misfit, that of the single measurements or that of their mean, if it is above 1. So they are where the
    /// measurements scatter further than those of the healthy structure, because some are wrong by too little to be set aside.
    ///
    /// The measurements count as independent, also where successive ones are correlated. The mean of a batch is an estimate of
    /// the state of its time, with the error of its measurements; how slowly the state moves, within a batch as well as from one to the
    /// next, is what the process describes. Widening the error by the effective number of measurements would count that movement twice.
    ///
    /// Source: R. T. Birge (1932), The calculation of errors by the method of least squares, Physical Review 40, 207–227.
    pub fn estimate(
        &self,
        baseline: &Baseline,
        batch: &SampledBatch<'_>,
        covariates: &[String],
        healthy: Option<&Healthy>,
    ) -> Option<(BatchEstimate, Option<Coordinates>)> {
        let beyond = batch.samples.beyond.as_ref().map(|(mean, _)| mean.clone());
        let found = beyond.or_else(|| batch_mean(baseline, &batch.samples.asked, healthy?));
        let scatter = found.as_ref().map_or(1.0, |found| found.scatter);
        let (mean, covariance) = match &found {
            Some(found) => self.of_batch_mean(found),
            None => self.of_draws(batch, healthy)?,
        };
        let larger = batch.samples.fit.misfit().map_or(1.0, |[each, of_mean]| each.max(of_mean)).max(scatter).max(1.0);
        let shown = self.misfit_of(baseline, batch.samples, healthy);
        let (mean, covariance) = self.with_misfit(mean, covariance * larger, shown.as_ref());
        let estimate = BatchEstimate {
            at: batch.measurements.iter().map(|m| m.measured_at).max()?,
            mean,
            covariance: covariance.as_slice().to_vec(),
            covariates: covariates.iter().map(|name| mean_covariate(batch.measurements, name)).collect(),
        };
        Some((estimate, shown))
    }

    /// What one factor of all frequencies does to the estimates, in ascending order of the factor: up to 3 %, as far as the prior holds the
    /// estimates. `like`: a measurement with the usual effects.
    pub fn under_one_factor(&self, baseline: &Baseline, like: &Observation, healthy: &Healthy) -> Vec<FactorPoint> {
        let Ok(usual_hz) = like.simulator(baseline.simulator()).frequencies_hz(&healthy.centre) else {
            return Vec::new();
        };
        let estimated = |ln_factor: f64| {
            let frequencies_hz: Vec<f64> = usual_hz.iter().map(|f| f * ln_factor.exp()).collect();
            let one = Observation { effect_sizes: like.effect_sizes.clone(), ..Observation::complete(&frequencies_hz) };
            let rows = vec![one; FACTOR_ROWS];
            let problem = Problem::new(baseline, &rows, healthy)?;
            let found = problem.solved()?;
            let inside = !problem.is_near_bound(&found, 1.0)?;
            let (mean, covariance) = self.of_batch_mean(&inside.then(|| problem.mean(&found)).flatten()?);
            let shown = self.quantities.misfit.as_ref().and_then(|misfit| problem.misfit_coordinates(&found, misfit));
            Some(self.with_misfit(mean, covariance, shown.as_ref()).0)
        };
        let Some(usual) = estimated(0.0) else { return Vec::new() };
        let point = |step: i32| {
            let ln_factor = f64::from(step) * FACTOR_STEP;
            let means = estimated(ln_factor)?;
            let changes =
                means.iter().zip(&usual).map(|(mean, usual)| Some((*mean)? - (*usual)?)).collect::<Option<_>>()?;
            Some(FactorPoint { ln_factor, changes })
        };
        let mut points: Vec<FactorPoint> = (1..=FACTOR_STEPS).map_while(|step| point(-step)).collect();
        points.reverse();
        points.extend((1..=FACTOR_STEPS).map_while(point));
        points
    }

    /// The estimate without quantities that the batch does not inform.
    pub fn of_informed(&self, mut estimate: BatchEstimate) -> BatchEstimate {
        let d = estimate.mean.len();
        for (k, (mean, prior)) in estimate.mean.iter_mut().zip(&self.prior_variances).enumerate() {
            *mean = mean.filter(|_| estimate.covariance[k * d + k] < INFORMED * prior);
        }
        estimate
    }

    /// The misfit that a batch shows, also by measurements that no point of the prior gives; `None` where it is not computed.
    fn misfit_of(&self, baseline: &Baseline, samples: &BatchSamples, healthy: Option<&Healthy>) -> Option<Coordinates> {
        // An archive that somebody has changed may state another number of modes.
        let fits = |misfit: &&MisfitBasis| misfit.modes == baseline.simulator().modes();
        let misfit = self.quantities.misfit.as_ref().filter(fits).filter(|_| samples.beyond.is_none())?;
        let problem = Problem::new(baseline, &samples.observations, healthy?)?;
        problem.misfit_coordinates(&problem.solved()?, misfit)
    }

    /// The estimate of the parameters with that of the misfit behind it, whose coordinates are not informed where they are not computed.
    ///
    /// The misfit of the simulation makes the errors of the parameters larger, but not its own, which is what it measures.
    fn with_misfit(
        &self,
        mut mean: Vec<Option<f64>>,
        covariance: DMatrix<f64>,
        shown: Option<&Coordinates>,
    ) -> (Vec<Option<f64>>, DMatrix<f64>) {
        let Some(misfit) = &self.quantities.misfit else { return (mean, covariance) };
        let (d, all) = (mean.len(), mean.len() + misfit.count());
        let mut covariance = covariance.resize(all, all, 0.0);
        mean.resize(all, None);
        if let Some(shown) = shown {
            for (own, coordinate) in mean[d..].iter_mut().zip(shown.mean.iter()) {
                *own = Some(*coordinate);
            }
            covariance.view_mut((d, d), shown.covariance.shape()).copy_from(&shown.covariance);
        }
        (mean, covariance)
    }

    /// Whether an estimate informs the misfit.
    pub fn informs_misfit(&self, estimate: &BatchEstimate) -> bool {
        estimate.mean[self.columns.len()..].iter().any(Option::is_some)
    }

    /// Takes the misfit from an estimate.
    pub fn without_misfit(&self, estimate: &mut BatchEstimate) {
        let (d, all) = (self.columns.len(), estimate.mean.len());
        estimate.mean.truncate(d);
        estimate.covariance =
            DMatrix::from_column_slice(all, all, &estimate.covariance).resize(d, d, 0.0).as_slice().to_vec();
    }

    fn of_batch_mean(&self, found: &BatchMean) -> (Vec<Option<f64>>, DMatrix<f64>) {
        let average = |columns: &Vec<usize>| columns.iter().map(|c| found.mean[*c]).sum::<f64>() / columns.len() as f64;
        let mean = self.columns.iter().map(|columns| Some(average(columns))).collect();
        (mean, self.averaged(&found.covariance))
    }

    /// The covariance of the quantities, `[d, d]`, from that of the parameters.
    fn averaged(&self, covariance: &DMatrix<f64>) -> DMatrix<f64> {
        let element = |a: usize, b: usize| {
            let (a, b) = (&self.columns[a], &self.columns[b]);
            let sum: f64 = a.iter().flat_map(|i| b.iter().map(|j| covariance[(*i, *j)])).sum();
            sum / (a.len() * b.len()) as f64
        };
        DMatrix::from_fn(self.columns.len(), self.columns.len(), element)
    }

    fn of_draws(
        &self,
        batch: &SampledBatch<'_>,
        healthy: Option<&Healthy>,
    ) -> Option<(Vec<Option<f64>>, DMatrix<f64>)> {
        let d = self.columns.len();
        let of_name = |name: &String| batch.quantities.iter().find(|s| s.name == *name);
        let own = self.quantities.names[..d].iter().map(of_name).collect::<Option<Vec<_>>>()?;
        let draws = own.iter().map(|s| s.population.mean_draws.len()).min().filter(|draws| *draws > 1)?;
        let centres: Vec<f64> = own.iter().map(|s| stats::mean(&s.population.mean_draws[..draws])).collect();
        let off = DMatrix::from_fn(draws, d, |draw, k| own[k].population.mean_draws[draw] - centres[k]);
        let mut covariance = off.tr_mul(&off) / (draws as f64 - 1.0);
        if let Some(healthy) = healthy.filter(|_| batch.samples.asked.len() == 1) {
            covariance += self.averaged(&healthy.scatter);
        }
        Some(((0..d).map(|k| self.informs(k, own[k]).then_some(centres[k])).collect(), covariance))
    }
}

/// A batch with its samples.
pub(super) struct SampledBatch<'a> {
    pub measurements: &'a [ModalMeasurement],
    pub samples: &'a BatchSamples,
    /// Samples of its monitored quantities.
    pub quantities: &'a [QuantitySamples],
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

/// Numeric covariates that vary and that the batches of a reference have, but for a few of them, in alphabetical order.
pub(super) fn process_covariates(batches: &[&[ModalMeasurement]]) -> Vec<String> {
    let mut names: Vec<&String> = batches.iter().flat_map(|batch| *batch).flat_map(|m| m.covariates.keys()).collect();
    names.sort();
    names.dedup();
    let varies = |name: &&&String| {
        let means: Vec<f64> = batches.iter().filter_map(|batch| mean_covariate(batch, name)).collect();
        let most_have_it = means.len() as f64 >= MOST_BATCHES * batches.len() as f64;
        most_have_it && stats::sample_std(&means).is_some_and(|std| std > 1e-9)
    };
    names.iter().filter(varies).map(|name| (*name).clone()).collect()
}
