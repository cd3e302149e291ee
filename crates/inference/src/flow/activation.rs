//! The activation of all hidden layers, with one pass over memory forward and one backward.
//!
//! candle composes the derivative of SiLU from six operations and calls the C library for each exponential. Here each
//! direction is one vectorised loop, which halves the time of a training step.

use candle_core::{bail, CpuStorage, CustomOp1, CustomOp2, Layout, Result, Shape, Tensor};

use super::kernel::sigmoid;

/// Sigmoid linear unit silu(x) = x / (1 + exp(−x)), element by element. The result has the shape of `x`.
///
/// # Errors
/// A candle error when `x` is neither f32 nor f64, or is not contiguous in the memory of the CPU.
pub fn silu(x: &Tensor) -> Result<Tensor> {
    x.apply_op1(Silu)
}

struct Silu;

/// Derivative of [`Silu`] times the gradient with respect to its result.
struct SiluGradient;

impl CustomOp1 for Silu {
    fn name(&self) -> &'static str {
        "silu"
    }

    fn cpu_fwd(&self, storage: &CpuStorage, layout: &Layout) -> Result<(CpuStorage, Shape)> {
        let result = match storage {
            CpuStorage::F32(x) => CpuStorage::F32(silu_f32(contiguous(x, layout)?)),
            CpuStorage::F64(x) => {
                CpuStorage::F64(contiguous(x, layout)?.iter().map(|x| x / (1.0 + (-x).exp())).collect())
            }
            _ => bail!("silu takes f32 or f64"),
        };
        Ok((result, layout.shape().clone()))
    }

    fn bwd(&self, x: &Tensor, _: &Tensor, gradient: &Tensor) -> Result<Option<Tensor>> {
        Ok(Some(x.apply_op2_no_bwd(&gradient.contiguous()?, &SiluGradient)?))
    }
}

impl CustomOp2 for SiluGradient {
    fn name(&self) -> &'static str {
        "silu-gradient"
    }

    fn cpu_fwd(&self, x: &CpuStorage, lx: &Layout, g: &CpuStorage, lg: &Layout) -> Result<(CpuStorage, Shape)> {
        let result = match (x, g) {
            (CpuStorage::F32(x), CpuStorage::F32(g)) => {
                CpuStorage::F32(silu_gradient_f32(contiguous(x, lx)?, contiguous(g, lg)?))
            }
            (CpuStorage::F64(x), CpuStorage::F64(g)) => {
                let one = |(x, g): (&f64, &f64)| {
                    let sigmoid = 1.0 / (1.0 + (-x).exp());
                    g * sigmoid * (1.0 + x * (1.0 - sigmoid))
                };
                CpuStorage::F64(contiguous(x, lx)?.iter().zip(contiguous(g, lg)?).map(one).collect())
            }
            _ => bail!("silu takes f32 or f64"),
        };
        Ok((result, lx.shape().clone()))
    }
}

fn contiguous<'a, T>(values: &'a [T], layout: &Layout) -> Result<&'a [T]> {
    match layout.contiguous_offsets() {
        Some((start, end)) => Ok(&values[start..end]),
        None => bail!("silu takes contiguous tensors"),
    }
}

fn silu_f32(x: &[f32]) -> Vec<f32> {
    let mut result = x.to_vec();
    silu_of(&mut result);
    result
}

fn silu_gradient_f32(x: &[f32], g: &[f32]) -> Vec<f32> {
    let mut result = g.to_vec();
    times_slope(&mut result, x);
    result
}

/// x ← silu(x).
#[pulp::with_simd(silu_of = pulp::Arch::new())]
#[inline(always)]
fn silu_of_simd<S: pulp::Simd>(_: S, values: &mut [f32]) {
    for x in values {
        *x *= sigmoid(*x);
    }
}

/// g ← g·silu′(x).
#[pulp::with_simd(times_slope = pulp::Arch::new())]
#[inline(always)]
fn times_slope_simd<S: pulp::Simd>(_: S, gradient: &mut [f32], x: &[f32]) {
    for (g, x) in gradient.iter_mut().zip(x) {
        let sigmoid = sigmoid(*x);
        *g *= sigmoid * (1.0 + x * (1.0 - sigmoid));
    }
}

#[cfg(test)]
mod tests {
    use candle_core::{Device, Var};

    use super::*;

    #[test]
    fn values_and_gradients_are_those_of_the_formula() {
        let points: Vec<f32> = (-4000..=4000).map(|i| i as f32 / 40.0).collect();
        let x = Var::new(points.as_slice(), &Device::Cpu).unwrap();
        let y = silu(&x).unwrap();
        let gradient = y.sum_all().unwrap().backward().unwrap().get(&x).unwrap().to_vec1::<f32>().unwrap();
        for ((x, y), slope) in points.iter().zip(y.to_vec1::<f32>().unwrap()).zip(gradient) {
            let x = f64::from(*x);
            let sigmoid = 1.0 / (1.0 + (-x).exp());
            let expected = [x * sigmoid, sigmoid * (1.0 + x * (1.0 - sigmoid))];
            for (found, expected) in [f64::from(y), f64::from(slope)].into_iter().zip(expected) {
                // The rounding error of f32 is 6e-8, which x·(1 − sigmoid) multiplies by x. The slope crosses zero, where
                // only the absolute error is meaningful.
                let tolerance = 4e-7 * (1.0 + expected.abs()) + 1.2e-7 * x.abs();
                assert!((found - expected).abs() < tolerance, "at {x}: {found}, expected {expected}");
            }
        }
    }
}
