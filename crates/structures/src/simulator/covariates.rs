//! Checks the covariates of a structure definition.

use super::definition::{CovariateDefinition, DefinitionProblem, StructureDefinition};
use super::layout::{check_names, Problems};
use crate::measurement::{Covariate, CovariateKind};
use crate::quantity::shown;

/// Longest unit of a covariate, characters.
const LONGEST_UNIT: usize = 20;

impl From<&CovariateDefinition> for Covariate {
    fn from(definition: &CovariateDefinition) -> Self {
        let CovariateDefinition { name, kind, unit, range } = definition.clone();
        Self { name, kind, unit, range }
    }
}

/// Checks the unit of a covariate: a short text without control characters, for numbers only.
fn check_unit(covariate: &CovariateDefinition, index: usize, problems: &mut Problems) {
    let Some(unit) = &covariate.unit else { return };
    let name = shown(&covariate.name);
    let message = if covariate.kind == CovariateKind::Category {
        format!("covariate {name} is a category, which has no unit: remove unit")
    } else if unit.trim() != unit
        || unit.is_empty()
        || unit.chars().count() > LONGEST_UNIT
        || unit.chars().any(char::is_control)
    {
        format!(
            "covariate {name} has the unit {}: it must have 1 to {LONGEST_UNIT} characters without spaces at its ends, such as \"°C\"",
            shown(unit)
        )
    } else {
        return;
    };
    problems.push(DefinitionProblem::new(format!("/covariate/{index}/unit"), message));
}

/// Checks the range of a covariate: two finite numbers in ascending order, for numbers only.
fn check_range(covariate: &CovariateDefinition, index: usize, problems: &mut Problems) {
    let Some([low, high]) = covariate.range else { return };
    let name = shown(&covariate.name);
    let message = if covariate.kind == CovariateKind::Category {
        format!("covariate {name} is a category, which has no range: remove range")
    } else if !(low.is_finite() && high.is_finite() && low < high) {
        format!(
            "covariate {name} has the range {low} to {high}: it must be two numbers in ascending order, such as [-40.0, 60.0]"
        )
    } else {
        return;
    };
    problems.push(DefinitionProblem::new(format!("/covariate/{index}/range"), message));
}

/// Checks that no covariate has the name of another column of measurement tables, the units and the ranges.
pub(super) fn check(definition: &StructureDefinition, problems: &mut Problems) {
    check_names("covariate", definition.covariates.iter().map(|c| &c.name), problems);
    for (index, covariate) in definition.covariates.iter().enumerate() {
        check_unit(covariate, index, problems);
        check_range(covariate, index, problems);
        let name = covariate.name.to_ascii_lowercase();
        let digits = |text: &str| !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
        let frequency = name.strip_prefix("std_").unwrap_or(&name);
        let frequency = frequency.strip_prefix('f').and_then(|n| n.strip_suffix("_hz")).is_some_and(digits);
        if frequency || name == "measured_at" || name == "source" || name.starts_with("set_") {
            let message = format!(
                "the covariate name {} is taken by another column of measurement tables: choose another name",
                shown(&covariate.name)
            );
            problems.push(DefinitionProblem::new(format!("/covariate/{index}/name"), message));
        }
    }
}
