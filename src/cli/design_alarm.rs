//! `modalwatch design-alarm`: the changes that the alarm charts of a structure will detect, computed before anything is
//! measured.

use std::path::PathBuf;

use anyhow::Context as _;
use clap::Args;
use serde::Serialize;

use super::design_process::{Moving, ProcessReport, Weather};
use super::output::write_whole;
use super::parameter::parameter_moments;
use super::rehearsal::seconds;
use crate::alarm::chart::{shared, standard_error, variance_of_mean};
use crate::alarm::detection::{detection, Detection, Wanted};
use crate::alarm::limits::{limits, Limits, Situation};
use crate::alarm::AlarmSettings;
use crate::baseline::identifiability::fisher_covariance;
use crate::baseline::library::find_structure;
use crate::damage::ChartReference;
use crate::parameter::{in_words, DamageDirection, Parameter};
use crate::plot::{page, table, Line, Plot};
use crate::simulator::{DerivedStiffness, Simulator};

/// Losses whose delay is stated.
const LOSSES: [f64; 3] = [0.02, 0.05, 0.1];

/// Mean number of batches to a false alarm beside which the delays are stated.
const COMPARED_RUN: f64 = 1_000.0;

/// Lengths of a day and of a year, s.
const DAY_S: f64 = 86_400.0;
const YEAR_S: f64 = 365.25 * DAY_S;

/// Simulate the alarm charts of a structure: false alarms, delay, and the loss that is detected with 90 % probability.
#[derive(Debug, Args)]
pub struct DesignAlarmArgs {
    /// Structure file (TOML or JSON), or the id of a shipped structure
    #[arg(long)]
    structure: String,
    /// Undamaged population of one parameter, as name=mean,std in its unit; once per parameter
    #[arg(long = "parameter", required = true, value_parser = parameter_moments)]
    parameters: Vec<(String, f64, f64)>,
    /// Number of measurements per batch
    #[arg(long, default_value_t = 20)]
    measurements: usize,
    /// Number of measurements of the undamaged reference
    #[arg(long, alias = "baseline", default_value_t = 100)]
    reference: usize,
    /// Noise as a multiple of the structure's noise
    #[arg(long, default_value_t = 1.0)]
    noise: f64,
    /// Time between batches, with its unit: 30s, 10m, 1h, 1d
    #[arg(long, default_value = "1d", value_parser = seconds)]
    every: f64,
    /// Required mean number of years between false alarms of the structure
    #[arg(long, default_value_t = AlarmSettings::default().false_alarm_years)]
    false_alarm_years: f64,
    /// Instead of the years: required mean number of undamaged batches between false alarms
    #[arg(long, conflicts_with = "false_alarm_years")]
    mean_run_batches: Option<f64>,
    /// Number of points above the limit that raise an alarm
    #[arg(long, default_value_t = AlarmSettings::default().needed)]
    needed: usize,
    /// Number of consecutive points that are considered
    #[arg(long, default_value_t = AlarmSettings::default().window)]
    window: usize,
    /// Weight of the latest batch in the moving average; 0 disables it
    #[arg(long, default_value_t = AlarmSettings::default().ewma_weight)]
    ewma_weight: f64,
    /// Correlation of successive batches, from 0 to below 1, of a structure under weather that nobody measures: the standard deviations
    /// of --parameter are then those over the seasons, and the charts of a process are designed as well
    #[arg(long)]
    batch_correlation: Option<f64>,
    /// With --batch-correlation: share of the variance of each parameter that the weather makes all have in common
    #[arg(long, default_value_t = 0.9, requires = "batch_correlation")]
    common: f64,
    /// With --batch-correlation: number of batches of the undamaged reference
    #[arg(long, default_value_t = 100, requires = "batch_correlation")]
    reference_batches: usize,
    /// Number of damaged batches within which a loss must be detected
    #[arg(long, default_value_t = 3)]
    within: usize,
    /// Seed of all random numbers
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Write an HTML page with plots to this file
    #[arg(long)]
    out: Option<PathBuf>,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Serialize)]
struct Report {
    structure: String,
    measurements: usize,
    baseline_measurements: usize,
    noise_multiple: f64,
    /// Time between batches, s.
    every_s: f64,
    wanted_run_batches: f64,
    shift_limit_standard_errors: f64,
    ewma_limit_standard_errors: Option<f64>,
    healthy_run_batches: f64,
    healthy_run_error: f64,
    within_batches: usize,
    parameters: Vec<ParameterReport>,
    curve: Vec<crate::alarm::detection::DetectionPoint>,
    /// Days from a loss to its alarm.
    delays: Vec<DelayReport>,
    /// The charts of a process, with `--batch-correlation`.
    #[serde(skip_serializing_if = "Option::is_none")]
    process: Option<ProcessReport>,
}

/// Days from a loss of a parameter to its alarm.
#[derive(Debug, Serialize)]
struct DelayReport {
    parameter: String,
    /// For losses of 2, 5 and 10 %: the median days with the limits as asked for, and with those of one false alarm in 1,000 batches; `null`
    /// where it is more than 300 batches.
    days: [[Option<f64>; 2]; LOSSES.len()],
}

impl DelayReport {
    fn cells(&self) -> [String; LOSSES.len()] {
        self.days.map(|own| {
            let [asked, compared] = own.map(|days| days.map_or("-".to_owned(), |days| format!("{days:.2}")));
            format!("{asked} ({compared})")
        })
    }
}

#[derive(Debug, Serialize)]
struct ParameterReport {
    name: String,
    unit: String,
    mean: f64,
    std: f64,
    /// Standard deviation of the parameter due to the noise of one measurement.
    noise_std: f64,
    /// Standard error of the difference between a batch and the undamaged reference.
    standard_error: f64,
    /// Relative change that is detected within the given batches with 90 % probability (a90).
    a90: Option<f64>,
    /// For a parameter that sets springs by a law: the same change as a loss of their stiffness.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    a90_of_stiffness: Vec<(String, f64)>,
}

/// The population of one parameter and the accuracy of its estimates.
#[derive(Clone, Copy)]
struct Moments {
    mean: f64,
    std: f64,
    noise_std: f64,
}

/// Simulates the charts and prints what they detect.
///
/// # Errors
/// A structure or population that is refused, a file that cannot be written.
pub fn design_alarm(args: &DesignAlarmArgs) -> anyhow::Result<()> {
    let simulator = find_structure(&args.structure)?;
    let settings = settings(args)?;
    let moments = moments(&simulator, &args.parameters)?;
    let noise_std = noise_std(&simulator, &moments, args.noise)?;
    let of = |k: usize| Moments { mean: moments[k].0, std: moments[k].1, noise_std: noise_std[k] };
    let watched: Vec<(&Parameter, usize)> =
        simulator.space().iter().zip(0..).filter(|(p, _)| p.damage != DamageDirection::None).collect();
    anyhow::ensure!(!watched.is_empty(), "no parameter of {} has a direction of damage", simulator.id());
    // This share is the same for all charts, since batch and undamaged reference have the same noise.
    let first = of(watched[0].1);
    let error_of = |own: Moments| {
        let (reference, n) = (reference(own, args.reference), args.measurements as f64);
        standard_error(&reference, variance_of_mean(&reference, own.noise_std.powi(2), n), n)
    };
    let shared = shared(&reference(first, args.reference), error_of(first));
    let situation = Situation { shared, degrees_of_freedom: args.reference - 1, charts: watched.len() };
    // Said on standard error, because each simulation can take minutes where false alarms are to be rare.
    eprintln!("simulating healthy batches: the limits of the charts");
    let run_batches = settings.run_batches(Some(YEAR_S / args.every));
    let wanted = Wanted { run_batches, within: args.within };
    let limits = limits(situation, &settings, run_batches);
    eprintln!("simulating healthy and damaged batches: false alarms, and the delay of alarms after a loss");
    let found = detection(situation, &limits, &settings, wanted, args.seed);
    let compared = Wanted { run_batches: COMPARED_RUN, within: args.within };
    let by_batches = detection(
        situation,
        &crate::alarm::limits::limits(situation, &settings, COMPARED_RUN),
        &settings,
        compared,
        args.seed,
    );
    let shift_90 = found.shift_found(0.9);
    let parameter = |&(p, k): &(&Parameter, usize)| {
        let own = of(k);
        let error = error_of(own);
        let change = shift_90.map(|shift| shift * error);
        ParameterReport {
            name: p.name.clone(),
            unit: p.unit.clone(),
            mean: own.mean,
            std: own.std,
            noise_std: own.noise_std,
            standard_error: error,
            a90: change.map(|change| change / own.mean.abs()),
            a90_of_stiffness: change.map_or_else(Vec::new, |change| stiffness_losses(&simulator, k, own.mean, change)),
        }
    };
    let report = Report {
        structure: simulator.id().to_string(),
        measurements: args.measurements,
        baseline_measurements: args.reference,
        noise_multiple: args.noise,
        every_s: args.every,
        wanted_run_batches: run_batches,
        shift_limit_standard_errors: limits.single,
        ewma_limit_standard_errors: Some(limits.ewma).filter(|l| l.is_finite()),
        healthy_run_batches: found.healthy_run_batches,
        healthy_run_error: found.healthy_run_error,
        within_batches: args.within,
        parameters: watched.iter().map(parameter).collect(),
        curve: found.curve.clone(),
        delays: delays_in_days(args, &watched, [&found, &by_batches], |k| (of(k).mean, error_of(of(k)))),
        process: process_report(args, &watched, of, run_batches)?,
    };
    if let Some(path) = &args.out {
        write_whole(path, html(&report, &found, &limits).as_bytes())?;
    }
    if args.json {
        println!("{}", serde_json::to_string_pretty(&report)?);
    } else {
        print(&report);
    }
    Ok(())
}

/// The charts of a process, if a correlation of successive batches is given.
fn process_report(
    args: &DesignAlarmArgs,
    watched: &[(&Parameter, usize)],
    of: impl Fn(usize) -> Moments,
    run_batches: f64,
) -> anyhow::Result<Option<ProcessReport>> {
    let Some(correlation) = args.batch_correlation else { return Ok(None) };
    let weather = Weather {
        correlation,
        common: args.common,
        reference: args.reference_batches,
        mean_run_batches: run_batches,
        seed: args.seed,
    };
    let moving = |(parameter, k): &(&Parameter, usize)| {
        let Moments { mean, std, noise_std } = of(*k);
        Moving { parameter: (*parameter).clone(), mean, std, error: noise_std / (args.measurements as f64).sqrt() }
    };
    let parameters: Vec<Moving> = watched.iter().map(moving).collect();
    weather.report(&parameters).map(Some)
}

/// The alarm settings of the arguments, which are checked.
fn settings(args: &DesignAlarmArgs) -> anyhow::Result<AlarmSettings> {
    anyhow::ensure!(args.measurements > 0 && args.within > 0, "--measurements and --within must be at least 1");
    anyhow::ensure!(args.reference >= 2, "--reference must be at least 2 measurements");
    anyhow::ensure!(args.noise > 0.0 && args.noise.is_finite(), "--noise must be above 0");
    anyhow::ensure!(args.every > 0.0, "--every must be above 0");
    let settings = AlarmSettings {
        false_alarm_years: args.false_alarm_years,
        mean_run_batches: args.mean_run_batches,
        needed: args.needed,
        window: args.window,
        ewma_weight: args.ewma_weight,
        ..AlarmSettings::default()
    };
    match settings.problem() {
        Some((key, value, must)) => anyhow::bail!("{key} is {value}: it must be {must}"),
        None => Ok(settings),
    }
}

/// The undamaged reference that `measurements` measurements of a population give.
fn reference(of: Moments, measurements: usize) -> ChartReference {
    ChartReference::of_one_batch(of.mean, of.std.hypot(of.noise_std), of.noise_std.powi(2), measurements)
}

/// For a parameter that sets springs by a law: the relative loss of stiffness of each when the parameter changes by
/// `change` towards damage.
fn stiffness_losses(simulator: &Simulator, column: usize, mean: f64, change: f64) -> Vec<(String, f64)> {
    let damage = simulator.space().as_slice()[column].damage;
    let towards = if damage == DamageDirection::Increase { 1.0 } else { -1.0 };
    let loss = |s: DerivedStiffness| {
        let (before, after) = (s.value(mean), s.value(mean + towards * change));
        (s.name, (before - after) / before)
    };
    simulator.derived_stiffnesses().into_iter().filter(|s| s.parameter == column).map(loss).collect()
}

/// Mean and standard deviation of each parameter, in the order of the space.
fn moments(simulator: &Simulator, given: &[(String, f64, f64)]) -> anyhow::Result<Vec<(f64, f64)>> {
    crate::simulator::population::Population::new(simulator.space(), given)?;
    let one = |p: &Parameter| {
        let (name, mean, std) = given.iter().find(|(name, ..)| *name == p.name).context("every parameter is given")?;
        anyhow::ensure!(
            p.prior().contains(mean),
            "the mean {mean} of {name} is outside its prior, {} to {}",
            p.lower,
            p.upper
        );
        Ok((*mean, *std))
    };
    simulator.space().iter().map(one).collect()
}

/// Standard deviation of each parameter given the frequencies of one measurement, in its unit, by the Fisher information at
/// the mean and the prior.
fn noise_std(simulator: &Simulator, moments: &[(f64, f64)], noise: f64) -> anyhow::Result<Vec<f64>> {
    let theta: Vec<f64> = moments.iter().map(|m| m.0).collect();
    let (jacobian, frequencies) = (simulator.jacobian(&theta)?, simulator.frequencies_hz(&theta)?);
    anyhow::ensure!(
        simulator.is_noisy(),
        "structure {} has no measurement noise: state it in measurement_noise",
        simulator.id()
    );
    // The uncertainty of a learned discrepancy is part of the noise of every measurement.
    let discrepancy = simulator.typical_discrepancy_variance();
    let std_hz = |(mode, f): (usize, &f64)| (noise * simulator.std_hz(mode, *f)).hypot(f * discrepancy[mode].sqrt());
    let std_hz: Vec<f64> = frequencies.iter().enumerate().map(std_hz).collect();
    let covariance = fisher_covariance(simulator, &jacobian, &std_hz, &[])
        .context("the Fisher information of the frequencies is not finite")?;
    let std = |(k, p): (usize, &Parameter)| covariance[(k, k)].sqrt() * (p.upper - p.lower);
    Ok(simulator.space().iter().enumerate().map(std).collect())
}

fn print(report: &Report) {
    println!(
        "{}: batches of {} measurements compared with an undamaged reference of {}, with {} times the stated noise",
        report.structure, report.measurements, report.baseline_measurements, report.noise_multiple
    );
    let ewma = report.ewma_limit_standard_errors.map_or("off".to_owned(), |l| format!("{l:.2}"));
    println!("limits: one batch {:.2} standard errors, moving average {ewma}", report.shift_limit_standard_errors);
    println!(
        "without damage: {:.0} ± {:.0} batches to the first false alarm (required {:.0}: {:.1} years with a batch every {:.2} days)",
        report.healthy_run_batches,
        report.healthy_run_error,
        report.wanted_run_batches,
        report.wanted_run_batches * report.every_s / YEAR_S,
        report.every_s / DAY_S
    );
    println!(
        "\n{:>16} {:>10} {:>10} {:>12} {:>14} {:>22}",
        "parameter", "mean", "std", "noise std", "std error", "detected, 90 % (a90)"
    );
    for p in &report.parameters {
        let a90 = p.a90.map_or("not detected".to_owned(), |a| format!("{:.2} %", 100.0 * a));
        println!(
            "{:>16} {:>10.4} {:>10.4} {:>12.5} {:>14.5} {a90:>22}",
            p.name, p.mean, p.std, p.noise_std, p.standard_error
        );
        for (spring, loss) in &p.a90_of_stiffness {
            println!("{:>16} as a loss of the {}: {:.2} %", "", in_words(spring), 100.0 * loss);
        }
    }
    println!(
        "a90: change that is detected within {} damaged batches with a probability of 90 %",
        report.within_batches
    );
    println!("median days from a loss to its alarm; in brackets, with one false alarm in {COMPARED_RUN:.0} batches:");
    let header: Vec<String> = LOSSES.iter().map(|loss| format!("{:>16.0} %", 100.0 * loss)).collect();
    println!("{:>16} {}", "parameter", header.join(""));
    for delay in &report.delays {
        println!("{:>16} {}", delay.parameter, delay.cells().map(|cell| format!("{cell:>18}")).join(""));
    }
    if let Some(process) = &report.process {
        process.print();
    }
}

/// Median days from a loss of each of [`LOSSES`] of the watched parameters to its alarm, with the limits as asked for and as compared.
fn delays_in_days(
    args: &DesignAlarmArgs,
    watched: &[(&Parameter, usize)],
    found: [&Detection; 2],
    moments: impl Fn(usize) -> (f64, f64),
) -> Vec<DelayReport> {
    let one = |&(parameter, k): &(&Parameter, usize)| {
        let (mean, error) = moments(k);
        let days = |found: &Detection, loss: f64| {
            found.median_run_of(loss * mean.abs() / error).map(|run| run * args.every / DAY_S)
        };
        DelayReport { parameter: parameter.name.clone(), days: LOSSES.map(|loss| found.map(|own| days(own, loss))) }
    };
    watched.iter().map(one).collect()
}

fn html(report: &Report, found: &Detection, limits: &Limits) -> String {
    let line = |p: &ParameterReport| Line {
        name: p.name.clone(),
        points: (0..=80)
            .map(|i| {
                let change = 12.0 * p.standard_error * f64::from(i) / 80.0;
                (100.0 * change / p.mean.abs(), found.probability_within(change / p.standard_error))
            })
            .collect(),
    };
    let plot = Plot {
        title: format!("Detected within {} batches of {}", report.within_batches, report.measurements),
        x_label: "change of the mean, %".to_owned(),
        y_label: "probability of an alarm".to_owned(),
        lines: report.parameters.iter().map(line).collect(),
        marks: vec![(0.9, "90 %".to_owned())],
        ..Plot::default()
    };
    let delay = Plot {
        title: "Delay".to_owned(),
        x_label: "change of the mean, standard errors of a batch".to_owned(),
        y_label: "damaged batches to the alarm".to_owned(),
        lines: vec![
            Line { name: "mean".to_owned(), points: delays(found, |p| p.mean_run) },
            Line { name: "median".to_owned(), points: delays(found, |p| p.median_run) },
        ],
        ..Plot::default()
    };
    let rows: Vec<Vec<String>> = report
        .parameters
        .iter()
        .map(|p| {
            let a90 = p.a90.map_or("not detected".to_owned(), |a| format!("{:.2} %", 100.0 * a));
            vec![p.name.clone(), format!("{:.4}", p.mean), format!("{:.4}", p.std), format!("{:.5}", p.noise_std), a90]
        })
        .collect();
    let facts = format!(
        "<p>Batches of {} measurements are compared with an undamaged reference of {}; the noise is {} times the structure's. \
         Limits: one batch {:.2} standard errors, moving average {:.2}. Without damage there are {:.0} ± {:.0} batches to the \
         first false alarm (required {:.0}).</p>",
        report.measurements,
        report.baseline_measurements,
        report.noise_multiple,
        limits.single,
        limits.ewma,
        report.healthy_run_batches,
        report.healthy_run_error,
        report.wanted_run_batches
    );
    let header = ["parameter", "mean", "std", "noise std of one measurement", "detected with 90 % (a90)"];
    let plots = format!("<div class=\"plots\">{}{}</div>", plot.svg(), delay.svg());
    let mut sections = vec![("Detectable changes".to_owned(), facts + &table(&header, &rows) + &plots)];
    sections.extend(report.process.as_ref().map(ProcessReport::section));
    page(&format!("Alarms of {}", report.structure), &sections)
}

/// A delay over the shift, where it is short enough for the plot.
fn delays(found: &Detection, value: impl Fn(&crate::alarm::detection::DetectionPoint) -> f64) -> Vec<(f64, f64)> {
    found.curve.iter().map(|p| (p.shift, value(p))).filter(|(_, run)| *run <= 30.0).collect()
}
