//! Reference methods: the same question as the trained flow's, answered without one.
//!
//! - [`sensitivity`]: a deterministic inverse for each measurement;
//! - [`stochastic`]: the population behind a batch, sampled by [`tmcmc`] under a likelihood by the Bhattacharyya
//!   [`distance`];
//! - [`chain`] and [`law`]: stiffnesses of couplings out of frequencies, and how they follow their settings.

pub mod chain;
pub mod distance;
pub mod law;

pub mod sensitivity;
pub mod stochastic;
pub mod tmcmc;
mod weights;
