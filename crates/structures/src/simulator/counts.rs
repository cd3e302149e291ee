//! How many parts a structure may have. They are counted before anything else is checked, so that a definition of millions of parts costs
//! no more than reading it.

use super::beam::MOST_ELEMENTS;
use super::definition::{DefinitionProblem, StructureDefinition, TargetDefinition};
use super::layout::Problems;

/// Masses: a dense eigenproblem of this size takes about three seconds.
pub(super) const MOST_MASSES: usize = 2_000;
/// Springs.
const MOST_SPRINGS: usize = 20_000;
/// Nodes of beams: each span has two ends.
const MOST_NODES: usize = 2 * MOST_ELEMENTS;
/// Unknown parameters.
const MOST_PARAMETERS: usize = 100;
/// Covariates.
const MOST_COVARIATES: usize = 100;
/// Effects.
const MOST_EFFECTS: usize = 100;
/// Coefficients of the law of one effect.
const MOST_NUMBERS: usize = 100;
/// Quantiles of the covariate of one effect.
const MOST_SEEN: usize = 1_000;

/// A mistake for each kind of part of which there are too many.
pub(super) fn too_many(definition: &StructureDefinition) -> Problems {
    let d = definition;
    let counts = [
        ("mass", d.masses.len(), MOST_MASSES),
        ("spring", d.springs.len(), MOST_SPRINGS),
        ("node", d.nodes.len(), MOST_NODES),
        // A span has at least one element.
        ("beam", d.beams.len(), MOST_ELEMENTS),
        ("parameter", d.parameters.len(), MOST_PARAMETERS),
        ("covariate", d.covariates.len(), MOST_COVARIATES),
        ("effect", d.effects.len(), MOST_EFFECTS),
    ];
    let mut problems = Problems::new();
    for (section, count, most) in counts.into_iter().filter(|(_, count, most)| count > most) {
        let message = format!("{count} [[{section}]]: a structure has at most {most}");
        problems.push(DefinitionProblem::new(format!("/{section}"), message));
    }
    if !problems.is_empty() {
        return problems;
    }
    let mut limit = |pointer: String, what: &str, count: usize, most: usize| {
        if count > most {
            problems.push(DefinitionProblem::new(pointer, format!("{count} {what}: at most {most} are allowed")));
        }
    };
    let points = d.mode_shapes.as_ref().map_or(0, |shapes| shapes.points.len());
    limit("/mode_shapes/points".to_owned(), "instrumented points", points, MOST_MASSES);
    for (index, parameter) in d.parameters.iter().enumerate() {
        let pointer = format!("/parameter/{index}/sets");
        limit(pointer, "stiffnesses", parameter.sets.len(), MOST_SPRINGS);
    }
    for (index, effect) in d.effects.iter().enumerate() {
        let pointer = |key: &str| format!("/effect/{index}/{key}");
        limit(pointer("numbers"), "coefficients", effect.numbers.len(), MOST_NUMBERS);
        limit(pointer("seen"), "quantiles", effect.seen.len(), MOST_SEEN);
        let named = match &effect.target {
            TargetDefinition::Springs(names) | TargetDefinition::Masses(names) => names.len(),
            TargetDefinition::ModeOrder(order) => order.len(),
            _ => 0,
        };
        limit(pointer("target"), "parts", named, MOST_SPRINGS);
    }
    problems
}

#[cfg(test)]
mod tests {
    use std::fmt::Write as _;
    use std::time::{Duration, Instant};

    use super::*;
    use crate::simulator::Simulator;

    /// The sections of a structure with these parts in one section more than it needs.
    fn with(section: &str, part: &str, count: usize) -> String {
        let mut text = "id = \"many\"\nmodes = 1\n".to_owned();
        for number in 0..count {
            let _ = write!(text, "[[{section}]]\nname = \"n{number}\"\n{part}\n");
        }
        text
    }

    #[test]
    fn too_many_parts_are_counted_and_nothing_else_is_checked() {
        let uniform = "prior = { uniform = [1.0, 2.0] }\nsets = { spring = \"none\" }";
        for (section, part, most) in [
            ("mass", "kg = -1.0", MOST_MASSES),
            ("spring", "from = \"x\"\nto = \"x\"", MOST_SPRINGS),
            ("node", "x_m = 0.0", MOST_NODES),
            ("beam", "from = \"x\"\nto = \"x\"\nmass_kg_per_m = -1.0", MOST_ELEMENTS),
            ("parameter", uniform, MOST_PARAMETERS),
            ("covariate", "kind = \"number\"", MOST_COVARIATES),
            ("effect", "target = { springs = [] }\nlaw = \"constant\"\nnumbers = {}", MOST_EFFECTS),
        ] {
            let error = Simulator::parse_toml(&with(section, part, most + 1)).unwrap_err();
            let only = format!("/{section}: {} [[{section}]]: a structure has at most {most}", most + 1);
            assert_eq!(error.problems.len(), 1, "{section}: {error}");
            assert!(error.to_string().ends_with(&only), "{error}");
            // One fewer is not too many.
            let error = Simulator::parse_toml(&with(section, part, most)).unwrap_err();
            assert!(!error.to_string().contains("a structure has at most"), "{section}: {error}");
        }
    }

    #[test]
    fn a_parameter_that_sets_every_spring_is_checked_in_linear_time() {
        let mut text = "id = \"all\"\nmodes = 1\nmass = [{ name = \"m\", kg = 1.0 }]\nspring = [\n".to_owned();
        let names = || (0..MOST_SPRINGS).map(|number| format!("a-spring-with-a-rather-long-common-name-{number}"));
        for name in names() {
            let _ = writeln!(text, "{{ name = \"{name}\", from = \"ground\", to = \"m\", n_per_m = 1.0 }},");
        }
        text += "]\n[[parameter]]\nname = \"p\"\nscale = true\nprior = { uniform = [0.5, 1.5] }\nsets = [\n";
        for name in names() {
            let _ = writeln!(text, "{{ spring = \"{name}\" }},");
        }
        text += "]\n";
        let started = Instant::now();
        Simulator::parse_toml(&text).unwrap();
        assert!(started.elapsed() < Duration::from_secs(2), "{:?}", started.elapsed());
    }
}
