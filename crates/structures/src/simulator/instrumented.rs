//! Instrumented points of a structure, at which its mode shapes are measured.

use std::collections::BTreeSet;

use super::definition::{DefinitionProblem, StructureDefinition};
use super::effect::{typical_sizes, SimulationEffect};
use super::layout::Problems;
use super::model::SimulationModel;
use super::sizes::nominal;
use crate::measurement::shape::InstrumentedPoints;
use crate::physics::effect::Target;
use crate::physics::shaped::respond_shaped;
use crate::physics::shapes::modes_to_pair;
use crate::quantity::shown;

/// Smallest number of instrumented points: a shape at a single point contains no information.
const FEWEST_POINTS: usize = 2;

/// Largest noise of a shape: with more, shapes of neighbouring modes cannot be distinguished.
const MOST_NOISE: f64 = 0.5;

/// The instrumented points of a checked structure.
#[derive(Debug, Clone, PartialEq)]
pub struct Instrumented {
    /// Degree of freedom of each point.
    pub(super) dofs: Vec<usize>,
    /// Standard deviation of each component of a measured shape of unit norm.
    pub(super) std: f64,
    /// Their names, and the mode shapes of the nominal structure under the mean sizes of its effects.
    pub(super) points: InstrumentedPoints,
}

/// Checks the instrumented points of a definition; `None` if it has none or has mistakes.
pub(super) fn check(
    definition: &StructureDefinition,
    model: &SimulationModel,
    effects: &[SimulationEffect],
    problems: &mut Problems,
) -> Option<Instrumented> {
    let given = definition.mode_shapes.as_ref()?;
    let mut wrong = |key: &str, message: String| {
        problems.push(DefinitionProblem::new(format!("/mode_shapes{key}"), message));
    };
    let SimulationModel::Matrices(matrices) = model else {
        wrong(
            "",
            "a table of runs contains no mode shapes: remove mode_shapes, or describe the structure by masses or beams"
                .to_owned(),
        );
        return None;
    };
    let structure = &matrices.structure;
    let noise = given.noise;
    if !(noise.is_finite() && noise > 0.0 && noise < MOST_NOISE) {
        wrong("/noise", format!("a noise of {noise} is not valid: it is a share of the shape's root mean square, above 0 and below {MOST_NOISE}"));
    }
    if given.points.len() < FEWEST_POINTS {
        let count = given.points.len();
        wrong("/points", format!("{count} points: a shape needs at least {FEWEST_POINTS}"));
    }
    let mut seen = BTreeSet::new();
    let mut dofs = Vec::new();
    for (index, name) in given.points.iter().enumerate() {
        let key = format!("/points/{index}");
        match structure.attachment_points().iter().find(|point| point.name == *name) {
            None => wrong(&key, format!("{} is not the name of a mass or of a node that can deflect", shown(name))),
            Some(_) if !seen.insert(name) => {
                wrong(&key, format!("{} is listed twice: list each point once", shown(name)));
            }
            Some(point) => dofs.push(point.dof),
        }
    }
    if dofs.len() != given.points.len() || !problems.is_empty() {
        return None;
    }
    let own = matrices.sizes.iter().map(|binding| &binding.target);
    let targets: Vec<Target> = own.chain(effects.iter().map(|effect| &effect.target)).cloned().collect();
    let typical = [nominal(definition, matrices), typical_sizes(effects)].concat();
    // A mode above those expected may be listed in place of one of them.
    let modes = modes_to_pair(definition.modes, structure.dofs());
    let nominal = match respond_shaped(structure, modes, (&targets, &typical), &dofs, (&[], 0)) {
        Ok(shaped) => shaped.shapes,
        Err(error) => {
            problems.push(DefinitionProblem::new("/mode_shapes", format!("at the nominal stiffnesses: {error}")));
            return None;
        }
    };
    let nominal = nominal.column_iter().map(|shape| shape.iter().copied().collect()).collect();
    let points = InstrumentedPoints { names: given.points.clone(), nominal };
    Some(Instrumented { std: noise / (dofs.len() as f64).sqrt(), dofs, points })
}
