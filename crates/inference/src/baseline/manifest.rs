//! The record that accompanies the weights: how a model was trained, what was measured of it, and how to check it.

use serde::{Deserialize, Serialize};

use super::conditions::{Conditions, Whitening};
use crate::flow::architecture::Architecture;
use crate::flow::train::{Stopped, TrainSettings};
use structures::parameter::ParameterSpace;
use structures::quantity::{Digest, StructureId};

/// Version of the manifest format.
pub const FORMAT: u32 = 2;

/// Absolute posterior correlation, averaged over measurements from the whole prior, above which two parameters form a
/// group.
pub(super) const GROUP_CORRELATION: f64 = 0.8;

/// Share of the prior variance that must remain before a parameter can join a group. A well-determined parameter needs no
/// group, whatever its correlation.
pub(super) const UNRESOLVED: f64 = 0.02;

/// Everything about a trained model except its weights. It contains no clock time and no machine name, so that the same
/// command gives the same bytes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Manifest {
    /// Version of the format, [`FORMAT`].
    pub format: u32,
    /// Version of the program that trained it.
    pub program_version: String,
    /// Structure it was trained for.
    pub structure: StructureId,
    /// Digest of that structure's definition.
    pub structure_digest: Digest,
    /// SHA-256 of the weight file.
    pub weights_sha256: Digest,
    /// Sizes of the flow and its permutations.
    pub architecture: Architecture,
    /// Standardisation of the log-frequencies.
    pub whitening: Whitening,
    /// What was varied in training besides the parameters.
    pub conditions: Conditions,
    /// How it was trained.
    pub training: TrainingRecord,
    /// Accuracy on held-out pairs.
    pub validation: ValidationRecord,
    /// Whether its posterior intervals have the stated coverage.
    pub calibration: CalibrationRecord,
    /// Factors of the spread of draws that the simulation does not correct; empty where they need none.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub spread: Vec<SpreadCell>,
    /// Which parameters the modes can distinguish.
    pub identifiability: IdentifiabilityRecord,
    /// An inference with a known result.
    pub self_test: SelfTest,
}

/// How a model was trained.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TrainingRecord {
    /// Simulated pairs it was trained on.
    pub samples: usize,
    /// Simulated pairs that selected the best epoch.
    pub validation_samples: usize,
    /// Training schedule and seed.
    pub settings: TrainSettings,
    /// Epoch whose weights were kept, counted from 1.
    pub best_epoch: usize,
    /// Why the training ended.
    pub stopped: Stopped,
    /// Digest of the model whose weights the training started from; `None` for random weights.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub parent: Option<Digest>,
    /// How the training went on after its calibration did not pass; empty where it did not go on.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub further_rounds: Vec<FurtherRound>,
}

/// A round of training from the weights of the round before.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FurtherRound {
    /// Epochs of this round.
    pub epochs: usize,
    /// Learning rate of its first step.
    pub learning_rate: f64,
    /// Epoch whose weights were kept, counted from 1 in this round.
    pub best_epoch: usize,
}

/// Factors by which draws of the flow are stretched about their median for one kind of measurement, learned on simulations of their
/// own (conformal calibration).
///
/// ```text
///  x′ = m + s (x − m),    m: median of the draws of a measurement,  s: 90 % quantile of |truth − m|/half width of the 90 % interval
/// ```
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SpreadCell {
    /// Noise as a multiple of the structure's noise.
    pub noise_multiple: f64,
    /// Number of the missing mode, counted from 1; `None` for complete measurements.
    pub missing_mode: Option<usize>,
    /// Whether the mode shapes are missing; `None` for a structure without instrumented points.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub without_shapes: Option<bool>,
    /// s of each parameter.
    pub scales: Vec<f64>,
}

/// Accuracy on held-out simulated pairs, which were used neither for training nor for selecting the epoch.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ValidationRecord {
    /// Pairs used.
    pub samples: usize,
    /// Mean of ln p(u) − ln q(u | y) with u the position in the prior box and p the density of the prior, 1 where it is uniform; nats.
    pub negative_log_likelihood: f64,
    /// Standard error of that mean, nats.
    pub negative_log_likelihood_error: f64,
    /// One entry per parameter.
    pub parameters: Vec<ParameterValidation>,
    /// Largest |x − f⁻¹(f(x))| in f32, as a share of the prior's width.
    pub inverse_error: f64,
}

/// How well one parameter is recovered. Source: Wang et al. (2025), Fig. 8.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ParameterValidation {
    /// Name of the parameter.
    pub name: String,
    /// R² of the posterior means.
    pub r_squared_mean: f64,
    /// R² of single posterior samples.
    pub r_squared_single: f64,
    /// 99.9 % quantile of |posterior sample − truth|, in the parameter's unit.
    pub error_quantile_999: f64,
}

/// An inference with a known result, which a loaded model must reproduce.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SelfTest {
    /// One complete measurement, Hz.
    pub frequencies_hz: Vec<f64>,
    /// Its mode shapes, where the structure has instrumented points.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub shapes: Vec<Vec<f64>>,
    /// Seed of the draws.
    pub seed: u64,
    /// The expected draws, one row each, in parameter units.
    pub expected: Vec<Vec<f64>>,
}

/// Calibration of the posterior: ranks, coverage and TARP over noise levels and missing modes.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct CalibrationRecord {
    /// Simulated measurements per cell.
    pub simulations: usize,
    /// Posterior draws per measurement.
    pub draws: usize,
    /// Where the intervals are too narrow; empty for a model that may be used.
    pub failures: Vec<String>,
    /// Where the intervals are too wide and nothing says that they are too narrow; the model may be used. Empty in the manifests of
    /// earlier versions of this program, which listed everything among the failures.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub cautions: Vec<String>,
    /// One entry per noise level and set of modes.
    pub cells: Vec<Cell>,
}

/// What the calibration of a model says about its use.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(as = CalibrationOutcome)]
pub enum Outcome {
    /// The calibration was not measured: the model was made in a second, and the simulation weighs its samples. It is used until there is a
    /// trained one; its intervals may be too narrow.
    NotMeasured,
    /// The intervals hold the stated share of the true values.
    Passed,
    /// The intervals are too wide somewhere and nowhere too narrow: the model is used, and small changes may be noticed later than
    /// they could be.
    Cautious,
    /// The intervals are too narrow somewhere: the model is not used unless it is accepted explicitly.
    Overconfident,
}

/// Calibration at one noise level with one set of modes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = CalibrationCell)]
pub struct Cell {
    /// Noise as a multiple of the structure's noise.
    pub noise_multiple: f64,
    /// Number of the missing mode, counted from 1; `None` for complete measurements.
    pub missing_mode: Option<usize>,
    /// Whether the mode shapes are missing; `None` for a structure without instrumented points.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub without_shapes: Option<bool>,
    /// p-value of uniform TARP ranks, for all parameters jointly.
    pub tarp_p_value: f64,
    /// Mean square distance of the TARP ranks from the middle, as a multiple of that of uniform ranks: below 1 where the joint
    /// posterior is too wide. `None` in the manifests of earlier versions of this program.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub tarp_spread: Option<f64>,
    /// One entry per parameter.
    pub parameters: Vec<CellParameter>,
}

/// Calibration of one parameter in one cell.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = CalibrationParameter)]
pub struct CellParameter {
    /// Name of the parameter.
    pub name: String,
    /// p-value of uniform ranks.
    pub rank_p_value: f64,
    /// Share of the true values inside the central 50 % interval.
    pub coverage_50: f64,
    /// Share of the true values inside the central 90 % interval.
    pub coverage_90: f64,
    /// Shares of the true values below and above the central 90 % interval, each 0.05 for a calibrated posterior. `None` in the
    /// manifests of earlier versions of this program.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schema(value_type = Option<Vec<f64>>)]
    pub outside_90: Option<[f64; 2]>,
    /// Factor that stretches the 90 % interval about the median to its nominal coverage (conformal calibration); 1 where
    /// the coverage is close enough to nominal.
    pub interval_scale: f64,
}

impl CalibrationRecord {
    /// What the calibration says about the use of the model.
    pub fn outcome(&self) -> Outcome {
        if self.cells.is_empty() && self.failures.is_empty() {
            return Outcome::NotMeasured;
        }
        match (self.failures.is_empty(), self.cautions.is_empty()) {
            (false, _) => Outcome::Overconfident,
            (true, false) => Outcome::Cautious,
            (true, true) => Outcome::Passed,
        }
    }

    /// Numbers of findings, the more serious ones first: a smaller value is better.
    pub fn findings(&self) -> (usize, usize) {
        (self.failures.len(), self.cautions.len())
    }

    /// What is wrong, in sentences: where the intervals are too narrow, then where they are too wide.
    pub fn reasons(&self) -> impl Iterator<Item = &str> {
        self.failures.iter().chain(&self.cautions).map(String::as_str)
    }

    /// True when no test failed.
    pub fn passed(&self) -> bool {
        self.outcome() == Outcome::Passed
    }

    /// Factor for the 90 % interval of parameter `column` of one measurement, taken from the cell with the nearest noise
    /// level. `complete`: all modes are present; `shapes`: mode shapes are present.
    pub fn interval_scale(&self, column: usize, noise_multiple: f64, complete: bool, shapes: bool) -> f64 {
        // Where a flow starts at the best fit, missing modes widen the fit itself, so that all cells are complete.
        let all_complete = self.cells.iter().all(|cell| cell.missing_mode.is_none());
        let fitting = self.cells.iter().filter(|cell| {
            (all_complete || cell.missing_mode.is_none() == complete) && cell.without_shapes != Some(shapes)
        });
        let distance = |cell: &&Cell| (cell.noise_multiple / noise_multiple).ln().abs();
        let nearest = fitting.min_by(|a, b| distance(a).total_cmp(&distance(b)));
        nearest.map_or(1.0, |cell| cell.parameters[column].interval_scale)
    }
}

/// What one complete measurement at the structure's noise reveals about each parameter.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct IdentifiabilityRecord {
    /// One entry per parameter.
    pub parameters: Vec<ParameterIdentifiability>,
    /// Groups of parameters, by name, that cannot be distinguished. Their damage is reported for the group as a whole.
    pub groups: Vec<Vec<String>>,
}

/// What one measurement reveals about one parameter, summarised over the prior.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct ParameterIdentifiability {
    /// Name of the parameter.
    pub name: String,
    /// Median standard deviation from the local Fisher information and the prior, in the parameter's unit.
    pub fisher_std: f64,
    /// Root mean posterior variance of the flow, in the parameter's unit. It exceeds `fisher_std` where several distant
    /// points of the prior give the same frequencies.
    pub posterior_std: f64,
    /// Posterior variance of the flow as a share of the prior variance: 0 means known exactly, 1 means nothing was learnt.
    pub variance_left: f64,
    /// The parameter with the largest absolute posterior correlation, and that correlation.
    pub confused_with: Option<(String, f64)>,
}

/// A group of parameters that the modes cannot distinguish.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Group {
    /// `group:` and the names, joined by `+`.
    pub name: String,
    /// Their columns in θ.
    pub columns: Vec<usize>,
}

impl ParameterIdentifiability {
    /// True when much of the prior variance remains because the parameter is strongly correlated with another.
    pub fn is_confused(&self) -> bool {
        let strongly = |(_, correlation): &(String, f64)| correlation.abs() > GROUP_CORRELATION;
        self.variance_left > UNRESOLVED && self.confused_with.as_ref().is_some_and(strongly)
    }
}

impl IdentifiabilityRecord {
    /// The groups with their columns in `space`.
    pub fn resolve(&self, space: &ParameterSpace) -> Vec<Group> {
        let group = |names: &Vec<String>| Group {
            name: format!("group:{}", names.join("+")),
            columns: names.iter().filter_map(|name| space.position(name)).collect(),
        };
        self.groups.iter().map(group).filter(|group| group.columns.len() > 1).collect()
    }
}
