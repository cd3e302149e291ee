//! The parts of a structure before its stiffnesses have values, and the checks that all kinds of structures share.

use std::collections::BTreeMap;

use super::definition::{
    DefinitionProblem, ParameterDefinition, SimulationKind, SpringDefinition, StructureDefinition,
};
use crate::physics::{AttachmentPoint, Form, Mass, Structure};
use crate::quantity::shown;

/// All mistakes found so far.
pub(super) type Problems = Vec<DefinitionProblem>;

/// The parts of a structure without the values of its stiffnesses.
pub(super) struct Layout {
    /// Number of degrees of freedom.
    pub dofs: usize,
    pub attachment_points: Vec<AttachmentPoint>,
    pub masses: Vec<Mass>,
    /// Patterns of the stiffnesses: springs, then beam spans.
    pub forms: Vec<Form>,
}

/// Checks that names are unique and can be used as a column of a table.
pub(super) fn check_names<'a>(section: &str, names: impl Iterator<Item = &'a String>, problems: &mut Problems) {
    let mut seen = BTreeMap::new();
    for (index, name) in names.enumerate() {
        let pointer = format!("/{section}/{index}/name");
        let allowed = |c: char| c.is_ascii_alphanumeric() || "_-.".contains(c);
        if name.is_empty() || name.len() > 64 || !name.chars().all(allowed) {
            let message = format!("the name {} must consist of 1 to 64 letters, digits, '_', '-' or '.'", shown(name));
            problems.push(DefinitionProblem::new(&pointer, message));
        }
        if let Some(first) = seen.insert(name, index) {
            let message = format!("the {section} name {} is used already by /{section}/{first}", shown(name));
            problems.push(DefinitionProblem::new(&pointer, message));
        }
    }
}

/// JSON pointer to an entry of `sets`. A single entry may be written as a table or as a list; only entries of a longer list have an index.
pub(super) fn sets_pointer(parameter: &ParameterDefinition, index: usize, position: usize) -> String {
    let sets = &parameter.sets[position];
    let named = [(sets.beam.is_some(), "beam"), (sets.mass.is_some(), "mass"), (sets.deviation.is_some(), "deviation")];
    let key = named.iter().find(|(named, _)| *named).map_or("spring", |(_, key)| key);
    match parameter.sets.len() {
        1 => format!("/parameter/{index}/sets"),
        _ => format!("/parameter/{index}/sets/{position}/{key}"),
    }
}

/// Checks the distances of masses from the ground.
pub(super) fn check_positions(definition: &StructureDefinition, problems: &mut Problems) {
    let given = definition.masses.iter().any(|mass| mass.at_m.is_some());
    for (index, mass) in definition.masses.iter().enumerate().filter(|_| given) {
        let name = shown(&mass.name);
        let message = match mass.at_m {
            Some(_) if definition.simulation == SimulationKind::Beam => {
                format!("mass {name} of a beam is at a node, which has its place: remove the key at_m")
            }
            None if definition.simulation == SimulationKind::Beam => continue,
            None => format!("mass {name} has no at_m: give it for all masses or for none"),
            Some(at_m) if !(at_m.is_finite() && at_m > 0.0) => {
                format!("mass {name} is {at_m} m from the ground: at_m must be finite and above 0")
            }
            Some(_) => continue,
        };
        problems.push(DefinitionProblem::new(format!("/mass/{index}/at_m"), message));
    }
}

/// A structure of masses on springs with the distances of its masses from the ground, if they are given.
pub(super) fn placed(structure: Structure, definition: &StructureDefinition) -> Structure {
    let positions_m: Option<Vec<f64>> = definition.masses.iter().map(|mass| mass.at_m).collect();
    match positions_m {
        Some(positions_m) => structure.with_positions(positions_m),
        None => structure,
    }
}

/// Checks that the mass of a body is positive.
pub(super) fn check_kg(name: &str, kg: f64, index: usize, problems: &mut Problems) {
    if !(kg.is_finite() && kg > 0.0) {
        let message = format!("mass {} has {kg} kg: it must be finite and above 0", shown(name));
        problems.push(DefinitionProblem::new(format!("/mass/{index}/kg"), message));
    }
}

/// Checks that the two ends of a spring differ and that its nominal stiffness is valid.
pub(super) fn check_spring(spring: &SpringDefinition, index: usize, problems: &mut Problems) {
    if spring.from == spring.to {
        let message =
            format!("spring {} goes from {} to itself: give it two ends", shown(&spring.name), shown(&spring.from));
        problems.push(DefinitionProblem::new(format!("/spring/{index}/to"), message));
    }
    for (key, unit, value) in [("n_per_m", "N/m", spring.n_per_m), ("n_m_per_rad", "N·m/rad", spring.n_m_per_rad)] {
        if let Some(value) = value.filter(|k| !(k.is_finite() && *k >= 0.0)) {
            let name = shown(&spring.name);
            let message =
                format!("spring {name} has a stiffness of {value} {unit}: it must be finite and not negative");
            problems.push(DefinitionProblem::new(format!("/spring/{index}/{key}"), message));
        }
    }
}
