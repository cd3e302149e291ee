//! Changes of many parts at once, each by a factor of its own.

/// Smallest share of a stiffness, mass or frequency that an effect may leave.
pub const LEAST_FACTOR: f64 = 0.02;

/// A direction in which a target changes many parts: the change of the logarithm of each for a size of 1. An empty list changes
/// nothing.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Direction {
    /// Of the stiffness of each spring, `[springs]`.
    pub springs: Vec<f64>,
    /// Of each mass, `[masses]`.
    pub masses: Vec<f64>,
    /// Of the frequency of each mode, `[m]`, beside what the stiffnesses and masses change.
    pub frequencies: Vec<f64>,
}

impl Direction {
    /// Multiplies the factors on all stiffnesses and masses by those of this size; whether all of them leave enough.
    pub(super) fn scale(&self, size: f64, springs: &mut [f64], masses: &mut [f64]) -> bool {
        let scale = |factors: &mut [f64], by: &[f64]| {
            factors.iter_mut().zip(by).for_each(|(factor, by)| *factor *= (size * by).exp());
        };
        scale(springs, &self.springs);
        scale(masses, &self.masses);
        springs.iter().chain(masses.iter()).all(|factor| factor.is_finite() && *factor >= LEAST_FACTOR)
    }
}
