//! The optimiser, on a vector of all weights.

use rayon::prelude::*;

use crate::flow::kernel::add;

/// Weights that one task updates.
const AT_A_TIME: usize = 4_096;
const BETA_1: f32 = 0.9;
const BETA_2: f32 = 0.999;
const EPSILON: f32 = 1e-8;

/// Adam with the default settings of candle's `AdamW` and without weight decay.
///
/// ```text
///  m ← β₁m + (1 − β₁)g,   v ← β₂v + (1 − β₂)g²,   w ← w − η · m/(1 − β₁ᵗ) / (√(v/(1 − β₂ᵗ)) + ε)
/// ```
pub(super) struct AdamW {
    first: Vec<f32>,
    second: Vec<f32>,
    steps: i32,
}

impl AdamW {
    pub(super) fn new(weights: usize) -> Self {
        Self { first: vec![0.0; weights], second: vec![0.0; weights], steps: 0 }
    }

    /// Makes one step. The gradient is the sum of `gradients`, added in their order.
    pub(super) fn step(&mut self, weights: &mut [f32], gradients: &[&[f32]], learning_rate: f64) {
        self.steps += 1;
        let correction = |beta: f32| 1.0 / (1.0 - f64::from(beta).powi(self.steps));
        let (of_first, of_second) = (correction(BETA_1) * learning_rate, correction(BETA_2) as f32);
        let of_first = of_first as f32;
        let moments = self.first.par_chunks_mut(AT_A_TIME).zip(self.second.par_chunks_mut(AT_A_TIME));
        weights.par_chunks_mut(AT_A_TIME).zip(moments).enumerate().for_each(|(chunk, (weights, (first, second)))| {
            let range = chunk * AT_A_TIME..chunk * AT_A_TIME + weights.len();
            let mut sum = [0.0; AT_A_TIME];
            let sum = &mut sum[..weights.len()];
            for gradient in gradients {
                add(sum, &gradient[range.clone()]);
            }
            update(weights, sum, first, second, of_first, of_second);
        });
    }
}

/// Computes w, m and v of the next step. `of_first`: η/(1 − β₁ᵗ); `of_second`: 1/(1 − β₂ᵗ).
#[pulp::with_simd(update = pulp::Arch::new())]
#[inline(always)]
fn update_simd<S: pulp::Simd>(
    _: S,
    weights: &mut [f32],
    gradient: &[f32],
    first: &mut [f32],
    second: &mut [f32],
    of_first: f32,
    of_second: f32,
) {
    for (((weight, gradient), first), second) in weights.iter_mut().zip(gradient).zip(first).zip(second) {
        *first = BETA_1 * *first + (1.0 - BETA_1) * gradient;
        *second = BETA_2 * *second + (1.0 - BETA_2) * gradient * gradient;
        *weight -= of_first * *first / ((*second * of_second).sqrt() + EPSILON);
    }
}
