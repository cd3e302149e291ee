//! Training by maximum likelihood.

use rand::seq::SliceRandom as _;
use serde::{Deserialize, Serialize};

use super::fused::Fused;
use super::model::Flow;
use super::pairs::Pairs;
use super::weights::Weights;
use structures::stats;

/// Training schedule.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainSettings {
    /// Passes over the training set.
    pub epochs: usize,
    /// Pairs per step.
    pub batch: usize,
    /// Learning rate of the first step. It falls to 0 along a half cosine.
    pub learning_rate: f64,
    /// Seed of the weights, the permutations and the order of the pairs.
    pub seed: u64,
}

impl Default for TrainSettings {
    fn default() -> Self {
        Self { epochs: 200, batch: 256, learning_rate: 3e-3, seed: 1 }
    }
}

/// State of the training after one epoch.
#[derive(Debug, Clone, Copy)]
pub struct EpochReport {
    /// Number of the epoch, counted from 1.
    pub epoch: usize,
    /// Mean loss over the steps of this epoch, nats.
    pub loss: f64,
    /// Loss over the validation pairs, nats.
    pub validation_loss: f64,
}

/// Why the training ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case", tag = "reason")]
pub enum Stopped {
    /// All epochs were completed.
    Completed,
    /// The loss was not finite in this epoch. The best weights before it are kept.
    Diverged {
        /// Epoch, counted from 1.
        epoch: usize,
    },
}

/// Result of a training. The flow holds the best weights.
#[derive(Debug, Clone)]
pub struct TrainOutcome {
    /// Epoch with the lowest validation loss, counted from 1.
    pub best_epoch: usize,
    /// The lowest validation loss, nats.
    pub best_validation_loss: f64,
    /// Why the training ended.
    pub stopped: Stopped,
}

/// Why a training gave no flow.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The loss was not finite in the first epoch.
    #[error("the loss was not finite in the first epoch (learning rate {learning_rate}): try a smaller one")]
    DivergedAtOnce {
        /// Learning rate of the first step.
        learning_rate: f64,
    },
    /// Tensors of the wrong shape: a bug.
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
}

/// Trains `flow`, whose variables are `weights`, by maximum likelihood, and leaves the weights with the lowest validation
/// loss in it.
///
/// `training` returns the pairs of an epoch (counted from 1), always `rows` of them; they may differ in their noise.
///
/// ```text
///  loss = 1/M Σ ( ½|z|² − ln|det ∂z/∂x| ),   AdamW without weight decay, learning rate falling to 0 along a half cosine
/// ```
///
/// Source: Wang et al. (2025), Eq. 20. The schedule and the choice of the best epoch are ours.
///
/// # Errors
/// [`Error::DivergedAtOnce`] when no epoch had a finite loss; [`Error::Tensor`] for weights that are not in single precision.
pub fn train(
    flow: &Flow,
    weights: &Weights,
    rows: usize,
    mut training: impl FnMut(usize) -> Result<Pairs, candle_core::Error>,
    validation: &Pairs,
    settings: &TrainSettings,
    mut on_epoch: impl FnMut(EpochReport),
) -> Result<TrainOutcome, Error> {
    let mut fused = Fused::new(flow, weights)?;
    let steps_per_epoch = rows.div_ceil(settings.batch);
    let total_steps = settings.epochs * steps_per_epoch;
    let mut shuffle = stats::stream(settings.seed, "shuffle");
    let mut order: Vec<u32> = (0..rows as u32).collect();
    let validation = fused.rows(flow, validation)?;

    let mut best: Option<(usize, f64, Vec<f32>)> = None;
    let mut stopped = Stopped::Completed;
    'epochs: for epoch in 1..=settings.epochs {
        order.shuffle(&mut shuffle);
        let training = fused.rows(flow, &training(epoch)?)?;
        let mut sum = 0.0;
        for (step, chosen) in order.chunks(settings.batch).enumerate() {
            let progress = ((epoch - 1) * steps_per_epoch + step) as f64 / total_steps as f64;
            let learning_rate = settings.learning_rate * 0.5 * (1.0 + (std::f64::consts::PI * progress).cos());
            let loss = fused.step(&training, chosen, learning_rate);
            if !loss.is_finite() {
                stopped = Stopped::Diverged { epoch };
                break 'epochs;
            }
            sum += loss;
        }
        let validation_loss = fused.loss(&validation);
        if !validation_loss.is_finite() {
            stopped = Stopped::Diverged { epoch };
            break;
        }
        if best.as_ref().is_none_or(|(_, least, _)| validation_loss < *least) {
            best = Some((epoch, validation_loss, fused.weights().to_vec()));
        }
        on_epoch(EpochReport { epoch, loss: sum / steps_per_epoch as f64, validation_loss });
    }
    let diverged_at_once = Error::DivergedAtOnce { learning_rate: settings.learning_rate };
    let (best_epoch, best_validation_loss, copy) = best.ok_or(diverged_at_once)?;
    fused.write(&copy, weights)?;
    Ok(TrainOutcome { best_epoch, best_validation_loss, stopped })
}
