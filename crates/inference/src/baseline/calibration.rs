//! Calibration of the posterior: rank statistics, interval coverage and TARP (tests of accuracy with random points), over the
//! noise range of the model and the modes that may be missing. What follows from it for the use of the model is in `judge`.

use std::ops::Range;

use nalgebra::DMatrix;
use rand::{Rng as _, RngCore as _};
use serde::Serialize;
use statrs::distribution::{ChiSquared, ContinuousCDF as _};

use super::error::InferenceError;
use super::judge::judge;
use super::manifest::{CalibrationRecord, Cell, CellParameter};
use super::model::Baseline;
use super::situations::Situation;
use structures::stats::{self, Stream};

pub use super::situations::{cell_title, cell_words};

/// Simulated measurements per cell.
pub const SIMULATIONS: usize = 1_000;

/// Simulated measurements per cell where the flow starts at the best fit, see [`super::start`]. Cells with missing modes
/// are then omitted, since missing modes widen the fit and not the flow.
pub const SIMULATIONS_FITTED: usize = 200;

/// Posterior draws per measurement; a rank takes one of `DRAWS` + 1 values.
pub const DRAWS: usize = 99;

/// Number of bins of the rank histograms.
pub const BINS: usize = 20;

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
    calibrate_watched(baseline, seed, &mut |_, _| {})
}

/// Called before each cell with the number of cells measured so far, and their number.
pub(super) type OnCell<'a> = &'a mut dyn FnMut(usize, usize);

/// As [`calibrate`]; `on_cell` learns of the progress.
///
/// # Errors
/// As [`calibrate`].
pub(super) fn calibrate_watched(
    baseline: &Baseline,
    seed: u64,
    on_cell: OnCell<'_>,
) -> Result<(CalibrationRecord, Vec<CellRanks>), InferenceError> {
    let situations = Situation::all(baseline);
    if situations.is_empty() {
        let failure =
            "the structure has no measurement noise: posteriors of exact data are points, whose intervals are \
                       meaningless; state the noise"
                .to_owned();
        let record = CalibrationRecord { failures: vec![failure], ..CalibrationRecord::default() };
        return Ok((record, Vec::new()));
    }
    judged(situations.len(), simulations(baseline), |index, second_look| {
        let situation = &situations[index];
        // The second looks come after all first ones.
        on_cell(if second_look { situations.len() } else { index }, situations.len());
        let look = if second_look { ", second look" } else { "" };
        measure_cell(baseline, situation, seed, &format!("{}{look}", situation.purpose()))
    })
}

/// Measures the cells that `chosen` selects by their index again, on other simulations; the others keep what `record` says of them. For
/// a model whose draws have changed in the chosen cells only. `on_cell` as in [`calibrate_watched`].
///
/// # Errors
/// As [`calibrate`].
pub(super) fn calibrate_again(
    baseline: &Baseline,
    record: &CalibrationRecord,
    (chosen, seed): (impl Fn(usize) -> bool, u64),
    on_cell: OnCell<'_>,
) -> Result<CalibrationRecord, InferenceError> {
    let situations = Situation::all(baseline);
    let measured = judged(situations.len(), record.simulations, |index, second_look| {
        if !chosen(index) {
            let cell = record.cells[index].clone();
            let title = cell_title(&cell);
            return Ok((cell, CellRanks { title, ranks: Vec::new(), tarp_ranks: Vec::new() }));
        }
        on_cell(if second_look { situations.len() } else { index }, situations.len());
        let look = if second_look { ", second look" } else { "" };
        measure_cell(baseline, &situations[index], seed, &format!("{}{look}", situations[index].purpose()))
    });
    measured.map(|(record, _)| record)
}

/// The record of `count` cells, which `measure` measures on `simulations` simulations each.
///
/// A few in a hundred calibrated flows fail somewhere by chance. A cell that fails is therefore measured a second time.
fn judged<E>(
    count: usize,
    simulations: usize,
    mut measure: impl FnMut(usize, bool) -> Result<(Cell, CellRanks), E>,
) -> Result<(CalibrationRecord, Vec<CellRanks>), E> {
    let (mut cells, mut ranks) = (Vec::new(), Vec::new());
    for index in 0..count {
        let (cell, cell_ranks) = measure(index, false)?;
        cells.push(cell);
        ranks.push(cell_ranks);
    }
    for index in 0..count {
        if !judge(&cells, index, simulations).is_clean() {
            (cells[index], ranks[index]) = measure(index, true)?;
        }
    }
    let mut record = CalibrationRecord { simulations, draws: DRAWS, ..CalibrationRecord::default() };
    for index in 0..count {
        let judgement = judge(&cells, index, simulations);
        record.failures.extend(judgement.narrow);
        record.cautions.extend(judgement.wide);
    }
    record.cells = cells;
    Ok((record, ranks))
}

/// Simulated measurements per cell.
pub(super) fn simulations(baseline: &Baseline) -> usize {
    if baseline.starts_at_fit() {
        SIMULATIONS_FITTED
    } else {
        SIMULATIONS
    }
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

    /// The calibration of the cell of `situation`, and its ranks. `stream` draws the reference points of TARP.
    fn cell(&self, situation: &Situation, names: &[&str], stream: &mut Stream) -> (Cell, CellRanks) {
        let simulations = self.truths.len();
        let mut ranks = vec![Vec::with_capacity(simulations); names.len()];
        let mut tarp_ranks = Vec::with_capacity(simulations);
        for (simulation, truth) in self.truths.iter().enumerate() {
            let reference: Vec<f64> = names.iter().map(|_| stream.random::<f64>()).collect();
            let distance = |point: &[f64]| -> f64 { reference.iter().zip(point).map(|(r, x)| (x - r).powi(2)).sum() };
            let (own, draws) = (distance(truth), self.of(simulation));
            tarp_ranks.push(draws.iter().filter(|draw| distance(draw) < own).count());
            for (column, ranks) in ranks.iter_mut().enumerate() {
                ranks.push(draws.iter().filter(|draw| draw[column] < truth[column]).count());
            }
        }
        let parameters = names.iter().zip(&ranks).enumerate();
        let parameters = parameters.map(|(column, (name, ranks))| self.parameter(column, name, ranks)).collect();
        let cell = Cell {
            noise_multiple: situation.noise_multiple,
            missing_mode: situation.missing.map(|mode| mode + 1),
            without_shapes: situation.without_shapes,
            tarp_p_value: uniform_p_value(&tarp_ranks),
            tarp_spread: Some(spread_of_ranks(&tarp_ranks)),
            parameters,
        };
        let title = cell_title(&cell);
        (cell, CellRanks { title, ranks, tarp_ranks })
    }

    /// Calibration of the parameter in `column`; `ranks` are those of its truths.
    fn parameter(&self, column: usize, name: &str, ranks: &[usize]) -> CellParameter {
        let simulations = self.truths.len();
        let (mut inside_50, mut inside_90, mut outside, mut needed) = (0, 0, [0; 2], Vec::with_capacity(simulations));
        for (simulation, truth) in self.truths.iter().enumerate() {
            let draws: Vec<f64> = self.of(simulation).iter().map(|draw| draw[column]).collect();
            let x = truth[column];
            let [low, q25, median, q75, high] =
                [0.05, 0.25, 0.5, 0.75, 0.95].map(|level| quantile_of_draws(&draws, level));
            inside_50 += usize::from((q25..=q75).contains(&x));
            inside_90 += usize::from((low..=high).contains(&x));
            outside[0] += usize::from(x < low);
            outside[1] += usize::from(x > high);
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
            outside_90: Some(outside.map(|count| count as f64 / simulations as f64)),
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
    let observations = situation.observe(baseline, &set, &mut stream);
    let samples = baseline.infer(&observations, DRAWS, stream.next_u64())?;
    let space = baseline.space();
    let unit = |theta: &DMatrix<f64>| -> Vec<Vec<f64>> {
        theta.row_iter().map(|row| space.iter().zip(&row).map(|(p, x)| p.to_unit(*x)).collect()).collect()
    };
    let drawn = Drawn { draws: unit(samples.theta()), truths: unit(&set.theta) };
    let names: Vec<&str> = space.iter().map(|p| p.name.as_str()).collect();
    Ok(drawn.cell(situation, &names, &mut stream))
}

/// Quantile of a small sample: the k-th of L sorted draws is the quantile at level k/(L + 1), which is unbiased for uniform
/// draws.
pub(super) fn quantile_of_draws(draws: &[f64], level: f64) -> f64 {
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

/// Mean square distance of `ranks`, `[n]`, from the middle of 0..=[`DRAWS`], as a multiple of that of uniform ranks.
///
/// ```text
///  1/n Σ (r − L/2)² / (L (L + 2)/12)
/// ```
fn spread_of_ranks(ranks: &[usize]) -> f64 {
    let most = DRAWS as f64;
    let squares: Vec<f64> = ranks.iter().map(|rank| (*rank as f64 - 0.5 * most).powi(2)).collect();
    stats::mean(&squares) / (most * (most + 2.0) / 12.0)
}

#[cfg(test)]
mod tests {
    use std::convert::Infallible;

    use rand_distr::StandardNormal;

    use super::super::manifest::Outcome;
    use super::*;

    /// The calibration of a normal posterior that is known exactly, whose draws are stretched and shifted, in six situations with two
    /// parameters each.
    ///
    /// x ~ N(0.5, 0.1²), y ~ N(x, s²): x | y ~ N(0.5 + w (y − 0.5), w s²), w = 0.1²/(0.1² + s²).
    fn of_normal(stretch: f64, shift: f64, seed: u64) -> CalibrationRecord {
        let situations: Vec<Situation> = [0.2, 1.0, 5.0]
            .into_iter()
            .flat_map(|noise_multiple| {
                [None, Some(0)].map(|missing| Situation { noise_multiple, missing, without_shapes: None })
            })
            .collect();
        let measure = |index: usize, second: bool| -> Result<_, Infallible> {
            let situation = &situations[index];
            let mut stream = stats::stream(seed, &format!("{}{second}", situation.purpose()));
            let (wide, noise) = (0.1, 0.05 * situation.noise_multiple);
            let weight = wide * wide / (wide * wide + noise * noise);
            let std = weight.sqrt() * noise;
            let normal = |stream: &mut Stream| -> f64 { stream.sample(StandardNormal) };
            let (mut truths, mut draws) = (Vec::new(), Vec::new());
            for _ in 0..SIMULATIONS {
                let truth = [0; 2].map(|_| 0.5 + wide * normal(&mut stream));
                let mean = truth.map(|x| 0.5 + weight * (x + noise * normal(&mut stream) - 0.5));
                truths.push(truth.to_vec());
                for _ in 0..DRAWS {
                    draws.push(mean.map(|m| m + std * (shift + stretch * normal(&mut stream))).to_vec());
                }
            }
            Ok(Drawn { draws, truths }.cell(situation, &["a", "b"], &mut stream))
        };
        judged(situations.len(), SIMULATIONS, measure).map_or_else(|never| match never {}, |(record, _)| record)
    }

    #[test]
    fn a_right_posterior_passes_at_the_stated_rate() {
        // Four kinds of test of 1 % each, and a second look: at most one posterior in a thousand fails.
        let passed = (0..40).filter(|seed| of_normal(1.0, 0.0, *seed).passed()).count();
        assert!(passed >= 39, "{passed} of 40");
    }

    #[test]
    fn a_widened_posterior_is_cautious_and_the_reason_is_in_words() {
        for seed in 0..5 {
            let record = of_normal(1.3, 0.0, seed);
            assert_eq!(record.outcome(), Outcome::Cautious, "{:?}", record.failures);
            assert!(record.failures.is_empty() && !record.passed());
            let said =
                "The intervals of a are too wide when mode 1 is missing and the noise is a fifth of the nominal: 9";
            assert!(record.cautions.iter().any(|reason| reason.starts_with(said)), "{:?}", record.cautions);
        }
    }

    #[test]
    fn a_narrowed_or_shifted_posterior_is_overconfident() {
        for seed in 0..5 {
            let record = of_normal(0.75, 0.0, seed);
            assert_eq!(record.outcome(), Outcome::Overconfident);
            assert!(record.failures.iter().any(|reason| reason.contains("too narrow when all modes are measured")));
            // Half a standard deviation too high: the intervals miss on one side.
            let record = of_normal(1.0, 0.5, seed);
            assert_eq!(record.outcome(), Outcome::Overconfident);
            assert!(record.failures.iter().any(|reason| reason.contains("lie too high")), "{:?}", record.failures);
            // Wide enough to hold the truths in spite of the shift on both sides: nothing is too narrow.
            assert_eq!(of_normal(2.0, 0.3, seed).outcome(), Outcome::Cautious);
        }
    }
}
