//! Posterior samples of the measurements of a batch, and the population behind them.

use nalgebra::DMatrix;

use super::admission::admit;
use super::batch_mean::{BatchMean, Healthy};
use super::beyond_prior::{self, Beyond};
use super::conditions::possible;
use super::misfit;
use super::population::population_behind;
use super::wrong_values::{set_aside, Compared};
use crate::baseline::observation::Observation;
use crate::baseline::{Baseline, InferenceError};
use crate::damage::UndamagedReference;
use crate::hierarchy::Populations;
use crate::posterior::PosteriorSamples;
use crate::trust::{cause, copies, fit, noise, quality, rounding, Finding, FindingCode, FindingEffect};
use structures::measurement::ModalMeasurement;
use structures::parameter::Parameter;
use structures::quantity::Hertz;

/// The pilot sample, which locates the population, is one third of the posterior samples for the population. Its samples include
/// repeats from the resampling: a third of 64 with repeats locates the population as well as a quarter of them without, and saves
/// two thirds of the flow's work.
const PILOT_DIVISOR: usize = 3;

/// Effective samples for each measurement below which a finding warns the reader.
const FEW_EFFECTIVE_SAMPLES: f64 = 3.0;

/// Why a batch was not assessed; the batch itself is kept.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// The trained baseline can use none of the measurements.
    #[error("none of {measurements} measurements can be used: each lacks a mode that the trained model needs, or states more than ten times the largest noise that it was trained for")]
    NoUsableMeasurement {
        /// Measurements of the batch.
        measurements: usize,
    },
    /// The flow failed, because of a programming error or a damaged trained baseline.
    #[error(transparent)]
    Inference(#[from] InferenceError),
    /// The simulation failed inside the prior. This is a programming error, because the prior box was checked.
    #[error("the simulation failed inside the prior: {0}")]
    Simulation(#[from] structures::physics::Error),
    /// The search for the cause of a misfit failed.
    #[error(transparent)]
    Cause(#[from] cause::Error),
}

/// How many posterior samples are drawn for a batch, and with which seed.
#[derive(Debug, Clone, Copy)]
pub struct Draws {
    /// Posterior samples of each measurement in the pool (paper).
    pub per_measurement: usize,
    /// Posterior samples of each measurement for the population behind the batch.
    pub for_population: usize,
    /// Seed of the latent draws.
    pub seed: u64,
}

impl Draws {
    /// Posterior samples of each measurement in the pool that Wang et al. (2025), §5.2, use.
    pub const PER_MEASUREMENT: usize = 10;

    /// Posterior samples of each measurement for the population.
    pub const FOR_POPULATION: usize = 64;

    /// The default numbers of samples with this seed.
    pub const fn with_seed(seed: u64) -> Self {
        Self { per_measurement: Self::PER_MEASUREMENT, for_population: Self::FOR_POPULATION, seed }
    }

    /// Posterior samples of each measurement that both uses together need.
    pub(super) fn most(&self) -> usize {
        self.for_population.max(self.per_measurement)
    }
}

/// Posterior samples of the measurements of a batch, and the findings made while drawing them.
#[derive(Debug)]
pub struct BatchSamples {
    /// Samples of the parameters.
    pub posterior: PosteriorSamples,
    /// The population behind them.
    pub populations: Populations,
    /// The observations passed to the flow: the measurements used, with those beyond the prior replaced by its nearest point.
    pub asked: Vec<Observation>,
    /// The measurements used, without the usual misfit of the reference.
    pub observations: Vec<Observation>,
    /// How well the simulation reproduces the admitted measurements.
    pub fit: fit::Fit,
    /// Findings about the data, the admission and the fit.
    pub findings: Vec<Finding>,
    /// Measurements left out.
    pub left_out: usize,
    /// Where the parameters lie beyond their prior: the mean of the batch, and the names of those parameters.
    pub(super) beyond: Option<(BatchMean, Vec<String>)>,
    /// Noise that the batch itself has shown, as a multiple of that which it was drawn with otherwise; 1 where it was not learned.
    pub noise: f64,
}

/// What a batch is compared with, and what came before it.
#[derive(Debug, Clone, Copy, Default)]
pub struct Context<'a> {
    /// The undamaged reference.
    pub undamaged: Option<&'a UndamagedReference>,
    /// What was measured before the batch.
    pub earlier: Option<&'a Earlier>,
}

/// Frequencies that were measured before a batch.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Earlier {
    /// Those of the last measurement of the same source, `[modes]`.
    pub previous: Option<Vec<Option<Hertz>>>,
    /// Those of the batches before it, of any source, in the order of time, `[n][modes]`.
    pub rows: Vec<Vec<Option<Hertz>>>,
}

impl Earlier {
    /// Number of earlier measurements that a batch of some measurements is compared with: as many as it has, at least a day of hourly ones.
    pub fn compared_with(measurements: usize) -> usize {
        measurements.clamp(24, 100)
    }
}

impl<'a> Context<'a> {
    /// Frequencies of the last measurement of the same source, `[modes]`.
    fn previous(&self) -> Option<&'a [Option<Hertz>]> {
        self.earlier.and_then(|earlier| earlier.previous.as_deref())
    }
}

/// Draws from the posterior of each measurement and estimates the population behind them.
///
/// # Errors
/// [`Error`], see its variants.
pub fn draw(
    baseline: &Baseline,
    measurements: &[ModalMeasurement],
    context: Context<'_>,
    draws: Draws,
) -> Result<BatchSamples, Error> {
    let Some(undamaged) = context.undamaged else {
        return draw_beside(baseline, measurements, context, Beside::default(), draws);
    };
    let std = |p: &Parameter| undamaged.quantities.iter().find(|q| q.name == p.name).map(|q| q.std);
    let all_times: Option<Vec<f64>> = baseline.space().iter().map(std).collect();
    let healthy = Healthy::of_reference(baseline, undamaged);
    // An earlier version of the structure may have had another number of modes.
    let previous = context.previous().filter(|previous| previous.len() == baseline.simulator().modes());
    let all_times = all_times.as_deref();
    let usual_misfit = undamaged.process.as_ref().map_or([1.0; 2], |process| process.usual_misfit);
    let compared = healthy.as_ref().map(|healthy| Compared { healthy, all_times, previous, usual_misfit });
    let process = undamaged.process.as_deref();
    let noise = process.map_or(&[][..], |process| &process.noise);
    let usual_ln = process.map_or(&[][..], |process| &process.usual_ln);
    draw_beside(baseline, measurements, context, Beside { compared, noise, usual_ln }, draws)
}

/// What is known of a healthy structure while a batch is drawn.
#[derive(Clone, Copy, Default)]
pub(super) struct Beside<'a> {
    /// The structure beside which wrong frequencies are set aside.
    pub compared: Option<Compared<'a>>,
    /// Noise of each mode as a multiple of the stated one, `[modes]`; empty where it is as stated.
    pub noise: &'a [f64],
    /// Usual difference of measured and simulated ln f of each mode, `[modes]`, which is taken out; empty where there is none.
    pub usual_ln: &'a [f64],
}

/// [`draw`] beside a healthy structure.
///
/// # Errors
/// As [`draw`].
pub(super) fn draw_beside(
    baseline: &Baseline,
    measurements: &[ModalMeasurement],
    context: Context<'_>,
    beside: Beside<'_>,
    draws: Draws,
) -> Result<BatchSamples, Error> {
    let (measurements, impossible) = possible(measurements, baseline.simulator().covariates());
    let Prepared { indices, mut observations, mut findings, least_noise } =
        prepared(baseline, &measurements, context, beside);
    findings.extend(impossible);
    if observations.is_empty() {
        return Err(Error::NoUsableMeasurement { measurements: measurements.len() });
    }
    // A single measurement, and a trained baseline that estimates the population of each parameter separately, need no pilot
    // sample.
    let piloted = observations.len() > 1 && !baseline.starts_at_fit();
    let first = if piloted { draws.per_measurement.max(draws.for_population / PILOT_DIVISOR) } else { draws.most() };
    let infer = |observations: &[Observation]| {
        if piloted {
            baseline.infer_with_repeats(observations, first, draws.seed)
        } else {
            baseline.infer(observations, first, draws.seed)
        }
    };
    let mut posterior = infer(&observations)?;
    let mut fit = fit::fit(baseline.simulator(), &observations, &rows(&posterior.means()))?;
    let beyond = beside
        .compared
        .and_then(|compared| beyond_prior::found(baseline, &observations, compared, &fit, draws.most(), draws.seed));
    if let Some(found) = beyond {
        let left_out = measurements.len() - observations.len();
        return Ok(beyond_samples(baseline, found, (indices, observations), findings, left_out));
    }
    let larger = if fit.rejected() { noise::learned(&noise::Tested { fit: &fit, noise: 1.0 }) } else { None };
    let mut noise_shown = 1.0;
    if let Some(larger) = larger.filter(|noise| *noise > 1.0) {
        let mut scaled = observations.clone();
        noise::scaled(&mut scaled, &vec![larger; baseline.simulator().modes()], least_noise);
        let samples = infer(&scaled)?;
        let of_scaled = fit::fit(baseline.simulator(), &scaled, &rows(&samples.means()))?;
        if !of_scaled.rejected() {
            findings.push(noise::finding(larger));
            (noise_shown, observations, posterior, fit) = (larger, scaled, samples, of_scaled);
        }
    }
    findings.extend(fit.findings(baseline.simulator(), &indices));
    if fit.rejected() {
        findings.extend(cause::suspect(baseline, &observations, draws.seed)?);
    }
    // Gross outliers are left out, unless all measurements are gross outliers.
    let leave_out = fit.gross.len() < observations.len();
    let is_used = |row: &usize| !(leave_out && fit.gross.contains(row));
    let asked: Vec<Observation> =
        (0..observations.len()).filter(is_used).map(|row| within_prior(&observations[row], row, &fit)).collect();
    let posterior = if fit.outside.is_empty() && fit.gross.is_empty() { posterior } else { infer(&asked)? };
    let (posterior, populations) =
        population_behind(baseline, posterior, &asked, context.undamaged, draws.most(), draws.seed)?;
    if populations.effective_sample_size < FEW_EFFECTIVE_SAMPLES && posterior.measurements() > 1 {
        let message = format!(
            "the hyperparameters are estimated from only {:.1} effective samples for each measurement, because the \
             measurement noise is large compared with the spread of the parameters: treat them as rough estimates",
            populations.effective_sample_size
        );
        findings.push(Finding::new(FindingCode::FewEffectiveSamples, FindingEffect::Note, message));
    }
    let left_out = measurements.len() - asked.len();
    let used = (0..observations.len()).filter(is_used).map(|row| observations[row].clone()).collect();
    Ok(BatchSamples {
        posterior,
        populations,
        asked,
        observations: used,
        fit,
        findings,
        left_out,
        beyond: None,
        noise: noise_shown,
    })
}

/// The samples of a batch whose parameters lie beyond the prior. `used`: places of the measurements in the batch, and their observations.
fn beyond_samples(
    baseline: &Baseline,
    found: Beyond,
    used: (Vec<usize>, Vec<Observation>),
    mut findings: Vec<Finding>,
    left_out: usize,
) -> BatchSamples {
    let (indices, observations) = used;
    findings.extend(found.fit.findings(baseline.simulator(), &indices));
    findings.push(found.finding);
    BatchSamples {
        posterior: found.posterior,
        populations: found.populations,
        asked: observations.clone(),
        observations,
        fit: found.fit,
        findings,
        left_out,
        beyond: Some((found.mean, found.names)),
        noise: 1.0,
    }
}

/// The observations of a batch as they are passed to the flow first.
struct Prepared {
    /// Places of their measurements in the batch.
    indices: Vec<usize>,
    observations: Vec<Observation>,
    findings: Vec<Finding>,
    /// Least noise that the trained model covers, as a multiple of that of the structure.
    least_noise: f64,
}

/// Inspects the measurements of a batch, in the order of time, and leaves out or sets aside what is not used.
fn prepared(
    baseline: &Baseline,
    measurements: &[ModalMeasurement],
    context: Context<'_>,
    beside: Beside<'_>,
) -> Prepared {
    let quality::Inspection { mut kept, mut findings } = quality::inspect(measurements, context.previous());
    // How measurements follow one another is judged in the order of time.
    kept.sort_by_key(|(_, measurement)| measurement.measured_at);
    let earlier = context.earlier.map_or(&[][..], |earlier| &earlier.rows);
    copies::of_earlier(baseline.simulator(), &mut kept, earlier, &mut findings);
    copies::standing_still(baseline.simulator(), &mut kept, earlier, &mut findings);
    findings.extend(copies::noise_overstated(&kept));
    let (indices, observations) = admit(baseline, &kept, &mut findings);
    // Values rounded to coarse steps coincide by chance.
    let (indices, mut observations) = if rounding::is_coarse(&kept) {
        (indices, observations)
    } else {
        copies::counted_once(baseline.simulator(), indices, observations, &mut findings)
    };
    rounding::widened(baseline.simulator(), &kept, &mut observations, &mut findings);
    let least_noise = baseline.manifest().conditions.noise_range.map_or(0.0, |range| range.lowest);
    noise::scaled(&mut observations, beside.noise, least_noise);
    misfit::take_out(&mut observations, beside.usual_ln);
    let (indices, observations) = match beside.compared {
        Some(compared) => set_aside(baseline, indices, observations, compared, &mut findings),
        None => (indices, observations),
    };
    Prepared { indices, observations, findings, least_noise }
}

/// An observation, replaced by the nearest point of the prior box where no point of the box reproduces it.
///
/// The flow was trained inside the box only. For an observation beyond it, its answer would be arbitrary in all parameters. The
/// nearest point keeps the parameters that do fit and puts the others at the bound of their prior.
fn within_prior(observation: &Observation, row: usize, fit: &fit::Fit) -> Observation {
    if !fit.outside.contains(&row) && !fit.gross.contains(&row) {
        return observation.clone();
    }
    let nearest = fit.nearest[row].frequencies_hz.iter().copied().map(Some);
    let present = observation.frequencies_hz.iter().map(Option::is_some);
    let frequencies_hz = nearest.zip(present).map(|(f, present)| f.filter(|_| present)).collect();
    Observation { frequencies_hz, ..observation.clone() }
}

/// Joins several batches, at least one, into one, and estimates the population behind all of them.
///
/// # Errors
/// [`InferenceError`] when further samples cannot be drawn.
pub(super) fn joined(
    baseline: &Baseline,
    parts: Vec<BatchSamples>,
    draws: Draws,
) -> Result<BatchSamples, InferenceError> {
    // The number of samples drawn differs between batches.
    let least = parts.iter().map(|part| part.posterior.draws()).min().unwrap_or(1);
    let cut: Vec<PosteriorSamples> = parts.iter().map(|part| part.posterior.first(least)).collect();
    let all: Vec<_> = cut.iter().flat_map(|part| part.theta().row_iter()).collect();
    let posterior = PosteriorSamples::new(DMatrix::from_rows(&all), least);
    let mut parts = parts.into_iter();
    let mut first = parts.next().expect("the caller has batches");
    for part in parts {
        first.observations.extend(part.observations);
        first.asked.extend(part.asked);
    }
    let (posterior, populations) =
        population_behind(baseline, posterior, &first.asked, None, draws.most(), draws.seed)?;
    Ok(BatchSamples { posterior, populations, ..first })
}

fn rows(matrix: &DMatrix<f64>) -> Vec<Vec<f64>> {
    matrix.row_iter().map(|row| row.iter().copied().collect()).collect()
}
