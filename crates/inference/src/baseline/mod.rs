//! Trained models: the flow of one structure, together with everything needed to use it and to judge its answers.
//!
//! A measurement becomes an [`observation::Observation`], and [`Baseline::infer`] answers with samples of the posterior of
//! the structural parameters:
//!
//! ```text
//!  p(θ | y) ∝ p(y | θ) p(θ),    y: natural frequencies (and mode shapes) with their noise,  p(θ) the prior
//! ```
//!
//! Source: Wang et al. (2025), §3.
//!
//! # Example
//!
//! Three natural frequencies of a chain of three masses, and the stiffnesses that they imply:
//!
//! ```
//! use inference::baseline::library::Library;
//! use inference::baseline::observation::Observation;
//! use structures::quantity::StructureId;
//!
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! let library = Library::open(None)?;
//! let entry = library.get(&StructureId::parse("three-dof")?).ok_or("the structure is shipped")?;
//! let model = entry.baseline.as_ref().ok_or("its model is shipped")?;
//!
//! let theta = [4.0, 5.0, 6.0]; // N/m
//! let measured = Observation::complete(&entry.simulator.frequencies_hz(&theta)?);
//! let samples = model.infer(&[measured], 200, 1)?;
//! let means = samples.means(); // one row per measurement, one column per parameter
//! for (column, stiffness) in theta.iter().enumerate() {
//!     assert!((means[(0, column)] - stiffness).abs() < 0.3, "{means}");
//! }
//! # Ok(())
//! # }
//! ```

mod adapt;
mod admit;
pub mod calibration;
mod certify;
pub mod conditions;
mod density;
mod error;
pub mod extension;
mod fitted;
pub mod identifiability;
mod infer;
mod judge;
pub mod library;
mod load;
mod local;
pub mod manifest;
mod mixture;
mod model;
pub mod nearest;
pub mod observation;
mod project;
mod proposal;
mod propose;
mod real_line;
pub mod recipe;
mod resample;
pub mod rounds;
mod situations;
mod spread;
pub mod start;
pub mod starting;
pub mod train;
mod trained;
mod validation;
pub mod warm;

pub use admit::Admitted;
pub use error::{InferenceError, LoadError};
pub use infer::assessment_seed;
pub use model::Baseline;
