//! `modalwatch train`: trains the model of a structure by simulation.

use std::path::PathBuf;
use std::time::Instant;

use anyhow::Context as _;
use clap::Args;

use super::output::write_whole;
use super::training::{print_record, sizes, train_into};
use crate::baseline::conditions::NoiseRange;
use crate::baseline::library::{find_structure, read_structure_file};
use crate::baseline::manifest::ValidationRecord;
use crate::baseline::train::diverged;
use crate::flow::train::TrainSettings;
use crate::flow::FlowSettings;

/// Train the model of a structure.
#[derive(Debug, Args)]
pub struct TrainArgs {
    /// Structure file (TOML or JSON), or the id of a shipped structure
    #[arg(long)]
    structure: String,
    /// Folder for structure.toml, baseline.safetensors and baseline.json [default: models/<structure>]
    #[arg(long)]
    out: Option<PathBuf>,
    /// Number of simulated training samples [default: 200000; 10000 for a structure without measurement noise; 3000 to 40000 with many
    /// parameters or with mode shapes]
    #[arg(long)]
    samples: Option<usize>,
    /// Number of passes over the training samples [default: 80; 200 for a structure without measurement noise; 8 with many
    /// parameters or with mode shapes]
    #[arg(long)]
    epochs: Option<usize>,
    /// Number of coupling units of the network; more units represent more complex posteriors and take longer [default: 4]
    #[arg(long, value_parser = clap::value_parser!(u16).range(1..=64))]
    units: Option<u16>,
    /// Range of noise that the trained model must cover, as multiples of the noise of the structure
    #[arg(long, value_name = "LOW,HIGH", value_parser = noise_range, default_value = "0.1,5")]
    noise_range: NoiseRange,
    /// Seed of all random numbers; the same seed gives the same files
    #[arg(long, default_value_t = TrainSettings::default().seed)]
    seed: u64,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// Trains the model, writes its files and prints its validation.
///
/// # Errors
/// An invalid structure file, a training that fails, a folder that cannot be written.
pub fn train(args: &TrainArgs) -> anyhow::Result<()> {
    let simulator = find_structure(&args.structure)?;
    let out = args.out.clone().unwrap_or_else(|| PathBuf::from("models").join(simulator.id().as_str()));
    // Before the training, so that minutes are not wasted if the folder cannot be written.
    std::fs::create_dir_all(&out).with_context(|| format!("cannot create the folder {}", out.display()))?;

    let own_file =
        ["structure.toml", "structure.json"].map(|name| out.join(name)).into_iter().find(|path| path.exists());
    if let Some(path) = &own_file {
        // A trained model in the folder of another structure would be refused when it is loaded.
        let beside = read_structure_file(path)?;
        anyhow::ensure!(
            beside.digest() == simulator.digest(),
            "{} describes a different structure than {}: choose another folder with --out",
            path.display(),
            args.structure
        );
    }

    if let Some(table) = simulator.table() {
        let error = |mode: usize| format!("{:.2e}", table.emulator().relative_error(mode));
        let errors: Vec<String> = (0..simulator.modes()).map(error).collect();
        eprintln!(
            "emulator of {} runs: relative error of each mode on runs that were left out: {}",
            table.runs(),
            errors.join(", ")
        );
    }
    for warning in simulator.warnings() {
        eprintln!("note: {warning}");
    }
    let (samples, epochs) = sizes(&simulator, args.samples, args.epochs);
    let settings = TrainSettings { epochs, seed: args.seed, ..TrainSettings::default() };
    let mut flow = FlowSettings::default();
    flow.units = args.units.map_or(flow.units, usize::from);
    let started = Instant::now();
    let trained = train_into(&out, &simulator, samples, args.noise_range, &flow, &settings)?;
    let seconds = started.elapsed().as_secs_f64();

    // `serve --models` only finds folders that contain the structure.
    if own_file.is_none() {
        write_whole(&out.join("structure.json"), simulator.definition().canonical_json().as_bytes())?;
    }

    let manifest = trained.baseline.manifest();
    if args.json {
        let report = serde_json::json!({
            "structure": manifest.structure, "model_digest": trained.baseline.digest(), "out": out,
            "seconds": seconds, "training": manifest.training, "validation": manifest.validation,
            "calibration": manifest.calibration, "identifiability": manifest.identifiability,
        });
        println!("{}", serde_json::to_string_pretty(&report)?);
        return Ok(());
    }
    println!("Trained {} in {seconds:.1} s: {}", simulator.id(), out.join("baseline.safetensors").display());
    println!("model digest {}", trained.baseline.digest());
    print_validation(&manifest.validation);
    print_record(manifest);
    if diverged(manifest) {
        println!(
            "The loss was not finite at the end of the training: the weights of epoch {} were kept.",
            manifest.training.best_epoch
        );
    }
    Ok(())
}

fn noise_range(text: &str) -> Result<NoiseRange, String> {
    let numbers: Vec<f64> = text.split(',').filter_map(|t| t.trim().parse().ok()).collect();
    match numbers[..] {
        [lowest, highest] => Ok(NoiseRange { lowest, highest }),
        _ => Err("must be two numbers separated by a comma, such as 0.1,5".to_owned()),
    }
}

fn print_validation(validation: &ValidationRecord) {
    println!(
        "held-out negative log-likelihood in the unit box {:.2} ± {:.2} nats over {} pairs, inverse error {:.1e}",
        validation.negative_log_likelihood,
        validation.negative_log_likelihood_error,
        validation.samples,
        validation.inverse_error
    );
    println!("{:>16} {:>10} {:>10} {:>24}", "parameter", "R² mean", "R² single", "99.9 % of errors below");
    for p in &validation.parameters {
        let (mean, single, quantile) = (p.r_squared_mean, p.r_squared_single, p.error_quantile_999);
        println!("{:>16} {mean:>10.6} {single:>10.6} {quantile:>24.4}", p.name);
    }
}
