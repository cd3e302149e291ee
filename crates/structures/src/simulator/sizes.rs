//! Checks the masses and the deviations that parameters set.

use std::collections::BTreeSet;
use std::sync::Arc;

use super::definition::{DefinitionProblem, ParameterDefinition, Sets, StructureDefinition};
use super::effect::cannot_deviate;
use super::layout::{sets_pointer, Problems};
use super::model::{Matrices, SizeBinding};
use crate::parameter::DamageDirection;
use crate::physics::deviation::{Deviation, DeviationKind};
use crate::physics::effect::{respond, Target, LEAST_FACTOR};
use crate::physics::Structure;
use crate::quantity::{shown, significant};

/// Which parameter sets which mass or deviation of a structure whose other sections have no mistakes. `nominal_hz`: frequencies of the measured
/// modes at the nominal stiffnesses, Hz, `[m]`.
pub(super) fn check(
    definition: &StructureDefinition,
    structure: &Structure,
    nominal_hz: &[f64],
) -> Result<Vec<SizeBinding>, Problems> {
    let mut problems = Problems::new();
    let mut found: Vec<SizeBinding> = Vec::new();
    let mut seen = BTreeSet::new();
    for (index, parameter) in definition.parameters.iter().enumerate() {
        for (position, sets) in parameter.sets.iter().enumerate().filter(|(_, sets)| sets.is_size()) {
            let mut wrong = |message: String| {
                problems.push(DefinitionProblem::new(sets_pointer(parameter, index, position), message));
            };
            if seen.insert(sets.in_words()) {
                match binding((structure, nominal_hz), parameter, sets) {
                    Ok((target, per_unit, at_zero)) => {
                        found.push(SizeBinding { parameter: index, target, per_unit, at_zero });
                    }
                    Err(message) => wrong(message),
                }
            } else {
                wrong(format!("{} is set already: a parameter sets it once, and no other does", sets.in_words()));
            }
        }
        check_damage(parameter, index, &mut problems);
    }
    let possible = |binding: &&SizeBinding| {
        let parameter = &definition.parameters[binding.parameter];
        check_prior(parameter, binding).map_err(|message| (binding.parameter, message))
    };
    for (index, message) in found.iter().map(|binding| possible(&binding)).filter_map(Result::err) {
        problems.push(DefinitionProblem::new(definition.parameters[index].prior.pointer(index), message));
    }
    problems.dedup_by(|a, b| a == b);
    if problems.is_empty() {
        Ok(found)
    } else {
        Err(problems)
    }
}

/// Target, change of its size per unit of the parameter, and size where the parameter is 0.
fn binding(
    (structure, nominal_hz): (&Structure, &[f64]),
    parameter: &ParameterDefinition,
    sets: &Sets,
) -> Result<(Target, f64, f64), String> {
    if sets.law.is_some() {
        return Err(format!(
            "a law gives a stiffness, and parameter {} sets {}: remove law",
            shown(&parameter.name),
            sets.in_words()
        ));
    }
    if let Some(kind) = sets.deviation {
        if parameter.scale {
            let name = shown(&parameter.name);
            return Err(format!(
                "parameter {name} is the size of a deviation, which has no nominal value: remove scale"
            ));
        }
        let deviation = match kind {
            DeviationKind::Calibration => Deviation::of_instrument(nominal_hz),
            _ => Deviation::new(structure, kind),
        };
        let deviation = deviation.ok_or_else(|| cannot_deviate(kind))?;
        return Ok((Target::Deviation(Arc::new(deviation)), 1.0, 0.0));
    }
    let name = sets.mass.as_deref().unwrap_or_default();
    let mass = structure.masses().iter().position(|mass| mass.name == name);
    let mass = mass.ok_or_else(|| format!("there is no mass {}", shown(name)))?;
    // m = m₀ (1 + g): per cent of nominal, or kg.
    let per_unit = if parameter.scale { 0.01 } else { 1.0 / structure.masses()[mass].kg };
    Ok((Target::Masses(vec![mass]), per_unit, -1.0))
}

/// A mass, or a deviation that is no restraint and no tension, that decreases is no damage.
fn check_damage(parameter: &ParameterDefinition, index: usize, problems: &mut Problems) {
    let kept = |sets: &Sets| !sets.is_size() || sets.deviation.is_some_and(DeviationKind::may_be_lost);
    let Some(sets) = parameter.sets.iter().find(|sets| !kept(sets)) else { return };
    if parameter.damage == DamageDirection::Decrease {
        let message = format!(
            "parameter {} sets {}, whose decrease is no damage: give damage = \"none\" if it is only estimated, or \"increase\"",
            shown(&parameter.name),
            sets.in_words()
        );
        problems.push(DefinitionProblem::new(format!("/parameter/{index}/damage"), message));
    }
}

/// Checks that every size in the prior of its parameter is possible.
fn check_prior(parameter: &ParameterDefinition, binding: &SizeBinding) -> Result<(), String> {
    let (least, greatest, what) = match &binding.target {
        Target::Deviation(deviation) => {
            let (least, greatest) = deviation.kind.possible_sizes();
            (least.max(LEAST_FACTOR - 1.0), greatest, format!("a size of the deviation {}", deviation.kind.name()))
        }
        _ => (LEAST_FACTOR - 1.0, f64::INFINITY, "a relative change of the mass".to_owned()),
    };
    for bound in parameter.bounds() {
        let size = binding.size(bound);
        if !(least..=greatest).contains(&size) {
            let limits =
                if greatest.is_finite() { format!("from {least} to {greatest}") } else { format!("at least {least}") };
            return Err(format!(
                "the {} lets {what} be {}: it must be {limits}{}",
                parameter.prior.words(),
                significant(size),
                parameter.prior.instead()
            ));
        }
    }
    Ok(())
}

/// The nominal frequencies under the nominal values of what [`check`] found, Hz, `[m]`; `nominal_hz` are those without. They exist where all
/// stiffnesses are least and all sizes least or greatest, too.
pub(super) fn nominal_frequencies_hz(
    definition: &StructureDefinition,
    matrices: &Matrices,
    nominal_hz: Vec<f64>,
) -> Result<Vec<f64>, Problems> {
    if matrices.sizes.is_empty() {
        return Ok(nominal_hz);
    }
    let targets: Vec<Target> = matrices.sizes.iter().map(|binding| binding.target.clone()).collect();
    let at = |structure: &Structure, sizes: &[f64], where_: &str| {
        let found = respond(structure, definition.modes, &targets, sizes).map(|response| response.frequencies_hz);
        found.map_err(|error| {
            let index = matrices.sizes[0].parameter;
            let pointer = definition.parameters[index].prior.pointer(index);
            vec![DefinitionProblem::new(
                pointer,
                format!(
                    "{where_}: {error}; let the prior of {} be narrower",
                    shown(&definition.parameters[index].name)
                ),
            )]
        })
    };
    let least: Vec<(usize, f64)> = matrices
        .bindings
        .iter()
        .map(|b| {
            let [low, high] = definition.parameters[b.parameter].bounds();
            (b.spring, b.stiffness(low).min(b.stiffness(high)))
        })
        .collect();
    let weakest = matrices
        .structure
        .with_stiffness(&least)
        .map_err(|error| vec![DefinitionProblem::new("/spring", error.to_string())])?;
    for (end, name) in ["least", "greatest"].into_iter().enumerate() {
        let size = |binding: &SizeBinding| binding.size(definition.parameters[binding.parameter].bounds()[end]);
        let sizes: Vec<f64> = matrices.sizes.iter().map(size).collect();
        at(
            &weakest,
            &sizes,
            &format!("with the least stiffnesses and the {name} values of masses and deviations in the priors"),
        )?;
    }
    at(&matrices.structure, &nominal(definition, matrices), "at the nominal values")
}

/// Nominal sizes of what parameters set: masses as the file states them, deviations at the medians of the priors.
pub(super) fn nominal(definition: &StructureDefinition, matrices: &Matrices) -> Vec<f64> {
    let size = |binding: &SizeBinding| match &binding.target {
        Target::Deviation(_) => binding.size(definition.parameters[binding.parameter].median()),
        _ => 0.0,
    };
    matrices.sizes.iter().map(size).collect()
}
