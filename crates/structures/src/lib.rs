//! Structures and their measured frequencies.
//!
//! [`quantity`], [`parameter`] and [`measurement`] are numbers with units and what is known of them; [`physics`] and [`emulator`] compute
//! natural frequencies, and [`simulator`] does so for a structure file. [`updating`] and [`gsa`] use a simulator: parameters from measured
//! frequencies by reference methods, and Sobol' indices. [`stats`], [`simd`] and [`plot`] serve all crates.

pub mod emulator;
pub mod gsa;
pub mod measurement;
pub mod parameter;
pub mod physics;
pub mod plot;
pub mod quantity;
pub mod simd;
pub mod simulator;
pub mod stats;
pub mod updating;
