//! Building blocks of fused training and sampling: products of a layer with a tile, and loops over its elements.
//!
//! The body of a loop is compiled once for each vector width (`pulp::with_simd`), and the width of the processor is
//! selected at run time. Everything in the loop must be inlined: a call would be compiled for the smallest width.
//!
//! A tile is a column-major matrix of single-precision numbers; a column is one row of the batch, or one draw.

use faer::linalg::matmul::matmul;
use faer::{Accum, MatMut, MatRef, Par};

use structures::simd;

/// W and b of a dense layer, borrowed.
#[derive(Clone, Copy)]
pub(super) struct Layer<'a> {
    /// W, `[outputs, inputs]`. A column-major matrix is multiplied in place; a row-major one is copied for each product.
    pub weight: MatRef<'a, f32>,
    /// b.
    pub bias: &'a [f32],
}

impl Layer<'_> {
    pub(super) fn outputs(&self) -> usize {
        self.bias.len()
    }

    pub(super) fn inputs(&self) -> usize {
        self.weight.ncols()
    }

    /// y ← W·x, or y ← y + W·x with `add`. The bias is added by the elementwise loop that follows.
    pub(super) fn product(&self, x: &[f32], y: &mut [f32], add: bool) {
        self.product_of_columns(0..self.inputs(), x, y, add);
    }

    /// As [`Self::product`], with a range of columns of W.
    pub(super) fn product_of_columns(&self, columns: std::ops::Range<usize>, x: &[f32], y: &mut [f32], add: bool) {
        if columns.is_empty() {
            if !add {
                y.fill(0.0);
            }
            return;
        }
        let count = y.len() / self.outputs();
        let x = MatRef::from_column_major_slice(x, columns.len(), count);
        let y = MatMut::from_column_major_slice_mut(y, self.outputs(), count);
        let weight = self.weight.subcols(columns.start, columns.len());
        matmul(y, accumulation(add), weight, x, 1.0, Par::Seq);
    }

    /// Gradient with respect to the layer's input from that with respect to its product: dx ← Wᵀ·dy.
    pub(super) fn input_gradient(&self, dy: &[f32], dx: &mut [f32]) {
        let count = dy.len() / self.outputs();
        let dy = MatRef::from_column_major_slice(dy, self.outputs(), count);
        let dx = MatMut::from_column_major_slice_mut(dx, self.inputs(), count);
        matmul(dx, Accum::Replace, self.weight.transpose(), dy, 1.0, Par::Seq);
    }
}

/// Adds the gradient with respect to a layer's weights: dW ← dW + dy·xᵀ.
pub(super) fn add_weight_gradient(gradient: &mut [f32], x: &[f32], dy: &[f32], count: usize) {
    let (inputs, outputs) = (x.len() / count, dy.len() / count);
    let x = MatRef::from_column_major_slice(x, inputs, count);
    let dy = MatRef::from_column_major_slice(dy, outputs, count);
    // Row-major dW is column-major dWᵀ.
    let transposed = MatMut::from_column_major_slice_mut(gradient, inputs, outputs);
    matmul(transposed, Accum::Add, x, dy.transpose(), 1.0, Par::Seq);
}

fn accumulation(add: bool) -> Accum {
    if add {
        Accum::Add
    } else {
        Accum::Replace
    }
}

/// v ← silu(v + b) for each column v.
#[pulp::with_simd(add_bias_and_silu = pulp::Arch::new())]
#[inline(always)]
pub(super) fn add_bias_and_silu_simd<S: pulp::Simd>(_: S, values: &mut [f32], bias: &[f32]) {
    for column in values.chunks_exact_mut(bias.len()) {
        for (value, bias) in column.iter_mut().zip(bias) {
            let x = *value + bias;
            *value = x * sigmoid(x);
        }
    }
}

/// As [`add_bias_and_silu`]; also writes the derivative silu′(v + b) to `slopes`.
#[pulp::with_simd(add_bias_and_silu_with_slopes = pulp::Arch::new())]
#[inline(always)]
pub(super) fn add_bias_and_silu_with_slopes_simd<S: pulp::Simd>(
    _: S,
    values: &mut [f32],
    bias: &[f32],
    slopes: &mut [f32],
) {
    let width = bias.len();
    for (column, slopes) in values.chunks_exact_mut(width).zip(slopes.chunks_exact_mut(width)) {
        for ((value, slope), bias) in column.iter_mut().zip(slopes).zip(bias) {
            let x = *value + bias;
            let sigmoid = sigmoid(x);
            *value = x * sigmoid;
            *slope = sigmoid * (1.0 + x * (1.0 - sigmoid));
        }
    }
}

/// d ← d ⊙ slope; adds the sum of the columns to the gradient with respect to the bias.
#[pulp::with_simd(through_slopes = pulp::Arch::new())]
#[inline(always)]
pub(super) fn through_slopes_simd<S: pulp::Simd>(
    _: S,
    gradient: &mut [f32],
    slopes: &[f32],
    bias_gradient: &mut [f32],
) {
    let width = bias_gradient.len();
    for (column, slopes) in gradient.chunks_exact_mut(width).zip(slopes.chunks_exact(width)) {
        for ((value, slope), sum) in column.iter_mut().zip(slopes).zip(bias_gradient.iter_mut()) {
            *value *= slope;
            *sum += *value;
        }
    }
}

/// Adds the sum of the columns of `gradient` to the gradient with respect to the bias.
pub(super) fn add_bias_gradient(gradient: &[f32], bias_gradient: &mut [f32]) {
    for column in gradient.chunks_exact(bias_gradient.len()) {
        add(bias_gradient, column);
    }
}

/// a ← a + b.
#[inline]
pub(super) fn add(a: &mut [f32], b: &[f32]) {
    a.iter_mut().zip(b).for_each(|(a, b)| *a += b);
}

/// s ← α·tanh(s/α); writes exp(`sign`·s) to `factors`.
#[pulp::with_simd(bounded_scales = pulp::Arch::new())]
#[inline(always)]
pub(super) fn bounded_scales_simd<S: pulp::Simd>(_: S, scales: &mut [f32], factors: &mut [f32], clamp: f32, sign: f32) {
    for (scale, factor) in scales.iter_mut().zip(factors) {
        *scale = clamp * tanh(*scale / clamp);
        *factor = simd::exp(sign * *scale);
    }
}

/// 1 / (1 + exp(−x)).
#[inline(always)]
pub(super) fn sigmoid(x: f32) -> f32 {
    simd::reciprocal(1.0 + simd::exp(-x))
}

/// tanh x = (1 − e^(−2|x|)) / (1 + e^(−2|x|)) with the sign of x; below 0.1 the Taylor series, since the difference would
/// lose digits.
#[inline(always)]
fn tanh(x: f32) -> f32 {
    let square = x * x;
    let series = x * (1.0 - square * (1.0 / 3.0 - square * (2.0 / 15.0 - square * (17.0 / 315.0))));
    let decay = simd::exp(-2.0 * x.abs());
    let quotient = ((1.0 - decay) * simd::reciprocal(1.0 + decay)).copysign(x);
    if square < 0.01 {
        series
    } else {
        quotient
    }
}
