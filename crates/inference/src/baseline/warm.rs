//! Training that starts from the weights of a trained model: for a structure that extends another one by effects.
//!
//! The inputs of the parent keep their meaning: the extension takes over its training box, its whitening, its noise range and
//! the ranges of its effects. New scales could not be compensated for in the weights, because the convolutions of the context
//! network have the same weights for all modes, while the whitening mixes the modes. Each new effect is a further input with weights
//! of zero, so that the untrained extension answers as its parent does. The training then continues with fewer epochs.

use std::fmt;

use super::conditions::{fit_features, Conditions, EffectRange};
use super::model::Baseline;
use super::start::starts_at_fit;
use super::train::{check, effect_ranges, space_of_flow, Error, Prepared, Trained, TRAINING_SET};
use super::trained::purpose_seed;
use crate::flow::inherit::inherited_flow;
use crate::flow::train::{EpochReport, TrainSettings};
use crate::flow::{Architecture, FlowSettings};
use structures::parameter::Parameter;
use structures::quantity::Digest;
use structures::simulator::effect::SimulationEffect;
use structures::simulator::Simulator;

/// Learning rate of the first step. The weights are nearly right already: larger steps forget what the parent has learnt.
const LEARNING_RATE: f64 = 1.5e-3;

/// A training that starts from the weights of a model takes this share of the steps of a training from random weights.
const SHARE_OF_STEPS: f64 = 0.25;

/// Least number of samples where the flow starts at the best fit; fewer are used only if the model itself was trained with fewer.
const FEWEST_FITTED: usize = 3_000;

/// Relative difference up to which two limits of a parameter are the same: they are computed again for each structure.
const SAME_LIMIT: f64 = 1e-9;

/// The model whose weights the training of a structure starts from.
pub struct WarmStart<'a> {
    parent: &'a Baseline,
}

/// Why the training of a structure cannot start from the weights of a model.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum Unlike {
    /// The parameters have other names or another order.
    #[error("its parameters are {found}, and those of the structure are {expected}")]
    Parameters {
        /// Names of the parameters of the model.
        found: String,
        /// Names of the parameters of the structure.
        expected: String,
    },
    /// A parameter has other limits.
    #[error("it was trained for {name} from {} to {}, and the structure needs {} to {}", .found[0], .found[1], .expected[0], .expected[1])]
    Limits {
        /// Name of the parameter.
        name: String,
        /// Limits of the training box of the model, parameter units.
        found: [f64; 2],
        /// Limits of the training box of the structure, parameter units.
        expected: [f64; 2],
    },
    /// The number of modes is another.
    #[error("it has {found} modes, and the structure has {expected}")]
    Modes {
        /// Modes of the model.
        found: usize,
        /// Modes of the structure.
        expected: usize,
    },
    /// The measurement noise is another.
    #[error("the structure has other measurement noise than the one that it was trained for")]
    Noise,
    /// One flow starts at the best fit of each measurement, and the other does not.
    #[error("with many parameters or mode shapes a flow starts at the best fit of a measurement; this holds for only one of the two")]
    Start,
    /// An effect that is an input of the model is missing in the structure, or acts on something else.
    #[error("the structure has no effect {0} that acts on the same target")]
    Effect(String),
}

impl<'a> WarmStart<'a> {
    /// A training of `simulator` that starts from the weights of `parent`.
    ///
    /// # Errors
    /// [`Unlike`] where the inputs of `parent` have another meaning for this structure.
    pub fn new(parent: &'a Baseline, simulator: &Simulator) -> Result<Self, Unlike> {
        let names =
            |simulator: &Simulator| simulator.space().iter().map(|p| p.name.as_str()).collect::<Vec<_>>().join(", ");
        let (found, expected) = (names(parent.simulator()), names(simulator));
        if found != expected {
            return Err(Unlike::Parameters { found, expected });
        }
        let (found, expected) = (parent.simulator().modes(), simulator.modes());
        if found != expected {
            return Err(Unlike::Modes { found, expected });
        }
        let same_noise = parent.simulator().noise() == simulator.noise();
        if !same_noise || parent.manifest().conditions.noise_range.is_some() != simulator.is_noisy() {
            return Err(Unlike::Noise);
        }
        if parent.starts_at_fit() != starts_at_fit(simulator) {
            return Err(Unlike::Start);
        }
        for (parameter, found) in space_of_flow(simulator).iter().zip(&parent.manifest().conditions.training_box) {
            let Parameter { name, lower, upper, .. } = parameter;
            let apart = (lower - found[0]).abs().max((upper - found[1]).abs());
            // This form of the condition also rejects NaN.
            let same = apart <= SAME_LIMIT * (upper - lower);
            if !same {
                return Err(Unlike::Limits { name: name.clone(), found: *found, expected: [*lower, *upper] });
            }
        }
        let start = Self { parent };
        for range in &parent.manifest().conditions.effects {
            let of_parent = at_column(parent.simulator().effects(), range.column);
            let kept = |of_parent: &SimulationEffect| {
                let own = simulator.effects().iter().find(|effect| effect.name == of_parent.name);
                own.is_some_and(|own| own.target == of_parent.target && own.varies())
            };
            if !of_parent.is_some_and(kept) {
                let name = of_parent.map_or_else(|| format!("number {}", range.column + 1), |e| e.name.clone());
                return Err(Unlike::Effect(name));
            }
        }
        Ok(start)
    }

    /// Digest of the model.
    pub fn digest(&self) -> &Digest {
        self.parent.digest()
    }

    /// Default numbers of samples and of epochs: a share of those of the model, or the same where its own training started
    /// from another model.
    ///
    /// Where the flow starts at the best fit, fitting the samples takes most of the time, so that there are fewer samples instead of
    /// fewer epochs.
    pub fn size(&self) -> (usize, usize) {
        let of_parent = &self.parent.manifest().training;
        let (samples, epochs) = (of_parent.samples, of_parent.settings.epochs);
        let share = |whole: usize| (whole as f64 * SHARE_OF_STEPS).ceil() as usize;
        match (of_parent.parent.is_some(), self.parent.starts_at_fit()) {
            (true, _) => (samples, epochs),
            (false, true) => (share(samples).max(FEWEST_FITTED.min(samples)), epochs),
            (false, false) => (samples, share(epochs)),
        }
    }

    /// The schedule of a training with this number of epochs.
    pub fn settings(&self, epochs: usize, seed: u64) -> TrainSettings {
        TrainSettings { epochs, seed, learning_rate: LEARNING_RATE, ..TrainSettings::default() }
    }

    /// What the extension is conditioned on: as its parent, and `effects`, its own ranges of effects, of which those that the parent
    /// has already keep the range of the parent. Also returns which effect of the parent each of them is.
    fn conditions(&self, simulator: &Simulator, mut effects: Vec<EffectRange>) -> (Conditions, Vec<Option<usize>>) {
        let of_parent = &self.parent.manifest().conditions;
        let mut inherited = Vec::with_capacity(effects.len());
        for range in &mut effects {
            let name = at_column(simulator.effects(), range.column).map(|effect| &effect.name);
            let same = |old: &EffectRange| {
                at_column(self.parent.simulator().effects(), old.column).map(|effect| &effect.name) == name
            };
            let position = of_parent.effects.iter().position(same);
            if let Some(old) = position.map(|position| of_parent.effects[position]) {
                (range.lowest, range.highest) = (old.lowest, old.highest);
            }
            inherited.push(position);
        }
        (Conditions { effects, ..of_parent.clone() }, inherited)
    }

    /// Trains a model of `simulator` on `samples` simulated pairs, from the weights of the parent, and measures its accuracy and
    /// calibration, as [`super::train::train`] does from random weights.
    ///
    /// The same simulator, parent, settings and seed give the same bytes, whatever the number of threads.
    ///
    /// # Errors
    /// As [`super::train::train`].
    pub fn train(
        &self,
        simulator: &Simulator,
        samples: usize,
        settings: &TrainSettings,
        on_epoch: impl FnMut(EpochReport),
    ) -> Result<Trained, Error> {
        self.prepare(simulator, samples, settings)?.train(simulator, settings, on_epoch)
    }

    /// A flow with the weights of the parent, and all that its training needs.
    pub(super) fn prepare(
        &self,
        simulator: &Simulator,
        samples: usize,
        settings: &TrainSettings,
    ) -> Result<Prepared, Error> {
        let of_parent = self.parent.manifest();
        // Without noise the range is not used.
        let noise_range = of_parent.conditions.noise_range.unwrap_or(super::observation::DEFAULT_NOISE_RANGE);
        check(samples, noise_range, &FlowSettings::default(), settings)?;
        // The limits of the parent's training, with the form of the priors of the structure to be trained.
        let space = of_parent.conditions.training_space(simulator.space());
        let training = simulator.pairs(&space, samples, purpose_seed(settings.seed, TRAINING_SET))?;
        let (conditions, inherited) = self.conditions(simulator, effect_ranges(simulator, &training));
        let (own, of_effects) = if conditions.starts_at_fit {
            let own = fit_features(space.len());
            // Flows that earlier versions of this program trained do not have the sizes of the effects as inputs.
            (own, of_parent.architecture.fixed_context - own)
        } else {
            (conditions.channels() - conditions.effects.len(), of_parent.conditions.effects.len())
        };
        let of_effect = |position: Option<usize>| position.filter(|p| *p < of_effects).map(|p| own + p);
        let inputs: Vec<Option<usize>> = (0..own).map(Some).chain(inherited.into_iter().map(of_effect)).collect();
        let architecture = Architecture {
            channels: conditions.channels(),
            fixed_context: conditions.fixed_context(space.len()),
            ..of_parent.architecture.clone()
        };
        let (flow, weights) = inherited_flow(&self.parent.flow, &architecture, &inputs)?;
        let (whitening, parent) = (of_parent.whitening.clone(), Some(self.parent.digest().clone()));
        Ok(Prepared { flow, weights, space, conditions, whitening, training, parent })
    }
}

impl fmt::Debug for WarmStart<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("WarmStart").field("parent", self.parent.digest()).finish()
    }
}

/// The effect whose first size is in `column` of the sizes of all effects.
fn at_column(effects: &[SimulationEffect], column: usize) -> Option<&SimulationEffect> {
    let mut first = 0;
    effects.iter().find(|effect| {
        let (own, sizes) = (first, effect.target.sizes());
        first += sizes;
        own == column && sizes > 0
    })
}
