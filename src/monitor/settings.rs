//! How batches are taken and assessed.

use serde::{Deserialize, Serialize};

use super::compute::ComputeSettings;
use crate::alarm::severity::SeverityLimits;
use crate::alarm::AlarmSettings;
use crate::assessment::Draws;

/// How batches are taken and assessed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct MonitorSettings {
    /// Posterior samples drawn for each measurement (paper §5.2: 10).
    pub draws_per_measurement: usize,
    /// Posterior samples drawn for each measurement to estimate the population behind a batch. A third of them is the pilot sample;
    /// the others are drawn only if the batch is noise-dominated or an importance proposal is not better.
    pub draws_for_population: usize,
    /// Largest number of measurements in one batch.
    pub max_measurements: usize,
    /// Digests of trained baselines that may be used although they did not pass their calibration; every assessment with them has a
    /// finding about it.
    pub accept_uncalibrated: Vec<String>,
    /// How measurements are treated that lack a covariate which the simulation depends on.
    pub missing_covariate: MissingCovariate,
    /// When the model of a structure is trained.
    pub training: TrainingStart,
    /// How alarms are raised.
    pub alarm: AlarmSettings,
    /// Limits of the severity of alarms.
    pub severity: SeverityLimits,
    /// Limits of the queue of assessments.
    pub compute: ComputeSettings,
}

/// How measurements are treated that lack a covariate which the simulation depends on.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MissingCovariate {
    /// The covariate is marginalised over all values that its effect was learnt from; the batch is flagged and raises no alarm.
    Marginalise,
    /// The batch is refused with 422.
    Refuse,
}

/// When the model of a structure without one is trained.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TrainingStart {
    /// With the first batch, where a model that is made in a second gives right answers meanwhile.
    Automatic,
    /// On request.
    OnRequest,
}

impl Default for MonitorSettings {
    fn default() -> Self {
        Self {
            draws_per_measurement: Draws::PER_MEASUREMENT,
            draws_for_population: Draws::FOR_POPULATION,
            max_measurements: 5_000,
            accept_uncalibrated: Vec::new(),
            missing_covariate: MissingCovariate::Marginalise,
            training: TrainingStart::Automatic,
            alarm: AlarmSettings::default(),
            severity: SeverityLimits::default(),
            compute: ComputeSettings::default(),
        }
    }
}

impl MonitorSettings {
    /// The settings on which the assessments of given measurements depend.
    pub(super) fn of_answers(&self) -> serde_json::Value {
        serde_json::json!({
            "draws_per_measurement": self.draws_per_measurement,
            "draws_for_population": self.draws_for_population,
            "alarm": self.alarm,
        })
    }
}
