//! Global sensitivity analysis: first-order and total Sobol' indices with confidence intervals.

use std::sync::atomic::{AtomicUsize, Ordering};

use rand::RngCore as _;
use rayon::prelude::*;
use serde::Serialize;

use crate::stats;

/// Largest number of points of a scrambled Sobol' sequence. Beyond it `sobol_burley` returns unspecified numbers, and checks only
/// in debug builds.
pub const MAX_SAMPLES: usize = 1 << 16;

/// Largest number of inputs: each needs two dimensions of the sequence.
pub const MAX_INPUTS: usize = sobol_burley::NUM_DIMENSIONS as usize / 2;

/// Number of rows of one parallel task. Sums are formed within each task and then over the tasks in order, which gives the same
/// bits on any number of threads.
const TASK_ROWS: usize = 16;

/// An output is constant up to rounding if its standard deviation is below this share of its largest magnitude.
const ROUNDING: f64 = 1e-12;

/// Smallest magnitude of an output that is rejected, because sums of its squares would overflow.
const LARGEST_OUTPUT: f64 = 1e150;

/// An input of the model, uniformly distributed between two bounds and independent of the other inputs.
#[derive(Debug, Clone, PartialEq)]
pub struct Input {
    /// Name in the result.
    pub name: String,
    /// Lower bound, in the unit of the input.
    pub lower: f64,
    /// Upper bound, above the lower.
    pub upper: f64,
}

/// Number of model runs, and seed of their points.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Settings {
    /// Number of rows N of one replicate: a power of two up to [`MAX_SAMPLES`]. Sobol' points are only balanced for powers of
    /// two.
    pub samples: usize,
    /// Number of independently scrambled replicates R, at least 2. Their spread gives the confidence intervals.
    pub replicates: usize,
    /// Seed of the scramblings.
    pub seed: u64,
}

impl Default for Settings {
    fn default() -> Self {
        Self { samples: 4096, replicates: 10, seed: 0 }
    }
}

/// A Sobol' index, which is a share of the variance of an output, with its confidence interval.
///
/// The values are not restricted to 0 to 1: the estimate of a small index can be slightly negative.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Index {
    /// Mean over the replicates.
    pub value: f64,
    /// 90 % confidence interval by Student's t distribution over the replicates.
    pub interval_90: [f64; 2],
}

/// Sobol' indices of one output, with one entry for each input.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Indices {
    /// First-order indices: share of the variance that each input explains alone, `[d]`.
    pub first: Vec<Index>,
    /// Total indices: share of the variance that each input contributes to, alone or in interaction with others, `[d]`.
    pub total: Vec<Index>,
}

/// Variance of one output, and its Sobol' indices.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct OutputSensitivity {
    /// Variance over the input ranges, in the squared unit of the output.
    pub variance: f64,
    /// `None` (JSON null) if the output is constant up to rounding.
    pub indices: Option<Indices>,
}

/// Sobol' indices of all outputs for all inputs.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Sensitivity {
    /// Names of the inputs, in the order of every list of indices.
    pub inputs: Vec<String>,
    /// One entry for each output of the model, in its order.
    pub outputs: Vec<OutputSensitivity>,
    /// Number of model runs: N(d + 2)R, plus one at the centre of the ranges.
    pub evaluations: usize,
}

/// Why the indices cannot be computed.
#[derive(Debug, thiserror::Error, PartialEq)]
pub enum Error<E> {
    /// There are no inputs, or more than the sequence has dimensions for.
    #[error("{inputs} inputs: there must be 1 to {MAX_INPUTS}")]
    Inputs {
        /// Number of inputs.
        inputs: usize,
    },
    /// The range of an input is empty or infinite.
    #[error("input {name:?} has the range [{lower}, {upper}]: the bounds must be finite, the upper above the lower")]
    Range {
        /// Name of the input.
        name: String,
        /// Lower bound.
        lower: f64,
        /// Upper bound.
        upper: f64,
    },
    /// The number of samples is not one for which the sequence is balanced.
    #[error("{samples} samples: their number must be a power of two from 2 to {MAX_SAMPLES}")]
    Samples {
        /// Samples asked for.
        samples: usize,
    },
    /// There are too few replicates for an interval.
    #[error("{replicates} replicates: at least 2 are needed for an interval")]
    Replicates {
        /// Replicates asked for.
        replicates: usize,
    },
    /// The model failed.
    #[error("the model fails at {at:?}")]
    Model {
        /// Inputs of the run.
        at: Vec<f64>,
        /// Error of the model.
        source: E,
    },
    /// An output is not finite or too large.
    #[error("output {output} of the model at {at:?} is {value}: it must be finite and below {LARGEST_OUTPUT:e} in magnitude")]
    NotFinite {
        /// Inputs of the run.
        at: Vec<f64>,
        /// Index of the output, from 0.
        output: usize,
        /// Value of the output.
        value: f64,
    },
    /// The model has no outputs.
    #[error("the model has no outputs: at least one is needed")]
    NoOutputs,
    /// The number of outputs differs between runs of the model.
    #[error("the model gives {found} outputs at {at:?}, and {expected} at the centre of the ranges")]
    Outputs {
        /// Inputs of the run.
        at: Vec<f64>,
        /// Outputs of this run.
        found: usize,
        /// Outputs at the centre.
        expected: usize,
    },
}

/// First-order and total Sobol' indices of every output of `model` for every input.
///
/// ```text
///  S_i = Var(E(f | x_i)) / V = 1 − Σ_n (f(B) − f(A_B^i))² / 2NV
///  T_i = E(Var(f | x_~i)) / V =    Σ_n (f(A) − f(A_B^i))² / 2NV
/// ```
///
/// A and B are `[N, d]`, the two halves of 2d-dimensional Owen-scrambled Sobol' points. A_B^i is A with column i from B. V is the
/// variance of f over A and B together. Each replicate is scrambled independently, and an index is the mean over the replicates.
/// `model` takes the inputs `[d]` in their units and returns the outputs. It runs on all threads of the rayon pool; the result
/// has the same bits on any number of threads. `progress` is called from any thread with (runs completed, total runs), not
/// necessarily in order.
///
/// Source: Jansen (1999) for both estimators; Saltelli et al. (2010), Table 2, for the design; Owen (1998) for
/// replicates of scrambled points.
///
/// # Errors
/// [`Error`] for invalid inputs or settings, or for a model run that fails. If several runs fail, the error is always that of the
/// same one.
pub fn sobol_indices<E, F>(
    inputs: &[Input],
    settings: &Settings,
    model: F,
    progress: Option<&(dyn Fn(usize, usize) + Sync)>,
) -> Result<Sensitivity, Error<E>>
where
    F: Fn(&[f64]) -> Result<Vec<f64>, E> + Sync,
    E: Send,
{
    check(inputs, settings)?;
    let centre: Vec<f64> = inputs.iter().map(|input| 0.5 * input.lower + 0.5 * input.upper).collect();
    let outputs = model(&centre).map_err(|source| Error::Model { at: centre, source })?.len();
    if outputs == 0 {
        return Err(Error::NoOutputs);
    }
    let mut stream = stats::stream(settings.seed, "sobol scrambling");
    let scramblings = (0..settings.replicates).map(|_| stream.next_u32()).collect();
    let design = Design { inputs, samples: settings.samples, scramblings, outputs, model };
    let tasks = design.run(progress)?;
    let replicates: Vec<Replicate> =
        tasks.chunks(design.tasks_of_replicate()).map(|tasks| Replicate::of(tasks, inputs.len(), outputs)).collect();
    Ok(Sensitivity {
        inputs: inputs.iter().map(|input| input.name.clone()).collect(),
        outputs: (0..outputs).map(|output| summary(&replicates, output, inputs.len())).collect(),
        evaluations: design.runs() + 1,
    })
}

/// Checks the ranges of the inputs and the settings.
fn check<E>(inputs: &[Input], settings: &Settings) -> Result<(), Error<E>> {
    let &Settings { samples, replicates, .. } = settings;
    if inputs.is_empty() || inputs.len() > MAX_INPUTS {
        return Err(Error::Inputs { inputs: inputs.len() });
    }
    // The width of a range with finite bounds can overflow.
    let unusable = |input: &&Input| !(input.lower < input.upper && (input.upper - input.lower).is_finite());
    if let Some(Input { name, lower, upper }) = inputs.iter().find(unusable) {
        return Err(Error::Range { name: name.clone(), lower: *lower, upper: *upper });
    }
    if !(2..=MAX_SAMPLES).contains(&samples) || !samples.is_power_of_two() {
        return Err(Error::Samples { samples });
    }
    if replicates < 2 {
        return Err(Error::Replicates { replicates });
    }
    Ok(())
}

/// The design of all model runs.
struct Design<'a, F> {
    inputs: &'a [Input],
    samples: usize,
    /// Seed of the sequence of each replicate.
    scramblings: Vec<u32>,
    outputs: usize,
    model: F,
}

/// Results of some rows of one replicate.
struct Task {
    /// f(A), f(B) of the first row, f(A) of the second, …: each `[outputs]`.
    values: Vec<f64>,
    /// Σ (f(B) − f(A_B^i))², `[outputs, inputs]`.
    first: Vec<f64>,
    /// Σ (f(A) − f(A_B^i))², `[outputs, inputs]`.
    total: Vec<f64>,
}

impl<F> Design<'_, F> {
    /// Number of tasks that the rows of one replicate are divided into.
    fn tasks_of_replicate(&self) -> usize {
        self.samples.div_ceil(TASK_ROWS)
    }

    /// Number of model runs of all replicates, N(d + 2)R.
    fn runs(&self) -> usize {
        self.scramblings.len() * self.samples * (self.inputs.len() + 2)
    }

    /// Runs all tasks in parallel; returns their results in order, or the error of the first task in order that fails.
    fn run<E>(&self, progress: Option<&(dyn Fn(usize, usize) + Sync)>) -> Result<Vec<Task>, Error<E>>
    where
        F: Fn(&[f64]) -> Result<Vec<f64>, E> + Sync,
        E: Send,
    {
        let tasks = self.tasks_of_replicate();
        let done = AtomicUsize::new(0);
        // A failure cancels only later tasks, so that the first failure in order is always found.
        let first_failure = AtomicUsize::new(usize::MAX);
        let results: Vec<Option<Result<Task, Error<E>>>> = (0..tasks * self.scramblings.len())
            .into_par_iter()
            .map(|task| {
                if task > first_failure.load(Ordering::Relaxed) {
                    return None;
                }
                let first_row = task % tasks * TASK_ROWS;
                let rows = first_row..self.samples.min(first_row + TASK_ROWS);
                let runs = rows.len() * (self.inputs.len() + 2);
                let result = self.task(self.scramblings[task / tasks], rows);
                if result.is_err() {
                    first_failure.fetch_min(task, Ordering::Relaxed);
                } else if let Some(progress) = progress {
                    progress(done.fetch_add(runs, Ordering::Relaxed) + runs, self.runs());
                }
                Some(result)
            })
            .collect();
        results.into_iter().flatten().collect()
    }

    /// Runs the model for some rows of the replicate with this scrambling.
    fn task<E>(&self, scrambling: u32, rows: std::ops::Range<usize>) -> Result<Task, Error<E>>
    where
        F: Fn(&[f64]) -> Result<Vec<f64>, E>,
    {
        let (inputs, outputs) = (self.inputs.len(), self.outputs);
        let mut values = Vec::with_capacity(2 * outputs * rows.len());
        let (mut first, mut total) = (vec![0.0; outputs * inputs], vec![0.0; outputs * inputs]);
        for row in rows {
            let mut a = self.point(row, 0, scrambling);
            let b = self.point(row, inputs, scrambling);
            let (f_a, f_b) = (self.outputs_at(&a)?, self.outputs_at(&b)?);
            for input in 0..inputs {
                let of_a = std::mem::replace(&mut a[input], b[input]);
                let mixed = self.outputs_at(&a)?;
                a[input] = of_a;
                for output in 0..outputs {
                    first[output * inputs + input] += (f_b[output] - mixed[output]).powi(2);
                    total[output * inputs + input] += (f_a[output] - mixed[output]).powi(2);
                }
            }
            values.extend(f_a);
            values.extend(f_b);
        }
        Ok(Task { values, first, total })
    }

    /// Inputs of one row, taken from the dimensions of the sequence starting with `dimension`, `[d]`.
    fn point(&self, row: usize, dimension: usize, scrambling: u32) -> Vec<f64> {
        // `sobol_burley` rounds each coordinate down to a multiple of 2⁻²³. The centre of this cell is unbiased and never
        // equals a bound.
        const HALF_CELL: f64 = 1.0 / (1 << 24) as f64;
        let coordinate = |(column, input): (usize, &Input)| {
            let u = sobol_burley::sample(row as u32, (dimension + column) as u32, scrambling);
            input.lower + (f64::from(u) + HALF_CELL) * (input.upper - input.lower)
        };
        self.inputs.iter().enumerate().map(coordinate).collect()
    }

    /// Checked outputs of one model run.
    fn outputs_at<E>(&self, at: &[f64]) -> Result<Vec<f64>, Error<E>>
    where
        F: Fn(&[f64]) -> Result<Vec<f64>, E>,
    {
        let values = (self.model)(at).map_err(|source| Error::Model { at: at.to_vec(), source })?;
        if values.len() != self.outputs {
            return Err(Error::Outputs { at: at.to_vec(), found: values.len(), expected: self.outputs });
        }
        match values.iter().position(|value| value.is_nan() || value.abs() >= LARGEST_OUTPUT) {
            Some(output) => Err(Error::NotFinite { at: at.to_vec(), output, value: values[output] }),
            None => Ok(values),
        }
    }
}

/// Estimates of one replicate.
struct Replicate {
    /// Variance over A and B, and whether it exceeds rounding errors, `[outputs]`.
    variances: Vec<(f64, bool)>,
    /// Estimates of S, `[outputs, inputs]`; meaningless for a constant output.
    first: Vec<f64>,
    /// Estimates of T, `[outputs, inputs]`; meaningless for a constant output.
    total: Vec<f64>,
}

impl Replicate {
    /// Computes the estimates from all tasks of the replicate.
    fn of(tasks: &[Task], inputs: usize, outputs: usize) -> Self {
        let rows: Vec<&[f64]> = tasks.iter().flat_map(|task| task.values.chunks(outputs)).collect();
        let variances: Vec<(f64, bool)> = (0..outputs)
            .map(|output| {
                let values: Vec<f64> = rows.iter().map(|row| row[output]).collect();
                let centre = stats::mean(&values);
                let variance = values.iter().map(|v| (v - centre).powi(2)).sum::<f64>() / values.len() as f64;
                let largest = values.iter().fold(0.0_f64, |largest, v| largest.max(v.abs()));
                (variance, variance.sqrt() > ROUNDING * largest)
            })
            .collect();
        // Half the mean square, divided by the variance. `rows` has 2N entries, which includes the factor ½.
        let share = |squares: fn(&Task) -> &[f64], index: usize| {
            let sum: f64 = tasks.iter().map(|task| squares(task)[index]).sum();
            sum / (rows.len() as f64 * variances[index / inputs].0)
        };
        Self {
            first: (0..outputs * inputs).map(|index| 1.0 - share(|task| &task.first, index)).collect(),
            total: (0..outputs * inputs).map(|index| share(|task| &task.total, index)).collect(),
            variances,
        }
    }
}

/// Means and confidence intervals over the replicates.
fn summary(replicates: &[Replicate], output: usize, inputs: usize) -> OutputSensitivity {
    let variances: Vec<f64> = replicates.iter().map(|replicate| replicate.variances[output].0).collect();
    let t = stats::student_t_quantile(0.95, replicates.len() - 1);
    let index = |estimate: &dyn Fn(&Replicate) -> f64| {
        let estimates: Vec<f64> = replicates.iter().map(estimate).collect();
        let value = stats::mean(&estimates);
        let std = stats::sample_std(&estimates).expect("the settings have at least two replicates");
        let half_width = t * std / (estimates.len() as f64).sqrt();
        Index { value, interval_90: [value - half_width, value + half_width] }
    };
    let varies = replicates.iter().all(|replicate| replicate.variances[output].1);
    let indices = varies.then(|| Indices {
        first: (0..inputs).map(|input| index(&|replicate| replicate.first[output * inputs + input])).collect(),
        total: (0..inputs).map(|input| index(&|replicate| replicate.total[output * inputs + input])).collect(),
    });
    OutputSensitivity { variance: stats::mean(&variances), indices }
}
