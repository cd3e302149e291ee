//! A further measurement in words.

use std::collections::BTreeMap;

use super::condition::Condition;
use super::experiment::{Experiment, Kind, NextMeasurement};
use super::value::{MOST_REPEATS, WANTED};
use crate::data::{Data, Origin, SETTING};
use crate::rank::Ranked;
use structures::measurement::CovariateValue;
use structures::simulator::Simulator;

/// The conditions of a measurement as values of the covariates that the candidates depend on, and of settings.
pub(super) fn conditions(
    simulator: &Simulator,
    data: &Data,
    ranked: &[&Ranked],
    experiment: &Experiment,
) -> Vec<BTreeMap<String, CovariateValue>> {
    let (mut names, mut settings): (Vec<&str>, Vec<&str>) = (Vec::new(), Vec::new());
    for column in ranked.iter().filter_map(|r| data.column(r.candidate.covariate.as_deref()?)) {
        let single = match column.origin {
            Origin::Product(first, second) => vec![&data.columns[first], &data.columns[second]],
            _ => vec![column],
        };
        for column in single {
            match column.origin {
                Origin::Time | Origin::Cycle(_) => {}
                Origin::Setting => settings.extend(column.name.strip_prefix(SETTING)),
                _ => names.push(&column.name),
            }
        }
    }
    let values = |condition: &Condition| {
        let mut names: Vec<&str> = names.clone();
        names.extend(condition.changed.keys().map(String::as_str));
        let mut values: BTreeMap<String, CovariateValue> = BTreeMap::new();
        for name in names {
            if let Some(value) = condition.value(data, name) {
                values.insert(name.to_owned(), value);
            }
        }
        for (column, parameter) in
            simulator.space().iter().enumerate().filter(|(_, p)| settings.contains(&p.name.as_str()))
        {
            if let Some(value) = data.settings[condition.row][column] {
                values.insert(parameter.name.clone(), CovariateValue::Number(value));
            }
        }
        for (column, value) in &condition.set {
            values.insert(simulator.space().as_slice()[*column].name.clone(), CovariateValue::Number(*value));
        }
        values
    };
    experiment.conditions.iter().map(values).collect()
}

/// How a second instrument is used.
const WITH_SECOND: &str = "with a second instrument, which does not have the faults of the first";

/// What is measured, as a noun.
pub(super) fn phrase(
    simulator: &Simulator,
    experiment: &Experiment,
    conditions: &[BTreeMap<String, CovariateValue>],
) -> String {
    let place = experiment.place.as_deref().unwrap_or_default();
    let what = match experiment.kind {
        Kind::ModeShapes => {
            let points = point_names(simulator, experiment).join(", ");
            format!("the shapes of the measured modes at {points}")
        }
        Kind::FurtherMode => format!("the frequency of mode {} with those measured so far", experiment.modes),
        Kind::HungMass => {
            let kg = experiment.hung.map_or(0.0, |(_, kg)| kg);
            let second = if experiment.second_instrument { format!(", {WITH_SECOND}") } else { String::new() };
            format!("the frequencies with a known mass of {kg} kg fixed to {place}{second}")
        }
        Kind::SecondInstrument => format!("the frequencies {WITH_SECOND}"),
        Kind::Weighing if experiment.second_instrument => {
            format!("the mass of {place} by weighing, and the frequencies {WITH_SECOND}")
        }
        Kind::Weighing => format!("the mass of {place} by weighing"),
        Kind::FurtherRange => format!("the frequencies at a value of {place} that was not met so far"),
        Kind::IndependentCovariates => format!("the frequencies in conditions in which {place} vary independently"),
        Kind::FurtherSettings => format!("the frequencies with {place} set near both ends of its range"),
        Kind::MoreRows => "more rows as those at hand".to_owned(),
    };
    let shapes = experiment.kind != Kind::ModeShapes && !experiment.points.is_empty();
    let beside = format!(", and the mode shapes at {}", point_names(simulator, experiment).join(", "));
    let what = if shapes { format!("{what}{beside}") } else { what };
    let each: Vec<String> = conditions.iter().filter(|c| !c.is_empty()).map(in_words).collect();
    if each.is_empty() {
        what
    } else {
        format!("{what}, at {}", each.join("; and at "))
    }
}

/// Names of the points at which shapes are measured.
pub(super) fn point_names(simulator: &Simulator, experiment: &Experiment) -> Vec<String> {
    let Some(structure) = simulator.structure() else { return Vec::new() };
    let name = |dof: &usize| structure.attachment_points().iter().find(|p| p.dof == *dof).map(|p| p.name.clone());
    experiment.points.iter().filter_map(name).collect()
}

/// The values of one condition.
fn in_words(condition: &BTreeMap<String, CovariateValue>) -> String {
    let value = |value: &CovariateValue| match value {
        CovariateValue::Number(number) => four_digits(*number),
        CovariateValue::Category(name) => name.clone(),
    };
    let each: Vec<String> = condition.iter().map(|(name, v)| format!("{name} = {}", value(v))).collect();
    each.join(", ")
}

/// A number with four significant digits, without zeros at its end.
fn four_digits(number: f64) -> String {
    let digits = (3.0 - number.abs().max(1e-12).log10().floor()).clamp(0.0, 9.0) as usize;
    let text = format!("{number:.digits$}");
    if text.contains('.') {
        text.trim_end_matches('0').trim_end_matches('.').to_owned()
    } else {
        text
    }
}

/// The sentence of a measurement whose other fields are known; `what` is its [`phrase`], `most` the expected probability after
/// [`MOST_REPEATS`] rows in each condition.
pub(super) fn sentence(what: &str, m: &NextMeasurement, most: f64) -> String {
    let weighed_only = m.kind == Kind::Weighing && !m.second_instrument;
    let rows = match (weighed_only, m.conditions.len()) {
        (true, 1) => String::new(),
        (true, _) => ", once in each of these conditions".to_owned(),
        (_, 1) => format!(", in {} rows", m.repeats),
        (_, _) => format!(", in {} rows in each of these conditions", m.repeats),
    };
    let reached = match m.repeats_to_95 {
        _ if weighed_only => String::new(),
        Some(1) => format!("; one row reaches {WANTED}"),
        Some(repeats) => format!("; {repeats} rows reach {WANTED}"),
        None => format!("; {MOST_REPEATS} rows reach {most:.2}"),
    };
    format!(
        "Measure {what}{rows}: the expected probability of the right cause changes from {:.2} to {:.2} ± {:.2}{reached}.",
        m.probability_now, m.probability_after, m.standard_error
    )
}
