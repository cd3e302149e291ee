//! Measured mode shapes: what they must look like, and which mode of a structure they resemble.

use crate::stats::squared_cosine;

/// Least MAC of a measured shape with some mode of the nominal structure: below, it is another structure's, or its numbers
/// stand in another order.
const LEAST_MAC: f64 = 0.1;

/// Names of points that are told in a message.
const TOLD: usize = 3;

/// The points of a structure whose motion gives the mode shapes.
#[derive(Debug, Clone, PartialEq)]
pub struct InstrumentedPoints {
    /// Their names, in the order of the numbers of a shape.
    pub names: Vec<String>,
    /// Shape of each mode of the nominal structure, of unit norm.
    pub nominal: Vec<Vec<f64>>,
}

impl InstrumentedPoints {
    /// The mode of the nominal structure that a shape resembles most, from 0, and their modal assurance criterion.
    pub fn nearest(&self, shape: &[f64]) -> Option<(usize, f64)> {
        let alike = self.nominal.iter().map(|own| squared_cosine(own, shape)).enumerate();
        alike.max_by(|a, b| a.1.total_cmp(&b.1))
    }

    /// What is wrong with a measured shape and what would be right; `None` where nothing is.
    pub fn mistake(&self, shape: &[f64]) -> Option<String> {
        let points = self.names.len();
        let some = self.names.iter().take(TOLD).cloned().collect::<Vec<_>>().join(", ");
        let names = format!("{some}{}", if points > TOLD { ", …" } else { "" });
        if shape.len() != points {
            return Some(format!("{} numbers, expected {points}: one for each of {names}", shape.len()));
        }
        if let Some((place, value)) = shape.iter().enumerate().find(|(_, x)| !x.is_finite()) {
            return Some(format!("{value} at place {place} is not finite"));
        }
        if unit_shape(shape).is_none() {
            return Some(
                "its numbers are all 0, or too large: send null for a shape that was not identified".to_owned(),
            );
        }
        let (mode, alike) = self.nearest(shape)?;
        (alike < LEAST_MAC).then(|| {
            format!(
                "it resembles no mode of this structure: its MAC is at most {alike:.3}, with mode {}, and at least \
                 {LEAST_MAC} is expected; are its numbers those of {names}, in this order?",
                mode + 1
            )
        })
    }
}

/// A shape of unit norm; `None` where it has none that is a number above 0.
pub fn unit_shape(shape: &[f64]) -> Option<Vec<f64>> {
    let norm = shape.iter().map(|x| x * x).sum::<f64>().sqrt();
    (norm > 0.0 && norm.is_finite()).then(|| shape.iter().map(|x| x / norm).collect())
}
