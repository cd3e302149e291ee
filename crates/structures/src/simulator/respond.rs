//! Frequencies under effects, with their derivatives with respect to the parameters and to the sizes of the effects.

use nalgebra::DMatrix;

use super::model::SimulationModel;
use super::moved::MovedParameters;
use super::settings::{groups_of_modes, CorrectedParameters};
use super::simulate::Simulator;
use crate::physics;
use crate::physics::effect::{frequencies_under, respond, Target};
use crate::physics::measured::measured;

/// Frequencies under effects and their derivatives.
#[derive(Debug, Clone)]
pub struct Response {
    /// Frequencies as the instrument reports them, Hz, `[m]`.
    pub frequencies_hz: Vec<f64>,
    /// Derivatives with respect to the parameters, Hz per parameter unit, `[m, d]`.
    pub by_parameter: DMatrix<f64>,
    /// Derivatives with respect to the sizes of the further effects, Hz per unit of the size, `[m, sizes]`.
    pub by_size: DMatrix<f64>,
}

impl Simulator {
    /// The lowest `modes` frequencies at parameters `theta` (`[d]`, parameter units) under the effects of the structure file
    /// and the further effects `targets`, and their derivatives with respect to the parameters and to the sizes of the further
    /// effects, `sizes` (`[sizes]`, in the units of the targets).
    ///
    /// # Errors
    /// As [`Self::frequencies_hz`] and [`respond`].
    pub fn respond(
        &self,
        theta: &[f64],
        modes: usize,
        targets: &[Target],
        sizes: &[f64],
    ) -> Result<Response, physics::Error> {
        let own: usize = self.sizes().len();
        let targets: Vec<Target> = self.effects().iter().map(|e| &e.target).chain(targets).cloned().collect();
        let sizes: Vec<f64> = self.sizes().iter().chain(sizes).copied().collect();
        let (targets, sizes) = (targets.as_slice(), sizes.as_slice());
        if !targets.iter().any(Target::acts_on_parameters) {
            let found = self.respond_at(theta, modes, targets, sizes)?;
            let by_size = found.by_size.columns(own, sizes.len() - own).into_owned();
            return Ok(Response { by_size, ..found });
        }
        let mut found = Response {
            frequencies_hz: vec![0.0; modes],
            by_parameter: DMatrix::zeros(modes, theta.len()),
            by_size: DMatrix::zeros(modes, sizes.len()),
        };
        for group in groups_of_modes(targets, modes) {
            let Some(mode) = group.first() else { continue };
            let corrected = CorrectedParameters::new(theta, targets, sizes, *mode);
            let response = self.respond_at(&corrected.theta, modes, targets, sizes)?;
            let by_parameter = &response.by_parameter * &corrected.by_theta;
            let by_size = &response.by_size + &response.by_parameter * &corrected.by_size;
            for mode in group {
                found.frequencies_hz[mode] = response.frequencies_hz[mode];
                found.by_parameter.set_row(mode, &by_parameter.row(mode));
                found.by_size.set_row(mode, &by_size.row(mode));
            }
        }
        self.apply_gains(&mut found, theta, targets, sizes)?;
        let by_size = found.by_size.columns(own, sizes.len() - own).into_owned();
        Ok(Response { by_size, ..found })
    }

    /// The frequencies of [`Self::respond`] under the effects of the structure file, Hz, `[m]`, without derivatives where matrices give them.
    ///
    /// # Errors
    /// As [`Self::respond`].
    pub(super) fn frequencies_under_effects(&self, theta: &[f64]) -> Result<Vec<f64>, physics::Error> {
        let targets: Vec<Target> = self.effects().iter().map(|effect| effect.target.clone()).collect();
        match self.model() {
            SimulationModel::Matrices(matrices) if !targets.iter().any(Target::acts_on_parameters) => {
                let (targets, sizes) = matrices.with_sizes(theta, (&targets, self.sizes()));
                frequencies_under(&matrices.at(theta)?, self.modes(), &targets, &sizes)
            }
            _ => self.respond(theta, self.modes(), &[], &[]).map(|response| response.frequencies_hz),
        }
    }

    /// The parameters `theta` (`[d]`) under the effects of the structure file and the further effects `targets` of the sizes
    /// `sizes`.
    pub(super) fn moved(&self, theta: &[f64], targets: &[Target], sizes: &[f64]) -> MovedParameters {
        let own: Vec<Target> = self.effects().iter().map(|e| e.target.clone()).collect();
        MovedParameters::new(theta, (own.as_slice(), self.sizes()), (targets, sizes))
    }

    /// The response at corrected parameters: targets on parameters are not applied, and the derivatives by their sizes are 0.
    fn respond_at(
        &self,
        theta: &[f64],
        modes: usize,
        targets: &[Target],
        sizes: &[f64],
    ) -> Result<Response, physics::Error> {
        Ok(match self.model() {
            SimulationModel::Matrices(matrices) => {
                let (targets, sizes) = matrices.with_sizes(theta, (targets, sizes));
                let response = respond(&matrices.at(theta)?, modes, &targets, &sizes)?;
                let by_parameter = matrices.by_parameter(&response.by_spring, &response.by_size, theta);
                let by_size = matrices.further(&response.by_size);
                Response { frequencies_hz: response.frequencies_hz, by_parameter, by_size }
            }
            SimulationModel::Table(table) => {
                let (frequencies, jacobian) = table.frequencies_and_jacobian(theta);
                let found = measured(&frequencies, &jacobian, modes, targets, sizes)?;
                Response {
                    frequencies_hz: found.frequencies_hz,
                    by_parameter: found.by_parameter,
                    by_size: found.by_size,
                }
            }
        })
    }

    /// Applies the gains of single modes to a response.
    ///
    /// ```text
    ///  ln f' = (1 + g) ln f − g ln f_r + h,    f'ₓ = f' [(1 + g) fₓ/f − g f_r,ₓ/f_r],    ∂f'/∂g = f' ln(f/f_r),    ∂f'/∂h = f'
    /// ```
    ///
    /// f_r: the same response with the parameter of the gain at its reference; g and h: the two sizes.
    fn apply_gains(
        &self,
        response: &mut Response,
        theta: &[f64],
        targets: &[Target],
        sizes: &[f64],
    ) -> Result<(), physics::Error> {
        let mut first = 0;
        for target in targets {
            if let Target::ModeGain { mode, column, reference } = target {
                let (mode, modes) = (*mode, response.frequencies_hz.len());
                let mut corrected = CorrectedParameters::new(theta, targets, sizes, mode);
                corrected.clamp(*column, [*reference; 2]);
                let at = self.respond_at(&corrected.theta, modes, targets, sizes)?;
                let (gain, level) = (sizes[first], sizes[first + 1]);
                let (f, f_r) = (response.frequencies_hz[mode], at.frequencies_hz[mode]);
                let ratio = (f / f_r).ln();
                let changed = f * (gain * ratio + level).exp();
                let by_parameter = at.by_parameter.row(mode) * &corrected.by_theta;
                let by_size = at.by_size.row(mode) + at.by_parameter.row(mode) * &corrected.by_size;
                let slope = |own: f64, other: f64| changed * ((1.0 + gain) * own / f - gain * other / f_r);
                for k in 0..theta.len() {
                    response.by_parameter[(mode, k)] = slope(response.by_parameter[(mode, k)], by_parameter[k]);
                }
                for size in 0..sizes.len() {
                    response.by_size[(mode, size)] = slope(response.by_size[(mode, size)], by_size[size]);
                }
                response.by_size[(mode, first)] += changed * ratio;
                response.by_size[(mode, first + 1)] += changed;
                response.frequencies_hz[mode] = changed;
            }
            first += target.sizes();
        }
        Ok(())
    }
}
