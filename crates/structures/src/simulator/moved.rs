//! Parameters under effects, with the derivatives of the response to the effects.

use nalgebra::DMatrix;

use super::settings::CorrectedParameters;
use crate::physics::effect::Target;

/// Parameters under effects, and the effects.
pub(super) struct MovedParameters {
    /// All effects, those of the structure file first.
    pub(super) targets: Vec<Target>,
    /// Their sizes, in the units of the targets.
    pub(super) sizes: Vec<f64>,
    /// The parameters that the effects leave, and their derivatives.
    corrected: CorrectedParameters,
    /// Number of sizes of the effects of the structure file.
    own: usize,
}

impl MovedParameters {
    /// The parameters `theta` under effects, given with their sizes: those of the structure file, then further ones. Effects on
    /// single modes are left out.
    pub(super) fn new(theta: &[f64], own: (&[Target], &[f64]), further: (&[Target], &[f64])) -> Self {
        let targets = [own.0, further.0].concat();
        let sizes = [own.1, further.1].concat();
        let corrected = CorrectedParameters::new(theta, &targets, &sizes, usize::MAX);
        Self { targets, sizes, corrected, own: own.1.len() }
    }

    /// The parameters that the effects leave, `[d]`.
    pub(super) fn theta(&self) -> &[f64] {
        &self.corrected.theta
    }

    /// Derivatives by the parameters before they are moved, `[rows, d]`, and by the sizes of the further effects,
    /// `[rows, further sizes]`, from those by the moved parameters, `[rows, d]`, and by the sizes of all effects that act on
    /// springs, masses or frequencies, `[rows, sizes]`.
    pub(super) fn chain(&self, by_moved: &DMatrix<f64>, by_size: DMatrix<f64>) -> (DMatrix<f64>, DMatrix<f64>) {
        if !self.targets.iter().any(Target::acts_on_parameters) {
            let by_size = by_size.columns(self.own, self.sizes.len() - self.own).into_owned();
            return (by_moved.clone(), by_size);
        }
        let by_size = by_size + by_moved * &self.corrected.by_size;
        let by_size = by_size.columns(self.own, self.sizes.len() - self.own).into_owned();
        (by_moved * &self.corrected.by_theta, by_size)
    }
}
