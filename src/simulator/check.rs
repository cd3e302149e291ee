//! From a definition to checked parts: every mistake that is no mistake of form.

use std::collections::BTreeMap;

use super::definition::{
    DefinitionProblem, Law, MeasurementNoise, ParameterDefinition, Prior, Sets, SimulationKind, StructureDefinition,
};
use super::effect::{self, Effect};
use super::shapes::{self, Instrumented};
use super::{beam, table, Binding, Model};
use crate::measurement::Covariate;
use crate::parameter::{Parameter, ParameterSpace};
use crate::physics::{floating_mass, natural_frequencies_hz, Form, Mass, Node, Place, Spring, Structure};
use crate::quantity::{shown, StructureId};

/// Most degrees of freedom: a dense eigenproblem of this size takes some three seconds.
const MOST_MASSES: usize = 2_000;

/// The checked parts of a structure.
#[derive(Debug, Clone)]
pub(super) struct Checked {
    pub id: StructureId,
    pub model: Model,
    pub nominal_frequencies_hz: Vec<f64>,
    pub space: ParameterSpace,
    pub covariates: Vec<Covariate>,
    pub effects: Vec<Effect>,
    pub instrumented: Option<Instrumented>,
}

pub(super) type Problems = Vec<DefinitionProblem>;

/// Checks a definition; all mistakes of a stage are reported together, a later stage needs the earlier ones.
pub(super) fn check(definition: &StructureDefinition) -> Result<Checked, Problems> {
    let mut problems = Problems::new();
    let id =
        StructureId::parse(&definition.id).map_err(|e| problems.push(DefinitionProblem::new("/id", e.to_string())));
    check_head(definition, &mut problems);
    check_sections(definition, &mut problems);
    check_covariates(definition, &mut problems);
    let layout = layout(definition, &mut problems);
    let bindings = check_parameters(definition, &mut problems);
    let (Ok(id), true) = (id, problems.is_empty()) else { return Err(problems) };

    let space = ParameterSpace::new(definition.parameters.iter().map(|p| parameter(definition, p)).collect());
    let (model, nominal_frequencies_hz) = match layout {
        None => {
            let emulated = table::emulate(definition, &space).map_err(|problem| vec![problem])?;
            let nominal = emulated.nominal_frequencies_hz(&space, definition.modes);
            (Model::Table(emulated), nominal)
        }
        Some(layout) => {
            let structure = assemble(definition, layout, &bindings)?;
            // Tied to the ground is not enough: values far apart can drown the lowest frequency in rounding.
            let nominal = natural_frequencies_hz(&structure, definition.modes).map_err(|e| {
                let message = format!("at the nominal stiffnesses: {e}");
                vec![DefinitionProblem::new("/spring", message)]
            })?;
            (Model::Matrices { structure, bindings }, nominal)
        }
    };
    let covariates: Vec<Covariate> =
        definition.covariates.iter().map(|c| Covariate { name: c.name.clone(), kind: c.kind }).collect();
    check_names("effect", definition.effects.iter().map(|e| &e.name), &mut problems);
    let effects = effect::check(definition, &model, &covariates, &mut problems);
    let instrumented = shapes::check(definition, &model, &mut problems);
    if !problems.is_empty() {
        return Err(problems);
    }
    Ok(Checked { id, model, nominal_frequencies_hz, space, covariates, effects, instrumented })
}

/// Degrees of freedom, places and masses of a structure, and the forms of its stiffnesses: springs, then spans.
pub(super) struct Layout {
    pub freedoms: usize,
    pub places: Vec<Place>,
    pub masses: Vec<Mass>,
    pub forms: Vec<Form>,
}

fn layout(definition: &StructureDefinition, problems: &mut Problems) -> Option<Layout> {
    match definition.simulation {
        SimulationKind::Table => None,
        SimulationKind::Beam => beam::layout(definition, problems),
        SimulationKind::SpringMass => {
            let by_name = check_masses(definition, problems);
            let forms = check_springs(definition, &by_name, problems);
            let masses = definition.masses.iter().enumerate();
            let place =
                |(freedom, m): (usize, &super::definition::MassDefinition)| Place { name: m.name.clone(), freedom };
            Some(Layout {
                freedoms: definition.masses.len(),
                places: masses.clone().map(place).collect(),
                masses: masses.map(|(freedom, m)| Mass::at(&m.name, freedom, m.kg)).collect(),
                forms,
            })
        }
    }
}

/// The structure at its nominal stiffnesses, which holds together over the whole prior.
fn assemble(definition: &StructureDefinition, layout: Layout, bindings: &[Binding]) -> Result<Structure, Problems> {
    let mut problems = Problems::new();
    let springs = springs(definition, layout.forms, bindings, &mut problems);
    let weakest = check_priors(definition, &springs, bindings, &mut problems);
    if definition.simulation == SimulationKind::SpringMass && problems.is_empty() {
        check_tied(definition, &springs, &weakest, bindings, &mut problems);
    }
    if !problems.is_empty() {
        return Err(problems);
    }
    let failed = |e: crate::physics::Error| vec![DefinitionProblem::new("/spring", e.to_string())];
    let Layout { freedoms, places, masses, .. } = layout;
    if definition.simulation == SimulationKind::SpringMass {
        return Structure::new(masses, springs).map_err(failed);
    }
    let structure = Structure::with_freedoms(freedoms, places, masses, springs).map_err(failed)?;
    let least: Vec<(usize, f64)> = weakest.iter().enumerate().map(|(i, s)| (i, s.n_per_m)).collect();
    let at_weakest = structure.with_stiffness(&least).and_then(|weak| natural_frequencies_hz(&weak, 1));
    at_weakest.map_err(|e| {
        let message = format!("with every parameter at its softest: {e}; hold the beam with supports or springs, or, if it is held, give a short span fewer elements");
        vec![DefinitionProblem::new("/node", message)]
    })?;
    Ok(structure)
}

/// Sections of another kind of simulation.
fn check_sections(definition: &StructureDefinition, problems: &mut Problems) {
    let d = definition;
    let (name, wrong): (_, &[(&str, bool)]) = match d.simulation {
        SimulationKind::SpringMass => (
            "spring_mass",
            &[("node", !d.nodes.is_empty()), ("beam", !d.beams.is_empty()), ("table", d.table.is_some())],
        ),
        SimulationKind::Beam => ("beam", &[("table", d.table.is_some())]),
        SimulationKind::Table => (
            "table",
            &[
                ("mass", !d.masses.is_empty()),
                ("spring", !d.springs.is_empty()),
                ("node", !d.nodes.is_empty()),
                ("beam", !d.beams.is_empty()),
            ],
        ),
    };
    for (section, _) in wrong.iter().filter(|(_, present)| *present) {
        let message = format!("a simulation \"{name}\" has no {section}: remove it, or say another simulation = \"…\"");
        problems.push(DefinitionProblem::new(format!("/{section}"), message));
    }
    if d.simulation == SimulationKind::SpringMass {
        for (index, _) in d.masses.iter().enumerate().filter(|(_, m)| m.at.is_some()) {
            let message = "only in a simulation \"beam\" a mass sits at a node";
            problems.push(DefinitionProblem::new(format!("/mass/{index}/at"), message));
        }
        for (index, _) in d.springs.iter().enumerate().filter(|(_, s)| s.n_m_per_rad.is_some()) {
            let message = "only in a simulation \"beam\" a spring holds a rotation: give n_per_m";
            problems.push(DefinitionProblem::new(format!("/spring/{index}/n_m_per_rad"), message));
        }
    }
}

fn check_head(definition: &StructureDefinition, problems: &mut Problems) {
    let masses = definition.masses.len();
    let bodies = definition.simulation == SimulationKind::SpringMass;
    if bodies && (masses == 0 || masses > MOST_MASSES) {
        let message = format!("{masses} masses: a structure has 1 to {MOST_MASSES} [[mass]]");
        problems.push(DefinitionProblem::new("/mass", message));
    } else if definition.modes == 0 || (bodies && definition.modes > masses) {
        let most = if bodies { masses.to_string() } else { "as many as are measured".to_owned() };
        let of = if bodies { format!("a structure of {masses} masses") } else { "a structure".to_owned() };
        let message = format!("{} modes: {of} has 1 to {most}", definition.modes);
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
pub(super) fn check_names<'a>(section: &str, names: impl Iterator<Item = &'a String>, problems: &mut Problems) {
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

/// Forms of the springs between named places.
fn check_springs(
    definition: &StructureDefinition,
    places: &BTreeMap<&str, usize>,
    problems: &mut Problems,
) -> Vec<Form> {
    check_names("spring", definition.springs.iter().map(|s| &s.name), problems);
    let mut forms = Vec::new();
    for (index, spring) in definition.springs.iter().enumerate() {
        let mut node = |key: &str, name: &str| match places.get(name) {
            _ if name == "ground" => Node::Ground,
            Some(freedom) => Node::Freedom(*freedom),
            None => {
                let spring = shown(&spring.name);
                let message = format!("spring {spring} goes to {}, which is no mass and not \"ground\"", shown(name));
                problems.push(DefinitionProblem::new(format!("/spring/{index}/{key}"), message));
                Node::Ground
            }
        };
        forms.push(Form::Spring(node("from", &spring.from), node("to", &spring.to)));
        check_spring(spring, index, problems);
    }
    forms
}

/// Ends that differ and a stiffness that is one.
pub(super) fn check_spring(spring: &super::definition::SpringDefinition, index: usize, problems: &mut Problems) {
    if spring.from == spring.to {
        let message = format!("spring {} goes from {} to itself", shown(&spring.name), shown(&spring.from));
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
        let table = definition.simulation == SimulationKind::Table;
        if parameter.sets.is_empty() && !table {
            let what = if definition.simulation == SimulationKind::Beam { "a beam or a spring" } else { "a spring" };
            let message = format!("parameter {} sets nothing: name {what}", shown(&parameter.name));
            problems.push(DefinitionProblem::new(format!("/parameter/{index}/sets"), message));
        }
        for (place, sets) in parameter.sets.iter().enumerate() {
            let key = if sets.beam.is_some() { "beam" } else { "spring" };
            // A single one may stand in the file as a table or as a list; a list of several has an index.
            let pointer = match parameter.sets.len() {
                1 => format!("/parameter/{index}/sets"),
                _ => format!("/parameter/{index}/sets/{place}/{key}"),
            };
            let mut wrong = |message: String| problems.push(DefinitionProblem::new(&pointer, message));
            if table {
                wrong("parameters of a table are columns of its runs: they set nothing".to_owned());
                continue;
            }
            let spring = match stiffness_index(definition, sets) {
                Ok(spring) => spring,
                Err(message) => {
                    wrong(message);
                    continue;
                }
            };
            if let Some(other) = bindings.iter().find(|b| b.spring == spring) {
                let other = shown(&definition.parameters[other.parameter].name);
                let name = sets.spring.as_ref().or(sets.beam.as_ref()).map_or("", String::as_str);
                wrong(format!("{key} {} is set by parameter {other} already", shown(name)));
                continue;
            }
            if let Some(Law::Exponential(e)) = sets.law {
                if !(e.a.is_finite() && e.b.is_finite() && e.c.is_finite()) {
                    wrong("the constants of a law must be finite".to_owned());
                    continue;
                }
            }
            bindings.push(Binding { parameter: index, spring, law: sets.law });
        }
    }
    bindings
}

/// Index among the stiffnesses: springs first, then spans.
fn stiffness_index(definition: &StructureDefinition, sets: &Sets) -> Result<usize, String> {
    match (&sets.spring, &sets.beam) {
        (Some(name), None) => {
            let place = definition.springs.iter().position(|s| s.name == *name);
            place.ok_or_else(|| format!("there is no spring {}", shown(name)))
        }
        (None, Some(name)) => {
            let place = definition.beams.iter().position(|b| b.name == *name);
            place.map(|p| definition.springs.len() + p).ok_or_else(|| format!("there is no beam {}", shown(name)))
        }
        _ => Err("name one spring or one beam".to_owned()),
    }
}

fn parameter(structure: &StructureDefinition, definition: &ParameterDefinition) -> Parameter {
    let Prior::Uniform([lower, upper]) = definition.prior;
    let plain = |sets: &Sets| sets.law.is_none();
    let rotation = |sets: &Sets| {
        structure.springs.iter().any(|s| Some(&s.name) == sets.spring.as_ref() && s.n_m_per_rad.is_some())
    };
    let unit = match definition.sets.first() {
        Some(_) if !definition.sets.iter().all(plain) => "–",
        None => "–",
        Some(sets) if sets.beam.is_some() => "N·m²",
        Some(sets) if rotation(sets) => "N·m/rad",
        Some(_) => "N/m",
    };
    let unit = definition.unit.clone().unwrap_or_else(|| unit.to_owned());
    Parameter { name: definition.name.clone(), unit, lower, upper, damage: definition.damage }
}

/// The stiffnesses at their nominal values.
fn springs(
    definition: &StructureDefinition,
    forms: Vec<Form>,
    bindings: &[Binding],
    problems: &mut Problems,
) -> Vec<Spring> {
    let springs = definition.springs.iter().map(|s| (&s.name, s.n_per_m.or(s.n_m_per_rad)));
    let spans = definition.beams.iter().map(|b| (&b.name, b.bending_stiffness_n_m2));
    let nominal = |(index, ((name, value), form)): (usize, ((&String, Option<f64>), Form))| {
        let binding = bindings.iter().find(|b| b.spring == index);
        let middle = binding.map(|b| {
            let Prior::Uniform([lower, upper]) = definition.parameters[b.parameter].prior;
            b.stiffness(f64::midpoint(lower, upper))
        });
        let n_per_m = value.or(middle).unwrap_or_else(|| {
            let of_springs = definition.springs.len();
            let (pointer, message) = if index < of_springs {
                (format!("/spring/{index}"), format!("spring {} has no n_per_m and no parameter sets it", shown(name)))
            } else {
                let message = format!("beam {} has no bending_stiffness_n_m2 and no parameter sets it", shown(name));
                (format!("/beam/{}", index - of_springs), message)
            };
            problems.push(DefinitionProblem::new(pointer, message));
            0.0
        });
        Spring { name: name.clone(), form, n_per_m }
    };
    springs.chain(spans).zip(forms).enumerate().map(nominal).collect()
}

/// No value of the prior may give a negative stiffness; the stiffnesses at their least.
fn check_priors(
    definition: &StructureDefinition,
    springs: &[Spring],
    bindings: &[Binding],
    problems: &mut Problems,
) -> Vec<Spring> {
    let mut weakest: Vec<Spring> = springs.to_vec();
    for binding in bindings {
        let Prior::Uniform([lower, upper]) = definition.parameters[binding.parameter].prior;
        // Every law is monotone: its least value lies at an end of the prior.
        let (at_lower, at_upper) = (binding.stiffness(lower), binding.stiffness(upper));
        let least = at_lower.min(at_upper);
        let pointer = format!("/parameter/{}/prior/uniform", binding.parameter);
        let name = shown(&springs[binding.spring].name);
        let kind = if binding.spring < definition.springs.len() { "spring" } else { "beam" };
        // Each end by itself: `min` and `max` pass over NaN, which 0·exp(large) gives.
        if !(least >= 0.0 && at_lower.is_finite() && at_upper.is_finite()) {
            let unit = if kind == "beam" { "N·m²" } else { "N/m" };
            let message = format!("the prior [{lower}, {upper}] lets {kind} {name} have a stiffness of {at_lower} to {at_upper} {unit}: it must be finite and not negative");
            problems.push(DefinitionProblem::new(pointer, message));
        }
        weakest[binding.spring].n_per_m = least;
    }
    weakest
}

/// No value of the prior may cut a mass off from the ground.
fn check_tied(
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
