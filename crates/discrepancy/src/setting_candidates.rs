//! Corrections of settings as candidates: frame, scale, unit, sign, direction, exchange, and the gain of a mode.

use super::data::Data;
use super::effect::Number;
use structures::physics::effect::Target;
use structures::simulator::Simulator;
use structures::stats;

/// Units in which a setting may have been given, in the unit of the parameter: powers of ten, inch in mm and cm, foot in m, pound in
/// kg, kilogram-force in N, revolution in rad. Their inverses are considered as well.
const UNITS: [f64; 9] = [10.0, 100.0, 1e3, 1e6, 25.4, 2.54, 0.3048, 0.453_592_37, 9.806_65];

/// Share of the settings that must lie inside the prior in another unit for that unit to be considered.
const INSIDE: f64 = 0.5;

/// Greatest number of settings whose exchange is considered.
const MOST_EXCHANGED: usize = 8;

/// Margin of a prior, as a share of its width, within which a setting counts as inside.
pub(super) const MARGIN: f64 = 0.02;

/// The corrections of settings that are considered for some data.
pub(super) fn setting_targets(simulator: &Simulator, data: &Data) -> Vec<Target> {
    let set = |k: &usize| data.settings.iter().any(|row| row[*k].is_some());
    let columns: Vec<usize> = (0..simulator.space().len()).filter(set).collect();
    let mut targets = Vec::new();
    for &column in &columns {
        targets.extend([Target::SettingOffset(column), Target::SettingScale(column), Target::SettingMirror(column)]);
        let values: Vec<f64> = data.settings.iter().filter_map(|row| row[column]).collect();
        let plausible = |factor: &f64| {
            let inside = values.iter().filter(|v| distance(simulator, column, factor * **v) <= 0.0).count();
            inside as f64 >= INSIDE * values.len() as f64
        };
        let units = UNITS.iter().flat_map(|unit| [*unit, 1.0 / unit]).chain([-1.0, std::f64::consts::TAU]);
        targets.extend(units.filter(plausible).map(|factor| Target::SettingUnit { column, factor }));
        if varies(&values) {
            let reference = stats::mean(&values);
            let gain = |mode: usize| Target::ModeGain { mode, column, reference };
            targets.extend((0..simulator.modes()).map(gain));
            let one_mode = |mode: usize| Target::InMode(mode, Box::new(Target::SettingOffset(column)));
            targets.extend((0..simulator.modes()).map(one_mode));
        }
    }
    if columns.len() <= MOST_EXCHANGED {
        for (place, &one) in columns.iter().enumerate() {
            for &other in &columns[place + 1..] {
                let exchange = Target::SettingExchange(one, other);
                let one_mode = |mode: usize| Target::InMode(mode, Box::new(exchange.clone()));
                targets.extend((0..simulator.modes()).map(one_mode));
                targets.push(exchange);
            }
        }
    }
    targets
}

fn varies(values: &[f64]) -> bool {
    values.iter().any(|v| v.to_bits() != values[0].to_bits())
}

/// Distance of a value from the prior of a parameter as a share of its width; negative or 0 inside, margin included.
pub(super) fn distance(simulator: &Simulator, column: usize, value: f64) -> f64 {
    let p = &simulator.space().as_slice()[column];
    let width = p.upper - p.lower;
    (p.lower - value).max(value - p.upper) / width - MARGIN
}

/// The size that a correction of a setting must have to bring all rows inside the prior, in the unit of its number; 0 for other
/// targets, and where all settings lie inside.
pub(super) fn beyond_prior(simulator: &Simulator, data: &Data, rows: &[usize], target: &Target) -> f64 {
    let [column] = target.settings()[..] else { return 0.0 };
    let p = &simulator.space().as_slice()[column];
    let values: Vec<f64> = rows.iter().filter_map(|row| data.settings[*row][column]).collect();
    let outside = |v: &&f64| distance(simulator, column, **v) > 0.0;
    let beyond = |v: &f64| (p.lower - v).max(v - p.upper);
    match target {
        Target::SettingScale(_) => {
            let middle = f64::midpoint(p.lower, p.upper);
            values
                .iter()
                .filter(outside)
                .map(|v| (middle / v - 1.0).abs())
                .filter(|g| g.is_finite())
                .fold(0.0, f64::max)
        }
        _ => values.iter().filter(outside).map(beyond).fold(0.0, f64::max),
    }
}

/// The numbers of the gain of a mode: the gain itself, and the level, both relative.
pub(super) fn gain_numbers() -> Vec<Number> {
    let number = |name: &str, prior_std: f64| Number {
        name: name.to_owned(),
        prior_mean: 0.0,
        prior_std,
        bounds: (f64::NEG_INFINITY, f64::INFINITY),
        of_factor: false,
    };
    vec![number("gain", 0.5), number("level", 0.01)]
}

/// The number of a setting that was measured from the other end: the sum of the values of both ends; `None` for a target without
/// numbers. `size`: standard deviation of its prior.
pub(super) fn sum_of_ends(simulator: &Simulator, target: &Target, size: f64) -> Option<Number> {
    let Target::SettingMirror(column) = target else { return None };
    let p = &simulator.space().as_slice()[*column];
    let prior_std = size.max(0.5 * (p.upper - p.lower));
    let bounds = (f64::NEG_INFINITY, f64::INFINITY);
    Some(Number { name: "sum_of_ends".to_owned(), prior_mean: p.lower + p.upper, prior_std, bounds, of_factor: false })
}
