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
use structures::stats;

/// Simulations for each cell, as a multiple of those of the calibration.
const SIMULATIONS: usize = 2;

/// Fewest measurements of a cell from which a factor is learned. With fewer, what is wrong lies elsewhere.
const FEWEST: usize = 100;

/// Least and greatest factor: beyond, the draws have not the shape of the posterior, and no stretching helps.
const SCALES: [f64; 2] = [0.5, 2.0];

/// Draws that estimate the median of a measurement for its density.
const MEDIAN_DRAWS: usize = 200;

/// Learns the factors of a model on simulations of their own, for the situations that `chosen` selects by their index; 1 for the others. The
/// present factors of the model are not used.
///
/// The factor is the ⌈0.9 (n + 1)⌉-th smallest of |truth − m|/h over the n measurements of a cell whose draws the simulation does not
/// correct, where m is the median of their draws and h the half width of their 90 % interval on the side of the truth. Intervals that
/// are stretched by it hold a new truth with probability 0.9.
///
/// # Errors
/// As [`super::calibration::calibrate`].
pub(super) fn learn(
    baseline: &Baseline,
    chosen: impl Fn(usize) -> bool,
    seed: u64,
) -> Result<Vec<SpreadCell>, InferenceError> {
    let one = |(index, situation): (usize, &Situation)| {
        let scales =
            if chosen(index) { learn_cell(baseline, situation, seed)? } else { vec![1.0; baseline.space().len()] };
        Ok(SpreadCell {
            noise_multiple: situation.noise_multiple,
            missing_mode: situation.missing.map(|mode| mode + 1),
            without_shapes: situation.without_shapes,
            scales,
        })
    };
    Situation::all(baseline).iter().enumerate().map(one).collect()
}

fn learn_cell(baseline: &Baseline, situation: &Situation, seed: u64) -> Result<Vec<f64>, InferenceError> {
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
    Ok((0..baseline.space().len()).map(scale).collect())
}

impl Baseline {
    /// Whether draws of the flow are stretched for any of the observations.
    pub(super) fn stretches(&self, observations: &[Observation]) -> bool {
        !self.manifest().spread.is_empty() || observations.iter().any(|one| self.noise_beyond_training(one) > 1.0)
    }

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
    /// cells; interpolated in the logarithm of the noise. Where the noise is larger than any that the flow was trained for, it draws as
    /// for the largest, and the factor is multiplied by the ratio of the two: to first order the posterior widens in that proportion. Where
    /// draws are weighted by the likelihood, they have the width of the stated noise already.
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
        let beyond = if self.is_resampled() { 1.0 } else { self.noise_beyond_training(observation) };
        for scale in &mut scales {
            *scale *= beyond;
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

#[cfg(test)]
mod tests {
    use super::super::calibration::calibrate;
    use super::super::manifest::Outcome;
    use super::super::observation::DEFAULT_NOISE_RANGE;
    use super::super::train::train;
    use super::*;
    use crate::flow::train::TrainSettings;
    use crate::flow::FlowSettings;
    use structures::simulator::definition::StructureDefinition;
    use structures::simulator::Simulator;

    /// A structure whose effect has an uncertain coefficient, so that the simulation corrects no draw.
    const UNCERTAIN: &str = r#"
id = "pair"
modes = 2
measurement_noise = { relative = 0.003 }
mass = [{ name = "m1", kg = 1.0 }, { name = "m2", kg = 2.0 }]
spring = [
    { name = "k1", from = "ground", to = "m1" },
    { name = "k2", from = "m1", to = "m2", n_per_m = 20.0 },
]
parameter = [{ name = "k1", prior = { uniform = [5.0, 15.0] }, sets = { spring = "k1" } }]
covariate = [{ name = "temperature_c" }]
[[effect]]
name = "warm"
target = { springs = ["k2"] }
law = "linear"
covariate = "temperature_c"
reference = 10.0
numbers = { slope_per_unit = -0.004 }
covariance = [[1e-6]]
seen = [-10.0, 10.0, 30.0]
"#;

    /// A flow trained far too short, so that its intervals are wrong.
    fn hardly_trained(flow: &FlowSettings) -> Baseline {
        let simulator = Simulator::new(StructureDefinition::parse_toml(UNCERTAIN).unwrap()).unwrap();
        let settings = TrainSettings { epochs: 4, ..TrainSettings::default() };
        train(&simulator, 3_000, DEFAULT_NOISE_RANGE, flow, &settings, |_| {}).unwrap().baseline
    }

    fn multiplied(spread: &[SpreadCell], factor: f64) -> Vec<SpreadCell> {
        let one = |cell: &SpreadCell| SpreadCell {
            scales: cell.scales.iter().map(|scale| scale * factor).collect(),
            ..cell.clone()
        };
        spread.iter().map(one).collect()
    }

    #[test]
    fn the_repair_restores_the_coverage_on_other_simulations() {
        // A small one: most of the time goes to draws.
        let flow =
            FlowSettings { units: 2, width: 16, context_channels: 4, context_features: 8, ..FlowSettings::default() };
        let mut baseline = hardly_trained(&flow);
        let off = |baseline: &Baseline, seed: u64| {
            let (record, _) = calibrate(baseline, seed).unwrap();
            let of_all = record.cells.iter().flat_map(|cell| &cell.parameters);
            (of_all.map(|p| (p.coverage_90 - 0.9).abs()).fold(0.0, f64::max), record.outcome())
        };
        baseline.manifest.spread.clear();
        let (before, _) = off(&baseline, 11);
        let spread = learn(&baseline, |_| true, 12).unwrap();
        baseline.manifest.spread.clone_from(&spread);
        let (after, _) = off(&baseline, 13);
        // Binomial errors of 1000 and of 2000 simulations, of which four, over nine cells.
        let bound = 4.0 * (0.09_f64 / 1_000.0 + 0.09 / 2_000.0).sqrt();
        println!("largest deviation of a coverage from 0.9: {before:.3}, after the repair {after:.3}");
        assert!(before > bound, "the test needs a flow with wrong intervals: {before}");
        assert!(after < bound, "{after}, before {before}");
        // Deliberately too wide and too narrow.
        baseline.manifest.spread = multiplied(&spread, 0.6);
        assert_eq!(off(&baseline, 14).1, Outcome::Overconfident);
        baseline.manifest.spread = multiplied(&spread, 1.5);
        let (record, _) = calibrate(&baseline, 15).unwrap();
        assert!(record.cells.iter().flat_map(|cell| &cell.parameters).all(|p| p.coverage_90 > 0.93), "{record:?}");
    }

    #[test]
    fn stretched_draws_have_the_stretched_density() {
        let mut baseline = hardly_trained(&FlowSettings::default());
        let cell = |noise_multiple: f64| SpreadCell {
            noise_multiple,
            missing_mode: None,
            without_shapes: None,
            scales: vec![0.8],
        };
        let exact = baseline.simulator().frequencies_hz(&[10.0]).unwrap();
        let observation = Observation { effect_sizes: vec![0.0], ..Observation::complete(&exact) };
        let grid = DMatrix::from_fn(4_001, 1, |row, _| 5.0 + 10.0 * row as f64 / 4_000.0);
        let moments = |baseline: &Baseline| {
            let logs = baseline.log_likelihood_of_draws(&grid, std::slice::from_ref(&observation)).unwrap();
            let mass: f64 = logs.iter().map(|log| log.exp()).sum();
            let mean = logs.iter().zip(grid.iter()).map(|(log, x)| log.exp() * x).sum::<f64>() / mass;
            let square =
                logs.iter().zip(grid.iter()).map(|(log, x)| log.exp() * (x - mean).powi(2)).sum::<f64>() / mass;
            (mass / 4_000.0, square.sqrt())
        };
        baseline.manifest.spread.clear();
        let (mass, std) = moments(&baseline);
        baseline.manifest.spread = vec![cell(0.2), cell(5.0)];
        let (stretched_mass, stretched_std) = moments(&baseline);
        assert!((stretched_mass / mass - 1.0).abs() < 0.02, "{stretched_mass}, {mass}");
        assert!((stretched_std / std - 0.8).abs() < 0.01, "{stretched_std}, {std}");
        let drawn = baseline.infer(std::slice::from_ref(&observation), 20_000, 3).unwrap();
        let found = stats::sample_std(&drawn.column(0)).unwrap();
        // The standard error of a standard deviation of 20,000 normal draws is half a per cent.
        assert!((found / stretched_std - 1.0).abs() < 0.04, "{found}, {stretched_std}");
    }
}
