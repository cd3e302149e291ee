//! What a trained model is worth: its accuracy, calibration and identifiability, which complete its manifest.

use candle_core::DType;

use super::calibration::{calibrate_again, calibrate_watched, OnCell};
use super::error::LoadError;
use super::identifiability::identifiability;
use super::judge::judge;
use super::manifest::Manifest;
use super::model::Baseline;
use super::observation::Observation;
use super::spread;
use super::trained::{observe, purpose_seed, rows, Error, Trained};
use super::validation::validate;
use crate::flow::checkpoint;
use structures::simulator::Simulator;
use structures::stats;

/// Number of held-out pairs, on which the accuracy in the manifest is measured.
const HELD_OUT_SAMPLES: usize = 2_000;
/// Number of held-out pairs where the flow starts at the best fit: a fit takes 0.2 s with three hundred parameters.
const HELD_OUT_FITTED: usize = 300;
/// Number of held-out pairs of a model whose calibration is not measured.
const HELD_OUT_QUICK: usize = 200;
/// Draws of the self-test.
const SELF_TEST_DRAWS: usize = 4;

/// Certifies a model again, as at the end of its training, for a model from an earlier version of this program with another
/// inference. The weights stay the same; the manifest, and with it the digest, become those that a training now would give.
///
/// # Errors
/// As [`super::train::train`].
pub fn renew(baseline: &Baseline, weights: Vec<u8>) -> Result<Trained, Error> {
    certify(baseline.manifest().clone(), baseline.simulator(), weights, &mut |_, _| {})
}

/// Measures accuracy, calibration and identifiability of a trained model, completes its manifest, and loads it back.
///
/// Where it does not pass, the spread of the uncorrected draws is repaired, and these cells are judged on other simulations.
pub(super) fn certify(
    mut manifest: Manifest,
    simulator: &Simulator,
    weights: Vec<u8>,
    cell: OnCell<'_>,
) -> Result<Trained, Error> {
    let mut draft = draft(&mut manifest, simulator, &weights)?;
    let seed = manifest.training.settings.seed;
    // Another round is judged on other simulations: the first ones have been looked at already.
    let round = match manifest.training.further_rounds.len() {
        0 => String::new(),
        further => format!(" of round {}", further + 1),
    };
    let calibration_seed = |what: &str| purpose_seed(seed, &format!("{what}{round}"));
    (manifest.calibration, _) = calibrate_watched(&draft, calibration_seed("calibration"), cell)?;
    if !manifest.calibration.passed() && simulator.is_noisy() {
        let record = &manifest.calibration;
        let faulty = |index: usize| !judge(&record.cells, index, record.simulations).is_clean();
        draft.manifest.spread = spread::learn(&draft, faulty, calibration_seed("spread"))?;
        let repaired = calibrate_again(&draft, record, (&faulty, calibration_seed("repair")), cell)?;
        if repaired.findings() < manifest.calibration.findings() {
            (manifest.calibration, manifest.spread) = (repaired, draft.manifest.spread.clone());
        } else {
            draft.manifest.spread = Vec::new();
        }
    }
    let count = if draft.starts_at_fit() { HELD_OUT_FITTED } else { HELD_OUT_SAMPLES };
    complete(manifest, &draft, weights, count)
}

/// Completes the manifest of a model whose calibration is not measured, and loads it back.
pub(super) fn without_calibration(
    mut manifest: Manifest,
    simulator: &Simulator,
    weights: Vec<u8>,
) -> Result<Trained, Error> {
    let draft = draft(&mut manifest, simulator, &weights)?;
    complete(manifest, &draft, weights, HELD_OUT_QUICK)
}

/// The model of a manifest whose records are not measured yet.
fn draft(manifest: &mut Manifest, simulator: &Simulator, weights: &[u8]) -> Result<Baseline, Error> {
    env!("CARGO_PKG_VERSION").clone_into(&mut manifest.program_version);
    manifest.spread = Vec::new();
    let flow = checkpoint::from_bytes(weights, &manifest.architecture, DType::F32)?;
    let digest = manifest.weights_sha256.clone();
    Ok(Baseline::new(flow, simulator, manifest.clone(), digest)?)
}

/// Measures accuracy and identifiability on `count` held-out pairs, writes the self-test, and loads the model back.
fn complete(mut manifest: Manifest, draft: &Baseline, weights: Vec<u8>, count: usize) -> Result<Trained, Error> {
    let (simulator, seed) = (draft.simulator(), manifest.training.settings.seed);
    let held_out = simulator.training_set(count, purpose_seed(seed, "held-out set"))?;
    let mut stream = stats::stream(seed, "observations of held-out set");
    let observations = observe(simulator, &manifest.conditions, &held_out, &mut stream);
    manifest.validation = validate(draft, &held_out.theta, &observations, seed)?;
    manifest.identifiability = identifiability(draft, purpose_seed(seed, "identifiability"))?;
    manifest.self_test.frequencies_hz = held_out.frequencies_hz.row(0).iter().copied().collect();
    let exact = held_out.shapes.first();
    manifest.self_test.shapes =
        exact.map_or_else(Vec::new, |s| s.column_iter().map(|shape| shape.iter().copied().collect()).collect());
    let shapes = manifest.self_test.shapes.iter().cloned().map(Some).collect();
    let observation = Observation { shapes, ..Observation::complete(&manifest.self_test.frequencies_hz) };
    // The self-test uses the flow's draws: resampling can depend on their last digits.
    let test_draws = draft.propose(&[observation], SELF_TEST_DRAWS, manifest.self_test.seed)?;
    manifest.self_test.expected = rows(&test_draws.theta);

    let mut manifest_json = serde_json::to_vec_pretty(&manifest).map_err(|e| Box::new(LoadError::from(e)))?;
    manifest_json.push(b'\n');
    let baseline = Baseline::load(&manifest_json, &weights, simulator).map_err(Box::new)?;
    Ok(Trained { baseline, manifest_json, weights })
}
