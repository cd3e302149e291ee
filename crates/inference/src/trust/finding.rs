//! Findings about a batch, which its reader must know before relying on the results.

use serde::{Deserialize, Serialize};

/// The effect of a finding on the assessment.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum FindingEffect {
    /// The reader is informed; nothing else follows.
    Note,
    /// The batch does not enter the alarm charts.
    HoldAlarm,
    /// The batch is rejected.
    Reject,
}

/// Kind of a finding; the names are part of the API.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum FindingCode {
    /// No parameters of the prior give these frequencies within their noise.
    SimulationDoesNotFit,
    /// As many parameters as modes: a misfit inside the prior box cannot be detected.
    FitNotTestable,
    /// The values are in another unit than Hz.
    UnitSuspected,
    /// Two modes have the same frequency.
    ModesCoincide,
    /// Modes are in the wrong order.
    ModesSwapped,
    /// A mode was missed, and those above it were numbered one too low.
    ModesShifted,
    /// All measurements are the same: the sensor or its gateway seems to repeat an old value.
    NoScatter,
    /// A measurement repeats an earlier one to the last digit.
    StaleRepeat,
    /// Measurements that differ by far less than noise and scatter let independent ones differ: they are counted once.
    NearCopies,
    /// Successive measurements are correlated, so that they are worth fewer independent ones.
    CorrelatedMeasurements,
    /// The stated noise is far larger than the scatter of the frequencies.
    NoiseOverstated,
    /// The frequencies scatter about the simulation further than the stated noise lets them; the noise that they show is used.
    NoiseUnderstated,
    /// Frequencies are rounded to steps larger than their noise.
    Quantised,
    /// Single measurements lie far from the others, or far from anything that the simulation gives; they are left out.
    Outlier,
    /// Measurements slightly beyond the prior; the nearest point of the prior is used for them.
    OutsidePrior,
    /// Many posterior samples lie at a bound of the prior of a parameter.
    PriorEdge,
    /// Measurements state less noise than the trained baseline covers; the least noise that it covers is used.
    NoiseBelowRange,
    /// Measurements that lack modes which the trained baseline needs; they are left out.
    NotUsable,
    /// Modes have more noise than the trained baseline covers; the intervals are widened to it.
    NoiseAboveRange,
    /// Covariates outside those of the undamaged reference, or outside the range from which an effect was learnt.
    Extrapolated,
    /// Many posterior samples lie in a region where the table behind an emulator has no runs.
    BeyondRuns,
    /// The undamaged reference or the simulation has a covariate that measurements lack.
    CovariateMissing,
    /// A covariate has a value that it cannot have, such as an error value of its sensor; it counts as missing.
    CovariateImpossible,
    /// The hyperparameters are estimated from few effective samples.
    FewEffectiveSamples,
    /// The trained baseline in use did not pass its calibration and was accepted by configuration.
    Uncalibrated,
    /// There is no trained model in use: one that was made in a second answers, whose calibration was not measured.
    StartingModel,
    /// Parameters that these modes cannot distinguish.
    NotIdentifiable,
    /// The measurements say hardly more about a parameter than its prior.
    NotInformed,
    /// Modes that the emulator of a table reproduces badly.
    EmulatorDoubtful,
}

/// One finding about a batch.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Finding {
    /// Kind of the finding.
    pub code: FindingCode,
    /// Its effect on the assessment.
    pub effect: FindingEffect,
    /// A sentence for people.
    pub message: String,
    /// Indices of the measurements concerned; empty if the finding is about the whole batch.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub measurements: Vec<usize>,
}

impl Finding {
    /// A finding about the whole batch.
    pub fn new(code: FindingCode, effect: FindingEffect, message: impl Into<String>) -> Self {
        Self { code, effect, message: message.into(), measurements: Vec::new() }
    }

    /// Limits the finding to these measurements of the batch.
    #[must_use]
    pub fn of(mut self, measurements: Vec<usize>) -> Self {
        self.measurements = measurements;
        self
    }
}

/// A batch is rejected as a whole when more than this share of its measurements, and more than one, are bad.
const MOST_BAD: f64 = 0.1;

/// True when `bad` of `all` measurements are so many that the others cannot be trusted either.
pub(super) fn too_many(bad: usize, all: usize) -> bool {
    bad > 0 && (bad == all || bad as f64 > (MOST_BAD * all as f64).max(1.0))
}
