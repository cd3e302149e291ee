//! How a model is trained: what was asked for, and the defaults for the rest. The command line and the service share them, so that
//! the same request gives the same bytes.

use serde::{Deserialize, Serialize};

use super::conditions::NoiseRange;
use super::observation::DEFAULT_NOISE_RANGE;
use super::rounds::{train_in_rounds, Progress, MOST_ROUNDS};
use super::train::{default_epochs, default_samples, Error, Trained};
use crate::flow::train::TrainSettings;
use crate::flow::FlowSettings;
use structures::simulator::Simulator;

/// What was asked for; `None` for a default.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RecipeRequest {
    /// Number of simulated pairs.
    pub samples: Option<usize>,
    /// Epochs of the first round.
    pub epochs: Option<usize>,
    /// Number of coupling units of the network.
    pub units: Option<usize>,
    /// Most rounds of training.
    pub rounds: Option<usize>,
    /// Noise that the model must cover.
    pub noise_range: Option<NoiseRange>,
    /// Seed of all random numbers.
    pub seed: Option<u64>,
}

/// How a model is trained.
#[derive(Debug, Clone)]
pub struct Recipe {
    /// Number of simulated pairs.
    pub samples: usize,
    /// Noise that the model must cover.
    pub noise_range: NoiseRange,
    /// Size of the network.
    pub flow: FlowSettings,
    /// Epochs of the first round, and the seed.
    pub settings: TrainSettings,
    /// Most rounds.
    pub rounds: usize,
}

impl RecipeRequest {
    /// The request with its defaults for a structure. Where the numbers of samples or epochs are given, the training does just what was
    /// asked for, in one round, unless the number of rounds is given too.
    pub fn recipe(&self, simulator: &Simulator) -> Recipe {
        let defaults = TrainSettings::default();
        let epochs = self.epochs.unwrap_or_else(|| default_epochs(simulator));
        let mut flow = FlowSettings::default();
        flow.units = self.units.unwrap_or(flow.units);
        let as_given = self.samples.is_some() || self.epochs.is_some();
        Recipe {
            samples: self.samples.unwrap_or_else(|| default_samples(simulator)),
            noise_range: self.noise_range.unwrap_or(DEFAULT_NOISE_RANGE),
            flow,
            settings: TrainSettings { epochs, seed: self.seed.unwrap_or(defaults.seed), ..defaults },
            rounds: self.rounds.unwrap_or(if as_given { 1 } else { MOST_ROUNDS }),
        }
    }
}

impl Recipe {
    /// Trains a model.
    ///
    /// # Errors
    /// As [`super::train::train`].
    pub fn train(&self, simulator: &Simulator, on_progress: &mut dyn FnMut(Progress)) -> Result<Trained, Error> {
        let Self { samples, noise_range, flow, settings, rounds } = self;
        train_in_rounds(simulator, *samples, *noise_range, flow, settings, *rounds, on_progress)
    }
}
