//! The flow: a bijection between parameters and a standard normal variable, conditioned on the observation.

use candle_core::{DType, Result, Tensor, D};
use candle_nn::VarBuilder;

use super::architecture::Architecture;
use super::context::ContextNetwork;
use super::coupling::CouplingUnit;
use super::dense::Dense;
use super::permutation::Permutation;

/// A conditional normalizing flow: a context network and N units, each a permutation followed by a conditional coupling
/// unit.
///
/// Source: Wang et al. (2025), §3.2, Eq. 11–13.
pub struct Flow {
    architecture: Architecture,
    context: ContextNetwork,
    units: Vec<(Permutation, CouplingUnit)>,
    dtype: DType,
}

impl Flow {
    /// Builds the flow from the weights of `vb`, which are either drawn (see `flow::weights`) or read from a
    /// checkpoint.
    ///
    /// # Errors
    /// A candle error when a weight is missing or has the wrong shape.
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

    pub(super) fn context(&self) -> &ContextNetwork {
        &self.context
    }

    pub(super) fn units(&self) -> &[(Permutation, CouplingUnit)] {
        &self.units
    }

    /// All dense layers with their names, which are those of the weight file without `.weight` and `.bias`.
    pub(super) fn layers(&self) -> Vec<(String, &Dense)> {
        let context = self.context.layers().into_iter().map(|(name, layer)| (format!("context.{name}"), layer));
        let units = self.units.iter().enumerate().flat_map(|(index, (_, unit))| {
            let nets = [("on_second", Some(unit.on_second())), ("on_first", unit.on_first())];
            nets.into_iter().filter_map(|(name, net)| Some((name, net?))).flat_map(move |(name, net)| {
                [("input", net.input()), ("hidden", net.hidden()), ("output", net.output())]
                    .map(|(layer, dense)| (format!("unit{index}.{name}.{layer}"), dense))
            })
        });
        context.chain(units).collect()
    }

    /// Summary S(y) that conditions the units. `y`: `[n, channels, modes]`, or `[n, fixed_context]`; returns `[n,
    /// context]`.
    ///
    /// # Errors
    /// A candle error when the shape of `y` is wrong.
    pub fn summarise(&self, y: &Tensor) -> Result<Tensor> {
        self.context.forward(y)
    }

    /// Maps x to the latent z. `x`: `[n, d]`; `context`: S(y), `[n, context]`. Returns z `[n, d]` and ln|det ∂z/∂x| `[n]`.
    ///
    /// # Errors
    /// A candle error when the shapes do not fit together.
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

    /// Maps z back to x; the inverse of [`Self::forward`] for the same context. Returns x `[n, d]` and ln|det ∂z/∂x| `[n]`.
    ///
    /// # Errors
    /// A candle error when the shapes do not fit together.
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

    /// Log-density ln q(x | y) of each row, nats. `x`: `[n, d]`; `context`: S(y), `[n, context]`; returns `[n]`.
    ///
    /// ```text
    ///  ln q(x | y) = −½|z|² − (d/2) ln 2π + ln|det ∂z/∂x|
    /// ```
    ///
    /// # Errors
    /// A candle error when the shapes do not fit together.
    pub fn log_prob(&self, x: &Tensor, context: &Tensor) -> Result<Tensor> {
        let (z, log_det) = self.forward(x, context)?;
        log_density(&z, &log_det)
    }
}

/// Log-density of x from its latent z `[n, d]` and ln|det ∂z/∂x| `[n]`; returns `[n]`, nats.
///
/// ```text
///  ln q = ln|det ∂z/∂x| − ½|z|² − (d/2) ln 2π
/// ```
pub(super) fn log_density(z: &Tensor, log_det: &Tensor) -> Result<Tensor> {
    let normaliser = 0.5 * z.dim(1)? as f64 * (2.0 * std::f64::consts::PI).ln();
    (log_det - (z.sqr()?.sum(D::Minus1)? * 0.5)?)? - normaliser
}
