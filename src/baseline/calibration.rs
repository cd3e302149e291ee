//! Is the flow as sure as it should be: ranks, coverage and TARP over the noise it was trained for and the modes that may
//! be missing.

use serde::{Deserialize, Serialize};
use statrs::distribution::{ChiSquared, ContinuousCDF as _};

use rand::Rng as _;

use super::observation::{measure, measure_shapes, Observation};
use super::{Baseline, InferenceError};
use crate::simulator::TrainingSet;
use crate::stats::{self, Stream};

/// Simulated measurements in each cell.
pub const SIMULATIONS: usize = 1_000;

/// The same where each is fitted first, see [`super::start`]; modes are then left out of none: what is missing widens the
/// fit, not the flow.
pub const SIMULATIONS_FITTED: usize = 200;

/// Posterior draws for each; a rank is one of `DRAWS` + 1 values.
pub const DRAWS: usize = 99;

/// Bins of the rank histograms.
pub const BINS: usize = 20;

/// Level of each kind of test over all cells and parameters together (Bonferroni).
const LEVEL: f64 = 0.01;

/// How far coverage of the 90 % intervals may be from 0.9 in any cell, or as far as chance takes one of all of them in
/// 1 % of right flows, if that is more.
const COVERAGE_TOLERANCE: f64 = 0.03;

/// Coverage within which intervals are left as they are: one standard deviation of the estimate.
const GOOD_COVERAGE: [f64; 2] = [0.89, 0.91];

/// What was measured of a flow's calibration; part of the manifest.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
pub struct CalibrationRecord {
    /// Simulated measurements in each cell.
    pub simulations: usize,
    /// Posterior draws for each.
    pub draws: usize,
    /// Why it fails; empty when it passes.
    pub failures: Vec<String>,
    /// The cells.
    pub cells: Vec<Cell>,
}

/// One size of noise with one set of modes.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = CalibrationCell)]
pub struct Cell {
    /// Noise as a multiple of the structure's.
    pub noise_multiple: f64,
    /// The mode that is missing, from 1; `None` for complete measurements.
    pub missing_mode: Option<usize>,
    /// Whether mode shapes are missing, of a structure that has some.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub without_shapes: Option<bool>,
    /// p-value of uniform TARP coverage, all parameters together.
    pub tarp_p_value: f64,
    /// One entry a parameter.
    pub parameters: Vec<CellParameter>,
}

/// Calibration of one parameter in one cell.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = CalibrationParameter)]
pub struct CellParameter {
    /// Name of the parameter.
    pub name: String,
    /// p-value of uniform ranks.
    pub rank_p_value: f64,
    /// Share of the true values inside the central 50 % interval.
    pub coverage_50: f64,
    /// Share of the true values inside the central 90 % interval.
    pub coverage_90: f64,
    /// Factor about the median that would give the 90 % interval its coverage (conformal); 1 where the coverage is right.
    pub interval_scale: f64,
}

/// The ranks behind a record, for plots.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CellRanks {
    /// Title of the cell.
    pub title: String,
    /// Rank of the truth among the draws, 0..=`DRAWS`, for each parameter and simulation.
    pub ranks: Vec<Vec<usize>>,
    /// The same for the TARP distances.
    pub tarp_ranks: Vec<usize>,
}

impl CalibrationRecord {
    /// True when nothing failed.
    pub fn passed(&self) -> bool {
        self.failures.is_empty()
    }

    /// Factor for the 90 % interval of parameter `column` of one measurement, with mode shapes or without, from the nearest
    /// cell.
    pub fn interval_scale(&self, column: usize, noise_multiple: f64, complete: bool, shapes: bool) -> f64 {
        // Where a flow starts at the best fit, what is missing widens the fit: the complete cells hold for all.
        let all_complete = self.cells.iter().all(|cell| cell.missing_mode.is_none());
        let fitting = self.cells.iter().filter(|cell| {
            (all_complete || cell.missing_mode.is_none() == complete) && cell.without_shapes != Some(shapes)
        });
        let distance = |cell: &&Cell| (cell.noise_multiple / noise_multiple).ln().abs();
        let nearest = fitting.min_by(|a, b| distance(a).total_cmp(&distance(b)));
        nearest.map_or(1.0, |cell| cell.parameters[column].interval_scale)
    }
}

/// Measures the calibration of a flow on simulations of its prior.
///
/// ```text
///  rank      #{draws below the truth}: uniform on 0..=L where the posterior is right (Talts et al. 2018)
///  coverage  share of the truths between the 5 % and the 95 % quantile of the draws
///  TARP      #{draws nearer to a random point than the truth is}: uniform where the joint posterior is right
///            (Lemos et al. 2023)
/// ```
///
/// Cells: twice the least noise of the range, the structure's own and the most; each complete and with each mode missing.
/// A cell that fails is measured once more, on other simulations; the record holds, and the gate counts, the second look.
///
/// # Errors
/// [`InferenceError`] when a draw is not finite; a simulation that fails inside the prior counts as such.
pub fn calibrate(baseline: &Baseline, seed: u64) -> Result<(CalibrationRecord, Vec<CellRanks>), InferenceError> {
    let Some(range) = baseline.manifest().conditions.noise_range else {
        let failure =
            "the structure has no measurement noise: posteriors of exact data are points, and no interval of \
                       them means anything; state the noise"
                .to_owned();
        let record = CalibrationRecord { simulations: 0, draws: 0, failures: vec![failure], cells: Vec::new() };
        return Ok((record, Vec::new()));
    };
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
        situations.extend(masks.iter().map(|&missing| Situation { noise_multiple, missing, without_shapes }));
    }
    if shaped {
        situations.push(Situation { noise_multiple: 1.0, missing: None, without_shapes: Some(true) });
    }
    let (mut cells, mut ranks) = (Vec::new(), Vec::new());
    for situation in &situations {
        let (cell, cell_ranks) = measure_cell(baseline, situation, seed, &situation.purpose())?;
        cells.push(cell);
        ranks.push(cell_ranks);
    }
    // Of a hundred flows that are right, one fails somewhere by chance. What fails is looked at once more, with other
    // simulations, and judged by these.
    for (index, situation) in situations.iter().enumerate() {
        if !failures_of(&cells, index, simulations(baseline)).is_empty() {
            let purpose = format!("{}, second look", situation.purpose());
            (cells[index], ranks[index]) = measure_cell(baseline, situation, seed, &purpose)?;
        }
    }
    let failures = (0..cells.len()).flat_map(|index| failures_of(&cells, index, simulations(baseline))).collect();
    Ok((CalibrationRecord { simulations: simulations(baseline), draws: DRAWS, failures, cells }, ranks))
}

/// Simulated measurements in each cell.
fn simulations(baseline: &Baseline) -> usize {
    if baseline.starts_at_fit() {
        SIMULATIONS_FITTED
    } else {
        SIMULATIONS
    }
}

/// What the measurements of a cell are like.
struct Situation {
    noise_multiple: f64,
    missing: Option<usize>,
    without_shapes: Option<bool>,
}

impl Situation {
    fn purpose(&self) -> String {
        let Self { noise_multiple, missing, without_shapes } = self;
        let shapes = if *without_shapes == Some(true) { ", without shapes" } else { "" };
        format!("calibration: noise {noise_multiple}, missing {missing:?}{shapes}")
    }
}

/// A cell in words.
pub fn place(noise_multiple: f64, missing_mode: Option<usize>, without_shapes: Option<bool>) -> String {
    let what = match (missing_mode, without_shapes) {
        (Some(mode), _) => format!("without mode {mode}"),
        (None, Some(true)) => "without shapes".to_owned(),
        (None, _) => "complete".to_owned(),
    };
    format!("noise × {noise_multiple:.3}, {what}")
}

/// A simulated measurement of each pair of a set.
fn observe(baseline: &Baseline, set: &TrainingSet, situation: &Situation, stream: &mut Stream) -> Vec<Observation> {
    let simulator = baseline.simulator();
    let one = |(index, sizes): (usize, &Vec<f64>)| {
        let exact: Vec<f64> = set.frequencies_hz.row(index).iter().copied().collect();
        let multiples: Vec<Option<f64>> = (0..exact.len())
            .map(|mode| (Some(mode) != situation.missing).then_some(situation.noise_multiple))
            .collect();
        let mut observation = measure(simulator, &exact, sizes, &multiples, stream);
        if situation.without_shapes == Some(false) {
            measure_shapes(simulator, &mut observation, &set.shapes[index], &vec![false; exact.len()], stream);
        }
        observation
    };
    set.effect_sizes.iter().enumerate().map(one).collect()
}

fn measure_cell(
    baseline: &Baseline,
    situation: &Situation,
    seed: u64,
    purpose: &str,
) -> Result<(Cell, CellRanks), InferenceError> {
    use rand::RngCore as _;
    let mut stream = stats::stream(seed, purpose);
    let simulations = simulations(baseline);
    let set = baseline
        .simulator()
        .training_set(simulations, stream.next_u64())
        .map_err(|e| InferenceError::Simulation(e.to_string()))?;
    let observations = observe(baseline, &set, situation, &mut stream);
    let samples = baseline.infer(&observations, DRAWS, stream.next_u64())?;
    let space = baseline.space();
    let unit = |row: usize, column: usize| space.as_slice()[column].to_unit(samples.theta()[(row, column)]);
    let truth = |simulation: usize, column: usize| space.as_slice()[column].to_unit(set.theta[(simulation, column)]);
    let mut ranks = vec![Vec::with_capacity(simulations); space.len()];
    let mut tarp_ranks = Vec::with_capacity(simulations);
    let mut parameters = Vec::new();
    for simulation in 0..simulations {
        let reference: Vec<f64> = (0..space.len()).map(|_| stream.random::<f64>()).collect();
        let distance = |point: &dyn Fn(usize) -> f64| -> f64 {
            reference.iter().enumerate().map(|(column, r)| (point(column) - r).powi(2)).sum()
        };
        let own = distance(&|column| truth(simulation, column));
        let drawn = simulation * DRAWS..(simulation + 1) * DRAWS;
        tarp_ranks.push(drawn.clone().filter(|&row| distance(&|column| unit(row, column)) < own).count());
        for (column, ranks) in ranks.iter_mut().enumerate() {
            ranks.push(drawn.clone().filter(|&row| unit(row, column) < truth(simulation, column)).count());
        }
    }
    for (column, parameter) in space.iter().enumerate() {
        let (mut inside_50, mut inside_90, mut needed) = (0, 0, Vec::with_capacity(simulations));
        for simulation in 0..simulations {
            let draws: Vec<f64> = (simulation * DRAWS..(simulation + 1) * DRAWS).map(|row| unit(row, column)).collect();
            let x = truth(simulation, column);
            let [low, q25, median, q75, high] =
                [0.05, 0.25, 0.5, 0.75, 0.95].map(|level| quantile_of_draws(&draws, level));
            inside_50 += usize::from((q25..=q75).contains(&x));
            inside_90 += usize::from((low..=high).contains(&x));
            let half = if x < median { median - low } else { high - median };
            needed.push((x - median).abs() / half.max(1e-12));
        }
        let coverage_90 = inside_90 as f64 / simulations as f64;
        let good = (GOOD_COVERAGE[0]..=GOOD_COVERAGE[1]).contains(&coverage_90);
        parameters.push(CellParameter {
            name: parameter.name.clone(),
            rank_p_value: uniform_p_value(&ranks[column]),
            coverage_50: inside_50 as f64 / simulations as f64,
            coverage_90,
            interval_scale: if good { 1.0 } else { stats::quantile(&needed, 0.9) },
        });
    }
    let cell = Cell {
        noise_multiple: situation.noise_multiple,
        missing_mode: situation.missing.map(|mode| mode + 1),
        without_shapes: situation.without_shapes,
        tarp_p_value: uniform_p_value(&tarp_ranks),
        parameters,
    };
    let title = place(cell.noise_multiple, cell.missing_mode, cell.without_shapes);
    Ok((cell, CellRanks { title, ranks, tarp_ranks }))
}

/// Quantile of few draws without the bias of interpolating between order statistics: the k-th of L draws stands at
/// k/(L + 1).
fn quantile_of_draws(draws: &[f64], level: f64) -> f64 {
    let mut sorted = draws.to_vec();
    sorted.sort_by(f64::total_cmp);
    let position = level * (sorted.len() + 1) as f64 - 1.0;
    let below = (position.floor().max(0.0) as usize).min(sorted.len() - 1);
    let above = (below + 1).min(sorted.len() - 1);
    sorted[below] + (position - below as f64).clamp(0.0, 1.0) * (sorted[above] - sorted[below])
}

/// p-value of χ² for ranks spread evenly over [`BINS`] bins.
pub fn uniform_p_value(ranks: &[usize]) -> f64 {
    let mut counts = [0.0; BINS];
    for rank in ranks {
        counts[rank * BINS / (DRAWS + 1)] += 1.0;
    }
    let expected = ranks.len() as f64 / BINS as f64;
    let statistic: f64 = counts.iter().map(|count| (count - expected).powi(2) / expected).sum();
    ChiSquared::new((BINS - 1) as f64).map_or(f64::NAN, |distribution| distribution.sf(statistic))
}

/// What fails in a cell; the levels are shared out over all cells.
fn failures_of(cells: &[Cell], index: usize, simulations: usize) -> Vec<String> {
    let cell = &cells[index];
    let parameters: usize = cells.iter().map(|cell| cell.parameters.len()).sum();
    let chance =
        -stats::normal_quantile(0.5 * LEVEL / parameters.max(1) as f64) * (0.9 * 0.1 / simulations as f64).sqrt();
    let tolerance = COVERAGE_TOLERANCE.max(chance);
    let mut failures = Vec::new();
    let place = place(cell.noise_multiple, cell.missing_mode, cell.without_shapes);
    for p in &cell.parameters {
        if (p.coverage_90 - 0.9).abs() > tolerance {
            failures.push(format!("{place}: 90 % intervals of {} cover {:.3}", p.name, p.coverage_90));
        }
        if p.rank_p_value.is_nan() || p.rank_p_value * (parameters as f64) < LEVEL {
            failures.push(format!("{place}: ranks of {} are not uniform (p = {:.1e})", p.name, p.rank_p_value));
        }
    }
    if cell.tarp_p_value.is_nan() || cell.tarp_p_value * (cells.len() as f64) < LEVEL {
        failures.push(format!("{place}: TARP coverage is not uniform (p = {:.1e})", cell.tarp_p_value));
    }
    failures
}
