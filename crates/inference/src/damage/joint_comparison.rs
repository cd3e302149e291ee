//! The joint probability of damage of a batch: that any of its quantities is beyond its threshold.

use serde::{Deserialize, Serialize};

use super::joint::{pairs, selected, sign, Correlation, JointSamples};
use super::orthant::probability_of_any;
use super::pool::QuantitySamples;
use super::reference::UndamagedReference;
use super::threshold::threshold;
use crate::hierarchy::{interval, PopulationEstimate};
use structures::parameter::DamageDirection;
use structures::quantity::Probability;
use structures::stats;

/// The correlations of a batch and its joint probability of damage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct JointAssessment {
    /// Correlations of each pair of the quantities that take part.
    pub correlations: Vec<Correlation>,
    /// Joint probability of damage; `None` without a comparison with an undamaged reference of the same quantities.
    pub damage: Option<JointDamage>,
}

/// Joint probability of damage of a batch, beside that of its undamaged reference.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct JointDamage {
    /// P(any x_k beyond δ_k) of the population behind the batch: its posterior median.
    pub probability: f64,
    /// Its 90 % credible interval, with the uncertainty of the population and of δ.
    pub probability_interval: [f64; 2],
    /// The same probability of the undamaged population, which it is to be compared with.
    pub reference_probability: f64,
    /// 90 % credible interval of that.
    pub reference_interval: [f64; 2],
    /// True when the lower end of its interval is above the probability of the undamaged population.
    pub exceeds: bool,
    /// The quantities that carry it, the most probable first: those whose own probability of damage exceeds the threshold
    /// probability p of the reference.
    pub carriers: Vec<Carrier>,
}

/// A quantity that carries a joint probability of damage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Carrier {
    /// Its name.
    pub name: String,
    /// Its own probability of damage.
    pub probability_of_damage: f64,
    /// Probability that it is beyond its threshold and that no quantity before it in the list is, for the median of each
    /// population: what it adds to those before it. The sum over the list is at most the joint probability.
    pub added: f64,
}

/// The correlations of a batch and, with an undamaged reference of the same quantities, its joint probability of damage.
///
/// ```text
///  P(any x_k beyond δ_k),    x ~ N(m, Σ),    δ_k = μ_ud,k ± Φ⁻¹(p) σ_ud,k
/// ```
///
/// (m, Σ) and (μ_ud, σ_ud) are drawn from their posteriors, draw by draw for all quantities together; the results are the median and
/// the central interval of the draws. Error of one probability: below 0.002 for equal correlations up to 0.9, at most 1/32 as one approaches ±1 (see `orthant`).
pub fn assess_jointly(
    samples: &[QuantitySamples],
    joint: &JointSamples,
    undamaged: Option<&UndamagedReference>,
) -> JointAssessment {
    let damage = undamaged.and_then(|undamaged| compare(samples, joint, undamaged));
    JointAssessment { correlations: pairs(joint), damage }
}

/// A quantity of the batch with that of the reference.
struct Compared<'a> {
    name: &'a str,
    direction: DamageDirection,
    population: &'a PopulationEstimate,
    mean_draws: &'a [f64],
    std_draws: &'a [f64],
}

impl Compared<'_> {
    /// (x − δ)/σ at the mean, towards health; `None` without a damage direction. `draw`: number of the draw.
    fn limit(&self, draw: usize, level: Probability) -> Option<f64> {
        let undamaged = draw % self.mean_draws.len();
        let delta = threshold(self.mean_draws[undamaged], self.std_draws[undamaged], self.direction, level)?;
        let distance = (self.population.mean_draws[draw] - delta) / self.population.std_draws[draw];
        Some(if self.direction == DamageDirection::Increase { -distance } else { distance })
    }
}

fn compare(samples: &[QuantitySamples], joint: &JointSamples, undamaged: &UndamagedReference) -> Option<JointDamage> {
    let reference = undamaged.joint.as_ref().filter(|reference| reference.quantities == joint.names)?;
    let level = Probability::new(undamaged.threshold_probability).ok()?;
    let own = selected(samples, joint)?;
    let compared = |sample: &&'_ QuantitySamples| {
        let reference = undamaged.quantities.iter().find(|q| q.name == sample.name)?;
        let known = !reference.mean_draws.is_empty() && reference.mean_draws.len() == reference.std_draws.len();
        known.then_some((reference.mean_draws.as_slice(), reference.std_draws.as_slice()))
    };
    let references: Vec<(&[f64], &[f64])> = own.iter().map(compared).collect::<Option<_>>()?;
    let all: Vec<Compared> = own
        .iter()
        .zip(references)
        .map(|(sample, (mean_draws, std_draws))| Compared {
            name: &sample.name,
            direction: sample.damage,
            population: &sample.population,
            mean_draws,
            std_draws,
        })
        .collect();
    let correlation =
        |draw: usize, k: usize, l: usize| sign(own[k]) * sign(own[l]) * joint.correlations.drawn(draw, k, l);
    let draws = joint.correlations.draws();
    let limits: Vec<Vec<f64>> =
        (0..draws).map(|draw| all.iter().map(|q| q.limit(draw, level)).collect()).collect::<Option<_>>()?;
    let probabilities: Vec<f64> = limits
        .iter()
        .enumerate()
        .map(|(draw, limits)| probability_of_any(limits, |k, l| correlation(draw, k, l)))
        .collect();
    let probability = stats::quantile(&probabilities, 0.5);
    let probability_interval = interval(&probabilities);
    let middle: Vec<f64> =
        (0..all.len()).map(|k| stats::quantile(&limits.iter().map(|own| own[k]).collect::<Vec<_>>(), 0.5)).collect();
    let point = |k: usize, l: usize| sign(own[k]) * sign(own[l]) * joint.correlations.point(k, l);
    Some(JointDamage {
        probability,
        probability_interval,
        reference_probability: reference.probability,
        reference_interval: reference.probability_interval,
        exceeds: probability_interval[0] > reference.probability,
        carriers: carriers(&all, &middle, point, undamaged.threshold_probability),
    })
}

/// The quantities whose own probability Φ(−h_k) exceeds p, the most probable first. `limits`: h, `[q]`.
fn carriers(all: &[Compared], limits: &[f64], correlation: impl Fn(usize, usize) -> f64, p: f64) -> Vec<Carrier> {
    let mut order: Vec<usize> = (0..all.len()).filter(|&k| stats::normal_cdf(-limits[k]) > p).collect();
    order.sort_by(|a, b| limits[*a].total_cmp(&limits[*b]));
    let of_first = |count: usize| {
        let limits: Vec<f64> = order[..count].iter().map(|&k| limits[k]).collect();
        probability_of_any(&limits, |i, j| correlation(order[i], order[j]))
    };
    let one = |place: usize| Carrier {
        name: all[order[place]].name.to_owned(),
        probability_of_damage: stats::normal_cdf(-limits[order[place]]),
        added: (of_first(place + 1) - if place == 0 { 0.0 } else { of_first(place) }).max(0.0),
    };
    (0..order.len()).map(one).collect()
}

#[cfg(test)]
mod tests {
    use rand::Rng as _;
    use rand_distr::StandardNormal;

    use super::super::joint::JointReference;
    use super::super::pool::QuantityKind;
    use super::*;
    use crate::hierarchy::Correlations;

    const DRAWS: usize = 400;

    /// A quantity whose posterior is a point.
    fn quantity(name: &str, mean: f64, damage: DamageDirection) -> QuantitySamples {
        let population =
            PopulationEstimate { mean, std: Some(0.2), mean_draws: vec![mean; DRAWS], std_draws: vec![0.2; DRAWS] };
        let mut stream = stats::stream(1, name);
        QuantitySamples {
            name: name.to_owned(),
            unit: "N/m".to_owned(),
            kind: QuantityKind::Parameter,
            damage,
            pool: (0..20).map(|_| mean + 0.2 * stream.sample::<f64, _>(StandardNormal)).collect(),
            draws: 1,
            population,
            prior_bound_mass: 0.0,
            group: None,
            serial: None,
        }
    }

    fn joint(names: &[&str], correlations: &[f64]) -> JointSamples {
        let draws = (0..DRAWS).flat_map(|_| correlations.iter().copied()).collect();
        JointSamples {
            names: names.iter().map(|name| (*name).to_owned()).collect(),
            correlations: Correlations::from_draws(names.len(), draws),
        }
    }

    fn reference(samples: &[QuantitySamples], joint: &JointSamples) -> UndamagedReference {
        let mut reference = UndamagedReference::from_samples(samples, &[20], 0.05).unwrap();
        reference.joint = JointReference::new(samples, joint, Probability::new(0.05).unwrap());
        reference
    }

    #[test]
    fn independent_quantities_multiply_and_those_that_move_together_count_once() {
        let names = ["a", "b"];
        let healthy = names.map(|name| quantity(name, 5.0, DamageDirection::Decrease));
        let damaged = [quantity("a", 4.8, DamageDirection::Decrease), quantity("b", 5.001, DamageDirection::Decrease)];
        // The mean of a has fallen by one standard deviation: P(x < δ) = Φ(−1.645 + 1) = 0.2594.
        for (correlation, undamaged, now) in
            [(0.0, 1.0 - 0.95 * 0.95, 1.0 - 0.95 * (1.0 - 0.2594)), (0.999_999, 0.05, 0.2594)]
        {
            let joint = joint(&names, &[correlation]);
            let found = assess_jointly(&damaged, &joint, Some(&reference(&healthy, &joint)));
            let damage = found.damage.unwrap();
            // The integral has an error of up to 1/32 where the correlation is 1.
            assert!((damage.reference_probability - undamaged).abs() < 0.032, "{correlation}: {damage:?}");
            assert!((damage.probability - now).abs() < 0.032, "{correlation}: {damage:?}");
            assert!(damage.exceeds && damage.carriers.len() == 1 && damage.carriers[0].name == "a", "{damage:?}");
            assert!((damage.carriers[0].added - 0.2595).abs() < 2e-4, "{damage:?}");
        }
    }

    #[test]
    fn a_growth_that_indicates_damage_changes_the_sign_of_its_correlation() {
        let healthy = [quantity("a", 5.0, DamageDirection::Decrease), quantity("b", 5.0, DamageDirection::Increase)];
        let opposed = joint(&["a", "b"], &[-0.999_999]);
        let found = reference(&healthy, &opposed).joint.unwrap();
        assert!((found.probability - 0.05).abs() < 0.032, "both are beyond their thresholds together: {found:?}");
        let aligned = reference(&healthy, &joint(&["a", "b"], &[0.999_999])).joint.unwrap();
        assert!((aligned.probability - 0.1).abs() < 0.032, "never both: {aligned:?}");
    }

    #[test]
    fn other_quantities_or_an_earlier_reference_give_no_joint_probability() {
        let samples = ["a", "b", "c"].map(|name| quantity(name, 5.0, DamageDirection::Decrease));
        let both = joint(&["a", "b"], &[0.5]);
        let mut undamaged = reference(&samples, &both);
        let other = joint(&["a", "c"], &[0.5]);
        assert!(assess_jointly(&samples, &other, Some(&undamaged)).damage.is_none());
        assert!(assess_jointly(&samples, &both, None).damage.is_none());
        assert!(assess_jointly(&samples, &both, Some(&undamaged)).damage.is_some());
        undamaged.joint = None;
        let without = assess_jointly(&samples, &both, Some(&undamaged));
        assert!(without.damage.is_none() && without.correlations.len() == 1, "{without:?}");
        let undirected = [quantity("a", 5.0, DamageDirection::None), quantity("b", 5.0, DamageDirection::Decrease)];
        assert!(JointReference::new(&undirected, &both, Probability::new(0.05).unwrap()).is_none());
    }
}
