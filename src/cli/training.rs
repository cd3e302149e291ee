//! Training with a progress bar, for the commands `train` and `extend`.

use std::path::Path;

use anyhow::Context as _;
use indicatif::{ProgressBar, ProgressStyle};

use super::output::write_whole;
use crate::baseline::extension::{ExtensionPlan, Progress};
use crate::baseline::manifest::{Manifest, Outcome};
use crate::baseline::recipe::Recipe;
use crate::baseline::train::Trained;
use crate::simulator::Simulator;

/// Trains with a progress bar until the calibration passes or stops improving, and writes the two files of the trained model to the
/// folder `out`.
///
/// # Errors
/// A training that fails, a folder that cannot be written.
pub fn train_into(out: &Path, simulator: &Simulator, recipe: &Recipe) -> anyhow::Result<Trained> {
    let bar = progress_bar()?;
    let trained = recipe.train(simulator, &mut |progress| show(&bar, progress))?;
    bar.finish_and_clear();
    write_files(out, &trained)?;
    Ok(trained)
}

/// Trains the model of an extended structure as planned, with a progress bar, writes its two files to the folder `out`, and prints
/// which weights the training started from.
///
/// # Errors
/// A training that fails, a folder that cannot be written.
pub fn train_extension_into(out: &Path, simulator: &Simulator, plan: &ExtensionPlan<'_>) -> anyhow::Result<Trained> {
    let bar = progress_bar()?;
    let trained = plan.train(simulator, &mut |progress| show(&bar, progress))?;
    bar.finish_and_clear();
    write_files(out, &trained)?;
    Ok(trained)
}

fn progress_bar() -> anyhow::Result<ProgressBar> {
    let style = "{elapsed} {wide_bar} epoch {pos}/{len}, {msg}, {eta} left";
    let style = ProgressStyle::with_template(style).context("the template of the progress bar")?;
    Ok(ProgressBar::new(0).with_style(style))
}

/// Shows what a training is doing. Sentences go to standard error, so that they stand above the bar and not in a JSON result.
fn show(bar: &ProgressBar, progress: Progress) {
    match progress {
        Progress::Start(sentence) | Progress::Round(sentence) => bar.suspend(|| eprintln!("{sentence}")),
        Progress::Calibration { round } => bar.set_message(format!("measuring the calibration after round {round}")),
        Progress::Cell { .. } => bar.tick(),
        Progress::Epoch { report, epochs } => {
            bar.set_length(epochs as u64);
            bar.set_message(format!(
                "misfit {:.3}, on other simulations {:.3} (lower is better)",
                report.loss, report.validation_loss
            ));
            bar.set_position(report.epoch as u64);
        }
    }
}

fn write_files(out: &Path, trained: &Trained) -> anyhow::Result<()> {
    write_whole(&out.join("baseline.safetensors"), &trained.weights)?;
    write_whole(&out.join("baseline.json"), &trained.manifest_json)
}

/// Prints what the modes determine, and the calibration.
pub fn print_record(manifest: &Manifest) {
    for p in &manifest.identifiability.parameters {
        let (name, left) = (&p.name, 100.0 * p.variance_left);
        println!(
            "one measurement leaves {left:.2} % of the prior variance of {name} (standard deviation {:.4})",
            p.posterior_std
        );
    }
    for group in &manifest.identifiability.groups {
        println!("the modes cannot distinguish these parameters: {}", group.join(", "));
    }
    let calibration = &manifest.calibration;
    let (cells, simulations) = (calibration.cells.len(), calibration.simulations);
    match calibration.outcome() {
        Outcome::Passed => println!(
            "calibration passed: the intervals hold the stated share of the true values in {cells} situations of {simulations} \
             simulated measurements each"
        ),
        Outcome::NotMeasured => println!("calibration: not measured"),
        Outcome::Cautious => println!(
            "calibration cautious: some intervals are wider than they need to be and none is too narrow; the service uses this model"
        ),
        Outcome::Overconfident => println!(
            "calibration overconfident: some intervals are too narrow; the service does not use this model unless \
             monitor.accept_uncalibrated lists its digest"
        ),
    }
    for reason in calibration.reasons() {
        println!("  {reason}.");
    }
    if !manifest.spread.is_empty() {
        println!("the spread of the network's own samples is adjusted by factors learned on further simulations");
    }
}

/// Fails for a model whose intervals are too narrow; `next` is the command to type then.
///
/// # Errors
/// The outcome `overconfident`, with the next command.
pub fn refuse_overconfident(manifest: &Manifest, next: &str) -> anyhow::Result<()> {
    anyhow::ensure!(
        manifest.calibration.outcome() < Outcome::Overconfident,
        "the model is overconfident: {} of its intervals are too narrow or misplaced. Next: {next}",
        manifest.calibration.failures.len()
    );
    Ok(())
}
