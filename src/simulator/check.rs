//! From a definition to checked parts: every mistake that is no mistake of form.

use std::collections::BTreeMap;

use super::definition::{
    DefinitionProblem, Law, MeasurementNoise, ParameterDefinition, Prior, SpringDefinition, StructureDefinition,
};
use super::effect::{self, Effect};
use super::Binding;
use crate::measurement::Covariate;
use crate::parameter::{Parameter, ParameterSpace};
use crate::physics::{floating_mass, natural_frequencies_hz, Mass, Node, Spring, Structure};
use crate::quantity::{shown, StructureId};

/// Most degrees of freedom: a dense eigenproblem of this size takes some three seconds.
const MOST_MASSES: usize = 2_000;

/// The checked parts of a structure.
#[derive(Debug, Clone)]
pub(super) struct Checked {
    pub id: StructureId,
    pub structure: Structure,
    pub nominal_frequencies_hz: Vec<f64>,
    pub space: ParameterSpace,
    pub bindings: Vec<Binding>,
    pub covariates: Vec<Covariate>,
    pub effects: Vec<Effect>,
}

type Problems = Vec<DefinitionProblem>;

/// Checks a definition; all mistakes of a stage are reported together, a later stage needs the earlier ones.
pub(super) fn check(definition: &StructureDefinition) -> Result<Checked, Problems> {
    let mut problems = Problems::new();
    let id =
        StructureId::parse(&definition.id).map_err(|e| problems.push(DefinitionProblem::new("/id", e.to_string())));
    check_head(definition, &mut problems);
    let masses = check_masses(definition, &mut problems);
    let ends = check_springs(definition, &masses, &mut problems);
    check_covariates(definition, &mut problems);
    let bindings = check_parameters(definition, &mut problems);
    let (Ok(id), true) = (id, problems.is_empty()) else { return Err(problems) };

    let space = ParameterSpace::new(definition.parameters.iter().map(parameter).collect());
    let springs = springs(definition, &ends, &bindings, &mut problems);
    check_priors(definition, &springs, &bindings, &mut problems);
    if !problems.is_empty() {
        return Err(problems);
    }
    let masses = definition.masses.iter().map(|m| Mass { name: m.name.clone(), kg: m.kg }).collect();
    let structure =
        Structure::new(masses, springs).map_err(|e| vec![DefinitionProblem::new("/spring", e.to_string())])?;
    // Tied to the ground is not enough: values far apart can drown the lowest frequency in rounding.
    let nominal_frequencies_hz = natural_frequencies_hz(&structure, definition.modes)
        .map_err(|e| vec![DefinitionProblem::new("/spring", format!("at the nominal stiffnesses: {e}"))])?;
    let covariates: Vec<Covariate> =
        definition.covariates.iter().map(|c| Covariate { name: c.name.clone(), kind: c.kind }).collect();
    check_names("effect", definition.effects.iter().map(|e| &e.name), &mut problems);
    let effects = effect::check(definition, &structure, &covariates, &mut problems);
    if !problems.is_empty() {
        return Err(problems);
    }
    Ok(Checked { id, structure, nominal_frequencies_hz, space, bindings, covariates, effects })
}

fn check_head(definition: &StructureDefinition, problems: &mut Problems) {
    let masses = definition.masses.len();
    if masses == 0 || masses > MOST_MASSES {
        let message = format!("{masses} masses: a structure has 1 to {MOST_MASSES} [[mass]]");
        problems.push(DefinitionProblem::new("/mass", message));
    } else if definition.modes == 0 || definition.modes > masses {
        let message = format!("{} modes: a structure of {masses} masses has 1 to {masses}", definition.modes);
        problems.push(DefinitionProblem::new("/modes", message));
    }
    let (key, noise) = match definition.measurement_noise {
        MeasurementNoise::Relative(share) => ("relative", share),
        MeasurementNoise::Hz(std_hz) => ("hz", std_hz),
    };
    if !(noise.is_finite() && noise >= 0.0) || (key == "relative" && noise >= 0.5) {
        let message =
            format!("{noise} is no standard deviation: it must be finite, not negative, and relative below 0.5");
        problems.push(DefinitionProblem::new(format!("/measurement_noise/{key}"), message));
    }
    if definition.parameters.is_empty() {
        problems.push(DefinitionProblem::new("/parameter", "no [[parameter]]: at least one unknown is needed"));
    }
}

/// Names must be unique and usable as a column of a table.
fn check_names<'a>(section: &str, names: impl Iterator<Item = &'a String>, problems: &mut Problems) {
    let mut seen = BTreeMap::new();
    for (index, name) in names.enumerate() {
        let place = format!("/{section}/{index}/name");
        let allowed = |c: char| c.is_ascii_alphanumeric() || "_-.".contains(c);
        if name.is_empty() || name.len() > 64 || !name.chars().all(allowed) {
            let message = format!("the name {} must be 1 to 64 of letters, digits, '_', '-', '.'", shown(name));
            problems.push(DefinitionProblem::new(&place, message));
        }
        if let Some(first) = seen.insert(name, index) {
            let message = format!("the {section} name {} is used already by /{section}/{first}", shown(name));
            problems.push(DefinitionProblem::new(&place, message));
        }
    }
}

fn check_masses<'a>(definition: &'a StructureDefinition, problems: &mut Problems) -> BTreeMap<&'a str, usize> {
    check_names("mass", definition.masses.iter().map(|m| &m.name), problems);
    let mut by_name = BTreeMap::new();
    for (index, mass) in definition.masses.iter().enumerate() {
        if mass.name == "ground" {
            let message = "no mass can be called \"ground\": the name stands for the fixed end of springs";
            problems.push(DefinitionProblem::new(format!("/mass/{index}/name"), message));
        }
        if !(mass.kg.is_finite() && mass.kg > 0.0) {
            let message = format!("mass {} has {} kg: it must be finite and above 0", shown(&mass.name), mass.kg);
            problems.push(DefinitionProblem::new(format!("/mass/{index}/kg"), message));
        }
        by_name.entry(mass.name.as_str()).or_insert(index);
    }
    by_name
}

fn check_springs(
    definition: &StructureDefinition,
    masses: &BTreeMap<&str, usize>,
    problems: &mut Problems,
) -> Vec<(Node, Node)> {
    check_names("spring", definition.springs.iter().map(|s| &s.name), problems);
    let mut ends = Vec::new();
    for (index, spring) in definition.springs.iter().enumerate() {
        let mut node = |key: &str, name: &str| match masses.get(name) {
            _ if name == "ground" => Node::Ground,
            Some(mass) => Node::Mass(*mass),
            None => {
                let message = format!(
                    "spring {} goes to {}, which is no mass and not \"ground\"",
                    shown(&spring.name),
                    shown(name)
                );
                problems.push(DefinitionProblem::new(format!("/spring/{index}/{key}"), message));
                Node::Ground
            }
        };
        ends.push((node("from", &spring.from), node("to", &spring.to)));
        if spring.from == spring.to {
            let message = format!("spring {} goes from {} to itself", shown(&spring.name), shown(&spring.from));
            problems.push(DefinitionProblem::new(format!("/spring/{index}/to"), message));
        }
        if let Some(n_per_m) = spring.n_per_m.filter(|k| !(k.is_finite() && *k >= 0.0)) {
            let name = shown(&spring.name);
            let message = format!("spring {name} has a stiffness of {n_per_m} N/m: it must be finite and not negative");
            problems.push(DefinitionProblem::new(format!("/spring/{index}/n_per_m"), message));
        }
    }
    ends
}

fn check_covariates(definition: &StructureDefinition, problems: &mut Problems) {
    check_names("covariate", definition.covariates.iter().map(|c| &c.name), problems);
    for (index, covariate) in definition.covariates.iter().enumerate() {
        let name = covariate.name.to_ascii_lowercase();
        let digits = |text: &str| !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
        let frequency = name.strip_prefix("std_").unwrap_or(&name);
        let frequency = frequency.strip_prefix('f').and_then(|n| n.strip_suffix("_hz")).is_some_and(digits);
        if frequency || name == "measured_at" || name == "source" || name.starts_with("set_") {
            let message = format!("the covariate {} has the name of a column that is taken", shown(&covariate.name));
            problems.push(DefinitionProblem::new(format!("/covariate/{index}/name"), message));
        }
    }
}

fn check_parameters(definition: &StructureDefinition, problems: &mut Problems) -> Vec<Binding> {
    check_names("parameter", definition.parameters.iter().map(|p| &p.name), problems);
    let mut bindings: Vec<Binding> = Vec::new();
    for (index, parameter) in definition.parameters.iter().enumerate() {
        let Prior::Uniform([lower, upper]) = parameter.prior;
        if !(lower.is_finite() && upper.is_finite() && lower < upper) {
            let message = format!("uniform = [{lower}, {upper}]: both must be finite, the first below the second");
            problems.push(DefinitionProblem::new(format!("/parameter/{index}/prior/uniform"), message));
        }
        if parameter.sets.is_empty() {
            let message = format!("parameter {} sets nothing: name a spring", shown(&parameter.name));
            problems.push(DefinitionProblem::new(format!("/parameter/{index}/sets"), message));
        }
        for (place, sets) in parameter.sets.iter().enumerate() {
            // A single one may stand in the file as a table or as a list; a list of several has an index.
            let pointer = match parameter.sets.len() {
                1 => format!("/parameter/{index}/sets"),
                _ => format!("/parameter/{index}/sets/{place}/spring"),
            };
            let Some(spring) = definition.springs.iter().position(|s| s.name == sets.spring) else {
                let message = format!("there is no spring {}", shown(&sets.spring));
                problems.push(DefinitionProblem::new(pointer, message));
                continue;
            };
            if let Some(other) = bindings.iter().find(|b| b.spring == spring) {
                let other = shown(&definition.parameters[other.parameter].name);
                let message = format!("spring {} is set by parameter {other} already", shown(&sets.spring));
                problems.push(DefinitionProblem::new(pointer, message));
                continue;
            }
            if let Some(Law::Exponential(e)) = sets.law {
                if !(e.a.is_finite() && e.b.is_finite() && e.c.is_finite()) {
                    problems.push(DefinitionProblem::new(pointer, "the constants of a law must be finite"));
                    continue;
                }
            }
            bindings.push(Binding { parameter: index, spring, law: sets.law });
        }
    }
    bindings
}

fn parameter(definition: &ParameterDefinition) -> Parameter {
    let Prior::Uniform([lower, upper]) = definition.prior;
    let plain = definition.sets.iter().all(|sets| sets.law.is_none());
    let unit = definition.unit.clone().unwrap_or_else(|| if plain { "N/m" } else { "–" }.to_owned());
    Parameter { name: definition.name.clone(), unit, lower, upper, damage: definition.damage }
}

/// The springs at their nominal stiffness.
fn springs(
    definition: &StructureDefinition,
    ends: &[(Node, Node)],
    bindings: &[Binding],
    problems: &mut Problems,
) -> Vec<Spring> {
    let nominal = |(index, spring): (usize, &SpringDefinition)| {
        let binding = bindings.iter().find(|b| b.spring == index);
        let middle = binding.map(|b| {
            let Prior::Uniform([lower, upper]) = definition.parameters[b.parameter].prior;
            b.stiffness(f64::midpoint(lower, upper))
        });
        let n_per_m = spring.n_per_m.or(middle).unwrap_or_else(|| {
            let message = format!("spring {} has no n_per_m and no parameter sets it", shown(&spring.name));
            problems.push(DefinitionProblem::new(format!("/spring/{index}"), message));
            0.0
        });
        let (from, to) = ends[index];
        Spring { name: spring.name.clone(), from, to, n_per_m }
    };
    definition.springs.iter().enumerate().map(nominal).collect()
}

/// No value of the prior may give a negative stiffness or cut a mass off from the ground.
fn check_priors(definition: &StructureDefinition, springs: &[Spring], bindings: &[Binding], problems: &mut Problems) {
    let mut weakest: Vec<Spring> = springs.to_vec();
    for binding in bindings {
        let Prior::Uniform([lower, upper]) = definition.parameters[binding.parameter].prior;
        // Every law is monotone: its least value lies at an end of the prior.
        let (at_lower, at_upper) = (binding.stiffness(lower), binding.stiffness(upper));
        let least = at_lower.min(at_upper);
        let pointer = format!("/parameter/{}/prior/uniform", binding.parameter);
        let name = shown(&springs[binding.spring].name);
        // Each end by itself: `min` and `max` pass over NaN, which 0·exp(large) gives.
        if !(least >= 0.0 && at_lower.is_finite() && at_upper.is_finite()) {
            let message = format!("the prior [{lower}, {upper}] lets spring {name} have a stiffness of {at_lower} to {at_upper} N/m: it must be finite and not negative");
            problems.push(DefinitionProblem::new(pointer, message));
        }
        weakest[binding.spring].n_per_m = least;
    }
    if !problems.is_empty() {
        return;
    }
    let masses = definition.masses.len();
    if let Some(mass) = floating_mass(masses, springs.iter().filter(|s| s.n_per_m > 0.0)) {
        let name = shown(&definition.masses[mass].name);
        let message = format!(
            "mass {name} is not tied to the ground by springs of positive stiffness: the structure is a mechanism"
        );
        problems.push(DefinitionProblem::new("/spring", message));
    } else if let Some(mass) = floating_mass(masses, weakest.iter().filter(|s| s.n_per_m > 0.0)) {
        let name = shown(&definition.masses[mass].name);
        let to_zero = bindings.iter().find(|b| weakest[b.spring].n_per_m <= 0.0);
        let pointer = to_zero.map_or("/parameter".to_owned(), |b| format!("/parameter/{}/prior/uniform", b.parameter));
        let message = format!("the prior allows a mechanism: with a stiffness of 0 mass {name} is not tied to the ground; let the prior begin above 0");
        problems.push(DefinitionProblem::new(pointer, message));
    }
}
