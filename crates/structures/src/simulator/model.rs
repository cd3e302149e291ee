//! What computes the frequencies of a simulation, and how parameters set its stiffnesses.

use nalgebra::DMatrix;

use super::definition::Law;
use super::table::Table;
use crate::physics::{self, Structure};

/// What computes the frequencies.
#[derive(Debug, Clone)]
pub enum SimulationModel {
    /// Matrices K and M whose stiffnesses are set by parameters.
    Matrices {
        /// The structure at its nominal stiffnesses.
        structure: Structure,
        /// Which parameter sets which stiffness.
        bindings: Vec<Binding>,
    },
    /// An emulator of finite-element runs.
    Table(Table),
}

impl SimulationModel {
    /// Number of modes that the simulation has.
    pub(super) fn available_modes(&self) -> usize {
        match self {
            Self::Matrices { structure, .. } => structure.dofs(),
            Self::Table(table) => table.emulator().modes(),
        }
    }
}

/// A stiffness that is set by a parameter.
#[derive(Debug, Clone, PartialEq)]
pub struct Binding {
    /// Column of the parameter.
    pub parameter: usize,
    /// Index of the spring or beam span.
    pub spring: usize,
    /// Stiffness as a function of the parameter.
    pub form: StiffnessForm,
}

/// Stiffness k as a function of the parameter p that sets it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum StiffnessForm {
    /// k = p: the parameter is the stiffness itself.
    Itself,
    /// k = k_nominal·p/100: the parameter is per cent of this nominal stiffness, which is in the unit of the spring or beam.
    PercentOf(f64),
    /// k(p) by a law of the structure file.
    Law(Law),
}

impl Binding {
    /// Stiffness k(p) at a parameter value, N/m.
    pub fn stiffness(&self, p: f64) -> f64 {
        match self.form {
            StiffnessForm::Itself => p,
            StiffnessForm::PercentOf(nominal) => 0.01 * nominal * p,
            StiffnessForm::Law(law) => law.value(p),
        }
    }

    /// Derivative dk/dp at a parameter value, N/m per unit of the parameter.
    pub fn slope(&self, p: f64) -> f64 {
        match self.form {
            StiffnessForm::Itself => 1.0,
            StiffnessForm::PercentOf(nominal) => 0.01 * nominal,
            StiffnessForm::Law(law) => law.slope(p),
        }
    }
}

/// The structure with the stiffnesses that the parameters `theta` set.
pub(super) fn structure_at(
    structure: &Structure,
    bindings: &[Binding],
    theta: &[f64],
) -> Result<Structure, physics::Error> {
    structure.with_stiffness(&changes(bindings, theta))
}

/// Index and stiffness of each spring that a parameter sets.
pub(super) fn changes(bindings: &[Binding], theta: &[f64]) -> Vec<(usize, f64)> {
    bindings.iter().map(|b| (b.spring, b.stiffness(theta[b.parameter]))).collect()
}

/// Chain rule: derivatives with respect to parameters, `[m, d]`, from those with respect to stiffnesses, `[m, springs]`.
pub(super) fn chained(by_spring: &DMatrix<f64>, bindings: &[Binding], theta: &[f64]) -> DMatrix<f64> {
    let mut by_parameter = DMatrix::zeros(by_spring.nrows(), theta.len());
    for binding in bindings {
        let slope = binding.slope(theta[binding.parameter]);
        for mode in 0..by_spring.nrows() {
            by_parameter[(mode, binding.parameter)] += by_spring[(mode, binding.spring)] * slope;
        }
    }
    by_parameter
}
