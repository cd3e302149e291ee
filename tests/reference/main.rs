//! The reference methods on cases with a known answer.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking, in its helpers too")]

mod gsa;
mod law;
mod sensitivity;
mod stochastic;
mod tmcmc;
