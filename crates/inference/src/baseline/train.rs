//! Training of a model for a structure, and its certification.

use candle_core::DType;

use super::calibration::OnCell;
use super::certify::{certify, without_calibration};
use super::conditions::{Conditions, EffectRange, NoiseRange, Whitening};
use super::fitted::fitted_pairs;
use super::manifest::{
    CalibrationRecord, FurtherRound, IdentifiabilityRecord, Manifest, SelfTest, TrainingRecord, ValidationRecord,
    FORMAT,
};
use super::observation::{Encoder, Observation};
use super::real_line::to_real_line;
use super::start::starts_at_fit;
use super::trained::{purpose_seed, rows};
use crate::flow::architecture::{Architecture, FlowSettings};
use crate::flow::pairs::Pairs;
use crate::flow::train::{EpochReport, Stopped, TrainOutcome, TrainSettings};
use crate::flow::weights::{self, Weights};
use crate::flow::{checkpoint, Flow};
use structures::parameter::ParameterSpace;
use structures::quantity::Digest;
use structures::simulator::{Simulator, TrainingSet};
use structures::stats;

pub use super::certify::renew;
pub use super::trained::{observe, Error, Trained, MINIMUM_SAMPLES};
pub use super::validation::validate;

/// Number of validation pairs, which select the best epoch.
const VALIDATION_SAMPLES: usize = 1_000;
/// Number of validation pairs where the flow starts at the best fit.
const VALIDATION_FITTED: usize = 500;
/// Purpose of the seed of the training set.
pub(super) const TRAINING_SET: &str = "training set";

/// Default number of training samples. Where the flow starts at the best fit, each sample takes milliseconds and the flow
/// has little left to learn, so that the number is smaller and falls with the number of parameters.
pub fn default_samples(simulator: &Simulator) -> usize {
    match (starts_at_fit(simulator), simulator.is_noisy()) {
        (true, _) => (1_000_000 / simulator.space().len()).clamp(3_000, 40_000),
        (false, true) => 200_000,
        (false, false) => 10_000,
    }
}

/// Default number of epochs. Where the flow starts at the best fit the noise is drawn only once, and more epochs would
/// overfit it.
pub fn default_epochs(simulator: &Simulator) -> usize {
    match (starts_at_fit(simulator), simulator.is_noisy()) {
        (true, _) => 8,
        (false, true) => 80,
        (false, false) => 200,
    }
}

/// Trains a model on `samples` simulated pairs from the prior of `simulator`, and measures its accuracy and calibration.
///
/// Where the structure has measurement noise, its level, the noise itself and the missing modes are drawn afresh in each
/// epoch, so that the flow never sees a measurement twice.
///
/// Where the flow starts at the best fit, see [`super::start`], it learns how the posterior differs from the normal
/// distribution at the fit. The noise is then drawn only once, since a fit takes a thousand times as long as a draw.
///
/// The same simulator, settings and seed give the same bytes, whatever the number of threads.
///
/// Source: Wang et al. (2025), §3.2, Eq. 20. The certification is ours.
///
/// # Errors
/// [`Error`] for settings out of range, a simulation that fails in the prior, or a training that diverges in its first epoch.
pub fn train(
    simulator: &Simulator,
    samples: usize,
    noise_range: NoiseRange,
    flow_settings: &FlowSettings,
    settings: &TrainSettings,
    on_epoch: impl FnMut(EpochReport),
) -> Result<Trained, Error> {
    prepare(simulator, samples, noise_range, flow_settings, settings)?.train(simulator, settings, on_epoch)
}

/// A flow with random weights, and all that its training needs.
pub(super) fn prepare(
    simulator: &Simulator,
    samples: usize,
    noise_range: NoiseRange,
    flow_settings: &FlowSettings,
    settings: &TrainSettings,
) -> Result<Prepared, Error> {
    check(samples, noise_range, flow_settings, settings)?;
    let fitted = starts_at_fit(simulator);
    let space = space_of_flow(simulator);
    let training = simulator.pairs(&space, samples, purpose_seed(settings.seed, TRAINING_SET))?;
    let conditions = Conditions {
        training_box: space.iter().map(|p| [p.lower, p.upper]).collect(),
        noise_range: simulator.is_noisy().then_some(noise_range),
        starts_at_fit: fitted,
        effects: effect_ranges(simulator, &training),
    };
    let nominal = simulator.nominal_frequencies_hz();
    let noise: Vec<f64> = nominal.iter().enumerate().map(|(mode, f)| simulator.std_hz(mode, *f) / f).collect();
    let whitening = Whitening::fit(&rows(&training.frequencies_hz), &noise).ok_or(Error::Degenerate)?;
    let mut permutations = stats::stream(settings.seed, "permutations");
    let mut architecture =
        flow_settings.architecture(space.len(), simulator.modes(), conditions.channels(), &mut permutations);
    architecture.fixed_context = conditions.fixed_context(space.len());
    let (flow, weights) = weights::untrained_flow(&architecture, DType::F32, settings.seed)?;
    Ok(Prepared { flow, weights, space, conditions, whitening, training, parent: None })
}

/// The box in which a new flow is trained.
pub(super) fn space_of_flow(simulator: &Simulator) -> ParameterSpace {
    // The normal distribution at a fit extends beyond the prior already, so that no margin is needed.
    if starts_at_fit(simulator) {
        simulator.space().clone()
    } else {
        simulator.training_space()
    }
}

/// A flow with its initial weights and all that its training needs.
pub(super) struct Prepared {
    pub flow: Flow,
    pub weights: Weights,
    /// The box in which the training set was drawn.
    pub space: ParameterSpace,
    pub conditions: Conditions,
    pub whitening: Whitening,
    pub training: TrainingSet,
    /// The model whose weights the flow starts from.
    pub parent: Option<Digest>,
}

impl Prepared {
    /// Trains the flow in one round, and certifies the model.
    pub(super) fn train(
        self,
        simulator: &Simulator,
        settings: &TrainSettings,
        on_epoch: impl FnMut(EpochReport),
    ) -> Result<Trained, Error> {
        let mut ongoing = self.begin(simulator, settings)?;
        ongoing.first_round(on_epoch)?;
        ongoing.certified(&mut |_, _| {})
    }

    /// A training before its first round.
    pub(super) fn begin<'a>(self, simulator: &'a Simulator, settings: &'a TrainSettings) -> Result<Ongoing<'a>, Error> {
        let validation_samples = if self.conditions.starts_at_fit { VALIDATION_FITTED } else { VALIDATION_SAMPLES };
        let seed = purpose_seed(settings.seed, "validation set");
        let validation = simulator.pairs(&self.space, validation_samples, seed)?;
        let record = TrainingRecord {
            samples: self.training.theta.nrows(),
            validation_samples,
            settings: settings.clone(),
            best_epoch: 0,
            stopped: Stopped::Completed,
            parent: self.parent.clone(),
            further_rounds: Vec::new(),
        };
        Ok(Ongoing { prepared: self, simulator, settings, validation, record })
    }
}

/// A training between two rounds.
pub(super) struct Ongoing<'a> {
    prepared: Prepared,
    pub(super) simulator: &'a Simulator,
    pub(super) settings: &'a TrainSettings,
    validation: TrainingSet,
    record: TrainingRecord,
}

impl Ongoing<'_> {
    /// Trains the flow as the settings say.
    pub(super) fn first_round(&mut self, on_epoch: impl FnMut(EpochReport)) -> Result<(), Error> {
        let outcome = self.run(self.settings, on_epoch)?;
        (self.record.best_epoch, self.record.stopped) = (outcome.best_epoch, outcome.stopped);
        Ok(())
    }

    /// Continues with the present weights, on other noise and missing modes.
    pub(super) fn further_round(
        &mut self,
        epochs: usize,
        learning_rate: f64,
        on_epoch: impl FnMut(EpochReport),
    ) -> Result<(), Error> {
        let seed = purpose_seed(self.settings.seed, &format!("round {}", self.rounds() + 1));
        let settings = TrainSettings { epochs, learning_rate, seed, batch: self.settings.batch };
        let TrainOutcome { best_epoch, stopped, .. } = self.run(&settings, on_epoch)?;
        self.record.stopped = stopped;
        self.record.further_rounds.push(FurtherRound { epochs, learning_rate, best_epoch });
        Ok(())
    }

    /// Rounds so far.
    pub(super) fn rounds(&self) -> usize {
        1 + self.record.further_rounds.len()
    }

    fn run(&self, settings: &TrainSettings, on_epoch: impl FnMut(EpochReport)) -> Result<TrainOutcome, Error> {
        let Prepared { flow, weights, space, conditions, whitening, training, .. } = &self.prepared;
        let task = Task { simulator: self.simulator, space, conditions, whitening, settings };
        task.run(flow, weights, training, &self.validation, on_epoch)
    }

    /// The model with the present weights; `on_cell` is called as in the calibration.
    pub(super) fn certified(&self, on_cell: OnCell<'_>) -> Result<Trained, Error> {
        let (manifest, weights) = self.drafted()?;
        certify(manifest, self.simulator, weights, on_cell)
    }

    /// The model with the present weights, whose calibration is not measured.
    pub(super) fn uncalibrated(&self) -> Result<Trained, Error> {
        let (manifest, weights) = self.drafted()?;
        without_calibration(manifest, self.simulator, weights)
    }

    /// The manifest before certification, and the weights.
    fn drafted(&self) -> Result<(Manifest, Vec<u8>), Error> {
        let Prepared { flow, weights, conditions, whitening, .. } = &self.prepared;
        let weights = checkpoint::to_bytes(weights)?;
        let described = (whitening.clone(), conditions.clone());
        let manifest =
            draft_manifest(self.simulator, &weights, flow.architecture().clone(), described, self.record.clone());
        Ok((manifest, weights))
    }
}

/// What the training of a flow needs besides the pairs.
struct Task<'a> {
    simulator: &'a Simulator,
    space: &'a ParameterSpace,
    conditions: &'a Conditions,
    whitening: &'a Whitening,
    settings: &'a TrainSettings,
}

impl Task<'_> {
    /// Trains `flow`, whose variables are `weights`.
    fn run(
        &self,
        flow: &Flow,
        weights: &Weights,
        training: &TrainingSet,
        validation: &TrainingSet,
        on_epoch: impl FnMut(EpochReport),
    ) -> Result<TrainOutcome, Error> {
        let samples = training.theta.nrows();
        let of_validation = self.observed(validation, "observations of validation");
        if self.conditions.starts_at_fit {
            let observations = self.observed(training, "observations");
            let pairs = fitted_pairs(self.simulator, self.conditions, training, &observations)?;
            let validation = fitted_pairs(self.simulator, self.conditions, validation, &of_validation)?;
            let epoch = |_| Ok(pairs.clone());
            return Ok(crate::flow::train::train(flow, weights, samples, epoch, &validation, self.settings, on_epoch)?);
        }
        let encoder = Encoder::new(self.whitening, self.conditions);
        let x = to_real_line(&training.theta, self.space)?.to_dtype(DType::F32)?;
        let epoch = |epoch: usize| {
            let observations = self.observed(training, &format!("observations of epoch {epoch}"));
            Ok(Pairs { x: x.clone(), y: encoder.encode(&observations)?.to_dtype(DType::F32)? })
        };
        let x = to_real_line(&validation.theta, self.space)?.to_dtype(DType::F32)?;
        let validation = Pairs { x, y: encoder.encode(&of_validation)?.to_dtype(DType::F32)? };
        Ok(crate::flow::train::train(flow, weights, samples, epoch, &validation, self.settings, on_epoch)?)
    }

    /// Simulated measurements of a training set, with noise and missing modes from the random stream named `purpose`.
    fn observed(&self, set: &TrainingSet, purpose: &str) -> Vec<Observation> {
        observe(self.simulator, self.conditions, set, &mut stats::stream(self.settings.seed, purpose))
    }
}

/// The manifest of a trained flow before certification, which measures the empty records.
fn draft_manifest(
    simulator: &Simulator,
    weights: &[u8],
    architecture: Architecture,
    (whitening, conditions): (Whitening, Conditions),
    training: TrainingRecord,
) -> Manifest {
    Manifest {
        format: FORMAT,
        program_version: env!("CARGO_PKG_VERSION").to_owned(),
        structure: simulator.id().clone(),
        structure_digest: simulator.digest().clone(),
        weights_sha256: Digest::of_file(weights),
        architecture,
        whitening,
        conditions,
        validation: ValidationRecord::default(),
        calibration: CalibrationRecord::default(),
        spread: Vec::new(),
        identifiability: IdentifiabilityRecord::default(),
        self_test: SelfTest { seed: training.settings.seed, ..SelfTest::default() },
        training,
    }
}

/// Whether the training ended before its last epoch because the loss was not finite.
pub fn diverged(manifest: &Manifest) -> bool {
    matches!(manifest.training.stopped, Stopped::Diverged { .. })
}

/// Checks the ranges of all settings.
pub(super) fn check(
    samples: usize,
    noise_range: NoiseRange,
    flow: &FlowSettings,
    settings: &TrainSettings,
) -> Result<(), Error> {
    let NoiseRange { lowest, highest } = noise_range;
    if !(lowest > 0.0 && highest.is_finite() && lowest < highest && (lowest..=highest).contains(&1.0)) {
        return Err(Error::NoiseRange { lowest, highest });
    }
    if samples < MINIMUM_SAMPLES {
        return Err(Error::TooFewSamples(samples));
    }
    let positive = [
        ("epochs", settings.epochs as f64),
        ("batch", settings.batch as f64),
        ("learning_rate", settings.learning_rate),
        ("units", flow.units as f64),
        ("width", flow.width as f64),
        ("context_channels", flow.context_channels as f64),
        ("context_features", flow.context_features as f64),
        ("clamp_tenths", f64::from(flow.clamp_tenths)),
    ];
    match positive.into_iter().find(|(_, value)| !(*value > 0.0 && value.is_finite())) {
        Some((name, value)) => Err(Error::Setting { name, value }),
        None => Ok(()),
    }
}

/// Ranges of sizes in a training set, of the effects that vary with a covariate.
pub(super) fn effect_ranges(simulator: &Simulator, set: &TrainingSet) -> Vec<EffectRange> {
    let mut first = 0;
    let mut ranges = Vec::new();
    for effect in simulator.effects() {
        let column = first;
        first += effect.target.sizes();
        if effect.varies() {
            let sizes = || set.effect_sizes.iter().map(|sizes| sizes[column]);
            let (lowest, highest) = (sizes().fold(f64::INFINITY, f64::min), sizes().fold(f64::NEG_INFINITY, f64::max));
            // The size of a constant effect carries no information.
            if lowest < highest {
                ranges.push(EffectRange { column, lowest, highest });
            }
        }
    }
    ranges
}
