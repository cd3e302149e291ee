//! Search for common mistakes that explain why a batch does not fit: another unit, or wrongly numbered modes.

use super::finding::{Finding, FindingCode, FindingEffect};
use super::fit::fit;
use crate::baseline::observation::Observation;
use crate::baseline::{Baseline, InferenceError};
use structures::measurement::mistaken_unit::MISTAKEN_UNITS;
use structures::physics;

/// Largest number of measurements on which a suspected mistake is tested.
const TESTED_MEASUREMENTS: usize = 8;

/// Posterior draws whose mean is the starting point of a search.
const DRAWS: usize = 16;

/// Why no suspected mistake could be tested.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The flow failed.
    #[error(transparent)]
    Inference(#[from] InferenceError),
    /// The simulation failed.
    #[error(transparent)]
    Simulation(#[from] physics::Error),
}

/// Tests common mistakes on a rejected batch and reports the first whose correction makes it fit.
///
/// # Errors
/// [`Error`], which does not occur with a loaded trained baseline.
pub fn suspect(baseline: &Baseline, observations: &[Observation], seed: u64) -> Result<Option<Finding>, Error> {
    let step = observations.len().div_ceil(TESTED_MEASUREMENTS).max(1);
    let subset: Vec<&Observation> = observations.iter().step_by(step).collect();
    let fits_after = |change: &dyn Fn(&Observation) -> Observation, must_be_tested: bool| -> Result<bool, Error> {
        let changed: Vec<Observation> = subset.iter().map(|o| change(o)).filter(|o| o.modes_present() > 0).collect();
        if changed.is_empty() {
            return Ok(false);
        }
        let means = baseline.infer(&changed, DRAWS, seed)?.means();
        let starts: Vec<Vec<f64>> = means.row_iter().map(|row| row.iter().copied().collect()).collect();
        let fit = fit(baseline.simulator(), &changed, &starts)?;
        Ok(!fit.rejected() && (fit.p_value.is_some() || !must_be_tested))
    };
    for unit in MISTAKEN_UNITS {
        let in_hz = |o: &Observation| Observation {
            frequencies_hz: o.frequencies_hz.iter().map(|f| f.map(unit.in_hz)).collect(),
            ..o.clone()
        };
        if fits_after(&in_hz, false)? {
            let message = format!("the measurements fit when they are read as {} instead of Hz: send Hz", unit.name);
            return Ok(Some(Finding::new(FindingCode::UnitSuspected, FindingEffect::Reject, message)));
        }
    }
    // If mode j was missed and the modes above it were numbered one too low, the value sent as mode i ≥ j belongs to mode i + 1,
    // and mode j has no value.
    let modes = baseline.simulator().modes();
    for missed in 0..modes.saturating_sub(1) {
        let shifted = |o: &Observation| {
            let from = |mode: usize| if mode > missed { mode - 1 } else { mode };
            Observation {
                frequencies_hz: (0..modes).map(|i| o.frequencies_hz[from(i)].filter(|_| i != missed)).collect(),
                noise_multiple: (0..modes).map(|i| if i == missed { 1.0 } else { o.noise_multiple[from(i)] }).collect(),
                ..o.clone()
            }
        };
        // With too few modes left for a test, any shift would fit.
        if fits_after(&shifted, true)? {
            let message = format!(
                "the measurements fit when mode {} is taken as missed and those above it as numbered one too low: send null for \
                 the missed mode",
                missed + 1
            );
            return Ok(Some(Finding::new(FindingCode::ModesShifted, FindingEffect::Reject, message)));
        }
    }
    Ok(None)
}
