//! Environmental and operational conditions: comparison of the covariates of a batch with those of the undamaged reference.

use std::borrow::Cow;
use std::collections::BTreeMap;

use crate::damage::SeenCovariate;
use crate::process::model::Process;
use crate::trust::{Finding, FindingCode, FindingEffect};
use structures::measurement::{Covariate, CovariateValue, ModalMeasurement};
use structures::quantity::Timestamp;

/// Measurements without the values of covariates that cannot be true, such as −127 °C of a thermometer that is not connected, and findings that
/// name them. `declared`: the covariates of the structure.
pub(super) fn possible<'a>(
    measurements: &'a [ModalMeasurement],
    declared: &[Covariate],
) -> (Cow<'a, [ModalMeasurement]>, Vec<Finding>) {
    let (mut measurements, mut findings) = (Cow::Borrowed(measurements), Vec::new());
    for covariate in declared {
        let why = |m: &ModalMeasurement| match m.covariates.get(&covariate.name) {
            Some(CovariateValue::Number(value)) => covariate.impossible(*value),
            _ => None,
        };
        let found: Vec<(usize, String)> =
            measurements.iter().enumerate().filter_map(|(row, m)| Some((row, why(m)?))).collect();
        let Some((_, first)) = found.first() else { continue };
        let message = format!(
            "{} of {} measurements have an impossible {} (in the first, {first}): the value counts as missing; if it is right, state the \
             range of the covariate in the structure file",
            found.len(),
            measurements.len(),
            covariate.name
        );
        let rows: Vec<usize> = found.iter().map(|(row, _)| *row).collect();
        for row in &rows {
            measurements.to_mut()[*row].covariates.remove(&covariate.name);
        }
        findings.push(Finding::new(FindingCode::CovariateImpossible, FindingEffect::Note, message).of(rows));
    }
    (measurements, findings)
}

/// The range or the categories of each covariate over some measurements.
pub(super) fn conditions<'a>(
    measurements: impl Iterator<Item = &'a ModalMeasurement>,
) -> BTreeMap<String, SeenCovariate> {
    let mut seen = BTreeMap::<String, SeenCovariate>::new();
    for (name, value) in measurements.flat_map(|m| &m.covariates) {
        match value {
            CovariateValue::Number(x) => {
                let entry = seen.entry(name.clone()).or_insert(SeenCovariate::Range([*x, *x]));
                if let SeenCovariate::Range([low, high]) = entry {
                    (*low, *high) = (low.min(*x), high.max(*x));
                }
            }
            CovariateValue::Category(c) => {
                let entry = seen.entry(name.clone()).or_insert_with(|| SeenCovariate::Categories([c.clone()].into()));
                if let SeenCovariate::Categories(all) = entry {
                    all.insert(c.clone());
                }
            }
        }
    }
    seen
}

/// Findings about values of covariates that lie outside those of the undamaged reference, followed by findings about missing
/// covariates. `process`: that of the reference. Of the covariates whose influence it has learned, values outside their range or missing ones
/// make its charts less sensitive; they are not held. `declared`: the covariates of the structure, for their units.
pub(super) fn compare_conditions(
    measurements: &[ModalMeasurement],
    seen: &BTreeMap<String, SeenCovariate>,
    process: Option<&Process>,
    declared: &[Covariate],
) -> impl Iterator<Item = Finding> {
    let (mut outside, mut missing) = (Vec::new(), Vec::new());
    let learned = process.map_or(&[][..], |process| &process.covariates);
    let month = measurements.iter().map(|m| m.measured_at).max().map(Timestamp::month);
    let seen_month = process.and_then(|process| process.coverage.as_ref()).zip(month);
    let seen_month = seen_month.is_some_and(|(coverage, month)| coverage.months.contains(&month));
    for (name, seen) in seen {
        let unit = declared.iter().find(|c| c.name == *name).and_then(Covariate::unit);
        let mut example: Option<String> = None;
        let (mut rows, mut lacking) = (Vec::new(), 0);
        for (index, measurement) in measurements.iter().enumerate() {
            let Some(value) = measurement.covariates.get(name) else {
                lacking += 1;
                continue;
            };
            if let Some(difference) = difference(name, unit, value, seen) {
                rows.push(index);
                example.get_or_insert(difference);
            }
        }
        if let Some(example) = example {
            let (effect, consequence) = if learned.contains(name) {
                (FindingEffect::Note, "the alarm charts are the less sensitive, the further the conditions are outside")
            } else {
                (FindingEffect::HoldAlarm, "they may alone explain a change, so this batch raises no alarm")
            };
            let message =
                format!("the conditions are outside those of the undamaged reference ({example}): {consequence}");
            outside.push(Finding::new(FindingCode::Extrapolated, effect, message).of(rows));
        }
        if lacking > 0 {
            let (effect, consequence) = match (learned.contains(name), lacking == measurements.len(), seen_month) {
                (false, ..) => (FindingEffect::HoldAlarm, "this batch raises no alarm"),
                (true, false, _) => (FindingEffect::Note, "the mean of the others is used"),
                (true, true, true) => (
                    FindingEffect::Note,
                    "the alarm charts allow for any value that it has seen, and are less sensitive",
                ),
                (true, true, false) => (
                    FindingEffect::HoldAlarm,
                    "it was not measured in this month, so that the weather may explain any change, and this batch raises no alarm",
                ),
            };
            let message =
                format!("{lacking} measurements lack {name}, which the undamaged reference has: {consequence}");
            missing.push(Finding::new(FindingCode::CovariateMissing, effect, message));
        }
    }
    outside.into_iter().chain(missing)
}

/// Describes a value that is outside the range or the categories of the reference; `None` if it is inside.
fn difference(name: &str, unit: Option<&str>, value: &CovariateValue, seen: &SeenCovariate) -> Option<String> {
    match (value, seen) {
        (CovariateValue::Number(x), SeenCovariate::Range([low, high])) => {
            let unit = unit.map_or_else(String::new, |unit| format!(" {unit}"));
            (!(low..=high).contains(&x)).then(|| format!("{name} = {x}{unit}, reference {low} to {high}{unit}"))
        }
        (CovariateValue::Category(c), SeenCovariate::Categories(all)) => (!all.contains(c))
            .then(|| format!("{name} = {c}, reference {}", all.iter().cloned().collect::<Vec<_>>().join(", "))),
        _ => None,
    }
}
