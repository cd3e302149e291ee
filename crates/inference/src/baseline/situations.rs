//! The kinds of measurement for which a model is calibrated: noise level, missing mode, and whether shapes are missing.

use super::manifest::Cell;
use super::model::Baseline;
use super::observation::{measure, measure_shapes, Observation};
use structures::simulator::TrainingSet;
use structures::stats::Stream;

/// A kind of measurement: noise multiple, missing mode (from 0), and whether shapes are missing.
pub(super) struct Situation {
    pub(super) noise_multiple: f64,
    pub(super) missing: Option<usize>,
    pub(super) without_shapes: Option<bool>,
}

impl Situation {
    /// The situations of a model: twice the smallest noise of the range, the structure's noise, and the largest noise of the range;
    /// each with complete measurements and with each mode missing. Empty for a structure without measurement noise.
    ///
    /// Where the flow starts at the best fit, missing modes widen the fit and not the flow, so that they are omitted.
    pub(super) fn all(baseline: &Baseline) -> Vec<Self> {
        let Some(range) = baseline.manifest().conditions.noise_range else { return Vec::new() };
        let modes = baseline.simulator().modes();
        let mut masks = vec![None];
        if modes > 1 && !baseline.starts_at_fit() {
            masks.extend((0..modes).map(Some));
        }
        let mut noises =
            vec![(2.0 * range.lowest).min(range.highest), 1.0_f64.clamp(range.lowest, range.highest), range.highest];
        noises.dedup();
        let shaped = baseline.simulator().shape_points() > 0;
        let mut situations = Vec::new();
        for noise_multiple in noises {
            let without_shapes = shaped.then_some(false);
            situations.extend(masks.iter().map(|&missing| Self { noise_multiple, missing, without_shapes }));
        }
        if shaped {
            situations.push(Self { noise_multiple: 1.0, missing: None, without_shapes: Some(true) });
        }
        situations
    }

    /// Purpose of the random stream of this situation.
    pub(super) fn purpose(&self) -> String {
        let Self { noise_multiple, missing, without_shapes } = self;
        let shapes = if *without_shapes == Some(true) { ", without shapes" } else { "" };
        format!("calibration: noise {noise_multiple}, missing {missing:?}{shapes}")
    }

    /// One simulated measurement of each pair of a set.
    pub(super) fn observe(&self, baseline: &Baseline, set: &TrainingSet, stream: &mut Stream) -> Vec<Observation> {
        let simulator = baseline.simulator();
        let one = |(index, sizes): (usize, &Vec<f64>)| {
            let exact: Vec<f64> = set.frequencies_hz.row(index).iter().copied().collect();
            let multiples: Vec<Option<f64>> =
                (0..exact.len()).map(|mode| (Some(mode) != self.missing).then_some(self.noise_multiple)).collect();
            let mut observation = measure(simulator, &exact, sizes, &multiples, stream);
            if self.without_shapes == Some(false) {
                measure_shapes(simulator, &mut observation, &set.shapes[index], &vec![false; exact.len()], stream);
            }
            observation
        };
        set.effect_sizes.iter().enumerate().map(one).collect()
    }
}

/// The measurements of a cell in words, such as "mode 4 is missing and the noise is a fifth of the nominal".
pub fn cell_words(cell: &Cell) -> String {
    let what = match (cell.missing_mode, cell.without_shapes) {
        (Some(mode), _) => format!("mode {mode} is missing"),
        (None, Some(true)) => "all modes are measured without their shapes".to_owned(),
        (None, Some(false)) => "all modes are measured with their shapes".to_owned(),
        (None, None) => "all modes are measured".to_owned(),
    };
    format!("{what} and the noise is {}", noise_words(cell.noise_multiple))
}

/// Short title of a cell for tables and plots, such as "0.2 times the stated noise, mode 4 missing".
pub fn cell_title(cell: &Cell) -> String {
    let what = match (cell.missing_mode, cell.without_shapes) {
        (Some(mode), _) => format!("mode {mode} missing"),
        (None, Some(true)) => "no shapes".to_owned(),
        (None, _) => "all modes".to_owned(),
    };
    format!("{} times the stated noise, {what}", plain(cell.noise_multiple))
}

/// A noise multiple in words: "a fifth of the nominal".
fn noise_words(multiple: f64) -> String {
    const FRACTIONS: [(f64, &str); 5] = [
        (2.0, "half of the nominal"),
        (3.0, "a third of the nominal"),
        (4.0, "a quarter of the nominal"),
        (5.0, "a fifth of the nominal"),
        (10.0, "a tenth of the nominal"),
    ];
    let near = |a: f64, b: f64| (a / b - 1.0).abs() < 1e-6;
    if near(multiple, 1.0) {
        return "the nominal one".to_owned();
    }
    match FRACTIONS.iter().find(|(part, _)| near(multiple * part, 1.0)) {
        Some((_, words)) => (*words).to_owned(),
        None => format!("{} times the nominal", plain(multiple)),
    }
}

/// A number with at most three digits after the point.
fn plain(value: f64) -> String {
    let text = format!("{value:.3}");
    text.trim_end_matches('0').trim_end_matches('.').to_owned()
}
