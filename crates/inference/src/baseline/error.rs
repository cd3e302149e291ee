//! Why a stored model is refused, and why an inference fails.

use super::manifest;
use crate::flow::checkpoint;
use structures::quantity::Digest;

/// Largest accepted difference of a self-test draw, as a share of the prior's width. Results of f32 kernels differ between
/// processors by about 1e-5; a wrong weight causes a far larger difference.
pub(super) const SELF_TEST_TOLERANCE: f64 = 1e-3;

/// Why a stored model is refused.
#[derive(Debug, thiserror::Error)]
pub enum LoadError {
    /// The manifest is not valid JSON of the expected form.
    #[error("the manifest is not readable: {0}")]
    Manifest(#[from] serde_json::Error),
    /// The manifest has another format version.
    #[error("the manifest has format {found}; this program reads format {}", manifest::FORMAT)]
    Format {
        /// Format found.
        found: u32,
    },
    /// The weights are not those that the manifest was written for.
    #[error("the weights have SHA-256 {found}, but the manifest requires {expected}: the two files do not belong together, or one is damaged")]
    WeightsDigest {
        /// Digest in the manifest.
        expected: Digest,
        /// Digest of the weight file.
        found: Digest,
    },
    /// The model was trained for another structure, or for another version of it.
    #[error("the model was trained for structure {trained_for} (digest {expected}), but the structure file has digest {found}: train again")]
    Structure {
        /// Id in the manifest.
        trained_for: String,
        /// Digest in the manifest.
        expected: Digest,
        /// Digest of the structure at hand.
        found: Digest,
    },
    /// A list in the manifest has a length that does not fit the structure.
    #[error("{what} has {found} entries, expected {expected}")]
    Shape {
        /// Part of the manifest.
        what: &'static str,
        /// Entries found.
        found: usize,
        /// Entries expected.
        expected: usize,
    },
    /// A factor of the spread of draws is not a positive number.
    #[error("spread has the factor {0}: it must be positive and finite")]
    Spread(f64),
    /// The weight file is damaged or belongs to another architecture.
    #[error(transparent)]
    Weights(#[from] checkpoint::Error),
    /// The self-test gave other draws than at the end of the training.
    #[error(
        "the self-test differs by {difference:.2e} of the prior's width (at most {SELF_TEST_TOLERANCE:.0e} is allowed)"
    )]
    SelfTest {
        /// Largest difference, as a share of the prior's width.
        difference: f64,
    },
    /// The inference of the self-test failed.
    #[error("the self-test failed: {0}")]
    Inference(#[from] InferenceError),
}

/// Why an inference failed. Each variant means a bug or a damaged model: bad input is refused earlier.
#[derive(Debug, thiserror::Error)]
pub enum InferenceError {
    /// The measurement has another number of modes than the model was trained for.
    #[error("a measurement has {found} frequencies, but the model was trained for {expected} modes")]
    Modes {
        /// Modes found.
        found: usize,
        /// Modes of the model.
        expected: usize,
    },
    /// A draw is NaN or infinite.
    #[error("draw {row} of parameter {parameter} is not finite")]
    NotFinite {
        /// Row of the sample matrix.
        row: usize,
        /// Name of the parameter.
        parameter: String,
    },
    /// The simulation failed inside the prior.
    #[error("the simulation failed: {0}")]
    Simulation(String),
    /// A tensor operation failed.
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
}
