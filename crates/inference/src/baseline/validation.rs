//! Accuracy of a trained model on held-out pairs.

use candle_core::{DType, Tensor};
use nalgebra::DMatrix;

use super::error::InferenceError;
use super::fitted::inverse_error_from_fit;
use super::manifest::{ParameterValidation, ValidationRecord};
use super::model::Baseline;
use super::observation::Observation;
use super::real_line::{logistic, to_real_line};
use structures::parameter::Parameter;
use structures::stats;

/// Draws per held-out pair.
const HELD_OUT_DRAWS: usize = 10;

/// Measures a model on held-out pairs: mean log-density of the truth above that of the prior, R² of posterior means and samples, inverse error of
/// the flow. `theta`: `[n, d]`, the truths of the n observations.
///
/// Source: Wang et al. (2025), Fig. 8.
///
/// # Errors
/// [`InferenceError`] when a draw is not finite.
pub fn validate(
    baseline: &Baseline,
    theta: &DMatrix<f64>,
    observations: &[Observation],
    seed: u64,
) -> Result<ValidationRecord, InferenceError> {
    let count = observations.len();
    let density = baseline.log_density_unit_box(theta, observations)?;
    let prior = theta.row_iter().map(|row| baseline.space().log_prior(row.iter()));
    let losses: Vec<f64> = prior.zip(&density).map(|(prior, log_q)| prior - log_q).collect();
    let samples = baseline.infer(observations, HELD_OUT_DRAWS, seed)?;
    let means = samples.means();
    let validation = |(column, parameter): (usize, &Parameter)| {
        let truth: Vec<f64> = theta.column(column).iter().copied().collect();
        let mean: Vec<f64> = means.column(column).iter().copied().collect();
        let single: Vec<f64> = samples.column(column).into_iter().step_by(HELD_OUT_DRAWS).collect();
        let all = samples.column(column);
        let errors: Vec<f64> = all.iter().enumerate().map(|(i, x)| (x - truth[i / HELD_OUT_DRAWS]).abs()).collect();
        ParameterValidation {
            name: parameter.name.clone(),
            r_squared_mean: stats::r_squared(&truth, &mean),
            r_squared_single: stats::r_squared(&truth, &single),
            error_quantile_999: stats::quantile(&errors, 0.999),
        }
    };
    Ok(ValidationRecord {
        samples: count,
        negative_log_likelihood: stats::mean(&losses),
        negative_log_likelihood_error: stats::sample_std(&losses).unwrap_or(f64::NAN) / (count as f64).sqrt(),
        parameters: baseline.space().iter().enumerate().map(validation).collect(),
        inverse_error: inverse_error(baseline, theta, observations)?,
    })
}

/// Error of the numerical inverse of the flow: largest |u − u'| after x → z → x', where u is the position in the training box.
fn inverse_error(
    baseline: &Baseline,
    theta: &DMatrix<f64>,
    observations: &[Observation],
) -> Result<f64, InferenceError> {
    if baseline.starts_at_fit() {
        return inverse_error_from_fit(baseline, theta, observations);
    }
    let x = to_real_line(theta, &baseline.training_space)?.to_dtype(DType::F32)?;
    let context = baseline.condition(observations)?;
    let (z, _) = baseline.flow.forward(&x, &context)?;
    let back = baseline.flow.inverse(&z, &context)?;
    let unit = |t: &Tensor| t.to_dtype(DType::F64)?.flatten_all()?.to_vec1::<f64>();
    let pairs = unit(&x)?.into_iter().zip(unit(&back.0)?);
    Ok(pairs.map(|(a, b)| (logistic(a) - logistic(b)).abs()).fold(0.0, f64::max))
}
