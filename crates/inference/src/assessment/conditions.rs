//! Environmental and operational conditions: comparison of the covariates of a batch with those of the undamaged reference.

use std::collections::BTreeMap;

use crate::damage::SeenCovariate;
use crate::trust::{Finding, FindingCode, FindingEffect};
use structures::measurement::{Covariate, CovariateValue, ModalMeasurement};

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
/// covariates. `learned`: covariates whose influence the process of the reference has learned: outside their range, its charts are
/// less sensitive instead of being held. `declared`: the covariates of the structure, for their units.
pub(super) fn compare_conditions(
    measurements: &[ModalMeasurement],
    seen: &BTreeMap<String, SeenCovariate>,
    learned: &[String],
    declared: &[Covariate],
) -> impl Iterator<Item = Finding> {
    let (mut outside, mut missing) = (Vec::new(), Vec::new());
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
            let message = format!(
                "{lacking} measurements lack {name}, which the undamaged reference has: this batch raises no alarm"
            );
            missing.push(Finding::new(FindingCode::CovariateMissing, FindingEffect::HoldAlarm, message));
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
