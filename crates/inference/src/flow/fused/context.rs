//! The context network on a tile: forward and backward pass.

use super::layout::{DenseWeights, Layout};
use crate::flow::architecture::Architecture;
use crate::flow::context::KERNEL;
use crate::flow::kernel::{add, add_bias_and_silu_with_slopes, add_weight_gradient, through_slopes};

/// The context network: two convolutions and a dense layer, and the shortcut; or the shortcut alone.
pub(super) struct Context {
    layers: Option<[DenseWeights; 3]>,
    modes: usize,
    features: usize,
    shortcut: usize,
}

/// Intermediate results of the forward pass of one tile that the backward pass needs, and buffers for its gradients.
pub(super) struct Trace {
    /// Input of each layer; that of the convolutions is unfolded into windows.
    inputs: [Vec<f32>; 3],
    /// Derivative of each layer's activation.
    slopes: [Vec<f32>; 3],
    /// Output of each layer.
    outputs: [Vec<f32>; 3],
    /// Gradients with respect to the input and the output of the current layer.
    of_input: Vec<f32>,
    of_output: Vec<f32>,
}

impl Context {
    pub(super) fn new(layout: &Layout, architecture: &Architecture, shortcut: usize) -> Self {
        let dense = |name| layout.dense(&format!("context.{name}"));
        let layers = (architecture.fixed_context == 0).then(|| ["conv1", "conv2", "features"].map(dense));
        let features = if layers.is_some() { architecture.context_features } else { 0 };
        Self { layers, modes: architecture.modes, features, shortcut }
    }

    /// Whether there is a network besides the shortcut.
    pub(super) fn has_network(&self) -> bool {
        self.layers.is_some()
    }

    /// Number of entries of S(y).
    pub(super) fn width(&self) -> usize {
        self.features + self.shortcut
    }

    /// Number of columns per observation in a layer.
    fn columns(&self, layer: usize) -> usize {
        if layer < 2 {
            self.modes
        } else {
            1
        }
    }

    /// A trace for tiles of up to `tile` observations.
    pub(super) fn trace(&self, tile: usize) -> Trace {
        let sized = |size: fn(&DenseWeights) -> usize| {
            let buffer = |layer: usize, dense: &DenseWeights| vec![0.0; size(dense) * self.columns(layer) * tile];
            self.layers.as_ref().map_or_else(Default::default, |all| [0, 1, 2].map(|layer| buffer(layer, &all[layer])))
        };
        let (inputs, outputs) = (sized(|dense| dense.inputs), sized(|dense| dense.outputs));
        let largest = |buffers: &[Vec<f32>; 3]| vec![0.0; buffers.iter().map(Vec::len).max().unwrap_or(0)];
        Trace { slopes: outputs.clone(), of_input: largest(&inputs), of_output: largest(&outputs), inputs, outputs }
    }

    /// Writes S(y) of `count` observations to `context`. `observation(i)` returns the inputs of row i, mode by mode, and
    /// its shortcut.
    pub(super) fn forward<'a>(
        &self,
        weights: &[f32],
        observation: impl Fn(usize) -> (&'a [f32], &'a [f32]),
        count: usize,
        trace: &mut Trace,
        context: &mut [f32],
    ) {
        let Some(layers) = &self.layers else {
            for (row, own) in context.chunks_exact_mut(self.shortcut).enumerate() {
                own.copy_from_slice(observation(row).1);
            }
            return;
        };
        let window = layers[0].inputs * self.modes;
        for row in 0..count {
            unfold(observation(row).0, self.modes, &mut trace.inputs[0][row * window..(row + 1) * window]);
        }
        for layer in 0..3 {
            let dense = &layers[layer];
            let layer_weights = dense.layer(weights);
            let columns = self.columns(layer) * count;
            let output = &mut trace.outputs[layer][..dense.outputs * columns];
            layer_weights.product(&trace.inputs[layer][..dense.inputs * columns], output, false);
            add_bias_and_silu_with_slopes(
                output,
                layer_weights.bias,
                &mut trace.slopes[layer][..dense.outputs * columns],
            );
            match layer {
                0 => {
                    let next = layers[1].inputs * self.modes;
                    let windows = trace.inputs[1].chunks_exact_mut(next);
                    for (output, windows) in output.chunks_exact(dense.outputs * self.modes).zip(windows) {
                        unfold(output, self.modes, windows);
                    }
                }
                // The features of all modes of an observation are contiguous already.
                1 => trace.inputs[2][..output.len()].copy_from_slice(output),
                _ => {
                    let columns = context.chunks_exact_mut(self.width()).zip(output.chunks_exact(self.features));
                    for (row, (own, features)) in columns.enumerate() {
                        own[..self.features].copy_from_slice(features);
                        own[self.features..].copy_from_slice(observation(row).1);
                    }
                }
            }
        }
    }

    /// Adds the gradient with respect to the weights to `gradient`, given that with respect to S(y).
    pub(super) fn backward(
        &self,
        weights: &[f32],
        context_gradient: &[f32],
        gradient: &mut [f32],
        count: usize,
        trace: &mut Trace,
    ) {
        let Some(layers) = &self.layers else { return };
        let of_features = trace.of_output.chunks_exact_mut(self.features);
        for (own, column) in of_features.zip(context_gradient.chunks_exact(self.width())) {
            own.copy_from_slice(&column[..self.features]);
        }
        for layer in [2, 1, 0] {
            let dense = &layers[layer];
            let columns = self.columns(layer) * count;
            let of_output = &mut trace.of_output[..dense.outputs * columns];
            let slopes = &trace.slopes[layer][..dense.outputs * columns];
            through_slopes(of_output, slopes, &mut gradient[dense.bias.clone()]);
            let input = &trace.inputs[layer][..dense.inputs * columns];
            add_weight_gradient(&mut gradient[dense.weight.clone()], input, of_output, columns);
            if layer == 0 {
                return;
            }
            let of_input = &mut trace.of_input[..dense.inputs * columns];
            dense.layer(weights).input_gradient(of_output, of_input);
            let of_previous = &mut trace.of_output[..layers[layer - 1].outputs * self.modes * count];
            if layer == 2 {
                of_previous.copy_from_slice(of_input);
            } else {
                let windows = of_input.chunks_exact(dense.inputs * self.modes);
                for (own, windows) in of_previous.chunks_exact_mut(dense.inputs / KERNEL * self.modes).zip(windows) {
                    fold(windows, self.modes, own);
                }
            }
        }
    }
}

/// Unfolds an observation into windows: column k becomes (y_{k−1}, y_k, y_{k+1}), with zeros beyond the ends.
fn unfold(values: &[f32], modes: usize, windows: &mut [f32]) {
    let channels = values.len() / modes;
    for (mode, window) in windows.chunks_exact_mut(KERNEL * channels).enumerate() {
        for (offset, part) in window.chunks_exact_mut(channels).enumerate() {
            match (mode + offset).checked_sub(KERNEL / 2).filter(|from| *from < modes) {
                Some(from) => part.copy_from_slice(&values[from * channels..(from + 1) * channels]),
                None => part.fill(0.0),
            }
        }
    }
}

/// The adjoint of [`unfold`]: adds up the gradients with respect to the windows.
fn fold(windows: &[f32], modes: usize, values: &mut [f32]) {
    let channels = values.len() / modes;
    values.fill(0.0);
    for (mode, window) in windows.chunks_exact(KERNEL * channels).enumerate() {
        for (offset, part) in window.chunks_exact(channels).enumerate() {
            if let Some(to) = (mode + offset).checked_sub(KERNEL / 2).filter(|to| *to < modes) {
                add(&mut values[to * channels..(to + 1) * channels], part);
            }
        }
    }
}
