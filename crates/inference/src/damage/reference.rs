//! The undamaged reference: threshold, chart reference and conditions of each quantity.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use serde::{Deserialize, Serialize};
use statrs::distribution::{ContinuousCDF as _, FisherSnedecor, StudentsT};

use super::doubts::doubts;
use super::joint::JointReference;
use super::pool::{Hyperparameters, Informed, QuantitySamples};
use super::threshold::threshold;
use crate::hierarchy::{interval, Serial};
use crate::process::reference::ReferenceProcess;
use structures::quantity::{OutOfRange, Probability};
use structures::stats;

/// The undamaged reference of one quantity.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct UndamagedQuantity {
    /// Name of the quantity.
    pub name: String,
    /// Mean μ_ud of the population, in the quantity's unit.
    pub mean: f64,
    /// Standard deviation σ_ud of the population, in the quantity's unit.
    pub std: f64,
    /// Damage threshold δ; `None` when no change of this quantity indicates damage.
    pub threshold: Option<f64>,
    /// 90 % credible interval of δ.
    pub threshold_interval: Option<[f64; 2]>,
    /// δ of the pool (paper), for the pooled probability of damage.
    pub pooled_threshold: Option<f64>,
    /// Reference of the alarm charts.
    pub reference: ChartReference,
    /// Posterior draws of μ_ud.
    #[serde(skip)]
    pub mean_draws: Vec<f64>,
    /// Posterior draws of σ_ud.
    #[serde(skip)]
    pub std_draws: Vec<f64>,
}

/// Mean and spread of single measurements in the undamaged reference, noise included.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct ChartReference {
    /// Mean of the posterior means of the measurements, in the quantity's unit.
    pub mean: f64,
    /// Their standard deviation about the mean of their batch, in the quantity's unit.
    pub std: f64,
    /// Mean posterior variance of one measurement, unit².
    pub within: f64,
    /// Number of measurements.
    pub measurements: usize,
    /// Number of batches.
    pub batches: usize,
    /// Degrees of freedom of the standard deviation.
    pub degrees_of_freedom: usize,
    /// Standard deviation τ of the batch means beyond what the scatter within batches explains; 0 unless it is significant.
    pub between_batches_std: f64,
    /// Number of independent measurements that these are worth for the mean; `null` in references of versions that did not estimate it.
    #[serde(default)]
    pub effective_measurements: Option<f64>,
    /// How successive measurements of a batch are correlated; `null` where they count as independent.
    #[serde(default)]
    pub serial: Option<Serial>,
    /// Batches in a year, by their rhythm; `null` where their times do not tell, and in references of earlier versions of the program.
    #[serde(default)]
    pub batches_per_year: Option<f64>,
}

/// The undamaged reference of a structure, which batches are compared with; a version never changes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct UndamagedReference {
    /// Version, from 1.
    pub version: u32,
    /// Threshold probability p, which defines δ. A batch exceeds it when its probability of damage is larger.
    pub threshold_probability: f64,
    /// Number of measurements in it.
    pub measurements: usize,
    /// The quantities, in the order of the trained baseline's.
    pub quantities: Vec<UndamagedQuantity>,
    /// Range or categories of each covariate of its measurements.
    pub conditions: BTreeMap<String, SeenCovariate>,
    /// Reasons to doubt its data, as sentences.
    pub doubts: Vec<String>,
    /// How its parameters move in time; `None` if too few batches show it, which `without_process` explains.
    #[serde(skip)]
    pub process: Option<Arc<ReferenceProcess>>,
    /// Why there is no process.
    #[serde(default)]
    pub without_process: Option<String>,
    /// The joint probability of damage of the undamaged population and its correlations; `None` where the correlations are not
    /// estimated, and in references of versions that did not.
    #[serde(default)]
    pub joint: Option<JointReference>,
    /// Where it comes from.
    #[serde(default)]
    pub origin: ReferenceOrigin,
}

/// Where an undamaged reference comes from.
#[derive(Debug, Clone, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct ReferenceOrigin {
    /// The version whose batches it contains beside others; `None` for one that was declared by itself.
    pub extends: Option<u32>,
    /// The first version of the chain of extensions; `None` for one that was declared by itself.
    pub first: Option<u32>,
    /// Why it was made, in the words of the person who declared it.
    pub reason: Option<String>,
    /// For a reference that was computed again by another trained baseline: when the first one was declared, µs since 1970.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub declared_at_us: Option<i64>,
}

/// The values of a covariate in the undamaged reference.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum SeenCovariate {
    /// Smallest and largest number.
    Range([f64; 2]),
    /// Categories.
    Categories(BTreeSet<String>),
}

/// Why no undamaged reference can be computed from samples.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Error {
    /// Too few measurements to estimate a spread.
    #[error(
        "{measurements} measurements: an undamaged reference needs at least {least}, so that its standard deviation, and with it \
         the damage threshold, is known to about 25 %"
    )]
    TooFewMeasurements {
        /// Measurements given.
        measurements: usize,
        /// Fewest allowed.
        least: usize,
    },
    /// Measurements that are worth too few independent ones.
    #[error(
        "{measurements} measurements that are worth only {effective:.1} independent ones, because successive measurements of {quantity} \
         are correlated ({correlation:.2}): an undamaged reference needs at least {least} independent ones. Declare batches of further \
         days, or measurements that are further apart in time{seen}"
    )]
    TooDependent {
        /// Measurements given.
        measurements: usize,
        /// Independent measurements that they are worth.
        effective: f64,
        /// The quantity with the fewest.
        quantity: String,
        /// Correlation of its successive measurements.
        correlation: f64,
        /// Fewest allowed.
        least: usize,
        /// What else is suspicious about the measurements: empty, or sentences that begin with a full stop.
        seen: String,
    },
    /// A threshold probability outside (0, 0.5].
    #[error("threshold probability {0} must be above 0 and at most 0.5")]
    ThresholdProbability(f64),
    /// A threshold probability that is not in [0, 1].
    #[error(transparent)]
    OutOfRange(#[from] OutOfRange),
}

/// Fewest measurements of an undamaged reference: with 10, the standard error of the standard deviation is 24 %.
pub const MINIMUM_MEASUREMENTS: usize = 10;

/// Significance level at which the data of an undamaged reference raise a doubt, for each of two tests over all quantities together.
const CONTAMINATION_LEVEL: f64 = 0.002;

/// Significance level at which the scatter between batches enters the charts.
const BETWEEN_LEVEL: f64 = 0.01;

impl UndamagedReference {
    /// Computes the undamaged reference from the samples of several batches, pooled batch after batch, each in the order of time; `sizes`
    /// are the numbers of measurements of the batches, `probability` is the threshold probability p. The version is 0 until the reference is stored.
    ///
    /// # Errors
    /// [`Error`] for too few measurements, for measurements worth too few independent ones, or a threshold probability outside (0, 0.5].
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
        let judged = samples.iter().filter(|sample| sample.is_judged()).count();
        let contamination = CONTAMINATION_LEVEL / judged.max(1) as f64;
        let mut doubts = doubts(samples, sizes);
        for sample in samples.iter().filter(|sample| sample.is_judged()) {
            let effective = sample.effective(sizes).of_mean;
            if let Some(serial) = sample.serial.filter(|_| effective < MINIMUM_MEASUREMENTS as f64) {
                return Err(Error::TooDependent {
                    measurements,
                    effective,
                    quantity: sample.name.clone(),
                    correlation: serial.correlation * serial.share,
                    least: MINIMUM_MEASUREMENTS,
                    seen: doubts.iter().flat_map(|doubt| [". ", doubt.as_str()]).collect(),
                });
            }
        }
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
            let (reference, doubt) = ChartReference::new(sample, sizes, contamination);
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
            process: None,
            without_process: None,
            joint: None,
            origin: ReferenceOrigin::default(),
        })
    }
}

impl UndamagedReference {
    /// Number of independent measurements that its measurements are worth, the smallest of its quantities; `None` in references of
    /// versions that did not estimate it.
    pub fn effective_measurements(&self) -> Option<f64> {
        let all: Option<Vec<f64>> = self.quantities.iter().map(|q| q.reference.effective_measurements).collect();
        all?.into_iter().reduce(f64::min)
    }
}

impl ChartReference {
    /// The reference of some independent measurements of one batch: their mean and standard deviation, and the mean posterior variance of one.
    pub fn of_one_batch(mean: f64, std: f64, within: f64, measurements: usize) -> Self {
        Self {
            mean,
            std,
            within,
            measurements,
            batches: 1,
            degrees_of_freedom: measurements.saturating_sub(1),
            between_batches_std: 0.0,
            effective_measurements: None,
            serial: None,
            batches_per_year: None,
        }
    }

    /// What is wrong with a reference that somebody has changed; `None` if the charts can use it.
    pub fn defect(&self) -> Option<&'static str> {
        let spreads = [self.std, self.within, self.between_batches_std];
        if spreads.iter().any(|spread| !spread.is_finite() || *spread < 0.0) {
            return Some("a standard deviation or variance of its chart is negative");
        }
        if !self.mean.is_finite() || self.effective_measurements.is_some_and(|worth| !worth.is_finite() || worth <= 0.0)
        {
            return Some("its chart has no mean, or no measurements");
        }
        let of_correlation =
            |serial: &Serial| (-1.0..=1.0).contains(&serial.correlation) && (0.0..=1.0).contains(&serial.share);
        (!self.serial.iter().all(of_correlation)).then_some("a correlation of its measurements is not from -1 to 1")
    }

    /// Number of independent measurements that its measurements are worth for the mean.
    pub fn independent(&self) -> f64 {
        self.effective_measurements.unwrap_or(self.measurements as f64)
    }

    /// The reference of the alarm charts, and a doubt about its data if there is one.
    ///
    /// If the batches differ (p < 0.01), the scatter between them enters the charts. If they differ strongly (p < `level`), or if one
    /// measurement lies far from the others, a doubt warns that the reference may contain more than random scatter.
    fn new(sample: &QuantitySamples, sizes: &[usize], level: f64) -> (Self, Option<String>) {
        let Informed { means, sizes, within } = &sample.informed(sizes);
        let analysis = Scatter::of(means, sizes, sample.serial, level);
        let doubt = analysis.contamination.clone().or_else(|| outlier(means, level));
        let (count, batches) = (means.len(), analysis.batches);
        let degrees_of_freedom = match (analysis.between_batches_std > 0.0, count > batches) {
            (true, _) => batches - 1,
            (false, true) => analysis.degrees_within,
            (false, false) => count - 1,
        };
        let reference = Self {
            mean: stats::mean(means),
            std: analysis.within_batches.sqrt(),
            within: *within,
            measurements: count,
            batches,
            degrees_of_freedom,
            between_batches_std: analysis.between_batches_std,
            effective_measurements: Some(sample.effective(sizes).of_mean),
            serial: sample.serial,
            batches_per_year: None,
        };
        (reference, doubt)
    }
}

/// One-way analysis of variance of the means of single measurements over their batches.
struct Scatter {
    batches: usize,
    /// Variance within batches, unit².
    within_batches: f64,
    /// Degrees of freedom of that variance.
    degrees_within: usize,
    /// Standard deviation between batches, 0 unless significant.
    between_batches_std: f64,
    contamination: Option<String>,
}

impl Scatter {
    /// ```text
    ///  F = variance of the batch means · n̄ / (variance within batches · τ) ~ F(B − 1, ν)   for batches of one population
    ///  variance within batches = Σ_b SS_b/Σ_b (n_b − τ_b),    τ = Σ_b n_b τ_b/N,    ν = N_e − B
    /// ```
    ///
    /// For independent measurements τ_b = 1 and N_e = N. Correlated ones scatter less about the mean of their batch than about that of
    /// the population, and the mean of a batch is less precise: only what this does not explain is scatter between batches.
    fn of(means: &[f64], sizes: &[usize], serial: Option<Serial>, level: f64) -> Self {
        let mut start = 0;
        let mut batches = Vec::new();
        for &size in sizes.iter().filter(|size| **size > 0) {
            batches.push(&means[start..start + size]);
            start += size;
        }
        let mean = stats::mean(means);
        let (b, n) = (batches.len() as f64, means.len() as f64);
        let tau = |size: usize| serial.map_or(1.0, |serial| serial.inefficiency(size));
        let free: f64 = batches.iter().map(|x| x.len() as f64 - tau(x.len())).sum();
        // Batches with one measurement each have no spread within.
        let within_batches =
            if n > b { batches.iter().map(|x| squares(x)).sum::<f64>() / free } else { squares(means) / (n - 1.0) };
        let degrees_within = match serial {
            Some(serial) if n > b => ((serial.effective(sizes).of_spread - b) as usize).max(1),
            _ => (means.len() - batches.len()).max(1),
        };
        let mean_tau = batches.iter().map(|x| x.len() as f64 * tau(x.len())).sum::<f64>() / n;
        // Equivalent size of unequal batches in the variance between them.
        let size = (n - batches.iter().map(|x| (x.len() as f64).powi(2)).sum::<f64>() / n) / (b - 1.0);
        let mut found = Self {
            batches: batches.len(),
            within_batches,
            degrees_within,
            between_batches_std: 0.0,
            contamination: None,
        };
        if batches.len() >= 2 && n > b && within_batches > 0.0 {
            let between: f64 = batches.iter().map(|x| x.len() as f64 * (stats::mean(x) - mean).powi(2)).sum();
            let of_means = within_batches * mean_tau;
            let f = between / (b - 1.0) / of_means;
            let p = FisherSnedecor::new(b - 1.0, degrees_within as f64).map_or(1.0, |distribution| distribution.sf(f));
            if p < BETWEEN_LEVEL {
                found.between_batches_std = ((between / (b - 1.0) - of_means) / size).max(0.0).sqrt();
            }
            if p < level {
                found.contamination = Some(format!(
                    "its batches differ by more than their scatter ({}): damage, weather or a changed set-up may be the cause",
                    stats::by_chance(p)
                ));
            }
        }
        found
    }
}

/// A doubt when one value lies far from the others, by Grubbs' test in its t approximation, two-sided.
fn outlier(means: &[f64], level: f64) -> Option<String> {
    let n = means.len() as f64;
    let (mean, total) = (stats::mean(means), squares(means) / (n - 1.0));
    if total <= 0.0 {
        return None;
    }
    let largest = means.iter().map(|x| (x - mean).abs()).fold(0.0, f64::max) / total.sqrt();
    let t2 = n * (n - 2.0) * largest.powi(2) / ((n - 1.0).powi(2) - n * largest.powi(2));
    let p = if t2 > 0.0 { StudentsT::new(0.0, 1.0, n - 2.0).map_or(1.0, |t| 2.0 * n * t.sf(t2.sqrt())) } else { 0.0 };
    (p < level).then(|| {
        format!("one measurement lies {largest:.1} standard deviations from the others ({})", stats::by_chance(p))
    })
}

/// Sum of the squared deviations from the mean.
fn squares(values: &[f64]) -> f64 {
    let centre = stats::mean(values);
    values.iter().map(|x| (x - centre).powi(2)).sum::<f64>()
}
