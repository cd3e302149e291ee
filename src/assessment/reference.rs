//! The undamaged reference that is computed from several batches.

use super::conditions::conditions;
use super::quantities::{joint_samples, monitored_quantities};
use super::samples::{draw, joined, BatchSamples, Draws, Error};
use crate::baseline::Baseline;
use crate::damage::{self, JointReference, UndamagedReference};
use crate::measurement::ModalMeasurement;
use crate::quantity::Probability;
use crate::trust::{FindingEffect, Trust};

/// A batch that cannot be part of the undamaged reference.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DoubtfulBatch {
    /// Its index among the batches.
    pub batch: usize,
    /// What was found in it.
    pub reason: String,
}

/// Why no undamaged reference could be computed from batches.
#[derive(Debug, thiserror::Error)]
pub enum ReferenceError {
    /// A batch could not be used at all.
    #[error("batch {batch}: {source}")]
    Assess {
        /// Index of the batch.
        batch: usize,
        /// The cause.
        source: Error,
    },
    /// Batches that cannot be trusted, at least one.
    #[error("{}", doubts(.0))]
    Doubtful(Vec<DoubtfulBatch>),
    /// The batches together have too few measurements, or the threshold probability is invalid.
    #[error(transparent)]
    State(#[from] damage::Error),
}

fn doubts(doubtful: &[DoubtfulBatch]) -> String {
    let each = doubtful.iter().map(|DoubtfulBatch { batch, reason }| format!("batch {batch}: {reason}"));
    format!("these batches cannot be part of the undamaged reference: {}", each.collect::<Vec<_>>().join("; "))
}

/// Batches for an undamaged reference, of which the doubtful ones have been taken out.
pub struct ReferenceBatches<'a> {
    baseline: &'a Baseline,
    trusted: Vec<(&'a [ModalMeasurement], Draws, BatchSamples)>,
    doubtful: Vec<DoubtfulBatch>,
}

impl<'a> ReferenceBatches<'a> {
    /// Examines batches, each with its draws.
    ///
    /// # Errors
    /// [`ReferenceError::Assess`] when a computation fails.
    pub fn examine(
        baseline: &'a Baseline,
        batches: &[(&'a [ModalMeasurement], Draws)],
    ) -> Result<Self, ReferenceError> {
        let (mut trusted, mut doubtful) = (Vec::new(), Vec::new());
        for (batch, (measurements, draws)) in batches.iter().enumerate() {
            let samples = match draw(baseline, measurements, None, *draws) {
                Ok(samples) => samples,
                Err(unusable @ Error::NoUsableMeasurement { .. }) => {
                    doubtful.push(DoubtfulBatch { batch, reason: unusable.to_string() });
                    continue;
                }
                Err(source) => return Err(ReferenceError::Assess { batch, source }),
            };
            let trust = Trust::new(&samples.fit, samples.findings.clone());
            // Every later batch is compared with the reference, so doubtful data must not enter it.
            match trust.findings.iter().find(|f| f.effect != FindingEffect::Note) {
                Some(finding) => doubtful.push(DoubtfulBatch { batch, reason: finding.message.clone() }),
                None => trusted.push((*measurements, *draws, samples)),
            }
        }
        Ok(Self { baseline, trusted, doubtful })
    }

    /// The batches that cannot be part of the reference, in the order in which they were given.
    pub fn doubtful(&self) -> &[DoubtfulBatch] {
        &self.doubtful
    }

    /// Computes the undamaged reference from the others.
    ///
    /// # Errors
    /// [`ReferenceError`].
    pub fn reference(self, threshold_probability: f64) -> Result<UndamagedReference, ReferenceError> {
        let Self { baseline, trusted, .. } = self;
        let Some((_, draws, _)) = trusted.first() else {
            let too_few = damage::Error::TooFewMeasurements { measurements: 0, least: damage::MINIMUM_MEASUREMENTS };
            return Err(too_few.into());
        };
        let draws = *draws;
        let (mut measurements, mut parts, mut sizes) = (Vec::new(), Vec::new(), Vec::new());
        for (batch, _, samples) in trusted {
            measurements.push(batch);
            sizes.push(samples.posterior.measurements());
            parts.push(samples);
        }
        let samples =
            joined(baseline, parts, draws).map_err(|e| ReferenceError::Assess { batch: 0, source: e.into() })?;
        let quantities = monitored_quantities(baseline, &samples, draws.per_measurement);
        let mut reference = UndamagedReference::from_samples(&quantities, &sizes, threshold_probability)?;
        reference.conditions = conditions(measurements.into_iter().flatten());
        let level = Probability::new(threshold_probability).map_err(damage::Error::from)?;
        let joint = joint_samples(baseline, &samples);
        reference.joint = joint.and_then(|joint| JointReference::new(&quantities, &joint, level));
        Ok(reference)
    }
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
    let examined = ReferenceBatches::examine(baseline, batches)?;
    if !examined.doubtful.is_empty() {
        return Err(ReferenceError::Doubtful(examined.doubtful));
    }
    examined.reference(threshold_probability)
}
