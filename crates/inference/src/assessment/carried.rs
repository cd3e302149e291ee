//! An assessment as text, for another process: the same to the last bit, or not at all.

use std::borrow::Cow;

use serde::{Deserialize, Serialize};

use super::result::Assessment;
use crate::process::estimate::BatchEstimate;

/// An assessment together with what clients do not see of it.
#[derive(Serialize, Deserialize)]
struct Carried<'a> {
    assessment: Cow<'a, Assessment>,
    estimate: Cow<'a, Option<BatchEstimate>>,
    /// Of each quantity.
    effective_measurements: Vec<Option<f64>>,
}

impl Assessment {
    /// The assessment as text. `None` if the text would not be read back as the same assessment, because a number is not finite: it has to be
    /// computed where it is needed.
    pub fn carried(&self) -> Option<String> {
        let carried = Carried {
            assessment: Cow::Borrowed(self),
            estimate: Cow::Borrowed(&self.estimate),
            effective_measurements: self.quantities.iter().map(|quantity| quantity.effective_measurements).collect(),
        };
        let text = serde_json::to_string(&carried).ok()?;
        (Self::from_carried(&text).as_ref() == Some(self)).then_some(text)
    }

    /// The assessment of a text that [`Self::carried`] wrote; `None` for any other text.
    pub fn from_carried(text: &str) -> Option<Self> {
        let Carried { assessment, estimate, effective_measurements } = serde_json::from_str(text).ok()?;
        let mut assessment = assessment.into_owned();
        if assessment.quantities.len() != effective_measurements.len() {
            return None;
        }
        assessment.estimate = estimate.into_owned();
        for (quantity, effective) in assessment.quantities.iter_mut().zip(effective_measurements) {
            quantity.effective_measurements = effective;
        }
        Some(assessment)
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::damage::{Damage, Hyperparameters, QuantityAssessment, QuantityKind};
    use crate::trust::Trust;
    use structures::quantity::{Digest, Timestamp};

    /// An assessment with some numbers in all kinds of places.
    fn with(numbers: &[f64; 8], seed: u64) -> Assessment {
        let [a, b, c, d, e, f, g, h] = *numbers;
        let quantity = QuantityAssessment {
            name: "k1".to_owned(),
            unit: "N/m".to_owned(),
            kind: QuantityKind::Parameter,
            mean: a,
            mean_interval: Some([b, c]),
            std: Some(d),
            std_interval: None,
            pooled: Hyperparameters { mean: e, std: Some(f), within: g, between: None },
            prior_bound_mass: h,
            group: None,
            effective_measurements: Some(a),
            damage: Some(Damage {
                threshold: b,
                probability_of_damage: c,
                probability_interval: None,
                pooled_probability: d,
                pooled_exceeds: Some(false),
                exceeds: true,
                relative_change: e,
                relative_change_interval: Some([f, g]),
            }),
        };
        Assessment {
            model_digest: Digest::of(&[b"model"]),
            structure_digest: Digest::of(&[b"structure"]),
            undamaged_version: Some(3),
            seed,
            draws_per_measurement: 10,
            measurements_used: 5,
            measurements_left_out: 0,
            measurements_outside: 1,
            effective_sample_size: h,
            misfit_percent: vec![Some(a), None],
            trust: Trust { p_value: Some(b), distance: Some(c), ..Trust::unknown() },
            assessed_at: Timestamp::from_micros(1_700_000_000_123_456).unwrap(),
            quantities: vec![quantity],
            estimate: Some(BatchEstimate {
                at: Timestamp::from_micros(1_699_999_999_000_001).unwrap(),
                mean: vec![Some(d), None],
                covariance: vec![e, f, g, h],
                covariates: vec![],
            }),
            joint: None,
        }
    }

    fn bits(assessment: &Assessment) -> String {
        // `Debug` prints the shortest text that is read back as the same number, and the sign of zero.
        format!("{assessment:?}")
    }

    proptest! {
        #[test]
        fn what_arrives_is_what_was_sent_to_the_last_bit(bits_of in prop::array::uniform8(any::<u64>()), seed: u64) {
            let numbers = bits_of.map(f64::from_bits);
            let sent = with(&numbers, seed);
            match sent.carried() {
                Some(text) => prop_assert_eq!(bits(&Assessment::from_carried(&text).unwrap()), bits(&sent)),
                None => prop_assert!(numbers.iter().any(|number| !number.is_finite())),
            }
        }
    }

    #[test]
    fn numbers_at_the_ends_of_their_range_arrive_and_others_are_not_sent() {
        let extreme = [f64::MAX, f64::MIN_POSITIVE, 5e-324, -0.0, 0.1, 1.0 / 3.0, -1e-300, 123_456_789.123_456_78];
        let sent = with(&extreme, u64::MAX);
        assert_eq!(bits(&Assessment::from_carried(&sent.carried().unwrap()).unwrap()), bits(&sent));
        for odd in [f64::NAN, f64::INFINITY, f64::NEG_INFINITY] {
            for place in 0..8 {
                let mut numbers = extreme;
                numbers[place] = odd;
                assert_eq!(with(&numbers, 1).carried(), None, "{odd} at {place}");
            }
        }
        for text in ["", "{}", "null", &sent.carried().unwrap()[1..]] {
            assert_eq!(Assessment::from_carried(text), None);
        }
    }
}
