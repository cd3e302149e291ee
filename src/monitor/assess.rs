//! From the measurements of a batch to its assessment: pure, so that service and command line agree to the bit.

use std::collections::BTreeMap;

use rand::RngCore as _;

use crate::assessment::Assessment;
use crate::baseline::observation::Observation;
use crate::baseline::{Baseline, InferenceError};
use crate::damage::{self, QuantityKind, QuantitySamples, SeenCovariate, UndamagedState};
use crate::hierarchy::{estimate, populations, populations_of_each, proposals, PopulationEstimate, Populations};
use crate::measurement::{CovariateValue, ModalMeasurement};
use crate::parameter::DamageDirection;
use crate::posterior::PosteriorSamples;
use crate::quantity::{Hertz, Timestamp};
use crate::stats;
use crate::trust::{cause, fit, quality, standing_findings, Code, Effect, Finding, Trust};

/// Samples of each measurement near where its posterior meets the population, which the population is estimated from: the
/// logarithm of a mean of few weights is too low, and the more so the narrower the population, so that samples that lie far from
/// it make σ too large.
const NEAR_DRAWS: usize = 64;

/// The same where noise hides the population: few of them count there.
const NEAR_DRAWS_HIDDEN: usize = 128;

/// Share of the posterior samples for the population that tells where that is, unless noise hides it. Its samples repeat: a third
/// of 64 that do are as good a guide to nearer ones as a quarter that do not, for two thirds of the flow's work.
const FIRST_SHARE: usize = 3;

/// Noise hides it below this effective share of the posterior samples: there the moments of few samples of each measurement
/// are not good enough, and σ comes out too large.
const HIDDEN: f64 = 0.56;

/// The posterior samples themselves are taken where their effective share is so many times that of the nearer ones: those come
/// from normal distributions, and a posterior may be far from one.
const POSTERIOR_BETTER: f64 = 2.0;

/// Effective samples for each measurement below which the reader is warned.
const TOO_FEW_EFFECTIVE: f64 = 3.0;

/// Share of samples at a prior edge above which the prior is called too narrow.
const MUCH_EDGE_MASS: f64 = 0.05;

/// Why a batch was not assessed; the batch itself is kept.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// No measurement that this baseline can use.
    #[error(
        "none of {measurements} measurements can be used: each lacks a mode that this baseline needs, or states more noise \
         than it was trained for"
    )]
    NoUsableMeasurement {
        /// Measurements of the batch.
        measurements: usize,
    },
    /// The flow failed: a bug or a damaged baseline.
    #[error(transparent)]
    Inference(#[from] InferenceError),
    /// The simulation failed inside the prior: a bug, since the prior box was checked.
    #[error("the simulation failed inside the prior: {0}")]
    Simulation(#[from] crate::physics::Error),
    /// The search for the cause of a misfit failed.
    #[error(transparent)]
    Cause(#[from] cause::Error),
}

/// How a batch is drawn from.
#[derive(Debug, Clone, Copy)]
pub struct Draws {
    /// Posterior samples of each measurement in the pool (paper).
    pub per_measurement: usize,
    /// Posterior samples of each measurement for the population behind the batch.
    pub for_population: usize,
    /// Seed of the latent draws.
    pub seed: u64,
}

/// What a batch is compared with, and what came before it.
#[derive(Debug, Clone, Copy, Default)]
pub struct Context<'a> {
    /// The undamaged state.
    pub undamaged: Option<&'a UndamagedState>,
    /// Frequencies of the measurement before the batch, of the same source.
    pub previous: Option<&'a [Option<Hertz>]>,
}

/// Posterior samples of the measurements of a batch, and what was found on the way.
#[derive(Debug)]
pub struct BatchSamples {
    /// Samples of the parameters.
    pub posterior: PosteriorSamples,
    /// The population behind them.
    pub populations: Populations,
    /// What the flow was asked: the measurements used, those beyond the prior as its nearest point.
    pub asked: Vec<Observation>,
    /// The measurements used.
    pub observations: Vec<Observation>,
    /// How well the simulation reproduces the measurements that could be asked about.
    pub fit: fit::Fit,
    /// What was found.
    pub findings: Vec<Finding>,
    /// Measurements left out.
    pub left_out: usize,
}

/// Draws from the posterior of each measurement and estimates the population behind them.
///
/// # Errors
/// [`Error`], see its variants.
pub fn draw(
    baseline: &Baseline,
    measurements: &[ModalMeasurement],
    previous: Option<&[Option<Hertz>]>,
    draws: Draws,
) -> Result<BatchSamples, Error> {
    let quality::Inspection { kept, mut findings } = quality::inspect(measurements, previous);
    let (indices, observations) = admit(baseline, &kept, &mut findings);
    if observations.is_empty() {
        return Err(Error::NoUsableMeasurement { measurements: measurements.len() });
    }
    let all = draws.for_population.max(draws.per_measurement);
    // A single measurement and a population of each parameter by itself take all as they are.
    let staged = observations.len() > 1 && !baseline.starts_at_fit();
    let first = if staged { draws.per_measurement.max(draws.for_population / FIRST_SHARE) } else { all };
    let infer = |observations: &[Observation]| {
        if staged {
            baseline.infer_with_repeats(observations, first, draws.seed)
        } else {
            baseline.infer(observations, first, draws.seed)
        }
    };
    let posterior = infer(&observations)?;
    let starts = rows(&posterior.means());
    let fit = fit::fit(baseline.simulator(), &observations, &starts)?;
    findings.extend(fit.findings(baseline.simulator(), &indices));
    if fit.rejected() {
        findings.extend(cause::suspect(baseline, &observations, draws.seed)?);
    }
    // A flow has seen nothing beyond its box: asked about it, it answers at random, in all parameters. The nearest point
    // keeps the parameters that do fit and puts the others at the edge. Gross outliers are left out, unless nothing else
    // is there.
    let leave_out = fit.gross.len() < observations.len();
    let asked: Vec<Observation> = (0..observations.len())
        .filter(|row| !(leave_out && fit.gross.contains(row)))
        .map(|row| {
            if fit.outside.contains(&row) || fit.gross.contains(&row) {
                let nearest = fit.nearest[row].frequencies_hz.iter().copied().map(Some);
                let there = observations[row].frequencies_hz.iter().map(Option::is_some);
                let frequencies_hz = nearest.zip(there).map(|(f, there)| f.filter(|_| there)).collect();
                Observation { frequencies_hz, ..observations[row].clone() }
            } else {
                observations[row].clone()
            }
        })
        .collect();
    let posterior = if fit.outside.is_empty() && fit.gross.is_empty() { posterior } else { infer(&asked)? };
    let (posterior, population) = population_behind(baseline, posterior, &asked, all, draws.seed)?;
    if population.effective_sample_size < TOO_FEW_EFFECTIVE && posterior.measurements() > 1 {
        let message = format!(
            "only {:.1} effective samples a measurement stand behind the hyperparameters: the noise drowns the spread; \
             read them as rough",
            population.effective_sample_size
        );
        findings.push(Finding::new(Code::FewEffectiveSamples, Effect::Note, message));
    }
    let left_out = measurements.len() - asked.len();
    let used = if leave_out {
        (0..observations.len()).filter(|row| !fit.gross.contains(row)).map(|row| observations[row].clone()).collect()
    } else {
        observations
    };
    Ok(BatchSamples { posterior, populations: population, asked, observations: used, fit, findings, left_out })
}

/// The population behind posterior samples: from samples nearer to it, weighed by their posterior density, or from `draws` of
/// each posterior where those serve better, which are returned then.
fn population_behind(
    baseline: &Baseline,
    posterior: PosteriorSamples,
    observations: &[Observation],
    draws: usize,
    seed: u64,
) -> Result<(PosteriorSamples, Populations), InferenceError> {
    let space = baseline.space();
    if posterior.measurements() < 2 {
        let mut one = populations(&posterior, None, space, seed);
        for (column, estimate) in one.parameters.iter_mut().enumerate() {
            conform(baseline, column, &observations[0], &mut estimate.mean_draws);
        }
        return Ok((posterior, one));
    }
    if baseline.starts_at_fit() {
        let populations = populations_of_each(&posterior, space, seed);
        return Ok((posterior, populations));
    }
    let complete = |posterior: PosteriorSamples| match draws.saturating_sub(posterior.draws()) {
        0 => Ok(posterior),
        missing => {
            let further = stats::stream(seed, "further draws").next_u64();
            baseline.infer(observations, missing, further).map(|samples| posterior.joined(&samples))
        }
    };
    let share = |populations: &Populations, draws: usize| populations.effective_sample_size / draws as f64;
    let mut found = estimate(&posterior, None, space);
    let mut posterior = posterior;
    let mut near_draws = NEAR_DRAWS;
    if share(&found, posterior.draws()) < HIDDEN {
        posterior = complete(posterior)?;
        found = estimate(&posterior, None, space);
        near_draws = NEAR_DRAWS_HIDDEN;
    }
    let (samples, log_density) = proposals(&posterior, &found, space, near_draws, seed);
    let log_posterior = baseline.log_posterior_of_draws(samples.theta(), observations)?;
    let log_weights: Vec<f64> = log_posterior.iter().zip(&log_density).map(|(q, r)| q - r).collect();
    let near = populations(&samples, Some(&log_weights), space, seed);
    if share(&found, posterior.draws()) <= POSTERIOR_BETTER * share(&near, near_draws) {
        return Ok((posterior, near));
    }
    let posterior = complete(posterior)?;
    let populations = populations(&posterior, None, space, seed);
    Ok((posterior, populations))
}

/// Stretches the draws of one measurement about their median by the factor that gave 90 % intervals their coverage in the
/// calibration (conformal), within the prior.
fn conform(baseline: &Baseline, column: usize, observation: &Observation, draws: &mut [f64]) {
    let modes = observation.modes_present();
    let present = observation.frequencies_hz.iter().zip(&observation.noise_multiple).filter(|(f, _)| f.is_some());
    let noise = (present.map(|(_, multiple)| multiple.ln()).sum::<f64>() / modes as f64).exp();
    let complete = modes == baseline.simulator().modes();
    let scale = baseline.manifest().calibration.interval_scale(column, noise, complete, observation.has_shapes());
    let (median, prior) = (stats::quantile(draws, 0.5), &baseline.space().as_slice()[column]);
    for draw in draws {
        *draw = (median + scale * (*draw - median)).clamp(prior.lower, prior.upper);
    }
}

/// Why batches make no undamaged state; `batch` is the index of the one to blame.
#[derive(Debug, thiserror::Error)]
pub enum UndamagedError {
    /// A batch could not be used at all.
    #[error("batch {batch}: {source}")]
    Assess {
        /// The batch.
        batch: usize,
        /// The cause.
        source: Error,
    },
    /// A batch is not to be trusted.
    #[error("batch {batch} cannot be part of an undamaged state: {reason}")]
    Untrusted {
        /// The batch.
        batch: usize,
        /// What was found in it.
        reason: String,
    },
    /// Together they make none.
    #[error(transparent)]
    State(#[from] damage::Error),
}

/// The undamaged state of several batches, each with its draws.
///
/// # Errors
/// [`UndamagedError`].
pub fn undamaged_state(
    baseline: &Baseline,
    batches: &[(&[ModalMeasurement], Draws)],
    threshold_probability: f64,
) -> Result<UndamagedState, UndamagedError> {
    let (mut parts, mut sizes) = (Vec::new(), Vec::new());
    for (batch, (measurements, draws)) in batches.iter().enumerate() {
        let samples =
            draw(baseline, measurements, None, *draws).map_err(|source| UndamagedError::Assess { batch, source })?;
        let trust = Trust::new(&samples.fit, samples.findings.clone());
        // What cannot be trusted must not become the measure of everything after it.
        if let Some(finding) = trust.findings.iter().find(|f| f.effect != Effect::Note) {
            return Err(UndamagedError::Untrusted { batch, reason: finding.message.clone() });
        }
        sizes.push(samples.posterior.measurements());
        parts.push(samples);
    }
    let Some((_, draws)) = batches.first() else {
        let too_few = damage::Error::TooFewMeasurements { measurements: 0, least: damage::MINIMUM_MEASUREMENTS };
        return Err(too_few.into());
    };
    let samples = joined(baseline, parts, *draws).map_err(|e| UndamagedError::Assess { batch: 0, source: e.into() })?;
    let quantities = monitored_quantities(baseline, &samples, draws.per_measurement);
    let mut state = UndamagedState::from_samples(&quantities, &sizes, threshold_probability)?;
    state.conditions = conditions(batches.iter().flat_map(|(measurements, _)| *measurements));
    Ok(state)
}

/// Several batches as one, with the population behind all of them; at least one.
fn joined(baseline: &Baseline, parts: Vec<BatchSamples>, draws: Draws) -> Result<BatchSamples, InferenceError> {
    // Of some batches more samples were drawn than of others.
    let least = parts.iter().map(|part| part.posterior.draws()).min().unwrap_or(1);
    let cut: Vec<PosteriorSamples> = parts.iter().map(|part| part.posterior.first(least)).collect();
    let all: Vec<_> = cut.iter().flat_map(|part| part.theta().row_iter()).collect();
    let posterior = PosteriorSamples::new(nalgebra::DMatrix::from_rows(&all), least);
    let mut parts = parts.into_iter();
    let mut first = parts.next().expect("the caller has batches");
    for part in parts {
        first.observations.extend(part.observations);
        first.asked.extend(part.asked);
    }
    let wanted = draws.for_population.max(draws.per_measurement);
    let (posterior, populations) = population_behind(baseline, posterior, &first.asked, wanted, draws.seed)?;
    Ok(BatchSamples { posterior, populations, ..first })
}

/// The measurements as the flow is asked about them, and their index in the batch.
fn admit(
    baseline: &Baseline,
    kept: &[(usize, ModalMeasurement)],
    findings: &mut Vec<Finding>,
) -> (Vec<usize>, Vec<Observation>) {
    let (mut indices, mut observations) = (Vec::new(), Vec::new());
    let (mut below, mut above, mut unusable) = (Vec::new(), Vec::new(), Vec::new());
    let (mut blind, mut beyond) = (BTreeMap::<String, Vec<usize>>::new(), BTreeMap::<String, Vec<usize>>::new());
    for (index, measurement) in kept {
        let admitted = baseline.admit(measurement);
        if admitted.below_range {
            below.push(*index);
        }
        if admitted.above_range {
            above.push(*index);
        }
        for (names, found) in [(&admitted.covariates_missing, &mut blind), (&admitted.covariates_beyond, &mut beyond)] {
            for name in names {
                found.entry(name.clone()).or_default().push(*index);
            }
        }
        match admitted.observation {
            Some(observation) => {
                indices.push(*index);
                observations.push(observation);
            }
            None => unusable.push(*index),
        }
    }
    for (name, rows) in blind {
        let message = format!(
            "{} measurements lack {name}, which the simulation depends on: they are taken at all values it was learnt from, and \
             the answer is wider for it",
            rows.len()
        );
        findings.push(Finding::new(Code::CovariateMissing, Effect::HoldAlarm, message).of(rows));
    }
    for (name, rows) in beyond {
        let message = format!(
            "{} measurements have a {name} beyond the range that its effect was learnt from: they count as its end",
            rows.len()
        );
        findings.push(Finding::new(Code::Extrapolated, Effect::HoldAlarm, message).of(rows));
    }
    let range = baseline.manifest().conditions.noise_range.map_or([0.0; 2], |r| [r.lowest, r.highest]);
    if !below.is_empty() {
        let message = format!(
            "{} measurements state less noise than {} times the structure's, the least this baseline was trained for: they \
             count as that",
            below.len(),
            range[0]
        );
        findings.push(Finding::new(Code::NoiseBelowRange, Effect::Note, message).of(below));
    }
    if !above.is_empty() {
        let message = format!(
            "{} measurements have modes with more noise than {} times the structure's, the most this baseline was trained \
             for: those modes are left out",
            above.len(),
            range[1]
        );
        findings.push(Finding::new(Code::NoiseAboveRange, Effect::Note, message).of(above));
    }
    if !unusable.is_empty() {
        let message = format!(
            "{} measurements are left out: they lack a mode that this baseline needs, or have no mode within its noise range",
            unusable.len()
        );
        findings.push(Finding::new(Code::NotUsable, Effect::Note, message).of(unusable));
    }
    (indices, observations)
}

/// Samples of everything that is monitored: each parameter, the stiffness of each spring set through a law, and the mean
/// of parameters that cannot be told apart.
pub fn monitored_quantities(
    baseline: &Baseline,
    samples: &BatchSamples,
    per_measurement: usize,
) -> Vec<QuantitySamples> {
    let pooled = samples.posterior.first(per_measurement.min(samples.posterior.draws()));
    let edge_mass = samples.posterior.prior_bound_mass(baseline.space());
    let population = |column: usize| &samples.populations.parameters[column];
    let groups = baseline.groups();
    let group_of = |column: usize| groups.iter().find(|g| g.columns.contains(&column)).map(|g| g.name.clone());
    let parameters = baseline.space().iter().enumerate().map(|(column, parameter)| QuantitySamples {
        name: parameter.name.clone(),
        unit: parameter.unit.clone(),
        kind: QuantityKind::Parameter,
        damage: parameter.damage,
        pool: pooled.column(column),
        draws: pooled.draws(),
        population: population(column).clone(),
        edge_mass: edge_mass[column],
        group: group_of(column),
    });
    let springs = baseline.simulator().derived_stiffnesses().into_iter().map(|spring| {
        let parameter = &baseline.space().as_slice()[spring.parameter];
        let watched = parameter.damage != DamageDirection::None;
        QuantitySamples {
            pool: pooled.column(spring.parameter).into_iter().map(|p| spring.value(p)).collect(),
            population: population(spring.parameter).through(|p| spring.value(p)),
            unit: "N/m".to_owned(),
            kind: QuantityKind::SpringStiffness,
            damage: if watched { DamageDirection::Decrease } else { DamageDirection::None },
            draws: pooled.draws(),
            edge_mass: edge_mass[spring.parameter],
            group: group_of(spring.parameter),
            name: spring.name,
        }
    });
    let of_groups = groups.iter().map(|group| {
        let members: Vec<Vec<f64>> = group.columns.iter().map(|&column| pooled.column(column)).collect();
        let parts: Vec<&PopulationEstimate> = group.columns.iter().map(|&column| population(column)).collect();
        let parameter = &baseline.space().as_slice()[group.columns[0]];
        QuantitySamples {
            name: group.name.clone(),
            unit: parameter.unit.clone(),
            kind: QuantityKind::Group,
            damage: parameter.damage,
            pool: (0..members[0].len())
                .map(|i| members.iter().map(|m| m[i]).sum::<f64>() / members.len() as f64)
                .collect(),
            draws: pooled.draws(),
            population: PopulationEstimate::average(&parts),
            edge_mass: group.columns.iter().map(|&column| edge_mass[column]).fold(0.0, f64::max),
            group: None,
        }
    });
    parameters.chain(springs).chain(of_groups).collect()
}

/// Assesses the measurements of one batch.
///
/// # Errors
/// [`Error`], see its variants.
pub fn assess(
    baseline: &Baseline,
    measurements: &[ModalMeasurement],
    context: Context<'_>,
    draws: Draws,
) -> Result<Assessment, Error> {
    let mut samples = draw(baseline, measurements, context.previous, draws)?;
    let mut findings = std::mem::take(&mut samples.findings);
    if let Some(state) = context.undamaged {
        findings.extend(compare_conditions(measurements, &state.conditions));
    }
    findings.extend(standing_findings(baseline));
    let sampled = monitored_quantities(baseline, &samples, draws.per_measurement);
    for sample in sampled.iter().filter(|s| s.kind == QuantityKind::Parameter && s.edge_mass > MUCH_EDGE_MASS) {
        let message = format!(
            "{:.0} % of the samples of {} lie at an edge of its prior: widen it",
            100.0 * sample.edge_mass,
            sample.name
        );
        findings.push(Finding::new(Code::PriorEdge, Effect::Note, message));
    }
    findings.extend(beyond_runs(baseline, &samples.posterior, &samples.asked));
    let trust = Trust::new(&samples.fit, findings);
    // Nothing is said of damage where the simulation does not hold.
    let compared = context.undamaged.filter(|_| trust.accepted());
    Ok(Assessment {
        model_digest: baseline.digest().clone(),
        structure_digest: baseline.simulator().digest().clone(),
        undamaged_version: context.undamaged.map(|state| state.version),
        seed: draws.seed,
        draws_per_measurement: draws.per_measurement,
        measurements_used: samples.observations.len(),
        measurements_left_out: samples.left_out,
        measurements_outside: samples.fit.outside.len(),
        effective_sample_size: samples.populations.effective_sample_size,
        misfit_percent: misfit_percent(baseline, &samples)?,
        trust,
        assessed_at: Timestamp::now(),
        quantities: damage::assess(&sampled, compared),
    })
}

/// Whether much of the posterior lies where the table behind an emulator has no runs.
fn beyond_runs(baseline: &Baseline, posterior: &PosteriorSamples, asked: &[Observation]) -> Option<Finding> {
    let simulator = baseline.simulator();
    simulator.table()?;
    let theta = posterior.theta();
    let outside = |row: &usize| {
        let simulator = asked[row / posterior.draws()].simulator(simulator);
        simulator.is_extrapolated(&theta.row(*row).iter().copied().collect::<Vec<_>>())
    };
    let share = (0..theta.nrows()).filter(outside).count() as f64 / theta.nrows() as f64;
    (share > MUCH_EDGE_MASS).then(|| {
        let message = format!(
            "{:.0} % of the samples lie where the table of runs has none: the emulator extrapolates; add runs there",
            100.0 * share
        );
        Finding::new(Code::BeyondRuns, Effect::Note, message)
    })
}

/// Covariates of the batch against those the undamaged state saw.
fn compare_conditions(
    measurements: &[ModalMeasurement],
    seen: &BTreeMap<String, SeenCovariate>,
) -> impl Iterator<Item = Finding> {
    let (mut outside, mut missing) = (Vec::new(), Vec::new());
    for (name, seen) in seen {
        let mut strange: Option<String> = None;
        let mut rows = Vec::new();
        let mut lacking = 0;
        for (index, measurement) in measurements.iter().enumerate() {
            let odd = match (measurement.covariates.get(name), seen) {
                (None, _) => {
                    lacking += 1;
                    None
                }
                (Some(CovariateValue::Number(x)), SeenCovariate::Range([low, high])) => {
                    (!(low..=high).contains(&x)).then(|| format!("{name} = {x}, seen {low} to {high}"))
                }
                (Some(CovariateValue::Category(c)), SeenCovariate::Categories(all)) => (!all.contains(c))
                    .then(|| format!("{name} = {c}, seen {}", all.iter().cloned().collect::<Vec<_>>().join(", "))),
                _ => None,
            };
            if let Some(odd) = odd {
                rows.push(index);
                strange.get_or_insert(odd);
            }
        }
        if let Some(example) = strange {
            let message = format!(
                "outside what the undamaged state saw ({example}): a change may come from there, so no alarm follows from this batch"
            );
            outside.push(Finding::new(Code::Extrapolated, Effect::HoldAlarm, message).of(rows));
        }
        if lacking > 0 {
            let message = format!(
                "{lacking} measurements lack {name}, which the undamaged state has: no alarm follows from this batch"
            );
            missing.push(Finding::new(Code::CovariateMissing, Effect::HoldAlarm, message));
        }
    }
    outside.into_iter().chain(missing)
}

/// The covariates under which measurements were taken.
fn conditions<'a>(measurements: impl Iterator<Item = &'a ModalMeasurement>) -> BTreeMap<String, SeenCovariate> {
    let mut seen = BTreeMap::<String, SeenCovariate>::new();
    for (name, value) in measurements.flat_map(|m| &m.covariates) {
        match value {
            CovariateValue::Number(x) => {
                let entry = seen.entry(name.clone()).or_insert(SeenCovariate::Range([*x, *x]));
                if let SeenCovariate::Range([low, high]) = entry {
                    (*low, *high) = (low.min(*x), high.max(*x));
                }
            }
            CovariateValue::Category(c) => {
                let entry = seen.entry(name.clone()).or_insert_with(|| SeenCovariate::Categories([c.clone()].into()));
                if let SeenCovariate::Categories(all) = entry {
                    all.insert(c.clone());
                }
            }
        }
    }
    seen
}

fn rows(matrix: &nalgebra::DMatrix<f64>) -> Vec<Vec<f64>> {
    matrix.row_iter().map(|row| row.iter().copied().collect()).collect()
}

/// What the simulation cannot reproduce, for each mode, in per cent of the measured frequency; `None` for a mode that no
/// measurement has.
///
/// ```text
///  100 · (mean measured f_i − f_i(x̄)) / mean measured f_i,    x̄ the mean of all posterior samples
/// ```
///
/// One simulation a batch, so that structures of hundreds of degrees of freedom stay fast; the curvature of f over the
/// spread of x adds some (σ/x)²/8, below 0.1 % for a spread of 8 %.
fn misfit_percent(baseline: &Baseline, samples: &BatchSamples) -> Result<Vec<Option<f64>>, Error> {
    let theta: Vec<f64> = samples.posterior.theta().row_mean().iter().copied().collect();
    // Under the mean of the effects' sizes.
    let count = samples.observations.len() as f64;
    let known: Vec<&Vec<f64>> =
        samples.observations.iter().map(|o| &o.effect_sizes).filter(|s| !s.is_empty()).collect();
    let sizes: Vec<f64> =
        (0..known.first().map_or(0, |s| s.len())).map(|i| known.iter().map(|s| s[i]).sum::<f64>() / count).collect();
    let simulated = baseline.simulator().under(&sizes).frequencies_hz(&theta)?;
    let misfit = |(mode, simulated): (usize, f64)| {
        let measured: Vec<f64> = samples.observations.iter().filter_map(|o| o.frequencies_hz[mode]).collect();
        (!measured.is_empty()).then(|| 100.0 * (1.0 - simulated / stats::mean(&measured)))
    };
    Ok(simulated.into_iter().enumerate().map(misfit).collect())
}
