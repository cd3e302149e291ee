//! The assessment of one batch: its samples, its findings, and its comparison with the undamaged reference.

use super::batch_mean::{is_computed, Coordinates, Healthy};
use super::conditions::{compare_conditions, possible};
use super::dependence;
use super::estimate::{ProcessQuantities, SampledBatch};
use super::misfit;
use super::quantities::{joint_samples, monitored_quantities};
use super::result::Assessment;
use super::samples::{draw, BatchSamples, Context, Draws, Error};
use crate::baseline::observation::Observation;
use crate::baseline::Baseline;
use crate::damage::{self, QuantityKind, QuantitySamples, UndamagedReference};
use crate::posterior::PosteriorSamples;
use crate::process::estimate::BatchEstimate;
use crate::trust::{standing_findings, Finding, FindingCode, FindingEffect, Trust};
use structures::measurement::ModalMeasurement;
use structures::parameter::in_words;
use structures::quantity::Timestamp;
use structures::stats;

/// Share of samples at the prior bounds, or in regions where a table has no runs, above which a finding warns the reader.
const MUCH_MASS: f64 = 0.05;

/// Assesses the measurements of one batch; `assessed_at` is the time that is stored in the assessment.
///
/// # Errors
/// [`Error`], see its variants.
pub fn assess(
    baseline: &Baseline,
    measurements: &[ModalMeasurement],
    context: Context<'_>,
    draws: Draws,
    assessed_at: Timestamp,
) -> Result<Assessment, Error> {
    let mut samples = draw(baseline, measurements, context, draws)?;
    let mut findings = std::mem::take(&mut samples.findings);
    let (measurements, _) = possible(measurements, baseline.simulator().covariates());
    let measurements = &*measurements;
    if let Some(undamaged) = context.undamaged {
        findings.extend(compare_conditions(
            measurements,
            &undamaged.conditions,
            undamaged.process.as_ref().map(|process| &process.process),
            baseline.simulator().covariates(),
        ));
    }
    findings.extend(standing_findings(baseline));
    let mut sampled = monitored_quantities(baseline, &samples, draws.per_measurement);
    findings.extend(prior_edges(baseline, &samples, &sampled));
    let of_reference = context.undamaged.and_then(|undamaged| undamaged.process.as_deref());
    let (basis, usual_ln) = of_reference.map_or((None, &[][..]), |own| (own.misfit.as_ref(), &own.usual_ln));
    let process = ProcessQuantities::of(baseline, basis);
    let not_informed = process.not_informed(&sampled);
    findings.extend(not_informed.iter().map(|name| not_informed_finding(name)));
    findings.extend(beyond_runs(baseline, &samples.posterior, &samples.asked));
    let batch = SampledBatch { measurements, samples: &samples, quantities: &sampled };
    let estimated = context.undamaged.and_then(|undamaged| estimate_about(baseline, &process, undamaged, &batch));
    let (estimate, shown) = estimated.map_or((None, None), |(estimate, shown)| (Some(estimate), shown));
    if let Some(own) = of_reference {
        if !samples.fit.rejected_beside(own.usual_misfit) {
            accept_misfit(
                &mut findings,
                "the batches of the undamaged reference deviate as much, so that the batch is accepted",
            );
        } else if shown.is_some_and(|shown| misfit::is_judged(&shown, own, &samples.fit)) {
            accept_misfit(
                &mut findings,
                "what the frequencies show beside the simulation is compared with the undamaged reference",
            );
        }
    }
    // After the estimate: a process has its own account of how measurements follow one another.
    findings.extend(dependence::within_batch(&mut sampled, measurements, context.undamaged));
    let mut trust = Trust::new(&samples.fit, findings);
    trust.effective_measurements = dependence::fewest(&sampled, &[samples.observations.len()]);
    // Where the simulation does not fit the data, its parameters say nothing about damage.
    let compared = context.undamaged.filter(|_| trust.accepted());
    let mut quantities = damage::assess(&sampled, compared);
    for quantity in quantities.iter_mut().filter(|q| not_informed.contains(&q.name)) {
        quantity.damage = None;
    }
    // A quantity that is not informed has no part in a joint probability either.
    let compared = compared.filter(|_| not_informed.is_empty());
    let joint = joint_samples(baseline, &samples).filter(|_| trust.accepted());
    let joint = joint.map(|joint| damage::assess_jointly(&sampled, &joint, compared));
    Ok(Assessment {
        model_digest: baseline.digest().clone(),
        structure_digest: baseline.simulator().digest().clone(),
        undamaged_version: context.undamaged.map(|undamaged| undamaged.version),
        seed: draws.seed,
        draws_per_measurement: draws.per_measurement,
        measurements_used: samples.observations.len(),
        measurements_left_out: samples.left_out,
        measurements_outside: samples.fit.outside.len(),
        effective_sample_size: samples.populations.effective_sample_size,
        misfit_percent: misfit_percent(baseline, &samples, usual_ln)?,
        trust,
        assessed_at,
        quantities,
        estimate,
        joint,
    })
}

/// Findings about parameters of which many samples lie at the bounds or in the tails of their prior, unless they were sought beyond it.
fn prior_edges(baseline: &Baseline, samples: &BatchSamples, sampled: &[QuantitySamples]) -> Vec<Finding> {
    let beyond = samples.beyond.as_ref().map_or(&[][..], |(_, names)| names.as_slice());
    let at_bound = |s: &&QuantitySamples| {
        s.kind == QuantityKind::Parameter && s.prior_bound_mass > MUCH_MASS && !beyond.contains(&s.name)
    };
    let finding = |sample: &QuantitySamples| {
        let tails = baseline.space().iter().any(|p| p.name == sample.name && !p.is_uniform());
        let place = if tails {
            "lie beyond three standard deviations of its prior, which pulls them towards its middle"
        } else {
            "lie at the bounds of its prior"
        };
        let share = 100.0 * sample.prior_bound_mass;
        let message = format!("{share:.0} % of the posterior samples of {} {place}: widen the prior", sample.name);
        Finding::new(FindingCode::PriorEdge, FindingEffect::Note, message)
    };
    sampled.iter().filter(at_bound).map(finding).collect()
}

/// The estimate of a batch about its reference; `None` where the reference has no process and the estimate is that of the samples, from which
/// the charts of such a reference compute their own errors.
fn estimate_about(
    baseline: &Baseline,
    process: &ProcessQuantities,
    undamaged: &UndamagedReference,
    batch: &SampledBatch<'_>,
) -> Option<(BatchEstimate, Option<Coordinates>)> {
    let covariates = undamaged.process.as_ref().map(|p| p.process.covariates.as_slice());
    if covariates.is_none() && !is_computed(baseline, &batch.samples.asked) {
        return None;
    }
    let healthy = Healthy::of_reference(baseline, undamaged);
    process.estimate(baseline, batch, covariates.unwrap_or_default(), healthy.as_ref())
}

/// Accepts the misfit of a batch for a reason, unless a mistake is suspected behind it.
fn accept_misfit(findings: &mut [Finding], reason: &str) {
    let is_misfit = |own: &Finding| own.code == FindingCode::SimulationDoesNotFit;
    for finding in findings.iter_mut().filter(|own| is_misfit(own) && own.effect == FindingEffect::Reject) {
        finding.effect = FindingEffect::Note;
        finding.message.push_str("; ");
        finding.message.push_str(reason);
    }
}

/// The finding about a quantity that the measurements of a batch hardly inform.
fn not_informed_finding(name: &str) -> Finding {
    let message = format!(
        "the measurements say hardly more about {} than its prior, mostly because modes are missing: it has no probability of damage \
         and no point on its chart",
        in_words(name)
    );
    Finding::new(FindingCode::NotInformed, FindingEffect::Note, message)
}

/// A finding when much of the posterior lies where the table behind an emulator has no runs.
fn beyond_runs(baseline: &Baseline, posterior: &PosteriorSamples, asked: &[Observation]) -> Option<Finding> {
    let simulator = baseline.simulator();
    simulator.table()?;
    let theta = posterior.theta();
    let outside = |row: &usize| {
        let simulator = asked[row / posterior.draws()].simulator(simulator);
        simulator.is_extrapolated(&theta.row(*row).iter().copied().collect::<Vec<_>>())
    };
    let share = (0..theta.nrows()).filter(outside).count() as f64 / theta.nrows() as f64;
    (share > MUCH_MASS).then(|| {
        let message = format!(
            "{:.0} % of the posterior samples lie where the table has no runs, so that the emulator extrapolates: add runs there",
            100.0 * share
        );
        Finding::new(FindingCode::BeyondRuns, FindingEffect::Note, message)
    })
}

/// The part of each measured mean frequency that the simulation cannot reproduce, per cent, `[modes]`; `None` for a mode that no
/// measurement has.
///
/// ```text
///  100 · (mean measured f_i − f_i(x̄)) / mean measured f_i,    x̄ the mean of all posterior samples
/// ```
///
/// `usual_ln`: the usual misfit of the reference, which has been taken out of the samples' observations.
///
/// Only one simulation is run for each batch, so that structures with hundreds of degrees of freedom stay fast. The curvature of f
/// over the spread of x adds about (σ/x)²/8, which is below 0.1 % for a spread of 8 %.
fn misfit_percent(baseline: &Baseline, samples: &BatchSamples, usual_ln: &[f64]) -> Result<Vec<Option<f64>>, Error> {
    let theta: Vec<f64> = samples.posterior.theta().row_mean().iter().copied().collect();
    // The simulation is evaluated at the mean sizes of the effects.
    let count = samples.observations.len() as f64;
    let known: Vec<&Vec<f64>> =
        samples.observations.iter().map(|o| &o.effect_sizes).filter(|s| !s.is_empty()).collect();
    let sizes: Vec<f64> =
        (0..known.first().map_or(0, |s| s.len())).map(|i| known.iter().map(|s| s[i]).sum::<f64>() / count).collect();
    let simulated = baseline.simulator().under(&sizes).frequencies_hz(&theta)?;
    let misfit = |(mode, simulated): (usize, f64)| {
        let measured: Vec<f64> = samples.observations.iter().filter_map(|o| o.frequencies_hz[mode]).collect();
        let usual = usual_ln.get(mode).map_or(1.0, |ln| ln.exp());
        (!measured.is_empty()).then(|| 100.0 * (1.0 - simulated / (usual * stats::mean(&measured))))
    };
    Ok(simulated.into_iter().enumerate().map(misfit).collect())
}
