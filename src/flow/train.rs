//! Training by maximum likelihood.

use std::collections::BTreeMap;

use candle_core::{DType, Device, Tensor};
use candle_nn::{AdamW, Optimizer as _, ParamsAdamW};
use rand::seq::SliceRandom as _;
use serde::{Deserialize, Serialize};

use super::fused::{Fused, Rows};
use super::model::Flow;
use super::pairs::{mean_loss, Pairs};
use super::weights::Weights;
use crate::stats;

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
/// [`Error::DivergedAtOnce`] when no epoch had a finite loss.
pub fn train(
    flow: &Flow,
    weights: &Weights,
    rows: usize,
    training: impl FnMut(usize) -> Result<Pairs, candle_core::Error>,
    validation: &Pairs,
    settings: &TrainSettings,
    on_epoch: impl FnMut(EpochReport),
) -> Result<TrainOutcome, Error> {
    // The fused implementation is used for single precision on the CPU, candle in all other cases.
    match Fused::new(flow, weights)? {
        Some(fused) => run(ByFused { flow, weights, fused }, rows, training, validation, settings, on_epoch),
        None => run(ByCandle::new(flow, weights)?, rows, training, validation, settings, on_epoch),
    }
}

/// An implementation of gradient descent on the loss.
trait Descent {
    /// Pairs in the form that this implementation uses.
    type Data;
    /// A copy of all weights.
    type Copy;

    /// Converts pairs to the form that this implementation uses.
    fn read(&self, pairs: &Pairs) -> Result<Self::Data, candle_core::Error>;
    /// Makes one step on the rows with the indices `chosen` and returns their mean loss before the step. If that loss is not
    /// finite, no step is made.
    fn step(&mut self, data: &Self::Data, chosen: &[u32], learning_rate: f64) -> Result<f64, candle_core::Error>;
    /// Mean loss of all rows.
    fn loss(&mut self, data: &Self::Data) -> Result<f64, candle_core::Error>;
    /// Copies the current weights.
    fn copy(&self) -> Result<Self::Copy, candle_core::Error>;
    /// Writes the weights of `copy` to the flow.
    fn finish(self, copy: &Self::Copy) -> Result<(), candle_core::Error>;
}

/// [`train`] with one implementation of gradient descent.
fn run<D: Descent>(
    mut descent: D,
    rows: usize,
    mut training: impl FnMut(usize) -> Result<Pairs, candle_core::Error>,
    validation: &Pairs,
    settings: &TrainSettings,
    mut on_epoch: impl FnMut(EpochReport),
) -> Result<TrainOutcome, Error> {
    let steps_per_epoch = rows.div_ceil(settings.batch);
    let total_steps = settings.epochs * steps_per_epoch;
    let mut shuffle = stats::stream(settings.seed, "shuffle");
    let mut order: Vec<u32> = (0..rows as u32).collect();
    let validation = descent.read(validation)?;

    let mut best: Option<(usize, f64, D::Copy)> = None;
    let mut stopped = Stopped::Completed;
    'epochs: for epoch in 1..=settings.epochs {
        order.shuffle(&mut shuffle);
        let training = descent.read(&training(epoch)?)?;
        let mut sum = 0.0;
        for (step, chosen) in order.chunks(settings.batch).enumerate() {
            let progress = ((epoch - 1) * steps_per_epoch + step) as f64 / total_steps as f64;
            let learning_rate = settings.learning_rate * 0.5 * (1.0 + (std::f64::consts::PI * progress).cos());
            let loss = descent.step(&training, chosen, learning_rate)?;
            if !loss.is_finite() {
                stopped = Stopped::Diverged { epoch };
                break 'epochs;
            }
            sum += loss;
        }
        let validation_loss = descent.loss(&validation)?;
        if !validation_loss.is_finite() {
            stopped = Stopped::Diverged { epoch };
            break;
        }
        if best.as_ref().is_none_or(|(_, least, _)| validation_loss < *least) {
            best = Some((epoch, validation_loss, descent.copy()?));
        }
        on_epoch(EpochReport { epoch, loss: sum / steps_per_epoch as f64, validation_loss });
    }
    let diverged_at_once = Error::DivergedAtOnce { learning_rate: settings.learning_rate };
    let (best_epoch, best_validation_loss, copy) = best.ok_or(diverged_at_once)?;
    descent.finish(&copy)?;
    Ok(TrainOutcome { best_epoch, best_validation_loss, stopped })
}

/// Gradient descent by [`Fused`].
struct ByFused<'a> {
    flow: &'a Flow,
    weights: &'a Weights,
    fused: Fused,
}

impl Descent for ByFused<'_> {
    type Data = Rows;
    type Copy = Vec<f32>;

    fn read(&self, pairs: &Pairs) -> Result<Rows, candle_core::Error> {
        self.fused.rows(self.flow, pairs)
    }

    fn step(&mut self, data: &Rows, chosen: &[u32], learning_rate: f64) -> Result<f64, candle_core::Error> {
        Ok(self.fused.step(data, chosen, learning_rate))
    }

    fn loss(&mut self, data: &Rows) -> Result<f64, candle_core::Error> {
        Ok(self.fused.loss(data))
    }

    fn copy(&self) -> Result<Vec<f32>, candle_core::Error> {
        Ok(self.fused.weights().to_vec())
    }

    fn finish(self, copy: &Vec<f32>) -> Result<(), candle_core::Error> {
        self.fused.write(copy, self.weights)
    }
}

/// Gradient descent by candle's gradients and its AdamW.
struct ByCandle<'a> {
    flow: &'a Flow,
    weights: &'a Weights,
    optimiser: AdamW,
}

impl<'a> ByCandle<'a> {
    fn new(flow: &'a Flow, weights: &'a Weights) -> Result<Self, candle_core::Error> {
        // The map is sorted by name, so that the optimiser processes the weights in the same order in every run.
        let params = ParamsAdamW { weight_decay: 0.0, ..ParamsAdamW::default() };
        Ok(Self { flow, weights, optimiser: AdamW::new(weights.values().cloned().collect(), params)? })
    }
}

impl Descent for ByCandle<'_> {
    type Data = Pairs;
    type Copy = BTreeMap<String, Tensor>;

    fn read(&self, pairs: &Pairs) -> Result<Pairs, candle_core::Error> {
        Ok(pairs.clone())
    }

    fn step(&mut self, data: &Pairs, chosen: &[u32], learning_rate: f64) -> Result<f64, candle_core::Error> {
        let chosen = Tensor::new(chosen, &Device::Cpu)?;
        let loss = mean_loss(self.flow, &data.x.index_select(&chosen, 0)?, &data.y.index_select(&chosen, 0)?)?;
        let value = scalar(&loss)?;
        if value.is_finite() {
            self.optimiser.set_learning_rate(learning_rate);
            self.optimiser.backward_step(&loss)?;
        }
        Ok(value)
    }

    fn loss(&mut self, data: &Pairs) -> Result<f64, candle_core::Error> {
        scalar(&mean_loss(self.flow, &data.x, &data.y)?)
    }

    fn copy(&self) -> Result<Self::Copy, candle_core::Error> {
        self.weights.iter().map(|(name, var)| Ok((name.clone(), var.as_tensor().copy()?))).collect()
    }

    fn finish(self, copy: &Self::Copy) -> Result<(), candle_core::Error> {
        copy.iter().try_for_each(|(name, copy)| self.weights[name].set(copy))
    }
}

fn scalar(tensor: &Tensor) -> Result<f64, candle_core::Error> {
    tensor.to_dtype(DType::F64)?.to_scalar()
}
