//! Admission of measurements: what the trained baseline can use of each, and what has to be left out.

use std::collections::BTreeMap;

use crate::baseline::observation::Observation;
use crate::baseline::Baseline;
use crate::trust::{Finding, FindingCode, FindingEffect};
use structures::measurement::ModalMeasurement;

/// Measurements that the trained baseline can use only in part or not at all, as indices in their batch.
#[derive(Default)]
struct Reservations {
    below_noise_range: Vec<usize>,
    above_noise_range: Vec<usize>,
    unusable: Vec<usize>,
    /// By covariate: measurements that lack it, so that it is marginalised.
    marginalised: BTreeMap<String, Vec<usize>>,
    /// By covariate: measurements whose value lies outside the range from which its effect was learnt.
    beyond: BTreeMap<String, Vec<usize>>,
    /// By input of the learned discrepancy: measurements that lack it.
    inputs_missing: BTreeMap<String, Vec<usize>>,
    /// By input of the learned discrepancy: measurements whose value lies outside those that it was learned from.
    inputs_beyond: BTreeMap<String, Vec<usize>>,
}

/// The observations that can be passed to the flow, each with the index of its measurement in the batch.
pub(super) fn admit(
    baseline: &Baseline,
    kept: &[(usize, ModalMeasurement)],
    findings: &mut Vec<Finding>,
) -> (Vec<usize>, Vec<Observation>) {
    let (mut indices, mut observations) = (Vec::new(), Vec::new());
    let mut found = Reservations::default();
    for (index, measurement) in kept {
        let admitted = baseline.admit(measurement);
        if admitted.below_range {
            found.below_noise_range.push(*index);
        }
        if admitted.above_range {
            found.above_noise_range.push(*index);
        }
        for name in &admitted.covariates_missing {
            found.marginalised.entry(name.clone()).or_default().push(*index);
        }
        for name in &admitted.covariates_beyond {
            found.beyond.entry(name.clone()).or_default().push(*index);
        }
        for name in admitted.inputs_missing {
            found.inputs_missing.entry(name).or_default().push(*index);
        }
        for name in admitted.inputs_beyond {
            found.inputs_beyond.entry(name).or_default().push(*index);
        }
        match admitted.observation {
            Some(observation) => {
                indices.push(*index);
                observations.push(observation);
            }
            None => found.unusable.push(*index),
        }
    }
    findings.extend(found.into_findings(baseline));
    (indices, observations)
}

impl Reservations {
    fn into_findings(self, baseline: &Baseline) -> Vec<Finding> {
        let mut findings = Vec::new();
        for (name, rows) in self.marginalised {
            let message = format!(
                "{} measurements lack {name}, which the simulation depends on: it is marginalised over all values that its effect \
                 was learnt from, which widens the result",
                rows.len()
            );
            findings.push(Finding::new(FindingCode::CovariateMissing, FindingEffect::HoldAlarm, message).of(rows));
        }
        for (name, rows) in self.beyond {
            let message = format!(
                "{} measurements have a {name} outside the range that its effect was learnt from: the nearest end of the range is \
                 used",
                rows.len()
            );
            findings.push(Finding::new(FindingCode::Extrapolated, FindingEffect::HoldAlarm, message).of(rows));
        }
        for (name, rows) in self.inputs_missing {
            let message = format!(
                "{} measurements lack {name}, which the learned discrepancy depends on: they are not corrected, and the variance of \
                 the discrepancy before any data is added to that of their noise",
                rows.len()
            );
            findings.push(Finding::new(FindingCode::CovariateMissing, FindingEffect::HoldAlarm, message).of(rows));
        }
        for (name, rows) in self.inputs_beyond {
            let message = format!(
                "{} measurements have a {name} outside the values that the discrepancy was learned from: the correction is uncertain \
                 there, and its variance is added to that of the noise",
                rows.len()
            );
            findings.push(Finding::new(FindingCode::Extrapolated, FindingEffect::HoldAlarm, message).of(rows));
        }
        let range = baseline.manifest().conditions.noise_range.map_or([0.0; 2], |r| [r.lowest, r.highest]);
        let notes = [
            (
                FindingCode::NoiseBelowRange,
                self.below_noise_range,
                format!(
                    "measurements state less noise than {} times that of the structure, the least that the trained model \
                     covers: this least noise is used for them",
                    range[0]
                ),
            ),
            (
                FindingCode::NoiseAboveRange,
                self.above_noise_range,
                format!(
                    "measurements have modes with more noise than {} times that of the structure, the most that the trained \
                     baseline covers: their intervals are widened to the stated noise, and modes with more than ten times as much are left out; \
                     check that std_hz is a standard deviation in Hz",
                    range[1]
                ),
            ),
            (
                FindingCode::NotUsable,
                self.unusable,
                "measurements are left out: they lack a mode that the trained model needs, or have no mode with a usable noise"
                    .to_owned(),
            ),
        ];
        for (code, rows, message) in notes {
            if !rows.is_empty() {
                let message = format!("{} {message}", rows.len());
                findings.push(Finding::new(code, FindingEffect::Note, message).of(rows));
            }
        }
        findings
    }
}
