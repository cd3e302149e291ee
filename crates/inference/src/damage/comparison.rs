//! Comparison of the quantities of a batch with the undamaged reference.

use rand::Rng as _;
use rand_distr::StandardNormal;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::pool::{Hyperparameters, QuantityKind, QuantitySamples};
use super::reference::{UndamagedQuantity, UndamagedReference};
use super::threshold::{probability_of_damage, threshold};
use crate::hierarchy::{interval, PopulationEstimate, DRAWS};
use crate::process::estimate::relative;
use structures::parameter::DamageDirection;
use structures::quantity::Probability;
use structures::stats;

/// Comparison of one quantity of a batch with the undamaged reference.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Damage {
    /// Damage threshold δ, in the quantity's unit.
    pub threshold: f64,
    /// Probability of damage P(x beyond δ) of the population behind the batch: its posterior median.
    pub probability_of_damage: f64,
    /// 90 % credible interval of the probability of damage, with the uncertainty of the population and of δ; `None` where the reference
    /// has no draws.
    pub probability_interval: Option<[f64; 2]>,
    /// Share of the pool beyond the pool's δ (paper).
    pub pooled_probability: f64,
    /// Whether this share is above p (paper), which it is in many healthy batches; `None` if the p of a stored comparison is not known.
    pub pooled_exceeds: Option<bool>,
    /// True when the probability of damage is above the threshold probability p of the reference beyond doubt: when the lower end of its
    /// interval is above p. One in twenty healthy batches reaches that by chance, whatever their number of measurements.
    pub exceeds: bool,
    /// Relative change of the mean, (μ − μ_ud)/μ_ud; for a parameter in `ln`, that of its factor, exp(μ − μ_ud) − 1.
    pub relative_change: f64,
    /// 90 % credible interval of the relative change.
    pub relative_change_interval: Option<[f64; 2]>,
}

/// The estimate of one quantity from a batch.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct QuantityAssessment {
    /// Name of the parameter, `spring:` with the name of the spring, or `group:` with the parameters of a group.
    pub name: String,
    /// Unit of mean and standard deviation.
    pub unit: String,
    /// Whether it is a parameter, a spring stiffness or a group.
    pub kind: QuantityKind,
    /// Mean of the population behind the batch, in `unit`.
    pub mean: f64,
    /// 90 % credible interval of the mean; `None` in assessments stored by versions that did not compute it.
    pub mean_interval: Option<[f64; 2]>,
    /// Standard deviation of the population; `None` for one measurement, which does not determine it.
    pub std: Option<f64>,
    /// 90 % credible interval of the standard deviation; `None` for one measurement.
    pub std_interval: Option<[f64; 2]>,
    /// Mean and spread of the pool (paper).
    pub pooled: Hyperparameters,
    /// Posterior mass at the ends of the prior: share of the samples within 1 % of the prior's width from a bound, or beyond three
    /// standard deviations of a normal or log-normal prior. Above a few per
    /// cent the prior is too narrow or the simulation does not fit.
    #[serde(rename = "edge_mass")]
    pub prior_bound_mass: f64,
    /// Group of parameters that this one cannot be distinguished from: damage is assessed for the group.
    pub group: Option<String>,
    /// Number of independent measurements that those of the batch are worth for the mean; `None` in an assessment that was read from
    /// the database.
    #[serde(skip)]
    pub effective_measurements: Option<f64>,
    /// Comparison with the undamaged reference; `None` without one, when no change of this quantity indicates damage, when the
    /// batch is rejected, or for a parameter of a group.
    pub damage: Option<Damage>,
}

/// Assesses each quantity, and compares it with the undamaged reference if there is one.
pub fn assess(samples: &[QuantitySamples], undamaged: Option<&UndamagedReference>) -> Vec<QuantityAssessment> {
    let one = |sample: &QuantitySamples| {
        let population = &sample.population;
        let damage = undamaged.filter(|_| sample.group.is_none()).and_then(|undamaged| compare(sample, undamaged));
        QuantityAssessment {
            name: sample.name.clone(),
            unit: sample.unit.clone(),
            kind: sample.kind,
            mean: population.mean,
            mean_interval: Some(population.mean_interval()),
            std: population.std,
            std_interval: population.std_interval(),
            pooled: Hyperparameters::from_pool(&sample.pool, sample.draws),
            prior_bound_mass: sample.prior_bound_mass,
            group: sample.group.clone(),
            effective_measurements: Some(sample.effective(&[sample.pool.len() / sample.draws]).of_mean),
            damage,
        }
    };
    samples.par_iter().map(one).collect()
}

fn compare(sample: &QuantitySamples, undamaged: &UndamagedReference) -> Option<Damage> {
    let reference = undamaged.quantities.iter().find(|q| q.name == sample.name)?;
    let threshold_here = reference.threshold?;
    let pooled_probability = probability_of_damage(&sample.pool, reference.pooled_threshold?, sample.damage)?;
    let p = undamaged.threshold_probability;
    let draws = population_probabilities(&sample.population, reference, sample.damage, p);
    let (probability, probability_interval) = match draws {
        Some(draws) => (stats::quantile(&draws, 0.5), Some(interval(&draws))),
        // Its posterior includes the noise, and so must δ.
        None => (pooled_probability, None),
    };
    let changes: Vec<f64> = sample
        .population
        .mean_draws
        .iter()
        .zip(reference.mean_draws.iter().cycle())
        .map(|(mean, undamaged)| relative(&sample.unit, *undamaged, mean - undamaged))
        .collect();
    Some(Damage {
        threshold: threshold_here,
        probability_of_damage: probability,
        probability_interval,
        pooled_probability,
        pooled_exceeds: Some(pooled_probability > p),
        exceeds: probability_interval.map_or(probability, |[low, _]| low) > p,
        relative_change: relative(&sample.unit, reference.mean, sample.population.mean - reference.mean),
        // A reference without draws has no interval.
        relative_change_interval: (!changes.is_empty()).then(|| interval(&changes)),
    })
}

/// Draws of the probability of damage of a normal population, each with its own δ; `None` where the reference has no draws.
///
/// ```text
///  PoD = Φ((δ − μ)/σ) for a loss,    δ = μ_ud + Φ⁻¹(p) σ_ud,    (μ, σ) and (μ_ud, σ_ud) drawn from their posteriors
/// ```
///
/// A single measurement x does not show the spread of its population, which is that of the reference then: μ = x + σ_ud z, σ = σ_ud, with x
/// drawn from its posterior and z from a standard normal distribution.
fn population_probabilities(
    population: &PopulationEstimate,
    reference: &UndamagedQuantity,
    direction: DamageDirection,
    probability: f64,
) -> Option<Vec<f64>> {
    let level = Probability::new(probability).ok()?;
    if population.mean_draws.is_empty() || reference.std_draws.is_empty() {
        return None;
    }
    let mut stream = stats::stream(1, "mean of the population of one measurement");
    let (single, count) = (population.std_draws.is_empty(), population.mean_draws.len());
    let one = |draw: usize| {
        let undamaged = draw % reference.std_draws.len();
        let (mean_ud, std_ud) = (reference.mean_draws[undamaged], reference.std_draws[undamaged]);
        let (mean, std) = if single {
            let z: f64 = stream.sample(StandardNormal);
            (population.mean_draws[draw % count] + std_ud * z, std_ud)
        } else {
            (population.mean_draws[draw], population.std_draws[draw])
        };
        let distance = (threshold(mean_ud, std_ud, direction, level)? - mean) / std;
        Some(stats::normal_cdf(if direction == DamageDirection::Increase { -distance } else { distance }))
    };
    (0..if single { DRAWS } else { count }).map(one).collect()
}
