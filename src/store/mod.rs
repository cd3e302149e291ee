//! Everything that is stored, and the only module that contains SQL.
//!
//! [`Store`] opens the database of a data folder, or one of a PostgreSQL server, and hands out one small interface for each area:
//! structures, batches, assessments, alarms and so on. The data of a folder are in one SQLite file with one connection that writes, a
//! write-ahead log and `synchronous = FULL`, so that acknowledged data survive a power failure. Write tasks run in the order of the calls,
//! in transactions of a background task, so that a caller who disconnects never leaves a transaction open. Tasks that wait at the same time
//! share one transaction and its sync to disk. Every statement is one text for both databases (`sql`).

mod alarm;
mod alarm_action;
pub mod archive;
mod arrival;
mod assessed;
mod assessment;
mod assessment_row;
mod audit;
mod automatic;
pub mod backup;
mod batch;
mod batch_header;
mod batch_id;
mod batch_state;
mod chart;
mod chart_episode;
mod chart_point;
mod chart_removal;
mod chart_series;
mod claim;
mod coincidence;
mod column;
mod comparison;
mod computation;
mod current;
mod damaged;
mod database;
mod database_file;
mod deletion;
mod diagnosis;
mod earlier;
mod error;
mod failed;
mod figures;
mod file;
mod history;
pub mod inspect;
mod interrupted;
mod job_end;
mod jobs;
mod late;
mod latest_quantities;
mod mail;
mod maintenance;
mod measurement_row;
mod measurements;
mod note;
mod outbox;
mod overview;
mod plotted;
mod preferred_sender;
mod process;
mod quarantine;
mod reader;
mod reference_content;
mod reference_version;
mod retention;
mod rows;
mod series;
pub mod server;
mod shared_job;
mod snapshot;
mod sql;
mod structure;
#[cfg(test)]
mod tests;
mod token;
mod training;
mod transaction;
pub mod transfer;
mod undamaged;
mod unreadable;
mod url;
mod version;
mod webhook;
mod write_connection;
mod write_queue;
mod writer;

use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

use crate::volume;
use damaged::DamagedRows;
use database::{Database, Place};
use reader::Reader;
use undamaged::Known;
use write_connection::WriterPool;
use writer::Writer;

pub use alarm::{Acknowledgement, Alarms, Episode, EpisodeDiagnosis, EpisodeQuery, OpenAlarms};
pub use alarm_action::{
    ActionKind, ActionOutcome, AlarmAction, AlarmActions, ClosingReason, Handling, NewAction, MOST_ACTIONS,
};
pub use archive::Archive;
pub use arrival::Arrival;
pub use assessment::{Assessments, ComparedWith, StoredAssessment};
pub use audit::{Audit, AuditEntry, AuditQuery, NewAuditEntry};
pub use automatic::{LatestDiagnoses, RejectedEpisode};
pub use batch::{BatchRecord, Batches, InsertBatch};
pub use batch_header::BatchHeader;
pub use chart_point::StoredChartPoint;
pub use chart_series::{ChartMark, ChartSeries};
pub use claim::Claim;
pub use computation::{Awaited, Computations, ComputedResult, ComputedWith, LiveWorkers, PieceState};
pub use database_file::{DatabaseFile, Engine};
pub use deletion::{Deletions, Removed};
pub use diagnosis::{Diagnoses, DiagnosisRecord, DiagnosisTrigger, JobState, NewDiagnosis};
pub use error::Error;
pub use figures::{Figures, FolderFigures};
pub use file::{schema_version, StoreSettings, DATABASE_FILE};
pub use history::{Exceedance, History, HistoryEntry, HistoryQuery};
pub use interrupted::Interrupted;
pub use job_end::JobEnd;
pub use jobs::{JobKind, JobRecord};
pub use late::Before;
pub use latest_quantities::{LatestPoint, LatestQuantity};
pub use mail::{DueMail, MailFigures, MailState, Mails};
pub use maintenance::MaintenanceWindow;
pub use measurements::{MeasurementPlace, MeasurementQuery, StoredMeasurement};
pub use note::{Note, Notes, MOST_NOTES};
pub use outbox::{Delivery, DeliveryState, Outbox, OutboxEvent, Settlement, Turns};
pub use overview::{LatestAssessment, Overview, RelativeChange, StructureOverview};
pub use preferred_sender::PreferredSender;
pub use quarantine::{Quarantine, QuarantinedMessage};
pub use reference_version::ReferenceVersion;
#[cfg(test)]
pub(crate) use retention::remove_beside;
pub use retention::{Deleted, Expired, Retention};
pub use series::{AssessedSeries, Extent, QuantityMark, QuantitySeries, Series, SeriesWindow, TrustMark};
pub use shared_job::{AwaitedJob, JobClaim, JobResult, SharedJob};
pub use structure::{PutStructure, StructureRecord, StructureSummary, Structures};
pub use token::Tokens;
pub use training::{NewTraining, TrainingJobRecord, Trainings};
pub use undamaged::{MeasuredBatch, NewReference, ReferenceRecord, References};
pub use url::{DatabaseUrl, UrlError};
pub use version::{NewVersion, StoredBaseline};
pub use webhook::{EventFilter, Secret, WebhookRecord, Webhooks};
pub use write_queue::WritePriority;

/// The open store. Cloning it is cheap.
#[derive(Clone)]
pub struct Store {
    database: Arc<Database>,
    known_undamaged: Arc<Known>,
}

impl Store {
    /// Opens the database of a data folder; folder and database are created if they are missing.
    ///
    /// # Errors
    /// [`Error`], with one variant for each cause, whose message says what to do.
    pub async fn open(data_dir: &Path) -> Result<Self, Error> {
        Self::open_with(data_dir, &StoreSettings::default()).await
    }

    /// As [`Self::open`], with settings: with a URL, the database of that server. `data_dir` is then the folder for what is not in the
    /// database, which is not created.
    ///
    /// # Errors
    /// [`Error`], with one variant for each cause, whose message says what to do.
    pub async fn open_with(data_dir: &Path, settings: &StoreSettings) -> Result<Self, Error> {
        let limits = file::Limits::of(settings);
        let database = if let Some(url) = &settings.url {
            let takeover = settings.standby.then(|| Duration::from_secs(settings.takeover_s));
            let server::Opened { writer, reader, version } = server::open(url, takeover).await?;
            Database {
                writer: Arc::new(Writer::new(WriterPool::Postgres(Box::new(writer)))),
                reader: Reader::Postgres(reader),
                place: Place::Server { folder: data_dir.to_owned(), version },
                limits,
                damaged: DamagedRows::default(),
            }
        } else {
            let path = data_dir.join(DATABASE_FILE);
            let lock = file::prepare_folder(data_dir, &path)?;
            let volume = volume::of(data_dir).map_err(|source| Error::Folder { path: data_dir.to_owned(), source })?;
            if volume.network && !settings.allow_network_filesystem {
                let file_system = volume.file_system;
                return Err(Error::NetworkFileSystem { path: data_dir.to_owned(), file_system });
            }
            file::refuse_foreign(&path).await?;
            let file::Opened { writer, reader, sqlite_version } = file::open(&path).await?;
            let opened = file::OpenedFile::of(path.clone())?;
            Database {
                writer: Arc::new(Writer::new(WriterPool::Sqlite(writer, opened))),
                reader: Reader::Sqlite(reader),
                place: Place::File { path, version: sqlite_version, _lock: lock },
                limits,
                damaged: DamagedRows::default(),
            }
        };
        Ok(Self { database: Arc::new(database), known_undamaged: Arc::default() })
    }

    /// Closes the database, for SQLite after its log was written back.
    pub async fn close(&self) {
        let Database { reader, writer, .. } = &*self.database;
        reader.close().await;
        writer.pool.close().await;
    }

    /// The database file, its limits and its backups.
    pub fn file(&self) -> DatabaseFile<'_> {
        DatabaseFile { database: &self.database }
    }

    /// Structures, their versions, and the trained baselines that the service made for them.
    pub fn structures(&self) -> Structures<'_> {
        Structures { database: &self.database }
    }

    /// Batches and their measurements.
    pub fn batches(&self) -> Batches<'_> {
        Batches { database: &self.database }
    }

    /// Assessments of batches.
    pub fn assessments(&self) -> Assessments<'_> {
        Assessments { database: &self.database }
    }

    /// The undamaged references of the structures.
    pub fn reference(&self) -> References<'_> {
        References { database: &self.database, known: &self.known_undamaged }
    }

    /// Alarm episodes, alarm charts and maintenance windows.
    pub fn alarms(&self) -> Alarms<'_> {
        Alarms { database: &self.database }
    }

    /// What people do with alarms.
    pub fn alarm_actions(&self) -> AlarmActions<'_> {
        AlarmActions { database: &self.database }
    }

    /// Notes on time lines.
    pub fn notes(&self) -> Notes<'_> {
        Notes { database: &self.database }
    }

    /// Mails about alarms.
    pub fn mails(&self) -> Mails<'_> {
        Mails { database: &self.database }
    }

    /// Diagnoses and extensions.
    pub fn diagnoses(&self) -> Diagnoses<'_> {
        Diagnoses { database: &self.database }
    }

    /// Trainings of models.
    pub fn trainings(&self) -> Trainings<'_> {
        Trainings { database: &self.database }
    }

    /// The registered webhooks.
    pub fn webhooks(&self) -> Webhooks<'_> {
        Webhooks { database: &self.database }
    }

    /// The messages to webhooks and their deliveries.
    pub fn outbox(&self) -> Outbox<'_> {
        Outbox { database: &self.database }
    }

    /// The access tokens, of whose secrets only digests are stored.
    pub fn tokens(&self) -> Tokens<'_> {
        Tokens { database: &self.database }
    }

    /// The audit log.
    pub fn audit(&self) -> Audit<'_> {
        Audit { database: &self.database, takes_away: false }
    }

    /// Messages that could not become a batch.
    pub fn quarantine(&self) -> Quarantine<'_> {
        Quarantine { database: &self.database }
    }

    /// Deletes structures.
    pub fn deletions(&self) -> Deletions<'_> {
        Deletions { database: &self.database, known: &self.known_undamaged }
    }

    /// Deletes old batches, and counts those that would be deleted.
    pub fn retention(&self) -> Retention<'_> {
        Retention { database: &self.database }
    }

    /// Pages of batches and of exceedances.
    pub fn history(&self) -> History<'_> {
        History { database: &self.database }
    }

    /// Time series for plots.
    pub fn series(&self) -> Series<'_> {
        Series { database: &self.database }
    }

    /// Summaries of all structures.
    pub fn overview(&self) -> Overview<'_> {
        Overview { database: &self.database }
    }

    /// Export and import of one structure.
    pub fn archive(&self) -> Archive<'_> {
        Archive { database: &self.database }
    }
}

/// Opens the database of a server for a process that reads, and computes for the service that serves it: beside that service, without
/// its lock. Whatever only that service may do fails.
///
/// # Errors
/// [`Error`], with one variant for each cause, whose message says what to do.
pub async fn open_beside(data_dir: &Path, url: &DatabaseUrl) -> Result<Store, Error> {
    let server::Opened { writer, reader, version } = server::open_beside(url).await?;
    let database = Database {
        writer: Arc::new(Writer::new(WriterPool::Postgres(Box::new(writer)))),
        reader: Reader::Postgres(reader),
        place: Place::Server { folder: data_dir.to_owned(), version },
        limits: file::Limits::of(&StoreSettings::default()),
        damaged: DamagedRows::default(),
    };
    Ok(Store { database: Arc::new(database), known_undamaged: Arc::default() })
}

impl<'s> Computations<'s> {
    /// The computations that a store shares with other processes; `None` for a file, which belongs to one process.
    pub fn of(store: &'s Store) -> Option<Self> {
        let Reader::Postgres(pool) = &store.database.reader else { return None };
        Some(Self { database: &store.database, pool })
    }
}
