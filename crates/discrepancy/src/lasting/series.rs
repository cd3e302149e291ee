//! What is tested for a change in time.

use crate::fit::Fit;
use crate::model::RowView;
use crate::study::Study;
use structures::stats;

/// More rows than this are averaged over successive ones.
const MOST_BINS: usize = 2_000;

/// Rows on each side of a row whose median it is compared with, and the robust standard deviations by which it may differ.
const NEIGHBOURS: usize = 6;
const OUTLIER: f64 = 5.0;

/// From the median absolute deviation to the standard deviation of a normal distribution.
const ROBUST: f64 = 1.4826;

/// A quantity that is tested.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Quantity {
    /// The residual of ln f of the mode with this index.
    Mode(usize),
    /// The best value of the parameter with this index minus its mean, as a share of the stiffness that it sets.
    Parameter(usize),
}

/// A quantity in each row; NaN where it is missing.
pub struct Series {
    /// What it is.
    pub quantity: Quantity,
    /// `[rows]`
    pub values: Vec<f64>,
}

impl Series {
    /// Its name in words.
    pub fn name(&self, study: &Study<'_>) -> String {
        match self.quantity {
            Quantity::Mode(mode) => format!("the frequency of mode {}", mode + 1),
            Quantity::Parameter(k) => {
                let what = if study.simulator.is_stiffness(k) { "stiffness" } else { "parameter" };
                format!("the {what} {}", study.simulator.space().as_slice()[k].name)
            }
        }
    }
}

/// The residual of each mode, and the best value of each free parameter, in each of the rows `views`. Single outliers are limited.
pub fn series(study: &Study<'_>, views: &[RowView], fit: &Fit) -> Vec<Series> {
    let of_mode = |mode: usize| {
        let value = |view: &RowView| {
            let place = view.present[..view.frequencies].iter().position(|present| *present == mode);
            place.map_or(f64::NAN, |place| view.residual[place])
        };
        Series { quantity: Quantity::Mode(mode), values: without_outliers(views.iter().map(value).collect()) }
    };
    let of_parameter = |k: &usize| {
        let share = study.simulator.stiffness_share(*k, fit.mean[*k]);
        let value = |view: &RowView| {
            let set = study.data.settings[view.row][*k].is_some();
            if set || view.frequencies == 0 {
                f64::NAN
            } else {
                view.deviation[*k] * share
            }
        };
        Series { quantity: Quantity::Parameter(*k), values: without_outliers(views.iter().map(value).collect()) }
    };
    (0..study.simulator.modes()).map(of_mode).chain(study.free().iter().map(of_parameter)).collect()
}

/// Limits each value to five robust standard deviations from the median of its neighbours in time, so that a step is kept and a single
/// outlier is not.
///
/// Source: F. R. Hampel (1974), JASA 69, for the identifier.
fn without_outliers(values: Vec<f64>) -> Vec<f64> {
    let known: Vec<usize> = (0..values.len()).filter(|i| values[*i].is_finite()).collect();
    let middle = |place: usize| {
        let (first, last) = (place.saturating_sub(NEIGHBOURS), (place + NEIGHBOURS + 1).min(known.len()));
        let near: Vec<f64> = known[first..last].iter().map(|i| values[*i]).collect();
        stats::quantile(&near, 0.5)
    };
    let middles: Vec<f64> = (0..known.len()).map(middle).collect();
    let off: Vec<f64> = known.iter().zip(&middles).map(|(i, m)| (values[*i] - m).abs()).collect();
    let limit = if off.is_empty() { 0.0 } else { OUTLIER * ROBUST * stats::quantile(&off, 0.5) };
    let mut limited = values;
    if limit > 0.0 {
        for (i, m) in known.iter().zip(&middles) {
            limited[*i] = limited[*i].clamp(m - limit, m + limit);
        }
    }
    limited
}

/// Number of successive rows that are averaged.
pub fn bin_size(rows: usize) -> usize {
    rows.div_ceil(MOST_BINS).max(1)
}

/// Means of the finite values of each `size` successive ones; NaN where there are none.
pub fn binned(values: &[f64], size: usize) -> Vec<f64> {
    let mean = |bin: &[f64]| {
        let known: Vec<f64> = bin.iter().copied().filter(|v| v.is_finite()).collect();
        stats::mean(&known)
    };
    values.chunks(size).map(mean).collect()
}
