//! Further measurements in a world, as a person would make them.

use std::collections::BTreeMap;

use rand::{Rng, SeedableRng};
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
#[derive(Debug, Clone, PartialEq)]
pub enum Done {
    MoreRows,
    /// A body of so many kg is fixed to a mass.
    Hung(String, f64),
    /// An instrument without the faults of the first is used.
    SecondInstrument,
    /// A mass is weighed.
    Weighed(String),
    /// One more mode is measured.
    FurtherMode,
    /// Mode shapes are measured at these masses.
    Shapes(Vec<String>),
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
        if *done == Done::FurtherMode {
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
        let name = match done {
            Done::Hung(mass, _) => format!("hung_kg_{mass}"),
            Done::Weighed(mass) => format!("weighed_kg_{mass}"),
            Done::SecondInstrument => "second_instrument".to_owned(),
            Done::Shapes(points) => {
                let mode = |mode: usize| points.iter().map(move |point| format!("phi{mode}_{point}"));
                (1..=structure.modes).flat_map(mode).collect::<Vec<_>>().join(",")
            }
            Done::MoreRows | Done::FurtherMode => return Some((structure.toml(), csv(&structure, &rows, None))),
        };
        let table = csv(&structure, &rows, None);
        let lines = table.lines().zip(std::iter::once(name).chain(cells));
        let toml = match done {
            Done::Shapes(points) => {
                let declared = format!("mode_shapes = {{ points = {points:?}, noise = {SHAPE_NOISE:?} }}\n");
                structure.toml().replacen("measurement_noise", &format!("{declared}measurement_noise"), 1)
            }
            _ => structure.toml(),
        };
        Some((toml, lines.map(|(line, cell)| format!("{line},{cell}\n")).collect()))
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
            (_, Some("time")) => effect.signal[last.index],
            (Some(curve), Some(column)) => curve(row.column(column)),
            _ => effect.signal[near.index],
        };
        let gains = self.effects.iter().map(gain).collect();
        Some((row, gains))
    }
}

/// The frequencies of a row, and the cell of the column that says what was done.
fn measured(
    rng: &mut ChaCha8Rng,
    structure: &Structure,
    hidden: &Hidden,
    (mut row, gains): (Row, Vec<f64>),
    done: &Done,
    balance: f64,
) -> Option<(Row, String)> {
    let mass = |name: &str| (0..structure.masses_kg.len()).find(|m| mass_name(*m) == name);
    let of_instrument = |e: &Effect| matches!(e.target, Target::Scale(_) | Target::Offset);
    let acts = |e: &Effect| *done != Done::SecondInstrument || !of_instrument(e);
    let effects = hidden.effects.iter().zip(&gains).filter(|(e, _)| acts(e));
    let mut all = effects.map(|(e, gain)| (e.target.clone(), *gain)).collect::<Vec<_>>();
    if let Done::Hung(name, kg) = done {
        all.push((Target::Body(mass(name)?), *kg));
    }
    let all = all.iter().map(|(target, gain)| (target, *gain)).collect::<Vec<_>>();
    let free = hidden.population.iter().map(|(mean, sd)| mean + sd * normal(rng)).collect::<Vec<_>>();
    let clean = structure.log_frequencies(row.set, &free, &all)?;
    row.log_f = clean.iter().map(|f| Some(f + (structure.noise * normal(rng)).ln_1p())).collect();
    let cell = match done {
        Done::Hung(_, kg) => number(*kg),
        Done::Weighed(name) => {
            let body = mass(name)?;
            let gain = |(e, gain): (&Effect, &f64)| match e.target {
                Target::Mass(m) if m == body => *gain,
                Target::Masses => *gain,
                _ => 0.0,
            };
            let share = 1.0 + hidden.effects.iter().zip(&gains).map(gain).sum::<f64>();
            number(structure.masses_kg[body] * share * (1.0 + balance + BALANCE.1 * normal(rng)))
        }
        Done::Shapes(names) => {
            let points = names.iter().map(|name| mass(name)).collect::<Option<Vec<_>>>()?;
            let std = SHAPE_NOISE / (points.len() as f64).sqrt();
            let shapes = structure.shapes(row.set, &free, &all, &points)?;
            let noisy = shapes.into_iter().flatten().map(|x| number(x + std * normal(rng)));
            noisy.collect::<Vec<_>>().join(",")
        }
        _ => "1".to_owned(),
    };
    Some((row, cell))
}
