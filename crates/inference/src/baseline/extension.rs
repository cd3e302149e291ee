//! Training of a model for a structure that extends another one.

use super::conditions::NoiseRange;
use super::manifest::Outcome;
use super::model::Baseline;
use super::observation::DEFAULT_NOISE_RANGE;
use super::rounds::{run, train_in_rounds, MOST_ROUNDS};
use super::train::{default_epochs, default_samples, Error, Trained};
use super::warm::WarmStart;
use crate::flow::train::TrainSettings;
use crate::flow::FlowSettings;
use structures::simulator::Simulator;

pub use super::rounds::Progress;

/// How the model of an extension is trained.
#[derive(Clone, Copy)]
pub struct ExtensionPlan<'a> {
    /// The trained model of the structure that is extended, if there is one.
    pub parent: Option<&'a Baseline>,
    /// Start from random weights even if the weights of the parent could be used.
    pub from_scratch: bool,
    /// Number of simulated pairs; `None` for a number that follows from the training of the parent.
    pub samples: Option<usize>,
    /// Number of epochs; `None` for a number that follows from the training of the parent.
    pub epochs: Option<usize>,
    /// Seed of the training.
    pub seed: u64,
}

impl ExtensionPlan<'_> {
    /// Trains the model of `simulator`: from the weights of the parent where its inputs have the same meaning, otherwise from random
    /// weights, with the noise range of the parent and its number of units.
    ///
    /// The training goes on until its calibration passes or stops improving ([`super::rounds`]). A model that was trained from the
    /// weights of its parent and remains overconfident is trained once more from random weights. Where the numbers of samples or
    /// epochs were given, the training does just what was asked for, in one round.
    ///
    /// # Errors
    /// As [`super::train::train`].
    pub fn train(&self, simulator: &Simulator, on_progress: &mut dyn FnMut(Progress)) -> Result<Trained, Error> {
        let warm = match (self.parent, self.from_scratch) {
            (_, true) => Err("as requested".to_owned()),
            (None, false) => Err("the structure has no trained model".to_owned()),
            (Some(parent), false) => WarmStart::new(parent, simulator)
                .map_err(|why| format!("the weights of the present model cannot be used: {why}")),
        };
        let why = match warm {
            Ok(start) => {
                let (samples, epochs) = start.size();
                let (samples, epochs) = (self.samples.unwrap_or(samples), self.epochs.unwrap_or(epochs));
                on_progress(Progress::Start(format!(
                    "training starts from the weights of the model {}: {samples} samples, {epochs} epochs",
                    start.digest()
                )));
                let settings = start.settings(epochs, self.seed);
                let prepared = start.prepare(simulator, samples, &settings)?;
                let trained = run(prepared.begin(simulator, &settings)?, self.rounds(), on_progress)?;
                let calibration = &trained.baseline.manifest().calibration;
                if calibration.outcome() < Outcome::Overconfident || self.is_given() || !simulator.is_noisy() {
                    return Ok(trained);
                }
                format!("the model that started from its weights is overconfident: {}", calibration.failures.join("; "))
            }
            Err(why) => why,
        };
        self.train_from_scratch(simulator, &why, on_progress)
    }

    /// Whether the numbers of samples or epochs were given.
    fn is_given(&self) -> bool {
        self.samples.is_some() || self.epochs.is_some()
    }

    fn rounds(&self) -> usize {
        if self.is_given() {
            1
        } else {
            MOST_ROUNDS
        }
    }

    fn train_from_scratch(
        &self,
        simulator: &Simulator,
        why: &str,
        on_progress: &mut dyn FnMut(Progress),
    ) -> Result<Trained, Error> {
        let of_parent = self.parent.map(Baseline::manifest);
        // A model that started from another one was trained for fewer epochs than random weights need.
        let own = of_parent.map(|m| &m.training).filter(|training| training.parent.is_none());
        let samples = self.samples.or(own.map(|t| t.samples)).unwrap_or_else(|| default_samples(simulator));
        let epochs = self.epochs.or(own.map(|t| t.settings.epochs)).unwrap_or_else(|| default_epochs(simulator));
        let noise_range: NoiseRange = of_parent.and_then(|m| m.conditions.noise_range).unwrap_or(DEFAULT_NOISE_RANGE);
        let mut flow = FlowSettings::default();
        flow.units = of_parent.map_or(flow.units, |m| m.architecture.units);
        on_progress(Progress::Start(format!(
            "training starts from random weights ({why}): {samples} samples, {epochs} epochs"
        )));
        let settings = TrainSettings { epochs, seed: self.seed, ..TrainSettings::default() };
        train_in_rounds(simulator, samples, noise_range, &flow, &settings, self.rounds(), on_progress)
    }
}
