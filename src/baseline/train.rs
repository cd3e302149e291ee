//! From a structure to a trained baseline.

use candle_core::{DType, Tensor};
use nalgebra::DMatrix;

use super::calibration::{calibrate, CalibrationRecord};
use super::fitted::{fitted_pairs, inverse_error_from_fit};
use super::identifiability::{identifiability, IdentifiabilityRecord};
use super::manifest::{
    Conditions, EffectRange, Manifest, NoiseRange, ParameterValidation, SelfTest, TrainingRecord, ValidationRecord,
    Whitening, FORMAT,
};
use super::observation::{measure, measure_shapes, Encoder, Observation};
use super::start::starts_at_fit;
use super::{to_real_line, Baseline, InferenceError};
use crate::flow::sampler::Sampler;
use crate::flow::train::{EpochReport, Pairs, Stopped, TrainSettings};
use crate::flow::{checkpoint, weights, FlowSettings};
use crate::quantity::Digest;
use crate::simulator::{Simulator, TrainingSet};
use crate::stats;

/// Pairs that choose the best epoch.
const VALIDATION_SAMPLES: usize = 1_000;
/// Pairs the manifest's figures are measured on.
const HELD_OUT_SAMPLES: usize = 2_000;
/// The same where each is fitted first, which takes a fifth of a second at three hundred parameters.
const HELD_OUT_FITTED: usize = 300;
/// Pairs that choose the best epoch there.
const VALIDATION_FITTED: usize = 500;
/// Draws for each held-out pair.
const HELD_OUT_DRAWS: usize = 10;
/// Draws of the self-test.
const SELF_TEST_DRAWS: usize = 4;
/// Fewest training samples: below, the covariance of the frequencies itself is uncertain.
pub const MINIMUM_SAMPLES: usize = 100;

/// Training samples unless asked otherwise. A measurement that is fitted first costs milliseconds, and the flow has little left
/// to learn: fewer of them, and the fewer the more parameters.
pub fn default_samples(simulator: &Simulator) -> usize {
    match (starts_at_fit(simulator), simulator.is_noisy()) {
        (true, _) => (1_000_000 / simulator.space().len()).clamp(3_000, 40_000),
        (false, true) => 200_000,
        (false, false) => 10_000,
    }
}

/// Passes over the training samples unless asked otherwise. Where noise is drawn once, more of them learn the noise by heart.
pub fn default_epochs(simulator: &Simulator) -> usize {
    match (starts_at_fit(simulator), simulator.is_noisy()) {
        (true, _) => 8,
        (false, true) => 80,
        (false, false) => 200,
    }
}

/// Why no baseline came of a training.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// Too few samples asked for.
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
    /// A noise range that is none.
    #[error("the noise range {lowest} to {highest} is none: two multiples of the structure's noise, both above 0, ascending, with 1 between them")]
    NoiseRange {
        /// Lowest multiple given.
        lowest: f64,
        /// Highest multiple given.
        highest: f64,
    },
    /// The simulation failed somewhere in the prior.
    #[error("the simulation failed: {0}")]
    Simulation(#[from] crate::simulator::Error),
    /// Frequencies that do not vary, or not independently.
    #[error("over the prior, a frequency does not vary or two vary as one: there is nothing to learn from them")]
    Degenerate,
    /// The flow was not trained.
    #[error(transparent)]
    Flow(#[from] crate::flow::train::Error),
    /// The weights could not be written.
    #[error(transparent)]
    Checkpoint(#[from] checkpoint::Error),
    /// The trained flow does not infer.
    #[error(transparent)]
    Inference(#[from] InferenceError),
    /// The new baseline does not pass its own checks: a bug.
    #[error("the new baseline is refused: {0}")]
    Refused(#[from] Box<super::LoadError>),
    /// Tensors of the wrong shape: a bug.
    #[error(transparent)]
    Tensor(#[from] candle_core::Error),
}

/// A trained baseline and its two files.
pub struct Trained {
    /// Ready for use, loaded back from the files below.
    pub baseline: Baseline,
    /// The manifest file.
    pub manifest_json: Vec<u8>,
    /// The weight file (safetensors).
    pub weights: Vec<u8>,
}

/// Simulates `samples` pairs from the prior of `simulator`, trains a flow on them and measures what it reached.
///
/// Where the structure has measurement noise, its size, the noise itself and the missing modes are drawn afresh in each
/// epoch, so that the flow never sees a measurement twice.
///
/// Where parameters are many or mode shapes are measured, each measurement is fitted first and the flow learns what lies beyond
/// the fit, see [`super::start`]; its noise is then drawn once, since a fit takes a thousand times as long as a draw.
///
/// The same simulator, settings and seed give the same bytes, whatever the number of threads.
///
/// # Errors
/// [`Error`] for settings out of range, a simulation that fails in the prior, or a training that diverges at once.
pub fn train(
    simulator: &Simulator,
    samples: usize,
    noise_range: NoiseRange,
    flow_settings: &FlowSettings,
    settings: &TrainSettings,
    on_epoch: impl FnMut(EpochReport),
) -> Result<Trained, Error> {
    check(samples, noise_range, flow_settings, settings)?;
    let fitted = starts_at_fit(simulator);
    // Where each measurement is fitted, its distribution reaches over the edge of the prior by itself.
    let space = if fitted { simulator.space().clone() } else { simulator.training_space() };
    let noisy = simulator.is_noisy();
    let training_box = space.iter().map(|p| [p.lower, p.upper]).collect();
    let draw = |count: usize, purpose: &str| simulator.pairs(&space, count, purpose_seed(settings.seed, purpose));
    let training = draw(samples, "training set")?;
    let effects = effect_ranges(simulator, &training);
    let noise_range = noisy.then_some(noise_range);
    let conditions = Conditions { training_box, noise_range, starts_at_fit: fitted, effects };
    let whitening = Whitening::fit(&rows(&training.frequencies_hz)).ok_or(Error::Degenerate)?;
    let encoder = Encoder::new(&whitening, &conditions);
    let observed = |set: &TrainingSet, purpose: &str| {
        let mut stream = stats::stream(settings.seed, purpose);
        observe(simulator, &conditions, set, &mut stream)
    };

    let mut permutations = stats::stream(settings.seed, "permutations");
    let mut architecture =
        flow_settings.architecture(space.len(), simulator.modes(), conditions.channels(), &mut permutations);
    architecture.fixed_context = conditions.fixed_context(space.len());
    let (flow, weights) = weights::untrained_flow(&architecture, DType::F32, settings.seed)?;
    let validation_samples = if fitted { VALIDATION_FITTED } else { VALIDATION_SAMPLES };
    let validation = draw(validation_samples, "validation set")?;
    let of_validation = observed(&validation, "observations of validation");
    let outcome = if fitted {
        let observations = observed(&training, "observations");
        let pairs = fitted_pairs(simulator, &training, &observations)?;
        let validation = fitted_pairs(simulator, &validation, &of_validation)?;
        let epoch = |_| Ok(pairs.clone());
        crate::flow::train::train(&flow, &weights, samples, epoch, &validation, settings, on_epoch)?
    } else {
        let x = to_real_line(&training.theta, &space)?.to_dtype(DType::F32)?;
        let epoch = |epoch: usize| {
            let observations = observed(&training, &format!("observations of epoch {epoch}"));
            Ok(Pairs { x: x.clone(), y: encoder.encode(&observations)?.to_dtype(DType::F32)? })
        };
        let x = to_real_line(&validation.theta, &space)?.to_dtype(DType::F32)?;
        let validation = Pairs { x, y: encoder.encode(&of_validation)?.to_dtype(DType::F32)? };
        crate::flow::train::train(&flow, &weights, samples, epoch, &validation, settings, on_epoch)?
    };

    let weight_bytes = checkpoint::to_bytes(&weights)?;
    let manifest = Manifest {
        format: FORMAT,
        program_version: env!("CARGO_PKG_VERSION").to_owned(),
        structure: simulator.id().clone(),
        structure_digest: simulator.digest().clone(),
        weights_sha256: Digest::of_file(&weight_bytes),
        architecture,
        whitening,
        conditions,
        training: TrainingRecord {
            samples,
            validation_samples,
            settings: settings.clone(),
            best_epoch: outcome.best_epoch,
            stopped: outcome.stopped,
        },
        validation: ValidationRecord {
            samples: 0,
            negative_log_likelihood: 0.0,
            negative_log_likelihood_error: 0.0,
            parameters: Vec::new(),
            inverse_error: 0.0,
        },
        calibration: CalibrationRecord { simulations: 0, draws: 0, failures: Vec::new(), cells: Vec::new() },
        identifiability: IdentifiabilityRecord { parameters: Vec::new(), groups: Vec::new() },
        self_test: SelfTest {
            frequencies_hz: Vec::new(),
            shapes: Vec::new(),
            seed: settings.seed,
            expected: Vec::new(),
        },
    };
    let draft = Baseline {
        sampler: Sampler::new(&flow)?,
        flow,
        encoder,
        training_space: space,
        simulator: simulator.clone(),
        digest: manifest.weights_sha256.clone(),
        manifest,
    };
    certify(&draft, weight_bytes)
}

/// Measures a baseline anew, as at the end of its training: for one that an earlier version of this program trained, whose
/// inference was another. Its weights stay, its manifest and so its digest become those that training it now would give.
///
/// # Errors
/// As [`train`].
pub fn renew(baseline: &Baseline, weights: Vec<u8>) -> Result<Trained, Error> {
    certify(baseline, weights)
}

/// The trained flow measures itself: what goes into the manifest is what a loaded baseline gives.
fn certify(draft: &Baseline, weights: Vec<u8>) -> Result<Trained, Error> {
    let simulator = draft.simulator();
    let mut manifest = draft.manifest.clone();
    env!("CARGO_PKG_VERSION").clone_into(&mut manifest.program_version);
    let seed = manifest.training.settings.seed;
    let count = if draft.starts_at_fit() { HELD_OUT_FITTED } else { HELD_OUT_SAMPLES };
    let held_out = simulator.training_set(count, purpose_seed(seed, "held-out set"))?;
    let mut stream = stats::stream(seed, "observations of held-out set");
    let observations = observe(simulator, &manifest.conditions, &held_out, &mut stream);
    manifest.validation = validate(draft, &held_out.theta, &observations, seed)?;
    (manifest.calibration, _) = calibrate(draft, purpose_seed(seed, "calibration"))?;
    manifest.identifiability = identifiability(draft, purpose_seed(seed, "identifiability"))?;
    manifest.self_test.frequencies_hz = held_out.frequencies_hz.row(0).iter().copied().collect();
    let exact = held_out.shapes.first();
    manifest.self_test.shapes =
        exact.map_or_else(Vec::new, |s| s.column_iter().map(|shape| shape.iter().copied().collect()).collect());
    let shapes = manifest.self_test.shapes.iter().cloned().map(Some).collect();
    let observation = Observation { shapes, ..Observation::complete(&manifest.self_test.frequencies_hz) };
    // The flow's own draws: which of them the simulation keeps can hang on the last digit.
    let test_draws = draft.propose(&[observation], SELF_TEST_DRAWS, manifest.self_test.seed)?;
    manifest.self_test.expected = rows(&test_draws.theta);

    let mut manifest_json = serde_json::to_vec_pretty(&manifest).map_err(|e| Box::new(super::LoadError::from(e)))?;
    manifest_json.push(b'\n');
    let baseline = Baseline::load(&manifest_json, &weights, simulator).map_err(Box::new)?;
    Ok(Trained { baseline, manifest_json, weights })
}

/// True when the training ended before its last epoch because the loss was not finite.
pub fn diverged(manifest: &Manifest) -> bool {
    matches!(manifest.training.stopped, Stopped::Diverged { .. })
}

fn check(samples: usize, noise_range: NoiseRange, flow: &FlowSettings, settings: &TrainSettings) -> Result<(), Error> {
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

/// A seed for each of the three sets, so that they never share a draw.
fn purpose_seed(seed: u64, purpose: &str) -> u64 {
    use rand::RngCore as _;
    stats::stream(seed, purpose).next_u64()
}

/// Sizes that the effects moved by a covariate have in a training set.
fn effect_ranges(simulator: &Simulator, set: &TrainingSet) -> Vec<EffectRange> {
    let mut first = 0;
    let mut ranges = Vec::new();
    for effect in simulator.effects() {
        let column = first;
        first += effect.target.sizes();
        if effect.varies() {
            let sizes = || set.effect_sizes.iter().map(|sizes| sizes[column]);
            let (lowest, highest) = (sizes().fold(f64::INFINITY, f64::min), sizes().fold(f64::NEG_INFINITY, f64::max));
            // An effect that never moves is no condition.
            if lowest < highest {
                ranges.push(EffectRange { column, lowest, highest });
            }
        }
    }
    ranges
}

/// A measurement of each pair, with noise and missing modes drawn as in training.
pub fn observe(
    simulator: &Simulator,
    conditions: &Conditions,
    set: &TrainingSet,
    stream: &mut stats::Stream,
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

/// Measures a baseline on pairs it has not seen: likelihood, R² (paper Fig. 8), inverse error.
///
/// # Errors
/// [`InferenceError`] when a draw is not finite.
pub fn validate(
    baseline: &Baseline,
    theta: &DMatrix<f64>,
    observations: &[Observation],
    seed: u64,
) -> Result<ValidationRecord, InferenceError> {
    let count = observations.len();
    let losses: Vec<f64> = baseline.log_density_unit_box(theta, observations)?.iter().map(|log_q| -log_q).collect();
    let samples = baseline.infer(observations, HELD_OUT_DRAWS, seed)?;
    let means = samples.means();
    let validation = |(column, parameter): (usize, &crate::parameter::Parameter)| {
        let truth: Vec<f64> = theta.column(column).iter().copied().collect();
        let mean: Vec<f64> = means.column(column).iter().copied().collect();
        let single: Vec<f64> = samples.column(column).into_iter().step_by(HELD_OUT_DRAWS).collect();
        let all = samples.column(column);
        let errors: Vec<f64> = all.iter().enumerate().map(|(i, x)| (x - truth[i / HELD_OUT_DRAWS]).abs()).collect();
        ParameterValidation {
            name: parameter.name.clone(),
            r_squared_mean: stats::r_squared(&truth, &mean),
            r_squared_single: stats::r_squared(&truth, &single),
            error_quantile_999: stats::quantile(&errors, 0.999),
        }
    };
    Ok(ValidationRecord {
        samples: count,
        negative_log_likelihood: stats::mean(&losses),
        negative_log_likelihood_error: stats::sample_std(&losses).unwrap_or(f64::NAN) / (count as f64).sqrt(),
        parameters: baseline.space().iter().enumerate().map(validation).collect(),
        inverse_error: inverse_error(baseline, theta, observations)?,
    })
}

/// Largest |u − u'| after x → z → x', u the position in the prior box.
fn inverse_error(
    baseline: &Baseline,
    theta: &DMatrix<f64>,
    observations: &[Observation],
) -> Result<f64, InferenceError> {
    if baseline.starts_at_fit() {
        return inverse_error_from_fit(baseline, theta, observations);
    }
    let x = to_real_line(theta, &baseline.training_space)?.to_dtype(DType::F32)?;
    let context = baseline.flow.summarise(&baseline.condition(observations)?)?;
    let (z, _) = baseline.flow.forward(&x, &context)?;
    let back = baseline.flow.inverse(&z, &context)?;
    let unit = |t: &Tensor| t.to_dtype(DType::F64)?.flatten_all()?.to_vec1::<f64>();
    let pairs = unit(&x)?.into_iter().zip(unit(&back.0)?);
    Ok(pairs.map(|(a, b)| (super::logistic(a) - super::logistic(b)).abs()).fold(0.0, f64::max))
}

/// Rows of a matrix.
fn rows(matrix: &DMatrix<f64>) -> Vec<Vec<f64>> {
    matrix.row_iter().map(|row| row.iter().copied().collect()).collect()
}
