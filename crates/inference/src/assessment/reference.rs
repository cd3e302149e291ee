//! The undamaged reference that is computed from several batches.

use std::borrow::Cow;
use std::sync::Arc;

use super::batch_mean::Healthy;
use super::conditions::{conditions, possible};
use super::dependence::{self, batches_per_year};
use super::estimate::{process_covariates, ProcessQuantities, SampledBatch};
use super::misfit;
use super::quantities::{joint_samples, monitored_quantities};
use super::samples::{draw, draw_beside, joined, BatchSamples, Beside, Context, Draws, Earlier, Error};
use super::usual_misfit;
use super::wrong_values::{self, Compared};
use crate::alarm::AlarmSettings;
use crate::baseline::observation::Observation;
use crate::baseline::Baseline;
use crate::damage::{self, JointReference, UndamagedReference};
use crate::process::estimate::BatchEstimate;
use crate::process::fit::{self, Quantities};
use crate::process::lasting::LastingChange;
use crate::process::reference::ReferenceProcess;
use crate::trust::fit::Misfit;
use crate::trust::{noise, Finding, FindingCode, FindingEffect, Trust};
use structures::measurement::ModalMeasurement;
use structures::quantity::{Hertz, Probability};
use structures::stats;

/// Greatest misfit, in standard deviations of the noise, that may be usual.
const MOST_USUAL_DISTANCE: f64 = 2.0;

/// Share of rejected batches from which a misfit is usual: five times what chance rejects.
const MORE_THAN_CHANCE: f64 = 0.05;

/// Quantile of the misfits of the reference that is accepted as usual.
const USUAL_QUANTILE: f64 = 0.9;

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
    /// Batches of an extension after which the charts of the first reference show a lasting change.
    #[error("{}", .0.sentence())]
    LastingChange(Box<LastingChange>),
    /// The batches together have too few measurements, or the threshold probability is invalid.
    #[error(transparent)]
    State(#[from] damage::Error),
}

fn doubts(doubtful: &[DoubtfulBatch]) -> String {
    let each = doubtful.iter().map(|DoubtfulBatch { batch, reason }| format!("batch {batch}: {reason}"));
    format!("these batches cannot be part of the undamaged reference: {}", each.collect::<Vec<_>>().join("; "))
}

/// What is usual for the batches of a reference: see [`ReferenceBatches`].
#[derive(Clone, Copy)]
struct Usual<'a> {
    misfit: Misfit,
    noise: &'a [f64],
    ln: &'a [f64],
}

/// A batch that can be part of a reference.
struct TrustedBatch<'a> {
    /// Its index among the batches that were given.
    index: usize,
    /// Without impossible values of covariates.
    measurements: Cow<'a, [ModalMeasurement]>,
    draws: Draws,
    samples: BatchSamples,
}

/// Batches for an undamaged reference, of which the doubtful ones have been taken out.
pub struct ReferenceBatches<'a> {
    baseline: &'a Baseline,
    trusted: Vec<TrustedBatch<'a>>,
    doubtful: Vec<DoubtfulBatch>,
    usual_misfit: Misfit,
    /// Noise of each mode as a multiple of the stated one; empty where it is as stated.
    noise: Vec<f64>,
    /// Usual misfit of each mode, ln f; empty where there is none.
    usual_ln: Vec<f64>,
}

/// The misfit that is usual for some batches; `None` if they are too few to show it, or if the simulation fits them.
///
/// A simulation is an approximation: where it deviates in more batches than chance would reject, but by less than twice the noise, the
/// deviation is a property of the simulation and not of the batch.
fn usual_misfit(batches: &[&BatchSamples]) -> Option<Misfit> {
    let slight = |samples: &&&BatchSamples| samples.fit.distance.is_some_and(|distance| distance < MOST_USUAL_DISTANCE);
    let slight: Vec<&&BatchSamples> = batches.iter().filter(slight).collect();
    let rejected = slight.iter().filter(|samples| samples.fit.rejected()).count();
    if batches.len() < fit::FEWEST_BATCHES || (rejected as f64) < MORE_THAN_CHANCE * batches.len() as f64 {
        return None;
    }
    let misfits: Vec<Misfit> = slight.iter().filter_map(|samples| samples.fit.misfit()).collect();
    let quantile = |which: usize| {
        let own: Vec<f64> = misfits.iter().map(|misfit| misfit[which]).collect();
        stats::quantile(&own, USUAL_QUANTILE).max(1.0)
    };
    Some([quantile(0), quantile(1)])
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
        let (mut drawn, mut doubtful) = (Vec::new(), Vec::new());
        let all_earlier = earlier(batches);
        let context = |batch: usize| Context { undamaged: None, earlier: Some(&all_earlier[batch]) };
        for (batch, (measurements, draws)) in batches.iter().enumerate() {
            match draw(baseline, measurements, context(batch), *draws) {
                Ok(samples) => {
                    let (measurements, _) = possible(measurements, baseline.simulator().covariates());
                    drawn.push((batch, measurements, *draws, samples));
                }
                Err(unusable @ Error::NoUsableMeasurement { .. }) => {
                    doubtful.push(DoubtfulBatch { batch, reason: unusable.to_string() });
                }
                Err(source) => return Err(ReferenceError::Assess { batch, source }),
            }
        }
        let mut in_time: Vec<_> = drawn.iter().collect();
        in_time.sort_by_key(|(_, measurements, ..)| measurements.iter().map(|m| m.measured_at).max());
        let tested: Vec<noise::Tested<'_>> =
            in_time.iter().map(|(.., samples)| noise::Tested { fit: &samples.fit, noise: samples.noise }).collect();
        let noise = noise::learned_of_modes(&tested).unwrap_or_default();
        let of_batch: Vec<&BatchSamples> = drawn.iter().map(|(.., samples)| samples).collect();
        let usual_ln = usual_misfit::usual(&of_batch);
        if !noise.is_empty() || !usual_ln.is_empty() {
            let beside = Beside { compared: None, noise: &noise, usual_ln: &usual_ln };
            for (batch, measurements, draws, samples) in &mut drawn {
                *samples = draw_beside(baseline, measurements, context(*batch), beside, *draws)
                    .map_err(|source| ReferenceError::Assess { batch: *batch, source })?;
            }
        }
        let of_batch: Vec<(&[ModalMeasurement], &[Observation])> =
            drawn.iter().map(|(_, measurements, _, samples)| (&**measurements, samples.asked.as_slice())).collect();
        if let Some(healthy) = healthy(baseline, of_batch) {
            let (all_times, previous, usual_misfit) = (None, None, [1.0; 2]);
            let compared = Some(Compared { healthy: &healthy, all_times, previous, usual_misfit });
            let beside = Beside { compared, noise: &noise, usual_ln: &usual_ln };
            for (batch, measurements, draws, samples) in &mut drawn {
                if wrong_values::any(baseline, &samples.asked, &healthy) {
                    *samples = draw_beside(baseline, measurements, context(*batch), beside, *draws)
                        .map_err(|source| ReferenceError::Assess { batch: *batch, source })?;
                }
            }
        }
        let of_batch: Vec<&BatchSamples> = drawn.iter().map(|(.., samples)| samples).collect();
        let usual_misfit = usual_misfit(&of_batch);
        let mut trusted = Vec::new();
        for (batch, measurements, draws, samples) in drawn {
            let trust = Trust::new(&samples.fit, samples.findings.clone());
            let usual = usual_misfit.is_some_and(|usual| !samples.fit.rejected_beside(usual));
            // Every later batch is compared with the reference, so doubtful data must not enter it.
            let is_doubt = |f: &&Finding| {
                f.effect != FindingEffect::Note && !(usual && f.code == FindingCode::SimulationDoesNotFit)
            };
            match trust.findings.iter().find(is_doubt) {
                Some(finding) => doubtful.push(DoubtfulBatch { batch, reason: finding.message.clone() }),
                None => trusted.push(TrustedBatch { index: batch, measurements, draws, samples }),
            }
        }
        doubtful.sort_by_key(|doubtful| doubtful.batch);
        Ok(Self { baseline, trusted, doubtful, usual_misfit: usual_misfit.unwrap_or([1.0; 2]), noise, usual_ln })
    }

    /// The batches that cannot be part of the reference, in the order in which they were given.
    pub fn doubtful(&self) -> &[DoubtfulBatch] {
        &self.doubtful
    }

    fn usual(&self) -> Usual<'_> {
        Usual { misfit: self.usual_misfit, noise: &self.noise, ln: &self.usual_ln }
    }

    /// Whether an extension hides a loss: batches for which `is_first` is true make a process by themselves, and its charts watch all
    /// others. A slow loss that each extension would take for a season is found so, because the first reference does not follow it.
    ///
    /// # Errors
    /// [`ReferenceError::LastingChange`]. There is no test where the first batches show no process.
    pub fn watched_by(&self, is_first: impl Fn(usize) -> bool, settings: &AlarmSettings) -> Result<(), ReferenceError> {
        let (first, later): (Vec<_>, Vec<_>) = self.trusted.iter().partition(|batch| is_first(batch.index));
        let watch = process(self.baseline, &first, settings, self.usual());
        let Ok((process, ..)) = watch else { return Ok(()) };
        let healthy = healthy_of(self.baseline, &first);
        let own = ProcessQuantities::of(self.baseline, process.misfit.as_ref());
        let estimates = estimates(self.baseline, &own, &later, &process.process.covariates, healthy.as_ref());
        match process.first_change(estimates) {
            Some(change) => Err(ReferenceError::LastingChange(Box::new(change))),
            None => Ok(()),
        }
    }

    /// Computes the undamaged reference from the others.
    ///
    /// # Errors
    /// [`ReferenceError`].
    pub fn reference(
        self,
        threshold_probability: f64,
        settings: &AlarmSettings,
    ) -> Result<UndamagedReference, ReferenceError> {
        let usual = self.usual();
        let all: Vec<&TrustedBatch<'_>> = self.trusted.iter().collect();
        let process = process(self.baseline, &all, settings, usual);
        let Self { baseline, trusted, usual_misfit, noise, usual_ln, .. } = self;
        let Some(draws) = trusted.first().map(|batch| batch.draws) else {
            let too_few = damage::Error::TooFewMeasurements { measurements: 0, least: damage::MINIMUM_MEASUREMENTS };
            return Err(too_few.into());
        };
        let (mut rows, mut parts, mut sizes) = (Vec::new(), Vec::new(), Vec::new());
        // Once for the reference, however many of its batches have it.
        let is_overstated = |f: &&Finding| f.code == FindingCode::NoiseOverstated;
        let overstated = trusted.iter().find_map(|batch| batch.samples.findings.iter().find(is_overstated));
        let overstated = overstated.map(|finding| finding.message.clone());
        for batch in trusted {
            rows.push(batch.measurements);
            sizes.push(batch.samples.posterior.measurements());
            parts.push(batch.samples);
        }
        let measurements: Vec<&[ModalMeasurement]> = rows.iter().map(|rows| &**rows).collect();
        let samples =
            joined(baseline, parts, draws).map_err(|e| ReferenceError::Assess { batch: 0, source: e.into() })?;
        let mut quantities = monitored_quantities(baseline, &samples, draws.per_measurement);
        dependence::within_batches(&mut quantities, &sizes, &measurements);
        let mut reference = UndamagedReference::from_samples(&quantities, &sizes, threshold_probability)?;
        let rhythm = batches_per_year(&measurements);
        reference.quantities.iter_mut().for_each(|quantity| quantity.reference.batches_per_year = rhythm);
        if usual_misfit.iter().any(|usual| *usual > 1.0) {
            reference.doubts.push(format!(
                "the simulation deviates from its batches by more than their noise (by {:.1} times in one of ten), which is accepted as \
                 usual for this structure: a diagnosis may find the cause",
                usual_misfit[0].sqrt()
            ));
        }
        if !noise.is_empty() {
            reference.doubts.push(noise::in_words(&noise));
        }
        if !usual_ln.is_empty() {
            reference.doubts.push(usual_misfit::in_words(&usual_ln));
        }
        reference.doubts.extend(overstated);
        reference.doubts.extend(dependence::short_period(&measurements));
        reference.conditions = conditions(measurements.into_iter().flatten());
        match process {
            Ok((process, quantities, estimates)) => {
                reference.doubts.extend(process.change_inside(&quantities, estimates).map(|change| {
                    let what = change.happening();
                    format!("a change lies in its batches: {what}; declare the part before it, or the part after it")
                }));
                reference.process = Some(Arc::new(process));
            }
            Err(why) => reference.without_process = Some(why.to_string()),
        }
        let level = Probability::new(threshold_probability).map_err(damage::Error::from)?;
        let joint = joint_samples(baseline, &samples);
        reference.joint = joint.and_then(|joint| JointReference::new(&quantities, &joint, level));
        Ok(reference)
    }
}

/// What was measured before each of some batches, in those before it.
fn earlier(batches: &[(&[ModalMeasurement], Draws)]) -> Vec<Earlier> {
    let mut order: Vec<usize> = (0..batches.len()).collect();
    order.sort_by_key(|batch| batches[*batch].0.iter().map(|m| m.measured_at).min());
    let mut found = vec![Earlier::default(); batches.len()];
    let mut rows: Vec<Vec<Option<Hertz>>> = Vec::new();
    for batch in order {
        found[batch].rows = rows[rows.len().saturating_sub(Earlier::compared_with(batches[batch].0.len()))..].to_vec();
        let mut own: Vec<&ModalMeasurement> = batches[batch].0.iter().collect();
        own.sort_by_key(|m| m.measured_at);
        rows.extend(own.iter().map(|m| m.frequencies_hz.clone()));
    }
    found
}

/// The process behind some batches, with what it was fitted to.
fn process(
    baseline: &Baseline,
    trusted: &[&TrustedBatch<'_>],
    settings: &AlarmSettings,
    Usual { misfit: usual_misfit, noise, ln: usual_ln }: Usual<'_>,
) -> Result<(ReferenceProcess, Quantities, Vec<BatchEstimate>), fit::Error> {
    let measurements: Vec<&[ModalMeasurement]> = trusted.iter().map(|batch| &*batch.measurements).collect();
    let covariates = process_covariates(&measurements);
    let healthy = healthy_of(baseline, trusted);
    let row = trusted.iter().flat_map(|batch| &batch.samples.asked).next();
    let misfit = healthy.as_ref().zip(row).and_then(|(healthy, row)| misfit::coordinates(baseline, row, healthy));
    let mut own = ProcessQuantities::of(baseline, misfit.as_ref());
    let mut estimates = estimates(baseline, &own, trusted, &covariates, healthy.as_ref());
    if estimates.iter().filter(|estimate| own.informs_misfit(estimate)).count()
        < fit::FEWEST_BATCHES.max(estimates.len() / 2)
    {
        // Too few of them have the modes that it needs.
        own = ProcessQuantities::of(baseline, None);
        for estimate in &mut estimates {
            own.without_misfit(estimate);
        }
    }
    let complete = |estimate: &BatchEstimate| estimate.covariates.iter().all(Option::is_some);
    let estimates: Vec<BatchEstimate> =
        estimates.into_iter().filter(complete).map(|estimate| own.of_informed(estimate)).collect();
    let run = settings.run_batches(batches_per_year(&measurements));
    let mut found = ReferenceProcess::new(&own.quantities, &covariates, estimates.clone(), run, usual_misfit)?;
    found.noise = noise.to_vec();
    found.usual_ln = usual_ln.to_vec();
    if let Some(healthy) = &healthy {
        found.one_factor = row.map_or_else(Vec::new, |row| own.under_one_factor(baseline, row, healthy));
    }
    found.scatter = healthy.map_or_else(Vec::new, |healthy| healthy.scatter.as_slice().to_vec());
    if let Some(seen) = &mut found.process.coverage {
        let declared = baseline.simulator().covariates();
        let unit = |name: &String| declared.iter().find(|c| c.name == *name)?.unit().map(str::to_owned);
        seen.units = covariates.iter().map(unit).collect();
    }
    Ok((found, own.quantities, estimates))
}

/// The healthy structure behind some batches; `None` where it is not computed.
fn healthy(baseline: &Baseline, mut batches: Vec<(&[ModalMeasurement], &[Observation])>) -> Option<Healthy> {
    batches.sort_by_key(|(measurements, _)| measurements.iter().map(|m| m.measured_at).max());
    let observations: Vec<&[Observation]> = batches.into_iter().map(|(_, observations)| observations).collect();
    Healthy::of_batches(baseline, &observations)
}

fn healthy_of(baseline: &Baseline, batches: &[&TrustedBatch<'_>]) -> Option<Healthy> {
    healthy(baseline, batches.iter().map(|batch| (&*batch.measurements, batch.samples.asked.as_slice())).collect())
}

/// The estimates of some batches.
fn estimates(
    baseline: &Baseline,
    own: &ProcessQuantities,
    batches: &[&TrustedBatch<'_>],
    covariates: &[String],
    healthy: Option<&Healthy>,
) -> Vec<BatchEstimate> {
    let estimate = |batch: &&TrustedBatch<'_>| {
        let quantities = monitored_quantities(baseline, &batch.samples, batch.draws.per_measurement);
        let sampled =
            SampledBatch { measurements: &batch.measurements, samples: &batch.samples, quantities: &quantities };
        own.estimate(baseline, &sampled, covariates, healthy).map(|(estimate, _)| estimate)
    };
    batches.iter().filter_map(estimate).collect()
}

/// Computes the undamaged reference from several batches, each with its draws.
///
/// # Errors
/// [`ReferenceError`].
pub fn undamaged_reference(
    baseline: &Baseline,
    batches: &[(&[ModalMeasurement], Draws)],
    threshold_probability: f64,
    settings: &AlarmSettings,
) -> Result<UndamagedReference, ReferenceError> {
    let examined = ReferenceBatches::examine(baseline, batches)?;
    if !examined.doubtful.is_empty() {
        return Err(ReferenceError::Doubtful(examined.doubtful));
    }
    examined.reference(threshold_probability, settings)
}
