//! Further measurements in a world, as a person would make them.

use std::collections::BTreeMap;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;

use super::effect::Effect;
use super::measure::csv;
use super::numbers::{normal, number};
use super::rows::Row;
use super::structure::{mass_name, Structure, Target};

/// Relative errors of a balance: one that stays for the day, and one of each weighing.
const BALANCE: (f64, f64) = (0.005, 0.0005);

/// What only the world knows.
#[derive(Clone)]
pub struct Hidden {
    pub structure: Structure,
    /// Mean and standard deviation of each free stiffness.
    pub population: Vec<(f64, f64)>,
    pub effects: Vec<Effect>,
    pub rows: Vec<Row>,
}

/// What is done in a further measurement.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Done {
    /// A body of so many kg is fixed to a mass.
    pub hung: Option<(String, f64)>,
    /// An instrument without the faults of the first is used.
    pub second_instrument: bool,
    /// A mass is weighed.
    pub weighed: Option<String>,
    /// One more mode is measured.
    pub further_mode: bool,
    /// Masses at which mode shapes are measured.
    pub points: Vec<String>,
}

/// Noise of a component of a measured shape as a share of the root mean square of the shape.
const SHAPE_NOISE: f64 = 0.03;

/// Values of columns and of the setting in which to measure.
pub type Condition = BTreeMap<String, String>;

impl Hidden {
    /// Structure file and table of `repeats` rows in each condition; `None` if they cannot be measured.
    pub fn follow(&self, seed: u64, done: &Done, conditions: &[Condition], repeats: usize) -> Option<(String, String)> {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let mut structure = self.structure.clone();
        if done.further_mode {
            structure.modes += 1;
        }
        let balance = BALANCE.0 * normal(&mut rng);
        let mut rows = Vec::new();
        let mut cells = Vec::new();
        for condition in conditions {
            for _ in 0..repeats {
                let (row, gains) = self.row_in(condition, rows.len())?;
                let (row, cell) = measured(&mut rng, &structure, self, (row, gains), done, balance)?;
                rows.push(row);
                cells.push(cell);
            }
        }
        let mut names = Vec::new();
        names.extend(done.hung.iter().map(|(mass, _)| format!("hung_kg_{mass}")));
        names.extend(done.weighed.iter().map(|mass| format!("weighed_kg_{mass}")));
        names.extend(done.second_instrument.then(|| "second_instrument".to_owned()));
        if !done.points.is_empty() {
            let mode = |mode: usize| done.points.iter().map(move |point| format!("phi{mode}_{point}"));
            names.extend((1..=structure.modes).flat_map(mode));
        }
        let table = csv(&structure, &rows, None);
        let lines = table.lines().zip(std::iter::once(names).chain(cells));
        let mut toml = structure.toml();
        if !done.points.is_empty() {
            let declared = format!("mode_shapes = {{ points = {:?}, noise = {SHAPE_NOISE:?} }}\n", done.points);
            toml = toml.replacen("measurement_noise", &format!("{declared}measurement_noise"), 1);
        }
        let joined = |(line, cells): (&str, Vec<String>)| {
            std::iter::once(line.to_owned()).chain(cells).collect::<Vec<_>>().join(",") + "\n"
        };
        Some((toml, lines.map(joined).collect()))
    }

    /// A row in a condition, `place` hours after the last one, and the value of each effect in it.
    fn row_in(&self, condition: &Condition, place: usize) -> Option<(Row, Vec<f64>)> {
        let last = self.rows.last()?;
        let numbers = |name: &str| condition.get(name).and_then(|v| v.parse::<f64>().ok());
        let columns = ["temperature_c", "humidity_percent", "amplitude_um"];
        let distance = |row: &Row| {
            let of = |name: &&str| {
                numbers(name).map_or(0.0, |wanted| ((row.column(name) - wanted) / (1.0 + wanted.abs())).powi(2))
            };
            columns.iter().map(of).sum::<f64>()
        };
        let fitting = |row: &&Row| condition.get("operator").is_none_or(|wanted| row.operator == wanted);
        let near = self
            .rows
            .iter()
            .filter(fitting)
            .min_by(|a, b| distance(a).total_cmp(&distance(b)).then(b.index.cmp(&a.index)))?;
        let mut row = near.clone();
        (row.day, row.at_s) = (last.day + place as f64 / 24.0, last.at_s + 3_600 * (1 + place as i64));
        (row.outlier, row.log_f) = (false, Vec::new());
        for name in columns {
            if let Some(wanted) = numbers(name) {
                match name {
                    "temperature_c" => row.temperature_c = wanted,
                    "humidity_percent" => row.humidity_percent = wanted,
                    _ => row.amplitude_um = wanted,
                }
            }
        }
        if let Some(set) = self.structure.setting.and_then(|s| numbers(&self.structure.springs[s].name)) {
            row.set = set;
        }
        let gain = |effect: &Effect| match (&effect.curve, effect.truth.covariate.as_deref()) {
            // Neither what goes with time nor what follows the weather with a delay of days changes within the hours of the visit.
            (_, Some("time")) => effect.signal[last.index],
            _ if effect.truth.law == "lagged" => effect.signal[last.index],
            (Some(curve), Some(column)) => curve(row.column(column)),
            _ => effect.signal[near.index],
        };
        let gains = self.effects.iter().map(gain).collect();
        Some((row, gains))
    }
}

/// The frequencies of a row, and the cells of the columns that say what was done.
fn measured(
    rng: &mut ChaCha8Rng,
    structure: &Structure,
    hidden: &Hidden,
    (mut row, gains): (Row, Vec<f64>),
    done: &Done,
    balance: f64,
) -> Option<(Row, Vec<String>)> {
    let mass = |name: &str| (0..structure.masses_kg.len()).find(|m| mass_name(*m) == name);
    let of_instrument = |e: &Effect| matches!(e.target, Target::Scale(_) | Target::Offset);
    let acts = |e: &Effect| !done.second_instrument || !of_instrument(e);
    let effects = hidden.effects.iter().zip(&gains).filter(|(e, _)| acts(e));
    let mut all = effects.map(|(e, gain)| (e.target.clone(), *gain)).collect::<Vec<_>>();
    if let Some((name, kg)) = &done.hung {
        all.push((Target::Body(mass(name)?), *kg));
    }
    let all = all.iter().map(|(target, gain)| (target, *gain)).collect::<Vec<_>>();
    let free = hidden.population.iter().map(|(mean, sd)| mean + sd * normal(rng)).collect::<Vec<_>>();
    let clean = structure.log_frequencies(row.set, &free, &all)?;
    row.log_f = clean.iter().map(|f| Some(f + (structure.noise * normal(rng)).ln_1p())).collect();
    let mut cells = Vec::new();
    cells.extend(done.hung.iter().map(|(_, kg)| number(*kg)));
    if let Some(name) = &done.weighed {
        let body = mass(name)?;
        let gain = |(e, gain): (&Effect, &f64)| match e.target {
            Target::Mass(m) if m == body => *gain,
            Target::Masses => *gain,
            _ => 0.0,
        };
        let share = 1.0 + hidden.effects.iter().zip(&gains).map(gain).sum::<f64>();
        cells.push(number(structure.masses_kg[body] * share * (1.0 + balance + BALANCE.1 * normal(rng))));
    }
    cells.extend(done.second_instrument.then(|| "1".to_owned()));
    if !done.points.is_empty() {
        let points = done.points.iter().map(|name| mass(name)).collect::<Option<Vec<_>>>()?;
        let std = SHAPE_NOISE / (points.len() as f64).sqrt();
        let shapes = structure.shapes(row.set, &free, &all, &points)?;
        cells.extend(shapes.into_iter().flatten().map(|x| number(x + std * normal(rng))));
    }
    Some((row, cells))
}
