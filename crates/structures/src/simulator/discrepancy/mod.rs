//! A discrepancy that was learned from data: what measured frequencies deviate by from the simulation as a function of settings and
//! covariates, where no effect explains the deviation.
//!
//! ```text
//!  ln f_i = ln M_i(θ, c) + g_i(u) + ε,    g_i a Gaussian process for each mode i, with its posterior given the data
//! ```
//!
//! - [`definition`]: how a structure file states it; [`process`]: mean and variance of g at inputs u;
//! - [`input`]: the inputs u of a measurement; `check`: checks of a structure file;
//! - [`measured`]: measurements corrected by it, and its simulation.
//!
//! The module `learned` of the diagnosis learns it. Every answer about a structure with a learned discrepancy uses corrected measurements:
//! the mean of g is subtracted from ln f, and its variance is added to that of the noise. The trained model of the structure does
//! not know about it.

pub(super) mod check;
pub mod definition;
pub mod input;
pub mod measured;
pub mod process;
