//! The result of one batch, as it is stored, listed and returned to clients.

use serde::{Deserialize, Serialize};

use crate::damage::{JointAssessment, QuantityAssessment};
use crate::process::estimate::BatchEstimate;
use crate::trust::Trust;
use structures::quantity::{Digest, Timestamp};

/// How far the processing of a stored batch has come.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum BatchState {
    /// Stored but not yet assessed: it waits in the queue or for a trained baseline.
    Received,
    /// Assessed; its newest assessment says which undamaged reference it was compared with.
    Assessed,
    /// The assessment failed; the reason is stored and the batch is kept.
    Failed,
}

impl BatchState {
    /// The name used in tables and answers.
    pub const fn as_str(self) -> &'static str {
        match self {
            Self::Received => "received",
            Self::Assessed => "assessed",
            Self::Failed => "failed",
        }
    }
}

/// The result of one batch: a pure function of data, trained baseline, undamaged reference and seed.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Assessment {
    /// Digest of the trained baseline that was used.
    pub model_digest: Digest,
    /// Digest of the version of the structure that the trained baseline was trained for.
    pub structure_digest: Digest,
    /// Version of the undamaged reference that the batch was compared with; `None` when there was none or when the batch is part
    /// of it.
    pub undamaged_version: Option<u32>,
    /// Seed of the random draws.
    pub seed: u64,
    /// Posterior samples drawn for each measurement.
    pub draws_per_measurement: usize,
    /// Measurements that the estimate is based on.
    pub measurements_used: usize,
    /// Measurements left out; the findings say which and why.
    pub measurements_left_out: usize,
    /// Number of used measurements that no point of the prior box reproduces; each is replaced by the nearest point of the box.
    pub measurements_outside: usize,
    /// Mean number of effective samples that a measurement contributes to the hyperparameters.
    pub effective_sample_size: f64,
    /// For each mode, 100·(mean measured − simulated)/mean measured, per cent, simulated at the mean of all posterior samples: the
    /// part that the simulation cannot reproduce. `None` for a mode that no measurement has.
    pub misfit_percent: Vec<Option<f64>>,
    /// How far the assessment can be trusted.
    pub trust: Trust,
    /// When it was computed.
    pub assessed_at: Timestamp,
    /// One entry for each monitored quantity.
    pub quantities: Vec<QuantityAssessment>,
    /// The estimate that enters the process behind the undamaged reference; `None` without such a process, and in an assessment that
    /// was read from the database.
    #[serde(skip)]
    pub estimate: Option<BatchEstimate>,
    /// Correlations and joint probability of damage; `None` where the batch does not determine the correlations of at least two
    /// quantities, for a rejected batch, and in assessments stored by versions that did not estimate them.
    pub joint: Option<JointAssessment>,
}
