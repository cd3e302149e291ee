//! One repetition, in which each method estimates the population from the measurements of a state, and the summary of many
//! repetitions as table rows.

use std::time::Instant;

use nalgebra::DMatrix;
use rand::Rng as _;
use rand_distr::StandardNormal;

use super::paper::{printed, Printed};
use super::result::{Accuracy, Compared, Method, Quantity, Row, Settings, Spread, State, Time};
use crate::assessment::{self, Context, Draws};
use crate::baseline::observation::Observation;
use crate::baseline::Baseline;
use crate::damage::Hyperparameters;
use crate::measurement::at_intervals;
use crate::quantity::Timestamp;
use crate::simulator::Simulator;
use crate::stats;
use crate::updating::sensitivity::{prior_lattice, update_all};
use crate::updating::stochastic::{settings, simulated_for, Population};

/// Number of posterior samples of each measurement (paper §5.2).
pub const DRAWS: usize = 10;

/// Time of the first simulated measurement, microseconds since 1970; the results do not depend on it.
const START_US: i64 = 1_700_000_000_000_000;

/// Factor of σ in the damage threshold, Eq. 21.
const DELTA: f64 = 1.645;

/// Number of held-out points of the prior in the figures of accuracy.
const HELD_OUT: usize = 1_000;

/// All methods, in the order of the paper's tables.
pub const METHODS: [Method; 3] = [Method::Sensitivity, Method::Tmcmc, Method::Cinn];

/// Measurements of one state, and the parameters that they were simulated with.
pub struct Data {
    /// Name of the state, as in [`Row`].
    pub state: String,
    /// Parameters, `[n, d]`.
    pub theta: DMatrix<f64>,
    /// Frequencies, Hz, `[n, m]`.
    pub frequencies_hz: DMatrix<f64>,
    /// Mean and standard deviation of the distribution of each parameter, `[d]`.
    pub target: Vec<(f64, f64)>,
    /// Whether each parameter has changed, `[d]`.
    pub damaged: Vec<bool>,
}

/// What a method found for a state.
#[derive(Clone)]
pub struct Found {
    /// Samples of the population of each parameter, `[d][samples]`.
    pub samples: Vec<Vec<f64>>,
    /// Mean, `[d]`.
    pub mean: Vec<f64>,
    /// Standard deviation, `[d]`.
    pub std: Vec<f64>,
    /// Elapsed time, s.
    pub seconds: f64,
    /// Number of model runs, if they were counted.
    pub model_runs: Option<usize>,
}

/// The trained flow and the settings that the methods use.
pub struct Bench<'a> {
    /// The trained flow.
    pub baseline: &'a Baseline,
    /// Number of repetitions and samples, and the seed.
    pub settings: &'a Settings,
}

impl Bench<'_> {
    fn simulator(&self) -> &Simulator {
        self.baseline.simulator()
    }

    /// Finds the population of a state by a method.
    ///
    /// # Errors
    /// The error of the method.
    pub fn find(&self, method: Method, data: &Data, seed: u64) -> anyhow::Result<Found> {
        let started = Instant::now();
        let mut found = match method {
            Method::Sensitivity => self.sensitivity(data)?,
            Method::Tmcmc => self.tmcmc(data, seed)?,
            Method::Cinn => self.cinn(data, seed)?,
        };
        if found.seconds <= 0.0 {
            found.seconds = started.elapsed().as_secs_f64();
        }
        Ok(found)
    }

    /// Updates the parameters by each measurement; these parameters are the samples.
    fn sensitivity(&self, data: &Data) -> anyhow::Result<Found> {
        let rows: Vec<Vec<Option<f64>>> =
            data.frequencies_hz.row_iter().map(|row| row.iter().copied().map(Some).collect()).collect();
        let updates = update_all(self.simulator(), &rows, &prior_lattice(self.simulator()))?;
        let column = |k: usize| updates.iter().map(|u| u.theta[k]).collect::<Vec<f64>>();
        let samples: Vec<Vec<f64>> = (0..self.simulator().space().len()).map(column).collect();
        let model_runs = updates.iter().map(|u| u.iterations + u.starts).sum();
        Ok(of_samples(samples, 1, Some(model_runs)))
    }

    /// Samples the posterior of (μ, σ), and draws one parameter vector from the population of each sample.
    fn tmcmc(&self, data: &Data, seed: u64) -> anyhow::Result<Found> {
        let modes: Vec<usize> = (0..self.simulator().modes()).collect();
        let simulated = simulated_for(data.frequencies_hz.nrows());
        let population = Population::new(self.simulator(), &data.frequencies_hz, &modes, 1.0, simulated, seed)?;
        let chains = settings(self.settings.tmcmc_samples);
        let (posterior, estimate) = population.sample(&chains, seed, &|_| {})?;
        let d = estimate.mean.len();
        let mut stream = stats::stream(seed, "population of a posterior");
        let mut draw = |k: usize| -> Vec<f64> {
            let rows = posterior.theta.row_iter();
            rows.map(|row| row[k] + row[d + k] * stream.sample::<f64, _>(StandardNormal)).collect()
        };
        let samples = (0..d).map(&mut draw).collect();
        let (mean, std) = (estimate.mean, estimate.std);
        Ok(Found { samples, mean, std, seconds: 0.0, model_runs: Some(estimate.model_runs) })
    }

    /// Draws posterior samples of each measurement with the trained flow.
    fn cinn(&self, data: &Data, seed: u64) -> anyhow::Result<Found> {
        // The time is that of the inference alone, without the checks of the service. The samples that are compared come from the
        // complete assessment, which first moves measurements beyond the prior box to the nearest point of the box.
        let rows: Vec<Vec<f64>> = data.frequencies_hz.row_iter().map(|row| row.iter().copied().collect()).collect();
        let measurements = at_intervals(&rows, Timestamp::from_micros(START_US)?, 1, None)?;
        let observations: Vec<Observation> =
            measurements.iter().filter_map(|m| self.baseline.admit(m).observation).collect();
        let started = Instant::now();
        let runs = self.baseline.infer(&observations, DRAWS, seed)?.simulations();
        let seconds = started.elapsed().as_secs_f64();
        let draws = Draws { per_measurement: DRAWS, for_population: DRAWS, seed };
        let batch = assessment::draw(self.baseline, &measurements, Context::default(), draws)?;
        let samples = (0..self.simulator().space().len()).map(|k| batch.posterior.column(k)).collect();
        Ok(Found { seconds, ..of_samples(samples, DRAWS, Some(runs)) })
    }
}

/// The result of a method that gives samples, `[d][samples]`, `draws` for each measurement.
fn of_samples(samples: Vec<Vec<f64>>, draws: usize, model_runs: Option<usize>) -> Found {
    let moments = |pool: &Vec<f64>| Hyperparameters::from_pool(pool, draws);
    let mean = samples.iter().map(|pool| moments(pool).mean).collect();
    let std = samples.iter().map(|pool| moments(pool).std.unwrap_or(f64::NAN)).collect();
    Found { samples, mean, std, seconds: 0.0, model_runs }
}

/// Damage threshold δ = μ − 1.645 σ of each parameter, in parameter units, `[d]` (Eq. 21 of the paper).
pub fn thresholds(undamaged: &Found) -> Vec<f64> {
    undamaged.mean.iter().zip(&undamaged.std).map(|(mean, std)| mean - DELTA * std).collect()
}

/// P(x < δ) of parameter k: for TMCMC that of the normal distribution which it fits, otherwise the share of samples below δ.
pub fn probability_of_damage(method: Method, found: &Found, k: usize, threshold: f64) -> f64 {
    match method {
        Method::Tmcmc => stats::normal_cdf((threshold - found.mean[k]) / found.std[k]),
        _ => share_below(&found.samples[k], threshold),
    }
}

/// Share of `values`, `[n]`, below a threshold in the same unit, from 0 to 1.
pub fn share_below(values: &[f64], threshold: f64) -> f64 {
    values.iter().filter(|x| **x < threshold).count() as f64 / values.len() as f64
}

/// The parameters that the measurements were simulated with, in the form of the result of a method.
pub fn realised(data: &Data) -> Found {
    let samples = data.theta.column_iter().map(|column| column.iter().copied().collect()).collect();
    of_samples(samples, 1, None)
}

/// One parameter in one state by one method, over the repetitions.
pub struct Series {
    /// Name of the state.
    pub state: String,
    /// Column of the parameter.
    pub parameter: usize,
    /// The method.
    pub method: Method,
    /// Whether the parameter has changed in this state.
    pub damaged: bool,
    target: (f64, f64),
    target_pod: Option<f64>,
    mean: Vec<f64>,
    std: Vec<f64>,
    pod: Vec<f64>,
    mean_error: Vec<f64>,
    std_error: Vec<f64>,
    pod_error: Vec<f64>,
    outside: Vec<f64>,
}

/// Result of one method for one state in one repetition.
pub struct Entry<'a> {
    /// The state.
    pub data: &'a Data,
    /// The method.
    pub method: Method,
    /// What it found.
    pub found: &'a Found,
    /// What the method found for the undamaged state, and the realised undamaged state; `None` without a comparison.
    pub undamaged: Option<(&'a Found, &'a Found)>,
    /// True probability of damage, `[d]`.
    pub target_pod: Option<Vec<f64>>,
}

/// Adds a repetition to the series of its state and method.
pub fn add(all: &mut Vec<Series>, simulator: &Simulator, entry: &Entry<'_>) {
    let Entry { data, method, found, .. } = entry;
    let drawn = realised(data);
    for (k, parameter) in simulator.space().iter().enumerate() {
        let same = |s: &Series| s.state == data.state && s.parameter == k && s.method == *method;
        let index = all.iter().position(same).unwrap_or_else(|| {
            all.push(Series {
                state: data.state.clone(),
                parameter: k,
                method: *method,
                damaged: data.damaged[k],
                target: data.target[k],
                target_pod: entry.target_pod.as_ref().map(|pod| pod[k]),
                mean: Vec::new(),
                std: Vec::new(),
                pod: Vec::new(),
                mean_error: Vec::new(),
                std_error: Vec::new(),
                pod_error: Vec::new(),
                outside: Vec::new(),
            });
            all.len() - 1
        });
        let series = &mut all[index];
        series.mean.push(found.mean[k]);
        series.std.push(found.std[k]);
        series.mean_error.push((found.mean[k] - drawn.mean[k]).abs());
        series.std_error.push((found.std[k] - drawn.std[k]).abs());
        let outside = |x: &&f64| !(parameter.lower..=parameter.upper).contains(*x);
        let count = drawn.samples[k].iter().filter(outside).count();
        series.outside.push(100.0 * count as f64 / drawn.samples[k].len() as f64);
        if let Some((undamaged, drawn_undamaged)) = entry.undamaged {
            let pod = probability_of_damage(*method, found, k, thresholds(undamaged)[k]);
            series.pod.push(pod);
            series.pod_error.push((pod - share_below(&drawn.samples[k], thresholds(drawn_undamaged)[k])).abs());
        }
    }
}

impl Series {
    /// Summarises the repetitions as a row of a table; `all` are the values that the paper prints.
    pub fn row(&self, simulator: &Simulator, all: &'static [Printed]) -> Row {
        let parameter = &simulator.space().as_slice()[self.parameter];
        let paper = printed(all, &self.state, &parameter.name, self.method);
        let pod = self.target_pod.filter(|_| !self.pod.is_empty());
        Row {
            state: self.state.clone(),
            parameter: parameter.name.clone(),
            unit: parameter.unit.clone(),
            method: self.method,
            damaged: self.damaged,
            mean: compared(&self.mean, self.target.0, paper.map(|p| p.mean)),
            std: compared(&self.std, self.target.1, paper.map(|p| p.std)),
            probability_of_damage: pod
                .map(|target| compared(&self.pod, target, paper.and_then(|p| p.probability_of_damage))),
            mean_error: spread(&self.mean_error),
            mean_absolute_mean_error: stats::mean(&self.mean_error),
            mean_absolute_std_error: stats::mean(&self.std_error),
            mean_absolute_pod_error: pod.map(|_| stats::mean(&self.pod_error)),
            outside_prior_percent: stats::mean(&self.outside),
        }
    }
}

/// Median, 5 % quantile and 95 % quantile of `values`, `[repetitions]`.
pub fn spread(values: &[f64]) -> Spread {
    let at = |level| stats::quantile(values, level);
    Spread { median: at(0.5), low: at(0.05), high: at(0.95) }
}

/// The distribution of `values` over the repetitions, with the target and the value of the paper.
fn compared(values: &[f64], target: f64, paper: Option<f64>) -> Compared {
    // Equal values count half, because a probability of 1 often occurs exactly.
    let percentile = |paper: f64| {
        let below = values.iter().filter(|v| **v < paper).count() as f64;
        let same = values.iter().filter(|v| (**v - paper).abs() <= 1e-12).count() as f64;
        100.0 * (below + 0.5 * same) / values.len() as f64
    };
    Compared { ours: spread(values), target, paper, paper_percentile: paper.map(percentile) }
}

/// Times of the methods and those of the paper. `training` is the duration (s) and the number of simulated samples of the
/// training; `found` holds the duration (s) and the model runs of each method in each repetition, in the order of [`METHODS`].
pub fn times(training: (f64, usize), found: &[Vec<(f64, Option<usize>)>; 3], paper: [f64; 4], note: &str) -> Vec<Time> {
    let median = |method: usize| stats::quantile(&found[method].iter().map(|f| f.0).collect::<Vec<_>>(), 0.5);
    let runs = |method: usize| found[method].first().and_then(|f| f.1);
    let reference = median(1);
    let one = |method, step: &str, seconds: f64, paper_seconds, model_runs| Time {
        method,
        step: step.to_owned(),
        seconds,
        paper_seconds,
        times_faster_than_tmcmc: reference / seconds,
        model_runs,
        note: note.to_owned(),
    };
    vec![
        one(Method::Sensitivity, "updating", median(0), paper[0], runs(0)),
        one(Method::Tmcmc, "updating", reference, paper[1], runs(1)),
        Time {
            note: format!("{} simulated pairs; with validation and calibration", training.1),
            ..one(Method::Cinn, "training", training.0, paper[2], None)
        },
        Time {
            note: format!("{note}, 10 samples each, without the service's checks"),
            ..one(Method::Cinn, "inference", median(2), paper[3], runs(2))
        },
    ]
}

/// Compares one posterior sample with the truth at each held-out point of the prior.
///
/// # Errors
/// The error of the simulation or of the flow.
pub fn accuracy(baseline: &Baseline, seed: u64) -> anyhow::Result<Vec<Accuracy>> {
    let simulator = baseline.simulator();
    let held_out = simulator.pairs(simulator.space(), HELD_OUT, seed)?;
    let mut stream = stats::stream(seed, "noise of held-out measurements");
    let noisy = |row: usize| {
        let exact: Vec<f64> = held_out.frequencies_hz.row(row).iter().copied().collect();
        crate::baseline::observation::measure(simulator, &exact, &[], &vec![Some(1.0); exact.len()], &mut stream)
    };
    let observations: Vec<Observation> = (0..HELD_OUT).map(noisy).collect();
    let samples = baseline.infer(&observations, 1, seed)?;
    let one = |(k, parameter): (usize, &crate::parameter::Parameter)| {
        let truth: Vec<f64> = held_out.theta.column(k).iter().copied().collect();
        let estimate = samples.column(k);
        let r_squared = stats::r_squared(&truth, &estimate);
        Accuracy { parameter: parameter.name.clone(), unit: parameter.unit.clone(), truth, estimate, r_squared }
    };
    Ok(simulator.space().iter().enumerate().map(one).collect())
}

/// A state of the first repetition for the figures. The flow has found `found` and `undamaged`; `normal` says whether the
/// parameters were drawn from normal distributions.
pub fn state(simulator: &Simulator, data: &Data, found: &Found, undamaged: &Found, normal: bool) -> State {
    let drawn = realised(data);
    let delta = thresholds(undamaged);
    let quantity = |(k, parameter): (usize, &crate::parameter::Parameter)| Quantity {
        name: parameter.name.clone(),
        unit: parameter.unit.clone(),
        prior: Some([parameter.lower, parameter.upper]),
        target: normal.then_some([data.target[k].0, data.target[k].1]),
        realised: drawn.samples[k].clone(),
        samples: found.samples[k].clone(),
        threshold: delta[k],
        probability_of_damage: share_below(&found.samples[k], delta[k]),
    };
    let mut quantities: Vec<Quantity> = simulator.space().iter().enumerate().map(quantity).collect();
    for derived in simulator.derived_stiffnesses() {
        let image = |values: &Vec<f64>| values.iter().map(|p| derived.value(*p)).collect::<Vec<f64>>();
        let k = derived.parameter;
        let of_undamaged = Hyperparameters::from_pool(&image(&undamaged.samples[k]), DRAWS);
        let threshold = of_undamaged.mean - DELTA * of_undamaged.std.unwrap_or(f64::NAN);
        let samples = image(&found.samples[k]);
        quantities.push(Quantity {
            name: derived.name.clone(),
            unit: "N/m".to_owned(),
            prior: None,
            target: None,
            realised: image(&drawn.samples[k]),
            threshold,
            probability_of_damage: share_below(&samples, threshold),
            samples,
        });
    }
    let column = |mode: usize| data.frequencies_hz.column(mode).iter().copied().collect();
    let frequencies_hz = (0..data.frequencies_hz.ncols()).map(column).collect();
    State { name: data.state.clone(), frequencies_hz, quantities }
}
