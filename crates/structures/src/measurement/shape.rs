//! Checks of measured mode shapes, by their resemblance to the modes of a structure.

use crate::stats::squared_cosine;

/// A measured shape must have at least this MAC with some mode of the nominal structure. Otherwise it belongs to another structure,
/// or its components are in another order.
const LEAST_MAC: f64 = 0.1;

/// Largest number of point names in a message.
const MOST_NAMES: usize = 3;

/// The instrumented points of a structure, at which mode shapes are measured.
#[derive(Debug, Clone, PartialEq)]
pub struct InstrumentedPoints {
    /// Names of the points, in the order of the components of a shape.
    pub names: Vec<String>,
    /// Shapes of the nominal structure with unit norm, one for each measured mode and for a few modes above, `[modes][points]`.
    pub nominal: Vec<Vec<f64>>,
}

impl InstrumentedPoints {
    /// The mode of the nominal structure (from 0) with the highest modal assurance criterion (MAC), and that MAC. Source: Allemang
    /// & Brown (1982).
    pub fn nearest(&self, shape: &[f64]) -> Option<(usize, f64)> {
        let macs = self.nominal.iter().map(|own| squared_cosine(own, shape)).enumerate();
        macs.max_by(|a, b| a.1.total_cmp(&b.1))
    }

    /// What is wrong with a measured shape, and what would be right; `None` if the shape is valid.
    pub fn mistake(&self, shape: &[f64]) -> Option<String> {
        let points = self.names.len();
        let first = self.names.iter().take(MOST_NAMES).cloned().collect::<Vec<_>>().join(", ");
        let names = format!("{first}{}", if points > MOST_NAMES { ", …" } else { "" });
        if shape.len() != points {
            return Some(format!("{} numbers, expected {points}: one for each of {names}", shape.len()));
        }
        if let Some((position, value)) = shape.iter().enumerate().find(|(_, x)| !x.is_finite()) {
            return Some(format!("{value} at position {position} (from 0) is not finite: send a number"));
        }
        if unit_shape(shape).is_none() {
            return Some(
                "all components are 0, or they are too large: send null for a shape that was not identified".to_owned(),
            );
        }
        let (mode, mac) = self.nearest(shape)?;
        (mac < LEAST_MAC).then(|| {
            format!(
                "the shape resembles no mode of this structure: its highest MAC is {mac:.3}, with mode {}, and at least \
                 {LEAST_MAC} is expected; check that its numbers are those of {names}, in this order",
                mode + 1
            )
        })
    }
}

/// A shape scaled to unit norm; `None` if its norm is 0 or not finite.
pub fn unit_shape(shape: &[f64]) -> Option<Vec<f64>> {
    let norm = shape.iter().map(|x| x * x).sum::<f64>().sqrt();
    (norm > 0.0 && norm.is_finite()).then(|| shape.iter().map(|x| x / norm).collect())
}
