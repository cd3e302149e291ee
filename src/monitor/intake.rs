//! From raw values to a batch that may be stored: the rules are the same for every door.

use tracing::Instrument as _;

use super::{Error, Ingested, MissingCovariate, Monitor, Watched};
use crate::measurement::body::RawBatch;
use crate::measurement::check::{check_idempotency_key, check_measurements, check_source, Place, Problem};
use crate::measurement::{MeasurementBatch, ModalMeasurement};
use crate::quantity::{StructureId, Timestamp};

/// Source of a batch that names none.
const DEFAULT_SOURCE: &str = "default";

/// Most missing covariates named.
const MOST_MISSING: usize = 20;

impl Monitor {
    /// Checks a batch against its structure. It computes: not for an async thread when the batch is large.
    ///
    /// # Errors
    /// Every mistake with its place, at most some twenty.
    pub fn check(
        &self,
        watched: &Watched,
        structure: StructureId,
        raw: RawBatch,
    ) -> Result<MeasurementBatch, Vec<Problem>> {
        let RawBatch { source, idempotency_key, measurements: raw } = raw;
        let source = source.unwrap_or_else(|| DEFAULT_SOURCE.to_owned());
        check_source(&source).map_err(|problem| vec![problem])?;
        idempotency_key.as_deref().map_or(Ok(()), check_idempotency_key).map_err(|problem| vec![problem])?;
        let places: Vec<Place> = raw.iter().map(|r| r.place).collect();
        let measurements =
            check_measurements(raw, &watched.simulator.expectation(Timestamp::now(), self.settings.max_measurements))?;
        if self.settings().missing_covariate == MissingCovariate::Refuse {
            let missing =
                measurements.iter().zip(&places).flat_map(|(m, place)| missing_covariates(watched, m, *place));
            let problems: Vec<Problem> = missing.take(MOST_MISSING).collect();
            if !problems.is_empty() {
                return Err(problems);
            }
        }
        Ok(MeasurementBatch { structure, source, idempotency_key, measurements })
    }

    /// As [`Monitor::ingest`], but waits for a place in the queue: for senders that cannot be told to come again.
    ///
    /// # Errors
    /// As [`Monitor::ingest`], without [`Error::QueueFull`].
    pub async fn ingest_when_free(&self, batch: MeasurementBatch) -> Result<Ingested, Error> {
        let place = self.compute.wait().await;
        let monitor = self.clone();
        let task = tokio::spawn(async move { monitor.ingest_here(batch, place).await }.in_current_span());
        task.await.map_err(|_| Error::Panicked)?
    }
}

fn missing_covariates(watched: &Watched, measurement: &ModalMeasurement, place: Place) -> Vec<Problem> {
    let missing = watched.simulator.effect_sizes(&measurement.covariates).missing;
    let problem = |name: String| {
        let message = format!("{name} is missing: the simulation of this structure depends on it");
        Problem::new(place.of_covariate(&name), message)
    };
    missing.into_iter().map(problem).collect()
}
