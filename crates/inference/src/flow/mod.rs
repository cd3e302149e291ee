//! The conditional invertible neural network: a density of x given y that can be evaluated and sampled.
//!
//! It operates on tensors only. `baseline` maps the parameters to the real line and whitens the observations.
//!
//! ```text
//!  z = f(x; S(y)),    ln q(x | y) = −½|z|² − (d/2) ln 2π + ln|det ∂f/∂x|
//! ```
//!
//! Source: Wang et al. (2025), §3.2, Eq. 11–13 and 20.
//!
//! # Example
//!
//! ```
//! use candle_core::{DType, Device, Tensor};
//! use inference::flow::weights::untrained_flow;
//! use inference::flow::FlowSettings;
//! use structures::stats;
//!
//! # fn main() -> candle_core::Result<()> {
//! // A flow of three parameters, given one number for each of four modes.
//! let settings = FlowSettings { units: 2, width: 16, ..FlowSettings::default() };
//! let architecture = settings.architecture(3, 4, 1, &mut stats::stream(1, "permutations"));
//! let (flow, _) = untrained_flow(&architecture, DType::F64, 1)?;
//!
//! let x = Tensor::new(&[[0.2, -0.7, 1.1]], &Device::Cpu)?; // [n, parameters]
//! let y = Tensor::new(&[[[0.3, -1.2, 0.5, 0.1]]], &Device::Cpu)?; // [n, channels, modes]
//! let context = flow.summarise(&y)?;
//! let (z, log_det) = flow.forward(&x, &context)?;
//! let (back, log_det_back) = flow.inverse(&z, &context)?;
//! assert!((back - x)?.abs()?.max_all()?.to_scalar::<f64>()? < 1e-12);
//! assert!((log_det - log_det_back)?.abs()?.max_all()?.to_scalar::<f64>()? < 1e-12);
//! # Ok(())
//! # }
//! ```

pub mod activation;
pub mod architecture;
pub mod checkpoint;
pub mod context;
pub mod coupling;
pub mod dense;
pub mod fused;
pub mod inherit;
mod kernel;
mod model;
pub mod pairs;
pub mod permutation;
pub mod sampler;
pub mod train;
pub mod weights;

pub use architecture::{Architecture, FlowSettings};
pub use model::Flow;
