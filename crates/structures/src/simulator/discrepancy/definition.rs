//! How a structure file states a learned discrepancy.

use serde::{Deserialize, Serialize};

/// A discrepancy that `modalwatch extend --learned` wrote: one Gaussian process for each mode, all over the same inputs and support
/// points.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct DiscrepancyDefinition {
    /// Free text for human readers.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub description: Option<String>,
    /// The inputs u; without any, the discrepancy is a constant for each mode.
    pub inputs: Vec<InputDefinition>,
    /// Support points: standardised inputs, one row for each point and one entry for each input. A category is the index of its
    /// name in `levels`, from 0.
    pub points: Vec<Vec<f64>>,
    /// The processes; a mode without one has no discrepancy.
    #[serde(rename = "mode")]
    pub modes: Vec<ModeDefinition>,
}

/// An input of a learned discrepancy: a covariate or a setting.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = DiscrepancyInputDefinition)]
pub struct InputDefinition {
    /// Name of a declared covariate.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub covariate: Option<String>,
    /// Name of a parameter that the experimenter sets, instead of `covariate`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub setting: Option<String>,
    /// Number that is subtracted from the value, in its unit.
    #[serde(default)]
    pub centre: f64,
    /// Number that the difference is divided by, in the unit of the value.
    #[serde(default = "one")]
    pub scale: f64,
    /// Smallest and largest value that the discrepancy was learned from, in the unit of the value; only for numbers.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub seen: Option<[f64; 2]>,
    /// Names of the categories that the discrepancy was learned from; only for a covariate of kind `category`.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub levels: Vec<String>,
}

fn one() -> f64 {
    1.0
}

/// The process of one mode.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = DiscrepancyModeDefinition)]
pub struct ModeDefinition {
    /// The mode, counted from 1.
    pub mode: usize,
    /// Prior standard deviation of g, as a share of the frequency.
    pub std: f64,
    /// Correlation length along each standardised input.
    pub lengths: Vec<f64>,
    /// Posterior mean of the coefficients of the basis, one for each support point.
    pub weights: Vec<f64>,
    /// Lower triangular Cholesky factor of the posterior covariance of the coefficients: row i has i + 1 entries.
    pub factor: Vec<Vec<f64>>,
}
