//! Reference methods of model updating, which find parameters from measured frequencies without a trained flow.
//!
//! - [`sensitivity`]: deterministic updating, one measurement at a time;
//! - [`stochastic`]: the posterior of a population, sampled by [`tmcmc`] with a likelihood based on the Bhattacharyya
//!   [`distance`];
//! - [`chain`] and [`law`]: coupling stiffnesses of a chain from its frequencies, and their dependence on a position.

pub mod chain;
pub mod distance;
pub mod law;
pub mod sensitivity;
pub mod stochastic;
pub mod tmcmc;
mod weights;
