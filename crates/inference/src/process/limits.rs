//! What healthy operation of a process reaches on the charts, from simulation.

use std::sync::atomic::{AtomicUsize, Ordering};

use nalgebra::{DMatrix, DVector};
use rand::Rng as _;
use rand_distr::StandardNormal;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::change::{Evidence, AGES, WINDOW};
use super::direction::ChangeDirection;
use super::estimate::Observation;
use super::filter::Filter;
use super::fit::{Progress, Watch};
use super::model::{Numbers, Process};
use super::score::{of_misfit as of_misfit_alone, of_one, of_several};
use structures::stats::{self, Stream};

/// Share of the wanted run length within which false alarms are counted: early ones are enough to set the limits, and cost less.
const EARLY: f64 = 0.1;

/// Batches that are simulated in total, and the least and greatest number of operations among which they are divided.
const BATCHES: usize = 200_000;
const OPERATIONS: [usize; 2] = [400, 2_000];

/// Longest operation that is simulated, in batches.
const LONGEST: usize = 2_000;

/// Ratio of the two runs from which longer ones are continued.
pub const CONTINUED_FROM: f64 = 10.0;

/// Charts whose evidence is compared with limits: single quantities, all together and the misfit, fast and slow.
const CHARTS: usize = 6;

/// Batches below the limits after which an alarm has ended.
const QUIET: usize = 3;

/// Batches after which the gain of the filter no longer changes.
const SETTLED: usize = 200;

/// Limits of the charts, in standard deviations.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct Limits {
    /// Of a single quantity.
    pub quantity: Evidence,
    /// Of all quantities together.
    pub joint: Evidence,
    /// Of the misfit, where there is one.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub misfit: Option<Evidence>,
}

/// The filter in steady operation: one batch a step, which informs all quantities as well as the reference's batches on average.
pub struct Steady {
    numbers: Numbers,
    contributions: DMatrix<f64>,
    gain: DMatrix<f64>,
    /// Gᵀ S⁻¹ for each age, `[WINDOW]` of `[d, d]`.
    weights: Vec<DMatrix<f64>>,
    /// I for each of [`AGES`].
    information: Vec<DMatrix<f64>>,
}

/// A simulated structure in operation.
struct Operation<'a> {
    steady: &'a Steady,
    truth: Numbers,
    contributions: DMatrix<f64>,
    /// Factor of the covariance of the errors.
    errors: DMatrix<f64>,
    state: DVector<f64>,
    filtered: DVector<f64>,
    /// The last innovations, the newest last.
    recent: Vec<DVector<f64>>,
}

impl Steady {
    /// The steady filter of a process; `None` if its covariances are not positive definite.
    pub fn new(process: &Process) -> Option<Self> {
        let d = process.sizes().quantities;
        let numbers = process.in_operation();
        let filter = Filter::exact(numbers.clone());
        // On average, the square of a factor is 1.
        let mut errors = DMatrix::from_column_slice(d, d, &process.usual_errors);
        for covariance in process.loading_covariances() {
            errors += covariance / numbers.noise;
        }
        let observation = Observation {
            steps: 1.0,
            informed: (0..d).collect(),
            mean: DVector::zeros(d),
            covariance: errors,
            covariates: DVector::zeros(process.sizes().covariates),
            missing: Vec::new(),
        };
        let mut known = filter.start();
        for _ in 0..SETTLED {
            known = filter.step(&known, &observation)?.0;
        }
        let innovation = filter.step(&known, &observation)?.1;
        let contributions = filter.contributions().clone();
        let mut taken = DMatrix::zeros(numbers.variance.len(), d);
        let (mut weights, mut information, mut sum) = (Vec::new(), Vec::new(), DMatrix::zeros(d, d));
        for age in 1..=WINDOW {
            let signature = DMatrix::identity(d, d) - &contributions * &taken;
            let weighted = signature.transpose() * &innovation.precision;
            sum += &weighted * &signature;
            taken += &innovation.gain * &signature;
            for (mut row, decay) in taken.row_iter_mut().zip(innovation.decay.iter()) {
                row *= *decay;
            }
            weights.push(weighted);
            if AGES.contains(&age) {
                information.push(sum.clone());
            }
        }
        Some(Self { numbers, contributions, gain: innovation.gain, weights, information })
    }

    /// Inverse of the part of I that belongs to the last r quantities, the misfit, for each of [`AGES`]; `None` if it is singular.
    fn of_misfit(&self, r: usize) -> Option<Vec<DMatrix<f64>>> {
        let inverse = |own: &DMatrix<f64>| {
            let first = own.nrows() - r;
            Some(own.view((first, first), (r, r)).into_owned().cholesky()?.inverse())
        };
        self.information.iter().map(inverse).collect()
    }

    /// The standard error of a loss of each quantity that has lasted for each of [`AGES`], standardised, `[ages][d]`.
    pub fn standard_errors(&self) -> Vec<Vec<f64>> {
        let of_age = |information: &DMatrix<f64>| information.diagonal().iter().map(|own| own.sqrt().recip()).collect();
        self.information.iter().map(of_age).collect()
    }
}

impl<'a> Operation<'a> {
    /// An operation of a structure whose numbers are drawn from what the reference leaves possible, after `WINDOW` batches.
    fn new(process: &Process, steady: &'a Steady, stream: &mut Stream) -> Option<Self> {
        let sizes = process.sizes();
        let d = sizes.quantities;
        let truth = Numbers::of(&process.draws[stream.random_range(0..process.draws.len())], sizes);
        let errors = DMatrix::from_column_slice(d, d, &process.usual_errors) * truth.noise;
        let state = truth.variance.map(|variance| variance.sqrt() * stream.sample::<f64, _>(StandardNormal));
        let filtered = DVector::zeros(steady.numbers.variance.len());
        let errors = errors.cholesky()?.unpack();
        let contributions = truth.contributions();
        let recent = Vec::with_capacity(2 * WINDOW);
        let mut operation = Self { steady, truth, contributions, errors, state, filtered, recent };
        (0..WINDOW).for_each(|_| operation.advance(None, stream));
        Some(operation)
    }

    /// Adds a batch; `loss`, `[d]`, is added to the parameters.
    fn advance(&mut self, loss: Option<&DVector<f64>>, stream: &mut Stream) {
        let mut normal = || stream.sample::<f64, _>(StandardNormal);
        for i in 0..self.state.len() {
            let f = self.truth.persistence[i];
            self.state[i] = f * self.state[i] + (self.truth.variance[i] * (1.0 - f * f)).sqrt() * normal();
        }
        let noise = DVector::from_fn(self.errors.nrows(), |_, _| normal());
        let mut batch = &self.truth.mean + &self.contributions * &self.state + &self.errors * noise;
        if let Some(loss) = loss {
            batch += loss;
        }
        let steady = self.steady;
        self.filtered.component_mul_assign(&steady.numbers.persistence);
        let innovation = batch - &steady.numbers.mean - &steady.contributions * &self.filtered;
        self.filtered += &steady.gain * &innovation;
        if self.recent.len() == self.recent.capacity() {
            self.recent.drain(..WINDOW);
        }
        self.recent.push(innovation);
    }

    /// Largest evidence in a single quantity, in several together, and in the misfit, at the newest batch.
    fn evidence(&self, directions: &[ChangeDirection], of_misfit: &[DMatrix<f64>]) -> [Evidence; 3] {
        let mut found = [Evidence::NONE; 3];
        let d = directions.len();
        let (mut score, mut losses) = (vec![0.0; d], vec![0.0; d]);
        for ((age, information), of_misfit) in AGES.into_iter().zip(&self.steady.information).zip(of_misfit) {
            score.fill(0.0);
            let since = &self.recent[self.recent.len() - age..];
            for (weights, innovation) in self.steady.weights.iter().zip(since) {
                for (column, value) in weights.as_slice().chunks_exact(d).zip(innovation.iter()) {
                    score.iter_mut().zip(column).for_each(|(score, weight)| *score += weight * value);
                }
            }
            for (k, own) in directions.iter().enumerate().filter(|(_, own)| own.is_damage()) {
                found[0].take(age, of_one(&score, information.as_slice(), k, own.sign()));
            }
            found[1].take(age, of_several(&score, information.as_slice(), directions, &mut losses));
            found[2].take(age, of_misfit_alone(&score, of_misfit));
        }
        found
    }
}

/// Limits at which healthy operation has as many early false alarms as a random process with one alarm in `mean_run_batches`
/// batches, over all charts of the structure together. Each operation has its own true process, drawn from what the reference leaves
/// possible. `None` if the covariances of the process are not positive definite.
///
/// The charts of single quantities, of all together and of the misfit, fast and slow, alarm equally often. An alarm is counted when it begins: the
/// evidence of successive batches is correlated, so that one alarm lasts for some of them. Limits of runs longer than ten times
/// 2,000 batches are continued from those of shorter ones, see [`continued`].
pub fn limits(process: &Process, directions: &[ChangeDirection], mean_run_batches: f64, seed: u64) -> Option<Limits> {
    watched(process, directions, mean_run_batches, seed, &|_| {})
}

/// [`limits`] with its progress.
pub fn watched(
    process: &Process,
    directions: &[ChangeDirection],
    mean_run_batches: f64,
    seed: u64,
    watch: Watch<'_>,
) -> Option<Limits> {
    let steady = Steady::new(process)?;
    let misfits = directions.iter().filter(|own| **own == ChangeDirection::Either).count();
    let of_misfit = steady.of_misfit(misfits)?;
    let longest = ((EARLY * mean_run_batches).round() as usize).clamp(1, LONGEST);
    let operations = (BATCHES / longest).clamp(OPERATIONS[0], OPERATIONS[1]);
    let done = AtomicUsize::new(0);
    let simulated = |operation: usize| {
        let mut stream = stats::stream(seed, &format!("healthy operation {operation} of a process"));
        let mut operation = Operation::new(process, &steady, &mut stream)?;
        let mut next = || {
            operation.advance(None, &mut stream);
            let [quantity, joint, misfit] = operation.evidence(directions, &of_misfit);
            [quantity.fast, quantity.slow, joint.fast, joint.slow, misfit.fast, misfit.slow]
                .map(|evidence| evidence as f32)
        };
        let evidence = (0..QUIET + longest).map(|_| next()).collect::<Vec<[f32; CHARTS]>>();
        watch(Progress::Limits { done: done.fetch_add(1, Ordering::Relaxed) + 1, all: operations });
        Some(evidence)
    };
    let all: Vec<Vec<[f32; CHARTS]>> = (0..operations).into_par_iter().filter_map(simulated).collect();
    let several = directions.iter().filter(|own| own.is_damage()).count() > 1;
    let charts = match (misfits > 0, several) {
        (true, _) => CHARTS,
        (false, true) => 4,
        (false, false) => 2,
    };
    let simulated_run = mean_run_batches.min(LONGEST as f64 / EARLY);
    let whole: Vec<&[[f32; CHARTS]]> = all.iter().map(Vec::as_slice).collect();
    let mut found = reached(&whole, simulated_run, charts);
    if simulated_run < mean_run_batches {
        let shorter = (longest as f64 / CONTINUED_FROM) as usize;
        let parts: Vec<&[[f32; CHARTS]]> = all.iter().flat_map(|own| parts(own, shorter)).collect();
        let of_shorter = reached(&parts, simulated_run / CONTINUED_FROM, charts);
        let times = mean_run_batches / simulated_run;
        found = std::array::from_fn(|chart| continued([of_shorter[chart], found[chart]], times));
    }
    let evidence = |first: usize| Evidence { fast: found[first], slow: found[first + 1] };
    Some(Limits { quantity: evidence(0), joint: evidence(2), misfit: (misfits > 0).then(|| evidence(4)) })
}

/// The limit for a run that is `times` as long as the longer one of two simulated ones, of which it is [`CONTINUED_FROM`] times as long.
///
/// ```text
///  z² = z₂² + (z₂² − z₁²) ln(times)/ln(10)
/// ```
///
/// z₁ and z₂: the limits of the shorter and of the longer run. The largest of n normal deviates with the variance σ² grows as 2σ² ln n.
pub fn continued([shorter, longer]: [f64; 2], times: f64) -> f64 {
    let slope = (longer.powi(2) - shorter.powi(2)).max(0.0) / CONTINUED_FROM.ln();
    (longer.powi(2) + slope * times.max(1.0).ln()).sqrt()
}

/// An operation in parts of `length` batches, each with the [`QUIET`] batches before it.
fn parts(operation: &[[f32; CHARTS]], length: usize) -> impl Iterator<Item = &[[f32; CHARTS]]> {
    let starts =
        (0..operation.len() - QUIET).step_by(length).filter(move |start| start + length <= operation.len() - QUIET);
    starts.map(move |start| &operation[start..start + QUIET + length])
}

/// Limits of the charts at which alarms begin in as many of some operations of equal length, each behind [`QUIET`] batches, as wanted for one
/// alarm in `mean_run_batches`; `charts` of them count.
fn reached(all: &[&[[f32; CHARTS]]], mean_run_batches: f64, charts: usize) -> [f64; CHARTS] {
    let longest = all.first().map_or(0, |own| own.len() - QUIET);
    let wanted = 1.0 - (-(longest as f64) / mean_run_batches).exp();
    let largest: [Vec<f64>; CHARTS] = std::array::from_fn(|chart| {
        let of_one = |own: &&[[f32; CHARTS]]| own[QUIET..].iter().map(|e| e[chart]).fold(f32::NEG_INFINITY, f32::max);
        all.iter().map(|own| f64::from(of_one(own))).collect()
    });
    let at = |level: f64| -> [f64; CHARTS] { std::array::from_fn(|chart| stats::quantile(&largest[chart], level)) };
    // The share of operations in which an alarm begins falls as the common level of the charts rises.
    let (mut low, mut high) = (0.0, 1.0);
    for _ in 0..40 {
        let middle = f64::midpoint(low, high);
        let limits = at(middle);
        let alarmed = all.iter().filter(|own| alarm_begins(own, &limits[..charts])).count();
        if alarmed as f64 > wanted * all.len() as f64 {
            low = middle;
        } else {
            high = middle;
        }
    }
    at(high)
}

/// Whether an alarm begins in an operation: a batch above a limit after [`QUIET`] batches below all.
fn alarm_begins(operation: &[[f32; CHARTS]], limits: &[f64]) -> bool {
    let mut quiet = 0;
    operation.iter().any(|evidence| {
        let above = evidence.iter().zip(limits).any(|(evidence, limit)| f64::from(*evidence) > *limit);
        let begins = above && quiet >= QUIET;
        quiet = if above { 0 } else { quiet + 1 };
        begins
    })
}
