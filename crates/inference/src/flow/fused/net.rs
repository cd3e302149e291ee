//! One half of a coupling unit on a tile: forward and backward pass.

use std::ops::Range;

use super::layout::{DenseWeights, Layout};
use crate::flow::kernel::{
    add, add_bias_and_silu_with_slopes, add_bias_gradient, add_weight_gradient, bounded_scales, through_slopes,
};

/// A subnet and its action on the state: the rows `active` are scaled and shifted by functions of the rows `passive` and of
/// the context.
///
/// ```text
///  (s̃, t) = W₃ silu(W₂ silu(W₁ u + b₁) + b₂) + b₃,   u = (passive, context),   s = α·tanh(s̃/α)
///  active ← active ⊙ exp(s) + t
/// ```
pub(super) struct Net {
    input: DenseWeights,
    hidden: DenseWeights,
    output: DenseWeights,
    passive: Range<usize>,
    active: Range<usize>,
    clamp: f32,
}

/// Intermediate results of the forward pass of one tile that the backward pass needs.
pub(super) struct Trace {
    /// u.
    inputs: Vec<f32>,
    /// Both hidden layers, and the derivatives of their activations.
    first: Vec<f32>,
    first_slopes: Vec<f32>,
    second: Vec<f32>,
    second_slopes: Vec<f32>,
    /// s̃ above t, without their biases.
    output: Vec<f32>,
    /// The active rows before the transformation, s, and exp(s).
    before: Vec<f32>,
    scales: Vec<f32>,
    factors: Vec<f32>,
}

/// Gradients of the loss for one tile in the backward pass.
pub(super) struct Gradients<'a> {
    /// With respect to the state, the same number of entries for each column.
    pub state: &'a mut [f32],
    /// With respect to the context.
    pub context: &'a mut [f32],
    /// With respect to all weights.
    pub weights: &'a mut [f32],
    /// 1/M, the weight of a row in the mean loss.
    pub share: f32,
    /// Number of columns.
    pub count: usize,
}

/// Buffers for the gradients inside a net, for one tile; shared by all nets.
pub(super) struct Scratch {
    output: Vec<f32>,
    hidden: Vec<f32>,
    other_hidden: Vec<f32>,
    inputs: Vec<f32>,
}

impl Net {
    pub(super) fn new(layout: &Layout, name: &str, passive: Range<usize>, active: Range<usize>, clamp: f32) -> Self {
        let dense = |layer: &str| layout.dense(&format!("{name}.{layer}"));
        Self { input: dense("input"), hidden: dense("hidden"), output: dense("output"), passive, active, clamp }
    }

    /// A trace for tiles of up to `tile` columns.
    pub(super) fn trace(&self, tile: usize) -> Trace {
        let (width, active) = (self.hidden.outputs, self.active.len());
        let buffer = |rows: usize| vec![0.0; rows * tile];
        Trace {
            inputs: buffer(self.input.inputs),
            first: buffer(width),
            first_slopes: buffer(width),
            second: buffer(width),
            second_slopes: buffer(width),
            output: buffer(2 * active),
            before: buffer(active),
            scales: buffer(active),
            factors: buffer(active),
        }
    }

    /// Buffers that are large enough for each of `nets`.
    pub(super) fn scratch(nets: &[&Net], tile: usize) -> Scratch {
        let largest = |size: fn(&Net) -> usize| vec![0.0; tile * nets.iter().map(|net| size(net)).max().unwrap_or(0)];
        Scratch {
            output: largest(|net| net.output.outputs),
            hidden: largest(|net| net.hidden.outputs),
            other_hidden: largest(|net| net.hidden.outputs),
            inputs: largest(|net| net.input.inputs),
        }
    }

    /// Forward pass: transforms `state` (`count` columns of `dimensions` numbers) and returns Σ s.
    pub(super) fn forward(
        &self,
        weights: &[f32],
        state: &mut [f32],
        context: &[f32],
        count: usize,
        trace: &mut Trace,
    ) -> f64 {
        let dimensions = state.len() / count;
        let (passive, features, active) = (self.passive.len(), context.len() / count, self.active.len());
        let [input, hidden, output] = [&self.input, &self.hidden, &self.output].map(|dense| dense.layer(weights));
        let width = input.outputs();

        let inputs = &mut trace.inputs[..(passive + features) * count];
        let columns = inputs.chunks_exact_mut(passive + features).zip(state.chunks_exact(dimensions));
        for ((own, state), context) in columns.zip(context.chunks_exact(features)) {
            own[..passive].copy_from_slice(&state[self.passive.clone()]);
            own[passive..].copy_from_slice(context);
        }
        let first = &mut trace.first[..width * count];
        input.product(inputs, first, false);
        add_bias_and_silu_with_slopes(first, input.bias, &mut trace.first_slopes[..width * count]);
        let second = &mut trace.second[..width * count];
        hidden.product(first, second, false);
        add_bias_and_silu_with_slopes(second, hidden.bias, &mut trace.second_slopes[..width * count]);
        let scale_and_shift = &mut trace.output[..2 * active * count];
        output.product(second, scale_and_shift, false);

        let scales = &mut trace.scales[..active * count];
        for (own, scales) in scale_and_shift.chunks_exact(2 * active).zip(scales.chunks_exact_mut(active)) {
            for ((scale, own), bias) in scales.iter_mut().zip(own).zip(output.bias) {
                *scale = own + bias;
            }
        }
        let factors = &mut trace.factors[..active * count];
        bounded_scales(scales, factors, self.clamp, 1.0);
        let columns = scale_and_shift.chunks_exact(2 * active).zip(state.chunks_exact_mut(dimensions));
        let kept = trace.before.chunks_exact_mut(active).zip(factors.chunks_exact(active));
        for ((own, state), (before, factors)) in columns.zip(kept) {
            let state = &mut state[self.active.clone()];
            before.copy_from_slice(state);
            for (row, value) in state.iter_mut().enumerate() {
                *value = *value * factors[row] + own[active + row] + output.bias[active + row];
            }
        }
        scales.iter().map(|scale| f64::from(*scale)).sum()
    }

    /// Backward pass: turns the gradient with respect to the state after this net into that with respect to the state
    /// before it, and adds the gradients with respect to the context and the weights.
    pub(super) fn backward(
        &self,
        weights: &[f32],
        gradients: &mut Gradients<'_>,
        trace: &Trace,
        scratch: &mut Scratch,
    ) {
        let Gradients { state, context, weights: gradient, share, count } = gradients;
        let (share, count) = (*share, *count);
        let dimensions = state.len() / count;
        let (passive, features, active) = (self.passive.len(), context.len() / count, self.active.len());
        let [input, hidden, output] = [&self.input, &self.hidden, &self.output].map(|dense| dense.layer(weights));
        let width = input.outputs();

        let of_output = &mut scratch.output[..2 * active * count];
        for (column, own) in of_output.chunks_exact_mut(2 * active).enumerate() {
            let state = &mut state[column * dimensions..][self.active.clone()];
            for row in 0..active {
                let at = column * active + row;
                let scaled = state[row] * trace.factors[at];
                let bounded = trace.scales[at] / self.clamp;
                own[active + row] = state[row];
                own[row] = (scaled * trace.before[at] - share) * (1.0 - bounded * bounded);
                state[row] = scaled;
            }
        }
        let hidden_size = width * count;
        add_bias_gradient(of_output, &mut gradient[self.output.bias.clone()]);
        add_weight_gradient(&mut gradient[self.output.weight.clone()], &trace.second[..hidden_size], of_output, count);
        let of_second = &mut scratch.hidden[..hidden_size];
        output.input_gradient(of_output, of_second);
        through_slopes(of_second, &trace.second_slopes[..hidden_size], &mut gradient[self.hidden.bias.clone()]);
        add_weight_gradient(&mut gradient[self.hidden.weight.clone()], &trace.first[..hidden_size], of_second, count);
        let of_first = &mut scratch.other_hidden[..hidden_size];
        hidden.input_gradient(of_second, of_first);
        through_slopes(of_first, &trace.first_slopes[..hidden_size], &mut gradient[self.input.bias.clone()]);
        let inputs = &trace.inputs[..(passive + features) * count];
        add_weight_gradient(&mut gradient[self.input.weight.clone()], inputs, of_first, count);
        let of_inputs = &mut scratch.inputs[..(passive + features) * count];
        input.input_gradient(of_first, of_inputs);
        let columns = of_inputs.chunks_exact(passive + features).zip(state.chunks_exact_mut(dimensions));
        for ((own, state), context) in columns.zip(context.chunks_exact_mut(features)) {
            add(&mut state[self.passive.clone()], &own[..passive]);
            add(context, &own[passive..]);
        }
    }
}
