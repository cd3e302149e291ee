//! Plots of the residuals without and with the causes.

use super::figures::digits;
use crate::data::{Data, Values, TIME};
use crate::diagnosis::Outcome;
use crate::fit::Fit;
use crate::study::Study;
use structures::plot::{Plot, Points, Scatter};
use structures::simulator::Simulator;
use structures::stats;

/// Greatest number of rows that are drawn.
const MOST_DRAWN: usize = 1500;

/// Stride that spreads points evenly over an interval for data with any period: the golden ratio minus 1.
const GOLDEN: f64 = 0.618_033_988_749_895;

/// Colours of [`Points`]: orange without, blue with the causes.
const BEFORE: usize = 1;
const AFTER: usize = 0;
const SET_ASIDE: usize = 2;

/// Label of the axis of residuals.
const RESIDUAL: &str = "measured minus predicted, %";

/// How a row was used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Use {
    Searched,
    HeldOut,
    /// Since a lasting change.
    SetAside,
}

/// Rows that are drawn, with the residuals of each mode without and with the causes, per cent.
pub(super) struct Drawn<'a> {
    pub(super) data: &'a Data,
    simulator: &'a Simulator,
    pub(super) rows: Vec<usize>,
    /// How each row was used.
    uses: Vec<Use>,
    /// `[modes][rows]`, NaN for a missing mode.
    pub(super) before: Vec<Vec<f64>>,
    /// The same with the causes; `None` if there are none.
    pub(super) after: Option<Vec<Vec<f64>>>,
}

/// A covariate at the rows that are drawn.
pub(super) struct Axis {
    pub(super) label: String,
    /// Names of the categories; empty for numbers.
    pub(super) names: Vec<String>,
    pub(super) values: Vec<f64>,
}

impl<'a> Drawn<'a> {
    /// `None` if the frequencies cannot be computed in some row under one of the fits.
    pub(super) fn new(simulator: &'a Simulator, data: &'a Data, outcome: &Outcome) -> Option<Self> {
        let stride = (data.rows() as f64 / MOST_DRAWN as f64).max(1.0);
        let count = (data.rows() as f64 / stride).floor() as usize;
        // Rows are selected evenly but not periodically: a fixed period could select the same hour of every day.
        let place = |i: usize| if stride > 1.0 { (i as f64 * GOLDEN).fract() } else { 0.0 };
        let rows: Vec<usize> = (0..count).map(|i| ((i as f64 + place(i)) * stride) as usize).collect();
        // Both fits contain the effects of the structure.
        let bare = simulator.without_effects();
        let study = Study::new(&bare, data);
        let residuals = |fit: &Fit| -> Option<Vec<Vec<f64>>> {
            let mut by_mode = vec![vec![f64::NAN; rows.len()]; simulator.modes()];
            for (row, view) in study.view(&rows, fit)?.iter().enumerate() {
                for (mode, residual) in view.present[..view.frequencies].iter().zip(view.residual.iter()) {
                    by_mode[*mode][row] = 100.0 * residual;
                }
            }
            Some(by_mode)
        };
        let before = residuals(&outcome.before)?;
        let after = if outcome.diagnosis.causes.is_empty() { None } else { Some(residuals(&outcome.after)?) };
        let mut uses = vec![Use::Searched; data.rows()];
        outcome.holdout.iter().for_each(|row| uses[*row] = Use::HeldOut);
        outcome.set_aside.iter().for_each(|row| uses[*row] = Use::SetAside);
        Some(Self { data, simulator, uses: rows.iter().map(|row| uses[*row]).collect(), rows, before, after })
    }

    pub(super) fn axis(&self, name: &str) -> Axis {
        let (names, values) = match self.data.column(name).map(|c| &c.values) {
            Some(Values::Numbers(values)) => (Vec::new(), self.rows.iter().map(|r| values[*r]).collect()),
            Some(Values::Categories(names, indices)) => {
                let index = |r: &usize| indices[*r].map_or(f64::NAN, |i| i as f64);
                (names.clone(), self.rows.iter().map(index).collect())
            }
            None => (Vec::new(), self.rows.iter().map(|r| self.data.times_days[*r]).collect()),
        };
        let label = if name == TIME {
            format!("{}s since the first row", self.data.time_unit)
        } else {
            let declared = self.simulator.covariates().iter().find(|c| c.name == name).and_then(|c| c.unit.as_ref());
            declared.map_or_else(|| name.to_owned(), |unit| format!("{name}, {unit}"))
        };
        Axis { label, names, values }
    }

    /// Title of a mode's plot, with its median frequency.
    pub(super) fn title(&self, mode: usize) -> String {
        let logs = self.rows.iter().map(|r| self.data.log_frequencies[*r][mode]).filter(|y| y.is_finite());
        let logs: Vec<f64> = logs.collect();
        if logs.is_empty() {
            return format!("Mode {}, never measured", mode + 1);
        }
        format!("Mode {}, about {} Hz", mode + 1, digits(stats::quantile(&logs, 0.5).exp()))
    }

    /// Residuals of a mode over a covariate, without and with the causes.
    pub(super) fn before_and_after(&self, mode: usize, axis: &Axis) -> String {
        let fits = match &self.after {
            Some(after) => {
                vec![("without the causes", BEFORE, &self.before[mode]), ("with the causes", AFTER, &after[mode])]
            }
            None => vec![("all rows", BEFORE, &self.before[mode])],
        };
        let mut clouds = Vec::new();
        for (place, (name, colour, residuals)) in fits.iter().enumerate() {
            let shift = if fits.len() > 1 { 0.4 * place as f64 - 0.2 } else { 0.0 };
            for (used, what) in [(Use::Searched, ""), (Use::HeldOut, ", held out")] {
                let points = self.points(residuals, axis, shift, |row| self.uses[row] == used);
                let hollow = used == Use::HeldOut;
                clouds.push(Points { name: format!("{name}{what}"), colour: *colour, hollow, points });
            }
            // One cloud is enough to see what a change did.
            let last = place + 1 == fits.len();
            if last && self.uses.contains(&Use::SetAside) {
                let points = self.points(residuals, axis, shift, |row| self.uses[row] == Use::SetAside);
                let name = format!("{name}, set aside");
                clouds.push(Points { name, colour: SET_ASIDE, hollow: true, points });
            }
        }
        figure(self.title(mode), axis, clouds)
    }

    /// Points of the `chosen` rows; those of a category are spread around its position, displaced by `shift`.
    pub(super) fn points(
        &self,
        residuals: &[f64],
        axis: &Axis,
        shift: f64,
        chosen: impl Fn(usize) -> bool,
    ) -> Vec<(f64, f64)> {
        let jitter = |row: usize| {
            if axis.names.is_empty() {
                0.0
            } else {
                shift + 0.3 * ((row as f64 * GOLDEN).fract() - 0.5)
            }
        };
        let known = (0..self.rows.len()).filter(|row| chosen(*row));
        let points = known.map(|row| (axis.values[row] + jitter(row), residuals[row]));
        points.filter(|(x, y)| x.is_finite() && y.is_finite()).collect()
    }
}

/// A plot of clouds over a covariate; outliers are drawn at its edge.
pub(super) fn figure(title: String, axis: &Axis, mut clouds: Vec<Points>) -> String {
    let all: Vec<f64> = clouds.iter().flat_map(|c| c.points.iter().map(|p| p.1)).collect();
    let (low, high) = (stats::quantile(&all, 0.005), stats::quantile(&all, 0.995));
    let margin = 0.35 * (high - low);
    let mut beyond = 0;
    for (_, y) in clouds.iter_mut().flat_map(|c| &mut c.points) {
        let inside = y.max(low - margin).min(high + margin);
        beyond += usize::from((inside - *y).abs() > 0.0);
        *y = inside;
    }
    let caption = match beyond {
        0 => String::new(),
        _ => format!("{beyond} of {} points lie outside the scale and are drawn at its edge.", all.len()),
    };
    let y_label = RESIDUAL.to_owned();
    let marks = vec![(0.0, String::new())];
    let plot = Plot { title, x_label: axis.label.clone(), y_label, marks, ..Plot::default() };
    Scatter { plot, points: clouds, x_names: axis.names.clone() }.figure(&caption)
}
