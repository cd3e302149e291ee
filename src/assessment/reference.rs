//! The undamaged reference that is computed from several batches.

use super::conditions::conditions;
use super::quantities::monitored_quantities;
use super::samples::{draw, joined, Draws, Error};
use crate::baseline::Baseline;
use crate::damage::{self, UndamagedReference};
use crate::measurement::ModalMeasurement;
use crate::trust::{FindingEffect, Trust};

/// Why no undamaged reference could be computed from batches; `batch` is the index of the batch responsible.
#[derive(Debug, thiserror::Error)]
pub enum ReferenceError {
    /// A batch could not be used at all.
    #[error("batch {batch}: {source}")]
    Assess {
        /// The batch.
        batch: usize,
        /// The cause.
        source: Error,
    },
    /// A batch cannot be trusted.
    #[error("batch {batch} cannot be part of the undamaged reference: {reason}")]
    Untrusted {
        /// The batch.
        batch: usize,
        /// What was found in it.
        reason: String,
    },
    /// The batches together have too few measurements, or the threshold probability is invalid.
    #[error(transparent)]
    State(#[from] damage::Error),
}

/// Computes the undamaged reference from several batches, each with its draws.
///
/// # Errors
/// [`ReferenceError`].
pub fn undamaged_reference(
    baseline: &Baseline,
    batches: &[(&[ModalMeasurement], Draws)],
    threshold_probability: f64,
) -> Result<UndamagedReference, ReferenceError> {
    let (mut parts, mut sizes) = (Vec::new(), Vec::new());
    for (batch, (measurements, draws)) in batches.iter().enumerate() {
        let samples =
            draw(baseline, measurements, None, *draws).map_err(|source| ReferenceError::Assess { batch, source })?;
        let trust = Trust::new(&samples.fit, samples.findings.clone());
        // Every later batch is compared with the reference, so doubtful data must not enter it.
        if let Some(finding) = trust.findings.iter().find(|f| f.effect != FindingEffect::Note) {
            return Err(ReferenceError::Untrusted { batch, reason: finding.message.clone() });
        }
        sizes.push(samples.posterior.measurements());
        parts.push(samples);
    }
    let Some((_, draws)) = batches.first() else {
        let too_few = damage::Error::TooFewMeasurements { measurements: 0, least: damage::MINIMUM_MEASUREMENTS };
        return Err(too_few.into());
    };
    let samples = joined(baseline, parts, *draws).map_err(|e| ReferenceError::Assess { batch: 0, source: e.into() })?;
    let quantities = monitored_quantities(baseline, &samples, draws.per_measurement);
    let mut reference = UndamagedReference::from_samples(&quantities, &sizes, threshold_probability)?;
    reference.conditions = conditions(batches.iter().flat_map(|(measurements, _)| *measurements));
    Ok(reference)
}
