//! `modalwatch update`: estimates the population of the parameters by sensitivity-based updating, by TMCMC or by the trained
//! flow.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::Context as _;
use clap::{Args, ValueEnum};
use indicatif::{ProgressBar, ProgressStyle};
use nalgebra::DMatrix;
use serde::Serialize;

use super::measurements::read_measurements;
use super::model::load;
use crate::assessment::{draw, Context, Draws};
use crate::baseline::library::find_structure;
use crate::damage::Hyperparameters;
use crate::measurement::ModalMeasurement;
use crate::quantity::Hertz;
use crate::simulator::effect::SimulationEffect;
use crate::simulator::Simulator;
use crate::stats;
use crate::updating::sensitivity::{prior_lattice, update_all, Update};
use crate::updating::stochastic::{settings, simulated_for, Estimate, Population};

/// Estimate mean and standard deviation of the parameters from measurements.
#[derive(Debug, Args)]
pub struct UpdateArgs {
    /// sensitivity: least squares for each measurement; tmcmc: Markov chains over mean and standard deviation; cinn: the trained
    /// model
    #[arg(long, value_enum)]
    method: Method,
    /// Structure file (TOML or JSON), or the id of a shipped structure
    #[arg(long)]
    structure: String,
    /// CSV file of the measurements
    #[arg(long)]
    data: PathBuf,
    /// Columns to ignore, separated by commas
    #[arg(long, value_delimiter = ',')]
    ignore: Vec<String>,
    /// cinn: trained model, its .safetensors file with its .json beside it [default: the one beside the structure file or the shipped
    /// one; otherwise one that is made in a second]
    #[arg(long)]
    model: Option<PathBuf>,
    /// tmcmc: number of samples
    #[arg(long, default_value_t = 1_000)]
    samples: usize,
    /// tmcmc: number of simulated measurements per sample [default: 128; more for more than 500 measurements]
    #[arg(long)]
    simulated: Option<usize>,
    /// tmcmc: measurement noise as a multiple of the structure's noise
    #[arg(long, default_value_t = 1.0)]
    noise: f64,
    /// Seed of all random numbers
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// A Bhattacharyya distance above this multiple of its expected value for a correct population is reported.
const FAR: f64 = 5.0;

#[derive(Debug, Clone, Copy, ValueEnum)]
enum Method {
    Sensitivity,
    Tmcmc,
    Cinn,
}

/// The result; intervals are 90 %.
#[derive(Debug, Serialize)]
struct Answer {
    method: &'static str,
    measurements_used: usize,
    measurements_left_out: usize,
    parameters: Vec<ParameterLine>,
    #[serde(skip_serializing_if = "Option::is_none")]
    evidence: Option<Estimate>,
    #[serde(skip_serializing_if = "Vec::is_empty")]
    updates: Vec<SingleUpdate>,
    notes: Vec<String>,
    seconds: f64,
}

#[derive(Debug, Serialize)]
struct ParameterLine {
    name: String,
    unit: String,
    mean: f64,
    mean_interval: Option<[f64; 2]>,
    std: Option<f64>,
    std_interval: Option<[f64; 2]>,
}

#[derive(Debug, Serialize)]
struct SingleUpdate {
    parameters: Vec<f64>,
    residual_percent: f64,
    iterations: usize,
    converged: bool,
}

/// Reads the measurements, estimates the population and prints it.
///
/// # Errors
/// A file that is refused, or data that the method cannot use.
pub fn update(args: &UpdateArgs) -> anyhow::Result<()> {
    let simulator = find_structure(&args.structure)?;
    let measurements = read_measurements(&simulator, &args.data, &args.ignore)?;
    // The flow corrects measurements by the learned discrepancy itself.
    let corrected = |m: &ModalMeasurement| simulator.corrected(m).into_owned();
    let measurements = match args.method {
        Method::Cinn => measurements,
        Method::Sensitivity | Method::Tmcmc => measurements.iter().map(corrected).collect(),
    };
    anyhow::ensure!(
        !simulator.effects().iter().any(SimulationEffect::varies) || matches!(args.method, Method::Cinn),
        "{} has effects that differ between measurements: only --method cinn accounts for them",
        simulator.id()
    );
    let started = Instant::now();
    let mut answer = match args.method {
        Method::Sensitivity => by_sensitivity(&simulator, &measurements)?,
        Method::Tmcmc => by_tmcmc(&simulator, &measurements, args)?,
        Method::Cinn => by_flow(&measurements, args)?,
    };
    answer.seconds = started.elapsed().as_secs_f64();
    if args.json {
        println!("{}", serde_json::to_string_pretty(&answer)?);
    } else {
        print(&answer);
    }
    Ok(())
}

fn by_sensitivity(simulator: &Simulator, measurements: &[ModalMeasurement]) -> anyhow::Result<Answer> {
    // With fewer modes than parameters the result would depend on the starting point.
    let needed = simulator.space().len();
    let enough = |m: &&ModalMeasurement| m.frequencies_hz.iter().flatten().count() >= needed;
    let rows: Vec<Vec<Option<f64>>> = measurements
        .iter()
        .filter(enough)
        .map(|m| m.frequencies_hz.iter().map(|f| f.map(Hertz::get)).collect())
        .collect();
    anyhow::ensure!(
        !rows.is_empty(),
        "no measurement has {needed} modes: sensitivity-based updating of {needed} parameters needs as many in each"
    );
    let left_out = measurements.len() - rows.len();
    let updates = update_all(simulator, &rows, &prior_lattice(simulator))?;
    let mut notes = stated_noise_ignored(measurements);
    if left_out > 0 {
        notes.push(format!("{left_out} measurements have fewer modes than there are parameters and were left out"));
    }
    let stuck = updates.iter().filter(|u| !u.converged).count();
    anyhow::ensure!(
        stuck < updates.len(),
        "none of the {stuck} iterations converged: the measurements do not belong to this structure, or its prior is wrong; \
         `modalwatch check` compares measured frequencies with the prior"
    );
    if stuck > 0 {
        notes.push(format!("{stuck} of {} iterations did not converge", updates.len()));
    }
    let missed = updates.iter().filter(|u| !u.is_met()).count();
    let worst = updates.iter().map(|u| 100.0 * u.residual).fold(0.0, f64::max);
    if missed > 0 {
        let message = "measurements cannot be matched exactly by parameters within the prior; largest misfit";
        notes.push(format!("{missed} of {} {message} {worst:.3} %", updates.len()));
    }
    let line = |(k, parameter): (usize, &crate::parameter::Parameter)| {
        let values: Vec<f64> = updates.iter().map(|u| u.theta[k]).collect();
        ParameterLine {
            name: parameter.name.clone(),
            unit: parameter.unit.clone(),
            mean: stats::mean(&values),
            mean_interval: None,
            std: stats::sample_std(&values),
            std_interval: None,
        }
    };
    let single = |u: &Update| SingleUpdate {
        parameters: u.theta.clone(),
        residual_percent: 100.0 * u.residual,
        iterations: u.iterations,
        converged: u.converged,
    };
    Ok(Answer {
        method: "sensitivity",
        measurements_used: updates.len(),
        measurements_left_out: left_out,
        parameters: simulator.space().iter().enumerate().map(line).collect(),
        evidence: None,
        updates: updates.iter().map(single).collect(),
        notes,
        seconds: 0.0,
    })
}

fn by_tmcmc(simulator: &Simulator, measurements: &[ModalMeasurement], args: &UpdateArgs) -> anyhow::Result<Answer> {
    anyhow::ensure!(args.noise >= 0.0 && args.noise.is_finite(), "--noise is {}: it must be 0 or above", args.noise);
    let complete: Vec<Vec<f64>> = measurements.iter().filter_map(ModalMeasurement::complete_hz).collect();
    let m = simulator.modes();
    let measured = DMatrix::from_fn(complete.len(), m, |row, mode| complete[row][mode]);
    let modes: Vec<usize> = (0..m).collect();
    let simulated = args.simulated.unwrap_or_else(|| simulated_for(complete.len()));
    let population = Population::new(simulator, &measured, &modes, args.noise, simulated, args.seed)?;
    let bar = ProgressBar::new(100);
    let style = "{elapsed} {wide_bar} {msg}";
    bar.set_style(ProgressStyle::with_template(style).context("the template of the progress bar")?);
    let (_, estimate) = population.sample(&settings(args.samples), args.seed, &|stage| {
        bar.set_message(format!("exponent {:.2e}, {:.0} % accepted", stage.exponent, 100.0 * stage.acceptance));
        bar.set_position((100.0 * stage.exponent) as u64);
    })?;
    bar.finish_and_clear();
    let line = |(k, parameter): (usize, &crate::parameter::Parameter)| ParameterLine {
        name: parameter.name.clone(),
        unit: parameter.unit.clone(),
        mean: estimate.mean[k],
        mean_interval: Some(estimate.mean_interval[k]),
        std: Some(estimate.std[k]),
        std_interval: Some(estimate.std_interval[k]),
    };
    let left_out = measurements.len() - complete.len();
    let mut notes = stated_noise_ignored(measurements);
    // Expected Bhattacharyya distance between the normal distributions fitted to two samples of size n from one population:
    // k / (4n), with k = m + m(m+1)/2 means and covariances.
    let by_chance = (m + m * (m + 1) / 2) as f64 / (4.0 * complete.len() as f64);
    if estimate.least_distance > FAR * by_chance {
        notes.push(format!(
            "the Bhattacharyya distance of the measured population from the closest simulated one is {:.2}, and {by_chance:.2} is \
             expected by chance: the population lies beyond the prior, or the simulation does not fit",
            estimate.least_distance
        ));
    }
    if left_out > 0 {
        notes.push(format!(
            "{left_out} measurements lack a mode and were left out: a distance between distributions needs all modes"
        ));
    }
    Ok(Answer {
        method: "tmcmc",
        measurements_used: complete.len(),
        measurements_left_out: left_out,
        parameters: simulator.space().iter().enumerate().map(line).collect(),
        evidence: Some(estimate),
        updates: Vec::new(),
        notes,
        seconds: 0.0,
    })
}

/// A note if the file states standard deviations, for the two methods that weight all measurements equally.
fn stated_noise_ignored(measurements: &[ModalMeasurement]) -> Vec<String> {
    let stated = measurements.iter().any(|m| m.std_hz.is_some());
    let note = "the standard deviations stated in the file are not used by this method; --method cinn does";
    stated.then(|| note.to_owned()).into_iter().collect()
}

fn by_flow(measurements: &[ModalMeasurement], args: &UpdateArgs) -> anyhow::Result<Answer> {
    let model = load(&args.structure, args.model.as_deref())?;
    let draws = Draws::with_seed(args.seed);
    let batch = draw(&model, measurements, Context::default(), draws)?;
    let population = &batch.populations.parameters;
    let line = |(k, parameter): (usize, &crate::parameter::Parameter)| ParameterLine {
        name: parameter.name.clone(),
        unit: parameter.unit.clone(),
        mean: stats::mean(&population[k].mean_draws),
        mean_interval: Some(population[k].mean_interval()),
        std: population[k].std_interval().map(|_| stats::mean(&population[k].std_draws)),
        std_interval: population[k].std_interval(),
    };
    let mut notes: Vec<String> = batch.findings.iter().map(|f| f.message.clone()).collect();
    let pool = batch.posterior.first(draws.per_measurement);
    for (k, parameter) in model.space().iter().enumerate() {
        let pooled = Hyperparameters::from_pool(&pool.column(k), draws.per_measurement);
        let std = pooled.std.map_or("-".to_owned(), |std| format!("{std:.4}"));
        notes.push(format!(
            "all samples of {} together, measurement noise included: mean {:.4}, std {std}",
            parameter.name, pooled.mean
        ));
    }
    Ok(Answer {
        method: "cinn",
        measurements_used: measurements.len() - batch.left_out,
        measurements_left_out: batch.left_out,
        parameters: model.space().iter().enumerate().map(line).collect(),
        evidence: None,
        updates: Vec::new(),
        notes,
        seconds: 0.0,
    })
}

/// Number of decimals that shows a difference of this size with two significant digits.
fn decimals(difference: f64) -> usize {
    let magnitude = difference.abs().max(1e-300).log10().floor();
    (1.0 - magnitude).clamp(0.0, 15.0) as usize
}

fn print(answer: &Answer) {
    println!(
        "{} measurements used, {} left out, {:.2} s by {}",
        answer.measurements_used, answer.measurements_left_out, answer.seconds, answer.method
    );
    for note in &answer.notes {
        println!("note: {note}");
    }
    let with = |value: Option<f64>, interval: Option<[f64; 2]>| match (value, interval) {
        (Some(v), Some([low, high])) => {
            // Two significant digits of the width of the interval.
            let digits = decimals(high - low);
            format!("{v:.digits$} ({low:.digits$} … {high:.digits$})")
        }
        (Some(v), None) => format!("{v:.0$}", decimals(0.03 * v)),
        _ => "-".to_owned(),
    };
    println!("{:>16} {:>30} {:>30} {:>8}", "parameter", "mean (90 %)", "std (90 %)", "unit");
    for p in &answer.parameters {
        let (mean, std) = (with(Some(p.mean), p.mean_interval), with(p.std, p.std_interval));
        println!("{:>16} {mean:>30} {std:>30} {:>8}", p.name, p.unit);
    }
    if let Some(e) = &answer.evidence {
        let [log_evidence, error] = e.log_evidence;
        println!(
            "evidence for the structure, to compare structures by the same measurements (higher is better): its natural logarithm is \
             {log_evidence:.2} ± {error:.2}, from {} runs of the simulation",
            e.model_runs
        );
    }
}
