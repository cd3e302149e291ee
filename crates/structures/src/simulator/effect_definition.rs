//! Effects as they are written in a structure file.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::law::LawKind;
use crate::physics::deviation::DeviationKind;

/// An effect: its target, its law, its covariate and the coefficients of the law.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct EffectDefinition {
    /// Unique name.
    pub name: String,
    /// Free text for human readers.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub description: Option<String>,
    /// What changes.
    pub target: TargetDefinition,
    /// Form of the law.
    pub law: LawKind,
    /// Declared covariate that the size depends on; none for a constant.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub covariate: Option<String>,
    /// Value of the covariate at which the effect has its `level`.
    #[serde(default)]
    pub reference: f64,
    /// Means of the coefficients of the law by name. A law by category has one for each category that has an effect.
    pub numbers: BTreeMap<String, f64>,
    /// Covariance of the coefficients, in alphabetical order of their names; none if they are exact.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub covariance: Vec<Vec<f64>>,
    /// Values of a numeric covariate that the effect was fitted to: at least two quantiles at equal steps, from the minimum to
    /// the maximum. Training draws between the extremes; a measurement without the covariate is marginalised over all values.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub seen: Vec<f64>,
}

/// What an effect changes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum TargetDefinition {
    /// Stiffness of these springs: k(1 + g).
    Springs(Vec<String>),
    /// Mass of these bodies: m(1 + g).
    Masses(Vec<String>),
    /// This parameter: p(1 + g).
    Parameter(String),
    /// This parameter: p + g, in its unit.
    ParameterOffset(String),
    /// Scale of the measured frequency of this mode, counted from 1, or of all modes for 0: f(1 + g).
    FrequencyScale(usize),
    /// Offset of the measured frequency of this mode, counted from 1, or of all modes for 0: f + g, Hz.
    FrequencyOffset(usize),
    /// An additional spring of stiffness g, N/m, between two nodes.
    AddedSpring([String; 2]),
    /// An additional body of `size` kg on a spring tuned to `frequency_hz`, attached to this mass or node.
    Oscillator(String),
    /// Mode i of the data is this mode of the structure, counted from 1.
    ModeOrder(Vec<usize>),
    /// A deviation of a chain of bodies, or of a beam, that is in no single part.
    Deviation(DeviationKind),
}
