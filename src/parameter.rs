//! What is unknown about a structure: names, units, priors, and the column order of every θ matrix.

use std::ops::Range;

use serde::{Deserialize, Serialize};

/// Which change of a parameter counts as damage.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum DamageDirection {
    /// Loss: P(x < δ). The default, since damage lowers stiffness.
    #[default]
    Decrease,
    /// Growth: P(x > δ).
    Increase,
    /// Estimated, but never a sign of damage.
    None,
}

/// One unknown of the structure with a uniform prior between `lower` and `upper`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Parameter {
    /// Name, unique in its space.
    pub name: String,
    /// Unit of the value, for people.
    pub unit: String,
    /// Lower end of the uniform prior, in `unit`.
    pub lower: f64,
    /// Upper end of the uniform prior, in `unit`.
    pub upper: f64,
    /// Which change counts as damage.
    pub damage: DamageDirection,
}

impl Parameter {
    /// The interval of the uniform prior.
    pub fn prior(&self) -> Range<f64> {
        self.lower..self.upper
    }

    /// Whether a share of its value means anything: the prior keeps clear of 0.
    pub fn has_share(&self) -> bool {
        self.lower > 0.0 || self.upper < 0.0
    }

    /// Position of a value in the prior interval, 0 at `lower` and 1 at `upper`.
    pub fn to_unit(&self, value: f64) -> f64 {
        (value - self.lower) / (self.upper - self.lower)
    }

    /// The value at a position of the prior interval; inverse of [`Self::to_unit`].
    pub fn from_unit(&self, position: f64) -> f64 {
        self.lower + position * (self.upper - self.lower)
    }
}

/// The parameters in the column order of every θ matrix of the crate. Names are unique, each prior has `lower < upper`:
/// the structure file's reader (`simulator::definition`) has checked it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct ParameterSpace {
    parameters: Vec<Parameter>,
}

impl ParameterSpace {
    /// A space of checked parameters.
    pub fn new(parameters: Vec<Parameter>) -> Self {
        Self { parameters }
    }

    /// Number of parameters d.
    pub fn len(&self) -> usize {
        self.parameters.len()
    }

    /// True without parameters.
    pub fn is_empty(&self) -> bool {
        self.parameters.is_empty()
    }

    /// The parameters in column order.
    pub fn iter(&self) -> std::slice::Iter<'_, Parameter> {
        self.parameters.iter()
    }

    /// The parameters in column order, by index.
    pub fn as_slice(&self) -> &[Parameter] {
        &self.parameters
    }

    /// Column of a named parameter.
    pub fn position(&self, name: &str) -> Option<usize> {
        self.parameters.iter().position(|p| p.name == name)
    }
}

impl<'a> IntoIterator for &'a ParameterSpace {
    type Item = &'a Parameter;
    type IntoIter = std::slice::Iter<'a, Parameter>;

    fn into_iter(self) -> Self::IntoIter {
        self.iter()
    }
}
