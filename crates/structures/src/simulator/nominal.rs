//! The parameters at which a structure has its nominal stiffnesses.

use super::definition::Law;
use super::model::{Binding, StiffnessForm};
use super::simulate::Simulator;

impl Simulator {
    /// Parameters at the nominal stiffnesses and masses, `[d]`, in the units of the parameters: the value at which the first stiffness or mass
    /// that a parameter sets has the value that the structure file gives it. A parameter that sets neither, as in a table, or whose law never
    /// reaches the nominal stiffness, is at the median of its prior.
    pub fn nominal_parameters(&self) -> Vec<f64> {
        let one = |(column, parameter): (usize, &crate::parameter::Parameter)| {
            let binding = self.bindings().iter().find(|b| b.parameter == column);
            let nominal = binding.and_then(|b| at_stiffness(b, self.structure()?.springs()[b.spring].n_per_m));
            let mass = self.size_bindings().iter().find(|b| b.parameter == column && !b.target.masses().is_empty());
            let of_mass = mass.map(|b| -b.at_zero / b.per_unit);
            nominal.or(of_mass).unwrap_or_else(|| parameter.at_level(0.5))
        };
        self.space().iter().enumerate().map(one).collect()
    }
}

/// The parameter at which a binding gives the stiffness k, N/m: 100 k/k_nominal for a factor, p = ln((k − c)/a)/b for the exponential
/// law.
fn at_stiffness(binding: &Binding, n_per_m: f64) -> Option<f64> {
    let p = match binding.form {
        StiffnessForm::Itself => n_per_m,
        StiffnessForm::PercentOf(nominal) => 100.0 * n_per_m / nominal,
        StiffnessForm::Law(Law::Exponential(e)) => ((n_per_m - e.c) / e.a).ln() / e.b,
    };
    p.is_finite().then_some(p)
}
