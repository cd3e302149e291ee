//! The rules that measurements of a structure must satisfy.

use super::Simulator;
use crate::measurement::check::{Expectation, Purpose};
use crate::quantity::Timestamp;

impl Simulator {
    /// The rules for measurements of this structure that are assessed and arrive at the time `now`, at most `max_measurements` in a batch.
    pub fn expectation(&self, now: Timestamp, max_measurements: usize) -> Expectation<'_> {
        Expectation {
            purpose: Purpose::Assessment,
            modes: self.modes(),
            frequency_limits_hz: self.frequency_limits_hz(),
            covariates: self.covariates(),
            instrumented: self.instrumented_points(),
            space: self.space(),
            now,
            max_measurements,
        }
    }
}
