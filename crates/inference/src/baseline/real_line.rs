//! The map between a box of parameters and the real line, where the flow is defined.

use candle_core::{Device, Result, Tensor};
use nalgebra::DMatrix;
use rayon::prelude::*;

use structures::parameter::ParameterSpace;

/// Draws that one task maps back to the box.
const DRAWS_PER_TASK: usize = 512;

/// The logistic function 1/(1 + e⁻ˣ), inverse of the logit.
pub(super) fn logistic(x: f64) -> f64 {
    1.0 / (1.0 + (-x).exp())
}

/// Maps draws x from the real line to θ in the box `space`, and their log-densities to those of the unit box, in place.
///
/// ```text
///  u = 1/(1 + e⁻ˣ),    ln q ← ln q − Σ ln u(1 − u) = ln q + Σ |x| + 2 ln Π (1 + e^−|x|)
/// ```
///
/// `values`: the d numbers of each draw in sequence, n·d in all; `log_density`: n.
pub(super) fn from_real_line(values: &mut [f64], log_density: &mut [f64], space: &ParameterSpace) {
    let d = space.len();
    let parts = values.par_chunks_mut(DRAWS_PER_TASK * d).zip(log_density.par_chunks_mut(DRAWS_PER_TASK));
    parts.for_each(|(values, log_density)| {
        for (values, log_q) in values.chunks_exact_mut(d).zip(log_density) {
            let mut product = 1.0_f64;
            for (value, parameter) in values.iter_mut().zip(space) {
                let e = (-value.abs()).exp();
                *log_q += value.abs();
                product *= 1.0 + e;
                if product > 1e200 {
                    *log_q += 2.0 * product.ln();
                    product = 1.0;
                }
                let unit = if *value < 0.0 { e / (1.0 + e) } else { 1.0 / (1.0 + e) };
                *value = parameter.from_unit(unit);
            }
            *log_q += 2.0 * product.ln();
        }
    });
}

/// Maps θ `[n, d]` in the box `space` to the real line, by the logit of its position in the box; f64 `[n, d]`.
pub(super) fn to_real_line(theta: &DMatrix<f64>, space: &ParameterSpace) -> Result<Tensor> {
    let (rows, columns) = theta.shape();
    let mut values = Vec::with_capacity(rows * columns);
    for row in 0..rows {
        for (column, parameter) in space.iter().enumerate() {
            // The logit of 0 or 1 is infinite.
            let unit = parameter.to_unit(theta[(row, column)]).clamp(1e-9, 1.0 - 1e-9);
            values.push((unit / (1.0 - unit)).ln());
        }
    }
    Tensor::from_vec(values, (rows, columns), &Device::Cpu)
}
