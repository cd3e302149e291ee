//! Posterior densities of given parameters.

use candle_core::{DType, Tensor};
use nalgebra::DMatrix;

use super::error::InferenceError;
use super::model::Baseline;
use super::observation::Observation;
use super::real_line::{logistic, to_real_line};
use structures::parameter::Parameter;
use structures::stats;

/// Draws that estimate which share of a posterior lies inside the prior.
const SHARE_DRAWS: usize = 200;

impl Baseline {
    /// Log-density of each row of `theta` given the observation of the same row, in the unit box of the prior, nats.
    ///
    /// ```text
    ///  ln q(u | y) = ln q(ℓ | y) − Σ ln v(1 − v) − Σ ln(training width/prior width) − ln P(inside the prior | y)
    ///  ℓ = logit v,    v = (θ − lower)/width of the training box
    /// ```
    ///
    /// P(inside the prior | y) is estimated from draws. Where the flow starts at the best fit it is taken as 1, so that the
    /// density is too low by the mass that the flow places outside the prior.
    ///
    /// `theta`: `[n, d]` inside the prior box; `observations`: n. Returns n values.
    ///
    /// # Errors
    /// [`InferenceError`] for another number of modes.
    pub fn log_density_unit_box(
        &self,
        theta: &DMatrix<f64>,
        observations: &[Observation],
    ) -> Result<Vec<f64>, InferenceError> {
        if self.starts_at_fit() {
            return self.log_density_from_fit(theta, observations);
        }
        let context = self.condition(observations)?;
        let (drawn, _) = self.draw_from_flow(&context, SHARE_DRAWS, &mut stats::stream(0, "share inside the prior"))?;
        let drawn = drawn.to_dtype(DType::F64)?.to_vec2::<f64>()?;
        let inside = |values: &&Vec<f64>| {
            let pairs = values.iter().zip(self.training_space.iter().zip(self.space()));
            { pairs }.all(|(x, (wide, prior))| (prior.lower..=prior.upper).contains(&wide.from_unit(logistic(*x))))
        };
        let share = |row: usize| {
            let count = drawn[row * SHARE_DRAWS..(row + 1) * SHARE_DRAWS].iter().filter(inside).count();
            (count.max(1) as f64 / SHARE_DRAWS as f64).ln()
        };
        let density = self.log_density(theta, &context)?;
        Ok(density.into_iter().enumerate().map(|(row, log_q)| log_q - share(row)).collect())
    }

    /// Log-density of the flow at `draws` rows of `theta` for each observation, in the unit box of the prior, nats. It is
    /// not normalised by the mass inside the prior, which is the same for all rows of one observation.
    ///
    /// Where a covariate is missing, the density is the mean over its possible values:
    ///
    /// ```text
    ///  q(x | y) = 1/C Σ_c q(x | y, c)
    /// ```
    ///
    /// `theta`: `[n·draws, d]`; `observations`: n. Returns n·draws values.
    ///
    /// # Errors
    /// [`InferenceError`] for another number of modes.
    pub(super) fn log_density_of_draws(
        &self,
        theta: &DMatrix<f64>,
        observations: &[Observation],
    ) -> Result<Vec<f64>, InferenceError> {
        if observations.iter().any(Observation::is_marginalised) {
            return self.marginal_log_density_of_draws(theta, observations);
        }
        if self.starts_at_fit() {
            return self.log_density_from_fit(theta, observations);
        }
        let draws = theta.nrows() / observations.len().max(1);
        let context = self.condition(observations)?;
        let (rows, features) = context.dims2()?;
        let repeated = context.unsqueeze(1)?.expand((rows, draws, features))?.reshape((rows * draws, features))?;
        self.log_density(theta, &repeated)
    }

    /// As [`Self::log_density_of_draws`], for observations of which some lack a covariate; one observation at a time.
    fn marginal_log_density_of_draws(
        &self,
        theta: &DMatrix<f64>,
        observations: &[Observation],
    ) -> Result<Vec<f64>, InferenceError> {
        let draws = theta.nrows() / observations.len().max(1);
        let mut all = Vec::with_capacity(theta.nrows());
        for (row, observation) in observations.iter().enumerate() {
            let own = theta.rows(row * draws, draws);
            let known =
                if observation.is_marginalised() { observation.at_each_size() } else { vec![observation.clone()] };
            let count = known.len();
            let repeated = DMatrix::from_fn(count * draws, own.ncols(), |i, k| own[(i % draws, k)]);
            let densities = self.log_density_of_draws(&repeated, &known)?;
            for draw in 0..draws {
                let values = || (0..count).map(|value| densities[value * draws + draw]);
                let largest = values().fold(f64::NEG_INFINITY, f64::max);
                let sum: f64 = values().map(|v| (v - largest).exp()).sum();
                all.push(largest + (sum / count as f64).ln());
            }
        }
        Ok(all)
    }

    /// Log-density of each row of `theta` `[n, d]` under the flow with the context of the same row, `[n, context]`, in the
    /// unit box of the prior.
    fn log_density(&self, theta: &DMatrix<f64>, context: &Tensor) -> Result<Vec<f64>, InferenceError> {
        let x = to_real_line(theta, &self.training_space)?.to_dtype(self.flow.dtype())?;
        let log_q = self.flow.log_prob(&x, context)?.to_dtype(DType::F64)?.to_vec1::<f64>()?;
        let stretch = |row: usize| -> f64 {
            let one = |(column, (wide, prior)): (usize, (&Parameter, &Parameter))| {
                let v = wide.to_unit(theta[(row, column)]);
                (v * (1.0 - v)).ln() + ((wide.upper - wide.lower) / (prior.upper - prior.lower)).ln()
            };
            self.training_space.iter().zip(self.space()).enumerate().map(one).sum()
        };
        Ok(log_q.into_iter().enumerate().map(|(row, log_q)| log_q - stretch(row)).collect())
    }
}
