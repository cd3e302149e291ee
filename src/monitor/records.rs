//! Reading stored batches and their assessments.

use std::fmt;
use std::sync::Arc;

use tracing::warn;

use super::assessor::Assessor;
use super::details::Details;
use super::error::Error;
use super::own_task::in_own_task;
use super::readers::Readers;
use crate::assessment::{Assessment, BatchDetail, BatchState};
use crate::measurement::MeasurementBatch;
use crate::quantity::{shown, Digest, StructureId, Timestamp};
use crate::reduction::Reduced;
use crate::store::{
    self, AssessedSeries, BatchHeader, BatchRecord, ChartSeries, Exceedance, Extent, HistoryEntry, HistoryQuery,
    LatestPoint, LatestQuantity, MeasurementQuery, OpenAlarms, QuantitySeries, ReferenceRecord, ReferenceVersion,
    SeriesWindow, StoredChartPoint, StoredMeasurement, StructureOverview, StructureSummary, TrustMark,
};

/// A batch with its results.
pub struct BatchView {
    /// The batch as it is stored.
    pub record: BatchRecord,
    /// Its current assessment.
    pub assessment: Option<Assessment>,
    /// Its points on the alarm charts.
    pub charts: Vec<StoredChartPoint>,
    /// Why there is no assessment, or no comparison with an undamaged reference.
    pub missing: Option<Missing>,
}

/// A stored batch, as far as it can be read.
pub enum FoundBatch {
    /// The batch with its results.
    Whole(Box<BatchView>),
    /// What is stored of it beside its measurements, and why it cannot be read.
    Header(Box<BatchHeader>, String),
}

/// Why a batch has no assessment, or no comparison with an undamaged reference.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Missing {
    /// The structure has no trained baseline in use; why, and what to do.
    Model(String),
    /// The batch is part of the reference of this version.
    PartOfReference(u32),
    /// The reference of this version was made with another trained baseline: it has to be declared again.
    OutdatedReference(u32),
    /// The assessment could not be computed or stored, and is attempted again.
    Assessment,
    /// The comparison has not been computed yet.
    NotYet,
    /// The structure has no reference: it has to be declared.
    Reference,
    /// The reference of the structure cannot be read; why, and what to do.
    UnreadableReference(String),
}

impl fmt::Display for Missing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Model(reason) | Self::UnreadableReference(reason) => f.write_str(reason),
            Self::PartOfReference(version) => {
                write!(f, "the batch is part of the undamaged reference, version {version}, and is not compared with it")
            }
            Self::OutdatedReference(version) => write!(
                f,
                "the undamaged reference, version {version}, was made with another trained model: declare undamaged batches again"
            ),
            Self::Assessment => {
                f.write_str("the batch is stored; it could not be assessed now, which is attempted again until it succeeds")
            }
            Self::NotYet => f.write_str("the batch has not been compared with the undamaged reference yet"),
            Self::Reference => f.write_str("there is no undamaged reference: declare undamaged batches"),
        }
    }
}

/// The newest undamaged reference of a structure, as far as it can be read.
#[derive(Debug, Clone, Default)]
pub struct FoundReference {
    /// The reference; `None` if there is none, or it cannot be read.
    pub record: Option<Arc<ReferenceRecord>>,
    /// Why it cannot be read, and what to do, as a sentence.
    pub unreadable: Option<String>,
}

impl FoundReference {
    /// What was read: a row that is damaged must not keep everything else of the structure from being read.
    fn of(read: Result<Option<Arc<ReferenceRecord>>, store::Error>) -> Result<Self, Error> {
        match read {
            Ok(record) => Ok(Self { record, unreadable: None }),
            Err(damaged @ store::Error::Row { .. }) => {
                Ok(Self { record: None, unreadable: Some(unreadable(&damaged)) })
            }
            Err(error) => Err(error.into()),
        }
    }
}

/// What to do about a reference that cannot be read.
fn unreadable(damaged: &store::Error) -> String {
    format!("{damaged}; `modalwatch doctor` names the row: restore a backup, or declare undamaged batches again")
}

/// What to do about a batch that cannot be read.
fn unreadable_batch(damaged: &store::Error) -> String {
    format!("{damaged}; restore a backup that has it, and run `modalwatch doctor` for further damage")
}

/// What to do about rows that are left out of an answer; `None` if there are none.
fn left_out_sentence(rows: u64) -> Option<String> {
    let what =
        if rows == 1 { "row of this time cannot be read and is" } else { "rows of this time cannot be read and are" };
    (rows > 0).then(|| {
        format!(
            "{rows} stored {what} left out; `GET /readyz` and `modalwatch doctor` name what is damaged: restore a backup"
        )
    })
}

/// Measured and computed series of a structure over a window of time.
pub struct Series {
    /// Number and times of the batches in the window.
    pub extent: Extent,
    /// Frequencies in Hz and numeric covariates of the measurements.
    pub measured: Reduced<()>,
    /// Mean and probability of damage of each monitored quantity.
    pub quantities: Vec<QuantitySeries>,
    /// Verdict and findings of each batch.
    pub trust: Reduced<TrustMark>,
    /// Points of the alarm charts.
    pub charts: Vec<ChartSeries>,
    /// Stored rows that cannot be read and are left out, and what to do, as a sentence; `None` if all can be read.
    pub unreadable: Option<String>,
}

/// Reads stored batches and what was computed from them.
#[derive(Clone)]
pub struct Records {
    assessor: Arc<Assessor>,
    details: Details,
}

impl Records {
    pub(super) fn new(assessor: Arc<Assessor>, readers: Readers) -> Self {
        let details = Details::new(Arc::clone(&assessor), readers);
        Self { assessor, details }
    }

    /// All stored structures.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn structures(&self) -> Result<Vec<StructureSummary>, Error> {
        Ok(self.assessor.store.structures().list().await?)
    }

    /// All structures with their newest assessments and open damage alarms, as of one moment.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn overview(&self) -> Result<(Vec<StructureOverview>, OpenAlarms), Error> {
        let store = self.assessor.store.clone();
        in_own_task(async move { Ok(store.overview().structures().await?) }).await
    }

    /// For the first `structures` structures by id: the quantities of the latest assessed batch, and the last points of the alarm charts.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn latest(&self, structures: usize) -> Result<(Vec<LatestQuantity>, Vec<LatestPoint>), Error> {
        let overview = self.assessor.store.overview();
        Ok((overview.latest_quantities(structures, None).await?, overview.latest_points(structures).await?))
    }

    /// The quantities of the latest assessed batch of a structure.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn latest_quantities(&self, structure: &StructureId) -> Result<Vec<LatestQuantity>, Error> {
        Ok(self.assessor.store.overview().latest_quantities(1, Some(structure)).await?)
    }

    /// The newest undamaged reference of a structure.
    ///
    /// # Errors
    /// [`Error::Store`], but not for a row that cannot be read.
    pub async fn reference(&self, structure: &StructureId) -> Result<FoundReference, Error> {
        FoundReference::of(self.assessor.store.reference().undamaged(structure).await)
    }

    /// All versions of the undamaged reference of a structure, the newest first. A version whose origin cannot be read is listed without it.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn reference_versions(&self, structure: &StructureId) -> Result<Vec<ReferenceVersion>, Error> {
        Ok(self.assessor.store.reference().versions(structure).await?)
    }

    /// A page of the batches of a structure with their current assessments. A batch whose assessment cannot be read is a failed one that says
    /// so, as in [`Self::found_batch`].
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn history(&self, structure: &StructureId, query: &HistoryQuery) -> Result<Vec<HistoryEntry>, Error> {
        let mut entries = self.assessor.store.history().page(structure, query).await?;
        for entry in &mut entries {
            if let Some(damaged) = &entry.unreadable {
                entry.state = BatchState::Failed;
                entry.failure = Some(unreadable_batch(damaged));
            }
        }
        Ok(entries)
    }

    /// A page of the exceedances of a structure.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn exceedances(&self, structure: &StructureId, query: &HistoryQuery) -> Result<Vec<Exceedance>, Error> {
        Ok(self.assessor.store.history().exceedances(structure, query).await?)
    }

    /// When a structure was created. One that is deleted and made anew under the same id is another one by this.
    ///
    /// # Errors
    /// [`Error::UnknownStructure`], [`Error::Store`].
    pub async fn created_at(&self, structure: &StructureId) -> Result<Timestamp, Error> {
        let created_at = self.assessor.store.structures().created_at(structure).await?;
        created_at.ok_or_else(|| Error::UnknownStructure(structure.clone()))
    }

    /// A page of the measurements of a structure.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn measurements(
        &self,
        structure: &StructureId,
        query: &MeasurementQuery,
    ) -> Result<Vec<StoredMeasurement>, Error> {
        Ok(self.assessor.store.batches().measurements(structure, query).await?)
    }

    /// The series of a structure; `modes` is its number of modes, `covariates` are the names of its numeric covariates.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn series(
        &self,
        structure: &StructureId,
        window: SeriesWindow,
        modes: usize,
        covariates: &[String],
    ) -> Result<Series, Error> {
        let store = &self.assessor.store;
        let extent = store.series().extent(structure, window).await?;
        let ((measured, unread), AssessedSeries { quantities, trust, left_out }, charts) = tokio::try_join!(
            store.series().frequency_series(structure, window, &extent, modes, covariates),
            store.series().assessed_series(structure, window, &extent),
            store.series().chart_series(structure, window, &extent),
        )?;
        let unreadable = left_out_sentence(unread + left_out);
        Ok(Series { extent, measured, quantities, trust, charts, unreadable })
    }

    /// One batch with its current assessment.
    ///
    /// # Errors
    /// [`Error::UnknownBatch`], [`Error::UnknownStructure`].
    pub async fn batch(&self, structure: &StructureId, batch_id: &str) -> Result<BatchView, Error> {
        self.view(self.assessor.stored(structure, batch_id).await?).await
    }

    /// One batch with its current assessment; if a row of it cannot be read, what is known of it without its measurements.
    ///
    /// # Errors
    /// [`Error::UnknownBatch`], [`Error::UnknownStructure`], [`Error::Store`].
    pub async fn found_batch(&self, structure: &StructureId, batch_id: &str) -> Result<FoundBatch, Error> {
        let damaged = match self.batch(structure, batch_id).await {
            Err(Error::Store(damaged @ store::Error::Row { .. })) => damaged,
            view => return Ok(FoundBatch::Whole(Box::new(view?))),
        };
        match self.assessor.store.batches().header(structure, batch_id).await? {
            Some(header) => Ok(FoundBatch::Header(Box::new(header), unreadable_batch(&damaged))),
            None => Err(Error::UnknownBatch { structure: structure.clone(), batch: shown(batch_id) }),
        }
    }

    /// A batch that was sent again, of whose stored rows one cannot be read: what was sent is what was stored.
    pub(super) async fn damaged(
        &self,
        sent: &MeasurementBatch,
        batch_id: &str,
        damaged: &store::Error,
    ) -> Result<BatchView, Error> {
        let unknown = || Error::UnknownBatch { structure: sent.structure.clone(), batch: shown(batch_id) };
        let header = self.assessor.store.batches().header(&sent.structure, batch_id).await?.ok_or_else(unknown)?;
        let record = BatchRecord {
            batch_id: header.batch_id,
            batch: MeasurementBatch { posted_by: header.posted_by, ..sent.clone() },
            content_digest: header.content_digest,
            received_at: header.received_at,
            state: BatchState::Failed,
            failure: Some(unreadable_batch(damaged)),
            kept_reference: None,
        };
        Ok(BatchView { record, assessment: None, charts: Vec::new(), missing: None })
    }

    /// A stored batch with its current assessment.
    pub(super) async fn view(&self, record: BatchRecord) -> Result<BatchView, Error> {
        let (structure, batch_id) = (&record.batch.structure, record.batch_id.as_str());
        let assessment = self.assessor.store.assessments().assessment(structure, batch_id).await?;
        let charts = self.assessor.store.alarms().chart_points(structure, batch_id).await?;
        self.view_of(record, assessment, charts).await
    }

    /// A stored batch with these results.
    pub(super) async fn view_of(
        &self,
        record: BatchRecord,
        assessment: Option<Assessment>,
        charts: Vec<StoredChartPoint>,
    ) -> Result<BatchView, Error> {
        let missing = self.missing(&record, assessment.as_ref()).await?;
        Ok(BatchView { record, assessment, charts, missing })
    }

    /// As [`Self::view_of`], for a batch that was stored just now: if it cannot be read why something is missing, this is left out, because
    /// an error would say that the batch may not be stored.
    pub(super) async fn view_of_stored(
        &self,
        record: BatchRecord,
        assessment: Option<Assessment>,
        charts: Vec<StoredChartPoint>,
    ) -> BatchView {
        let missing = self.missing(&record, assessment.as_ref()).await;
        let missing = missing.inspect_err(|error| {
            warn!(structure.id = %record.batch.structure, batch.id = %record.batch_id, %error, "Could not read why batch {} is not compared: {error}", record.batch_id);
        });
        BatchView { record, assessment, charts, missing: missing.unwrap_or_default() }
    }

    /// Why a batch has no assessment, or no comparison; `None` if nothing is missing, or it waits for its turn.
    async fn missing(&self, record: &BatchRecord, assessment: Option<&Assessment>) -> Result<Option<Missing>, Error> {
        let active = self.assessor.structures.get(&record.batch.structure)?;
        Ok(match (assessment, &active.baseline) {
            (None, Err(reason)) => Some(Missing::Model(reason.clone())),
            (Some(a), _) if a.undamaged_version.is_none() => {
                Some(self.why_not_compared(record, active.model_digest()).await?)
            }
            _ => None,
        })
    }

    async fn why_not_compared(&self, record: &BatchRecord, model_digest: Option<&Digest>) -> Result<Missing, Error> {
        let FoundReference { record: reference, unreadable } = self.reference(&record.batch.structure).await?;
        let Some(reference) = reference else {
            return Ok(unreadable.map_or(Missing::Reference, Missing::UnreadableReference));
        };
        let version = reference.state.version;
        Ok(if reference.batches.contains(&record.batch_id) {
            Missing::PartOfReference(version)
        } else if model_digest.is_some_and(|digest| *digest != reference.model_digest) {
            Missing::OutdatedReference(version)
        } else {
            Missing::NotYet
        })
    }

    /// The densities and predictions of an assessed batch, by the samples of its assessment, which are drawn again.
    ///
    /// # Errors
    /// [`Error::UnknownStructure`], [`Error::UnknownBatch`], [`Error::NoModel`], [`Error::NotAssessed`],
    /// [`Error::TooManyReaders`].
    pub async fn batch_detail(&self, structure: &StructureId, batch_id: &str) -> Result<Arc<BatchDetail>, Error> {
        self.details.of_batch(structure, batch_id).await
    }
}
