//! The unknown parameters θ of a structure: names, units, priors, and the column order of every θ matrix.

use std::ops::Range;

use serde::{Deserialize, Serialize};

/// The name of a monitored quantity as people read it: `spring:k12`, a stiffness that follows from a parameter by a law, is the "stiffness of
/// spring k12", and `group:k1+k2`, parameters that the measurements cannot tell apart, is "k1 and k2 together". A parameter is itself.
pub fn in_words(quantity: &str) -> String {
    match quantity.split_once(':') {
        Some(("spring", name)) => format!("stiffness of spring {name}"),
        Some(("group", names)) => format!("{} together", names.replace('+', " and ")),
        _ => quantity.to_owned(),
    }
}

/// Direction of change of a parameter that is damage.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum DamageDirection {
    /// A decrease: P(x < δ). This is the default, because damage reduces stiffness.
    #[default]
    Decrease,
    /// An increase: P(x > δ).
    Increase,
    /// No change is damage: the parameter is only estimated.
    None,
}

/// An unknown parameter with a uniform prior between `lower` and `upper`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Parameter {
    /// Unique name.
    pub name: String,
    /// Unit of the value, for display.
    pub unit: String,
    /// Lower bound of the uniform prior, in `unit`.
    pub lower: f64,
    /// Upper bound of the uniform prior, in `unit`.
    pub upper: f64,
    /// Direction of change that is damage.
    pub damage: DamageDirection,
}

impl Parameter {
    /// The interval of the uniform prior.
    pub fn prior(&self) -> Range<f64> {
        self.lower..self.upper
    }

    /// Whether relative changes of the parameter are meaningful: the prior does not include 0.
    pub fn has_share(&self) -> bool {
        self.lower > 0.0 || self.upper < 0.0
    }

    /// Position of a value in the prior interval: 0 at `lower`, 1 at `upper`.
    pub fn to_unit(&self, value: f64) -> f64 {
        (value - self.lower) / (self.upper - self.lower)
    }

    /// The value at a position in the prior interval, the inverse of [`Self::to_unit`].
    pub fn from_unit(&self, position: f64) -> f64 {
        self.lower + position * (self.upper - self.lower)
    }
}

/// The parameters in the column order of every θ matrix. Names are unique and each prior has `lower < upper`, which the check of
/// the structure file guarantees.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct ParameterSpace {
    parameters: Vec<Parameter>,
}

impl ParameterSpace {
    /// A space of parameters that have been checked.
    pub fn new(parameters: Vec<Parameter>) -> Self {
        Self { parameters }
    }

    /// Number of parameters d.
    pub fn len(&self) -> usize {
        self.parameters.len()
    }

    /// Whether there are no parameters.
    pub fn is_empty(&self) -> bool {
        self.parameters.is_empty()
    }

    /// The parameters in column order.
    pub fn iter(&self) -> std::slice::Iter<'_, Parameter> {
        self.parameters.iter()
    }

    /// The parameters in column order, as a slice.
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

#[cfg(test)]
mod tests {
    use super::in_words;

    #[test]
    fn a_quantity_has_no_prefix_where_people_read_its_name() {
        assert_eq!(in_words("spring:k12"), "stiffness of spring k12");
        assert_eq!(in_words("group:k1+k2"), "k1 and k2 together");
        assert_eq!(in_words("west_ei"), "west_ei");
    }
}
