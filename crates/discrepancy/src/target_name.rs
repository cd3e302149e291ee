//! Names of the targets of causes, for results and sentences.

use serde::{Deserialize, Serialize};

use super::grammar::Candidate;
use structures::physics::effect::Target;
use structures::physics::{Form, Node};
use structures::simulator::Simulator;

/// Name of the springs that no parameter sets, as a group.
const UNSET: &str = "without parameter";

/// What a cause acts on.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct TargetName {
    /// `spring`, `spring_group`, `mass`, `mass_group`, `frequency_scale`, `frequency_offset`, `added_spring`, `oscillator`,
    /// `mode_assignment`; `beam` for the bending stiffness of a span, `parameter` for one of a table. Of a setting: `setting` for
    /// an offset or a scale, `setting_unit`, `setting_direction` for one measured from the other end, `setting_exchange`.
    /// `mode_gain` for the response of a mode to a setting. Of a chain of bodies `bending`, `base_rotation`, `spread_mass`,
    /// `stiffness_gradient` and `mass_gradient`; of a beam `end_restraint`, `axial_force`, `rotary_inertia` and both gradients; of the instrument `calibration`. `everywhere` for a simulation that is off by a little in all its parts and
    /// in no single place.
    pub kind: String,
    /// Name of the spring, mass, beam or parameter; `all` for a group of all, `without parameter` for the springs that no parameter
    /// sets; `mode 2` for one mode; empty for all modes; of a deviation the parameter that is its size, if there is one; of exchanged settings both names, joined by `and`.
    pub name: String,
    /// The only mode that a correction of a setting acts on, from 1.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub mode: Option<usize>,
    /// Factor from the unit of a setting to that of its parameter; −1 for the opposite sign.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub factor: Option<f64>,
    /// The setting to which the response of a mode differs.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub setting: Option<String>,
    /// Nodes at the ends of an added spring.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub between: Option<[String; 2]>,
    /// The category that differs.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub level: Option<String>,
}

/// The name of a candidate's target.
pub fn target_name(simulator: &Simulator, candidate: &Candidate) -> TargetName {
    let mut name = name_of(simulator, &candidate.target);
    name.level.clone_from(&candidate.level);
    name
}

/// The name of a target, without the category that differs.
fn name_of(simulator: &Simulator, target: &Target) -> TargetName {
    let structure = || simulator.structure().expect("targets with parts belong to a structure");
    let spring = |index: usize| structure().springs()[index].name.clone();
    let span = |index: usize| matches!(structure().springs()[index].form, Form::Bending(_));
    let node = |node: Node| structure().node_name(node).to_owned();
    let parameter = |column: usize| simulator.space().as_slice()[column].name.clone();
    let one_mode = |mode: &Option<usize>| mode.map_or_else(String::new, |m| format!("mode {}", m + 1));
    let same = |group: &[usize], other: &[usize]| group.len() == other.len() && group.iter().all(|i| other.contains(i));
    let mut between = None;
    let (mut factor_of_unit, mut setting) = (None, None);
    let (kind, name) = match target {
        Target::Springs(indices) if indices.len() == 1 && span(indices[0]) => ("beam", spring(indices[0])),
        Target::Springs(indices) if indices.len() == 1 => ("spring", spring(indices[0])),
        Target::Springs(indices) if indices.len() == structure().springs().len() => ("spring_group", "all".to_owned()),
        Target::Springs(indices) => {
            let group = simulator.spring_groups().into_iter().find(|(_, springs)| same(springs, indices));
            ("spring_group", group.map_or_else(|| UNSET.to_owned(), |(name, _)| name))
        }
        Target::Masses(indices) if indices.len() == 1 => ("mass", structure().masses()[indices[0]].name.clone()),
        Target::Masses(indices) if indices.len() == structure().masses().len() => ("mass_group", "all".to_owned()),
        Target::Masses(indices) => {
            let group = simulator.mass_groups().into_iter().find(|(_, masses)| same(masses, indices));
            ("mass_group", group.map_or_else(String::new, |(name, _)| name))
        }
        Target::FrequencyScale(mode) => ("frequency_scale", one_mode(mode)),
        Target::FrequencyOffset(mode) => ("frequency_offset", one_mode(mode)),
        Target::SettingOffset(k) | Target::SettingScale(k) => ("setting", parameter(*k)),
        Target::SettingUnit { column, factor } => {
            factor_of_unit = Some(*factor);
            ("setting_unit", parameter(*column))
        }
        Target::SettingMirror(k) => ("setting_direction", parameter(*k)),
        Target::SettingExchange(one, other) => {
            ("setting_exchange", format!("{} and {}", parameter(*one), parameter(*other)))
        }
        Target::InMode(mode, target) => return TargetName { mode: Some(mode + 1), ..name_of(simulator, target) },
        Target::ModeGain { mode, column, .. } => {
            setting = Some(parameter(*column));
            ("mode_gain", format!("mode {}", mode + 1))
        }
        Target::ParameterScale(k) | Target::ParameterOffset(k) => ("parameter", parameter(*k)),
        Target::AddedSpring(from, to) => {
            between = Some([node(*from), node(*to)]);
            ("added_spring", String::new())
        }
        Target::AddedMass(dof) => ("added_mass", node(Node::Dof(*dof))),
        Target::Oscillator(host) => ("oscillator", node(Node::Dof(*host))),
        Target::ModeOrder(order) => ("mode_assignment", order_name(order)),
        Target::Deviation(deviation) => {
            (deviation.kind.name(), simulator.parameter_of_deviation(target).map_or_else(String::new, parameter))
        }
        Target::Everywhere(_) => ("everywhere", String::new()),
    };
    TargetName { kind: kind.to_owned(), name, mode: None, factor: factor_of_unit, setting, between, level: None }
}

/// Name of an order of modes: which mode was overlooked, or which modes were swapped.
fn order_name(order: &[usize]) -> String {
    if let Some(skipped) = (0..order.len()).find(|m| order[*m] == m + 1 && !order.contains(m)) {
        return format!("mode {} overlooked", skipped + 1);
    }
    let swapped: Vec<String> =
        order.iter().enumerate().filter(|(i, m)| i != *m).map(|(i, _)| (i + 1).to_string()).collect();
    format!("modes {} swapped", swapped.join(" and "))
}

/// A target that varies as the subject of a sentence.
pub(super) fn varying_phrase(name: &TargetName) -> String {
    match name.kind.as_str() {
        "base_rotation" | "end_restraint" | "axial_force" if !name.name.is_empty() => {
            format!("the parameter {}", name.name)
        }
        "base_rotation" => "the flexibility of the base in rotation".to_owned(),
        "end_restraint" => "the restraint of the end supports against rotation".to_owned(),
        "axial_force" => "the force along the beam".to_owned(),
        _ => phrase(name),
    }
}

/// In what a sentence gives the change of a target that varies, where that is no relative change of the target itself.
pub(super) fn varying_unit(name: &TargetName) -> Option<&'static str> {
    match name.kind.as_str() {
        _ if !name.name.is_empty() => None,
        "base_rotation" => Some("% of the deflection under a force at the free end"),
        "end_restraint" | "axial_force" => Some("% of the stiffness of the first mode"),
        _ => None,
    }
}

/// A target as the subject of a sentence.
pub(super) fn phrase(name: &TargetName) -> String {
    if let Some(mode) = name.mode {
        return format!("{}, for mode {mode} only,", phrase(&TargetName { mode: None, ..name.clone() }));
    }
    let of = |what: &str| format!("{what} of {}", name.name);
    match name.kind.as_str() {
        "spring" => of("the stiffness"),
        "beam" => of("the bending stiffness"),
        "parameter" => format!("the parameter {}", name.name),
        "spring_group" if name.name == "all" => "the stiffness of all springs together".to_owned(),
        "spring_group" if name.name == UNSET => {
            "the stiffness of the springs that no parameter sets, all by one factor,".to_owned()
        }
        "spring_group" => of("the stiffness of the springs"),
        "mass" => format!("the mass {}", name.name),
        "mass_group" if name.name == "all" => "the mass of all bodies together".to_owned(),
        "mass_group" => of("the mass of the bodies"),
        "frequency_scale" if name.name.is_empty() => "the scale of all measured frequencies".to_owned(),
        "frequency_scale" => of("the scale of the measured frequency"),
        "frequency_offset" if name.name.is_empty() => "the offset of all measured frequencies".to_owned(),
        "frequency_offset" => of("the offset of the measured frequency"),
        "setting" => format!("the true value of the setting {}", name.name),
        "setting_unit" => format!("the unit of the setting {}", name.name),
        "setting_direction" => format!("the direction of the setting {}", name.name),
        "setting_exchange" => format!("the order of the settings {}", name.name),
        "mode_gain" => {
            format!(
                "the response of the frequency of {} to the setting {}",
                name.name,
                name.setting.as_deref().unwrap_or_default()
            )
        }
        "added_spring" => {
            let [a, b] = name.between.clone().unwrap_or_default();
            format!("the stiffness of an additional spring between {a} and {b}")
        }
        "oscillator" => format!("an additional body on a spring attached to {}", name.name),
        "bending" => "bending of the whole row of bodies".to_owned(),
        "base_rotation" => "a rotation of the base".to_owned(),
        "spread_mass" => "mass that is spread between the bodies".to_owned(),
        "stiffness_gradient" => "a stiffness that changes evenly along the structure".to_owned(),
        "mass_gradient" => "a mass that changes evenly along the structure".to_owned(),
        "end_restraint" => "supports at the ends that hold the rotation".to_owned(),
        "axial_force" => "a force along the beam".to_owned(),
        "rotary_inertia" => "the rotary inertia of the cross-sections".to_owned(),
        "calibration" => "an error of the instrument that changes with the square of the frequency".to_owned(),
        "everywhere" => "the simulation is off everywhere and in no single place".to_owned(),
        _ => format!("the order of the modes ({})", name.name),
    }
}
