//! `modalwatch assess`: the same assessment as the service's, from files.

use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::Args;

use crate::baseline::library::find_structure;
use crate::baseline::{assessment_seed, library::Library, Baseline};
use crate::damage::UndamagedState;
use crate::measurement::check::{check_measurements, Expectation};
use crate::measurement::csv::{self, CsvOptions, Times};
use crate::measurement::MeasurementBatch;
use crate::monitor::assess::{self, Draws};
use crate::monitor::MonitorSettings;
use crate::quantity::Timestamp;

/// Assess measurements without a service.
#[derive(Debug, Args)]
pub struct AssessArgs {
    /// Structure file (TOML or JSON), or the id of a shipped structure
    #[arg(long)]
    structure: String,
    /// The trained baseline's .safetensors, with its .json beside it; the shipped one without it
    #[arg(long)]
    model: Option<PathBuf>,
    /// CSV of the undamaged state
    #[arg(long)]
    baseline: PathBuf,
    /// CSV to assess
    #[arg(long)]
    data: PathBuf,
    /// Columns that are not read, separated by commas
    #[arg(long, value_delimiter = ',')]
    ignore: Vec<String>,
    /// Source of the measurements; part of what is digested, and so of the seed
    #[arg(long, default_value = "default")]
    source: String,
    /// p of the damage threshold
    #[arg(long, default_value_t = 0.05)]
    threshold_probability: f64,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// Reads the files and prints the assessment.
///
/// # Errors
/// Any file that is refused, with line and column.
pub fn assess(args: &AssessArgs) -> anyhow::Result<()> {
    let simulator = find_structure(&args.structure)?;
    let baseline = if let Some(weights) = &args.model {
        let read = |path: &Path| std::fs::read(path).with_context(|| format!("cannot read {}", path.display()));
        let manifest = weights.with_extension("json");
        Baseline::load(&read(&manifest)?, &read(weights)?, &simulator)
            .with_context(|| format!("{} is refused", weights.display()))?
            .into()
    } else {
        let library = Library::open(None)?;
        let entry = library.get(simulator.id()).and_then(|e| e.baseline.clone());
        entry.with_context(|| format!("no baseline of {} is shipped: give --model", simulator.id()))?
    };
    let undamaged_batch = read_batch(args, &args.baseline, &baseline)?;
    let batch = read_batch(args, &args.data, &baseline)?;
    let draws = |batch: &MeasurementBatch| Draws {
        per_measurement: MonitorSettings::default().draws_per_measurement,
        seed: assessment_seed(&batch.content_digest(), baseline.digest()),
    };
    let samples = assess::draw(&baseline, &undamaged_batch.measurements, draws(&undamaged_batch))?;
    let quantities = assess::monitored_quantities(&baseline, &samples.posterior);
    let undamaged = UndamagedState::from_samples(1, &quantities, args.threshold_probability)?;
    let assessment = assess::assess(&baseline, &batch.measurements, Some(&undamaged), draws(&batch))?;

    if args.json {
        let report = serde_json::json!({ "undamaged": undamaged, "assessment": assessment });
        println!("{}", serde_json::to_string_pretty(&report)?);
        return Ok(());
    }
    println!(
        "{} measurements used ({} of them outside the prior), {} left out for a missing mode",
        assessment.measurements_used, assessment.measurements_outside, assessment.measurements_left_out
    );
    for warning in assessment.warnings() {
        println!("warning: {warning}");
    }
    let misfit: Vec<String> = assessment.misfit_percent.iter().map(|m| format!("{m:+.3}")).collect();
    println!("simulation misses the mean frequencies by {} %", misfit.join(", "));
    println!("{:>16} {:>12} {:>12} {:>12} {:>8} {:>8}", "parameter", "mean", "std", "threshold", "PoD", "exceeds");
    for q in &assessment.quantities {
        let std = q.hyperparameters.std.map_or("-".to_owned(), |s| format!("{s:.4}"));
        let damage = q.damage.as_ref().map_or(["-".to_owned(), "-".to_owned(), "-".to_owned()], |d| {
            let exceeds = if d.exceeds { "yes" } else { "no" };
            [format!("{:.4}", d.threshold), format!("{:.1} %", 100.0 * d.probability_of_damage), exceeds.to_owned()]
        });
        let [threshold, pod, exceeds] = damage;
        println!("{:>16} {:>12.4} {std:>12} {threshold:>12} {pod:>8} {exceeds:>8}", q.name, q.hyperparameters.mean);
    }
    Ok(())
}

fn read_batch(args: &AssessArgs, path: &Path, baseline: &Baseline) -> anyhow::Result<MeasurementBatch> {
    let simulator = baseline.simulator();
    let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    let options = CsvOptions { times: Times::RowNumber, ignore: args.ignore.clone() };
    let expectation = Expectation {
        modes: simulator.modes(),
        frequency_limits_hz: simulator.frequency_limits_hz(),
        covariates: simulator.covariates(),
        space: simulator.space(),
        now: Timestamp::now(),
        max_measurements: usize::MAX,
    };
    let measurements = csv::read(&bytes, simulator.modes(), simulator.covariates(), &options)
        .and_then(|raw| check_measurements(raw, &expectation))
        .map_err(|problems| {
            let lines: Vec<String> = problems.iter().map(|p| format!("  {}: {}", p.pointer, p.message)).collect();
            anyhow::anyhow!("{} is refused:\n{}", path.display(), lines.join("\n"))
        })?;
    let structure = simulator.id().clone();
    Ok(MeasurementBatch { structure, source: args.source.clone(), idempotency_key: None, measurements })
}
