//! The simulation and the measurements that a diagnosis compares.

use super::data::Data;
use crate::physics::effect::Target;
use crate::simulator::Simulator;

/// A simulation without effects and the measurements that it is compared with.
pub struct Study<'a> {
    /// The simulation.
    pub simulator: &'a Simulator,
    /// The measurements.
    pub data: &'a Data,
    /// Parameters that are not set in every row.
    pub(super) free: Vec<usize>,
    /// For each row, the modes present and the sum of the logarithms of their stated noise.
    pub(super) present: Vec<(Vec<usize>, f64)>,
}

impl<'a> Study<'a> {
    /// A study of `data` under `simulator`.
    pub fn new(simulator: &'a Simulator, data: &'a Data) -> Self {
        let set = |k: &usize| data.settings.iter().all(|row| row[*k].is_some());
        let free = (0..simulator.space().len()).filter(|k| !set(k)).collect();
        let present = |(y, noise): (&Vec<f64>, &Vec<f64>)| {
            let present: Vec<usize> = (0..y.len()).filter(|mode| y[*mode].is_finite()).collect();
            let log_noise = present.iter().map(|mode| noise[*mode].ln()).sum();
            (present, log_noise)
        };
        let present = data.log_frequencies.iter().zip(&data.noise).map(present).collect();
        Self { simulator, data, free, present }
    }

    /// Columns of the free parameters, which are not set in every row, `[free]`.
    pub fn free(&self) -> &[usize] {
        &self.free
    }

    /// Whether an effect on this target acts in a row: one on a setting does not where it was not set, and one of the instrument
    /// does not where a second instrument was used.
    pub fn is_set(&self, row: usize, target: &Target) -> bool {
        match target {
            Target::SettingOffset(k) | Target::SettingScale(k) => self.data.settings[row][*k].is_some(),
            Target::FrequencyScale(_) | Target::FrequencyOffset(_) => !self.data.second_instrument[row],
            _ => true,
        }
    }
}
