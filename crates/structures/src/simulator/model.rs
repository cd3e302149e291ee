//! What computes the frequencies of a simulation, and what parameters set in it.

use nalgebra::DMatrix;

use super::definition::Law;
use super::table::Table;
use crate::physics::effect::Target;
use crate::physics::{self, Structure};

/// What computes the frequencies.
#[derive(Debug, Clone)]
pub enum SimulationModel {
    /// Matrices K and M that parameters set.
    Matrices(Matrices),
    /// An emulator of finite-element runs.
    Table(Table),
}

impl SimulationModel {
    /// Number of modes that the simulation has.
    pub(super) fn available_modes(&self) -> usize {
        match self {
            Self::Matrices(matrices) => matrices.structure.dofs(),
            Self::Table(table) => table.emulator().modes(),
        }
    }
}

/// A structure and what parameters set in it.
#[derive(Debug, Clone)]
pub struct Matrices {
    /// The structure at its nominal stiffnesses and masses.
    pub structure: Structure,
    /// Which parameter sets which stiffness.
    pub bindings: Vec<Binding>,
    /// Which parameter sets which mass or deviation.
    pub sizes: Vec<SizeBinding>,
}

/// The size g of a change of masses, or of a deviation that is in no single part, that is set by a parameter p.
///
/// ```text
///  g = per_unit p + at_zero
/// ```
#[derive(Debug, Clone, PartialEq)]
pub struct SizeBinding {
    /// Column of the parameter.
    pub parameter: usize,
    /// What changes, with one size.
    pub target: Target,
    /// Change of g per unit of the parameter.
    pub per_unit: f64,
    /// g where the parameter is 0.
    pub at_zero: f64,
}

impl SizeBinding {
    /// The size at a parameter value.
    pub fn size(&self, p: f64) -> f64 {
        self.per_unit * p + self.at_zero
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

impl Matrices {
    /// The structure with the stiffnesses that the parameters `theta` set.
    pub(super) fn at(&self, theta: &[f64]) -> Result<Structure, physics::Error> {
        self.structure.with_stiffness(&self.changes(theta))
    }

    /// Index and stiffness of each spring that a parameter sets.
    pub(super) fn changes(&self, theta: &[f64]) -> Vec<(usize, f64)> {
        self.bindings.iter().map(|b| (b.spring, b.stiffness(theta[b.parameter]))).collect()
    }

    /// The changes that the parameters `theta` set beside the stiffnesses, followed by `further` ones: targets and their sizes.
    pub(super) fn with_sizes(&self, theta: &[f64], further: (&[Target], &[f64])) -> (Vec<Target>, Vec<f64>) {
        let own = self.sizes.iter().map(|binding| binding.target.clone());
        let of_own = self.sizes.iter().map(|binding| binding.size(theta[binding.parameter]));
        (own.chain(further.0.iter().cloned()).collect(), of_own.chain(further.1.iter().copied()).collect())
    }

    /// Chain rule: derivatives with respect to parameters, `[m, d]`, from those with respect to stiffnesses, `[m, springs]`, and to the sizes
    /// of [`Self::with_sizes`], `[m, own + further]`.
    pub(super) fn by_parameter(&self, by_spring: &DMatrix<f64>, by_size: &DMatrix<f64>, theta: &[f64]) -> DMatrix<f64> {
        let mut by_parameter = DMatrix::zeros(by_spring.nrows(), theta.len());
        for binding in &self.bindings {
            let slope = binding.slope(theta[binding.parameter]);
            by_parameter.column_mut(binding.parameter).axpy(slope, &by_spring.column(binding.spring), 1.0);
        }
        for (binding, by_size) in self.sizes.iter().zip(by_size.column_iter()) {
            by_parameter.column_mut(binding.parameter).axpy(binding.per_unit, &by_size, 1.0);
        }
        by_parameter
    }

    /// The columns of derivatives with respect to the sizes of [`Self::with_sizes`] that belong to the further ones.
    pub(super) fn further(&self, by_size: &DMatrix<f64>) -> DMatrix<f64> {
        let own = self.sizes.len();
        by_size.columns(own, by_size.ncols() - own).into_owned()
    }
}
