//! Fully connected layers.

use candle_core::{Result, Tensor};
use candle_nn::{init, Init, VarBuilder};

/// A fully connected layer, y = x·Wᵀ + 1·bᵀ.
///
/// The bias is added as a product with a column of ones instead of by broadcasting: its gradient is then a matrix product,
/// whereas candle's sum over the rows of a broadcast took a fifth of a training step.
pub struct Dense {
    weight: Tensor,
    bias: Tensor,
}

impl Dense {
    /// A layer with candle's default initialisation: normal weights (Kaiming) and biases uniform within ±1/√inputs.
    ///
    /// # Errors
    /// A candle error when a weight is missing or has the wrong shape.
    pub fn new(inputs: usize, outputs: usize, vb: &VarBuilder<'_>) -> Result<Self> {
        let bound = 1.0 / (inputs as f64).sqrt();
        let uniform = Init::Uniform { lo: -bound, up: bound };
        Self::with_init(inputs, outputs, init::DEFAULT_KAIMING_NORMAL, uniform, vb)
    }

    /// A layer whose weights and biases are initialised to 0.
    ///
    /// # Errors
    /// As [`Self::new`].
    pub fn zero(inputs: usize, outputs: usize, vb: &VarBuilder<'_>) -> Result<Self> {
        Self::with_init(inputs, outputs, Init::Const(0.0), Init::Const(0.0), vb)
    }

    fn with_init(inputs: usize, outputs: usize, weight: Init, bias: Init, vb: &VarBuilder<'_>) -> Result<Self> {
        let weight = vb.get_with_hints((outputs, inputs), "weight", weight)?;
        let bias = vb.get_with_hints(outputs, "bias", bias)?;
        Ok(Self { weight, bias })
    }

    /// W, `[outputs, inputs]`.
    pub fn weight(&self) -> &Tensor {
        &self.weight
    }

    /// Number of outputs.
    pub fn outputs(&self) -> usize {
        self.bias.elem_count()
    }

    /// b, `[outputs]`.
    pub fn bias(&self) -> &Tensor {
        &self.bias
    }

    /// Applies the layer. `x`: `[n, inputs]`; returns `[n, outputs]`.
    ///
    /// # Errors
    /// A candle error when the shape of `x` is wrong.
    pub fn forward(&self, x: &Tensor) -> Result<Tensor> {
        let ones = Tensor::ones((x.dim(0)?, 1), x.dtype(), x.device())?;
        x.matmul(&self.weight.t()?)? + ones.matmul(&self.bias.unsqueeze(0)?)?
    }
}
