//! Mode shapes of a structure under effects.

use nalgebra::DMatrix;

use super::model::SimulationModel;
use super::settings::CorrectedParameters;
use super::simulate::Simulator;
use crate::physics;
use crate::physics::effect::{modes_under, Target};
use crate::physics::shapes::shapes_at;

impl Simulator {
    /// Shapes of the lowest `count` modes of the data at the degrees of freedom `points`, at parameters `theta` (`[d]`, parameter
    /// units) and under the further effects `targets` with their `sizes`: `[points, count]`, each of unit norm and arbitrary
    /// sign. `None` for a table, which has no shapes.
    ///
    /// # Errors
    /// As [`Self::respond`].
    pub fn shapes_under(
        &self,
        theta: &[f64],
        count: usize,
        (targets, sizes): (&[Target], &[f64]),
        points: &[usize],
    ) -> Result<Option<DMatrix<f64>>, physics::Error> {
        let SimulationModel::Matrices(matrices) = self.model() else { return Ok(None) };
        // Corrections of a setting in one mode only do not change its shape by more than its frequency: they are left out.
        let theta = CorrectedParameters::new(theta, targets, sizes, usize::MAX).theta;
        let (targets, sizes) = matrices.with_sizes(&theta, (targets, sizes));
        let (modes, order) = modes_under(&matrices.at(&theta)?, count, &targets, &sizes)?;
        Ok(Some(shapes_at(&modes, points).select_columns(&order)))
    }
}
