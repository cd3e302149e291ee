//! Parameters that effects move before stiffnesses are computed from them.

use nalgebra::DMatrix;

use crate::physics::effect::Target;

/// Parameters under effects, and the effects.
pub(super) struct MovedParameters {
    /// All effects, those of the structure file first.
    pub(super) targets: Vec<Target>,
    /// Their sizes, in the units of the targets.
    pub(super) sizes: Vec<f64>,
    /// The parameters that the effects leave, `[d]`.
    pub(super) theta: Vec<f64>,
    /// Factor of the effects on each parameter, `[d]`.
    scale: Vec<f64>,
    /// Number of sizes of the effects of the structure file.
    own: usize,
}

impl MovedParameters {
    /// The parameters `theta` under effects, given with their sizes: those of the structure file, then further ones.
    pub(super) fn new(theta: &[f64], own: (&[Target], &[f64]), further: (&[Target], &[f64])) -> Self {
        let targets = [own.0, further.0].concat();
        let sizes = [own.1, further.1].concat();
        let mut theta = theta.to_vec();
        let mut scale = vec![1.0; theta.len()];
        let mut first = 0;
        for target in &targets {
            match target {
                Target::SettingOffset(column) => theta[*column] += sizes[first],
                Target::SettingScale(column) | Target::ParameterScale(column) => {
                    theta[*column] *= 1.0 + sizes[first];
                    scale[*column] *= 1.0 + sizes[first];
                }
                _ => {}
            }
            first += target.sizes();
        }
        Self { targets, sizes, theta, scale, own: own.1.len() }
    }

    /// Derivatives by the parameters before they are moved, `[rows, d]`, and by the sizes of the further effects,
    /// `[rows, further sizes]`, from those by the moved parameters, `[rows, d]`, and by the sizes of all effects that act on
    /// springs, masses or frequencies, `[rows, sizes]`.
    pub(super) fn chain(
        &self,
        mut by_parameter: DMatrix<f64>,
        mut by_size: DMatrix<f64>,
    ) -> (DMatrix<f64>, DMatrix<f64>) {
        let mut first = 0;
        for target in &self.targets {
            for row in 0..by_size.nrows() {
                match target {
                    Target::SettingOffset(column) => by_size[(row, first)] = by_parameter[(row, *column)],
                    Target::SettingScale(column) | Target::ParameterScale(column) => {
                        by_size[(row, first)] =
                            by_parameter[(row, *column)] * self.theta[*column] / (1.0 + self.sizes[first]);
                    }
                    _ => {}
                }
            }
            first += target.sizes();
        }
        for (column, scale) in self.scale.iter().enumerate() {
            by_parameter.column_mut(column).scale_mut(*scale);
        }
        let by_size = by_size.columns(self.own, self.sizes.len() - self.own).into_owned();
        (by_parameter, by_size)
    }
}
