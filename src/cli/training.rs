//! Training with a progress bar, for the commands `train` and `extend`.

use std::path::Path;

use anyhow::Context as _;
use indicatif::{ProgressBar, ProgressStyle};

use super::output::write_whole;
use crate::baseline::conditions::NoiseRange;
use crate::baseline::extension::{ExtensionPlan, Progress};
use crate::baseline::manifest::Manifest;
use crate::baseline::train::{default_epochs, default_samples, train, Trained};
use crate::flow::train::{EpochReport, TrainSettings};
use crate::flow::FlowSettings;
use crate::simulator::Simulator;

/// Number of samples and epochs of a training: those given, otherwise the defaults for the structure.
pub fn sizes(simulator: &Simulator, samples: Option<usize>, epochs: Option<usize>) -> (usize, usize) {
    (samples.unwrap_or_else(|| default_samples(simulator)), epochs.unwrap_or_else(|| default_epochs(simulator)))
}

/// Trains with a progress bar and writes the two files of the trained model to the folder `out`.
///
/// # Errors
/// A training that fails, a folder that cannot be written.
pub fn train_into(
    out: &Path,
    simulator: &Simulator,
    samples: usize,
    noise_range: NoiseRange,
    flow: &FlowSettings,
    settings: &TrainSettings,
) -> anyhow::Result<Trained> {
    let bar = progress_bar()?;
    let trained =
        train(simulator, samples, noise_range, flow, settings, |epoch| advance(&bar, epoch, settings.epochs))?;
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
    let trained = plan.train(simulator, &mut |progress| match progress {
        Progress::Start(how) => bar.suspend(|| println!("{how}")),
        Progress::Epoch { report, epochs } => advance(&bar, report, epochs),
    })?;
    bar.finish_and_clear();
    write_files(out, &trained)?;
    Ok(trained)
}

fn progress_bar() -> anyhow::Result<ProgressBar> {
    let style = "{elapsed} {wide_bar} epoch {pos}/{len}, {msg}, {eta} left";
    let style = ProgressStyle::with_template(style).context("the template of the progress bar")?;
    Ok(ProgressBar::new(0).with_style(style))
}

fn advance(bar: &ProgressBar, epoch: EpochReport, epochs: usize) {
    bar.set_length(epochs as u64);
    bar.set_message(format!("loss {:.3}, validation {:.3}", epoch.loss, epoch.validation_loss));
    bar.set_position(epoch.epoch as u64);
}

fn write_files(out: &Path, trained: &Trained) -> anyhow::Result<()> {
    write_whole(&out.join("baseline.safetensors"), &trained.weights)?;
    write_whole(&out.join("baseline.json"), &trained.manifest_json)
}

/// Prints the identifiability and the calibration of a trained model.
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
    if calibration.passed() {
        println!("calibration passed in {} cells of {} simulations", calibration.cells.len(), calibration.simulations);
        return;
    }
    println!(
        "CALIBRATION FAILED: the service does not use this model unless monitor.accept_uncalibrated lists its digest"
    );
    for failure in &calibration.failures {
        println!("  {failure}");
    }
}
