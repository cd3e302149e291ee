//! Correlations of the monitored quantities, and the joint probability that any of them is beyond its threshold in the undamaged
//! population itself.

use serde::{Deserialize, Serialize};

use super::orthant::{probability_of_any, MOST};
use super::pool::QuantitySamples;
use crate::hierarchy::{interval, Correlations};
use structures::parameter::DamageDirection;
use structures::quantity::Probability;
use structures::stats;

/// The quantities of a batch that take part in the joint probability of damage, with their correlations: parameters, and groups
/// instead of their parameters, that indicate damage.
#[derive(Debug, Clone, PartialEq)]
pub struct JointSamples {
    /// Names of the quantities, `[q]`.
    pub names: Vec<String>,
    /// Their correlations, with draws that are paired with those of their means and standard deviations.
    pub correlations: Correlations,
}

/// Correlation of two quantities over the measurements of a batch, without the noise of the measurements.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Correlation {
    /// Name of the first quantity.
    pub first: String,
    /// Name of the second quantity.
    pub second: String,
    /// Correlation, in [−1, 1]: its posterior median.
    pub correlation: f64,
    /// Its 90 % credible interval.
    pub interval: [f64; 2],
}

/// The undamaged reference of the joint probability of damage.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct JointReference {
    /// Names of the quantities that take part.
    pub quantities: Vec<String>,
    /// Correlations of each pair of them.
    pub correlations: Vec<Correlation>,
    /// Joint probability P(any x_k beyond δ_k) of the undamaged population itself: its posterior median.
    pub probability: f64,
    /// Its 90 % credible interval.
    pub probability_interval: [f64; 2],
}

impl JointReference {
    /// What is wrong with a reference that somebody has changed; `None` if batches can be compared with it.
    pub fn defect(&self) -> Option<&'static str> {
        let probabilities = self.probability_interval.iter().chain([&self.probability]);
        if !probabilities.into_iter().all(|probability| (0.0..=1.0).contains(probability)) {
            return Some("a joint probability is not from 0 to 1");
        }
        let known = |name: &String| self.quantities.contains(name);
        let is_correlation = |pair: &Correlation| {
            let values = [pair.correlation, pair.interval[0], pair.interval[1]];
            known(&pair.first) && known(&pair.second) && values.iter().all(|value| (-1.0..=1.0).contains(value))
        };
        (!self.correlations.iter().all(is_correlation))
            .then_some("a correlation is not from -1 to 1, or of another quantity")
    }

    /// The reference from the quantities of the undamaged population; `None` where one of them has no spread or does not indicate
    /// damage. `level`: threshold probability p.
    ///
    /// ```text
    ///  P(any x_k beyond δ_k) = P(any v_k > −Φ⁻¹(p)),    v ~ N(0, R_ud)
    /// ```
    ///
    /// R_ud is drawn from its posterior, with the signs of the quantities whose growth indicates damage changed. For independent
    /// quantities this is 1 − (1 − p)^q, and p for quantities that move together.
    pub fn new(samples: &[QuantitySamples], joint: &JointSamples, level: Probability) -> Option<Self> {
        let own = selected(samples, joint)?;
        let limits = vec![-stats::normal_quantile(level.get()); own.len()];
        let one = |draw: usize| {
            probability_of_any(&limits, |k, l| sign(own[k]) * sign(own[l]) * joint.correlations.drawn(draw, k, l))
        };
        let draws: Vec<f64> = (0..joint.correlations.draws()).map(one).collect();
        Some(Self {
            quantities: joint.names.clone(),
            correlations: pairs(joint),
            probability: stats::quantile(&draws, 0.5),
            probability_interval: interval(&draws),
        })
    }
}

/// The samples of the quantities that take part; `None` where one of them is missing, has no spread or does not indicate damage, or
/// where their number is not from two to eight.
pub(super) fn selected<'a>(samples: &'a [QuantitySamples], joint: &JointSamples) -> Option<Vec<&'a QuantitySamples>> {
    let draws = joint.correlations.draws();
    let usable = |sample: &&QuantitySamples| {
        let population = &sample.population;
        let known = population.mean_draws.len() == draws && population.std_draws.len() == draws;
        known && draws > 0 && sample.damage != DamageDirection::None
    };
    let find = |name: &String| samples.iter().find(|sample| sample.name == *name).filter(usable);
    let own: Option<Vec<&QuantitySamples>> = joint.names.iter().map(find).collect();
    own.filter(|own| (2..=MOST).contains(&own.len()) && joint.correlations.size() == own.len())
}

/// The sign of a quantity with which larger values are healthy.
pub(super) fn sign(sample: &QuantitySamples) -> f64 {
    if sample.damage == DamageDirection::Increase {
        -1.0
    } else {
        1.0
    }
}

pub(super) fn pairs(joint: &JointSamples) -> Vec<Correlation> {
    let all = (0..joint.names.len()).flat_map(|k| (0..k).map(move |l| (l, k)));
    let one = |(first, second): (usize, usize)| {
        Some(Correlation {
            first: joint.names[first].clone(),
            second: joint.names[second].clone(),
            correlation: joint.correlations.point(first, second),
            interval: joint.correlations.interval(first, second)?,
        })
    };
    all.filter_map(one).collect()
}
