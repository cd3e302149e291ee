//! Hidden effects: their targets, laws and sizes.

use std::sync::Arc;

use rand::seq::IndexedRandom;
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::numbers::quantiles;
use super::rows::{training_rows, Row, Weather};
use super::structure::{mass_name, Node, Structure, Target, PRIOR};

/// One hidden effect.
#[derive(Debug, Clone)]
pub struct Truth {
    /// Kind of its target: `spring`, `spring_group`, `mass`, `mass_group`, `frequency_scale`, `frequency_offset`,
    /// `setting`, `added_spring`, `oscillator` or `mode_assignment`.
    pub kind: &'static str,
    /// Name of the target: `k2`; `all` for groups; `mode 2`; empty for all modes; the host mass of an oscillator.
    pub name: String,
    /// Ends of an added spring, ground first, then in the order of the masses.
    pub between: Option<(String, String)>,
    /// `constant`, `linear`, `bilinear`, `quadratic`, `exponential`, `category`, `step` or `lagged`.
    pub law: &'static str,
    /// The column that it depends on; `time` for a step, `None` for a constant.
    pub covariate: Option<String>,
    /// The category that differs.
    pub level: Option<String>,
    /// For a numeric covariate the effect range: the effect at the 95 % quantile of the column minus that at the 5 % quantile
    /// (lagged: slope times the difference of the quantiles). Otherwise the effect itself. Relative for springs, masses and
    /// scales; in the unit of the parameter for settings, Hz for offsets, N/m for added springs, kg for oscillators.
    pub size: f64,
}

/// Effects that no law of the program describes.
pub const OUTSIDE: [&str; 3] = [
    "product of temperature and humidity on one mass",
    "hysteresis of one spring with temperature",
    "product of temperature and amplitude on one spring",
];
/// Joins the names of two columns that an effect depends on.
pub const AND: &str = " and ";

/// A function of one column.
type Curve = Arc<dyn Fn(f64) -> f64 + Send + Sync>;

/// An effect: its target and its value in each row.
#[derive(Clone)]
pub struct Effect {
    pub target: Target,
    pub signal: Vec<f64>,
    /// The value as a function of its numeric column, if it depends on the present value of one alone.
    pub curve: Option<Curve>,
    pub truth: Truth,
}

/// A law: its covariate, its value in each row, and its effect range (or its value) as [`Truth::size`] defines it.
struct Shape {
    covariate: Option<&'static str>,
    level: Option<&'static str>,
    values: Vec<f64>,
    curve: Option<Curve>,
    size: f64,
}

/// Draws target, law and size; `None` if the structure or the weather does not allow them.
pub fn draw_effect(
    rng: &mut ChaCha8Rng,
    structure: &Structure,
    weather: &Weather,
    rows: &[Row],
    (kind, law): (&'static str, &'static str),
) -> Option<Effect> {
    let n = structure.masses_kg.len();
    let any_mass = rng.random_range(0..n);
    let (target, name) = match kind {
        "spring" => {
            let taken = |s: &usize| structure.setting == Some(*s) || (law == "constant" && structure.free.contains(s));
            let springs = (0..structure.springs.len()).filter(|s| !taken(s)).collect::<Vec<_>>();
            let spring = *springs.choose(rng)?;
            (Target::Spring(spring), structure.springs[spring].name.clone())
        }
        "spring_group" => (Target::Springs, "all".to_owned()),
        "mass" => (Target::Mass(any_mass), mass_name(any_mass)),
        "mass_group" => (Target::Masses, "all".to_owned()),
        "frequency_scale" if law == "category" && rng.random_bool(0.5) => {
            let mode = rng.random_range(0..structure.modes);
            (Target::Scale(Some(mode)), format!("mode {}", mode + 1))
        }
        "frequency_scale" => (Target::Scale(None), String::new()),
        "frequency_offset" => (Target::Offset, String::new()),
        "setting" => (Target::Setting, structure.springs[structure.setting?].name.clone()),
        "added_spring" => {
            let (from, to) = draw_gap(rng, structure)?;
            (Target::AddedSpring(from, to), String::new())
        }
        "oscillator" => {
            let modes_hz = &structure.nominal_hz;
            let hz = rng.random_range(0.5 * modes_hz[0]..1.3 * modes_hz[structure.modes - 1]);
            if modes_hz.iter().any(|f| (hz / f - 1.0).abs() < 0.04) {
                return None;
            }
            (Target::Oscillator { host: any_mass, hz }, mass_name(any_mass))
        }
        _ if structure.modes < n => (Target::SkippedMode(rng.random_range(0..structure.modes)), String::new()),
        _ => return None,
    };
    let sign = if matches!(kind, "oscillator" | "added_spring") && law != "linear" || rng.random_bool(0.5) {
        1.0
    } else {
        -1.0
    };
    let shape = draw_shape(rng, weather, rows, law, sign)?;
    let scale = draw_scale(rng, structure, kind);
    let signal = shape.values.iter().map(|v| scale * v).collect::<Vec<_>>();
    let relative = !matches!(kind, "frequency_offset" | "setting" | "added_spring");
    if relative && signal.iter().any(|g| *g < -0.6 || *g > 2.0) {
        return None;
    }
    let size = match target {
        Target::SkippedMode(_) => 0.0,
        Target::Oscillator { host, .. } => scale * shape.size * structure.masses_kg[host],
        _ => scale * shape.size,
    };
    let between = match target {
        Target::AddedSpring(from, to) => Some((Structure::node_name(from), mass_name(to))),
        _ => None,
    };
    let (covariate, level) = (shape.covariate.map(str::to_owned), shape.level.map(str::to_owned));
    let curve = shape.curve.map(|curve| -> Curve { Arc::new(move |c| scale * curve(c)) });
    Some(Effect { target, signal, curve, truth: Truth { kind, name, between, law, covariate, level, size } })
}

/// Draws two nodes that no spring connects.
fn draw_gap(rng: &mut ChaCha8Rng, structure: &Structure) -> Option<(Node, usize)> {
    let n = structure.masses_kg.len();
    let pairs = (0..n).flat_map(|to| (0..to).map(Some).chain([None]).map(move |from| (from, to)));
    let joined = |pair: &(Node, usize)| structure.springs.iter().any(|s| (s.from, s.to) == *pair);
    pairs.filter(|p| !joined(p)).collect::<Vec<_>>().choose(rng).copied()
}

/// Draws the size of an effect on a kind of target, in the unit of the effect.
fn draw_scale(rng: &mut ChaCha8Rng, structure: &Structure, kind: &str) -> f64 {
    let (low, high, unit) = match kind {
        "spring" | "spring_group" => (0.02, 0.15, 1.0),
        "mass" | "mass_group" => (0.02, 0.10, 1.0),
        "frequency_scale" => (0.003, 0.02, 1.0),
        "frequency_offset" => (0.003, 0.02, structure.nominal_hz[0]),
        "setting" => {
            let nominal = structure.setting.map_or(0.0, |s| structure.springs[s].n_per_m);
            (0.03, 0.15, (PRIOR.1 - PRIOR.0) * nominal)
        }
        "added_spring" => (0.03, 0.30, structure.mean_n_per_m()),
        _ => (0.01, 0.10, 1.0),
    };
    rng.random_range(low..high) * unit
}

/// Draws a law of size ±1 with the given sign; a bilinear law always becomes stiffer in the cold.
fn draw_shape(rng: &mut ChaCha8Rng, weather: &Weather, rows: &[Row], law: &str, sign: f64) -> Option<Shape> {
    let plain = |covariate, level, values| Some(Shape { covariate, level, values, curve: None, size: sign });
    let training = training_rows(rows.len());
    match law {
        "constant" => plain(None, None, vec![sign; rows.len()]),
        "category" => {
            let level = *["A", "B", "C"].choose(rng)?;
            let values = rows.iter().map(|r| if r.operator == level { sign } else { 0.0 }).collect();
            plain(Some("operator"), Some(level), values)
        }
        "step" => {
            let (first, last) = (rows[0].day, rows[training - 1].day);
            let from = first + rng.random_range(0.25..0.75) * (last - first);
            plain(Some("time"), None, rows.iter().map(|r| if r.day > from { sign } else { 0.0 }).collect())
        }
        "lagged" => {
            let lagged_c = weather.lagged_c(rng.random_range(5.0..30.0));
            let (low, high) = quantiles(rows.iter().map(|r| r.temperature_c).collect());
            let slope = sign / (high - low);
            let values = rows.iter().map(|r| slope * (Weather::at(&lagged_c, r.day) - 20.0)).collect();
            plain(Some("temperature_c"), None, values)
        }
        _ => draw_curve(rng, rows, training, law, sign),
    }
}

/// Draws a law of a numeric column: linear, bilinear, quadratic or exponential.
fn draw_curve(rng: &mut ChaCha8Rng, rows: &[Row], training: usize, law: &str, sign: f64) -> Option<Shape> {
    let covariate = match rng.random_range(0..10) {
        0 if law == "linear" || law == "quadratic" => "amplitude_um",
        1 | 2 if law == "linear" || law == "quadratic" => "humidity_percent",
        _ => "temperature_c",
    };
    let reference = match covariate {
        "temperature_c" => 20.0,
        "humidity_percent" => 50.0,
        _ => 1.0,
    };
    let column = rows.iter().map(|r| r.column(covariate)).collect::<Vec<_>>();
    let (low, high) = quantiles(column.clone());
    let width = high - low;
    let curve: Curve = match law {
        "linear" => Arc::new(move |c| c - reference),
        "bilinear" => {
            let (knee_c, ratio) = (rng.random_range(-2.0..5.0), rng.random_range(3.0..10.0));
            let cold = column[..training].iter().filter(|c| **c < knee_c).count();
            if cold * 10 < training {
                return None;
            }
            Arc::new(move |c: f64| ratio * (c - knee_c).min(0.0) + (c - knee_c).max(0.0))
        }
        "quadratic" => {
            let bend = rng.random_range(0.4..1.5) * if rng.random_bool(0.5) { 1.0 } else { -1.0 };
            Arc::new(move |c| {
                let z = (c - reference) / width;
                z + bend * z * z
            })
        }
        _ => {
            let range =
                column.iter().copied().fold(f64::MIN, f64::max) - column.iter().copied().fold(f64::MAX, f64::min);
            let rate = rng.random_range(1.0..3.0) / range * if rng.random_bool(0.5) { 1.0 } else { -1.0 };
            Arc::new(move |c| (rate * (c - reference)).exp() - 1.0)
        }
    };
    let range = curve(high) - curve(low);
    let inner = column.iter().filter(|c| (low..=high).contains(*c)).map(|c| curve(*c)).collect::<Vec<_>>();
    let spread = inner.iter().copied().fold(f64::MIN, f64::max) - inner.iter().copied().fold(f64::MAX, f64::min);
    // The range of a curve that returns to its start does not describe it.
    if range.abs() < 0.5 * spread {
        return None;
    }
    let size = if law == "bilinear" { -1.0 } else { sign };
    let scaled: Curve = Arc::new(move |c| size * curve(c) / range);
    let values = column.iter().map(|c| scaled(*c)).collect();
    Some(Shape { covariate: Some(covariate), level: None, values, curve: Some(scaled), size })
}

/// Draws an effect that no law of the program describes.
pub fn draw_outside(
    rng: &mut ChaCha8Rng,
    structure: &Structure,
    weather: &Weather,
    rows: &[Row],
    name: &str,
) -> Effect {
    let spring = rng.random_range(0..structure.springs.len());
    let (target, columns, raw) = if name == OUTSIDE[0] {
        let values = rows.iter().map(|r| (r.temperature_c - 15.0) * (r.humidity_percent - 50.0)).collect::<Vec<_>>();
        let mass = rng.random_range(0..structure.masses_kg.len());
        (Target::Mass(mass), vec!["temperature_c", "humidity_percent"], values)
    } else if name == OUTSIDE[1] {
        let half_width_c = rng.random_range(3.0..6.0);
        let mut centre_c = weather.hourly_c[0];
        let play = |c: &f64| {
            centre_c = centre_c.clamp(c - half_width_c, c + half_width_c);
            centre_c
        };
        let behind_c = weather.hourly_c.iter().map(play).collect::<Vec<_>>();
        let values = rows.iter().map(|r| Weather::at(&behind_c, r.day) - 15.0).collect();
        (Target::Spring(spring), vec!["temperature_c"], values)
    } else {
        let values = rows.iter().map(|r| (r.temperature_c - 15.0) * (r.amplitude_um - 1.0)).collect();
        (Target::Spring(spring), vec!["temperature_c", "amplitude_um"], values)
    };
    let (low, high) = quantiles(raw.clone());
    let range = rng.random_range(0.05..0.15) * if rng.random_bool(0.5) { 1.0 } else { -1.0 };
    let signal = raw.iter().map(|v| (range * v / (high - low)).clamp(-0.6, 2.0)).collect();
    let (kind, name) = match target {
        Target::Mass(mass) => ("mass", mass_name(mass)),
        _ => ("spring", structure.springs[spring].name.clone()),
    };
    let truth = Truth {
        kind,
        name,
        between: None,
        law: "outside",
        covariate: Some(columns.join(AND)),
        level: None,
        size: range,
    };
    Effect { target, signal, curve: None, truth }
}
