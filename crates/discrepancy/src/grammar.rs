//! The candidates: every combination of a target and a covariate, and the laws that each can follow.

use std::collections::BTreeSet;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::data::{Column, Data, Origin, Values, MOST_LEVELS, TIME};
use super::effect::{is_factor, FittedEffect, Number};
use super::missing_springs::{missing_springs, translational_n_per_m};
use super::setting_candidates::{beyond_prior, gain_numbers, setting_targets, sum_of_ends};
use structures::physics::deviation::{Deviation, DeviationKind};
use structures::physics::effect::Target;
use structures::physics::Structure;
use structures::simulator::law::{Law, LawKind};
use structures::simulator::Simulator;
use structures::stats;

/// The kind of a cause, which determines its prior probability and what should be done about it.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(as = CauseClass)]
pub enum Class {
    /// An environmental or operational condition, such as temperature, moisture or load.
    Environment,
    /// A fault of the measuring chain.
    Instrument,
    /// The person, the procedure or the settings of the test.
    SetUp,
    /// The simulation describes the structure wrongly.
    Structure,
    /// The structure has changed with time.
    PossibleDamage,
    /// The structure has become stiffer with time.
    Rise,
}

impl Class {
    /// Whether the structure has changed with time, which is not compensated.
    pub const fn is_change(self) -> bool {
        matches!(self, Self::PossibleDamage | Self::Rise)
    }

    /// Its name in words.
    pub const fn in_words(self) -> &'static str {
        match self {
            Self::Environment => "environment",
            Self::Instrument => "instrument",
            Self::SetUp => "set-up",
            Self::Structure => "structure",
            Self::PossibleDamage => "possible damage",
            Self::Rise => "rise of a stiffness",
        }
    }
}

/// A possible cause: a target and the covariate that it depends on. It can follow one of several laws.
#[derive(Debug, Clone, PartialEq)]
pub struct Candidate {
    /// What changes.
    pub target: Target,
    /// The covariate that it depends on; `None` for a constant.
    pub covariate: Option<String>,
    /// The category that differs; `None` for a numeric covariate, or if each category has its own number.
    pub level: Option<String>,
    /// Kind of cause.
    pub class: Class,
    /// For a target of springs or masses, the number of springs or masses in the structure; otherwise 0.
    pub of: usize,
    /// Prior probability among the candidates. Those of different candidates differ by a factor of a few only.
    pub weight: f64,
}

/// Prior probability that the simulation is off everywhere by a little, among all candidates. No other error of a simulation is as common.
const EVERYWHERE: f64 = 0.35;

/// Prior probability of each deviation that is in no single part, and that of a curved calibration, which is rarer.
const DEVIATION: f64 = 0.04;
const CALIBRATION: f64 = 0.01;

/// Prior probability of a swing with the time of day or year relative to that of a dependence on a quantity that was recorded, which explains
/// a swing better if it takes part in it.
const CYCLE: f64 = 0.2;

/// All candidates for a structure and the rows with the indices `rows` of its data; their prior probabilities sum to 1.
pub fn candidates(simulator: &Simulator, data: &Data, rows: &[usize]) -> Vec<Candidate> {
    let mut all = Vec::new();
    let deviations = deviations(simulator);
    let varying = deviations.iter().filter(|target| can_vary(target)).cloned();
    for target in targets(simulator, data).into_iter().chain(varying) {
        let mut add = |covariate: Option<&str>, level: Option<&str>| {
            let (class, mut weight) = plausibility(&target, covariate, is_category(data, covariate));
            if covariate.and_then(|c| data.column(c)).is_some_and(|column| column.origin.cycle().is_some()) {
                weight *= CYCLE;
            }
            let (covariate, level) = (covariate.map(str::to_owned), level.map(str::to_owned));
            let of = match &target {
                Target::Springs(_) => simulator.structure().map_or(0, |s| s.springs().len()),
                Target::Masses(_) => simulator.structure().map_or(0, |s| s.masses().len()),
                _ => 0,
            };
            all.push(Candidate { target: target.clone(), covariate, level, class, of, weight });
        };
        if !can_vary(&target) && !absorbed(simulator, data, &target) {
            add(None, None);
        }
        for column in data.columns.iter().filter(|column| can_depend(&target, column)) {
            match &column.values {
                Values::Numbers(_) => {
                    if spread(column, rows) > 0.0 {
                        add(Some(&column.name), None);
                    }
                }
                Values::Categories(names, indices) => {
                    let used: BTreeSet<usize> = rows.iter().filter_map(|r| indices[*r]).collect();
                    if used.len() < 2 || used.len() > MOST_LEVELS {
                        continue;
                    }
                    // With two categories, only the difference between them matters: the alphabetically later one is used.
                    let skipped = usize::from(used.len() == 2);
                    for level in used.iter().skip(skipped) {
                        add(Some(&column.name), Some(&names[*level]));
                    }
                    if used.len() > 2 && !target.is_switch() {
                        add(Some(&column.name), None);
                    }
                }
            }
        }
    }
    let deviations: Vec<Target> = deviations.into_iter().filter(|target| !absorbed(simulator, data, target)).collect();
    let share = |target: &Target| if target.is_of_instrument() { CALIBRATION } else { DEVIATION };
    let of_deviations: f64 = deviations.iter().map(share).sum();
    let total: f64 = all.iter().map(|c| c.weight).sum();
    for candidate in &mut all {
        candidate.weight *= (1.0 - EVERYWHERE - of_deviations) / total;
    }
    let whole = |target: Target, weight: f64| {
        let class = if target.is_of_instrument() { Class::Instrument } else { Class::Structure };
        Candidate { target, covariate: None, level: None, class, of: 0, weight }
    };
    all.extend(deviations.into_iter().map(|target| whole(target.clone(), share(&target))));
    all.push(whole(Target::Everywhere(Vec::new()), EVERYWHERE));
    all
}

/// The deviations that are in no single part, and the curve of calibration of the instrument.
fn deviations(simulator: &Simulator) -> Vec<Target> {
    let deviation = |kind: DeviationKind| Deviation::new(simulator.structure()?, kind);
    let of_structure = DeviationKind::OF_A_STRUCTURE.into_iter().filter_map(deviation);
    let curve = Deviation::of_instrument(&simulator.nominal_frequencies_hz());
    of_structure.chain(curve).map(Arc::new).map(Target::Deviation).collect()
}

/// Whether a target is a deviation that can vary while the structure stands.
fn can_vary(target: &Target) -> bool {
    matches!(target, Target::Deviation(deviation) if deviation.kind.can_vary())
}

/// Whether a parameter that is set in no row is this constant change, of masses or a deviation; or a constant change of a group of springs is
/// that of a single other spring, of those that no parameter sets, or none, because such parameters take the other springs of the group to any
/// stiffness.
fn absorbed(simulator: &Simulator, data: &Data, target: &Target) -> bool {
    let never_set = |parameter: usize| data.settings.iter().all(|row| row[parameter].is_none());
    let Target::Springs(group) = target else { return simulator.own_parameter_of(target).is_some_and(never_set) };
    let free = |spring: &usize| simulator.own_parameter(*spring).is_some_and(never_set);
    let alone = group.len() > 1 && group.iter().filter(|spring| !free(spring)).count() <= 1;
    let all = simulator.structure().is_some_and(|structure| structure.springs().len() == group.len());
    let all_but_unset = || (0..simulator.space().len()).all(never_set) && !simulator.unset_springs().is_empty();
    alone || all && all_but_unset()
}

fn is_category(data: &Data, covariate: Option<&str>) -> bool {
    covariate.and_then(|c| data.column(c)).is_some_and(|c| matches!(c.values, Values::Categories(..)))
}

/// Whether a target can depend on a column. Oscillators and orders of modes are constant; corrections of settings differ between
/// categories or change at a time, and a correction that depended on the setting would be another correction.
fn can_depend(target: &Target, column: &Column) -> bool {
    let measured = matches!(column.origin, Origin::Covariate | Origin::Time | Origin::Cycle(_));
    let category = matches!(column.values, Values::Categories(..));
    match target {
        Target::Oscillator(_) | Target::ModeOrder(_) | Target::ModeGain { .. } | Target::InMode(..) => false,
        target if target.is_switch() => category || column.origin == Origin::Time,
        Target::FrequencyOffset(_) => measured,
        target => measured || target.settings().is_empty(),
    }
}

/// Standard deviations of the two factors of a product, in their units; 1 for any other column.
fn factor_widths(data: &Data, rows: &[usize], column: Option<&Column>) -> (f64, f64) {
    let Some(Origin::Product(first, second)) = column.map(|column| column.origin) else { return (1.0, 1.0) };
    let width = |index: usize| spread(&data.columns[index], rows).max(f64::MIN_POSITIVE);
    (width(first), width(second))
}

/// Every target that could change.
fn targets(simulator: &Simulator, data: &Data) -> Vec<Target> {
    let modes = simulator.modes();
    let mut targets = simulator.structure().map_or_else(Vec::new, |structure| part_targets(simulator, structure));
    if simulator.table().is_some() {
        // An emulator has no springs: the parameters represent their stiffness.
        // A parameter that is set in every row has targets of its own.
        let free = |column: &usize| data.settings.iter().any(|row| row[*column].is_none());
        targets.extend((0..simulator.space().len()).filter(free).map(|column| {
            let share = simulator.space().as_slice()[column].has_share();
            if share {
                Target::ParameterScale(column)
            } else {
                Target::ParameterOffset(column)
            }
        }));
    }
    targets.extend([Target::FrequencyScale(None), Target::FrequencyOffset(None)]);
    if modes > 1 {
        targets.extend((0..modes).flat_map(|m| [Target::FrequencyScale(Some(m)), Target::FrequencyOffset(Some(m))]));
    }
    targets.extend(setting_targets(simulator, data));
    if let Some(structure) = simulator.structure() {
        targets.extend(missing_springs(structure).into_iter().map(|(from, to)| Target::AddedSpring(from, to)));
        targets.extend(structure.attachment_points().iter().map(|point| Target::Oscillator(point.dof)));
    }
    // A mode that was not identified, or two neighbouring modes that were interchanged.
    if simulator.available_modes() > modes {
        let skipping = |skipped: usize| (0..modes).map(|m| m + usize::from(m >= skipped)).collect();
        targets.extend((0..modes).map(|skipped| Target::ModeOrder(skipping(skipped))));
    }
    for low in 0..modes.saturating_sub(1) {
        let mut order: Vec<usize> = (0..modes).collect();
        order.swap(low, low + 1);
        targets.push(Target::ModeOrder(order));
    }
    targets
}

/// Springs and masses, individually and in groups.
fn part_targets(simulator: &Simulator, structure: &Structure) -> Vec<Target> {
    let (springs, masses) = (structure.springs().len(), structure.masses().len());
    let mut targets: Vec<Target> = (0..springs).map(|s| Target::Springs(vec![s])).collect();
    let all = (0..springs).collect::<Vec<usize>>();
    let further = [simulator.unset_springs(), all].into_iter().filter(|group| !group.is_empty());
    for mut group in simulator.spring_groups().into_iter().map(|(_, group)| group).chain(further) {
        group.sort_unstable();
        let target = Target::Springs(group);
        if !targets.contains(&target) {
            targets.push(target);
        }
    }
    targets.extend((0..masses).map(|m| Target::Masses(vec![m])));
    let all = (masses > 1).then(|| (0..masses).collect());
    for mut group in simulator.mass_groups().into_iter().map(|(_, group)| group).chain(all) {
        group.sort_unstable();
        let target = Target::Masses(group);
        if !targets.contains(&target) {
            targets.push(target);
        }
    }
    targets
}

/// Class and relative prior weight of a candidate. The weights differ by a factor of a few only, so that they rank candidates
/// that data cannot distinguish, but do not outweigh data.
fn plausibility(target: &Target, covariate: Option<&str>, category: bool) -> (Class, f64) {
    let time = covariate == Some(TIME);
    match target {
        Target::Springs(_) | Target::ParameterScale(_) | Target::ParameterOffset(_) | Target::AddedSpring(..) => {
            match covariate {
                _ if time => (Class::PossibleDamage, 1.0),
                Some(_) if category => (Class::SetUp, 0.5),
                Some(_) => (Class::Environment, if matches!(target, Target::AddedSpring(..)) { 0.3 } else { 1.0 }),
                None => (Class::Structure, 0.5),
            }
        }
        Target::Masses(_) => match covariate {
            _ if time => (Class::Structure, 0.4),
            Some(_) if category => (Class::SetUp, 0.5),
            Some(_) => (Class::Environment, 0.5),
            None => (Class::Structure, 0.5),
        },
        Target::FrequencyScale(mode) | Target::FrequencyOffset(mode) => {
            let one = if mode.is_some() { 0.2 } else { 1.0 };
            (Class::Instrument, if category || covariate.is_none() || time { one } else { 0.4 * one })
        }
        Target::InMode(..) => (Class::SetUp, 0.1),
        Target::ModeGain { .. } => (Class::Structure, 0.5),
        target if !target.settings().is_empty() => {
            (Class::SetUp, if category || covariate.is_none() { 1.0 } else { 0.3 })
        }
        Target::Oscillator(_) | Target::AddedMass(_) => (Class::Structure, 0.4),
        Target::Deviation(_) if time => (Class::PossibleDamage, 0.5),
        Target::Deviation(_) => (Class::Environment, 0.5),
        _ => (Class::SetUp, 0.5),
    }
}

/// Smallest and largest possible size of a constant effect.
fn possible_sizes(target: &Target) -> (f64, f64) {
    match target {
        // A spring that the structure has and the file lacks.
        Target::AddedSpring(..) => (0.0, f64::INFINITY),
        Target::Deviation(deviation) => deviation.kind.possible_sizes(),
        _ => (f64::NEG_INFINITY, f64::INFINITY),
    }
}

/// Standard deviation of a numeric covariate over the rows with the indices `rows`, in the unit of the covariate; 0 for a
/// constant.
pub fn spread(column: &Column, rows: &[usize]) -> f64 {
    let numbers = column.numbers(rows);
    let std = stats::sample_std(&numbers).unwrap_or(0.0);
    let size = numbers.iter().fold(0.0, |a: f64, v| a.max(v.abs()));
    // Values that differ by rounding only are a constant.
    if std > 1e-9 * size {
        std
    } else {
        0.0
    }
}

impl Candidate {
    /// Whether it multiplies all frequencies by the same factor, as the stiffness of all springs, the mass of all bodies and the
    /// scale of the instrument do.
    pub fn acts_on_all(&self) -> bool {
        match &self.target {
            Target::Springs(indices) | Target::Masses(indices) => indices.len() == self.of,
            Target::FrequencyScale(mode) => mode.is_none(),
            _ => false,
        }
    }

    /// The covariate and the category that it depends on.
    pub fn input(&self) -> (Option<&str>, Option<&str>) {
        (self.covariate.as_deref(), self.level.as_deref())
    }

    /// The laws that it can follow.
    pub fn laws(&self, data: &Data) -> Vec<LawKind> {
        let Some(name) = &self.covariate else { return vec![LawKind::Constant] };
        if is_category(data, Some(name)) {
            return vec![LawKind::Category];
        }
        if self.target.is_switch() {
            return vec![LawKind::Step];
        }
        match data.column(name).map(|column| column.origin) {
            Some(Origin::Time) => return vec![LawKind::Step, LawKind::Linear],
            Some(Origin::Setting) => return vec![LawKind::Linear, LawKind::Quadratic],
            Some(Origin::Product(..)) => return vec![LawKind::Product],
            Some(Origin::Cycle(_)) => return vec![LawKind::Cycle],
            _ => {}
        }
        vec![LawKind::Linear, LawKind::Quadratic, LawKind::Bilinear, LawKind::Exponential, LawKind::Lagged]
    }

    /// Names of the categories that have a coefficient; the most frequent category in `rows` is the reference and has none.
    pub fn levels(&self, data: &Data, rows: &[usize]) -> Vec<String> {
        let column = self.covariate.as_deref().and_then(|name| data.column(name));
        let Some(Values::Categories(names, indices)) = column.map(|c| &c.values) else { return Vec::new() };
        if let Some(level) = &self.level {
            return vec![level.clone()];
        }
        let used: BTreeSet<usize> = rows.iter().filter_map(|r| indices[*r]).collect();
        let count = |l: &usize| rows.iter().filter(|r| indices[**r] == Some(*l)).count();
        let most = used.iter().copied().max_by_key(count);
        used.iter().filter(|l| Some(**l) != most).map(|l| names[*l].clone()).collect()
    }

    /// The effect under a law, with priors for its numbers that are scaled by the typical size of the target and by the standard
    /// deviation of the covariate. `step_days`: time of a step, days.
    pub fn effect(
        &self,
        simulator: &Simulator,
        data: &Data,
        rows: &[usize],
        kind: LawKind,
        with_level: bool,
        step_days: f64,
    ) -> FittedEffect {
        let column = self.covariate.as_deref().and_then(|c| data.column(c));
        let size = self.typical_size(simulator).max(beyond_prior(simulator, data, rows, &self.target));
        let mut levels = Vec::new();
        let mut reference = if kind == LawKind::Step { step_days } else { 0.0 };
        let mut width = 1.0;
        let mut range = (f64::NEG_INFINITY, f64::INFINITY);
        let mut middle = 0.0;
        if let Some(column) = column {
            match &column.values {
                Values::Categories(..) => {
                    levels = self.levels(data, rows);
                }
                Values::Numbers(_) => {
                    let numbers = column.numbers(rows);
                    width = spread(column, rows).max(f64::MIN_POSITIVE);
                    middle = stats::quantile(&numbers, 0.5);
                    range = (stats::quantile(&numbers, 0.03), stats::quantile(&numbers, 0.97));
                    if !matches!(kind, LawKind::Step | LawKind::Cycle) {
                        reference = stats::mean(&numbers);
                    }
                }
            }
        }
        let law = Law { kind, covariate: self.covariate.clone(), reference, with_level, levels };
        let span = data.times_days.last().copied().unwrap_or(0.0).max(1e-6);
        let free = (f64::NEG_INFINITY, f64::INFINITY);
        let factors = factor_widths(data, rows, column);
        let number = |name: String| {
            let (prior_mean, prior_std, bounds) = match name.as_str() {
                "slope_per_unit" if kind == LawKind::Product => (0.0, size / (2.0 * factors.0), free),
                "slope_per_unit" => (0.0, size / (2.0 * width), free),
                "slope_below_per_unit" | "slope_above_per_unit" => (0.0, size / width, free),
                "second_slope_per_unit" => (0.0, size / (2.0 * factors.1), free),
                "product_per_unit2" => (0.0, size / (4.0 * factors.0 * factors.1), free),
                "curvature_per_unit2" => (0.0, size / (2.0 * width).powi(2), free),
                "rate_per_unit" => (0.0, 1.0 / width, (-4.0 / width, 4.0 / width)),
                "knee" => (middle, width, range),
                "lag_days" => (span / 20.0, span / 10.0, (span / 2_000.0, span / 3.0)),
                "cosine" | "sine" => (0.0, size / 2.0, free),
                "size" if kind == LawKind::Constant => (0.0, size, possible_sizes(&self.target)),
                _ => (0.0, size, free),
            };
            let constant = name == "level" || kind == LawKind::Constant;
            let of_factor = constant && is_factor(&self.target);
            Number { name, prior_mean, prior_std, bounds, of_factor }
        };
        let mut numbers: Vec<Number> = match &self.target {
            Target::ModeOrder(_) => Vec::new(),
            Target::ModeGain { .. } => gain_numbers(),
            target if target.is_switch() => sum_of_ends(simulator, target, size).into_iter().collect(),
            _ => law.numbers().into_iter().map(number).collect(),
        };
        if let Target::Oscillator(_) = self.target {
            let f = simulator.nominal_frequencies_hz();
            let (low, high) = (0.3 * f[0], 2.0 * f[f.len() - 1]);
            numbers[0].bounds = (1e-4 * size, 20.0 * size);
            let (prior_mean, prior_std) = (f64::midpoint(low, high), 0.5 * (high - low));
            numbers.push(Number {
                name: "frequency_hz".to_owned(),
                prior_mean,
                prior_std,
                bounds: (low, high),
                of_factor: false,
            });
        }
        FittedEffect { target: self.target.clone(), law, numbers, mixture: None, onset90: None }
    }

    /// The size that such an effect typically has, in the unit of its target: the standard deviation of its prior.
    pub fn typical_size(&self, simulator: &Simulator) -> f64 {
        if let Some(column) = simulator.parameter_of_deviation(&self.target) {
            return 0.1 * simulator.space().as_slice()[column].at_level(0.5);
        }
        match &self.target {
            Target::Springs(_) | Target::Masses(_) | Target::ParameterScale(_) | Target::SettingScale(_) => 0.1,
            Target::FrequencyScale(_) => 0.01,
            Target::Deviation(deviation) => match deviation.kind {
                DeviationKind::SpreadMass => 0.5,
                // The force and the restraint have nearly the same frequencies, and the sizes that they usually have must not tell them apart.
                DeviationKind::Bending
                | DeviationKind::BaseRotation
                | DeviationKind::EndRestraint
                | DeviationKind::AxialForce => 0.3,
                DeviationKind::StiffnessGradient | DeviationKind::MassGradient => 0.2,
                DeviationKind::RotaryInertia | DeviationKind::Calibration => 0.02,
            },
            Target::FrequencyOffset(None) => 0.01 * simulator.nominal_frequencies_hz()[0],
            Target::FrequencyOffset(Some(mode)) => 0.01 * simulator.nominal_frequencies_hz()[*mode],
            Target::InMode(_, target) => Self { target: (**target).clone(), ..self.clone() }.typical_size(simulator),
            Target::ParameterOffset(column) | Target::SettingOffset(column) | Target::SettingMirror(column) => {
                let p = &simulator.space().as_slice()[*column];
                0.1 * (p.upper - p.lower)
            }
            Target::AddedSpring(..) => {
                let structure = simulator.structure();
                let stiffnesses: Vec<f64> = structure.map_or_else(Vec::new, translational_n_per_m);
                let mean = if stiffnesses.is_empty() { 0.0 } else { stats::mean(&stiffnesses) };
                // For a beam without springs, the stiffness k = m ω² of its mass at its lowest frequency.
                let lowest = std::f64::consts::TAU * simulator.nominal_frequencies_hz()[0];
                let kg: f64 = structure.map_or(0.0, |s| s.masses().iter().map(|m| m.kg).sum());
                0.15 * if mean > 0.0 { mean } else { kg * lowest.powi(2) }
            }
            Target::Oscillator(host) | Target::AddedMass(host) => {
                0.05 * simulator.structure().map_or(1.0, |s| s.kg_at(*host))
            }
            Target::ModeOrder(_)
            | Target::Everywhere(_)
            | Target::SettingUnit { .. }
            | Target::SettingExchange(..)
            | Target::ModeGain { .. } => 1.0,
        }
    }
}
