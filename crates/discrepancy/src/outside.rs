//! Settings that lie outside the prior of their parameter or outside the runs of a table.

use std::collections::BTreeSet;

use nalgebra::DMatrix;
use serde::{Deserialize, Serialize};

use super::data::Data;
use super::setting_candidates::distance;
use structures::physics::effect::Target;
use structures::simulator::settings::CorrectedParameters;
use structures::simulator::Simulator;

/// Log-likelihood that a setting outside its prior costs at least, nats. The prior states which values are possible, so that a
/// model under which a setting lies outside is nearly excluded; the cost grows with the distance, so that of two such models the
/// nearer one is preferred.
const OUTSIDE_NATS: f64 = 3.0;

/// How many settings lie outside under a fit, and what they cost.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Outside {
    /// Number of rows with a setting outside.
    pub rows: usize,
    /// Sum over all different settings of the log-likelihood that they cost, nats:
    ///
    /// ```text
    ///  Σ 3 (1 + ln(1 + z)),    z: distance from the prior as a share of its width
    /// ```
    ///
    /// A setting at which many rows were measured was made once, and counts once.
    pub nats: f64,
}

/// The settings of one parameter that lie outside its prior, as they were given and after the corrections that were found.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct OutsideSetting {
    /// Name of the parameter.
    pub parameter: String,
    /// Its unit; empty if none is stated.
    pub unit: String,
    /// Rows in which it was set.
    pub rows: usize,
    /// Rows in which the value given lies outside the prior.
    pub outside_rows: usize,
    /// Smallest and largest value given.
    pub given: [f64; 2],
    /// The prior.
    pub prior: [f64; 2],
    /// Rows in which the value still lies outside after the corrections.
    pub outside_rows_corrected: usize,
    /// Smallest and largest value after the corrections.
    pub corrected: [f64; 2],
}

/// The parameters of each row after the corrections of settings, `[rows][d]`. `mean`: value of a parameter that is not set, `[d]`;
/// `sizes`: sizes of all targets, `[sizes, rows]`. Corrections of single modes are left out.
pub(super) fn corrected_settings(
    data: &Data,
    rows: &[usize],
    mean: &[f64],
    targets: &[Target],
    sizes: &DMatrix<f64>,
) -> Vec<Vec<f64>> {
    let corrected = |(place, row): (usize, &usize)| {
        let theta: Vec<f64> = data.settings[*row].iter().zip(mean).map(|(set, mean)| set.unwrap_or(*mean)).collect();
        CorrectedParameters::new(&theta, targets, sizes.column(place).as_slice(), usize::MAX).theta
    };
    rows.iter().enumerate().map(corrected).collect()
}

/// Counts the settings outside their priors, given the parameters after the corrections, `[rows][d]`. For a table, a row inside
/// all priors but in a part of the range without runs is outside as well.
pub(super) fn outside(simulator: &Simulator, data: &Data, rows: &[usize], corrected: &[Vec<f64>]) -> Outside {
    let mut found = Outside::default();
    let (mut counted, mut counted_rows) = (BTreeSet::new(), BTreeSet::<Vec<u64>>::new());
    for (row, theta) in rows.iter().zip(corrected) {
        let set = |k: &usize| data.settings[*row][*k].is_some();
        let mut is_outside = false;
        let mut is_set = false;
        for k in (0..theta.len()).filter(set) {
            is_set = true;
            let beyond = distance(simulator, k, theta[k]);
            // This form of the condition also counts NaN.
            let inside = beyond <= 0.0;
            if !inside {
                is_outside = true;
                if counted.insert((k, theta[k].to_bits())) {
                    found.nats += OUTSIDE_NATS * (1.0 + beyond.ln_1p());
                }
            }
        }
        if is_set && !is_outside && simulator.table().is_some_and(|table| table.is_outside(theta)) {
            is_outside = true;
            let settings = (0..theta.len()).filter(set).map(|k| theta[k].to_bits()).collect();
            if counted_rows.insert(settings) {
                found.nats += OUTSIDE_NATS;
            }
        }
        found.rows += usize::from(is_outside);
    }
    found
}

/// The settings of each parameter of which any value given lies outside the prior.
pub(super) fn outside_settings(
    simulator: &Simulator,
    data: &Data,
    rows: &[usize],
    corrected: &[Vec<f64>],
) -> Vec<OutsideSetting> {
    let range = |values: &[f64]| {
        let ends = values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(*v), h.max(*v)));
        [ends.0, ends.1]
    };
    let mut found = Vec::new();
    // Without settings, nothing was corrected.
    let parameters = if corrected.is_empty() { 0 } else { simulator.space().len() };
    for (k, p) in simulator.space().iter().enumerate().take(parameters) {
        let places: Vec<usize> = (0..rows.len()).filter(|place| data.settings[rows[*place]][k].is_some()).collect();
        let given: Vec<f64> = places.iter().filter_map(|place| data.settings[rows[*place]][k]).collect();
        let after: Vec<f64> = places.iter().map(|place| corrected[*place][k]).collect();
        let count = |values: &[f64]| values.iter().filter(|v| distance(simulator, k, **v) > 0.0).count();
        if count(&given) > 0 {
            found.push(OutsideSetting {
                parameter: p.name.clone(),
                unit: p.unit.clone(),
                rows: given.len(),
                outside_rows: count(&given),
                given: range(&given),
                prior: [p.lower, p.upper],
                outside_rows_corrected: count(&after),
                corrected: range(&after),
            });
        }
    }
    found
}

impl OutsideSetting {
    /// The finding as a sentence, with what became of it.
    pub fn sentence(&self) -> String {
        let unit = if self.unit.is_empty() { String::new() } else { format!(" {}", self.unit) };
        let range = |[low, high]: [f64; 2]| format!("{} to {}{unit}", shown(low), shown(high));
        let finding = format!(
            "the setting {} lies outside the prior of the parameter ({}) in {} of {} rows: the values given are {}",
            self.parameter,
            range(self.prior),
            self.outside_rows,
            self.rows,
            range(self.given)
        );
        let same = |(a, b): (&f64, &f64)| a.to_bits() == b.to_bits();
        let after = if self.corrected.iter().zip(&self.given).all(same) {
            "no correction of its frame, scale, unit, sign or direction brings them inside; they were limited to half the width of \
             the prior beyond it"
                .to_owned()
        } else if self.outside_rows_corrected == 0 {
            format!("with the corrections below they are {}, inside the prior", range(self.corrected))
        } else {
            format!(
                "with the corrections below they are {}, and {} rows remain outside",
                range(self.corrected),
                self.outside_rows_corrected
            )
        };
        format!("{finding}; {after}")
    }
}

/// A number with four significant digits.
fn shown(value: f64) -> String {
    let digits = (3 - value.abs().max(1e-12).log10().floor() as i32).clamp(0, 9) as usize;
    format!("{value:.digits$}")
}
