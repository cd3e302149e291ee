//! `modalwatch assess`: the assessment of the service, from files.

use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::Args;

use super::measurements::read_measurements;
use super::model::load;
use crate::alarm::AlarmSettings;
use crate::assessment::{self, Draws};
use crate::baseline::{assessment_seed, Baseline};
use crate::clock;
use crate::measurement::MeasurementBatch;
use crate::parameter::in_words;

/// Assess measurements without a service.
#[derive(Debug, Args)]
pub struct AssessArgs {
    /// Structure file (TOML or JSON), or the id of a shipped structure
    #[arg(long)]
    structure: String,
    /// Trained model: its .safetensors file, with its .json beside it [default: the one beside the structure file or the shipped
    /// one; otherwise one that is made in a second]
    #[arg(long)]
    model: Option<PathBuf>,
    /// CSV file of the undamaged reference
    #[arg(long, alias = "baseline")]
    reference: PathBuf,
    /// CSV file to assess
    #[arg(long)]
    data: PathBuf,
    /// Columns to ignore, separated by commas
    #[arg(long, value_delimiter = ',')]
    ignore: Vec<String>,
    /// Source of the measurements; the random seed depends on it, as in the service
    #[arg(long, default_value = "default")]
    source: String,
    /// Probability that defines the damage threshold: the quantile of the undamaged reference
    #[arg(long, default_value_t = 0.05)]
    threshold_probability: f64,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// Reads the files and prints the assessment.
///
/// # Errors
/// A file that is refused, with line and column.
pub fn assess(args: &AssessArgs) -> anyhow::Result<()> {
    let model = load(&args.structure, args.model.as_deref())?;
    let undamaged_batch = read_batch(args, &args.reference, &model)?;
    let batch = read_batch(args, &args.data, &model)?;
    let draws = |batch: &MeasurementBatch| Draws::with_seed(assessment_seed(&batch.content_digest(), model.digest()));
    let undamaged_draws = draws(&undamaged_batch);
    let batches = [(undamaged_batch.measurements.as_slice(), undamaged_draws)];
    let settings = AlarmSettings::default();
    let mut undamaged = assessment::undamaged_reference(&model, &batches, args.threshold_probability, &settings)
        .with_context(|| format!("{} cannot be used as undamaged reference", args.reference.display()))?;
    undamaged.version = 1;
    let context = assessment::Context { undamaged: Some(&undamaged), earlier: None };
    let assessment = assessment::assess(&model, &batch.measurements, context, draws(&batch), clock::now())?;

    if args.json {
        let report = serde_json::json!({ "undamaged": undamaged, "assessment": assessment });
        println!("{}", serde_json::to_string_pretty(&report)?);
        return trusted(args, &assessment);
    }
    println!(
        "{} measurements used, of which {} lie outside the prior; {} left out",
        assessment.measurements_used, assessment.measurements_outside, assessment.measurements_left_out
    );
    for finding in undamaged.doubts.iter().chain(assessment.trust.findings.iter().map(|f| &f.message)) {
        println!("note: {finding}");
    }
    let percent = |misfit: &Option<f64>| misfit.map_or("-".to_owned(), |m| format!("{m:+.3}"));
    let misfit: Vec<String> = assessment.misfit_percent.iter().map(percent).collect();
    println!("deviation of the simulated from the mean measured frequencies: {} %", misfit.join(", "));
    println!(
        "{:>30} {:>26} {:>26} {:>12} {:>24} {:>8}",
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
            "{:>30} {:>26} {:>26} {:>12} {:>24} {:>8}",
            with_unit(q),
            with(Some(q.mean), q.mean_interval, 1.0, 4),
            with(q.std, q.std_interval, 1.0, 4),
            damage.map_or("-".to_owned(), |d| format!("{:.4}", d.threshold)),
            with(damage.map(|d| d.probability_of_damage), damage.and_then(|d| d.probability_interval), 100.0, 1),
            damage.map_or("-", |d| if d.exceeds { "yes" } else { "no" })
        );
    }
    println!(
        "std: standard deviation between the measurements. (90 %): interval that contains the value with a probability of 90 %."
    );
    println!(
        "threshold: {:.0} % of the undamaged values lie beyond it. PoD: probability of damage, that the value lies beyond the threshold.",
        100.0 * args.threshold_probability
    );
    println!(
        "exceeds: the PoD is above that of the undamaged measurements. Single healthy batches show that as well; alarms are raised by the \
         charts of the service."
    );
    trusted(args, &assessment)
}

/// The name of a quantity with its unit.
fn with_unit(quantity: &crate::damage::QuantityAssessment) -> String {
    let name = in_words(&quantity.name);
    if matches!(quantity.unit.as_str(), "" | "1") {
        name
    } else {
        format!("{name} ({})", quantity.unit)
    }
}

/// An error for measurements that were not accepted: there is no probability of damage, and a script must not take this for "healthy".
fn trusted(args: &AssessArgs, assessment: &assessment::Assessment) -> anyhow::Result<()> {
    anyhow::ensure!(
        assessment.trust.accepted(),
        "{} is not accepted, so that no probability of damage is given: {}",
        args.data.display(),
        assessment.trust.findings.iter().map(|f| f.message.as_str()).collect::<Vec<_>>().join("; ")
    );
    Ok(())
}

fn read_batch(args: &AssessArgs, path: &Path, model: &Baseline) -> anyhow::Result<MeasurementBatch> {
    let simulator = model.simulator();
    let measurements = read_measurements(simulator, path, &args.ignore)?;
    let structure = simulator.id().clone();
    let source = args.source.clone();
    Ok(MeasurementBatch { structure, source, idempotency_key: None, posted_by: None, measurements })
}
