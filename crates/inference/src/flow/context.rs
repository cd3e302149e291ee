//! The context network: a 1-D convolutional network over the observation.

use candle_core::{Result, Tensor, D};
use candle_nn::VarBuilder;

use super::activation::silu;
use super::architecture::Architecture;
use super::dense::Dense;

/// Width of the convolution kernels: each mode is combined with its two neighbours.
pub(super) const KERNEL: usize = 3;

/// Two 1-D convolutions along the modes and a dense layer. The observation itself is passed on in addition to the features.
///
/// ```text
///  h = silu(conv₂(silu(conv₁(y)))),    S(y) = [ silu(W·flatten(h) + b), flatten(y) ]
/// ```
///
/// Source: Wang et al. (2025), §3.2.2 and §5.2 (a 1-D CNN as conditional network). The shortcut of y is not in the
/// paper: without it, the features would have to represent the narrow posteriors of noise-free data.
///
/// With `architecture.fixed_context` there is no network, and S(y) = y.
pub struct ContextNetwork {
    layers: Option<Layers>,
    width: usize,
}

struct Layers {
    first: Convolution,
    second: Convolution,
    features: Dense,
}

impl ContextNetwork {
    /// Builds the network for observations `[n, channels, modes]` from the weights of `vb`.
    ///
    /// # Errors
    /// A candle error when a weight is missing or has the wrong shape.
    pub fn new(architecture: &Architecture, vb: &VarBuilder<'_>) -> Result<Self> {
        if architecture.fixed_context > 0 {
            return Ok(Self { layers: None, width: architecture.fixed_context });
        }
        let (modes, channels) = (architecture.modes, architecture.context_channels);
        let layers = Layers {
            first: Convolution::new(architecture.channels, channels, &vb.pp("conv1"))?,
            second: Convolution::new(channels, channels, &vb.pp("conv2"))?,
            features: Dense::new(modes * channels, architecture.context_features, &vb.pp("features"))?,
        };
        let width = architecture.context_features + modes * architecture.channels;
        Ok(Self { layers: Some(layers), width })
    }

    /// Number of entries of S(y).
    pub fn width(&self) -> usize {
        self.width
    }

    /// Number of entries of [`Self::shortcut`].
    pub fn shortcut_width(&self) -> usize {
        self.width - self.layers.as_ref().map_or(0, |layers| layers.features.outputs())
    }

    /// The dense layers with their names; empty without a network.
    pub(super) fn layers(&self) -> Vec<(&'static str, &Dense)> {
        self.layers.as_ref().map_or_else(Vec::new, |layers| {
            vec![("conv1", &layers.first.weights), ("conv2", &layers.second.weights), ("features", &layers.features)]
        })
    }

    /// Computes S(y) `[n, width]`. `y`: `[n, channels, modes]`, or `[n, fixed_context]` without a network.
    ///
    /// # Errors
    /// A candle error when the shape of `y` is wrong.
    pub fn forward(&self, y: &Tensor) -> Result<Tensor> {
        let Some(layers) = &self.layers else { return Ok(y.clone()) };
        let by_mode = y.transpose(1, 2)?.contiguous()?;
        let hidden = silu(&layers.first.forward(&by_mode)?)?;
        let hidden = silu(&layers.second.forward(&hidden)?)?;
        let features = silu(&layers.features.forward(&hidden.flatten_from(1)?)?)?;
        Tensor::cat(&[features, self.shortcut(y)?], 1)
    }

    /// The flattened observation, `[n, shortcut]`, which is passed on in addition to the features and does not depend on
    /// weights. Without a network it is all of S(y).
    ///
    /// # Errors
    /// A candle error when the shape of `y` is wrong.
    pub fn shortcut(&self, y: &Tensor) -> Result<Tensor> {
        y.flatten_from(1)?.contiguous()
    }
}

/// 1-D convolution with zero padding, as one matrix product over the unfolded input.
///
/// candle's `conv1d` copies to another layout and back in each call. For a handful of modes the unfolding below is faster,
/// forward and backward, and gives the same numbers.
struct Convolution {
    weights: Dense,
}

impl Convolution {
    fn new(inputs: usize, outputs: usize, vb: &VarBuilder<'_>) -> Result<Self> {
        Ok(Self { weights: Dense::new(KERNEL * inputs, outputs, vb)? })
    }

    /// `[n, modes, inputs]` to `[n, modes, outputs]`.
    fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let modes = x.dim(1)?;
        let padded = x.pad_with_zeros(1, KERNEL / 2, KERNEL / 2)?;
        let windows = (0..KERNEL).map(|k| padded.narrow(1, k, modes)).collect::<Result<Vec<_>>>()?;
        let unfolded = Tensor::cat(&windows, D::Minus1)?;
        let (rows, _, columns) = unfolded.dims3()?;
        self.weights.forward(&unfolded.reshape((rows * modes, columns))?)?.reshape((rows, modes, ()))
    }
}
