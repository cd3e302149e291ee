//! The measurements that are possible for a structure and its candidates.

use super::condition::{anchors, combinations, contrasts, single_covariates, Condition, Contrast};
use super::experiment::{Experiment, Kind};
use crate::data::{Data, Values};
use crate::rank::Ranked;
use structures::measurement::CovariateValue;
use structures::physics::effect::Target;
use structures::physics::{Form, Node, Structure};
use structures::simulator::Simulator;

/// Greatest number of points at which a mass is hung, and of bodies that are weighed. With more, every n-th is considered.
const MOST_PLACES: usize = 12;

/// Greatest number of points of a mode shape.
const MOST_POINTS: usize = 8;

/// Masses that are hung, as shares of the mass at their point.
const HUNG_SHARES: [f64; 2] = [0.1, 0.5];

/// Distance of a further setting from the end of the prior, as a share of the width of the prior.
const FROM_END: f64 = 0.1;

/// Smallest further range that is considered, as a share of the width of the range at hand.
const LEAST_FURTHER: f64 = 0.25;

/// Greatest number of pairs of covariates that are varied independently.
const MOST_PAIRS: usize = 3;

/// Greatest number of acts, and of sets of conditions, that are joined.
const MOST_JOINED: usize = 4;

/// Greatest number of conditions in which mode shapes are measured beside something else.
const MOST_WITH_SHAPES: usize = 2;

/// All measurements that are possible; `rows`: rows at hand.
pub(super) fn options(simulator: &Simulator, data: &Data, rows: &[usize], ranked: &[&Ranked]) -> Vec<Experiment> {
    let rows: Vec<usize> = rows.iter().copied().filter(|row| !data.further[*row]).collect();
    let contrasts = contrasts(data, &rows, ranked);
    let present = anchors(data, &rows, &contrasts);
    let plain = Experiment {
        kind: Kind::MoreRows,
        conditions: present.clone(),
        modes: simulator.modes(),
        hung: None,
        weighed: None,
        second_instrument: false,
        points: Vec::new(),
        place: None,
    };
    let mut all = vec![plain.clone()];
    if simulator.available_modes() > simulator.modes() {
        all.push(Experiment { kind: Kind::FurtherMode, modes: simulator.modes() + 1, ..plain.clone() });
    }
    if let Some(structure) = simulator.structure() {
        all.extend(hung_masses(structure, &plain));
        all.extend(weighings(structure, ranked, &plain));
    }
    if ranked.iter().any(|r| r.candidate.target.is_of_instrument()) {
        let useful = |e: &&Experiment| matches!(e.kind, Kind::MoreRows | Kind::HungMass | Kind::Weighing);
        let second: Vec<Experiment> =
            all.iter().filter(useful).map(|e| with_second_instrument(e, plain.modes)).collect();
        all.extend(second);
    }
    if let Some(structure) = simulator.structure().filter(|_| data.shapes.is_none()) {
        all.extend(mode_shapes(simulator, structure, &plain));
    }
    let with = |kind: Kind, place: Option<String>, conditions: Vec<Condition>| Experiment {
        kind,
        conditions,
        place,
        ..plain.clone()
    };
    let single = single_covariates(data, &rows, &contrasts);
    for contrast in &single {
        for (number, end) in beyond(data, &rows, contrast).into_iter().enumerate() {
            let mut condition = present[number.min(present.len() - 1)].clone();
            condition.changed.insert(contrast.covariate.clone(), CovariateValue::Number(end));
            all.push(with(Kind::FurtherRange, Some(contrast.covariate.clone()), vec![condition]));
        }
    }
    let last = present[0].row;
    let pairs = single.iter().enumerate().flat_map(|(index, a)| single[index + 1..].iter().map(move |b| (a, b)));
    for (a, b) in pairs.take(MOST_PAIRS) {
        let place = Some(format!("{} and {}", a.covariate, b.covariate));
        all.push(with(Kind::IndependentCovariates, place, combinations(last, a, b)));
    }
    all.extend(further_settings(simulator, ranked, &plain));
    all
}

/// Measurements that join two others, given by value, the best first: the best of each kind of act on the structure, in the conditions
/// of another measurement and with mode shapes beside it.
pub(super) fn joined(by_value: &[&Experiment]) -> Vec<Experiment> {
    let mut acts: Vec<&Experiment> = Vec::new();
    for e in by_value.iter().filter(|e| !e.kind.is_of_conditions() && e.kind != Kind::MoreRows) {
        let same = |known: &&Experiment| (known.kind, known.second_instrument) == (e.kind, e.second_instrument);
        if acts.len() < MOST_JOINED && !acts.iter().any(same) {
            acts.push(e);
        }
    }
    let mut all: Vec<Experiment> = Vec::new();
    for act in &acts {
        let conditions = by_value.iter().filter(|e| e.kind.is_of_conditions()).take(MOST_JOINED);
        all.extend(conditions.map(|c| Experiment { conditions: c.conditions.clone(), ..(*act).clone() }));
    }
    if let Some(shapes) = by_value.iter().find(|e| e.kind == Kind::ModeShapes) {
        for act in acts.iter().filter(|e| e.kind != Kind::ModeShapes) {
            let conditions = act.conditions[..act.conditions.len().min(MOST_WITH_SHAPES)].to_vec();
            let modes = act.modes.max(shapes.modes);
            all.push(Experiment { points: shapes.points.clone(), modes, conditions, ..(*act).clone() });
        }
    }
    all
}

/// The same measurement with a second instrument. A known mass does not tell all springs from the scale of the instrument, and a
/// second instrument does not tell all springs from all masses; both together do. `modes`: modes measured, also beside a weighing.
fn with_second_instrument(e: &Experiment, modes: usize) -> Experiment {
    let kind = if e.kind == Kind::MoreRows { Kind::SecondInstrument } else { e.kind };
    Experiment { kind, second_instrument: true, modes, ..e.clone() }
}

/// A light and a heavy mass at each attachment point.
fn hung_masses(structure: &Structure, plain: &Experiment) -> Vec<Experiment> {
    let points = structure.attachment_points();
    let at = |share: f64, index: usize| {
        let point = &points[index];
        let kg = two_digits(share * structure.kg_at(point.dof));
        let (hung, place) = (Some((point.dof, kg)), Some(point.name.clone()));
        Experiment { kind: Kind::HungMass, hung, place, ..plain.clone() }
    };
    let places = || (0..points.len()).step_by(points.len().div_ceil(MOST_PLACES).max(1));
    HUNG_SHARES.into_iter().flat_map(|share| places().map(move |index| at(share, index))).collect()
}

/// The weighing of each rigid body whose mass a candidate changes.
fn weighings(structure: &Structure, ranked: &[&Ranked], plain: &Experiment) -> Vec<Experiment> {
    let rigid = |mass: &usize| matches!(structure.masses()[*mass].form, Form::Spring(Node::Ground, Node::Dof(_)));
    let mut bodies: Vec<usize> = Vec::new();
    for r in ranked {
        if let Target::Masses(masses) = &r.candidate.target {
            bodies.extend(masses.iter().filter(|m| rigid(m)));
        }
    }
    bodies.sort_unstable();
    bodies.dedup();
    let weighing = |mass: &usize| Experiment {
        kind: Kind::Weighing,
        modes: 0,
        weighed: Some(*mass),
        place: Some(structure.masses()[*mass].name.clone()),
        ..plain.clone()
    };
    bodies.iter().step_by(bodies.len().div_ceil(MOST_PLACES).max(1)).map(weighing).collect()
}

/// The shapes of the measured modes at the instrumented points, or at all attachment points if there are none; in the first
/// conditions only.
fn mode_shapes(simulator: &Simulator, structure: &Structure, plain: &Experiment) -> Option<Experiment> {
    let points = structure.attachment_points();
    let points: Vec<usize> = match simulator.instrumented_points() {
        Some(instrumented) => points.iter().filter(|p| instrumented.names.contains(&p.name)).map(|p| p.dof).collect(),
        None => points.iter().step_by(points.len().div_ceil(MOST_POINTS).max(1)).map(|p| p.dof).collect(),
    };
    let conditions = plain.conditions[..1].to_vec();
    (points.len() > 1).then(|| Experiment { kind: Kind::ModeShapes, points, conditions, ..plain.clone() })
}

/// Values of a numeric covariate beyond both ends of its range, by half the width of the range; a covariate that was never
/// negative is not extended below 0, and one in per cent not above 100.
fn beyond(data: &Data, rows: &[usize], contrast: &Contrast) -> Vec<f64> {
    let Some(column) = data.column(&contrast.covariate) else { return Vec::new() };
    if !matches!(column.values, Values::Numbers(_)) {
        return Vec::new();
    }
    let numbers = column.numbers(rows);
    let (low, high) = numbers.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(*v), h.max(*v)));
    let width = high - low;
    let temperature = ["_c", "_degc"].iter().any(|unit| contrast.covariate.ends_with(unit));
    let percent = contrast.covariate.ends_with("_percent");
    let least = if low >= 0.0 && !temperature { 0.0 } else { f64::NEG_INFINITY };
    let most = if percent { 100.0 } else { f64::INFINITY };
    let (below, above) = ((low - 0.5 * width).max(least), (high + 0.5 * width).min(most));
    let further = |by: f64| by >= LEAST_FURTHER * width;
    [(low - below, below), (above - high, above)]
        .into_iter()
        .filter(|(by, _)| further(*by))
        .map(|(_, end)| end)
        .collect()
}

/// Settings near both ends of the prior, for each setting that a candidate changes.
fn further_settings(simulator: &Simulator, ranked: &[&Ranked], plain: &Experiment) -> Vec<Experiment> {
    let mut columns: Vec<usize> = Vec::new();
    for r in ranked {
        let of_gain = if let Target::ModeGain { column, .. } = r.candidate.target { Some(column) } else { None };
        for column in r.candidate.target.settings().into_iter().chain(of_gain) {
            if !columns.contains(&column) {
                columns.push(column);
            }
        }
    }
    let of_column = |column: &usize| {
        let parameter = &simulator.space().as_slice()[*column];
        let width = parameter.upper - parameter.lower;
        let ends = if parameter.is_uniform() {
            [parameter.lower + FROM_END * width, parameter.upper - FROM_END * width]
        } else {
            [FROM_END, 1.0 - FROM_END].map(|level| parameter.at_level(level))
        };
        let conditions = ends.into_iter().map(|end| {
            let mut condition = plain.conditions[0].clone();
            condition.set.insert(*column, end);
            condition
        });
        Experiment {
            kind: Kind::FurtherSettings,
            place: Some(parameter.name.clone()),
            conditions: conditions.collect(),
            ..plain.clone()
        }
    };
    columns.iter().map(of_column).collect()
}

/// A positive number, rounded to two significant digits.
fn two_digits(value: f64) -> f64 {
    let unit = 10_f64.powf(value.log10().floor() - 1.0);
    let rounded = (value / unit).round() * unit;
    format!("{rounded:.12}").parse().unwrap_or(rounded)
}
