//! The reference methods on cases with a known answer.

mod gsa;
mod law;
mod sensitivity;
mod stochastic;
mod tmcmc;
