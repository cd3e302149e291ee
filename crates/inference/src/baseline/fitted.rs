//! Draws, densities and training pairs of a flow that starts at the best fit; see [`super::start`].

use candle_core::{DType, Device, Tensor};
use nalgebra::{DMatrix, DMatrixView};
use rayon::prelude::*;

use super::conditions::Conditions;
use super::error::InferenceError;
use super::model::{fit_condition, Baseline};
use super::observation::Observation;
use super::resample::Proposals;
use super::start::{locate_all, Located};
use crate::flow::pairs::Pairs;
use structures::parameter::Parameter;
use structures::simulator::{Simulator, TrainingSet};
use structures::stats;

/// Measurements fitted at a time: the precision matrix of each has d² entries.
const AT_A_TIME: usize = 64;

impl Baseline {
    /// The flow's draws about the best fits, `draws` per observation, inside the prior.
    ///
    /// # Errors
    /// [`InferenceError`] for another number of modes or a draw that is not finite.
    pub(super) fn propose_from_fit(
        &self,
        observations: &[Observation],
        draws: usize,
        seed: u64,
    ) -> Result<Proposals, InferenceError> {
        let prior = self.space().as_slice();
        let d = prior.len();
        let mut stream = stats::stream(seed, "latent");
        let mut theta = DMatrix::zeros(observations.len() * draws, d);
        let mut log_density = Vec::with_capacity(theta.nrows());
        let mut moved = vec![false; observations.len()];
        for (chunk, part) in observations.chunks(AT_A_TIME).enumerate() {
            let (located, context) = self.locate(part)?;
            let (x, own) = self.draw_from_flow(&context, draws, &mut stream)?;
            let x = x.to_dtype(DType::F64)?.flatten_all()?.to_vec1::<f64>()?;
            log_density.extend(own.to_dtype(DType::F64)?.to_vec1::<f64>()?);
            let drawn = x.chunks_exact(d * draws).zip(&located).enumerate();
            // Each measurement has its own stream, so that the draws do not depend on the number of threads.
            let placed: Vec<(DMatrix<f64>, bool)> = drawn
                .collect::<Vec<_>>()
                .into_par_iter()
                .map(|(row, (x, fit))| {
                    let mut unit = fit.from_flow(&DMatrix::from_column_slice(d, draws, x));
                    let mut stream =
                        stats::stream(seed, &format!("draws beyond the prior {}", chunk * AT_A_TIME + row));
                    let mut beyond = false;
                    for draw in unit.as_mut_slice().chunks_exact_mut(d) {
                        beyond |= fit.draw_back(draw, &mut stream);
                    }
                    (unit, beyond)
                })
                .collect();
            for (row, (unit, beyond)) in placed.into_iter().enumerate() {
                let row = chunk * AT_A_TIME + row;
                moved[row] = beyond;
                for (draw, position) in unit.column_iter().enumerate() {
                    for (column, parameter) in prior.iter().enumerate() {
                        let value = parameter.from_unit(position[column]);
                        if !value.is_finite() {
                            return Err(InferenceError::NotFinite { row, parameter: parameter.name.clone() });
                        }
                        theta[(row * draws + draw, column)] = value;
                    }
                }
            }
        }
        Ok(Proposals { theta, log_density, moved })
    }

    /// Log-density of each row of `theta` in the unit box of the prior, nats. `theta` `[n·k, d]` has the same number k of
    /// rows for each of the n observations.
    ///
    /// # Errors
    /// [`InferenceError`] for another number of modes.
    pub(super) fn log_density_from_fit(
        &self,
        theta: &DMatrix<f64>,
        observations: &[Observation],
    ) -> Result<Vec<f64>, InferenceError> {
        let prior = self.space().as_slice();
        let each = theta.nrows() / observations.len().max(1);
        let mut all = Vec::with_capacity(theta.nrows());
        for (chunk, part) in observations.chunks(AT_A_TIME).enumerate() {
            let (located, context) = self.locate(part)?;
            let features = context.dim(1)?;
            let x = to_flow(&located, prior, &theta.rows(chunk * AT_A_TIME * each, part.len() * each))?;
            let x = x.to_dtype(self.flow.dtype())?;
            let shape = (part.len(), each, features);
            let repeated = context.unsqueeze(1)?.expand(shape)?.reshape((part.len() * each, features))?;
            let log_q = self.flow.log_prob(&x, &repeated)?.to_dtype(DType::F64)?.to_vec1::<f64>()?;
            all.extend(log_q.into_iter().enumerate().map(|(row, log_q)| log_q + located[row / each].log_det()));
        }
        Ok(all)
    }
}

/// Training pairs: the deviation of each parameter vector from the best fit of its measurement, and the condition of the
/// flow at that fit.
///
/// # Errors
/// [`InferenceError::Simulation`], which cannot occur inside a checked prior.
pub(super) fn fitted_pairs(
    simulator: &Simulator,
    conditions: &Conditions,
    set: &TrainingSet,
    observations: &[Observation],
) -> Result<Pairs, InferenceError> {
    let prior = simulator.space().as_slice();
    let width = conditions.fixed_context(prior.len());
    let (mut x, mut y) = (Vec::new(), Vec::new());
    for (chunk, part) in observations.chunks(AT_A_TIME).enumerate() {
        let located = locate_all(simulator, part).map_err(|e| InferenceError::Simulation(e.to_string()))?;
        x.push(to_flow(&located, prior, &set.theta.rows(chunk * AT_A_TIME, part.len()))?.to_dtype(DType::F32)?);
        y.push(fit_condition(&located, part, conditions, width)?.to_dtype(DType::F32)?);
    }
    Ok(Pairs { x: Tensor::cat(&x, 0)?, y: Tensor::cat(&y, 0)? })
}

/// Largest |u − u'| after x → z → x', where u is the position in the prior box.
///
/// # Errors
/// [`InferenceError`] for another number of modes.
pub(super) fn inverse_error_from_fit(
    baseline: &Baseline,
    theta: &DMatrix<f64>,
    observations: &[Observation],
) -> Result<f64, InferenceError> {
    let prior = baseline.space().as_slice();
    let (located, context) = baseline.locate(observations)?;
    let unit = |row: usize| DMatrix::from_fn(prior.len(), 1, |k, _| prior[k].to_unit(theta[(row, k)]));
    let x = to_flow(&located, prior, &theta.as_view())?.to_dtype(DType::F32)?;
    let (z, _) = baseline.flow.forward(&x, &context)?;
    let back = baseline.flow.inverse(&z, &context)?.0.to_dtype(DType::F64)?.to_vec2::<f64>()?;
    let error = |(row, (x, fit)): (usize, (Vec<f64>, &Located))| {
        (fit.from_flow(&DMatrix::from_column_slice(x.len(), 1, &x)) - unit(row)).amax()
    };
    Ok(back.into_iter().zip(&located).enumerate().map(error).fold(0.0, f64::max))
}

/// Maps rows of `theta`, the same number for each fit and in their order, to the space of the flow, f64 `[rows, d]`.
///
/// # Errors
/// A candle error, which would be a bug.
fn to_flow(
    located: &[Located],
    prior: &[Parameter],
    theta: &DMatrixView<'_, f64>,
) -> Result<Tensor, candle_core::Error> {
    let (d, each) = (prior.len(), theta.nrows() / located.len().max(1));
    let mut x = Vec::with_capacity(theta.len());
    for (row, fit) in located.iter().enumerate() {
        let unit = DMatrix::from_fn(d, each, |k, draw| prior[k].to_unit(theta[(row * each + draw, k)]));
        x.extend_from_slice(fit.to_flow(&unit).as_slice());
    }
    Tensor::from_vec(x, (theta.nrows(), d), &Device::Cpu)
}
