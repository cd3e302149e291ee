//! Judgement on posterior samples: hyperparameters, damage thresholds, probability of damage, exceedances.

use std::collections::{BTreeMap, BTreeSet};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use statrs::distribution::{ContinuousCDF as _, FisherSnedecor, StudentsT};

use crate::hierarchy::{interval, PopulationEstimate};
use crate::parameter::DamageDirection;
use crate::quantity::{OutOfRange, Probability};
use crate::stats;

/// Mean and spread of one quantity over the measurements of a batch ("pooled" estimate).
///
/// ```text
///  mean    = mean of all samples x_js        (measurement j of n, sample s of S)
///  within  = mean over j of the variance of x_js about its own mean x̄_j      what one measurement leaves open
///  between = variance of the x̄_j over j, with n − 1                          what varies between measurements
///  std²    = n/(n − 1) · variance of the pool = n/(n − 1)·within + between
/// ```
///
/// Source: Wang et al. (2025), §5.2, which pools the samples. The factor n/(n − 1) is ours: 10 samples of one
/// measurement are not 10 measurements. With one measurement a spread over measurements is not identifiable.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Hyperparameters {
    /// Mean, in the quantity's unit.
    pub mean: f64,
    /// Standard deviation, in the quantity's unit; `None` for one measurement.
    pub std: Option<f64>,
    /// Mean posterior variance of a measurement, unit².
    pub within: f64,
    /// Variance of the posterior means, unit²; `None` for one measurement.
    pub between: Option<f64>,
}

impl Hyperparameters {
    /// From pooled samples, `draws` for each measurement, those of one measurement together.
    pub fn from_pool(pool: &[f64], draws: usize) -> Self {
        let measurements = pool.len() / draws;
        let means: Vec<f64> = pool.chunks(draws).map(stats::mean).collect();
        let spread = pool
            .chunks(draws)
            .zip(&means)
            .map(|(samples, mean)| samples.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / draws as f64);
        let within = spread.sum::<f64>() / measurements as f64;
        let between = stats::sample_std(&means).map(|std| std.powi(2));
        let bessel = measurements as f64 / (measurements as f64 - 1.0);
        let std = between.map(|between| (bessel * within + between).sqrt());
        Self { mean: stats::mean(pool), std, within, between }
    }
}

/// The level below which (or above which) a value counts as damaged.
///
/// ```text
///  δ = μ_ud + Φ⁻¹(p) σ_ud      for a loss,       δ = μ_ud − Φ⁻¹(p) σ_ud      for a growth
/// ```
///
/// Source: Wang et al. (2025), Eq. 21 with p = 0.05 (Φ⁻¹ = −1.645).
pub fn threshold(mean: f64, std: f64, direction: DamageDirection, probability: Probability) -> Option<f64> {
    let distance = stats::normal_quantile(probability.get()) * std;
    match direction {
        DamageDirection::Decrease => Some(mean + distance),
        DamageDirection::Increase => Some(mean - distance),
        DamageDirection::None => None,
    }
}

/// Share of the samples on the damaged side of δ, in [0, 1]; `None` when no change of this quantity is damage.
///
/// Source: Wang et al. (2025), §4: P(x < δ), here of the pool itself rather than of a density fitted to it.
pub fn probability_of_damage(pool: &[f64], threshold: f64, direction: DamageDirection) -> Option<f64> {
    let damaged: fn(f64, f64) -> bool = match direction {
        DamageDirection::Decrease => |x, delta| x < delta,
        DamageDirection::Increase => |x, delta| x > delta,
        DamageDirection::None => return None,
    };
    Some(pool.iter().filter(|x| damaged(**x, threshold)).count() as f64 / pool.len() as f64)
}

/// What a quantity is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum QuantityKind {
    /// A parameter of the structure.
    Parameter,
    /// The stiffness of a spring that a parameter sets through a law.
    SpringStiffness,
    /// The mean of parameters that the modes cannot tell apart.
    Group,
}

/// Samples of one monitored quantity of a batch.
#[derive(Debug, Clone)]
pub struct QuantitySamples {
    /// Name: the parameter's, `spring:` and the spring's, or `group:` and the parameters of a group.
    pub name: String,
    /// Unit of the samples.
    pub unit: String,
    /// What it is.
    pub kind: QuantityKind,
    /// Which change counts as damage.
    pub damage: DamageDirection,
    /// The pool: `draws` samples for each measurement, those of one measurement together.
    pub pool: Vec<f64>,
    /// Samples for each measurement.
    pub draws: usize,
    /// The population behind the pool.
    pub population: PopulationEstimate,
    /// Share of the samples within 1 % of an end of the prior.
    pub edge_mass: f64,
    /// Name of the group that this parameter cannot be told apart in.
    pub group: Option<String>,
}

/// The undamaged state of one quantity.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct UndamagedQuantity {
    /// Name of the quantity.
    pub name: String,
    /// Mean μ_ud of the population.
    pub mean: f64,
    /// Standard deviation σ_ud of the population.
    pub std: f64,
    /// Damage threshold δ; `None` when no change of this quantity is damage.
    pub threshold: Option<f64>,
    /// 90 % credible interval of δ.
    pub threshold_interval: Option<[f64; 2]>,
    /// δ of the pool (paper), which the pooled probability of damage is set against.
    pub pooled_threshold: Option<f64>,
    /// What alarm charts compare batches with.
    pub reference: ChartReference,
    /// Posterior draws of μ_ud.
    #[serde(skip)]
    pub mean_draws: Vec<f64>,
    /// Posterior draws of σ_ud.
    #[serde(skip)]
    pub std_draws: Vec<f64>,
}

/// Mean and spread of single measurements in the undamaged state, noise included.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct ChartReference {
    /// Mean of the posterior means of the measurements, in the quantity's unit.
    pub mean: f64,
    /// Their standard deviation about the mean of their batch, in the quantity's unit.
    pub std: f64,
    /// Mean posterior variance of one measurement, unit².
    pub within: f64,
    /// Measurements behind it.
    pub measurements: usize,
    /// Batches behind it.
    pub batches: usize,
    /// Degrees of freedom of the standard deviation.
    pub degrees_of_freedom: usize,
    /// Standard deviation of the batch means beyond what the scatter within batches explains; 0 unless it is significant.
    pub between_batches_std: f64,
}

/// The undamaged state of a structure, which batches are compared with; versions never change.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct UndamagedState {
    /// Version, from 1.
    pub version: u32,
    /// p of the threshold; also the probability of damage above which a batch exceeds.
    pub threshold_probability: f64,
    /// Measurements it was taken from.
    pub measurements: usize,
    /// The quantities, in the order of the baseline's.
    pub quantities: Vec<UndamagedQuantity>,
    /// Covariates under which it was taken.
    pub conditions: BTreeMap<String, SeenCovariate>,
    /// What is doubtful about it, in sentences.
    pub doubts: Vec<String>,
}

/// The values of a covariate that an undamaged state saw.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum SeenCovariate {
    /// Least and largest number.
    Range([f64; 2]),
    /// Categories.
    Categories(BTreeSet<String>),
}

/// Why samples make no undamaged state.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// Too few measurements for a spread.
    #[error(
        "{measurements} measurements: an undamaged state needs at least {least}, so that its spread and with it the \
         threshold are known to some 25 %"
    )]
    TooFewMeasurements {
        /// Measurements given.
        measurements: usize,
        /// Fewest allowed.
        least: usize,
    },
    /// A threshold probability outside (0, 0.5].
    #[error("threshold probability {0} must be above 0 and at most 0.5")]
    ThresholdProbability(f64),
    /// Not a probability at all.
    #[error(transparent)]
    OutOfRange(#[from] OutOfRange),
}

/// Fewest measurements of an undamaged state: with 10 the spread is known to ±24 %.
pub const MINIMUM_MEASUREMENTS: usize = 10;

/// Level at which batches of an undamaged state count as different from each other.
const CONTAMINATION_LEVEL: f64 = 0.001;

/// Level at which the scatter between batches counts as more than that within.
const BETWEEN_LEVEL: f64 = 0.01;

impl UndamagedState {
    /// Takes the samples of several batches, pooled batch after batch, as the undamaged state; `sizes` are the measurements
    /// of each batch.
    ///
    /// # Errors
    /// [`Error`] for too few measurements or a threshold probability outside (0, 0.5].
    pub fn from_samples(samples: &[QuantitySamples], sizes: &[usize], probability: f64) -> Result<Self, Error> {
        if !(probability > 0.0 && probability <= 0.5) {
            return Err(Error::ThresholdProbability(probability));
        }
        let level = Probability::new(probability)?;
        let measurements = samples.first().map_or(0, |s| s.pool.len() / s.draws);
        let too_few = Error::TooFewMeasurements { measurements, least: MINIMUM_MEASUREMENTS };
        if measurements < MINIMUM_MEASUREMENTS {
            return Err(too_few);
        }
        let mut doubts = Vec::new();
        let mut quantity = |sample: &QuantitySamples| {
            let pooled = Hyperparameters::from_pool(&sample.pool, sample.draws);
            let population = &sample.population;
            let (std, pooled_std) = (population.std?, pooled.std?);
            let thresholds: Vec<f64> = population
                .mean_draws
                .iter()
                .zip(&population.std_draws)
                .filter_map(|(m, s)| threshold(*m, *s, sample.damage, level))
                .collect();
            let (reference, doubt) = ChartReference::new(sample, sizes);
            doubts.extend(doubt.map(|doubt| format!("{}: {doubt}", sample.name)));
            Some(UndamagedQuantity {
                name: sample.name.clone(),
                mean: population.mean,
                std,
                threshold: threshold(population.mean, std, sample.damage, level),
                threshold_interval: (!thresholds.is_empty()).then(|| interval(&thresholds)),
                pooled_threshold: threshold(pooled.mean, pooled_std, sample.damage, level),
                reference,
                mean_draws: population.mean_draws.clone(),
                std_draws: population.std_draws.clone(),
            })
        };
        let quantities = samples.iter().map(&mut quantity).collect::<Option<Vec<_>>>().ok_or(too_few)?;
        Ok(Self {
            version: 0,
            threshold_probability: probability,
            measurements,
            quantities,
            conditions: BTreeMap::new(),
            doubts,
        })
    }
}

impl ChartReference {
    /// The reference, and what its batches say against it.
    ///
    /// ```text
    ///  F = variance of the batch means · n̄ / variance within batches ~ F(B − 1, N − B)   for batches of one population
    /// ```
    ///
    /// Where batches differ (p < 0.01) the difference enters the charts; where they differ beyond doubt (p < 0.001), or one
    /// measurement does (Grubbs), the reader is told that something else than scatter is in the undamaged state.
    fn new(sample: &QuantitySamples, sizes: &[usize]) -> (Self, Option<String>) {
        let means: Vec<f64> = sample.pool.chunks(sample.draws).map(stats::mean).collect();
        let count = means.len();
        let mut start = 0;
        let mut batches = Vec::new();
        for &size in sizes.iter().filter(|size| **size > 0) {
            batches.push(&means[start..start + size]);
            start += size;
        }
        let mean = stats::mean(&means);
        let squares = |values: &[f64]| {
            let centre = stats::mean(values);
            values.iter().map(|x| (x - centre).powi(2)).sum::<f64>()
        };
        let (b, n) = (batches.len() as f64, count as f64);
        let total = squares(&means) / (n - 1.0);
        // Batches of one measurement each have no spread within.
        let within_batches = if n > b { batches.iter().map(|x| squares(x)).sum::<f64>() / (n - b) } else { total };
        // The size that stands for all in the variance between unequal batches.
        let size = (n - batches.iter().map(|x| (x.len() as f64).powi(2)).sum::<f64>() / n) / (b - 1.0);
        let (mut between_batches_std, mut doubt) = (0.0, None);
        if batches.len() >= 2 && n > b && within_batches > 0.0 {
            let between: f64 = batches.iter().map(|x| x.len() as f64 * (stats::mean(x) - mean).powi(2)).sum();
            let f = between / (b - 1.0) / within_batches;
            let p = FisherSnedecor::new(b - 1.0, n - b).map_or(1.0, |distribution| distribution.sf(f));
            if p < BETWEEN_LEVEL {
                between_batches_std = ((between / (b - 1.0) - within_batches) / size).max(0.0).sqrt();
            }
            if p < CONTAMINATION_LEVEL {
                doubt = Some(format!(
                    "its batches differ by more than their scatter (p = {p:.0e}): damage, weather or set-up may be among them"
                ));
            }
        }
        if doubt.is_none() && total > 0.0 {
            // Grubbs' test by its t approximation, two-sided.
            let largest = means.iter().map(|x| (x - mean).abs()).fold(0.0, f64::max) / total.sqrt();
            let t2 = n * (n - 2.0) * largest.powi(2) / ((n - 1.0).powi(2) - n * largest.powi(2));
            let p = if t2 > 0.0 {
                StudentsT::new(0.0, 1.0, n - 2.0).map_or(1.0, |t| 2.0 * n * t.sf(t2.sqrt()))
            } else {
                0.0
            };
            if p < CONTAMINATION_LEVEL {
                doubt = Some(format!(
                    "one measurement lies {largest:.1} standard deviations from the others (p = {p:.0e})"
                ));
            }
        }
        let within = Hyperparameters::from_pool(&sample.pool, sample.draws).within;
        let degrees_of_freedom = match (between_batches_std > 0.0, count > batches.len()) {
            (true, _) => batches.len() - 1,
            (false, true) => count - batches.len(),
            (false, false) => count - 1,
        };
        let (std, measurements) = (within_batches.sqrt(), count);
        let batches = batches.len();
        let reference = Self { mean, std, within, measurements, batches, degrees_of_freedom, between_batches_std };
        (reference, doubt)
    }
}

/// A quantity of a batch set against its undamaged state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Damage {
    /// Damage threshold δ, in the quantity's unit.
    pub threshold: f64,
    /// Probability of damage P(x beyond δ) of the population behind the batch: its posterior median.
    pub probability_of_damage: f64,
    /// Its 90 % credible interval, with the uncertainty of the population and of δ; `None` for one measurement.
    pub probability_interval: Option<[f64; 2]>,
    /// Share of the pool beyond the pool's δ (paper).
    pub pooled_probability: f64,
    /// True when the probability of damage exceeds the undamaged threshold probability.
    pub exceeds: bool,
    /// (μ − μ_ud)/μ_ud.
    pub relative_change: f64,
    /// Its 90 % credible interval.
    pub relative_change_interval: Option<[f64; 2]>,
}

/// What a batch says of one quantity.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct QuantityAssessment {
    /// Name: the parameter's, `spring:` and the spring's, or `group:` and the parameters of a group.
    pub name: String,
    /// Unit of mean and standard deviation.
    pub unit: String,
    /// What it is.
    pub kind: QuantityKind,
    /// Mean of the population behind the batch.
    pub mean: f64,
    /// Its 90 % credible interval; `None` in assessments from before there were any.
    pub mean_interval: Option<[f64; 2]>,
    /// Standard deviation of the population; `None` for one measurement, which says nothing of it.
    pub std: Option<f64>,
    /// Its 90 % credible interval.
    pub std_interval: Option<[f64; 2]>,
    /// Mean and spread of the pool (paper).
    pub pooled: Hyperparameters,
    /// Share of the samples within 1 % of an end of the prior: above some per cent, the prior is too narrow or the
    /// simulation does not fit.
    pub edge_mass: f64,
    /// Group that this parameter cannot be told apart in: its damage stands with the group.
    pub group: Option<String>,
    /// Comparison with the undamaged state; `None` without one, when no change of this quantity is damage, when the batch
    /// is not to be trusted, or for a parameter of a group.
    pub damage: Option<Damage>,
}

/// Assesses each quantity, against the undamaged state if there is one.
pub fn assess(samples: &[QuantitySamples], undamaged: Option<&UndamagedState>) -> Vec<QuantityAssessment> {
    let one = |sample: &QuantitySamples| {
        let population = &sample.population;
        let damage = undamaged.filter(|_| sample.group.is_none()).and_then(|state| compare(sample, state));
        QuantityAssessment {
            name: sample.name.clone(),
            unit: sample.unit.clone(),
            kind: sample.kind,
            mean: population.mean,
            mean_interval: Some(population.mean_interval()),
            std: population.std,
            std_interval: population.std_interval(),
            pooled: Hyperparameters::from_pool(&sample.pool, sample.draws),
            edge_mass: sample.edge_mass,
            group: sample.group.clone(),
            damage,
        }
    };
    samples.par_iter().map(one).collect()
}

fn compare(sample: &QuantitySamples, state: &UndamagedState) -> Option<Damage> {
    let reference = state.quantities.iter().find(|q| q.name == sample.name)?;
    let threshold_here = reference.threshold?;
    let pooled_probability = probability_of_damage(&sample.pool, reference.pooled_threshold?, sample.damage)?;
    let draws = population_probabilities(&sample.population, reference, sample.damage, state.threshold_probability);
    let (probability, probability_interval) = match draws {
        Some(draws) => (stats::quantile(&draws, 0.5), Some(interval(&draws))),
        // One measurement: its posterior holds the noise, and so must δ.
        None => (pooled_probability, None),
    };
    let changes: Vec<f64> = sample
        .population
        .mean_draws
        .iter()
        .zip(reference.mean_draws.iter().cycle())
        .map(|(mean, undamaged)| (mean - undamaged) / undamaged)
        .collect();
    Some(Damage {
        threshold: threshold_here,
        probability_of_damage: probability,
        probability_interval,
        pooled_probability,
        exceeds: probability > state.threshold_probability,
        relative_change: (sample.population.mean - reference.mean) / reference.mean,
        relative_change_interval: Some(interval(&changes)),
    })
}

/// Draws of the probability of damage of a normal population, each with its own δ; `None` without a spread.
///
/// ```text
///  PoD = Φ((δ − μ)/σ) for a loss,    δ = μ_ud + Φ⁻¹(p) σ_ud,    (μ, σ) and (μ_ud, σ_ud) drawn from their posteriors
/// ```
fn population_probabilities(
    population: &PopulationEstimate,
    reference: &UndamagedQuantity,
    direction: DamageDirection,
    probability: f64,
) -> Option<Vec<f64>> {
    let level = Probability::new(probability).ok()?;
    if population.std_draws.is_empty() || reference.std_draws.is_empty() {
        return None;
    }
    let undamaged = reference.mean_draws.iter().zip(&reference.std_draws).cycle();
    let one = |((mean, std), (mean_ud, std_ud)): ((&f64, &f64), (&f64, &f64))| {
        let distance = (threshold(*mean_ud, *std_ud, direction, level)? - mean) / std;
        Some(stats::normal_cdf(if direction == DamageDirection::Increase { -distance } else { distance }))
    };
    population.mean_draws.iter().zip(&population.std_draws).zip(undamaged).map(one).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_papers_threshold_and_target_probabilities_follow_from_its_populations() {
        let level = Probability::new(0.05).unwrap();
        let delta = threshold(4.0, 0.3, DamageDirection::Decrease, level).unwrap();
        assert!((delta - 3.5065).abs() < 1e-4); // Fig. 6
        let target = |mean: f64, std: f64, undamaged: f64| {
            let delta = threshold(undamaged, std, DamageDirection::Decrease, level).unwrap();
            stats::normal_cdf((delta - mean) / std)
        };
        // Table 4: 37.76 %, 99.96 %, 99.99 %. The paper computes with 1.645 for 1.64485, which moves the first by 0.005 %,
        // and prints two decimals cut off rather than rounded (37.765 % and 99.992 %): together 0.015 %.
        assert!((target(3.6, 0.3, 4.0) - 0.3776).abs() < 1.5e-4);
        assert!((target(4.5, 0.1, 5.0) - 0.9996).abs() < 1.5e-4);
        assert!(target(4.8, 0.2, 6.0) > 0.9999);
    }

    #[test]
    fn pooled_variance_splits_into_within_and_between() {
        let pool = [1.0, 3.0, 4.0, 6.0, 9.0, 13.0];
        let hyper = Hyperparameters::from_pool(&pool, 2);
        // Means 2, 5, 11; variances about them 1, 1, 4.
        assert!((hyper.within - 2.0).abs() < 1e-12);
        assert!((hyper.between.unwrap() - 21.0).abs() < 1e-12);
        let pooled: f64 = pool.iter().map(|x| (x - 6.0_f64).powi(2)).sum::<f64>() / 6.0;
        assert!((hyper.std.unwrap().powi(2) - pooled * 3.0 / 2.0).abs() < 1e-12);
    }

    #[test]
    fn growth_is_damage_where_the_structure_says_so() {
        let pool = [1.0, 2.0, 3.0, 4.0];
        assert_eq!(probability_of_damage(&pool, 2.5, DamageDirection::Decrease), Some(0.5));
        assert_eq!(probability_of_damage(&pool, 3.5, DamageDirection::Increase), Some(0.25));
        assert_eq!(probability_of_damage(&pool, 2.5, DamageDirection::None), None);
    }

    #[test]
    fn one_measurement_has_a_mean_but_no_spread() {
        let hyper = Hyperparameters::from_pool(&[4.0, 4.2], 2);
        assert!((hyper.mean - 4.1).abs() < 1e-12 && hyper.std.is_none() && hyper.between.is_none());
    }
}
