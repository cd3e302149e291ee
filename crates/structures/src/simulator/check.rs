//! Checks the contents of a structure definition, which is well-formed already, and builds the parts of a simulator.

use std::collections::{BTreeMap, HashMap};

use super::definition::{
    DefinitionProblem, Law, MassDefinition, MeasurementNoise, ParameterDefinition, Sets, SimulationKind,
    StructureDefinition, PERCENT_OF_NOMINAL,
};
use super::discrepancy;
use super::discrepancy::input::Discrepancy;
use super::effect::{self, SimulationEffect};
use super::instrumented::{self, Instrumented};
use super::layout::{check_kg, check_names, check_positions, check_spring, placed, sets_pointer, Layout, Problems};
use super::model::{Binding, Matrices, SimulationModel, StiffnessForm};
use super::weakest::{check_connected_to_ground, check_priors};
use super::{beam, counts, covariates, sizes, table};
use crate::measurement::Covariate;
use crate::parameter::{Parameter, ParameterSpace};
use crate::physics::{self, natural_frequencies_hz, AttachmentPoint, Form, Mass, Node, Spring, Structure};
use crate::quantity::{shown, StructureId};

/// The parts of a checked structure.
#[derive(Debug, Clone)]
pub(super) struct Checked {
    pub id: StructureId,
    pub model: SimulationModel,
    pub nominal_frequencies_hz: Vec<f64>,
    pub space: ParameterSpace,
    pub covariates: Vec<Covariate>,
    pub effects: Vec<SimulationEffect>,
    pub discrepancy: Option<Discrepancy>,
    pub instrumented: Option<Instrumented>,
}

/// Checks a definition in several stages. All mistakes of a stage are reported together; a stage runs only if the stages before
/// it found none.
pub(super) fn check(definition: &StructureDefinition) -> Result<Checked, Problems> {
    let too_many = counts::too_many(definition);
    if !too_many.is_empty() {
        return Err(too_many);
    }
    let mut problems = Problems::new();
    let id =
        StructureId::parse(&definition.id).map_err(|e| problems.push(DefinitionProblem::new("/id", e.to_string())));
    check_counts_and_noise(definition, &mut problems);
    check_sections(definition, &mut problems);
    covariates::check(definition, &mut problems);
    let layout = layout(definition, &mut problems);
    let bindings = check_parameters(definition, &mut problems);
    let (Ok(id), true) = (id, problems.is_empty()) else { return Err(problems) };

    let space = ParameterSpace::new(definition.parameters.iter().map(|p| parameter(definition, p)).collect());
    let (model, nominal_frequencies_hz) = match layout {
        None => {
            let emulated = table::emulate(definition, &space).map_err(|problem| vec![problem])?;
            let nominal = emulated.nominal_frequencies_hz(&space, definition.modes);
            (SimulationModel::Table(emulated), nominal)
        }
        Some(layout) => {
            let structure = assemble(definition, layout, &bindings)?;
            // A structure that is connected to the ground can still be a mechanism numerically, if its values are far apart.
            let nominal = natural_frequencies_hz(&structure, definition.modes).map_err(|e| {
                let message = format!("at the nominal stiffnesses: {e}");
                vec![DefinitionProblem::new("/spring", message)]
            })?;
            let sizes = sizes::check(definition, &structure, &nominal)?;
            let matrices = Matrices { structure, bindings, sizes };
            let nominal = sizes::nominal_frequencies_hz(definition, &matrices, nominal)?;
            (SimulationModel::Matrices(matrices), nominal)
        }
    };
    let covariates: Vec<Covariate> = definition.covariates.iter().map(Covariate::from).collect();
    check_names("effect", definition.effects.iter().map(|e| &e.name), &mut problems);
    let effects = effect::check(definition, (&model, &nominal_frequencies_hz), &covariates, &mut problems);
    let discrepancy = discrepancy::check::check(definition, &covariates, &mut problems);
    let instrumented = instrumented::check(definition, &model, &effects, &mut problems);
    if !problems.is_empty() {
        return Err(problems);
    }
    Ok(Checked { id, model, nominal_frequencies_hz, space, covariates, effects, discrepancy, instrumented })
}

/// The parts of a structure; `None` for a table, which has none, or if a beam has mistakes.
fn layout(definition: &StructureDefinition, problems: &mut Problems) -> Option<Layout> {
    check_positions(definition, problems);
    match definition.simulation {
        SimulationKind::Table => None,
        SimulationKind::Beam => beam::layout(definition, problems),
        SimulationKind::SpringMass => {
            let by_name = check_masses(definition, problems);
            let forms = check_springs(definition, &by_name, problems);
            let masses = definition.masses.iter().enumerate();
            let point = |(dof, m): (usize, &MassDefinition)| AttachmentPoint { name: m.name.clone(), dof };
            Some(Layout {
                dofs: definition.masses.len(),
                attachment_points: masses.clone().map(point).collect(),
                masses: masses.map(|(dof, m)| Mass::at(&m.name, dof, m.kg)).collect(),
                forms,
            })
        }
    }
}

/// The structure at its nominal stiffnesses. It must not become a mechanism anywhere in the prior.
fn assemble(definition: &StructureDefinition, layout: Layout, bindings: &[Binding]) -> Result<Structure, Problems> {
    let mut problems = Problems::new();
    let springs = springs(definition, layout.forms, bindings, &mut problems);
    let weakest = check_priors(definition, &springs, bindings, &mut problems);
    if definition.simulation == SimulationKind::SpringMass && problems.is_empty() {
        check_connected_to_ground(definition, &springs, &weakest, bindings, &mut problems);
    }
    if !problems.is_empty() {
        return Err(problems);
    }
    let failed = |e: physics::Error| vec![DefinitionProblem::new("/spring", e.to_string())];
    let Layout { dofs, attachment_points, masses, .. } = layout;
    if definition.simulation == SimulationKind::SpringMass {
        return Structure::new(masses, springs).map(|structure| placed(structure, definition)).map_err(failed);
    }
    let structure = Structure::with_dofs(dofs, attachment_points, masses, springs).map_err(failed)?;
    let least: Vec<(usize, f64)> = weakest.iter().enumerate().map(|(i, s)| (i, s.n_per_m)).collect();
    let at_weakest = structure.with_stiffness(&least).and_then(|weak| natural_frequencies_hz(&weak, 1));
    at_weakest.map_err(|e| {
        let message = format!(
            "with every stiffness at its smallest value in the prior: {e}; hold the beam with supports or springs, or, if it \
             is held already, give its short spans fewer elements"
        );
        vec![DefinitionProblem::new("/node", message)]
    })?;
    Ok(structure)
}

/// Checks that there are no sections that belong to another kind of simulation.
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
        let message =
            format!("a simulation \"{name}\" has no {section}: remove it, or choose another simulation = \"…\"");
        problems.push(DefinitionProblem::new(format!("/{section}"), message));
    }
    if d.simulation == SimulationKind::SpringMass {
        for (index, _) in d.masses.iter().enumerate().filter(|(_, m)| m.at.is_some()) {
            let message = "a mass has a node only in a simulation \"beam\": remove the key at";
            problems.push(DefinitionProblem::new(format!("/mass/{index}/at"), message));
        }
        for (index, _) in d.springs.iter().enumerate().filter(|(_, s)| s.n_m_per_rad.is_some()) {
            let message = "a spring has a rotational stiffness only in a simulation \"beam\": give n_per_m";
            problems.push(DefinitionProblem::new(format!("/spring/{index}/n_m_per_rad"), message));
        }
    }
}

/// Checks the number of masses and modes, the measurement noise, and that there is a parameter.
fn check_counts_and_noise(definition: &StructureDefinition, problems: &mut Problems) {
    let masses = definition.masses.len();
    let bodies = definition.simulation == SimulationKind::SpringMass;
    if bodies && masses == 0 {
        let message = format!("0 masses: a structure has 1 to {} [[mass]]", counts::MOST_MASSES);
        problems.push(DefinitionProblem::new("/mass", message));
    } else if definition.modes == 0 || (bodies && definition.modes > masses) {
        let message = if bodies {
            format!("{} modes: a structure of {masses} masses has 1 to {masses}", definition.modes)
        } else {
            "0 modes: at least 1 must be measured".to_owned()
        };
        problems.push(DefinitionProblem::new("/modes", message));
    }
    let (key, noise) = match definition.measurement_noise {
        MeasurementNoise::Relative(share) => ("relative", share),
        MeasurementNoise::Hz(std_hz) => ("hz", std_hz),
    };
    if !(noise.is_finite() && noise >= 0.0) || (key == "relative" && noise >= 0.5) {
        let message =
            format!("a standard deviation of {noise} is not valid: it must be finite and not negative; a relative one must be below 0.5");
        problems.push(DefinitionProblem::new(format!("/measurement_noise/{key}"), message));
    }
    if definition.parameters.is_empty() {
        problems
            .push(DefinitionProblem::new("/parameter", "no [[parameter]]: at least one unknown parameter is needed"));
    }
}

/// Checks the masses. Returns the index of each mass by its name.
fn check_masses<'a>(definition: &'a StructureDefinition, problems: &mut Problems) -> BTreeMap<&'a str, usize> {
    check_names("mass", definition.masses.iter().map(|m| &m.name), problems);
    let mut by_name = BTreeMap::new();
    for (index, mass) in definition.masses.iter().enumerate() {
        if mass.name == "ground" {
            let message = "a mass cannot be called \"ground\": this name means the fixed end of springs";
            problems.push(DefinitionProblem::new(format!("/mass/{index}/name"), message));
        }
        check_kg(&mass.name, mass.kg, index, problems);
        by_name.entry(mass.name.as_str()).or_insert(index);
    }
    by_name
}

/// Checks the springs between masses. Returns the stiffness pattern of each.
fn check_springs(
    definition: &StructureDefinition,
    masses: &BTreeMap<&str, usize>,
    problems: &mut Problems,
) -> Vec<Form> {
    check_names("spring", definition.springs.iter().map(|s| &s.name), problems);
    let mut forms = Vec::new();
    for (index, spring) in definition.springs.iter().enumerate() {
        let mut node = |key: &str, name: &str| match masses.get(name) {
            _ if name == "ground" => Node::Ground,
            Some(dof) => Node::Dof(*dof),
            None => {
                let spring = shown(&spring.name);
                let message =
                    format!("spring {spring} goes to {}, which is neither a mass nor \"ground\"", shown(name));
                problems.push(DefinitionProblem::new(format!("/spring/{index}/{key}"), message));
                Node::Ground
            }
        };
        forms.push(Form::Spring(node("from", &spring.from), node("to", &spring.to)));
        check_spring(spring, index, problems);
    }
    forms
}

/// Checks the parameters. Returns which parameter sets which stiffness.
fn check_parameters(definition: &StructureDefinition, problems: &mut Problems) -> Vec<Binding> {
    check_names("parameter", definition.parameters.iter().map(|p| &p.name), problems);
    let mut bindings: Vec<Binding> = Vec::new();
    let stiffnesses = Stiffnesses::of(definition);
    let mut set_by: HashMap<usize, usize> = HashMap::new();
    for (index, parameter) in definition.parameters.iter().enumerate() {
        if let Some((below, message)) = parameter.prior.mistake() {
            problems.push(DefinitionProblem::new(parameter.prior.pointer(index) + below, message));
        }
        let table = definition.simulation == SimulationKind::Table;
        check_factor(definition, index, problems);
        if parameter.sets.is_empty() && !table {
            let beam = if definition.simulation == SimulationKind::Beam { "a beam, " } else { "" };
            let name = shown(&parameter.name);
            let message = format!("parameter {name} sets nothing: name {beam}a spring, a mass or a deviation in sets");
            problems.push(DefinitionProblem::new(format!("/parameter/{index}/sets"), message));
        }
        for (position, sets) in parameter.sets.iter().enumerate() {
            let key = if sets.beam.is_some() { "beam" } else { "spring" };
            let pointer = sets_pointer(parameter, index, position);
            let mut wrong = |message: String| problems.push(DefinitionProblem::new(&pointer, message));
            if table {
                wrong(
                    "the parameters of a simulation \"table\" are columns of its runs and set nothing: remove sets"
                        .to_owned(),
                );
                continue;
            }
            // Masses and deviations are checked once the structure is known.
            let is_stiffness = sets.spring.is_some() || sets.beam.is_some();
            if !is_stiffness && sets.mass.is_some() != sets.deviation.is_some() {
                continue;
            }
            let spring = match stiffnesses.index(sets) {
                Ok(spring) => spring,
                Err(message) => {
                    wrong(message);
                    continue;
                }
            };
            if let Some(other) = set_by.get(&spring) {
                let other = shown(&definition.parameters[*other].name);
                let name = sets.spring.as_ref().or(sets.beam.as_ref()).map_or("", String::as_str);
                wrong(format!("{key} {} is set by parameter {other} already", shown(name)));
                continue;
            }
            match form(definition, parameter, (sets, spring)) {
                Ok(form) => {
                    set_by.insert(spring, index);
                    bindings.push(Binding { parameter: index, spring, form });
                }
                Err(message) => wrong(message),
            }
        }
    }
    bindings
}

/// Checks that a parameter which is a factor has neither a unit of its own nor a table of runs.
fn check_factor(definition: &StructureDefinition, index: usize, problems: &mut Problems) {
    let parameter = &definition.parameters[index];
    if !parameter.scale {
        return;
    }
    let name = shown(&parameter.name);
    if definition.simulation == SimulationKind::Table {
        let message = format!(
            "parameter {name} is a column of the runs of a simulation \"table\", which has no nominal stiffness: remove scale"
        );
        problems.push(DefinitionProblem::new(format!("/parameter/{index}/scale"), message));
    }
    if let Some(unit) = parameter.unit.as_ref().filter(|unit| *unit != PERCENT_OF_NOMINAL) {
        let message = format!(
            "parameter {name} has the unit {}, but a factor (scale = true) is given in {PERCENT_OF_NOMINAL}: remove unit",
            shown(unit)
        );
        problems.push(DefinitionProblem::new(format!("/parameter/{index}/unit"), message));
    }
}

/// Stiffness that an entry of `sets` describes, as a function of its parameter; `spring` is the index of the stiffness.
fn form(
    definition: &StructureDefinition,
    parameter: &ParameterDefinition,
    (sets, spring): (&Sets, usize),
) -> Result<StiffnessForm, String> {
    let kind = if sets.beam.is_some() { "beam" } else { "spring" };
    let name = || shown(sets.spring.as_ref().or(sets.beam.as_ref()).map_or("", String::as_str));
    match (sets.law, parameter.scale) {
        (None, false) => Ok(StiffnessForm::Itself),
        (Some(_), true) => Err(format!(
            "parameter {} is a factor (scale = true) and has a law for {kind} {}: remove one of the two",
            shown(&parameter.name),
            name()
        )),
        (Some(law @ Law::Exponential(e)), false) => {
            if e.a.is_finite() && e.b.is_finite() && e.c.is_finite() {
                Ok(StiffnessForm::Law(law))
            } else {
                Err(format!("the constants of a law must be finite: a = {}, b = {}, c = {}", e.a, e.b, e.c))
            }
        }
        (None, true) => {
            let key = if sets.beam.is_some() { "bending_stiffness_n_m2" } else { "n_per_m or n_m_per_rad" };
            let stated = match definition.springs.get(spring) {
                Some(spring) => spring.stiffness(),
                None => definition.beams[spring - definition.springs.len()].bending_stiffness_n_m2,
            };
            let nominal = stated.filter(|k| *k > 0.0);
            nominal.map(StiffnessForm::PercentOf).ok_or_else(|| {
                format!(
                    "parameter {} is a factor (scale = true) of the nominal stiffness of {kind} {}, which must be stated and above 0: \
                     give {key} there",
                    shown(&parameter.name),
                    name()
                )
            })
        }
    }
}

/// The stiffnesses by their names: springs come first, then beam spans. The first of equal names counts.
struct Stiffnesses<'a> {
    springs: HashMap<&'a str, usize>,
    beams: HashMap<&'a str, usize>,
}

impl<'a> Stiffnesses<'a> {
    fn of(definition: &'a StructureDefinition) -> Self {
        let (mut springs, mut beams) = (HashMap::new(), HashMap::new());
        for (index, spring) in definition.springs.iter().enumerate() {
            springs.entry(spring.name.as_str()).or_insert(index);
        }
        for (index, beam) in definition.beams.iter().enumerate() {
            beams.entry(beam.name.as_str()).or_insert(definition.springs.len() + index);
        }
        Self { springs, beams }
    }

    /// Index of the stiffness that an entry of `sets` names.
    fn index(&self, sets: &Sets) -> Result<usize, String> {
        match (&sets.spring, &sets.beam) {
            (Some(name), None) if !sets.is_size() => {
                let index = self.springs.get(name.as_str()).copied();
                index.ok_or_else(|| format!("there is no spring {}", shown(name)))
            }
            (None, Some(name)) if !sets.is_size() => {
                let index = self.beams.get(name.as_str()).copied();
                index.ok_or_else(|| format!("there is no beam {}", shown(name)))
            }
            _ => Err("name one spring, one beam, one mass or one deviation".to_owned()),
        }
    }
}

/// The parameter of a checked definition, with the unit of the stiffness that it sets unless the file gives one.
fn parameter(structure: &StructureDefinition, definition: &ParameterDefinition) -> Parameter {
    let [lower, upper] = definition.bounds();
    let without_law = |sets: &Sets| sets.law.is_none();
    let unit = match definition.sets.first() {
        _ if definition.scale => PERCENT_OF_NOMINAL,
        Some(_) if !definition.sets.iter().all(without_law) => "–",
        None => "–",
        Some(sets) => structure.unit_of(sets),
    };
    let unit = definition.unit.clone().unwrap_or_else(|| unit.to_owned());
    Parameter { name: definition.name.clone(), unit, lower, upper, damage: definition.damage, form: definition.form() }
}

/// The stiffnesses at their nominal values: those of the file, or else at the median of the prior of the parameter that sets
/// them.
fn springs(
    definition: &StructureDefinition,
    forms: Vec<Form>,
    bindings: &[Binding],
    problems: &mut Problems,
) -> Vec<Spring> {
    let springs = definition.springs.iter().map(|s| (&s.name, s.stiffness()));
    let spans = definition.beams.iter().map(|b| (&b.name, b.bending_stiffness_n_m2));
    let by_spring: HashMap<usize, &Binding> = bindings.iter().map(|binding| (binding.spring, binding)).collect();
    let nominal = |(index, ((name, value), form)): (usize, ((&String, Option<f64>), Form))| {
        let binding = by_spring.get(&index);
        let middle = binding.map(|b| b.stiffness(definition.parameters[b.parameter].median()));
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
