//! Mode shapes at the instrumented points of a structure, and their derivatives.

use nalgebra::DMatrix;

use super::model::{Matrices, SimulationModel};
use super::respond::Response;
use super::settings::CorrectedParameters;
use super::simulate::Simulator;
use crate::measurement::shape::InstrumentedPoints;
use crate::physics::effect::Target;
use crate::physics::shaped::{respond_shaped, Shaped};
use crate::physics::shapes::modes_to_pair;
use crate::physics::tracked::{respond_tracked, ReferenceMode};
use crate::physics::{self, Structure};

/// Frequencies and mode shapes at one set of parameters, and their derivatives.
#[derive(Debug, Clone)]
pub struct Linearised {
    /// Frequencies, Hz, ascending, `[modes]`.
    pub frequencies_hz: Vec<f64>,
    /// Derivatives of the frequencies, Hz per parameter unit, `[modes, d]`.
    pub frequency_slopes: DMatrix<f64>,
    /// Shapes of unit norm, `[points, modes]`; `[0, 0]` if no shapes were asked for.
    pub shapes: DMatrix<f64>,
    /// Derivatives of the shape of each mode, per parameter unit, `[points, d]`.
    pub shape_slopes: Vec<DMatrix<f64>>,
}

/// Mode shapes as coordinates about the shapes of reference modes, and their derivatives; see
/// [`crate::physics::tracked::ShapeResponse`].
#[derive(Debug, Clone)]
pub struct ShapeResponse {
    /// Coordinates, rad, `[m (P − 1)]` at P points.
    pub coordinates: Vec<f64>,
    /// Derivatives with respect to the parameters, rad per parameter unit, `[m (P − 1), d]`.
    pub by_parameter: DMatrix<f64>,
    /// Derivatives with respect to the sizes of the further effects, rad per unit of the size, `[m (P − 1), sizes]`.
    pub by_size: DMatrix<f64>,
}

impl Simulator {
    /// Number of instrumented points; 0 if mode shapes are not measured.
    pub fn shape_points(&self) -> usize {
        self.instrumented().map_or(0, |i| i.dofs.len())
    }

    /// Degree of freedom of each instrumented point; empty without any.
    pub fn shape_dofs(&self) -> &[usize] {
        self.instrumented().map_or(&[], |i| &i.dofs)
    }

    /// The instrumented points, if mode shapes are measured.
    pub fn instrumented_points(&self) -> Option<&InstrumentedPoints> {
        self.instrumented().map(|i| &i.points)
    }

    /// Standard deviation of each component of a measured shape of unit norm; 0 if mode shapes are not measured.
    pub fn shape_std(&self) -> f64 {
        self.instrumented().map_or(0.0, |i| i.std)
    }

    /// Frequencies, Hz, `[m]`, and mode shapes of unit norm, `[points, m]`, at parameters `theta` (`[d]`) under the effects, without
    /// noise.
    ///
    /// # Errors
    /// As [`Self::frequencies_hz`].
    pub fn frequencies_and_shapes(&self, theta: &[f64]) -> Result<(Vec<f64>, DMatrix<f64>), physics::Error> {
        match (self.model(), self.instrumented()) {
            (SimulationModel::Matrices(matrices), Some(instrumented)) => {
                let corrected = self.at_mean_effects(theta).theta;
                let shaped = self.shaped(matrices, &corrected, self.modes(), (&instrumented.dofs, (&[], 0)))?;
                if self.has_effects_in_single_modes() {
                    return Ok((self.frequencies_hz(theta)?, shaped.shapes));
                }
                Ok((shaped.response.frequencies_hz, shaped.shapes))
            }
            _ => Ok((self.frequencies_hz(theta)?, DMatrix::zeros(0, 0))),
        }
    }

    /// The modes at parameters `theta` (`[d]`) under the effects, and their derivatives. If the structure has instrumented points and
    /// `with_shapes` is true, these are the lowest `count` modes with their shapes; otherwise they are the measured modes without
    /// shapes.
    ///
    /// # Errors
    /// As [`Self::frequencies_hz`].
    pub fn linearise(&self, theta: &[f64], count: usize, with_shapes: bool) -> Result<Linearised, physics::Error> {
        match (self.model(), self.instrumented()) {
            (SimulationModel::Matrices(matrices), Some(instrumented)) if with_shapes => {
                let springs: Vec<usize> = matrices.bindings.iter().map(|b| b.spring).collect();
                let slopes = (springs.as_slice(), matrices.sizes.len());
                let corrected = self.at_mean_effects(theta);
                let moved = self.effects().iter().any(|effect| effect.target.acts_on_parameters());
                let chain = |slopes: DMatrix<f64>| if moved { slopes * &corrected.by_theta } else { slopes };
                let Shaped { response, shapes, shape_slopes } =
                    self.shaped(matrices, &corrected.theta, count, (&instrumented.dofs, slopes))?;
                let mut frequencies_hz = response.frequencies_hz;
                let by_parameter = matrices.by_parameter(&response.by_spring, &response.by_size, &corrected.theta);
                let mut frequency_slopes = chain(by_parameter);
                if self.has_effects_in_single_modes() {
                    let measured = self.respond(theta, self.modes(), &[], &[])?;
                    frequencies_hz[..self.modes()].copy_from_slice(&measured.frequencies_hz);
                    frequency_slopes.rows_mut(0, self.modes()).copy_from(&measured.by_parameter);
                }
                let by_parameter = |of_mode: DMatrix<f64>| {
                    let mut slopes = DMatrix::zeros(of_mode.nrows(), theta.len());
                    let stiffnesses = matrices.bindings.iter();
                    let by_stiffness = stiffnesses.map(|b| (b.parameter, b.slope(corrected.theta[b.parameter])));
                    let by_size = matrices.sizes.iter().map(|b| (b.parameter, b.per_unit));
                    for ((parameter, slope), column) in by_stiffness.chain(by_size).zip(of_mode.column_iter()) {
                        slopes.column_mut(parameter).axpy(slope, &column, 1.0);
                    }
                    chain(slopes)
                };
                let shape_slopes = shape_slopes.into_iter().map(by_parameter).collect();
                Ok(Linearised { frequencies_hz, frequency_slopes, shapes, shape_slopes })
            }
            _ => {
                let (frequencies_hz, frequency_slopes) = self.frequencies_and_jacobian(theta)?;
                let (shapes, shape_slopes) = (DMatrix::zeros(0, 0), Vec::new());
                Ok(Linearised { frequencies_hz, frequency_slopes, shapes, shape_slopes })
            }
        }
    }

    /// Parameters `theta` (`[d]`) as the effects change them in all modes.
    fn at_mean_effects(&self, theta: &[f64]) -> CorrectedParameters {
        // No mode has this number, so that the effects on the frequency of a single mode are left out.
        CorrectedParameters::new(theta, &self.targets(), self.sizes(), usize::MAX)
    }

    /// Targets of the effects of the structure file.
    pub(super) fn targets(&self) -> Vec<Target> {
        self.effects().iter().map(|effect| effect.target.clone()).collect()
    }

    /// Whether an effect changes the parameters, or the response to them, for the frequency of a single mode only.
    fn has_effects_in_single_modes(&self) -> bool {
        self.effects().iter().any(|effect| matches!(effect.target, Target::InMode(..) | Target::ModeGain { .. }))
    }

    /// The lowest `count` modes of the structure under the effects at `corrected` parameters (`[d]`), with their shapes at the degrees
    /// of freedom `points`, and the derivatives of the shapes that are wanted ([`respond_shaped`]). Sizes begin with those that parameters set.
    fn shaped(
        &self,
        matrices: &Matrices,
        corrected: &[f64],
        count: usize,
        (points, wanted): (&[usize], (&[usize], usize)),
    ) -> Result<Shaped, physics::Error> {
        let (targets, sizes) = matrices.with_sizes(corrected, (&self.targets(), self.sizes()));
        respond_shaped(&matrices.at(corrected)?, count, (&targets, &sizes), points, wanted)
    }

    /// Number of simulated modes to pair with the measured ones: the measured modes and a few above, which can swap with them.
    pub fn modes_to_pair(&self) -> usize {
        modes_to_pair(self.modes(), self.structure().map_or(self.modes(), Structure::dofs))
    }

    /// As [`Self::respond`], but for the modes that resemble the `reference` modes, one for each, with their shapes at the
    /// instrumented points ([`respond_tracked`]). `None` for the shapes if the structure has no instrumented points.
    ///
    /// # Errors
    /// As [`Self::respond`].
    pub fn respond_tracked(
        &self,
        theta: &[f64],
        reference: &[ReferenceMode],
        targets: &[Target],
        sizes: &[f64],
    ) -> Result<(Response, Option<ShapeResponse>), physics::Error> {
        let (SimulationModel::Matrices(matrices), Some(instrumented)) = (self.model(), self.instrumented()) else {
            return Ok((self.respond(theta, reference.len(), targets, sizes)?, None));
        };
        let moved = self.moved(theta, targets, sizes);
        let at = moved.theta();
        let (targets, sizes) = matrices.with_sizes(at, (&moved.targets, &moved.sizes));
        let (response, shapes) = respond_tracked(&matrices.at(at)?, &targets, &sizes, &instrumented.dofs, reference)?;
        let chained = |by_spring: &DMatrix<f64>, by_size: &DMatrix<f64>| {
            moved.chain(&matrices.by_parameter(by_spring, by_size, at), matrices.further(by_size))
        };
        let (by_parameter, by_size) = chained(&response.by_spring, &response.by_size);
        let response = Response { frequencies_hz: response.frequencies_hz, by_parameter, by_size };
        let (by_parameter, by_size) = chained(&shapes.by_spring, &shapes.by_size);
        Ok((response, Some(ShapeResponse { coordinates: shapes.coordinates, by_parameter, by_size })))
    }
}
