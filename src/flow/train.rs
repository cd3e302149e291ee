//! Training by maximum likelihood.

use std::collections::BTreeMap;

use candle_core::{DType, Device, Tensor, D};
use candle_nn::{AdamW, Optimizer as _, ParamsAdamW};
use rand::seq::SliceRandom as _;
use serde::{Deserialize, Serialize};

use super::fused::{Fused, Rows};
use super::weights::Weights;
use super::Flow;
use crate::stats;

/// How long and how fast to train.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainSettings {
    /// Passes over the training set.
    pub epochs: usize,
    /// Rows of one step.
    pub batch: usize,
    /// Learning rate of the first step; it falls to 0 along a cosine.
    pub learning_rate: f64,
    /// Seed of weights, permutations and shuffles.
    pub seed: u64,
}

impl Default for TrainSettings {
    fn default() -> Self {
        Self { epochs: 200, batch: 256, learning_rate: 3e-3, seed: 1 }
    }
}

/// Pairs of x on the real line and whitened y.
#[derive(Debug, Clone)]
pub struct Pairs {
    /// `[n, d]`.
    pub x: Tensor,
    /// `[n, channels, modes]`.
    pub y: Tensor,
}

/// State of the training after one epoch.
#[derive(Debug, Clone, Copy)]
pub struct EpochReport {
    /// Epochs done, from 1.
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
    /// All epochs were done.
    Completed,
    /// The loss was not finite in this epoch; the best weights before it are kept.
    Diverged {
        /// Epoch, from 1.
        epoch: usize,
    },
}

/// What a training gave; the flow holds the best weights.
#[derive(Debug, Clone)]
pub struct TrainOutcome {
    /// Epoch of the best validation loss, from 1.
    pub best_epoch: usize,
    /// The best validation loss, nats.
    pub best_validation_loss: f64,
    /// Why it ended.
    pub stopped: Stopped,
}

/// Why a training gave no flow.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The loss was never finite.
    #[error("the loss was not finite in the first epoch (learning rate {learning_rate}): try a smaller one")]
    DivergedAtOnce {
        /// Learning rate of the first step.
        learning_rate: f64,
    },
    /// Tensors of the wrong shape: a bug.
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
}

/// Trains `flow`, whose variables are `weights`, and leaves in it the weights of the best validation loss.
///
/// `training` gives the pairs of an epoch (from 1), always `rows` of them: the same ones, or with noise drawn afresh.
///
/// ```text
///  loss = 1/M Σ ( ½|z|² − log|det ∂z/∂x| ),   AdamW, learning rate falling to 0 along a half cosine
/// ```
///
/// Source: Wang et al. (2025), Eq. 20. Schedule and choice of the best epoch are ours.
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
    // The one place that chooses: by hand in single precision on the CPU, by candle for all else.
    match Fused::new(flow, weights)? {
        Some(fused) => run(ByHand { flow, weights, fused }, rows, training, validation, settings, on_epoch),
        None => run(ByCandle::new(flow, weights)?, rows, training, validation, settings, on_epoch),
    }
}

/// A way to lower the loss.
trait Descent {
    /// Pairs as this way reads them.
    type Data;
    /// A copy of all weights.
    type Copy;

    fn read(&self, pairs: &Pairs) -> Result<Self::Data, candle_core::Error>;
    /// One step on the `chosen` rows; returns their mean loss before it. A loss that is not finite changes nothing.
    fn step(&mut self, data: &Self::Data, chosen: &[u32], learning_rate: f64) -> Result<f64, candle_core::Error>;
    /// Mean loss of all rows.
    fn loss(&mut self, data: &Self::Data) -> Result<f64, candle_core::Error>;
    fn copy(&self) -> Result<Self::Copy, candle_core::Error>;
    /// Leaves the weights of `copy` in the flow.
    fn finish(self, copy: &Self::Copy) -> Result<(), candle_core::Error>;
}

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

/// By [`Fused`].
struct ByHand<'a> {
    flow: &'a Flow,
    weights: &'a Weights,
    fused: Fused,
}

impl Descent for ByHand<'_> {
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

/// By candle's gradients and its AdamW.
struct ByCandle<'a> {
    flow: &'a Flow,
    weights: &'a Weights,
    optimiser: AdamW,
}

impl<'a> ByCandle<'a> {
    fn new(flow: &'a Flow, weights: &'a Weights) -> Result<Self, candle_core::Error> {
        // Sorted by name, so that the optimiser meets the weights in the same order in every run.
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

/// Mean of ½|z|² − log|det ∂z/∂x| over the rows, nats, with candle's gradient: the reference of [`super::fused`].
///
/// # Errors
/// A candle error when shapes do not fit.
pub fn mean_loss(flow: &Flow, x: &Tensor, y: &Tensor) -> Result<Tensor, candle_core::Error> {
    let (z, log_det) = flow.forward(x, &flow.summarise(y)?)?;
    ((z.sqr()?.sum(D::Minus1)? * 0.5)? - log_det)?.mean(0)
}

fn scalar(tensor: &Tensor) -> Result<f64, candle_core::Error> {
    tensor.to_dtype(DType::F64)?.to_scalar()
}
