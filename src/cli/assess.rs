//! `modalwatch assess`: the same assessment as the service's, from files.

use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::Args;

use super::calibrate::load;
use super::measurements::read_measurements;
use crate::assessment::{self, Draws};
use crate::baseline::{assessment_seed, Baseline};
use crate::measurement::MeasurementBatch;
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
    let baseline = load(&args.structure, args.model.as_deref())?;
    let undamaged_batch = read_batch(args, &args.baseline, &baseline)?;
    let batch = read_batch(args, &args.data, &baseline)?;
    let draws =
        |batch: &MeasurementBatch| Draws::with_seed(assessment_seed(&batch.content_digest(), baseline.digest()));
    let undamaged_draws = draws(&undamaged_batch);
    let batches = [(undamaged_batch.measurements.as_slice(), undamaged_draws)];
    let mut undamaged = assessment::undamaged_state(&baseline, &batches, args.threshold_probability)
        .with_context(|| format!("{} makes no undamaged reference", args.baseline.display()))?;
    undamaged.version = 1;
    let context = assessment::Context { undamaged: Some(&undamaged), previous: None };
    let assessment = assessment::assess(&baseline, &batch.measurements, context, draws(&batch), Timestamp::now())?;

    if args.json {
        let report = serde_json::json!({ "undamaged": undamaged, "assessment": assessment });
        println!("{}", serde_json::to_string_pretty(&report)?);
        return Ok(());
    }
    println!(
        "{} measurements used ({} of them beyond the prior), {} left out",
        assessment.measurements_used, assessment.measurements_outside, assessment.measurements_left_out
    );
    if !assessment.trust.accepted() {
        println!("NOT TO BE TRUSTED: no probability of damage is given");
    }
    for finding in undamaged.doubts.iter().chain(assessment.trust.findings.iter().map(|f| &f.message)) {
        println!("note: {finding}");
    }
    let percent = |misfit: &Option<f64>| misfit.map_or("-".to_owned(), |m| format!("{m:+.3}"));
    let misfit: Vec<String> = assessment.misfit_percent.iter().map(percent).collect();
    println!("simulation misses the mean frequencies by {} %", misfit.join(", "));
    println!(
        "{:>16} {:>26} {:>26} {:>12} {:>24} {:>8}",
        "parameter", "mean (90 %)", "std (90 %)", "threshold", "PoD, % (90 %)", "exceeds"
    );
    let with = |value: Option<f64>, interval: Option<[f64; 2]>, scale: f64, digits: usize| match (value, interval) {
        (Some(v), Some([low, high])) => {
            format!("{:.digits$} ({:.digits$} … {:.digits$})", v * scale, low * scale, high * scale)
        }
        (Some(v), None) => format!("{:.digits$}", v * scale),
        _ => "-".to_owned(),
    };
    for q in &assessment.quantities {
        let damage = q.damage.as_ref();
        println!(
            "{:>16} {:>26} {:>26} {:>12} {:>24} {:>8}",
            q.name,
            with(Some(q.mean), q.mean_interval, 1.0, 4),
            with(q.std, q.std_interval, 1.0, 4),
            damage.map_or("-".to_owned(), |d| format!("{:.4}", d.threshold)),
            with(damage.map(|d| d.probability_of_damage), damage.and_then(|d| d.probability_interval), 100.0, 1),
            damage.map_or("-", |d| if d.exceeds { "yes" } else { "no" })
        );
    }
    Ok(())
}

fn read_batch(args: &AssessArgs, path: &Path, baseline: &Baseline) -> anyhow::Result<MeasurementBatch> {
    let simulator = baseline.simulator();
    let measurements = read_measurements(simulator, path, &args.ignore)?;
    let structure = simulator.id().clone();
    Ok(MeasurementBatch { structure, source: args.source.clone(), idempotency_key: None, measurements })
}
