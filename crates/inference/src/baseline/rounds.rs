//! Training that goes on by itself until its calibration passes or stops improving.
//!
//! After each round the model is certified, on simulations of its own. A further round continues from the present weights with half
//! the learning rate and half the epochs of the first. The training ends when the calibration passes, after [`MOST_ROUNDS`] rounds, or
//! after two rounds in a row that leave no fewer findings than the best one before. The model with the fewest findings is
//! kept; one that is too narrow anywhere counts as worse than any that is not.

use super::conditions::NoiseRange;
use super::manifest::{CalibrationRecord, Outcome};
use super::train::{prepare, Error, Ongoing, Trained};
use crate::flow::train::{EpochReport, TrainSettings};
use crate::flow::FlowSettings;
use structures::simulator::Simulator;

/// Most rounds of a training.
pub const MOST_ROUNDS: usize = 4;

/// Rounds in a row without fewer findings, after which the training ends.
const PATIENCE: usize = 2;

/// Epochs of a further round, as a share of those of the first.
const SHARE_OF_EPOCHS: f64 = 0.5;

/// Learning rate of a further round, as a share of that of the first.
const SHARE_OF_LEARNING_RATE: f64 = 0.5;

/// What happens in a training.
#[derive(Debug, Clone)]
pub enum Progress {
    /// How the training starts, and why.
    Start(String),
    /// An epoch has ended.
    Epoch {
        /// State after the epoch.
        report: EpochReport,
        /// Number of epochs of this round.
        epochs: usize,
    },
    /// The calibration is measured.
    Calibration {
        /// Number of the round, counted from 1.
        round: usize,
    },
    /// A cell of the calibration is measured. A calibration that does not pass is measured again after a repair.
    Cell {
        /// Cells measured so far.
        done: usize,
        /// Number of cells.
        cells: usize,
    },
    /// The training goes on or ends without having passed, and why.
    Round(String),
}

/// Trains a model on `samples` simulated pairs, in at most `rounds` rounds.
///
/// The same simulator, settings and seed give the same bytes, whatever the number of threads.
///
/// # Errors
/// As [`super::train::train`].
pub fn train_in_rounds(
    simulator: &Simulator,
    samples: usize,
    noise_range: NoiseRange,
    flow_settings: &FlowSettings,
    settings: &TrainSettings,
    rounds: usize,
    on_progress: &mut dyn FnMut(Progress),
) -> Result<Trained, Error> {
    let prepared = prepare(simulator, samples, noise_range, flow_settings, settings)?;
    run(prepared.begin(simulator, settings)?, rounds, on_progress)
}

/// Runs a training in at most `most` rounds.
pub(super) fn run(
    mut ongoing: Ongoing<'_>,
    most: usize,
    on_progress: &mut dyn FnMut(Progress),
) -> Result<Trained, Error> {
    let first = ongoing.settings;
    ongoing.first_round(|report| on_progress(Progress::Epoch { report, epochs: first.epochs }))?;
    on_progress(Progress::Calibration { round: 1 });
    let mut best = ongoing.certified(&mut |done, cells| on_progress(Progress::Cell { done, cells }))?;
    let epochs = (first.epochs as f64 * SHARE_OF_EPOCHS).ceil() as usize;
    let learning_rate = first.learning_rate * SHARE_OF_LEARNING_RATE;
    let mut without_improvement = 0;
    // Without noise there is nothing to calibrate.
    while ongoing.simulator.is_noisy() && !calibration(&best).passed() && ongoing.rounds() < most {
        if without_improvement == PATIENCE {
            on_progress(Progress::Round(format!(
                "{}; the last {PATIENCE} rounds brought no improvement, so the training ends",
                state(ongoing.rounds(), calibration(&best))
            )));
            break;
        }
        on_progress(Progress::Round(format!(
            "{}; the training goes on for {epochs} epochs",
            state(ongoing.rounds(), calibration(&best))
        )));
        let report = |report| on_progress(Progress::Epoch { report, epochs });
        match ongoing.further_round(epochs, learning_rate, report) {
            Err(Error::Flow(error)) => {
                on_progress(Progress::Round(format!("the training ends: {error}")));
                break;
            }
            other => other?,
        }
        on_progress(Progress::Calibration { round: ongoing.rounds() });
        let next = ongoing.certified(&mut |done, cells| on_progress(Progress::Cell { done, cells }))?;
        if calibration(&next).findings() < calibration(&best).findings() {
            (best, without_improvement) = (next, 0);
        } else {
            without_improvement += 1;
        }
    }
    Ok(best)
}

fn calibration(trained: &Trained) -> &CalibrationRecord {
    &trained.baseline.manifest().calibration
}

/// The best calibration so far in a sentence.
fn state(round: usize, record: &CalibrationRecord) -> String {
    let (count, first, how) = match record.outcome() {
        Outcome::Overconfident => (record.failures.len(), record.failures.first(), "too narrow or misplaced"),
        Outcome::Cautious | Outcome::Passed | Outcome::NotMeasured => {
            (record.cautions.len(), record.cautions.first(), "too wide")
        }
    };
    let first = first.map(String::as_str).unwrap_or_default();
    let places = if count == 1 { "place" } else { "places" };
    format!("after round {round} the model is {how} in {count} {places} ({first})")
}
