//! The conditional invertible neural network: a density of x given y that can be evaluated and sampled.
//!
//! It sees tensors only: x is already mapped to the real line, y already whitened (`baseline` does both).
//!
//! ```text
//!  z = f(x; S(y)),    log q(x | y) = −½|z|² − d/2·log 2π + log|det ∂f/∂x|
//! ```
//!
//! Source: Wang et al. (2025), §3.2, Eq. 11–13 and 20.

pub mod activation;
pub mod checkpoint;
pub mod context;
pub mod coupling;
pub mod dense;
pub mod fused;
mod kernel;
pub mod permutation;
pub mod sampler;
pub mod train;
pub mod weights;

use candle_core::{DType, Device, Result, Tensor, D};
use candle_nn::VarBuilder;
use rand::Rng as _;
use rand_distr::StandardNormal;
use serde::{Deserialize, Serialize};

use crate::stats::Stream;
use context::ContextNetwork;
use coupling::CouplingUnit;
use permutation::Permutation;
use sampler::Sampler;

/// Size of a flow; part of the manifest, since it fixes the shapes of all weights.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Architecture {
    /// Number of parameters d.
    pub parameters: usize,
    /// Number of modes m: the length of the observation vector.
    pub modes: usize,
    /// Numbers given for each mode (only the whitened log-frequency so far).
    pub channels: usize,
    /// Number of conditional coupling units N.
    pub units: usize,
    /// Width of the hidden layers of every subnet.
    pub width: usize,
    /// Channels of the convolutions of the context network.
    pub context_channels: usize,
    /// Features the context network gives besides the observation itself.
    pub context_features: usize,
    /// Numbers that the units are conditioned on directly, where the context network is none: y is then `[n, fixed_context]` and
    /// S(y) = y. 0 for a context network.
    #[serde(default, skip_serializing_if = "is_zero")]
    pub fixed_context: usize,
    /// Bound α of each log-scale, in tenths (an integer, so that architectures compare exactly).
    pub clamp_tenths: u32,
    /// The fixed permutation in front of each unit.
    pub permutations: Vec<Vec<u32>>,
}

#[allow(clippy::trivially_copy_pass_by_ref, reason = "serde hands over a reference")]
fn is_zero(value: &usize) -> bool {
    *value == 0
}

/// Size of a flow before the structure is known.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct FlowSettings {
    /// Number of conditional coupling units N.
    pub units: usize,
    /// Width of the hidden layers of every subnet.
    pub width: usize,
    /// Channels of the convolutions of the context network.
    pub context_channels: usize,
    /// Features the context network gives besides the observation itself.
    pub context_features: usize,
    /// Bound α of each log-scale, in tenths.
    pub clamp_tenths: u32,
}

impl Default for FlowSettings {
    fn default() -> Self {
        Self { units: 4, width: 64, context_channels: 16, context_features: 32, clamp_tenths: 30 }
    }
}

impl FlowSettings {
    /// The architecture for `parameters` unknowns and `modes` modes, with permutations drawn from `stream`.
    pub fn architecture(&self, parameters: usize, modes: usize, channels: usize, stream: &mut Stream) -> Architecture {
        let permutations = (0..self.units).map(|_| permutation::random_order(parameters, stream)).collect();
        Architecture {
            parameters,
            modes,
            channels,
            units: self.units,
            width: self.width,
            context_channels: self.context_channels,
            context_features: self.context_features,
            fixed_context: 0,
            clamp_tenths: self.clamp_tenths,
            permutations,
        }
    }
}

/// A conditional flow: context network and N units, each a permutation and a conditional coupling unit.
pub struct Flow {
    architecture: Architecture,
    context: ContextNetwork,
    units: Vec<(Permutation, CouplingUnit)>,
    dtype: DType,
}

impl Flow {
    /// Builds the flow on the weights of `vb`: drawn by [`weights::SeededWeights`] or read from a checkpoint.
    ///
    /// # Errors
    /// A candle error when a weight is missing or of another shape.
    pub fn new(architecture: &Architecture, vb: &VarBuilder<'_>) -> Result<Self> {
        let context = ContextNetwork::new(architecture, &vb.pp("context"))?;
        let build = |(index, order): (usize, &Vec<u32>)| {
            let permutation = Permutation::new(order, vb.device())?;
            let unit = CouplingUnit::new(architecture, context.width(), &vb.pp(format!("unit{index}")))?;
            Ok((permutation, unit))
        };
        let units = architecture.permutations.iter().enumerate().map(build).collect::<Result<Vec<_>>>()?;
        Ok(Self { architecture: architecture.clone(), context, units, dtype: vb.dtype() })
    }

    /// Sizes of this flow.
    pub fn architecture(&self) -> &Architecture {
        &self.architecture
    }

    /// Precision of the weights.
    pub fn dtype(&self) -> DType {
        self.dtype
    }

    /// Summary S(y) the units are conditioned on. `y`: `[n, channels, modes]`, or `[n, fixed_context]`; returns `[n, context]`.
    ///
    /// # Errors
    /// A candle error when the shape of `y` is another.
    pub fn summarise(&self, y: &Tensor) -> Result<Tensor> {
        self.context.forward(y)
    }

    /// x to z. `x`: `[n, d]`, `context`: `[n, context]`. Returns z `[n, d]` and log|det ∂z/∂x| `[n]`.
    ///
    /// # Errors
    /// A candle error when shapes do not fit.
    pub fn forward(&self, x: &Tensor, context: &Tensor) -> Result<(Tensor, Tensor)> {
        let mut z = x.clone();
        let mut log_det = Tensor::zeros(x.dim(0)?, self.dtype, x.device())?;
        for (permutation, unit) in &self.units {
            let (next, unit_log_det) = unit.forward(&permutation.forward(&z)?, context)?;
            z = next;
            log_det = (log_det + unit_log_det)?;
        }
        Ok((z, log_det))
    }

    /// z to x, the inverse of [`Self::forward`] for the same context; with log|det ∂z/∂x| `[n]`.
    ///
    /// # Errors
    /// A candle error when shapes do not fit.
    pub fn inverse(&self, z: &Tensor, context: &Tensor) -> Result<(Tensor, Tensor)> {
        let mut x = z.clone();
        let mut log_det = Tensor::zeros(z.dim(0)?, self.dtype, z.device())?;
        for (permutation, unit) in self.units.iter().rev() {
            let (next, unit_log_det) = unit.inverse(&x, context)?;
            x = permutation.inverse(&next)?;
            log_det = (log_det + unit_log_det)?;
        }
        Ok((x, log_det))
    }

    /// Log-density log q(x | y) of each row, nats. `x`: `[n, d]`, `context`: S(y) `[n, context]`; returns `[n]`.
    ///
    /// # Errors
    /// A candle error when shapes do not fit.
    pub fn log_prob(&self, x: &Tensor, context: &Tensor) -> Result<Tensor> {
        let (z, log_det) = self.forward(x, context)?;
        log_density(&z, &log_det)
    }

    /// `draws` samples of x for each row of `context`, S(y) `[n, context]`, in the order of the rows: `[n·draws, d]`; and the
    /// log-density of each, nats, `[n·draws]`.
    ///
    /// Reads all weights first; a [`Sampler`] that is kept draws the same without.
    ///
    /// # Errors
    /// A candle error when the shape of `context` is another.
    pub fn sample(&self, context: &Tensor, draws: usize, stream: &mut Stream) -> Result<(Tensor, Tensor)> {
        if let Some(sampler) = Sampler::new(self)? {
            return sampler.sample(context, draws, stream);
        }
        let (rows, features) = context.dims2()?;
        let z = standard_normal(rows * draws, self.architecture.parameters, stream).to_dtype(self.dtype)?;
        let repeated = context.unsqueeze(1)?.expand((rows, draws, features))?;
        let (x, log_det) = self.inverse(&z, &repeated.reshape((rows * draws, features))?)?;
        Ok((x, log_density(&z, &log_det)?))
    }
}

/// ```text
///  log q = log|det ∂z/∂x| − ½|z|² − (d/2) log 2π
/// ```
fn log_density(z: &Tensor, log_det: &Tensor) -> Result<Tensor> {
    let normaliser = 0.5 * z.dim(1)? as f64 * (2.0 * std::f64::consts::PI).ln();
    (log_det - (z.sqr()?.sum(D::Minus1)? * 0.5)?)? - normaliser
}

/// Standard normal draws `[rows, columns]` from our own stream, f64 (candle's generator cannot be seeded).
fn standard_normal(rows: usize, columns: usize, stream: &mut Stream) -> Tensor {
    let draws: Vec<f64> = (0..rows * columns).map(|_| stream.sample(StandardNormal)).collect();
    Tensor::from_vec(draws, (rows, columns), &Device::Cpu).expect("as many draws as the shape has places")
}
