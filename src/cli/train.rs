//! `modalwatch train`: trains the model of a structure by simulation.

use std::path::{Path, PathBuf};
use std::time::Instant;

use anyhow::Context as _;
use clap::Args;

use super::output::write_whole;
use super::training::{print_record, refuse_overconfident, train_into};
use crate::baseline::conditions::NoiseRange;
use crate::baseline::library::{find_structure, read_structure_file};
use crate::baseline::manifest::{Manifest, Outcome, ValidationRecord};
use crate::baseline::recipe::RecipeRequest;
use crate::baseline::rounds::MOST_ROUNDS;
use crate::baseline::train::diverged;
use crate::flow::train::TrainSettings;
use crate::simulator::Simulator;

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
    /// Most rounds of training: after a round whose calibration does not pass, a shorter round follows [default: 4; 1 if --samples or
    /// --epochs is given]
    #[arg(long, value_parser = clap::value_parser!(u16).range(1..=16))]
    rounds: Option<u16>,
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
/// An invalid structure file, a training that fails, a folder that cannot be written; a model that is overconfident, after its files
/// are written.
pub fn train(args: &TrainArgs) -> anyhow::Result<()> {
    let simulator = find_structure(&args.structure)?;
    let out = args.out.clone().unwrap_or_else(|| PathBuf::from("models").join(simulator.id().as_str()));
    // Before the training, so that minutes are not wasted if the folder cannot be written.
    std::fs::create_dir_all(&out).with_context(|| format!("cannot create the folder {}", out.display()))?;

    let own_file = own_structure_file(&out, &simulator, &args.structure)?;
    if let Some(table) = simulator.table() {
        let error = |mode: usize| format!("{:.2e}", table.emulator().relative_error(mode));
        let errors: Vec<String> = (0..simulator.modes()).map(error).collect();
        eprintln!(
            "emulator of {} runs: relative error of each mode on runs that were left out: {}",
            table.runs(),
            errors.join(", ")
        );
    }
    for warning in simulator.warnings().into_iter().chain(simulator.mesh_warning()) {
        eprintln!("note: {warning}");
    }
    let request = RecipeRequest {
        samples: args.samples,
        epochs: args.epochs,
        units: args.units.map(usize::from),
        rounds: args.rounds.map(usize::from),
        noise_range: Some(args.noise_range),
        seed: Some(args.seed),
    };
    let started = Instant::now();
    let recipe = request.recipe(&simulator);
    let trained = train_into(&out, &simulator, &recipe)?;
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
            "outcome": manifest.calibration.outcome(), "calibration": manifest.calibration, "identifiability": manifest.identifiability,
        });
        println!("{}", serde_json::to_string_pretty(&report)?);
        return refuse_overconfident(manifest, &again(args, &out, manifest));
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
    if !simulator.is_noisy() {
        // Posteriors of exact data are points: no further training helps.
        let path = &args.structure;
        let next = format!(
            "state measurement_noise in {path}, then modalwatch train --structure {path} --out {}",
            out.display()
        );
        return refuse_overconfident(manifest, &next);
    }
    let again = again(args, &out, manifest);
    match manifest.calibration.outcome() {
        Outcome::Passed | Outcome::NotMeasured => {}
        Outcome::Cautious => println!("for narrower intervals: {again}"),
        Outcome::Overconfident => return refuse_overconfident(manifest, &again),
    }
    if let Some(models) = out.parent() {
        let models = if models.as_os_str().is_empty() { Path::new(".") } else { models };
        println!("next: modalwatch serve --models {}", models.display());
    }
    Ok(())
}

/// The structure file that the folder has already.
///
/// # Errors
/// If it describes another structure: a trained model beside it would be refused when it is loaded.
fn own_structure_file(out: &Path, simulator: &Simulator, given: &str) -> anyhow::Result<Option<PathBuf>> {
    let own_file =
        ["structure.toml", "structure.json"].map(|name| out.join(name)).into_iter().find(|path| path.exists());
    if let Some(path) = &own_file {
        anyhow::ensure!(
            read_structure_file(path)?.digest() == simulator.digest(),
            "{} describes a different structure than {given}: choose another folder with --out",
            path.display(),
        );
    }
    Ok(own_file)
}

/// The command that trains a larger network for longer.
fn again(args: &TrainArgs, out: &Path, manifest: &Manifest) -> String {
    let units = (2 * manifest.architecture.units).min(64);
    let epochs = 2 * manifest.training.settings.epochs;
    format!(
        "modalwatch train --structure {} --out {} --units {units} --epochs {epochs} --rounds {MOST_ROUNDS}",
        args.structure,
        out.display()
    )
}

fn noise_range(text: &str) -> Result<NoiseRange, String> {
    let numbers: Vec<f64> = text.split(',').filter_map(|t| t.trim().parse().ok()).collect();
    match numbers[..] {
        [lowest, highest] => Ok(NoiseRange { lowest, highest }),
        _ => Err("must be two numbers separated by a comma, such as 0.1,5".to_owned()),
    }
}

/// A ratio by its natural logarithm, as a power of ten where it is large.
fn ratio(ln: f64) -> String {
    match ln.exp() {
        large if large >= 1e5 => format!("10^{:.1}", ln / std::f64::consts::LN_10),
        ratio if ratio >= 100.0 => format!("{ratio:.0}"),
        ratio => format!("{ratio:.2}"),
    }
}

fn print_validation(validation: &ValidationRecord) {
    println!(
        "{} simulated measurements that the training did not use: the answers give the true values on average {} times the probability density \
         that the prior gives them (higher is better; geometric mean, standard error {:.0} %)",
        validation.samples,
        ratio(-validation.negative_log_likelihood),
        100.0 * validation.negative_log_likelihood_error.exp_m1()
    );
    println!(
        "the network maps its samples back to where they came from to within {:.5} % of the width of the prior",
        100.0 * validation.inverse_error
    );
    println!("share of the variance of the true values that the answers explain (R², 1 is best), and the error that 99.9 % of the samples stay below:");
    println!("{:>16} {:>12} {:>14} {:>14}", "parameter", "R² of means", "R² of samples", "error");
    for p in &validation.parameters {
        let (mean, single, quantile) = (p.r_squared_mean, p.r_squared_single, p.error_quantile_999);
        println!("{:>16} {mean:>12.6} {single:>14.6} {quantile:>14.4}", p.name);
    }
}
