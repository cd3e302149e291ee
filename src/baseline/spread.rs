//! Repair of the spread of draws that the simulation does not correct, learned on simulations of its own (conformal calibration).
//!
//! Draws that were weighted by their likelihood need no repair. The others are those of the flow: of measurements for which too few
//! proposals are effective, and of all measurements where the flow starts at the best fit, the coefficients of an effect are
//! uncertain, or the structure is large.
//!
//! Source: Y. Romano, E. Patterson, E. Candès (2019), Conformalized quantile regression, NeurIPS; here the quantity that is
//! calibrated is the distance from the median in half widths of the interval.

use nalgebra::{DMatrix, DMatrixViewMut};
use rand::RngCore as _;

use super::calibration::{quantile_of_draws, simulations, DRAWS};
use super::error::InferenceError;
use super::manifest::SpreadCell;
use super::model::Baseline;
use super::observation::Observation;
use super::situations::Situation;
use crate::stats;

/// Simulations for each cell, as a multiple of those of the calibration.
const SIMULATIONS: usize = 2;

/// Fewest measurements of a cell from which a factor is learned. With fewer, what is wrong lies elsewhere.
const FEWEST: usize = 100;

/// Least and greatest factor: beyond, the draws have not the shape of the posterior, and no stretching helps.
const SCALES: [f64; 2] = [0.5, 2.0];

/// Draws that estimate the median of a measurement for its density.
const MEDIAN_DRAWS: usize = 200;

/// Learns the factors of a model on simulations of their own. The present factors of the model are not used.
///
/// The factor is the ⌈0.9 (n + 1)⌉-th smallest of |truth − m|/h over the n measurements of a cell whose draws the simulation does not
/// correct, where m is the median of their draws and h the half width of their 90 % interval on the side of the truth. Intervals that
/// are stretched by it hold a new truth with probability 0.9.
///
/// # Errors
/// As [`super::calibration::calibrate`].
pub(super) fn learn(baseline: &Baseline, seed: u64) -> Result<Vec<SpreadCell>, InferenceError> {
    Situation::all(baseline).iter().map(|situation| learn_cell(baseline, situation, seed)).collect()
}

fn learn_cell(baseline: &Baseline, situation: &Situation, seed: u64) -> Result<SpreadCell, InferenceError> {
    let mut stream = stats::stream(seed, &situation.purpose());
    let set = baseline
        .simulator()
        .training_set(SIMULATIONS * simulations(baseline), stream.next_u64())
        .map_err(|e| InferenceError::Simulation(e.to_string()))?;
    let observations = situation.observe(baseline, &set, &mut stream);
    let drawn = baseline.infer_as_known(&observations, DRAWS, stream.next_u64())?;
    let theta = drawn.samples.theta();
    let scale = |column: usize| {
        let needed = |row: usize| {
            let own: Vec<f64> = theta.column(column).rows(row * DRAWS, DRAWS).iter().copied().collect();
            let [low, median, high] = [0.05, 0.5, 0.95].map(|level| quantile_of_draws(&own, level));
            let truth = set.theta[(row, column)];
            let half = if truth < median { median - low } else { high - median };
            (truth - median).abs() / half.max(f64::MIN_POSITIVE)
        };
        let mut needed: Vec<f64> = (0..observations.len()).filter(|row| !drawn.weighted[*row]).map(needed).collect();
        if needed.len() < FEWEST {
            return 1.0;
        }
        needed.sort_by(f64::total_cmp);
        let rank = (0.9 * (needed.len() + 1) as f64).ceil() as usize;
        needed[rank.min(needed.len()) - 1].clamp(SCALES[0], SCALES[1])
    };
    Ok(SpreadCell {
        noise_multiple: situation.noise_multiple,
        missing_mode: situation.missing.map(|mode| mode + 1),
        without_shapes: situation.without_shapes,
        scales: (0..baseline.space().len()).map(scale).collect(),
    })
}

impl Baseline {
    /// Stretches draws of the flow for one observation, `[draws, d]` in parameter units, about their medians and within the prior.
    pub(super) fn stretch(&self, observation: &Observation, mut theta: DMatrixViewMut<'_, f64>) {
        let scales = self.spread_of(observation);
        for ((mut column, scale), parameter) in theta.column_iter_mut().zip(scales).zip(self.space()) {
            let own: Vec<f64> = column.iter().copied().collect();
            let median = stats::quantile(&own, 0.5);
            for draw in column.iter_mut() {
                *draw = (median + scale * (*draw - median)).clamp(parameter.lower, parameter.upper);
            }
        }
    }

    /// The points that stretching moves to the rows of `theta`, k rows for each of the n observations, and Σ ln s of their
    /// observation, `[n·k]`: the density of a stretched draw is that of the flow at the former, over the exponential of the latter.
    ///
    /// # Errors
    /// As [`Baseline::infer`].
    pub(super) fn before_stretching(
        &self,
        theta: &DMatrix<f64>,
        observations: &[Observation],
    ) -> Result<(DMatrix<f64>, Vec<f64>), InferenceError> {
        let each = theta.nrows() / observations.len().max(1);
        let (mut before, mut log_stretch) = (theta.clone(), vec![0.0; theta.nrows()]);
        for (row, observation) in observations.iter().enumerate() {
            let known = observation.at_each_size();
            let alike = if known.is_empty() { std::slice::from_ref(observation) } else { &known };
            let drawn = self.propose(alike, MEDIAN_DRAWS.div_ceil(alike.len()), row as u64)?.theta;
            let scales = self.spread_of(observation);
            for (column, scale) in scales.iter().enumerate() {
                let parameter = &self.space().as_slice()[column];
                let own: Vec<f64> = drawn.column(column).iter().copied().collect();
                let median = stats::quantile(&own, 0.5);
                for value in before.view_mut((row * each, column), (each, 1)).iter_mut() {
                    *value = (median + (*value - median) / scale).clamp(parameter.lower, parameter.upper);
                }
            }
            log_stretch[row * each..(row + 1) * each].fill(scales.iter().map(|scale| scale.ln()).sum());
        }
        Ok((before, log_stretch))
    }

    /// The factor of each parameter for one observation, `[d]`: that of the cells with its missing modes, or the mean of several such
    /// cells; interpolated in the logarithm of the noise.
    fn spread_of(&self, observation: &Observation) -> Vec<f64> {
        let shapes = observation.has_shapes();
        let cells: Vec<&SpreadCell> =
            self.manifest().spread.iter().filter(|cell| cell.without_shapes != Some(shapes)).collect();
        let missing: Vec<usize> = (0..observation.frequencies_hz.len())
            .filter(|&mode| observation.frequencies_hz[mode].is_none())
            .map(|mode| mode + 1)
            .filter(|mode| cells.iter().any(|cell| cell.missing_mode == Some(*mode)))
            .collect();
        let groups: Vec<Option<usize>> =
            if missing.is_empty() { vec![None] } else { missing.into_iter().map(Some).collect() };
        let noise = observation.mean_noise_multiple().ln();
        let mut scales = vec![0.0; self.space().len()];
        for group in &groups {
            let of_group: Vec<(f64, &[f64])> = cells
                .iter()
                .filter(|cell| cell.missing_mode == *group)
                .map(|cell| (cell.noise_multiple.ln(), cell.scales.as_slice()))
                .collect();
            for (column, scale) in scales.iter_mut().enumerate() {
                *scale += interpolated(&of_group, column, noise) / groups.len() as f64;
            }
        }
        scales
    }
}

/// The factor of one parameter between cells in ascending order of their noise; 1 without cells.
fn interpolated(cells: &[(f64, &[f64])], column: usize, noise: f64) -> f64 {
    let above = cells.partition_point(|(level, _)| *level < noise);
    let at = |index: usize| cells[index].1[column];
    match (cells.len(), above) {
        (0, _) => 1.0,
        (_, 0) => at(0),
        (count, above) if above == count => at(count - 1),
        (_, above) => {
            let (below_level, above_level) = (cells[above - 1].0, cells[above].0);
            let share = (noise - below_level) / (above_level - below_level);
            at(above - 1) + share * (at(above) - at(above - 1))
        }
    }
}
