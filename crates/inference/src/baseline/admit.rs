//! From a measurement to the observation that a model can answer.

use super::model::Baseline;
use super::observation::Observation;
use structures::measurement::shape::unit_shape;
use structures::measurement::ModalMeasurement;
use structures::quantity::Hertz;

/// Noise of a mode as a multiple of the largest that the model was trained for, above which the mode is treated as missing: it says
/// hardly more than the prior, and the number is most likely a mistake.
const MOST_BEYOND: f64 = 10.0;

/// A measurement as a model accepts it.
#[derive(Debug, Clone, PartialEq)]
pub struct Admitted {
    /// Input of the inference; `None` when no mode is left.
    pub observation: Option<Observation>,
    /// Some mode had less noise than the model was trained for.
    pub below_range: bool,
    /// Some mode had more noise than the model was trained for.
    pub above_range: bool,
    /// Covariates that an effect needs and the measurement lacks.
    pub covariates_missing: Vec<String>,
    /// Covariates outside the range that an effect was fitted to.
    pub covariates_beyond: Vec<String>,
    /// Inputs of the learned discrepancy that the measurement lacks.
    pub inputs_missing: Vec<String>,
    /// Inputs outside those that the discrepancy was learned from.
    pub inputs_beyond: Vec<String>,
}

impl Baseline {
    /// Prepares a measurement for the inference: it is corrected by the learned discrepancy of the structure, and the structure's
    /// noise is used where none is given.
    ///
    /// A mode with less noise than the model was trained for gets the smallest trained noise, which makes the posterior wider than
    /// necessary. More noise is kept as stated: the flow is asked as for the largest trained noise, and its draws are weighted by the
    /// likelihood under the stated one, or stretched in proportion where a model's draws are not weighted. A mode with more than ten times
    /// the largest trained noise is treated as missing.
    pub fn admit(&self, measurement: &ModalMeasurement) -> Admitted {
        let (inputs_missing, inputs_beyond) = self.simulator.discrepancy_reservations(measurement);
        let measurement = &*self.simulator.corrected(measurement);
        let mut frequencies_hz: Vec<Option<f64>> =
            measurement.frequencies_hz.iter().map(|f| f.map(Hertz::get)).collect();
        let mut noise_multiple = vec![1.0; frequencies_hz.len()];
        let (mut below_range, mut above_range) = (false, false);
        match &self.manifest.conditions.noise_range {
            Some(range) => {
                for (mode, frequency) in frequencies_hz.iter_mut().enumerate() {
                    let given = measurement.std_hz.as_ref().and_then(|stds| stds[mode]);
                    let own = frequency.map(|f| self.simulator.std_hz(mode, f));
                    let given = given.zip(*frequency).map(|(std, f)| self.simulator.with_emulator_error(mode, f, std));
                    let multiple = given.zip(own).map_or(1.0, |(given, own)| given / own);
                    // The tolerance keeps the limits inside the range in spite of rounding.
                    below_range |= frequency.is_some() && multiple < range.lowest * (1.0 - 1e-6);
                    above_range |= frequency.is_some() && multiple > range.highest * (1.0 + 1e-6);
                    if multiple > MOST_BEYOND * range.highest * (1.0 + 1e-6) {
                        *frequency = None;
                    } else if frequency.is_some() {
                        noise_multiple[mode] = multiple.max(range.lowest);
                    }
                }
            }
            // A model without noise was trained on exact and complete measurements only.
            None if frequencies_hz.iter().any(Option::is_none) => frequencies_hz.fill(None),
            None => noise_multiple.fill(0.0),
        }
        let shapes = measurement.mode_shapes.iter().flatten().map(|shape| unit_shape(shape.as_ref()?)).collect();
        let sizes = self.simulator.effect_sizes(&measurement.covariates);
        let sizes_to_marginalise = if sizes.missing.is_empty() {
            Vec::new()
        } else {
            self.simulator.marginalised_sizes(&measurement.covariates)
        };
        let observation =
            Observation { frequencies_hz, noise_multiple, shapes, effect_sizes: sizes.values, sizes_to_marginalise };
        Admitted {
            observation: (observation.modes_present() > 0).then_some(observation),
            below_range,
            above_range,
            covariates_missing: sizes.missing,
            covariates_beyond: sizes.beyond,
            inputs_missing,
            inputs_beyond,
        }
    }
}
