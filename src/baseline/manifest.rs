//! The record beside the weights: how a baseline was made, what was measured of it, and how to check it.

use serde::{Deserialize, Serialize};

use super::calibration::CalibrationRecord;
use super::identifiability::IdentifiabilityRecord;
use crate::flow::train::{Stopped, TrainSettings};
use crate::flow::Architecture;
use crate::quantity::{Digest, StructureId};

/// Version of the manifest's layout.
pub const FORMAT: u32 = 2;

/// Everything about a trained baseline but its weights. It holds no clock time and no machine name: the same command
/// gives the same bytes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// Layout, [`FORMAT`].
    pub format: u32,
    /// Version of the program that trained it.
    pub program_version: String,
    /// Structure it was trained for.
    pub structure: StructureId,
    /// Digest of that structure's definition.
    pub structure_digest: Digest,
    /// SHA-256 of the weight file.
    pub weights_sha256: Digest,
    /// Sizes of the flow.
    pub architecture: Architecture,
    /// Standardiser of the observations.
    pub whitening: Whitening,
    /// What was varied in training beside the parameters.
    pub conditions: Conditions,
    /// How it was trained.
    pub training: TrainingRecord,
    /// What it reached on pairs it never saw.
    pub validation: ValidationRecord,
    /// Whether it is as sure as it should be.
    pub calibration: CalibrationRecord,
    /// What the modes can tell apart.
    pub identifiability: IdentifiabilityRecord,
    /// An inference whose result is known.
    pub self_test: SelfTest,
}

/// Mean and Cholesky factor of the log-frequencies (ln Hz) over the training set.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Whitening {
    /// Mean of ln f, one entry a mode.
    pub mean: Vec<f64>,
    /// Lower triangular factor L of the covariance, by rows.
    pub factor: Vec<Vec<f64>>,
}

/// What the flow is conditioned on beside the frequencies.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct Conditions {
    /// Lower and upper end of the box it was trained in, one pair a parameter, in parameter units: the prior with a margin.
    /// Draws beyond the prior are drawn again.
    pub training_box: Vec<[f64; 2]>,
    /// Noise of the frequencies; `None` for a structure without noise, whose measurements must be complete and exact.
    pub noise_range: Option<NoiseRange>,
    /// Whether the flow starts at the best fit of each measurement, see [`super::start`].
    #[serde(default, skip_serializing_if = "is_false")]
    pub starts_at_fit: bool,
    /// Effects that a covariate moves: the flow is told their sizes.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub effects: Vec<EffectRange>,
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "serde hands over a reference")]
fn is_false(value: &bool) -> bool {
    !value
}

/// Sizes of one effect that a flow was trained for.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct EffectRange {
    /// Its place among all sizes of the structure's effects.
    pub column: usize,
    /// Least size.
    pub lowest: f64,
    /// Greatest size.
    pub highest: f64,
}

/// The noise a flow was trained for, as multiples of the structure's own; modes may be missing within it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct NoiseRange {
    /// Least noise: less is taken as this much.
    pub lowest: f64,
    /// Most noise: a mode with more counts as missing.
    pub highest: f64,
}

/// How a baseline was trained.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingRecord {
    /// Simulated pairs it was trained on.
    pub samples: usize,
    /// Simulated pairs that chose the best epoch.
    pub validation_samples: usize,
    /// Schedule and seed.
    pub settings: TrainSettings,
    /// Epoch whose weights were kept, from 1.
    pub best_epoch: usize,
    /// Why training ended.
    pub stopped: Stopped,
}

/// Figures on simulated pairs that neither trained nor chose anything.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ValidationRecord {
    /// Pairs used.
    pub samples: usize,
    /// Mean of −log q(u | y) with u in the unit box, nats.
    pub negative_log_likelihood: f64,
    /// Standard error of that mean, nats.
    pub negative_log_likelihood_error: f64,
    /// One entry for each parameter.
    pub parameters: Vec<ParameterValidation>,
    /// Largest |x − f⁻¹(f(x))| as a share of the prior's width, in f32.
    pub inverse_error: f64,
}

/// How well one parameter is recovered (paper Fig. 8).
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ParameterValidation {
    /// Name of the parameter.
    pub name: String,
    /// R² of posterior means.
    pub r_squared_mean: f64,
    /// R² of single posterior samples.
    pub r_squared_single: f64,
    /// 99.9 % quantile of |single sample − truth|, in the parameter's unit: how far off the worst draws are.
    pub error_quantile_999: f64,
}

/// An inference whose result is known: a loaded baseline must repeat it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SelfTest {
    /// One complete measurement, Hz.
    pub frequencies_hz: Vec<f64>,
    /// Its mode shapes, where the structure has instrumented points.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub shapes: Vec<Vec<f64>>,
    /// Seed of the draws.
    pub seed: u64,
    /// The draws, one row each, in parameter units.
    pub expected: Vec<Vec<f64>>,
}
