//! The inputs u of a learned discrepancy in one measurement.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, DVector};

use super::definition::{DiscrepancyDefinition, InputDefinition, ModeDefinition};
use super::process::{Moments, Process, Support};
use crate::measurement::CovariateValue;

/// Margin around the values that a discrepancy was learned from, as a share of their range; a value beyond it is reported.
const BEYOND: f64 = 0.1;

/// Greatest number of support points.
pub const MOST_POINTS: usize = 300;

/// Greatest number of inputs.
pub const MOST_INPUTS: usize = 12;

/// Factor by which rounding in a file may make a posterior variance larger than the prior variance.
const ROUNDING: f64 = 1.0 + 1e-6;

/// A checked learned discrepancy.
#[derive(Debug, Clone, PartialEq)]
pub struct Discrepancy {
    definition: DiscrepancyDefinition,
    support: Support,
    /// `[m]`; `None` for a mode without discrepancy.
    modes: Vec<Option<Process>>,
}

/// The inputs of one measurement.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Inputs {
    /// Standardised, `[inputs]`; `None` if one of them is missing or is a category that was never seen.
    pub u: Option<Vec<f64>>,
    /// Names of inputs that the measurement lacks.
    pub missing: Vec<String>,
    /// Names of inputs outside the values that the discrepancy was learned from.
    pub beyond: Vec<String>,
}

/// JSON pointer below the discrepancy, and the message of a mistake.
pub(super) type Mistake = (String, String);

impl InputDefinition {
    /// Name of the covariate or of the setting.
    pub fn name(&self) -> &str {
        self.covariate.as_deref().or(self.setting.as_deref()).unwrap_or_default()
    }

    /// Whether the input is a category.
    pub fn is_category(&self) -> bool {
        !self.levels.is_empty()
    }

    /// A number, standardised.
    pub fn standardised(&self, value: f64) -> f64 {
        (value - self.centre) / self.scale
    }

    fn is_beyond(&self, value: f64) -> bool {
        let Some([low, high]) = self.seen else { return false };
        let margin = BEYOND * (high - low);
        !(low - margin..=high + margin).contains(&value)
    }
}

impl Discrepancy {
    /// Checks a definition for a structure of `modes` modes, as far as it does not depend on other parts of the structure.
    ///
    /// # Errors
    /// The key, as a JSON pointer below the discrepancy, and the message.
    pub fn new(definition: &DiscrepancyDefinition, modes: usize) -> Result<Self, (String, String)> {
        let (inputs, count) = (definition.inputs.len(), definition.points.len());
        if inputs > MOST_INPUTS {
            let message = format!("{inputs} inputs: a discrepancy has at most {MOST_INPUTS}");
            return Err(("/inputs".to_owned(), message));
        }
        if count == 0 || count > MOST_POINTS {
            return Err((
                "/points".to_owned(),
                format!("{count} support points: a discrepancy has 1 to {MOST_POINTS}"),
            ));
        }
        for (index, input) in definition.inputs.iter().enumerate() {
            check_input(input).map_err(|(key, message)| (format!("/inputs/{index}{key}"), message))?;
        }
        for (index, point) in definition.points.iter().enumerate() {
            check_point(&definition.inputs, point).map_err(|message| (format!("/points/{index}"), message))?;
        }
        let points = DMatrix::from_fn(count, inputs, |point, input| definition.points[point][input]);
        let support = Support::new(points, definition.inputs.iter().map(InputDefinition::is_category).collect());
        let mut processes: Vec<Option<Process>> = vec![None; modes];
        for (index, mode) in definition.modes.iter().enumerate() {
            let at = |(key, message): Mistake| (format!("/mode/{index}{key}"), message);
            if mode.mode == 0 || mode.mode > modes {
                let message = format!("mode {}: the structure has the modes 1 to {modes}", mode.mode);
                return Err(at(("/mode".to_owned(), message)));
            }
            let process = checked_process(mode, &support, inputs).map_err(at)?;
            if processes[mode.mode - 1].replace(process).is_some() {
                return Err(at(("/mode".to_owned(), format!("mode {} is given twice: give it once", mode.mode))));
            }
        }
        Ok(Self { definition: definition.clone(), support, modes: processes })
    }

    /// The definition that it was made from.
    pub fn definition(&self) -> &DiscrepancyDefinition {
        &self.definition
    }

    /// The support points.
    pub fn support(&self) -> &Support {
        &self.support
    }

    /// The process of each mode, `[m]`.
    pub fn modes(&self) -> &[Option<Process>] {
        &self.modes
    }

    /// Mean and variance of g of each mode at standardised inputs, `[inputs]`, or where they are not known, `[m]`.
    pub fn at(&self, u: Option<&[f64]>) -> Vec<Moments> {
        let one = |process: &Process| u.map_or_else(|| process.unknown(), |u| process.at(&self.support, u));
        self.modes.iter().map(|process| process.as_ref().map(one).unwrap_or_default()).collect()
    }

    /// The inputs of a measurement with these covariates and settings.
    pub fn inputs(&self, covariates: &BTreeMap<String, CovariateValue>, settings: &BTreeMap<String, f64>) -> Inputs {
        let mut found = Inputs::default();
        let mut u = Vec::with_capacity(self.definition.inputs.len());
        for input in &self.definition.inputs {
            let name = || input.name().to_owned();
            let set = || input.setting.as_ref().and_then(|name| settings.get(name)).copied();
            match input
                .covariate
                .as_ref()
                .map_or_else(|| set().map(CovariateValue::Number), |name| covariates.get(name).cloned())
            {
                Some(CovariateValue::Number(value)) if !input.is_category() => {
                    if input.is_beyond(value) {
                        found.beyond.push(name());
                    }
                    u.push(input.standardised(value));
                }
                Some(CovariateValue::Category(text)) if input.is_category() => {
                    match input.levels.iter().position(|level| *level == text) {
                        Some(level) => u.push(level as f64),
                        None => found.beyond.push(name()),
                    }
                }
                _ => found.missing.push(name()),
            }
        }
        found.u = (u.len() == self.definition.inputs.len()).then_some(u);
        found
    }
}

fn check_input(input: &InputDefinition) -> Result<(), Mistake> {
    if input.covariate.is_some() == input.setting.is_some() {
        return Err((
            String::new(),
            "an input is either a covariate or a setting: give one of the two keys".to_owned(),
        ));
    }
    if !(input.scale.is_finite() && input.scale > 0.0) {
        return Err((
            "/scale".to_owned(),
            format!("a scale of {} is not valid: it must be finite and above 0", input.scale),
        ));
    }
    if !input.centre.is_finite() {
        return Err(("/centre".to_owned(), format!("a centre of {} is not valid: it must be finite", input.centre)));
    }
    match input.seen {
        Some(_) if input.is_category() => {
            Err(("/seen".to_owned(), "an input with levels has no seen: remove one of the two keys".to_owned()))
        }
        Some([low, high]) if low.is_finite() && high.is_finite() && low < high => Ok(()),
        None if input.is_category() => Ok(()),
        _ => {
            let message = "seen must list the smallest and the largest value that the discrepancy was learned from, two different \
                           finite numbers in ascending order";
            Err(("/seen".to_owned(), message.to_owned()))
        }
    }
}

fn check_point(inputs: &[InputDefinition], point: &[f64]) -> Result<(), String> {
    if point.len() != inputs.len() || point.iter().any(|v| !v.is_finite()) {
        return Err(format!("a support point must have {} finite numbers, one for each input", inputs.len()));
    }
    for (input, value) in inputs.iter().zip(point).filter(|(input, _)| input.is_category()) {
        if !(value.fract() == 0.0 && (0.0..input.levels.len() as f64).contains(value)) {
            let last = input.levels.len() - 1;
            return Err(format!("{} is {value}: a category is an index of its levels, 0 to {last}", input.name()));
        }
    }
    Ok(())
}

fn checked_process(mode: &ModeDefinition, support: &Support, inputs: usize) -> Result<Process, Mistake> {
    let points = support.len();
    let positive = |value: &f64| value.is_finite() && *value > 0.0;
    if !(positive(&mode.std) && mode.std < 1.0) {
        let message =
            format!("a std of {} is not valid: it is a share of the frequency, above 0 and below 1", mode.std);
        return Err(("/std".to_owned(), message));
    }
    if mode.lengths.len() != inputs || !mode.lengths.iter().all(positive) {
        return Err((
            "/lengths".to_owned(),
            format!("lengths must list {inputs} finite numbers above 0, one for each input"),
        ));
    }
    if mode.weights.len() != points || mode.weights.iter().any(|w| !w.is_finite()) {
        let message = format!("weights must list {points} finite numbers, one for each support point");
        return Err(("/weights".to_owned(), message));
    }
    let triangular = mode.factor.len() == points && mode.factor.iter().enumerate().all(|(i, row)| row.len() == i + 1);
    // Data reduce the variance of each coefficient, which is 1 before them.
    let posterior = |row: &Vec<f64>| row.iter().map(|v| v * v).sum::<f64>() <= ROUNDING;
    if !triangular || !mode.factor.iter().all(posterior) {
        let message = format!(
            "factor must be the lower triangle of {points} rows, the first with 1 number, and the squares of a row must not add up \
             to more than 1, the variance before the data"
        );
        return Err(("/factor".to_owned(), message));
    }
    let factor = DMatrix::from_fn(points, points, |i, j| if j <= i { mode.factor[i][j] } else { 0.0 });
    let weights = DVector::from_column_slice(&mode.weights);
    let process = Process::new(support, mode.std, mode.lengths.clone(), weights, factor);
    process.ok_or_else(|| ("/lengths".to_owned(), "the correlations of the support points are not finite".to_owned()))
}
