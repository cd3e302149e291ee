//! What a batch says, drawn again: the densities of its parameters, and what they predict for each mode.

use std::sync::Arc;

use super::assess::{self, BatchSamples};
use super::{baseline_of, Error, Monitor};
use crate::assessment::BatchState;
use crate::baseline::Baseline;
use crate::damage::UndamagedState;
use crate::measurement::ModalMeasurement;
use crate::parameter::Parameter;
use crate::plot::density;
use crate::quantity::{Digest, Hertz, StructureId};
use crate::stats;
use crate::store::BatchRecord;

/// Measured values shown of each mode, evenly chosen from the batch.
const SHOWN_MEASUREMENTS: usize = 200;

/// Simulations behind a prediction.
const SIMULATIONS: usize = 1_000;

/// Places over the whole prior, and over the part of it where the densities are.
const PLACES: [usize; 2] = [60, 140];

/// Margin about the prior, as a share of its width.
const MARGIN: f64 = 0.05;

/// Standard deviations about a mean beyond which a density is not drawn finely.
const REACH: f64 = 4.5;

/// The densities of the parameters of a batch and what they predict.
#[derive(Debug, Clone, PartialEq)]
pub struct BatchDetail {
    /// The trained baseline in use, which drew it.
    pub model_digest: Digest,
    /// Measurements of the batch.
    pub measurements: usize,
    /// Those whose values are shown.
    pub shown: usize,
    /// Posterior samples that were sent through the simulation.
    pub simulations: usize,
    /// One entry a parameter.
    pub parameters: Vec<ParameterDetail>,
    /// One entry a mode.
    pub modes: Vec<ModeDetail>,
}

/// Densities of one parameter, all on the same places.
#[derive(Debug, Clone, PartialEq)]
pub struct ParameterDetail {
    /// Its name.
    pub name: String,
    /// Its unit.
    pub unit: String,
    /// Places, ascending; closer where the densities are.
    pub grid: Vec<f64>,
    /// The uniform prior.
    pub prior: Vec<f64>,
    /// The pooled samples of the batch.
    pub posterior: Vec<f64>,
    /// The population behind the undamaged state.
    pub undamaged: Option<Vec<f64>>,
    /// δ.
    pub threshold: Option<f64>,
}

/// A mode: measured, and predicted by the posterior samples, without noise.
#[derive(Debug, Clone, PartialEq)]
pub struct ModeDetail {
    /// Values of the measurements shown, Hz.
    pub measured_hz: Vec<Option<Hertz>>,
    /// Mean of the predicted frequencies, Hz.
    pub predicted_mean_hz: f64,
    /// 5 % and 95 % of the predicted frequencies lie below, Hz.
    pub predicted_interval_hz: [f64; 2],
}

impl Monitor {
    /// The detail of an assessed batch, by the samples of its assessment.
    ///
    /// # Errors
    /// [`Error::UnknownStructure`], [`Error::UnknownBatch`], [`Error::NoModel`], [`Error::NotAssessed`],
    /// [`Error::QueueFull`].
    pub async fn batch_detail(&self, structure: &StructureId, batch_id: &str) -> Result<BatchDetail, Error> {
        let watched = self.structure(structure)?;
        let record = self.stored(structure, batch_id).await?;
        let baseline = baseline_of(structure, &watched)?;
        let not_assessed = |reason: String| Error::NotAssessed { batch: batch_id.to_owned(), reason };
        match record.state {
            BatchState::Assessed => {}
            BatchState::Received => return Err(not_assessed("it waits for its turn".to_owned())),
            BatchState::Failed => return Err(not_assessed(record.failure.unwrap_or_default())),
        }
        let place = self.compute.reserve()?;
        let draws = self.draws(&baseline, &record);
        let (source, from) = (&record.batch.source, record.batch.time_span().0);
        let previous = self.store.batches().frequencies_before(structure, source, from).await?;
        let undamaged = self.store.reference().undamaged(structure).await?;
        let undamaged = undamaged.filter(|u| u.model_digest == *baseline.digest());
        let drawn = Arc::clone(&baseline);
        let work = move || {
            let BatchRecord { batch, .. } = record;
            let samples = assess::draw(&drawn, &batch.measurements, previous.as_deref(), draws)?;
            detail(&drawn, &batch.measurements, &samples, draws.per_measurement, undamaged.as_ref().map(|u| &u.state))
        };
        let done = place.run(work).await.map_err(|_| Error::Panicked)?;
        done.map_err(|error| not_assessed(error.to_string()))
    }
}

fn detail(
    baseline: &Baseline,
    measurements: &[ModalMeasurement],
    samples: &BatchSamples,
    per_measurement: usize,
    undamaged: Option<&UndamagedState>,
) -> Result<BatchDetail, assess::Error> {
    let pooled = samples.posterior.first(per_measurement.min(samples.posterior.draws()));
    let parameter = |(column, parameter): (usize, &Parameter)| {
        let state = undamaged.and_then(|state| state.quantities.iter().find(|q| q.name == parameter.name));
        let population = state.map(|q| (q.mean, q.std)).filter(|(_, std)| *std > 0.0);
        let pool = pooled.column(column);
        let grid = grid(parameter, &pool, population);
        let height = 1.0 / (parameter.upper - parameter.lower);
        let inside = |x: &f64| if (parameter.lower..=parameter.upper).contains(x) { height } else { 0.0 };
        ParameterDetail {
            name: parameter.name.clone(),
            unit: parameter.unit.clone(),
            prior: grid.iter().map(inside).collect(),
            // Samples without a spread have no density that could be drawn.
            posterior: density::kernel_at(&pool, &grid).unwrap_or_else(|| vec![0.0; grid.len()]),
            undamaged: population.map(|(mean, std)| grid.iter().map(|x| density::normal(*x, mean, std)).collect()),
            threshold: state.and_then(|q| q.threshold),
            grid,
        }
    };
    let rows = evenly(pooled.theta().nrows(), SIMULATIONS);
    let mut predicted = vec![Vec::with_capacity(rows.len()); baseline.simulator().modes()];
    for &row in &rows {
        let theta: Vec<f64> = pooled.theta().row(row).iter().copied().collect();
        let simulator = samples.asked[row / pooled.draws()].simulator(baseline.simulator());
        for (mode, frequency_hz) in simulator.frequencies_hz(&theta)?.into_iter().enumerate() {
            predicted[mode].push(frequency_hz);
        }
    }
    let shown = evenly(measurements.len(), SHOWN_MEASUREMENTS);
    let mode = |(mode, predicted): (usize, Vec<f64>)| ModeDetail {
        measured_hz: shown.iter().map(|&index| measurements[index].frequencies_hz[mode]).collect(),
        predicted_mean_hz: stats::mean(&predicted),
        predicted_interval_hz: [0.05, 0.95].map(|level| stats::quantile(&predicted, level)),
    };
    Ok(BatchDetail {
        model_digest: baseline.digest().clone(),
        measurements: measurements.len(),
        shown: shown.len(),
        simulations: rows.len(),
        parameters: baseline.space().iter().enumerate().map(parameter).collect(),
        modes: predicted.into_iter().enumerate().map(mode).collect(),
    })
}

/// Places over the prior with its edges, closer together where the samples and the undamaged population are.
fn grid(parameter: &Parameter, pool: &[f64], population: Option<(f64, f64)>) -> Vec<f64> {
    let width = parameter.upper - parameter.lower;
    let (low, high) = (parameter.lower - MARGIN * width, parameter.upper + MARGIN * width);
    let own = stats::sample_std(pool).map(|std| (stats::mean(pool), std));
    let reach = || own.into_iter().chain(population);
    let from = reach().map(|(mean, std)| mean - REACH * std).fold(high, f64::min).max(low);
    let to = reach().map(|(mean, std)| mean + REACH * std).fold(low, f64::max).min(high);
    let spread =
        |from: f64, to: f64, count: usize| (0..count).map(move |i| from + (to - from) * i as f64 / (count - 1) as f64);
    let mut places: Vec<f64> = spread(low, high, PLACES[0]).chain([parameter.lower, parameter.upper]).collect();
    if from < to {
        places.extend(spread(from, to, PLACES[1]));
    }
    places.sort_by(f64::total_cmp);
    places.dedup();
    places
}

/// At most `most` of `count` indices, evenly.
fn evenly(count: usize, most: usize) -> Vec<usize> {
    let taken = count.min(most);
    (0..taken).map(|i| i * count / taken).collect()
}
