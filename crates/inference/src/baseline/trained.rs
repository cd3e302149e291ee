//! What a training gives: a model with its two files, or why there is none; and what training and certification share.

use nalgebra::DMatrix;
use rand::RngCore as _;

use super::conditions::Conditions;
use super::error::{InferenceError, LoadError};
use super::model::Baseline;
use super::observation::{measure, measure_shapes, Observation};
use crate::flow::checkpoint;
use structures::simulator::{Simulator, TrainingSet};
use structures::stats::{self, Stream};

/// Smallest number of training samples. With fewer, the covariance of the frequencies is too uncertain.
pub const MINIMUM_SAMPLES: usize = 100;

/// Why a training gave no model.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The number of training samples is too small.
    #[error("{0} training samples are too few: at least {MINIMUM_SAMPLES} are needed")]
    TooFewSamples(usize),
    /// A setting that must be positive is not.
    #[error("{name} is {value}: it must be positive")]
    Setting {
        /// Name of the setting.
        name: &'static str,
        /// Its value.
        value: f64,
    },
    /// The noise range is not valid.
    #[error("the noise range {lowest} to {highest} is not valid: give two ascending multiples of the structure's noise, both above 0, with 1 between them")]
    NoiseRange {
        /// Lowest multiple given.
        lowest: f64,
        /// Highest multiple given.
        highest: f64,
    },
    /// The simulation failed somewhere in the prior.
    #[error("the simulation failed: {0}")]
    Simulation(#[from] structures::simulator::Error),
    /// No frequency varies over the prior.
    #[error("no frequency varies over the prior: measurements say nothing about the parameters; let each parameter set what moves a mode")]
    Degenerate,
    /// The training of the flow failed.
    #[error(transparent)]
    Flow(#[from] crate::flow::train::Error),
    /// The weights could not be written.
    #[error(transparent)]
    Checkpoint(#[from] checkpoint::Error),
    /// The trained model failed in an inference.
    #[error(transparent)]
    Inference(#[from] InferenceError),
    /// The new model does not pass its own checks: a bug.
    #[error("the new model is refused: {0}")]
    Refused(#[from] Box<LoadError>),
    /// Tensors of the wrong shape: a bug.
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
}

/// A trained model and its two files.
pub struct Trained {
    /// The model, loaded back from the files below.
    pub baseline: Baseline,
    /// The manifest file.
    pub manifest_json: Vec<u8>,
    /// The weight file (safetensors).
    pub weights: Vec<u8>,
}

/// A seed for each purpose, so that the sets never share a draw.
pub(super) fn purpose_seed(seed: u64, purpose: &str) -> u64 {
    stats::stream(seed, purpose).next_u64()
}

/// Simulates one measurement of each pair of a set, with noise and missing modes drawn as in training.
pub fn observe(
    simulator: &Simulator,
    conditions: &Conditions,
    set: &TrainingSet,
    stream: &mut Stream,
) -> Vec<Observation> {
    let one = |(row, (exact, sizes)): (usize, (Vec<f64>, &Vec<f64>))| {
        let multiples = conditions.draw(exact.len(), stream);
        let mut observation = measure(simulator, &exact, sizes, &multiples, stream);
        if let Some(shapes) = set.shapes.get(row) {
            let missing = Conditions::draw_shapes(exact.len(), stream);
            measure_shapes(simulator, &mut observation, shapes, &missing, stream);
        }
        observation
    };
    rows(&set.frequencies_hz).into_iter().zip(&set.effect_sizes).enumerate().map(one).collect()
}

/// Rows of a matrix.
pub(super) fn rows(matrix: &DMatrix<f64>) -> Vec<Vec<f64>> {
    matrix.row_iter().map(|row| row.iter().copied().collect()).collect()
}
