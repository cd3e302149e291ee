//! What parameters set: which stiffnesses, masses and deviations, alone or in groups.

use std::collections::BTreeSet;

use super::definition::Law;
use super::model::{Binding, StiffnessForm};
use super::simulate::Simulator;
use crate::parameter::Parameter;
use crate::physics::effect::Target;

/// The stiffness of a spring that a parameter sets through a law.
#[derive(Debug, Clone, PartialEq)]
pub struct DerivedStiffness {
    /// `spring:` followed by the name of the spring.
    pub name: String,
    /// Column of the parameter.
    pub parameter: usize,
    /// The law.
    pub law: Law,
}

impl DerivedStiffness {
    /// Stiffness k(p) at a parameter value, N/m.
    pub fn value(&self, p: f64) -> f64 {
        self.law.value(p)
    }
}

impl Simulator {
    /// The springs that a parameter sets through a law. Their stiffness is monitored in addition to the parameter.
    pub fn derived_stiffnesses(&self) -> Vec<DerivedStiffness> {
        let derived = |binding: &Binding| {
            let StiffnessForm::Law(law) = binding.form else { return None };
            let name = format!("spring:{}", self.structure()?.springs()[binding.spring].name);
            Some(DerivedStiffness { name, parameter: binding.parameter, law })
        };
        self.bindings().iter().filter_map(derived).collect()
    }

    /// Relative change of stiffness per unit of a parameter, d ln k/dp, for the first stiffness that the parameter sets.
    ///
    /// A parameter that sets no stiffness is treated as the stiffness itself, 1/p. If its prior includes 0, this is undefined,
    /// and one over the width of the prior is returned instead.
    pub fn stiffness_share(&self, column: usize, p: f64) -> f64 {
        let binding = self.bindings().iter().find(|b| b.parameter == column);
        let parameter = &self.space().as_slice()[column];
        let of_itself = if parameter.has_share() { 1.0 / p } else { 1.0 / (parameter.upper - parameter.lower) };
        binding.map_or(of_itself, |b| b.slope(p) / b.stiffness(p))
    }

    /// Column of the parameter that sets the stiffness of a spring and of no other; `None` if there is none.
    pub fn own_parameter(&self, spring: usize) -> Option<usize> {
        let parameter = self.bindings().iter().find(|b| b.spring == spring)?.parameter;
        let alone = self.bindings().iter().filter(|b| b.parameter == parameter).count() == 1;
        alone.then_some(parameter)
    }

    /// Whether a parameter is a stiffness or stands for one, as in a table, and not a mass or a deviation.
    pub fn is_stiffness(&self, column: usize) -> bool {
        self.size_bindings().iter().all(|b| b.parameter != column)
    }

    /// Whether a parameter is the size of a deviation.
    pub fn sets_deviation(&self) -> bool {
        self.size_bindings().iter().any(|b| matches!(b.target, Target::Deviation(_)))
    }

    /// Column of the parameter that sets exactly these masses, or this deviation, and nothing else; `None` if there is none, and for another
    /// target.
    pub fn own_parameter_of(&self, target: &Target) -> Option<usize> {
        let own = |column: usize| self.size_bindings().iter().filter(move |b| b.parameter == column);
        let alone = |column: usize| self.bindings().iter().all(|b| b.parameter != column);
        let sets = |column: usize| match target {
            Target::Deviation(deviation) => {
                own(column).all(|b| matches!(&b.target, Target::Deviation(set) if set.kind == deviation.kind))
            }
            Target::Masses(masses) => {
                let set: BTreeSet<usize> = own(column).flat_map(|b| b.target.masses().iter().copied()).collect();
                set == masses.iter().copied().collect()
            }
            _ => false,
        };
        let mut columns = self.size_bindings().iter().map(|b| b.parameter);
        columns.find(|column| alone(*column) && sets(*column))
    }

    /// Column of the parameter that is the size of a deviation and is never 0; `None` if there is none, and for another target.
    pub fn parameter_of_deviation(&self, target: &Target) -> Option<usize> {
        let own = self.own_parameter_of(target).filter(|_| matches!(target, Target::Deviation(_)));
        own.filter(|column| self.space().as_slice()[*column].lower > 0.0)
    }

    /// Name of each parameter that sets several springs together, with the indices of these springs.
    pub fn spring_groups(&self) -> Vec<(String, Vec<usize>)> {
        let group = |(column, parameter): (usize, &Parameter)| {
            let bindings = self.bindings().iter().filter(|b| b.parameter == column);
            let springs: Vec<usize> = bindings.map(|b| b.spring).collect();
            (springs.len() > 1).then(|| (parameter.name.clone(), springs))
        };
        self.space().iter().enumerate().filter_map(group).collect()
    }

    /// Name of each parameter that sets several masses together, with the indices of these masses.
    pub fn mass_groups(&self) -> Vec<(String, Vec<usize>)> {
        let group = |(column, parameter): (usize, &Parameter)| {
            let sizes = self.size_bindings().iter().filter(|b| b.parameter == column);
            let masses: Vec<usize> = sizes.flat_map(|b| b.target.masses().iter().copied()).collect();
            (masses.len() > 1).then(|| (parameter.name.clone(), masses))
        };
        self.space().iter().enumerate().filter_map(group).collect()
    }

    /// The springs that no parameter sets, if they are several but not all; none otherwise.
    pub fn unset_springs(&self) -> Vec<usize> {
        let springs = self.structure().map_or(0, |structure| structure.springs().len());
        let mut set = vec![false; springs];
        self.bindings().iter().for_each(|binding| set[binding.spring] = true);
        let unset: Vec<usize> = (0..springs).filter(|spring| !set[*spring]).collect();
        if unset.len() > 1 && unset.len() < springs {
            unset
        } else {
            Vec::new()
        }
    }
}
