//! From the measurements of a batch to its assessment: pure, so that service and command line agree to the bit.

use rayon::prelude::*;

use crate::assessment::Assessment;
use crate::baseline::reach::{reach, Reach};
use crate::baseline::{Baseline, InferenceError};
use crate::damage::{self, QuantityKind, QuantitySamples, UndamagedState};
use crate::measurement::ModalMeasurement;
use crate::parameter::DamageDirection;
use crate::posterior::PosteriorSamples;
use crate::quantity::Timestamp;
use crate::stats;

/// Why a batch was not assessed; the batch itself is kept.
#[derive(Debug, thiserror::Error)]
pub enum Error {
    /// No measurement with all modes.
    #[error("all {measurements} measurements lack a mode: this baseline was trained on complete measurements")]
    NoCompleteMeasurement {
        /// Measurements of the batch.
        measurements: usize,
    },
    /// The flow failed: a bug or a damaged baseline.
    #[error(transparent)]
    Inference(#[from] InferenceError),
    /// The simulation failed at the posterior mean: a bug, since the prior box was checked.
    #[error("the simulation failed at the posterior mean: {0}")]
    Simulation(#[from] crate::physics::Error),
}

/// How a batch is drawn from.
#[derive(Debug, Clone, Copy)]
pub struct Draws {
    /// Posterior samples for each measurement.
    pub per_measurement: usize,
    /// Seed of the latent draws.
    pub seed: u64,
}

/// Posterior samples of the measurements that have all modes.
#[derive(Debug)]
pub struct BatchSamples {
    /// Samples of the parameters.
    pub posterior: PosteriorSamples,
    /// Frequencies of the measurements used, Hz, complete rows.
    pub frequencies_hz: Vec<Vec<f64>>,
    /// Measurements left out because a mode is missing.
    pub left_out: usize,
    /// Measurements that no point of the prior box gives; they are drawn from as their nearest point.
    pub outside: usize,
}

/// Draws from the posterior of each complete measurement.
///
/// # Errors
/// [`Error::NoCompleteMeasurement`] when each lacks a mode; [`Error::Inference`].
pub fn draw(baseline: &Baseline, measurements: &[ModalMeasurement], draws: Draws) -> Result<BatchSamples, Error> {
    let frequencies_hz: Vec<Vec<f64>> = measurements.iter().filter_map(ModalMeasurement::complete_hz).collect();
    if frequencies_hz.is_empty() {
        return Err(Error::NoCompleteMeasurement { measurements: measurements.len() });
    }
    let left_out = measurements.len() - frequencies_hz.len();
    let posterior = baseline.infer(&frequencies_hz, draws.per_measurement, draws.seed)?;
    let nearest = nearest_points(baseline, &posterior, &frequencies_hz)?;
    let outside = nearest.iter().flatten().count();
    if outside == 0 {
        return Ok(BatchSamples { posterior, frequencies_hz, left_out, outside });
    }
    let given = |(nearest, measured): (Option<Vec<f64>>, &Vec<f64>)| nearest.unwrap_or_else(|| measured.clone());
    let condition: Vec<Vec<f64>> = nearest.into_iter().zip(&frequencies_hz).map(given).collect();
    let posterior = baseline.infer(&condition, draws.per_measurement, draws.seed)?;
    Ok(BatchSamples { posterior, frequencies_hz, left_out, outside })
}

/// For each measurement that the simulation cannot give inside the prior box, the frequencies that come nearest.
///
/// A flow has seen nothing beyond the box: asked about it, it answers at random, in all parameters. The nearest point
/// keeps the parameters that do fit and puts the others at the edge.
fn nearest_points(
    baseline: &Baseline,
    posterior: &PosteriorSamples,
    frequencies_hz: &[Vec<f64>],
) -> Result<Vec<Option<Vec<f64>>>, crate::physics::Error> {
    let means = posterior.means();
    let look = |(row, measured): (usize, &Vec<f64>)| {
        let start: Vec<f64> = means.row(row).iter().copied().collect();
        Ok(match reach(baseline.simulator(), measured, &start)? {
            Reach::Inside => None,
            Reach::Outside { nearest_hz } => Some(nearest_hz),
        })
    };
    frequencies_hz.par_iter().enumerate().map(look).collect()
}

/// Samples of everything that is monitored: each parameter, and the stiffness of each spring set through a law.
pub fn monitored_quantities(baseline: &Baseline, posterior: &PosteriorSamples) -> Vec<QuantitySamples> {
    let edge_mass = posterior.edge_mass(baseline.space());
    let parameters = baseline.space().iter().enumerate().map(|(column, parameter)| QuantitySamples {
        name: parameter.name.clone(),
        unit: parameter.unit.clone(),
        kind: QuantityKind::Parameter,
        damage: parameter.damage,
        pool: posterior.column(column),
        draws: posterior.draws(),
        edge_mass: edge_mass[column],
    });
    let springs = baseline.simulator().derived_stiffnesses().into_iter().map(|spring| {
        let parameter = &baseline.space().as_slice()[spring.parameter];
        let watched = parameter.damage != DamageDirection::None;
        QuantitySamples {
            pool: posterior.column(spring.parameter).into_iter().map(|p| spring.value(p)).collect(),
            name: spring.name,
            unit: "N/m".to_owned(),
            kind: QuantityKind::SpringStiffness,
            damage: if watched { DamageDirection::Decrease } else { DamageDirection::None },
            draws: posterior.draws(),
            edge_mass: edge_mass[spring.parameter],
        }
    });
    parameters.chain(springs).collect()
}

/// Assesses the measurements of one batch.
///
/// # Errors
/// [`Error`], see its variants.
pub fn assess(
    baseline: &Baseline,
    measurements: &[ModalMeasurement],
    undamaged: Option<&UndamagedState>,
    draws: Draws,
) -> Result<Assessment, Error> {
    let samples = draw(baseline, measurements, draws)?;
    Ok(Assessment {
        model_digest: baseline.digest().clone(),
        structure_digest: baseline.simulator().digest().clone(),
        undamaged_version: undamaged.map(|state| state.version),
        seed: draws.seed,
        draws_per_measurement: draws.per_measurement,
        measurements_used: samples.frequencies_hz.len(),
        measurements_left_out: samples.left_out,
        measurements_outside: samples.outside,
        misfit_percent: misfit_percent(baseline, &samples)?,
        assessed_at: Timestamp::now(),
        quantities: damage::assess(&monitored_quantities(baseline, &samples.posterior), undamaged),
    })
}

/// What the simulation cannot reproduce, for each mode, in per cent of the measured frequency.
///
/// ```text
///  100 · (mean measured f_i − f_i(x̄)) / mean measured f_i,    x̄ the mean of all posterior samples
/// ```
///
/// One simulation a batch, so that structures of hundreds of degrees of freedom stay fast; the curvature of f over the
/// spread of x adds some (σ/x)²/8, below 0.1 % for a spread of 8 %.
fn misfit_percent(baseline: &Baseline, samples: &BatchSamples) -> Result<Vec<f64>, Error> {
    let theta: Vec<f64> = samples.posterior.theta().row_mean().iter().copied().collect();
    let simulated = baseline.simulator().frequencies_hz(&theta)?;
    let misfit = |(mode, simulated): (usize, f64)| {
        let measured: Vec<f64> = samples.frequencies_hz.iter().map(|row| row[mode]).collect();
        100.0 * (1.0 - simulated / stats::mean(&measured))
    };
    Ok(simulated.into_iter().enumerate().map(misfit).collect())
}
