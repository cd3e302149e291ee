//! Structures of masses, springs and beams: their matrices, natural frequencies, mode shapes and derivatives.
//!
//! Two equal masses between two walls, joined by three equal springs, have a closed form:
//!
//! ```text
//!  |──k──[m]──k──[m]──k──|        f₁ = √(k/m)/2π,    f₂ = √(3k/m)/2π
//! ```
//!
//! ```
//! use structures::physics::{natural_frequencies_hz, Mass, Node, Spring, Structure};
//!
//! let (kg, n_per_m) = (2.0, 5_000.0_f64);
//! let masses = vec![Mass::at("m1", 0, kg), Mass::at("m2", 1, kg)];
//! let springs = vec![
//!     Spring::between("k1", Node::Ground, Node::Dof(0), n_per_m),
//!     Spring::between("k2", Node::Dof(0), Node::Dof(1), n_per_m),
//!     Spring::between("k3", Node::Dof(1), Node::Ground, n_per_m),
//! ];
//! let frequencies_hz = natural_frequencies_hz(&Structure::new(masses, springs)?, 2)?;
//!
//! let first_hz = (n_per_m / kg).sqrt() / std::f64::consts::TAU;
//! assert!((frequencies_hz[0] / first_hz - 1.0).abs() < 1e-12);
//! assert!((frequencies_hz[1] / (3.0_f64.sqrt() * first_hz) - 1.0).abs() < 1e-12);
//! # Ok::<(), structures::physics::Error>(())
//! ```

pub mod assembly;
mod banded;
pub mod batched;
mod batched_slopes;
pub mod beam;
pub mod deviation;
mod deviation_of_beam;
mod deviations;
mod direction;
pub mod effect;
pub mod eigen;
mod lanes;
pub mod measured;
pub mod modes;
pub mod shaped;
pub mod shapes;
mod structure;
pub mod tangent;
pub mod tracked;
mod tridiagonal;

pub use modes::{
    frequency_sensitivity, modes, natural_frequencies_hz, natural_frequencies_with, FrequencySensitivity, Modes,
};
pub use structure::{floating_mass, AttachmentPoint, Error, Form, Mass, Node, Spring, Structure};
