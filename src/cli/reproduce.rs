//! `modalwatch reproduce`: the paper's two cases, beside its figures.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::Context as _;
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};

use super::write_whole;
use crate::baseline::conditions::NoiseRange;
use crate::baseline::library::find_structure;
use crate::baseline::train::train;
use crate::baseline::Baseline;
use crate::flow::train::TrainSettings;
use crate::flow::FlowSettings;
use crate::reproduce::{case1, case2, report, Machine, Reproduction, Settings};
use crate::simulator::definition::MeasurementNoise;
use crate::simulator::Simulator;

/// Measurement noise of case 2, as a share of each frequency.
const RIG_NOISE: f64 = 0.001;

/// Run the paper's cases.
#[derive(Debug, Args)]
pub struct ReproduceArgs {
    /// Folder for report.html and reproduction.json
    #[arg(long)]
    out: PathBuf,
    /// Only this case
    #[arg(long, value_parser = clap::value_parser!(u8).range(1..=2))]
    case: Option<u8>,
    /// Repetitions with fresh measurements [default: 30; 3 with --quick]
    #[arg(long)]
    repetitions: Option<usize>,
    /// A short run, to look at: three repetitions, flows trained for a shorter time
    #[arg(long)]
    quick: bool,
    /// Seed of everything random
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Print the numbers as JSON
    #[arg(long)]
    json: bool,
}

/// Runs, writes the report and says where it is.
///
/// # Errors
/// A folder that cannot be written; what a method says of its data.
pub fn reproduce(args: &ReproduceArgs) -> anyhow::Result<()> {
    std::fs::create_dir_all(&args.out).with_context(|| format!("cannot make the folder {}", args.out.display()))?;
    let started = Instant::now();
    let repetitions = args.repetitions.unwrap_or(if args.quick { 3 } else { 30 });
    anyhow::ensure!(repetitions > 0, "--repetitions is 0: at least 1 is needed");
    let mut reproduction = Reproduction {
        machine: Machine::here(),
        settings: Settings {
            repetitions,
            seed: args.seed,
            tmcmc_samples: if args.quick { 400 } else { 1_000 },
            training_samples: if args.quick { 5_000 } else { 10_000 },
            training_epochs: if args.quick { 50 } else { 200 },
            quick: args.quick,
        },
        case1: None,
        case2: None,
        seconds: 0.0,
    };
    let settings = reproduction.settings.clone();
    if args.case != Some(2) {
        let (baseline, seconds) = trained("three-dof", 0.0, &settings)?;
        let bar = spinner("case 1")?;
        reproduction.case1 = Some(case1(&baseline, seconds, &settings, &|step| bar.set_message(step.to_owned()))?);
        bar.finish_and_clear();
    }
    if args.case != Some(1) {
        let (baseline, seconds) = trained("rig", RIG_NOISE, &settings)?;
        let bar = spinner("case 2")?;
        reproduction.case2 = Some(case2(&baseline, seconds, &settings, &|step| bar.set_message(step.to_owned()))?);
        bar.finish_and_clear();
    }
    reproduction.seconds = started.elapsed().as_secs_f64();
    let page = args.out.join("report.html");
    write_whole(&page, report::html(&reproduction).as_bytes())?;
    let json = serde_json::to_string_pretty(&reproduction)?;
    write_whole(&args.out.join("reproduction.json"), json.as_bytes())?;
    if args.json {
        println!("{json}");
    } else {
        println!("{repetitions} repetitions in {:.0} s: {}", reproduction.seconds, page.display());
    }
    Ok(())
}

/// A flow for a shipped structure with this noise, and the seconds its training took.
fn trained(structure: &str, noise: f64, settings: &Settings) -> anyhow::Result<(Baseline, f64)> {
    let mut definition = find_structure(structure)?.definition().clone();
    definition.measurement_noise = MeasurementNoise::Relative(noise);
    let simulator = Simulator::new(definition)?;
    let train_settings =
        TrainSettings { epochs: settings.training_epochs, seed: settings.seed, ..TrainSettings::default() };
    let bar = ProgressBar::new(settings.training_epochs as u64);
    let style = "{elapsed} {wide_bar} training {msg} epoch {pos}/{len}, {eta} left";
    bar.set_style(ProgressStyle::with_template(style).context("the template of the progress bar")?);
    bar.set_message(structure.to_owned());
    let started = Instant::now();
    let range = NoiseRange { lowest: 0.5, highest: 2.0 };
    let (samples, flow) = (settings.training_samples, FlowSettings::default());
    let trained =
        train(&simulator, samples, range, &flow, &train_settings, |epoch| bar.set_position(epoch.epoch as u64))?;
    bar.finish_and_clear();
    Ok((trained.baseline, started.elapsed().as_secs_f64()))
}

fn spinner(case: &str) -> anyhow::Result<ProgressBar> {
    let bar = ProgressBar::new_spinner();
    let style = format!("{{elapsed}} {case}, {{msg}}");
    bar.set_style(ProgressStyle::with_template(&style).context("the template of the progress bar")?);
    bar.enable_steady_tick(std::time::Duration::from_millis(200));
    Ok(bar)
}
