//! Calibration of the posterior: rank statistics, interval coverage and TARP (tests of accuracy with random points), over the
//! noise range of the model and the modes that may be missing.

use std::ops::Range;

use nalgebra::DMatrix;
use rand::{Rng as _, RngCore as _};
use serde::Serialize;
use statrs::distribution::{ChiSquared, ContinuousCDF as _};

use super::error::InferenceError;
use super::manifest::{CalibrationRecord, Cell, CellParameter};
use super::model::Baseline;
use super::observation::{measure, measure_shapes, Observation};
use crate::simulator::TrainingSet;
use crate::stats::{self, Stream};

/// Simulated measurements per cell.
pub const SIMULATIONS: usize = 1_000;

/// Simulated measurements per cell where the flow starts at the best fit, see [`super::start`]. Cells with missing modes
/// are then omitted, since missing modes widen the fit and not the flow.
pub const SIMULATIONS_FITTED: usize = 200;

/// Posterior draws per measurement; a rank takes one of `DRAWS` + 1 values.
pub const DRAWS: usize = 99;

/// Number of bins of the rank histograms.
pub const BINS: usize = 20;

/// Significance level of each kind of test over all cells and parameters together (Bonferroni).
const LEVEL: f64 = 0.01;

/// Largest accepted deviation of the coverage of the 90 % intervals from 0.9 in any cell. Where random variation alone
/// would exceed it somewhere for 1 % of calibrated flows, that larger deviation is accepted.
const COVERAGE_TOLERANCE: f64 = 0.03;

/// Coverage for which intervals are not rescaled: 0.9 plus or minus one standard deviation of the estimate.
const GOOD_COVERAGE: [f64; 2] = [0.89, 0.91];

/// The ranks of one cell, for plots.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CellRanks {
    /// Title of the cell.
    pub title: String,
    /// Rank of the truth among the draws, 0..=`DRAWS`, `[parameter][simulation]`.
    pub ranks: Vec<Vec<usize>>,
    /// Rank of the truth by its TARP distance, `[simulation]`.
    pub tarp_ranks: Vec<usize>,
}

/// Measures the calibration of a model on simulations from its prior.
///
/// ```text
///  rank      #{draws below the truth}: uniform on 0..=L for a calibrated posterior
///  coverage  share of the truths between the 5 % and the 95 % quantile of the draws
///  TARP      #{draws nearer to a random point than the truth}: uniform for a calibrated joint posterior
/// ```
///
/// The cells are: twice the smallest noise of the range, the structure's noise, and the largest noise of the range; each
/// with complete measurements and with each mode missing. A cell that fails is measured once more on other simulations, and
/// this second result decides.
///
/// Source: S. Talts et al. (2018), Validating Bayesian inference algorithms with simulation-based calibration,
/// arXiv:1804.06788; P. Lemos et al. (2023), Sampling-based accuracy testing of posterior estimators for general inference,
/// ICML.
///
/// # Errors
/// [`InferenceError`] when a draw is not finite or a simulation fails inside the prior.
pub fn calibrate(baseline: &Baseline, seed: u64) -> Result<(CalibrationRecord, Vec<CellRanks>), InferenceError> {
    let Some(range) = baseline.manifest().conditions.noise_range else {
        let failure =
            "the structure has no measurement noise: posteriors of exact data are points, whose intervals are \
                       meaningless; state the noise"
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
    // One in a hundred calibrated flows fails somewhere by chance. A cell that fails is therefore measured again.
    for (index, situation) in situations.iter().enumerate() {
        if !failures_of(&cells, index, simulations(baseline)).is_empty() {
            let purpose = format!("{}, second look", situation.purpose());
            (cells[index], ranks[index]) = measure_cell(baseline, situation, seed, &purpose)?;
        }
    }
    let failures = (0..cells.len()).flat_map(|index| failures_of(&cells, index, simulations(baseline))).collect();
    Ok((CalibrationRecord { simulations: simulations(baseline), draws: DRAWS, failures, cells }, ranks))
}

/// Simulated measurements per cell.
fn simulations(baseline: &Baseline) -> usize {
    if baseline.starts_at_fit() {
        SIMULATIONS_FITTED
    } else {
        SIMULATIONS
    }
}

/// The measurements of a cell: noise multiple, missing mode (from 0), and whether shapes are missing.
struct Situation {
    noise_multiple: f64,
    missing: Option<usize>,
    without_shapes: Option<bool>,
}

impl Situation {
    /// Purpose of the random stream of this cell.
    fn purpose(&self) -> String {
        let Self { noise_multiple, missing, without_shapes } = self;
        let shapes = if *without_shapes == Some(true) { ", without shapes" } else { "" };
        format!("calibration: noise {noise_multiple}, missing {missing:?}{shapes}")
    }
}

/// Describes a cell: noise level and missing mode (counted from 1).
pub fn cell_title(noise_multiple: f64, missing_mode: Option<usize>, without_shapes: Option<bool>) -> String {
    let what = match (missing_mode, without_shapes) {
        (Some(mode), _) => format!("without mode {mode}"),
        (None, Some(true)) => "without shapes".to_owned(),
        (None, _) => "complete".to_owned(),
    };
    format!("noise × {noise_multiple:.3}, {what}")
}

/// One simulated measurement of each pair of a set.
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

/// Draws of the posterior and the truths of one cell, in the unit box of the prior.
struct Drawn {
    /// `[simulation·DRAWS + draw][parameter]`
    draws: Vec<Vec<f64>>,
    /// `[simulation][parameter]`
    truths: Vec<Vec<f64>>,
}

impl Drawn {
    /// Draws for one simulation, `[DRAWS][parameter]`.
    fn of(&self, simulation: usize) -> &[Vec<f64>] {
        let rows: Range<usize> = simulation * DRAWS..(simulation + 1) * DRAWS;
        &self.draws[rows]
    }

    /// Calibration of the parameter in `column`; `ranks` are those of its truths.
    fn parameter(&self, column: usize, name: &str, ranks: &[usize]) -> CellParameter {
        let simulations = self.truths.len();
        let (mut inside_50, mut inside_90, mut needed) = (0, 0, Vec::with_capacity(simulations));
        for (simulation, truth) in self.truths.iter().enumerate() {
            let draws: Vec<f64> = self.of(simulation).iter().map(|draw| draw[column]).collect();
            let x = truth[column];
            let [low, q25, median, q75, high] =
                [0.05, 0.25, 0.5, 0.75, 0.95].map(|level| quantile_of_draws(&draws, level));
            inside_50 += usize::from((q25..=q75).contains(&x));
            inside_90 += usize::from((low..=high).contains(&x));
            let half = if x < median { median - low } else { high - median };
            needed.push((x - median).abs() / half.max(1e-12));
        }
        let coverage_90 = inside_90 as f64 / simulations as f64;
        let good = (GOOD_COVERAGE[0]..=GOOD_COVERAGE[1]).contains(&coverage_90);
        CellParameter {
            name: name.to_owned(),
            rank_p_value: uniform_p_value(ranks),
            coverage_50: inside_50 as f64 / simulations as f64,
            coverage_90,
            interval_scale: if good { 1.0 } else { stats::quantile(&needed, 0.9) },
        }
    }
}

/// Measures the calibration of one cell on new simulations, whose random stream is named `purpose`.
fn measure_cell(
    baseline: &Baseline,
    situation: &Situation,
    seed: u64,
    purpose: &str,
) -> Result<(Cell, CellRanks), InferenceError> {
    let mut stream = stats::stream(seed, purpose);
    let simulations = simulations(baseline);
    let set = baseline
        .simulator()
        .training_set(simulations, stream.next_u64())
        .map_err(|e| InferenceError::Simulation(e.to_string()))?;
    let observations = observe(baseline, &set, situation, &mut stream);
    let samples = baseline.infer(&observations, DRAWS, stream.next_u64())?;
    let space = baseline.space();
    let unit = |theta: &DMatrix<f64>| -> Vec<Vec<f64>> {
        theta.row_iter().map(|row| space.iter().zip(&row).map(|(p, x)| p.to_unit(*x)).collect()).collect()
    };
    let drawn = Drawn { draws: unit(samples.theta()), truths: unit(&set.theta) };
    let mut ranks = vec![Vec::with_capacity(simulations); space.len()];
    let mut tarp_ranks = Vec::with_capacity(simulations);
    for (simulation, truth) in drawn.truths.iter().enumerate() {
        let reference: Vec<f64> = (0..space.len()).map(|_| stream.random::<f64>()).collect();
        let distance = |point: &[f64]| -> f64 { reference.iter().zip(point).map(|(r, x)| (x - r).powi(2)).sum() };
        let (own, draws) = (distance(truth), drawn.of(simulation));
        tarp_ranks.push(draws.iter().filter(|draw| distance(draw) < own).count());
        for (column, ranks) in ranks.iter_mut().enumerate() {
            ranks.push(draws.iter().filter(|draw| draw[column] < truth[column]).count());
        }
    }
    let parameters = space.iter().zip(&ranks).enumerate();
    let parameters = parameters.map(|(column, (p, ranks))| drawn.parameter(column, &p.name, ranks)).collect();
    let cell = Cell {
        noise_multiple: situation.noise_multiple,
        missing_mode: situation.missing.map(|mode| mode + 1),
        without_shapes: situation.without_shapes,
        tarp_p_value: uniform_p_value(&tarp_ranks),
        parameters,
    };
    let title = cell_title(cell.noise_multiple, cell.missing_mode, cell.without_shapes);
    Ok((cell, CellRanks { title, ranks, tarp_ranks }))
}

/// Quantile of a small sample: the k-th of L sorted draws is the quantile at level k/(L + 1), which is unbiased for uniform
/// draws.
fn quantile_of_draws(draws: &[f64], level: f64) -> f64 {
    let mut sorted = draws.to_vec();
    sorted.sort_by(f64::total_cmp);
    let position = level * (sorted.len() + 1) as f64 - 1.0;
    let below = (position.floor().max(0.0) as usize).min(sorted.len() - 1);
    let above = (below + 1).min(sorted.len() - 1);
    sorted[below] + (position - below as f64).clamp(0.0, 1.0) * (sorted[above] - sorted[below])
}

/// p-value of the χ² test that `ranks`, `[n]`, which lie between 0 and [`DRAWS`], are uniform, in [`BINS`] bins.
///
/// ```text
///  χ² = Σ_b (n_b − n/B)²/(n/B),    B − 1 degrees of freedom
/// ```
pub fn uniform_p_value(ranks: &[usize]) -> f64 {
    let mut counts = [0.0; BINS];
    for rank in ranks {
        counts[rank * BINS / (DRAWS + 1)] += 1.0;
    }
    let expected = ranks.len() as f64 / BINS as f64;
    let statistic: f64 = counts.iter().map(|count| (count - expected).powi(2) / expected).sum();
    ChiSquared::new((BINS - 1) as f64).map_or(f64::NAN, |distribution| distribution.sf(statistic))
}

/// Reasons why a cell fails; the significance level is divided among all cells.
fn failures_of(cells: &[Cell], index: usize, simulations: usize) -> Vec<String> {
    let cell = &cells[index];
    let parameters: usize = cells.iter().map(|cell| cell.parameters.len()).sum();
    let chance =
        -stats::normal_quantile(0.5 * LEVEL / parameters.max(1) as f64) * (0.9 * 0.1 / simulations as f64).sqrt();
    let tolerance = COVERAGE_TOLERANCE.max(chance);
    let mut failures = Vec::new();
    let title = cell_title(cell.noise_multiple, cell.missing_mode, cell.without_shapes);
    for p in &cell.parameters {
        if (p.coverage_90 - 0.9).abs() > tolerance {
            failures.push(format!("{title}: 90 % intervals of {} cover {:.3}", p.name, p.coverage_90));
        }
        if p.rank_p_value.is_nan() || p.rank_p_value * (parameters as f64) < LEVEL {
            failures.push(format!("{title}: ranks of {} are not uniform (p = {:.1e})", p.name, p.rank_p_value));
        }
    }
    if cell.tarp_p_value.is_nan() || cell.tarp_p_value * (cells.len() as f64) < LEVEL {
        failures.push(format!("{title}: TARP coverage is not uniform (p = {:.1e})", cell.tarp_p_value));
    }
    failures
}
