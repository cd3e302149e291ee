//! Simulations of structures: parameters in, natural frequencies and mode shapes out.
//!
//! [`Simulator`] offers three kinds of simulation behind one interface: rigid bodies on springs and Euler–Bernoulli beams, both
//! by their matrices K and M, and a table of the user's own finite-element runs, by an emulator.
//!
//! ```
//! use structures::simulator::definition::StructureDefinition;
//! use structures::simulator::Simulator;
//!
//! let file = r#"
//!     id = "mast"
//!     modes = 1
//!     [[mass]]
//!     name = "head"
//!     kg = 10.0
//!     [[spring]]
//!     name = "shaft"
//!     from = "ground"
//!     to = "head"
//!     [[parameter]]
//!     name = "k"
//!     prior = { uniform = [20000.0, 60000.0] }
//!     sets = { spring = "shaft" }
//! "#;
//! let simulator = Simulator::new(StructureDefinition::parse_toml(file)?)?;
//!
//! let frequencies_hz = simulator.frequencies_hz(&[40_000.0])?;
//! let closed_form_hz = (40_000.0_f64 / 10.0).sqrt() / std::f64::consts::TAU;
//! assert!((frequencies_hz[0] / closed_form_hz - 1.0).abs() < 1e-12);
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```

mod batched;
mod beam;
mod changed;
mod check;
mod counts;
mod covariates;
pub mod definition;
pub mod discrepancy;
pub mod drawing;
pub mod effect;
mod effect_definition;
mod expectation;
mod instrumented;
pub mod law;
mod layout;
mod mesh;
mod model;
mod moved;
mod nominal;
mod parse;
pub mod plausibility;
pub mod population;
pub mod prior;
pub mod rehearsal;
mod respond;
mod sets;
pub mod settings;
pub mod shape_comparison;
mod shapes;
mod simulate;
mod sizes;
pub mod table;
mod training;
mod weakest;

pub use model::{Binding, Matrices, SimulationModel, SizeBinding, StiffnessForm};
pub use respond::Response;
pub use sets::DerivedStiffness;
pub use shapes::{Linearised, ShapeResponse};
pub use simulate::{Error, Simulator};
pub use training::TrainingSet;
