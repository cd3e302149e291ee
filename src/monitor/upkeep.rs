//! The health of the service, and its background tasks.

use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use serde::Serialize;

use super::automatic_diagnoses::AutomaticDiagnoses;
use super::automatic_trainings::AutomaticTrainings;
use super::backups::Backups;
use super::compute::Compute;
use super::error::Error;
use super::metrics::process_figures;
use super::models::Models;
use super::probe::WriterProbe;
use super::reason::Reason;
use super::retention::Retention;
use super::silence::Silence;
use super::structures::ActiveStructures;
use crate::alarm::ALARM_KINDS;
use crate::store::{Error as Unreadable, FolderFigures, Store};

/// Number of rows that the health names.
const MOST_NAMED: usize = 5;

/// How long a search for unreadable references is used.
const UNREADABLE_FRESH_FOR: Duration = Duration::from_secs(5);

/// Whether batches can be stored and assessed, and what is degraded.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, utoipa::ToSchema)]
pub struct Health {
    /// True when a batch sent now would be stored, and assessed for at least one structure.
    pub ready: bool,
    /// Why not; empty when ready.
    pub reasons: Vec<Reason>,
    /// What is degraded, without being a reason to take the service out of use.
    pub findings: Vec<Reason>,
}

/// Returns findings whenever the health is read; it must not block.
type FindingSource = Box<dyn Fn() -> Vec<Reason> + Send + Sync>;

/// What stored data cannot be read, and when this was looked for.
pub(super) type LookedFor = (Instant, Vec<Reason>);

/// The health of the service, and its background tasks.
#[derive(Clone)]
pub struct Upkeep {
    pub(super) store: Store,
    pub(super) structures: Arc<ActiveStructures>,
    pub(super) models: Models,
    pub(super) compute: Compute,
    pub(super) probe: WriterProbe,
    pub(super) backups: Backups,
    pub(super) retention: Retention,
    pub(super) silence: Silence,
    pub(super) diagnoses: AutomaticDiagnoses,
    pub(super) trainings: AutomaticTrainings,
    pub(super) sources: Arc<Mutex<Vec<FindingSource>>>,
    pub(super) unreadable: Arc<tokio::sync::Mutex<Option<LookedFor>>>,
    pub(super) started: Instant,
}

impl Upkeep {
    /// Makes and lists backups.
    pub fn backups(&self) -> &Backups {
        &self.backups
    }

    /// Deletes old batches if this is configured.
    pub fn retention(&self) -> &Retention {
        &self.retention
    }

    /// Opens and ends alarms for structures that send no batches.
    pub fn silence(&self) -> &Silence {
        &self.silence
    }

    /// Starts diagnoses after rejected batches and on schedule.
    pub fn diagnoses(&self) -> &AutomaticDiagnoses {
        &self.diagnoses
    }

    /// Starts trainings with the first batches of structures without a model.
    pub fn trainings(&self) -> &AutomaticTrainings {
        &self.trainings
    }

    /// Number of free places in the queue of assessments.
    pub fn free_places(&self) -> usize {
        self.compute.free()
    }

    /// Number of structures with a trained baseline in use.
    pub fn baselines_in_use(&self) -> usize {
        self.structures.models_in_use().len()
    }

    /// Adds a source of findings for the health, such as a webhook that fails or a broker that is unreachable.
    pub fn report_findings_from(&self, source: impl Fn() -> Vec<Reason> + Send + Sync + 'static) {
        self.sources.lock().expect("no holder of this lock panics").push(Box::new(source));
    }

    /// Checks everything that is needed to store and assess a batch. The test whether the database can be written is at most one
    /// second old.
    pub async fn health(&self) -> Health {
        let mut reasons: Vec<Reason> = self.probe.finding().await.into_iter().collect();
        if self.baselines_in_use() == 0 {
            reasons.push(Reason::new("no_model", "no trained model is in use"));
        }
        let mut findings = self.findings(reasons.is_empty());
        findings.extend(self.unreadable().await);
        findings.extend(self.left_out());
        Health { ready: reasons.is_empty(), reasons, findings }
    }

    /// Undamaged references that cannot be read, at most some seconds old.
    async fn unreadable(&self) -> Vec<Reason> {
        let mut last = self.unreadable.lock().await;
        if let Some((_, found)) = last.as_ref().filter(|(at, _)| at.elapsed() < UNREADABLE_FRESH_FOR) {
            return found.clone();
        }
        let mut found = Vec::new();
        for structure in self.structures.ids() {
            if let Err(error @ Unreadable::Row { .. }) = self.store.reference().undamaged(&structure).await {
                let message =
                    format!("{structure}: {error}; its batches are stored and wait; `modalwatch doctor` has more");
                found.push(Reason::new("stored_data_unreadable", message));
            }
        }
        *last = Some((Instant::now(), found.clone()));
        found
    }

    /// Stored rows that were left out of answers within the last hour.
    fn left_out(&self) -> Option<Reason> {
        let rows = self.store.file().unreadable_rows();
        let named = rows.iter().take(MOST_NAMED).cloned().collect::<Vec<_>>().join("; ");
        let further =
            if rows.len() > MOST_NAMED { format!("; and {} more", rows.len() - MOST_NAMED) } else { String::new() };
        (!rows.is_empty()).then(|| {
            let message = format!(
                "{} stored row(s) cannot be read and are left out of answers: {named}{further}; restore a backup; `modalwatch doctor` looks for further damage",
                rows.len()
            );
            Reason::new("stored_data_unreadable", message)
        })
    }

    /// True unless the writer of the database hangs: a full disk is no reason to restart the service.
    pub async fn writer_responds(&self) -> bool {
        self.probe.responds().await
    }

    /// What is degraded. A full queue is among the findings and not among the reasons: a busy service must not be restarted.
    fn findings(&self, writable: bool) -> Vec<Reason> {
        let mut findings = self.disk_findings(writable);
        if self.free_places() == 0 {
            findings.push(Reason::new(
                "queue_full",
                "the queue of assessments is full: further batches are refused with 503",
            ));
        }
        for refusal in self.structures.library().refusals() {
            findings.push(Reason::new("model_refused", format!("{}: {}", refusal.file, refusal.reason)));
        }
        findings.extend(self.structures.calibration_findings());
        for (structure, reason) in &self.structures.refused() {
            let message = format!("structure {structure} is not monitored: {reason}");
            findings.push(Reason::new("definition_refused", message));
        }
        for (structure, reason) in self.models.refused() {
            let message =
                format!("the last reload of the trained model of {structure} was refused, and the previous one stays in use: {reason}");
            findings.push(Reason::new("model_reload_refused", message));
        }
        let failed = self.retention.last_run().and_then(|run| run.failure);
        findings.extend(failed.map(|failure| Reason::new("retention_failed", failure)));
        for source in self.sources.lock().expect("no holder of this lock panics").iter() {
            findings.extend(source());
        }
        findings
    }

    fn disk_findings(&self, writable: bool) -> Vec<Reason> {
        let mut findings = Vec::new();
        let Ok(files) = FolderFigures::of(self.store.file().folder()) else { return findings };
        let (wal, most) = (files.wal_bytes, self.store.file().max_wal_bytes());
        if wal > most {
            let message = format!(
                "the write-ahead log has {wal} bytes, more than {most}: a long read, such as a backup, prevents it from being \
                 written back"
            );
            findings.push(Reason::new("wal_large", message));
        }
        let (free, floor) = (files.volume.free_bytes, self.store.file().min_free_bytes());
        if writable && free < floor.saturating_mul(2) {
            let message = format!("{free} bytes are free; below {floor} nothing more is stored");
            findings.push(Reason::new("disk_nearly_full", message));
        }
        findings
    }

    /// Sets the gauges whose values are read from their source and not counted.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn set_gauges(&self) -> Result<(), Error> {
        metrics::gauge!("modalwatch_uptime_seconds").set(self.started.elapsed().as_secs_f64());
        metrics::gauge!("modalwatch_queue_free_places").set(self.free_places() as f64);
        metrics::gauge!("modalwatch_baselines_in_use").set(self.baselines_in_use() as f64);
        metrics::gauge!("modalwatch_unreadable_rows").set(self.store.file().unreadable_rows().len() as f64);
        if let Ok(files) = FolderFigures::of(self.store.file().folder()) {
            metrics::gauge!("modalwatch_database_bytes").set(files.database_bytes as f64);
            metrics::gauge!("modalwatch_wal_bytes").set(files.wal_bytes as f64);
            metrics::gauge!("modalwatch_disk_free_bytes").set(files.volume.free_bytes as f64);
        }
        let (resident, open_files) = process_figures();
        metrics::gauge!("modalwatch_resident_memory_bytes").set(resident);
        metrics::gauge!("modalwatch_open_files").set(open_files);
        let figures = self.store.overview().figures().await?;
        metrics::gauge!("modalwatch_structures").set(figures.structures as f64);
        metrics::gauge!("modalwatch_pending_batches").set(figures.pending_batches as f64);
        for kind in ALARM_KINDS {
            let found = figures.open_alarms.iter().find(|(name, ..)| name == kind);
            let (open, unacknowledged) = found.map_or((0, 0), |(_, open, unacknowledged)| (*open, *unacknowledged));
            metrics::gauge!("modalwatch_open_alarms", "kind" => kind).set(open as f64);
            metrics::gauge!("modalwatch_unacknowledged_alarms", "kind" => kind).set(unacknowledged as f64);
        }
        Ok(())
    }
}
