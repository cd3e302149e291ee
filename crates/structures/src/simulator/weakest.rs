//! Checks that a structure stands with every stiffness that its priors allow.

use super::definition::{DefinitionProblem, StructureDefinition};
use super::layout::Problems;
use super::model::Binding;
use crate::physics::{floating_mass, Spring};
use crate::quantity::shown;

/// Checks that no value of the prior gives a negative stiffness. Returns the springs, each at its smallest stiffness in the
/// prior.
pub(super) fn check_priors(
    definition: &StructureDefinition,
    springs: &[Spring],
    bindings: &[Binding],
    problems: &mut Problems,
) -> Vec<Spring> {
    let mut weakest: Vec<Spring> = springs.to_vec();
    for binding in bindings {
        let prior = definition.parameters[binding.parameter].prior;
        if prior.mistake().is_some() {
            continue;
        }
        let [lower, upper] = definition.parameters[binding.parameter].bounds();
        // Every law is monotone, so that its smallest value is at a bound of the prior.
        let (at_lower, at_upper) = (binding.stiffness(lower), binding.stiffness(upper));
        let least = at_lower.min(at_upper);
        let name = shown(&springs[binding.spring].name);
        let kind = if binding.spring < definition.springs.len() { "spring" } else { "beam" };
        // Both bounds are checked, because `min` ignores NaN, which 0·exp(large) gives.
        if !(least >= 0.0 && at_lower.is_finite() && at_upper.is_finite()) {
            let unit = if kind == "beam" { "N·m²" } else { "N/m" };
            let message = format!(
                "the {} lets {kind} {name} have a stiffness of {at_lower} to {at_upper} {unit}: it must be finite and not \
                 negative{}",
                prior.words(),
                prior.instead()
            );
            problems.push(DefinitionProblem::new(prior.pointer(binding.parameter), message));
        }
        weakest[binding.spring].n_per_m = least;
    }
    weakest
}

/// Checks that no value of the prior disconnects a mass from the ground.
pub(super) fn check_connected_to_ground(
    definition: &StructureDefinition,
    springs: &[Spring],
    weakest: &[Spring],
    bindings: &[Binding],
    problems: &mut Problems,
) {
    let masses = definition.masses.len();
    if let Some(mass) = floating_mass(masses, springs.iter().filter(|s| s.n_per_m > 0.0)) {
        let name = shown(&definition.masses[mass].name);
        let message = format!(
            "mass {name} is not connected to the ground by springs of positive stiffness: the structure is a mechanism"
        );
        problems.push(DefinitionProblem::new("/spring", message));
    } else if let Some(mass) = floating_mass(masses, weakest.iter().filter(|s| s.n_per_m > 0.0)) {
        let name = shown(&definition.masses[mass].name);
        let to_zero = bindings.iter().find(|b| weakest[b.spring].n_per_m <= 0.0);
        let of_prior = |b: &Binding| definition.parameters[b.parameter].prior.pointer(b.parameter);
        let pointer = to_zero.map_or_else(|| "/parameter".to_owned(), of_prior);
        let message = format!(
            "the prior allows a mechanism: with a stiffness of 0, mass {name} is not connected to the ground; let the prior \
             begin above 0"
        );
        problems.push(DefinitionProblem::new(pointer, message));
    }
}
