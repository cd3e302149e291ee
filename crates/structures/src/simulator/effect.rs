//! Effects of a structure file: their checks, and their sizes under measured covariates.

use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::{DMatrix, DVector};
use rand::Rng as _;
use rand_distr::StandardNormal;

use super::definition::{DefinitionProblem, EffectDefinition, StructureDefinition, TargetDefinition};
use super::law::{Input, Law, LawKind};
use super::model::SimulationModel;
use crate::measurement::{Covariate, CovariateKind, CovariateValue};
use crate::parameter::ParameterSpace;
use crate::physics::deviation::{Deviation, DeviationKind};
use crate::physics::effect::Target;
use crate::physics::{Node, Structure};
use crate::quantity::shown;
use crate::stats::Stream;

/// Margin around the values of a covariate that an effect was fitted to, as a share of their range. A value beyond this margin is
/// clamped to it and reported.
const BEYOND: f64 = 0.1;

/// A checked effect of a structure file.
#[derive(Debug, Clone)]
pub struct SimulationEffect {
    /// Its unique name.
    pub name: String,
    /// What changes.
    pub target: Target,
    /// Size of the change as a function of the covariate.
    pub law: Law,
    /// Means of the coefficients ψ, in the order of the law; for an oscillator followed by its frequency, Hz.
    pub psi: Vec<f64>,
    /// Cholesky factor of the covariance of the coefficients; `None` if they are exact.
    factor: Option<DMatrix<f64>>,
    /// Values of a numeric covariate that the effect was fitted to, ascending.
    seen: Vec<f64>,
}

/// Sizes of the effects of one measurement.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Sizes {
    /// Sizes of all effects in the order of the effects, each in the unit of its target, `[sizes]`.
    pub values: Vec<f64>,
    /// Covariates that an effect needs but that are missing in the measurement.
    pub missing: Vec<String>,
    /// Covariates whose value lies outside the range that an effect was fitted to.
    pub beyond: Vec<String>,
}

impl SimulationEffect {
    /// Whether the effect depends on a covariate, so that a flow must be conditioned on its size.
    pub fn varies(&self) -> bool {
        self.law.covariate.is_some()
    }

    /// Standard deviation of each coefficient of the law, in the unit of the coefficient, `[ψ]`; 0 if it is exact.
    pub fn psi_std(&self) -> Vec<f64> {
        let of = |i: usize| self.factor.as_ref().map_or(0.0, |factor| factor.row(i).norm());
        (0..self.psi.len()).map(of).collect()
    }

    /// Sizes at one value of the covariate with the coefficients `psi`.
    fn sizes_at(&self, input: Input, psi: &[f64]) -> Vec<f64> {
        match self.target {
            Target::ModeOrder(_) => Vec::new(),
            Target::Oscillator(_) => psi.to_vec(),
            _ => vec![self.law.size(input, psi, &mut vec![0.0; psi.len()])],
        }
    }

    /// Sizes of this effect at one value of the covariate with the mean coefficients, in the unit of the target,
    /// `[target.sizes()]`.
    pub fn sizes(&self, input: Input) -> Vec<f64> {
        self.sizes_at(input, &self.psi)
    }

    /// The values of the covariate over which the effect is marginalised if the covariate is missing: those that the effect was
    /// fitted to.
    pub fn inputs_seen(&self) -> Vec<Input> {
        if self.law.covariate.is_none() {
            return vec![Input::Number(0.0)];
        }
        if self.law.kind == LawKind::Category {
            return (0..self.law.levels.len()).map(|l| Input::Level(Some(l))).chain([Input::Level(None)]).collect();
        }
        self.seen.iter().map(|v| Input::Number(*v)).collect()
    }

    /// As [`Self::sizes`], with coefficients drawn from their normal distribution.
    pub fn draw_sizes(&self, input: Input, stream: &mut Stream) -> Vec<f64> {
        let Some(factor) = &self.factor else { return self.sizes(input) };
        let normal = DVector::from_fn(self.psi.len(), |_, _| stream.sample::<f64, _>(StandardNormal));
        let psi = DVector::from_column_slice(&self.psi) + factor * normal;
        self.sizes_at(input, psi.as_slice())
    }

    /// The covariate of a measurement as an input of the law, clamped to the range that the effect was fitted to; and whether it
    /// lies outside this range.
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
                // A faulty sensor that reports 9999 must not lead to a structure without stiffness.
                let within = value.clamp(low - margin, high + margin);
                (Input::Number(within), !(low - margin..=high + margin).contains(value))
            }
        }
    }
}

/// Sizes of all effects under the covariates of a measurement, `[sizes]`. An effect whose covariate is missing has the mean of
/// its sizes over the values that it was fitted to.
pub fn sizes(effects: &[SimulationEffect], covariates: &BTreeMap<String, CovariateValue>) -> Sizes {
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

/// Sizes of all effects, one entry `[sizes]` for each value that the missing covariates of a measurement can have. Empty if none
/// is missing.
pub fn marginalised_sizes(
    effects: &[SimulationEffect],
    covariates: &BTreeMap<String, CovariateValue>,
) -> Vec<Vec<f64>> {
    let missing = |e: &&SimulationEffect| e.law.covariate.as_ref().is_some_and(|name| !covariates.contains_key(name));
    let count = effects.iter().filter(missing).map(|e| e.inputs_seen().len()).max().unwrap_or(0);
    let at = |step: usize| -> Vec<f64> {
        let one = |effect: &SimulationEffect| match effect.input(covariates) {
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

/// Draws the value of every covariate that an effect depends on, by its name, for training. Numbers are uniform in the range
/// that the effects were fitted to, with a margin. Categories are equally probable; all categories without a coefficient are
/// treated as one.
pub fn draw_covariates(effects: &[SimulationEffect], stream: &mut Stream) -> BTreeMap<String, CovariateValue> {
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

/// Sizes of all effects under given covariates, `[sizes]`, with coefficients drawn from their normal distributions.
pub fn draw_sizes(
    effects: &[SimulationEffect],
    covariates: &BTreeMap<String, CovariateValue>,
    stream: &mut Stream,
) -> Vec<f64> {
    effects.iter().flat_map(|effect| effect.draw_sizes(effect.input(covariates).0, stream)).collect()
}

/// Mean sizes of all effects over the covariate values that they were fitted to, `[sizes]`.
pub fn typical_sizes(effects: &[SimulationEffect]) -> Vec<f64> {
    effects.iter().flat_map(mean_sizes).collect()
}

/// Mean sizes of one effect over the covariate values that it was fitted to, `[target.sizes()]`.
fn mean_sizes(effect: &SimulationEffect) -> Vec<f64> {
    let all: Vec<Vec<f64>> = effect.inputs_seen().into_iter().map(|input| effect.sizes(input)).collect();
    (0..effect.target.sizes()).map(|i| all.iter().map(|s| s[i]).sum::<f64>() / all.len() as f64).collect()
}

/// Checks the effects of a definition whose other sections have no mistakes.
pub(super) fn check(
    definition: &StructureDefinition,
    (model, nominal_hz): (&SimulationModel, &[f64]),
    covariates: &[Covariate],
    problems: &mut Vec<DefinitionProblem>,
) -> Vec<SimulationEffect> {
    let one = |(index, effect): (usize, &EffectDefinition)| {
        check_one(definition, effect, (model, nominal_hz), covariates)
            .map_err(|(key, message)| problems.push(DefinitionProblem::new(format!("/effect/{index}/{key}"), message)))
            .ok()
    };
    definition.effects.iter().enumerate().filter_map(one).collect()
}

/// The key of the effect definition that contains a mistake, and the error message.
type Mistake = (&'static str, String);

/// Why a law occurs in diagnoses only; `None` for one that an effect of a file may have.
fn only_of_diagnoses(law: LawKind) -> Option<String> {
    match law {
        LawKind::Step | LawKind::Lagged => Some(format!(
            "the law {} needs the history of its covariate, which an assessment does not have: use another law",
            law.name()
        )),
        LawKind::Cycle => Some(
            "the law cycle follows the time, which an assessment does not use: record what varies with it".to_owned(),
        ),
        LawKind::Product => {
            Some("the law product needs two covariates, and an effect has one: use another law".to_owned())
        }
        _ => None,
    }
}

/// Checks one effect and builds it; the error names the key that is wrong.
fn check_one(
    definition: &StructureDefinition,
    effect: &EffectDefinition,
    simulation: (&SimulationModel, &[f64]),
    covariates: &[Covariate],
) -> Result<SimulationEffect, Mistake> {
    let target = check_target(&effect.target, simulation, definition)?;
    let constant = matches!(effect.law, LawKind::Constant);
    if let Some(message) = only_of_diagnoses(effect.law) {
        return Err(("law", message));
    }
    if !constant && matches!(target, Target::Oscillator(_) | Target::ModeOrder(_)) {
        return Err(("law", "the targets oscillator and mode_order need the law constant".to_owned()));
    }
    let covariate = effect.covariate.as_ref();
    let declared = covariate.map(|name| covariates.iter().find(|c| c.name == *name));
    match (constant, declared) {
        (true, None) => {}
        (true, Some(_)) => return Err(("covariate", "the law constant takes no covariate: remove it".to_owned())),
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
                    format!(
                        "the law {} needs a covariate of kind {}",
                        effect.law.name(),
                        if effect.law == LawKind::Category { "category" } else { "number" }
                    ),
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
        let message = if category {
            "a law by category needs one number for each category that has an effect".to_owned()
        } else {
            format!("the numbers of this effect must be {}; \"level\" is optional", wanted.join(", "))
        };
        return Err(("numbers", message));
    }
    if let Some((name, value)) = effect.numbers.iter().find(|(_, v)| !v.is_finite()) {
        return Err(("numbers", format!("{name} is {value}: it must be finite")));
    }
    let seen = check_seen(effect, category || constant)?;
    let position = |name: &String| given.iter().position(|g| *g == name).unwrap_or_default();
    let factor = check_covariance(effect, &wanted.iter().map(position).collect::<Vec<_>>())?;
    let psi = wanted.iter().map(|name| effect.numbers[name]).collect();
    if !law.reference.is_finite() {
        return Err(("reference", format!("a reference of {} is not valid: it must be finite", law.reference)));
    }
    Ok(SimulationEffect { name: effect.name.clone(), target, law, psi, factor, seen })
}

/// Checks the key `seen`, the covariate values that the effect was fitted to. `must_be_absent`: the law has no numeric covariate.
fn check_seen(effect: &EffectDefinition, must_be_absent: bool) -> Result<Vec<f64>, Mistake> {
    let seen = &effect.seen;
    if must_be_absent {
        let message = || "only an effect of a numeric covariate has the key seen: remove it".to_owned();
        return if seen.is_empty() { Ok(Vec::new()) } else { Err(("seen", message())) };
    }
    let ascending = seen.windows(2).all(|w| w[0] <= w[1]) && seen.iter().all(|v| v.is_finite());
    let wide = seen.len() >= 2 && seen[0] < seen[seen.len() - 1];
    if !(ascending && wide) {
        let message = "seen must list at least two different finite values of the covariate in ascending order: those that the effect was fitted to";
        return Err(("seen", message.to_owned()));
    }
    Ok(seen.clone())
}

/// Cholesky factor of the covariance of the coefficients, with its rows reordered by `order`; `None` without a covariance.
fn check_covariance(effect: &EffectDefinition, order: &[usize]) -> Result<Option<DMatrix<f64>>, Mistake> {
    let rows = &effect.covariance;
    let n = order.len();
    if rows.is_empty() {
        return Ok(None);
    }
    let wrong = || {
        (
            "covariance",
            format!("the covariance must have {n} rows of {n} finite numbers, ordered by the names of the numbers, and be positive semidefinite"),
        )
    };
    if rows.len() != n || rows.iter().any(|row| row.len() != n || row.iter().any(|v| !v.is_finite())) {
        return Err(wrong());
    }
    let matrix = DMatrix::from_fn(n, n, |i, j| rows[order[i]][order[j]]);
    // The coefficients of a law can differ by orders of magnitude, so that correlations are factorised.
    let scale: Vec<f64> = (0..n).map(|i| matrix[(i, i)].max(0.0).sqrt()).collect();
    let share = DMatrix::from_fn(n, n, |i, j| {
        let product = scale[i] * scale[j];
        let correlation = if product > 0.0 { matrix[(i, j)] / product } else { 0.0 };
        // A small addition to the diagonal keeps the matrix positive definite despite the rounding of numbers in a file.
        correlation + f64::from(u8::from(i == j)) * 1e-9
    });
    let zero_diagonal = (0..n).any(|i| matrix[(i, i)] < 0.0);
    let factor = share.cholesky().filter(|_| !zero_diagonal).ok_or_else(wrong)?.l();
    Ok(Some(DMatrix::from_fn(n, n, |i, j| scale[i] * factor[(i, j)])))
}

/// Checks the target of an effect. `nominal_hz`: nominal frequencies of the measured modes, Hz, `[m]`.
fn check_target(
    target: &TargetDefinition,
    (model, nominal_hz): (&SimulationModel, &[f64]),
    definition: &StructureDefinition,
) -> Result<Target, Mistake> {
    let modes = definition.modes;
    let wrong = |message: String| ("target", message);
    let one_mode = |mode: usize| match mode {
        0 => Ok(None),
        mode if mode <= modes => Ok(Some(mode - 1)),
        _ => Err(wrong(format!("mode {mode}: the structure has {modes} modes; 0 means all of them"))),
    };
    let parameter = |name: &String| {
        let column = definition.parameters.iter().position(|p| p.name == *name);
        column.ok_or_else(|| wrong(format!("there is no parameter {}", shown(name))))
    };
    let available = model.available_modes();
    match target {
        TargetDefinition::FrequencyScale(mode) => Ok(Target::FrequencyScale(one_mode(*mode)?)),
        TargetDefinition::FrequencyOffset(mode) => Ok(Target::FrequencyOffset(one_mode(*mode)?)),
        TargetDefinition::Parameter(name) => parameter(name).map(Target::ParameterScale),
        TargetDefinition::ParameterOffset(name) => parameter(name).map(Target::ParameterOffset),
        TargetDefinition::ModeOrder(order) => {
            let mut sorted = order.clone();
            sorted.sort_unstable();
            sorted.dedup();
            let valid =
                sorted.len() == modes && order.len() == modes && order.iter().all(|m| (1..=available).contains(m));
            if !valid {
                return Err(wrong(format!("mode_order must list {modes} different modes from 1 to {available}")));
            }
            Ok(Target::ModeOrder(order.iter().map(|m| m - 1).collect()))
        }
        TargetDefinition::Deviation(DeviationKind::Calibration) => {
            let curve = Deviation::of_instrument(nominal_hz);
            curve
                .map(|curve| Target::Deviation(Arc::new(curve)))
                .ok_or_else(|| wrong(cannot_deviate(DeviationKind::Calibration)))
        }
        _ => match model {
            SimulationModel::Matrices(matrices) => check_part(target, &matrices.structure).map_err(wrong),
            SimulationModel::Table(_) => {
                Err(wrong("a simulation \"table\" has no springs or masses: name a parameter as the target".to_owned()))
            }
        },
    }
}

/// Why a structure cannot deviate in this way.
pub(super) fn cannot_deviate(kind: DeviationKind) -> String {
    format!("the deviation \"{}\" needs {}", kind.name(), kind.needs())
}

/// Checks a target that is a part of a structure.
fn check_part(target: &TargetDefinition, structure: &Structure) -> Result<Target, String> {
    let mass = |name: &String| {
        let index = structure.masses().iter().position(|m| m.name == *name);
        index.ok_or_else(|| format!("there is no mass {}", shown(name)))
    };
    let spring = |name: &String| {
        let index = structure.springs().iter().position(|s| s.name == *name);
        index.ok_or_else(|| format!("there is no spring {}", shown(name)))
    };
    let dof = |name: &String| {
        let point = structure.attachment_points().iter().find(|point| point.name == *name);
        point
            .map(|point| point.dof)
            .ok_or_else(|| format!("there is no mass or free node {} to attach to", shown(name)))
    };
    let node = |name: &String| if name == "ground" { Ok(Node::Ground) } else { dof(name).map(Node::Dof) };
    let not_empty = |count: usize| if count > 0 { Ok(()) } else { Err("name at least one spring or mass".to_owned()) };
    match target {
        TargetDefinition::Springs(names) => {
            not_empty(names.len())?;
            Ok(Target::Springs(names.iter().map(spring).collect::<Result<_, _>>()?))
        }
        TargetDefinition::Masses(names) => {
            not_empty(names.len())?;
            Ok(Target::Masses(names.iter().map(mass).collect::<Result<_, _>>()?))
        }
        TargetDefinition::AddedSpring([a, b]) if a == b => {
            Err("the added spring goes from a node to itself: name two different nodes".to_owned())
        }
        TargetDefinition::AddedSpring([a, b]) => Ok(Target::AddedSpring(node(a)?, node(b)?)),
        TargetDefinition::Oscillator(host) => Ok(Target::Oscillator(dof(host)?)),
        TargetDefinition::Deviation(kind) => {
            let deviation = Deviation::new(structure, *kind).ok_or_else(|| cannot_deviate(*kind))?;
            Ok(Target::Deviation(Arc::new(deviation)))
        }
        TargetDefinition::FrequencyScale(_)
        | TargetDefinition::FrequencyOffset(_)
        | TargetDefinition::Parameter(_)
        | TargetDefinition::ParameterOffset(_)
        | TargetDefinition::ModeOrder(_) => {
            unreachable!("check_target handles targets that are not parts of a structure")
        }
    }
}

/// A target as it is written in a structure file. `None` for a setting, which is not part of the structure, and for the gain of
/// a mode, which concerns settings only.
///
/// # Panics
/// If the target acts on a spring or mass and `structure` is `None`, as for a table: a programming error in the caller.
pub fn target_definition(
    target: &Target,
    structure: Option<&Structure>,
    space: &ParameterSpace,
) -> Option<TargetDefinition> {
    let structure = || structure.expect("only a structure has parts");
    let springs = |indices: &[usize]| indices.iter().map(|i| structure().springs()[*i].name.clone()).collect();
    let masses = |indices: &[usize]| indices.iter().map(|i| structure().masses()[*i].name.clone()).collect();
    let node = |node: Node| structure().node_name(node).to_owned();
    let parameter = |column: usize| space.as_slice()[column].name.clone();
    let mode = |mode: &Option<usize>| mode.map_or(0, |m| m + 1);
    match target {
        Target::Springs(indices) => Some(TargetDefinition::Springs(springs(indices))),
        Target::Masses(indices) => Some(TargetDefinition::Masses(masses(indices))),
        Target::FrequencyScale(m) => Some(TargetDefinition::FrequencyScale(mode(m))),
        Target::FrequencyOffset(m) => Some(TargetDefinition::FrequencyOffset(mode(m))),
        Target::AddedSpring(a, b) => Some(TargetDefinition::AddedSpring([node(*a), node(*b)])),
        Target::Oscillator(host) => Some(TargetDefinition::Oscillator(node(Node::Dof(*host)))),
        Target::ModeOrder(order) => Some(TargetDefinition::ModeOrder(order.iter().map(|m| m + 1).collect())),
        Target::Deviation(deviation) => Some(TargetDefinition::Deviation(deviation.kind)),
        Target::ParameterScale(column) => Some(TargetDefinition::Parameter(parameter(*column))),
        Target::ParameterOffset(column) => Some(TargetDefinition::ParameterOffset(parameter(*column))),
        _ => None,
    }
}
