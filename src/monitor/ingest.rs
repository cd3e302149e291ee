//! From raw values to a stored and assessed batch. The rules are the same for HTTP and MQTT.

use std::sync::Arc;
use std::time::Duration;

use tokio::sync::oneshot;
use tracing::{warn, Instrument as _};

use super::assessor::{Assessor, Computed, Finished, Task};
use super::compute::{Place, QueueFull};
use super::error::{Error, IngestError};
use super::records::{BatchView, Missing, Records};
use super::replay::Replay;
use super::settings::MissingCovariate;
use super::structures::ActiveStructure;
use crate::assessment::BatchState;
use crate::clock;
use crate::measurement::body::RawBatch;
use crate::measurement::check::{
    check_idempotency_key, check_measurements, check_source, EachCheck, FieldPath, Problem, RawMeasurement,
};
use crate::measurement::{CovariateKind, CovariateValue, MeasurementBatch, ModalMeasurement};
use crate::quantity::{Digest, StructureId, Timestamp};
use crate::store::{self, BatchRecord, InsertBatch, PreferredSender};

/// Source of a batch whose sender does not name one.
pub const DEFAULT_SOURCE: &str = "default";

/// Largest number of missing covariates that are reported.
const MOST_MISSING: usize = 20;

/// A batch that was accepted.
pub struct Ingested {
    /// The batch.
    pub view: BatchView,
    /// True when it was already stored before.
    pub replayed: bool,
}

/// What was computed for a batch while it was being stored.
enum Begun {
    Computed(Box<Computed>),
    NotComputed(Place),
}

/// What became of a batch that was stored before.
enum Replayed {
    Stored(Box<BatchView>),
    /// The retention has removed it meanwhile; the place in the queue, if it was not used.
    Removed(Option<Place>),
}

/// Checks the rows of a table one after the other against a structure.
pub struct RowCheck<'a> {
    active: &'a ActiveStructure,
    refuses_missing: bool,
    each: EachCheck<'a>,
}

impl RowCheck<'_> {
    /// Checks the next row.
    ///
    /// # Errors
    /// Its first mistake.
    pub fn check(&mut self, raw: RawMeasurement) -> Result<ModalMeasurement, Problem> {
        let path = raw.path;
        let measurement = self.each.check(raw)?;
        let missing =
            if self.refuses_missing { missing_covariates(self.active, &measurement, path) } else { Vec::new() };
        missing.into_iter().next().map_or(Ok(measurement), Err)
    }
}

/// Checks, stores and assesses batches.
#[derive(Clone)]
pub struct Ingest {
    assessor: Arc<Assessor>,
    replay: Replay,
    records: Records,
}

impl Ingest {
    pub(super) fn new(assessor: Arc<Assessor>, replay: Replay, records: Records) -> Self {
        Self { assessor, replay, records }
    }

    /// Checks a batch against its structure. For a large batch this takes milliseconds, so it should not run on an async thread.
    ///
    /// # Errors
    /// Every mistake with its location in the input, at most about 20.
    pub fn check(&self, active: &ActiveStructure, raw: RawBatch) -> Result<MeasurementBatch, Vec<Problem>> {
        let RawBatch { source, idempotency_key, posted_by, measurements: raw } = raw;
        let source = source.unwrap_or_else(|| DEFAULT_SOURCE.to_owned());
        check_source(&source).map_err(|problem| vec![problem])?;
        idempotency_key.as_deref().map_or(Ok(()), check_idempotency_key).map_err(|problem| vec![problem])?;
        let paths: Vec<FieldPath> = raw.iter().map(|r| r.path).collect();
        let settings = &self.assessor.settings;
        let expectation = active.simulator.expectation(clock::now(), settings.max_measurements);
        let measurements = check_measurements(raw, &expectation)?;
        if settings.missing_covariate == MissingCovariate::Refuse {
            let missing = measurements.iter().zip(&paths).flat_map(|(m, path)| missing_covariates(active, m, *path));
            let problems: Vec<Problem> = missing.take(MOST_MISSING).collect();
            if !problems.is_empty() {
                return Err(problems);
            }
        }
        let structure = active.simulator.id().clone();
        Ok(MeasurementBatch { structure, source, idempotency_key, posted_by, measurements })
    }

    /// A check of the rows of a table that arrived at the time `now`. As [`Self::check`], it should not run on an async thread.
    pub fn row_check<'a>(&self, active: &'a ActiveStructure, now: Timestamp) -> RowCheck<'a> {
        let refuses_missing = self.assessor.settings.missing_covariate == MissingCovariate::Refuse;
        RowCheck { active, refuses_missing, each: EachCheck::new(active.simulator.expectation(now, usize::MAX)) }
    }

    /// Largest number of measurements in a batch.
    pub fn max_measurements(&self) -> usize {
        self.assessor.settings.max_measurements
    }

    /// Stores a batch, assesses it and stores the result; refuses it at once when the queue is full.
    ///
    /// # Errors
    /// [`Error::QueueFull`] with nothing stored; [`IngestError`].
    pub async fn take(&self, batch: MeasurementBatch) -> Result<Ingested, IngestError> {
        let place = self.assessor.compute.reserve().map_err(Error::from)?;
        self.take_with(batch, place).await
    }

    /// As [`Self::take`], but waits at most `patience` for a place in the queue. For requests with many batches, which should
    /// neither be refused nor displace the batches of other senders.
    ///
    /// # Errors
    /// As [`Self::take`].
    pub async fn take_within(&self, batch: MeasurementBatch, patience: Duration) -> Result<Ingested, IngestError> {
        let waited = tokio::time::timeout(patience, self.assessor.compute.wait()).await;
        self.take_with(batch, waited.map_err(|_| Error::from(QueueFull))?).await
    }

    /// As [`Self::take`], but waits for a place in the queue. For senders that cannot be asked to repeat the request.
    ///
    /// # Errors
    /// As [`Self::take`], without [`Error::QueueFull`].
    pub async fn take_when_free(&self, batch: MeasurementBatch) -> Result<Ingested, IngestError> {
        let place = self.assessor.compute.wait().await;
        self.take_with(batch, place).await
    }

    /// Stores and assesses a batch in a separate task, which continues when the client disconnects.
    async fn take_with(&self, batch: MeasurementBatch, place: Place) -> Result<Ingested, IngestError> {
        let (ingest, structure) = (self.clone(), batch.structure.clone());
        let task = tokio::spawn(async move { ingest.take_here(batch, place).await }.in_current_span());
        task.await.unwrap_or_else(|_| {
            // The batch may have been stored before the panic.
            self.replay.resume_until_done(structure);
            Err(Error::Panicked.into())
        })
    }

    /// It was checked before, and its structure may have been defined anew since then: it is looked at once more, and stored only under the
    /// version that it was looked at with.
    async fn take_here(&self, batch: MeasurementBatch, place: Place) -> Result<Ingested, IngestError> {
        let structure = batch.structure.clone();
        let active = self.assessor.structures.get(&structure)?;
        if !fits(&batch, &active) {
            return Err(Error::VersionChanged(structure).into());
        }
        let _sender = PreferredSender::of(&self.assessor.store);
        let (batch_id, received_at) = (uuid::Uuid::now_v7().to_string(), clock::now());
        let (speculative, outcome) = oneshot::channel();
        let insert = self.assessor.store.batches().insert_batch_speculative(
            &batch,
            &batch_id,
            received_at,
            (Some(active.simulator.digest()), speculative),
        );
        let record = |batch: MeasurementBatch, batch_id: String, content_digest: Digest| BatchRecord {
            batch_id,
            batch,
            content_digest,
            received_at,
            state: BatchState::Received,
            failure: None,
            kept_reference: None,
        };
        // The assessment is computed while the batch is written to disk. No result is stored or published before the batch itself
        // is stored.
        let compute = async {
            match outcome.await {
                Ok(InsertBatch::Inserted { batch_id, content_digest, .. }) if active.baseline.is_ok() => {
                    let task = Task::new(Arc::clone(&active), record(batch.clone(), batch_id, content_digest), place)?;
                    Ok(Begun::Computed(Box::new(self.assessor.compute(task).await?)))
                }
                _ => Ok(Begun::NotComputed(place)),
            }
        };
        let (inserted, begun) = tokio::join!(insert, compute);
        let inserted = inserted.inspect_err(|error| {
            // The batch may be stored nevertheless, and its sender may not send it again.
            if error.is_temporary() {
                self.replay.resume_until_done(structure.clone());
            }
        })?;
        match inserted {
            InsertBatch::Inserted { batch_id, content_digest, outdates } => {
                metrics::counter!("modalwatch_batches_received_total").increment(1);
                metrics::counter!("modalwatch_measurements_received_total").increment(batch.measurements.len() as u64);
                // The record is returned as it was stored, without reading it from the database.
                let view = self.inserted(record(batch, batch_id, content_digest), begun).await;
                if outdates {
                    self.replay.resume_later(structure);
                }
                Ok(Ingested { view, replayed: false })
            }
            InsertBatch::Replayed(id) => {
                let place = self.place_of(begun?).await;
                match self.replayed(active, &batch, &id, place).await? {
                    Replayed::Stored(view) => Ok(Ingested { view: *view, replayed: true }),
                    // It is stored again.
                    Replayed::Removed(place) => {
                        let place = match place {
                            Some(place) => place,
                            None => self.assessor.compute.wait().await,
                        };
                        Box::pin(self.take_here(batch, place)).await
                    }
                }
            }
            InsertBatch::AnotherVersion => {
                self.follow(&active).await?;
                let place = self.place_of(begun?).await;
                Box::pin(self.take_here(batch, place)).await
            }
            InsertBatch::KeyConflict { batch_id } => Err(IngestError::KeyConflict { batch: batch_id }),
            InsertBatch::MeasurementConflict { ordinal, measured_at, batch_id } => {
                Err(IngestError::MeasurementConflict { ordinal, measured_at, batch: batch_id })
            }
        }
    }

    /// The place in the queue, if it was not used, or another one.
    async fn place_of(&self, begun: Begun) -> Place {
        match begun {
            Begun::NotComputed(place) => place,
            Begun::Computed(_) => self.assessor.compute.wait().await,
        }
    }

    /// Puts the stored version of a structure into use in place of `active`.
    ///
    /// # Errors
    /// [`Error::VersionChanged`] if there is no other.
    async fn follow(&self, active: &ActiveStructure) -> Result<(), Error> {
        let structure = active.simulator.id();
        self.assessor.structures.follow_stored(structure).await?;
        let present = self.assessor.structures.get(structure)?;
        let is_another = present.simulator.digest() != active.simulator.digest();
        is_another.then_some(()).ok_or_else(|| Error::VersionChanged(structure.clone()))
    }

    /// Answers a batch that was stored before, and assesses it if it waits.
    async fn replayed(
        &self,
        active: Arc<ActiveStructure>,
        sent: &MeasurementBatch,
        id: &str,
        place: Place,
    ) -> Result<Replayed, Error> {
        let structure = &sent.structure;
        let record = match self.assessor.stored(structure, id).await {
            Err(Error::UnknownBatch { .. }) => return Ok(Replayed::Removed(Some(place))),
            Err(error) => return self.stored(sent, id, Err(error)).await,
            Ok(record) => record,
        };
        // One that keeps its references is compared with them in their order, by the replay.
        let waits = record.state == BatchState::Received && record.kept_reference.is_none();
        if !waits || active.baseline.is_err() {
            let view = self.records.view(record).await;
            return self.stored(sent, id, view).await;
        }
        let waiting = record.clone();
        let finished = async { self.assessor.finish(Task::new(active, record, place)?).await }.await;
        let view = match self.or_resumed(structure, finished) {
            Err(failure) => Ok(self.waiting(waiting, &failure)),
            Ok(finished) => self.finished(waiting, finished).await,
        };
        self.stored(sent, id, view).await
    }

    /// The view of a batch that was stored before, or what is known of it if a row of it is damaged.
    async fn stored(
        &self,
        sent: &MeasurementBatch,
        id: &str,
        view: Result<BatchView, Error>,
    ) -> Result<Replayed, Error> {
        let view = match view {
            Err(Error::Store(damaged @ store::Error::Row { .. })) => self.records.damaged(sent, id, &damaged).await,
            view => view,
        };
        match view {
            Err(Error::UnknownBatch { .. }) => Ok(Replayed::Removed(None)),
            view => Ok(Replayed::Stored(Box::new(view?))),
        }
    }

    /// Stores the assessment of a batch that was just stored. If that fails, for example on a full disk, the batch is answered as it is:
    /// stored, and waiting for its assessment, which is attempted again.
    async fn inserted(&self, record: BatchRecord, begun: Result<Begun, Error>) -> BatchView {
        let structure = record.batch.structure.clone();
        let finished = match begun {
            Ok(Begun::Computed(computed)) => self.assessor.finish_computed(*computed).await,
            Ok(Begun::NotComputed(_)) => {
                self.assessor.events.batch_changed(&structure, &record.batch_id, record.state);
                // A trained baseline that was put into use meanwhile has not found the batch among those that wait.
                if self.assessor.structures.get(&structure).is_ok_and(|active| active.baseline.is_ok()) {
                    self.replay.resume_later(structure);
                }
                return self.records.view_of_stored(record, None, Vec::new()).await;
            }
            Err(failure) => Err(failure),
        };
        let waiting = record.clone();
        let finished = match self.or_resumed(&structure, finished) {
            Ok(finished) => self.finished(record, finished).await,
            Err(failure) => Err(failure),
        };
        // Also if the retention has removed it meanwhile: it was stored.
        finished.unwrap_or_else(|failure| self.waiting(waiting, &failure))
    }

    /// A stored batch whose assessment has ended.
    ///
    /// # Errors
    /// [`Error::UnknownBatch`] if the retention has removed it meanwhile.
    async fn finished(&self, record: BatchRecord, finished: Finished) -> Result<BatchView, Error> {
        let failed = match finished {
            Finished::Assessed(assessment, charts) => {
                let record = BatchRecord { state: BatchState::Assessed, ..record };
                return Ok(self.records.view_of_stored(record, Some(*assessment), charts).await);
            }
            Finished::Failed => true,
            Finished::Superseded => false,
        };
        match self.records.batch(&record.batch.structure, &record.batch_id).await {
            // That the batch is stored is known, and an error would say otherwise.
            Err(Error::Store(failure)) if failed => {
                let why =
                    format!("it could not be assessed, and why cannot be read now ({failure}): read the batch again");
                let record = BatchRecord { state: BatchState::Failed, failure: Some(why), ..record };
                Ok(self.records.view_of_stored(record, None, Vec::new()).await)
            }
            Err(Error::Store(failure)) => Ok(self.waiting(record, &failure.into())),
            read => read,
        }
    }

    /// A stored batch whose assessment could not be computed or stored.
    fn waiting(&self, record: BatchRecord, failure: &Error) -> BatchView {
        let (structure, id) = (&record.batch.structure, &record.batch_id);
        warn!(structure.id = %structure, batch.id = %id, error = %failure, "Stored batch {id} of {structure}, which waits for its assessment: {failure}");
        self.assessor.events.batch_changed(structure, id, record.state);
        BatchView { record, assessment: None, charts: Vec::new(), missing: Some(Missing::Assessment) }
    }

    /// Returns the given result of a stored batch. If the batch has no result, its assessment is attempted again later, because the
    /// sender may not send it again.
    fn or_resumed(&self, structure: &StructureId, result: Result<Finished, Error>) -> Result<Finished, Error> {
        match &result {
            Ok(finished) => self.replay.resume_if_superseded(structure, finished),
            Err(_) => self.replay.resume_until_done(structure.clone()),
        }
        result
    }
}

/// Whether a batch has the modes, points, covariates and settings of a version of its structure, and frequencies that it can have.
fn fits(batch: &MeasurementBatch, active: &ActiveStructure) -> bool {
    let simulator = &active.simulator;
    let (modes, (low, high)) = (simulator.modes(), simulator.frequency_limits_hz());
    let points = simulator.instrumented_points().map(|points| points.names.len());
    let declared = |name: &String, value: &CovariateValue| {
        let covariate = simulator.covariates().iter().find(|covariate| covariate.name == *name);
        covariate.is_some_and(|covariate| match value {
            CovariateValue::Number(_) => covariate.kind == CovariateKind::Number,
            CovariateValue::Category(_) => covariate.kind == CovariateKind::Category,
        })
    };
    batch.measurements.iter().all(|m| {
        let shapes = m.mode_shapes.iter().flatten();
        m.frequencies_hz.len() == modes
            && m.frequencies_hz.iter().flatten().all(|f| (low..=high).contains(&f.get()))
            && m.std_hz.as_ref().is_none_or(|all| all.len() == modes)
            && m.mode_shapes.as_ref().is_none_or(|all| all.len() == modes)
            && shapes.flatten().all(|shape| Some(shape.len()) == points)
            && m.covariates.iter().all(|(name, value)| declared(name, value))
            && m.settings.keys().all(|name| simulator.space().iter().any(|p| p.name == *name))
    })
}

fn missing_covariates(active: &ActiveStructure, measurement: &ModalMeasurement, path: FieldPath) -> Vec<Problem> {
    let mut missing = active.simulator.effect_sizes(&measurement.covariates).missing;
    missing.extend(active.simulator.discrepancy_reservations(measurement).0);
    missing.sort();
    missing.dedup();
    let problem = |name: String| {
        let message = format!("{name} is missing: the simulation of this structure depends on it");
        Problem::new(path.of_covariate(&name), message)
    };
    missing.into_iter().map(problem).collect()
}
