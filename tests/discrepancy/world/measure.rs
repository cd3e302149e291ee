//! Measured frequencies of all rows.

use std::fmt::Write as _;

use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::effect::Effect;
use super::numbers::{normal, number, rfc3339};
use super::rows::{training_rows, Row};
use super::structure::Structure;

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
    }
    Some(())
}

/// The measurements as the program reads them.
pub fn csv(structure: &Structure, rows: &[Row]) -> String {
    let mut text = String::from("measured_at");
    for mode in 1..=structure.modes {
        let _ = write!(text, ",f{mode}_hz");
    }
    text += ",temperature_c,humidity_percent,amplitude_um,operator";
    if let Some(spring) = structure.setting {
        let _ = write!(text, ",set_{}", structure.springs[spring].name);
    }
    text.push('\n');
    for row in rows {
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
        text.push('\n');
    }
    text
}
