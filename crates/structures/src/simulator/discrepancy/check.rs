//! Checks of the learned discrepancy of a structure file.

use super::definition::InputDefinition;
use super::input::Discrepancy;
use crate::measurement::{Covariate, CovariateKind};
use crate::quantity::shown;
use crate::simulator::definition::{DefinitionProblem, MeasurementNoise, StructureDefinition};

/// Checks the discrepancy of a definition; `None` if it has none or has mistakes.
pub fn check(
    definition: &StructureDefinition,
    covariates: &[Covariate],
    problems: &mut Vec<DefinitionProblem>,
) -> Option<Discrepancy> {
    let given = definition.discrepancy.as_ref()?;
    let mut wrong = |key: &str, message: String| {
        problems.push(DefinitionProblem::new(format!("/discrepancy{key}"), message));
    };
    let (MeasurementNoise::Relative(noise) | MeasurementNoise::Hz(noise)) = definition.measurement_noise;
    if noise <= 0.0 {
        wrong("", "a discrepancy is added to the noise of a measurement: state measurement_noise above 0".to_owned());
    }
    let discrepancy = Discrepancy::new(given, definition.modes).map_err(|(key, message)| wrong(&key, message)).ok();
    for (index, input) in given.inputs.iter().enumerate() {
        if let Err((key, message)) = check_declared(definition, covariates, input) {
            wrong(&format!("/inputs/{index}/{key}"), message);
        }
        let earlier =
            |other: &InputDefinition| (&other.covariate, &other.setting) == (&input.covariate, &input.setting);
        if given.inputs[..index].iter().any(earlier) {
            wrong(&format!("/inputs/{index}"), format!("{} is an input already", shown(input.name())));
        }
    }
    discrepancy
}

/// Checks that an input is a declared covariate of its kind or a parameter; the error names the key.
fn check_declared(
    definition: &StructureDefinition,
    covariates: &[Covariate],
    input: &InputDefinition,
) -> Result<(), (&'static str, String)> {
    if let Some(name) = &input.setting {
        if !definition.parameters.iter().any(|p| p.name == *name) {
            return Err(("setting", format!("there is no parameter {}", shown(name))));
        }
        if input.is_category() {
            return Err(("levels", "a setting is a number and has no levels: remove them".to_owned()));
        }
    }
    let Some(name) = &input.covariate else { return Ok(()) };
    let Some(declared) = covariates.iter().find(|c| c.name == *name) else {
        return Err(("covariate", format!("there is no [[covariate]] {}", shown(name))));
    };
    match (declared.kind, input.is_category()) {
        (CovariateKind::Category, false) => Err(("levels", format!("{} is a category: list its levels", shown(name)))),
        (CovariateKind::Number, true) => {
            Err(("levels", format!("{} is a number and has no levels: remove them", shown(name))))
        }
        _ => Ok(()),
    }
}
