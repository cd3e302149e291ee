//! Effects of a structure file: checked, and their sizes under measured covariates.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, DVector};
use rand::Rng as _;
use rand_distr::StandardNormal;

use super::definition::{DefinitionProblem, EffectDefinition, StructureDefinition, TargetDefinition};
use super::law::{Input, Law, LawKind};
use super::{Model, Simulator};
use crate::measurement::{Covariate, CovariateKind, CovariateValue};
use crate::physics::effect::Target;
use crate::physics::{Node, Structure};
use crate::quantity::shown;
use crate::stats::Stream;

/// A covariate may go beyond what the effect was learnt from by this share of the range before the reader is told.
const BEYOND: f64 = 0.1;

/// An effect of a structure, ready for use.
#[derive(Debug, Clone)]
pub struct Effect {
    /// Its name.
    pub name: String,
    /// What changes.
    pub target: Target,
    /// By how much.
    pub law: Law,
    /// Means of the numbers, in the order of the law; then the frequency of an oscillator.
    pub psi: Vec<f64>,
    /// Lower factor of their covariance; `None` where they are exact.
    factor: Option<DMatrix<f64>>,
    /// Values of a numeric covariate that it was learnt from, ascending.
    seen: Vec<f64>,
}

/// Sizes of the effects of one measurement.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Sizes {
    /// All sizes, those of the first effect first.
    pub values: Vec<f64>,
    /// Covariates that an effect needs and the measurement lacks.
    pub missing: Vec<String>,
    /// Covariates beyond what an effect was learnt from.
    pub beyond: Vec<String>,
}

impl Effect {
    /// Whether it depends on a covariate, and so is a condition of a flow.
    pub fn varies(&self) -> bool {
        self.law.covariate.is_some()
    }

    /// Standard deviation of each number; 0 where it is exact.
    pub fn psi_std(&self) -> Vec<f64> {
        let of = |i: usize| self.factor.as_ref().map_or(0.0, |factor| factor.row(i).norm());
        (0..self.psi.len()).map(of).collect()
    }

    /// Its sizes at one value of the covariate with the numbers `psi`.
    fn sizes_at(&self, input: Input, psi: &[f64]) -> Vec<f64> {
        match self.target {
            Target::ModeOrder(_) => Vec::new(),
            Target::Oscillator(_) => psi.to_vec(),
            _ => vec![self.law.size(input, psi, &mut vec![0.0; psi.len()])],
        }
    }

    /// Its sizes at one value of the covariate.
    pub fn sizes(&self, input: Input) -> Vec<f64> {
        self.sizes_at(input, &self.psi)
    }

    /// Inputs that stand for not knowing the covariate: what it was learnt from.
    pub fn inputs_seen(&self) -> Vec<Input> {
        if self.law.covariate.is_none() {
            return vec![Input::Number(0.0)];
        }
        if self.law.kind == LawKind::Category {
            return (0..self.law.levels.len()).map(|l| Input::Level(Some(l))).chain([Input::Level(None)]).collect();
        }
        self.seen.iter().map(|v| Input::Number(*v)).collect()
    }

    /// Its sizes at an input with numbers drawn from what is known of them.
    pub fn draw_sizes(&self, input: Input, stream: &mut Stream) -> Vec<f64> {
        let Some(factor) = &self.factor else { return self.sizes(input) };
        let normal = DVector::from_fn(self.psi.len(), |_, _| stream.sample::<f64, _>(StandardNormal));
        let psi = DVector::from_column_slice(&self.psi) + factor * normal;
        self.sizes_at(input, psi.as_slice())
    }

    /// The covariate of a measurement as the law takes it, within what it was learnt from; whether it lies beyond.
    fn input(&self, covariates: &BTreeMap<String, CovariateValue>) -> (Input, bool) {
        let Some(name) = &self.law.covariate else { return (Input::Number(0.0), false) };
        match covariates.get(name) {
            None => (Input::Missing, false),
            Some(CovariateValue::Category(text)) => {
                (Input::Level(self.law.levels.iter().position(|level| level == text)), false)
            }
            Some(CovariateValue::Number(value)) => {
                let (low, high) = (self.seen[0], self.seen[self.seen.len() - 1]);
                let margin = BEYOND * (high - low);
                // A sensor that sends 9999 must not become a structure without stiffness.
                let within = value.clamp(low - margin, high + margin);
                (Input::Number(within), !(low - margin..=high + margin).contains(value))
            }
        }
    }
}

/// Sizes of all effects under the covariates of a measurement; an effect whose covariate is missing has the mean of its
/// sizes over what it was learnt from.
pub fn sizes(effects: &[Effect], covariates: &BTreeMap<String, CovariateValue>) -> Sizes {
    let mut found = Sizes::default();
    for effect in effects {
        let name = || effect.law.covariate.clone().unwrap_or_default();
        match effect.input(covariates) {
            (Input::Missing, _) => {
                found.missing.push(name());
                found.values.extend(mean_sizes(effect));
            }
            (input, beyond) => {
                if beyond {
                    found.beyond.push(name());
                }
                found.values.extend(effect.sizes(input));
            }
        }
    }
    found.missing.sort();
    found.missing.dedup();
    found
}

/// Sizes of all effects at each of the values that missing covariates may have.
pub fn possible_sizes(effects: &[Effect], covariates: &BTreeMap<String, CovariateValue>) -> Vec<Vec<f64>> {
    let missing = |e: &&Effect| e.law.covariate.as_ref().is_some_and(|name| !covariates.contains_key(name));
    let count = effects.iter().filter(missing).map(|e| e.inputs_seen().len()).max().unwrap_or(0);
    let at = |step: usize| -> Vec<f64> {
        let one = |effect: &Effect| match effect.input(covariates) {
            (Input::Missing, _) => {
                let inputs = effect.inputs_seen();
                effect.sizes(inputs[step * inputs.len() / count])
            }
            (input, _) => effect.sizes(input),
        };
        effects.iter().flat_map(one).collect()
    };
    (0..count).map(at).collect()
}

/// Values of all covariates that effects depend on, as training draws them: numbers anywhere in the range that was seen, with
/// a margin, and each category alike, those without a number of their own as one.
pub fn draw_covariates(effects: &[Effect], stream: &mut Stream) -> BTreeMap<String, CovariateValue> {
    let mut names: Vec<&String> = effects.iter().filter_map(|e| e.law.covariate.as_ref()).collect();
    names.sort();
    names.dedup();
    let draw = |name: &String| {
        let own = || effects.iter().filter(|e| e.law.covariate.as_ref() == Some(name));
        let seen = || own().flat_map(|e| e.seen.iter().copied());
        let (low, high) = seen().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
        let value = if low.is_finite() {
            let margin = BEYOND * (high - low);
            CovariateValue::Number(low - margin + stream.random::<f64>() * (high - low + 2.0 * margin))
        } else {
            let mut levels: Vec<&str> = own().flat_map(|e| e.law.levels.iter().map(String::as_str)).collect();
            levels.sort_unstable();
            levels.dedup();
            levels.push("");
            CovariateValue::Category(levels[stream.random_range(0..levels.len())].to_owned())
        };
        (name.clone(), value)
    };
    names.into_iter().map(draw).collect()
}

/// Sizes under covariates with numbers drawn from what is known of them.
pub fn draw_sizes(effects: &[Effect], covariates: &BTreeMap<String, CovariateValue>, stream: &mut Stream) -> Vec<f64> {
    effects.iter().flat_map(|effect| effect.draw_sizes(effect.input(covariates).0, stream)).collect()
}

/// Sizes where nothing is known of the covariates.
pub fn typical_sizes(effects: &[Effect]) -> Vec<f64> {
    effects.iter().flat_map(mean_sizes).collect()
}

fn mean_sizes(effect: &Effect) -> Vec<f64> {
    let all: Vec<Vec<f64>> = effect.inputs_seen().into_iter().map(|input| effect.sizes(input)).collect();
    (0..effect.target.sizes()).map(|i| all.iter().map(|s| s[i]).sum::<f64>() / all.len() as f64).collect()
}

/// Checks the effects of a definition whose other parts are right.
pub(super) fn check(
    definition: &StructureDefinition,
    model: &Model,
    covariates: &[Covariate],
    problems: &mut Vec<DefinitionProblem>,
) -> Vec<Effect> {
    let one = |(index, effect): (usize, &EffectDefinition)| {
        check_one(definition, effect, model, covariates)
            .map_err(|(key, message)| problems.push(DefinitionProblem::new(format!("/effect/{index}/{key}"), message)))
            .ok()
    };
    definition.effects.iter().enumerate().filter_map(one).collect()
}

type Mistake = (&'static str, String);

fn check_one(
    definition: &StructureDefinition,
    effect: &EffectDefinition,
    model: &Model,
    covariates: &[Covariate],
) -> Result<Effect, Mistake> {
    let target = check_target(&effect.target, model, definition)?;
    let constant = matches!(effect.law, LawKind::Constant);
    if matches!(effect.law, LawKind::Step | LawKind::Lagged) {
        let message = format!(
            "the law {} needs the history of what came before, which an assessment does not have: use another",
            effect.law.name()
        );
        return Err(("law", message));
    }
    if !constant && matches!(target, Target::Oscillator(_) | Target::ModeOrder(_)) {
        return Err(("law", "an oscillator and an order of modes are constant".to_owned()));
    }
    let covariate = effect.covariate.as_ref();
    let declared = covariate.map(|name| covariates.iter().find(|c| c.name == *name));
    match (constant, declared) {
        (true, None) => {}
        (true, Some(_)) => return Err(("covariate", "a constant has no covariate".to_owned())),
        (false, None) => return Err(("covariate", format!("the law {} needs a covariate", effect.law.name()))),
        (false, Some(None)) => {
            let name = covariate.map_or_else(String::new, |name| shown(name));
            return Err(("covariate", format!("there is no [[covariate]] {name}")));
        }
        (false, Some(Some(declared))) => {
            let wanted = if effect.law == LawKind::Category { CovariateKind::Category } else { CovariateKind::Number };
            if declared.kind != wanted {
                return Err((
                    "covariate",
                    format!("the law {} takes a covariate of the other kind", effect.law.name()),
                ));
            }
        }
    }
    let category = effect.law == LawKind::Category;
    let levels = if category { effect.numbers.keys().cloned().collect() } else { Vec::new() };
    let with_level = effect.numbers.contains_key("level") && effect.law.has_level();
    let law =
        Law { kind: effect.law, covariate: effect.covariate.clone(), reference: effect.reference, with_level, levels };
    let mut wanted = if matches!(target, Target::ModeOrder(_)) { Vec::new() } else { law.numbers() };
    if matches!(target, Target::Oscillator(_)) {
        wanted.push("frequency_hz".to_owned());
    }
    let given: Vec<&String> = effect.numbers.keys().collect();
    let mut sorted = wanted.clone();
    sorted.sort();
    if given != sorted.iter().collect::<Vec<_>>() || (category && given.is_empty()) {
        let message = format!("the numbers of this effect are {}; \"level\" may be left out", wanted.join(", "));
        return Err(("numbers", message));
    }
    if let Some((name, value)) = effect.numbers.iter().find(|(_, v)| !v.is_finite()) {
        return Err(("numbers", format!("{name} is {value}: it must be finite")));
    }
    let seen = check_seen(effect, category || constant)?;
    let place = |name: &String| given.iter().position(|g| *g == name).unwrap_or_default();
    let factor = check_covariance(effect, &wanted.iter().map(place).collect::<Vec<_>>())?;
    let psi = wanted.iter().map(|name| effect.numbers[name]).collect();
    if !law.reference.is_finite() {
        return Err(("reference", format!("{} must be finite", law.reference)));
    }
    Ok(Effect { name: effect.name.clone(), target, law, psi, factor, seen })
}

fn check_seen(effect: &EffectDefinition, none: bool) -> Result<Vec<f64>, Mistake> {
    let seen = &effect.seen;
    if none {
        let message = || "only a numeric covariate has values that were seen".to_owned();
        return if seen.is_empty() { Ok(Vec::new()) } else { Err(("seen", message())) };
    }
    let ascending = seen.windows(2).all(|w| w[0] <= w[1]) && seen.iter().all(|v| v.is_finite());
    let wide = seen.len() >= 2 && seen[0] < seen[seen.len() - 1];
    if !(ascending && wide) {
        let message = "at least two finite values of the covariate, ascending: what the effect was learnt from";
        return Err(("seen", message.to_owned()));
    }
    Ok(seen.clone())
}

/// Lower factor of the covariance, reordered by `order`.
fn check_covariance(effect: &EffectDefinition, order: &[usize]) -> Result<Option<DMatrix<f64>>, Mistake> {
    let rows = &effect.covariance;
    let n = order.len();
    if rows.is_empty() {
        return Ok(None);
    }
    let wrong = || {
        (
            "covariance",
            format!("{n} rows of {n} finite numbers, positive semidefinite, in the order of the names of the numbers"),
        )
    };
    if rows.len() != n || rows.iter().any(|row| row.len() != n || row.iter().any(|v| !v.is_finite())) {
        return Err(wrong());
    }
    let matrix = DMatrix::from_fn(n, n, |i, j| rows[order[i]][order[j]]);
    // A number of the law may be far smaller than another: what counts are correlations.
    let scale: Vec<f64> = (0..n).map(|i| matrix[(i, i)].max(0.0).sqrt()).collect();
    let share = DMatrix::from_fn(n, n, |i, j| {
        let product = scale[i] * scale[j];
        let correlation = if product > 0.0 { matrix[(i, j)] / product } else { 0.0 };
        // A little on the diagonal: rounding in a file must not make a covariance negative.
        correlation + f64::from(u8::from(i == j)) * 1e-9
    });
    let zero_diagonal = (0..n).any(|i| matrix[(i, i)] < 0.0);
    let factor = share.cholesky().filter(|_| !zero_diagonal).ok_or_else(wrong)?.l();
    Ok(Some(DMatrix::from_fn(n, n, |i, j| scale[i] * factor[(i, j)])))
}

fn check_target(target: &TargetDefinition, model: &Model, definition: &StructureDefinition) -> Result<Target, Mistake> {
    let modes = definition.modes;
    let wrong = |message: String| ("target", message);
    let one_mode = |mode: usize| match mode {
        0 => Ok(None),
        mode if mode <= modes => Ok(Some(mode - 1)),
        _ => Err(wrong(format!("mode {mode}: the structure has {modes} modes; 0 stands for all"))),
    };
    let available = match model {
        Model::Matrices { structure, .. } => structure.freedoms(),
        Model::Table(table) => table.emulator().modes(),
    };
    match target {
        TargetDefinition::FrequencyScale(mode) => Ok(Target::FrequencyScale(one_mode(*mode)?)),
        TargetDefinition::FrequencyOffset(mode) => Ok(Target::FrequencyOffset(one_mode(*mode)?)),
        TargetDefinition::Parameter(name) => {
            let place = definition.parameters.iter().position(|p| p.name == *name);
            place.map(Target::ParameterScale).ok_or_else(|| wrong(format!("there is no parameter {}", shown(name))))
        }
        TargetDefinition::ModeOrder(order) => {
            let mut sorted = order.clone();
            sorted.sort_unstable();
            sorted.dedup();
            let valid =
                sorted.len() == modes && order.len() == modes && order.iter().all(|m| (1..=available).contains(m));
            if !valid {
                return Err(wrong(format!("{modes} different modes from 1 to {available}")));
            }
            Ok(Target::ModeOrder(order.iter().map(|m| m - 1).collect()))
        }
        _ => match model {
            Model::Matrices { structure, .. } => check_part(target, structure).map_err(wrong),
            Model::Table(_) => Err(wrong("a table has no springs and masses: name a parameter".to_owned())),
        },
    }
}

/// A target among the parts of a structure.
fn check_part(target: &TargetDefinition, structure: &Structure) -> Result<Target, String> {
    let mass = |name: &String| {
        let place = structure.masses().iter().position(|m| m.name == *name);
        place.ok_or_else(|| format!("there is no mass {}", shown(name)))
    };
    let spring = |name: &String| {
        let place = structure.springs().iter().position(|s| s.name == *name);
        place.ok_or_else(|| format!("there is no spring {}", shown(name)))
    };
    let freedom = |name: &String| {
        let place = structure.places().iter().find(|place| place.name == *name);
        place.map(|place| place.freedom).ok_or_else(|| format!("there is nothing {} to attach to", shown(name)))
    };
    let node = |name: &String| if name == "ground" { Ok(Node::Ground) } else { freedom(name).map(Node::Freedom) };
    let some = |count: usize| if count > 0 { Ok(()) } else { Err("name at least one".to_owned()) };
    match target {
        TargetDefinition::Springs(names) => {
            some(names.len())?;
            Ok(Target::Springs(names.iter().map(spring).collect::<Result<_, _>>()?))
        }
        TargetDefinition::Masses(names) => {
            some(names.len())?;
            Ok(Target::Masses(names.iter().map(mass).collect::<Result<_, _>>()?))
        }
        TargetDefinition::AddedSpring([a, b]) if a == b => Err("a spring from a node to itself".to_owned()),
        TargetDefinition::AddedSpring([a, b]) => Ok(Target::AddedSpring(node(a)?, node(b)?)),
        TargetDefinition::Oscillator(host) => Ok(Target::Oscillator(freedom(host)?)),
        TargetDefinition::FrequencyScale(_)
        | TargetDefinition::FrequencyOffset(_)
        | TargetDefinition::Parameter(_)
        | TargetDefinition::ModeOrder(_) => unreachable!("no part of a structure"),
    }
}

/// A target as a structure file writes it; `None` for a setting, which acts on what the experimenter says, not on the
/// structure.
pub fn target_definition(target: &Target, simulator: &Simulator) -> Option<TargetDefinition> {
    let structure = || simulator.structure().expect("only a structure has parts to name");
    let springs = |indices: &[usize]| indices.iter().map(|i| structure().springs()[*i].name.clone()).collect();
    let masses = |indices: &[usize]| indices.iter().map(|i| structure().masses()[*i].name.clone()).collect();
    let node = |node: Node| structure().node_name(node).to_owned();
    let parameter = |column: usize| simulator.space().as_slice()[column].name.clone();
    let mode = |mode: &Option<usize>| mode.map_or(0, |m| m + 1);
    match target {
        Target::Springs(indices) => Some(TargetDefinition::Springs(springs(indices))),
        Target::Masses(indices) => Some(TargetDefinition::Masses(masses(indices))),
        Target::FrequencyScale(m) => Some(TargetDefinition::FrequencyScale(mode(m))),
        Target::FrequencyOffset(m) => Some(TargetDefinition::FrequencyOffset(mode(m))),
        Target::AddedSpring(a, b) => Some(TargetDefinition::AddedSpring([node(*a), node(*b)])),
        Target::Oscillator(host) => Some(TargetDefinition::Oscillator(node(Node::Freedom(*host)))),
        Target::ModeOrder(order) => Some(TargetDefinition::ModeOrder(order.iter().map(|m| m + 1).collect())),
        Target::ParameterScale(column) => Some(TargetDefinition::Parameter(parameter(*column))),
        Target::SettingOffset(_) | Target::SettingScale(_) => None,
    }
}
