//! Measured frequencies and mode shapes of all rows.

use std::fmt::Write as _;

use rand::seq::SliceRandom;
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::effect::Effect;
use super::numbers::{log_uniform, normal, number, rfc3339, rounded};
use super::rows::{training_rows, Row};
use super::structure::{mass_name, Structure};

/// Sets the measured frequencies; `None` if a row is not stable or the order of its modes changes.
pub fn measure(
    rng: &mut ChaCha8Rng,
    structure: &Structure,
    population: &[(f64, f64)],
    effects: &[Effect],
    rows: &mut [Row],
) -> Option<()> {
    let missing = rng.random_range(0.0..0.03);
    let gross = if rng.random_bool(0.25) { 0.01 } else { 0.0 };
    let training = training_rows(rows.len());
    for (index, row) in rows.iter_mut().enumerate() {
        let free = population.iter().map(|(mean, sd)| mean + sd * normal(rng)).collect::<Vec<_>>();
        let gains = effects.iter().map(|e| (&e.target, e.signal[index])).collect::<Vec<_>>();
        let clean = structure.log_frequencies(row.set, &free, &gains)?;
        let noisy = clean.iter().map(|f| f + (structure.noise * normal(rng)).ln_1p()).collect::<Vec<_>>();
        if noisy.windows(2).any(|f| f[1] <= f[0]) {
            return None;
        }
        for log_f in noisy {
            let mut log_f = log_f;
            // Not in the rows held out, where outliers would dominate the errors that are compared.
            if rng.random_bool(gross) && index < training {
                let error: f64 = rng.random_range(0.05..0.15);
                log_f += (if rng.random_bool(0.5) { error } else { -error }).ln_1p();
                row.outlier = true;
            }
            // A missing outlier leaves its row marked; the likelihood then loses one good row, which does no harm.
            row.log_f.push((!rng.random_bool(missing)).then_some(log_f));
        }
        if row.log_f.iter().all(Option::is_none) {
            return None;
        }
        row.free = free;
    }
    Some(())
}

/// Share of the shapes that are not identified although the frequency is.
const NO_SHAPE: f64 = 0.05;

/// Measured shapes: the masses that they are measured at, the noise of a component as a share of the root mean square of a shape,
/// and the shape of each mode in each row, with any norm and sign.
pub struct Shapes {
    pub points: Vec<usize>,
    pub noise: f64,
    pub rows: Vec<Vec<Option<Vec<f64>>>>,
}

impl Shapes {
    /// Measures shapes at half of the masses, at least at two.
    pub fn measure(rng: &mut ChaCha8Rng, structure: &Structure, effects: &[Effect], rows: &[Row]) -> Self {
        let n = structure.masses_kg.len();
        let mut points = (0..n).collect::<Vec<_>>();
        points.shuffle(rng);
        points.truncate(n.div_ceil(2).max(2));
        points.sort_unstable();
        let noise = rounded(rng.random_range(0.01..0.03), 2);
        let std = noise / (points.len() as f64).sqrt();
        let mut of_row = |(index, row): (usize, &Row)| {
            let gains = effects.iter().map(|e| (&e.target, e.signal[index])).collect::<Vec<_>>();
            let clean = structure.shapes(row.set, &row.free, &gains, &points).expect("the row has frequencies");
            let mut measured = |(shape, log_f): (Vec<f64>, &Option<f64>)| {
                let norm = log_uniform(rng, 0.1, 10.0) * if rng.random_bool(0.5) { 1.0 } else { -1.0 };
                let noisy = shape.iter().map(|x| norm * (x + std * normal(rng))).collect::<Vec<_>>();
                (!rng.random_bool(NO_SHAPE) && log_f.is_some()).then_some(noisy)
            };
            clean.into_iter().zip(&row.log_f).map(&mut measured).collect()
        };
        let rows = rows.iter().enumerate().map(&mut of_row).collect();
        Self { points, noise, rows }
    }
}

/// The measurements as the program reads them, with shapes if they were measured.
pub fn csv(structure: &Structure, rows: &[Row], shapes: Option<&Shapes>) -> String {
    let mut text = String::from("measured_at");
    for mode in 1..=structure.modes {
        let _ = write!(text, ",f{mode}_hz");
    }
    text += ",temperature_c,humidity_percent,amplitude_um,operator";
    if let Some(spring) = structure.setting {
        let _ = write!(text, ",set_{}", structure.springs[spring].name);
    }
    let points = shapes.map_or(&[][..], |s| &s.points[..]);
    for mode in 1..=structure.modes {
        for point in points {
            let _ = write!(text, ",phi{mode}_{}", mass_name(*point));
        }
    }
    text.push('\n');
    for (index, row) in rows.iter().enumerate() {
        text += &rfc3339(row.at_s);
        for log_f in &row.log_f {
            let cell = log_f.map_or(String::new(), |l| number(l.exp()));
            let _ = write!(text, ",{cell}");
        }
        let columns = [row.temperature_c, row.humidity_percent, row.amplitude_um];
        for column in columns {
            let _ = write!(text, ",{}", number(column));
        }
        let _ = write!(text, ",{}", row.operator);
        if structure.setting.is_some() {
            let _ = write!(text, ",{}", number(row.set));
        }
        for shape in shapes.map_or(&[][..], |s| &s.rows[index][..]) {
            for place in 0..points.len() {
                let cell = shape.as_ref().map_or(String::new(), |shape| number(shape[place]));
                let _ = write!(text, ",{cell}");
            }
        }
        text.push('\n');
    }
    text
}
