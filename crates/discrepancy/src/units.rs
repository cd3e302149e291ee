//! Units of the numbers of causes.

use super::data::TIME;
use super::effect::FittedEffect;
use super::target_name::{varying_unit, TargetName};
use structures::measurement::{unit_of_name, Covariate};
use structures::physics::effect::Target;
use structures::simulator::law::LawKind;
use structures::simulator::Simulator;

/// Unit of the size of a target, and the factor and unit in which a sentence gives it.
fn unit(simulator: &Simulator, target: &Target) -> (String, f64, String) {
    let relative = || ("share".to_owned(), 100.0, "%".to_owned());
    let plain = |unit: &str| (unit.to_owned(), 1.0, unit.to_owned());
    match target {
        Target::FrequencyOffset(_) => plain("Hz"),
        Target::SettingOffset(k) | Target::SettingMirror(k) | Target::ParameterOffset(k) => {
            plain(&simulator.space().as_slice()[*k].unit)
        }
        Target::InMode(_, target) => self::unit(simulator, target),
        Target::AddedSpring(..) => plain("N/m"),
        Target::Oscillator(_) | Target::AddedMass(_) => plain("kg"),
        Target::ModeOrder(_) => plain(""),
        // A share would be read as a relative change.
        Target::Deviation(deviation) if deviation.is_gradient() => plain("log ratio"),
        _ => relative(),
    }
}

/// As [`unit`], in the terms of the sentence of an effect: a deviation that varies changes the parameter that is its size by a share of the mean of
/// that, or something else by a share of what its sentence names.
pub(super) fn shown_unit(
    simulator: &Simulator,
    (effect, name): (&FittedEffect, &TargetName),
    mean: &[f64],
) -> (String, f64, String) {
    let (unit, factor, shown) = unit(simulator, &effect.target);
    if effect.law.kind == LawKind::Constant {
        return (unit, factor, shown);
    }
    match simulator.parameter_of_deviation(&effect.target) {
        Some(column) => (unit, factor / mean[column], shown),
        None => (unit, factor, varying_unit(name).map_or(shown, str::to_owned)),
    }
}

/// Unit of a covariate: the one that the structure states, or else that at the end of its name; `unit` if neither is known.
pub(super) fn covariate_unit(simulator: &Simulator, name: &str, unit_of_time: &str) -> String {
    if name == TIME {
        return unit_of_time.to_owned();
    }
    let declared = simulator.covariates().iter().find(|c| c.name == name).and_then(Covariate::unit);
    declared.or_else(|| unit_of_name(name)).unwrap_or("unit").to_owned()
}

/// Unit of a number of an effect: `unit` is that of its target, `over` that of its covariate.
pub(super) fn unit_of_number(name: &str, target: &Target, unit: &str, over: &str, unit_of_time: &str) -> String {
    match name {
        "slope_per_unit" | "slope_below_per_unit" | "slope_above_per_unit" => format!("{unit} per {over}"),
        "curvature_per_unit2" => format!("{unit} per {over}²"),
        "second_slope_per_unit" => format!("{unit} per unit of the second"),
        "product_per_unit2" => format!("{unit} per unit of both"),
        "gain" | "level" if matches!(target, Target::ModeGain { .. }) => "share".to_owned(),
        "rate_per_unit" => format!("1/{over}"),
        "knee" => over.to_owned(),
        "lag_days" => unit_of_time.to_owned(),
        "frequency_hz" => "Hz".to_owned(),
        _ => unit.to_owned(),
    }
}
