//! Keeping the service in order: is it ready, what is degraded, backups, and tasks that must not die.

use std::collections::BTreeMap;
use std::future::Future;
use std::sync::Mutex;
use std::time::{Duration, Instant};

use serde::Serialize;
use tracing::{error, info};

use super::retention::{RetentionRun, RetentionSettings};
use super::{Error, Monitor};
use crate::alarm::ALARM_KINDS;
use crate::quantity::{StructureId, Timestamp};
use crate::store::{self, backup, FolderFigures};

/// Pause before a task that panicked is started again: one that always does would spin.
const PAUSE_AFTER_PANIC: Duration = Duration::from_secs(1);

/// Something a person should know, with a stable code.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, utoipa::ToSchema)]
pub struct Reason {
    /// Stable code.
    pub code: &'static str,
    /// For people.
    pub message: String,
}

impl Reason {
    /// A reason.
    pub fn new(code: &'static str, message: impl Into<String>) -> Self {
        Self { code, message: message.into() }
    }
}

/// Whether batches can be taken and assessed, and what else is wrong.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, utoipa::ToSchema)]
pub struct Health {
    /// True when a batch posted now would be stored, and assessed for at least one structure.
    pub ready: bool,
    /// Why not; empty when ready.
    pub reasons: Vec<Reason>,
    /// What is degraded; no reason to take the service out of use.
    pub findings: Vec<Reason>,
}

/// Asked for findings at each look; it must answer at once.
type FindingSource = Box<dyn Fn() -> Vec<Reason> + Send + Sync>;

/// State of what is done beside the batches.
pub(super) struct Upkeep {
    started: Instant,
    sources: Mutex<Vec<FindingSource>>,
    backing_up: tokio::sync::Mutex<()>,
    /// Held while a trained baseline is put in the place of another.
    pub(super) reloading: tokio::sync::Mutex<()>,
    /// Why the last reload of a structure's baseline was refused, until one succeeds.
    pub(super) refused_reloads: Mutex<BTreeMap<StructureId, String>>,
    pub(super) retention: Mutex<RetentionSettings>,
    pub(super) last_retention: Mutex<Option<RetentionRun>>,
}

impl Default for Upkeep {
    fn default() -> Self {
        Self {
            started: Instant::now(),
            sources: Mutex::default(),
            backing_up: tokio::sync::Mutex::default(),
            reloading: tokio::sync::Mutex::default(),
            refused_reloads: Mutex::default(),
            retention: Mutex::default(),
            last_retention: Mutex::default(),
        }
    }
}

impl Monitor {
    /// Adds a source of findings for `/readyz`: a webhook that fails, a broker that is gone.
    pub fn report_findings_from(&self, source: impl Fn() -> Vec<Reason> + Send + Sync + 'static) {
        self.upkeep.sources.lock().expect("no holder of this lock panics").push(Box::new(source));
    }

    /// Looks at everything that a batch needs; whether anything can be written is known as of a second ago at most.
    pub async fn health(&self) -> Health {
        let mut reasons: Vec<Reason> = self.probe.finding().await.into_iter().collect();
        if self.baselines_in_use() == 0 {
            reasons.push(Reason::new("no_model", "no trained baseline is in use"));
        }
        let findings = self.findings(reasons.is_empty());
        Health { ready: reasons.is_empty(), reasons, findings }
    }

    /// What is degraded. A full queue is among them and no reason: who is busy must not be taken for dead and restarted.
    fn findings(&self, has_room: bool) -> Vec<Reason> {
        let mut findings = Vec::new();
        let files = FolderFigures::of(self.store.folder());
        if let Ok(files) = &files {
            let (wal, most) = (files.wal_bytes, self.store.max_wal_bytes());
            if wal > most {
                let message = format!(
                    "the write-ahead log has {wal} bytes, more than {most}: a long reader, such as a backup, keeps it from being \
                     written back"
                );
                findings.push(Reason::new("wal_large", message));
            }
            let (free, floor) = (files.volume.free_bytes, self.store.min_free_bytes());
            if has_room && free < floor.saturating_mul(2) {
                let message = format!("{free} bytes are free; below {floor} nothing is stored any more");
                findings.push(Reason::new("disk_nearly_full", message));
            }
        }
        if self.free_places() == 0 {
            findings.push(Reason::new(
                "queue_full",
                "as many batches as may wait are waiting: further ones are answered 503",
            ));
        }
        for refusal in self.refusals() {
            findings.push(Reason::new("model_refused", format!("{}: {}", refusal.file, refusal.reason)));
        }
        for (structure, reason) in self.refused_structures() {
            findings.push(Reason::new("definition_refused", format!("structure {structure} is not watched: {reason}")));
        }
        for (structure, reason) in self.upkeep.refused_reloads.lock().expect("no holder of this lock panics").iter() {
            let message = format!("the last reload for {structure} was refused, the baseline before serves: {reason}");
            findings.push(Reason::new("model_reload_refused", message));
        }
        let failed = self.last_retention().and_then(|run| run.failure);
        if let Some(failure) = failed {
            findings.push(Reason::new("retention_failed", failure));
        }
        for source in self.upkeep.sources.lock().expect("no holder of this lock panics").iter() {
            findings.extend(source());
        }
        findings
    }

    /// True when the writer takes turns at all: a full disk is no reason to restart, a writer that hangs is.
    pub async fn writer_takes_turns(&self) -> bool {
        self.probe.takes_turns().await
    }

    /// Makes a backup under a name, or under one made of the time.
    ///
    /// It runs in a task of its own: a client that goes away does not stop it half-way.
    ///
    /// # Errors
    /// [`Error::BackupRunning`], [`Error::Backup`].
    pub async fn back_up(&self, name: Option<String>) -> Result<backup::Manifest, Error> {
        let monitor = self.clone();
        let task = tokio::spawn(async move { monitor.back_up_here(name).await });
        task.await.map_err(|_| Error::Panicked)?
    }

    async fn back_up_here(&self, name: Option<String>) -> Result<backup::Manifest, Error> {
        let _turn = self.upkeep.backing_up.try_lock().map_err(|_| Error::BackupRunning)?;
        let name = name.unwrap_or_else(backup::name_of_now);
        let started = Instant::now();
        let made = self.store.backup(&name, self.models_in_use().await).await;
        let outcome = if made.is_ok() { "done" } else { "failed" };
        metrics::counter!("modalwatch_backups_total", "outcome" => outcome).increment(1);
        match &made {
            Ok(manifest) => {
                let duration_ms = started.elapsed().as_secs_f64() * 1e3;
                metrics::gauge!("modalwatch_last_backup_timestamp_seconds").set(seconds_since_1970());
                info!(backup = %manifest.name, bytes = manifest.bytes, duration_ms, "Made backup {name}");
            }
            Err(error) => error!(backup = %name, %error, "Could not make backup {name}: {error}"),
        }
        made.map_err(Error::Backup)
    }

    /// The trained baselines in use that are not in the database.
    async fn models_in_use(&self) -> Vec<backup::Model> {
        let in_use: Vec<_> = self
            .lock_read()
            .iter()
            .filter_map(|(id, watched)| Some((id.to_string(), watched.baseline.as_ref().ok()?.digest().clone())))
            .collect();
        let library = self.library();
        // Files are read, and hashed.
        let found = tokio::task::spawn_blocking(move || {
            let model = |(structure, digest): (String, crate::quantity::Digest)| {
                let files = library.files_of(&digest).ok().flatten()?;
                Some(backup::Model { structure, digest: digest.to_string(), kept_in: files.kept_in })
            };
            in_use.into_iter().filter_map(model).collect()
        });
        found.await.unwrap_or_default()
    }

    /// Sets the gauges of what can only be counted by looking.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn look_at_gauges(&self) -> Result<(), Error> {
        metrics::gauge!("modalwatch_uptime_seconds").set(self.upkeep.started.elapsed().as_secs_f64());
        metrics::gauge!("modalwatch_queue_free_places").set(self.free_places() as f64);
        metrics::gauge!("modalwatch_baselines_in_use").set(self.baselines_in_use() as f64);
        if let Ok(files) = FolderFigures::of(self.store.folder()) {
            metrics::gauge!("modalwatch_database_bytes").set(files.database_bytes as f64);
            metrics::gauge!("modalwatch_wal_bytes").set(files.wal_bytes as f64);
            metrics::gauge!("modalwatch_disk_free_bytes").set(files.volume.free_bytes as f64);
        }
        let (resident, open_files) = process_figures();
        metrics::gauge!("modalwatch_resident_memory_bytes").set(resident);
        metrics::gauge!("modalwatch_open_files").set(open_files);
        let figures = self.store.figures().await?;
        metrics::gauge!("modalwatch_structures").set(figures.structures as f64);
        metrics::gauge!("modalwatch_pending_batches").set(figures.pending_batches as f64);
        for kind in ALARM_KINDS {
            let found = figures.open_alarms.iter().find(|(name, ..)| name == kind);
            let (open, unseen) = found.map_or((0, 0), |(_, open, unseen)| (*open, *unseen));
            metrics::gauge!("modalwatch_open_alarms", "kind" => kind).set(open as f64);
            metrics::gauge!("modalwatch_unacknowledged_alarms", "kind" => kind).set(unseen as f64);
        }
        Ok(())
    }
}

/// What the metrics mean, in the unit that their name ends with.
const MEANINGS: [(&str, &str); 34] = [
    ("modalwatch_alarms_total", "Alarms raised."),
    ("modalwatch_assessment_seconds", "Time of an assessment."),
    ("modalwatch_assessments_failed_total", "Batches that could not be assessed."),
    ("modalwatch_assessments_total", "Batches assessed."),
    ("modalwatch_backups_total", "Backups, by outcome."),
    ("modalwatch_baselines_in_use", "Structures with a trained baseline in use."),
    ("modalwatch_batches_received_total", "New batches stored."),
    ("modalwatch_build_info", "Program and SQLite; always 1."),
    ("modalwatch_database_bytes", "Size of the database file."),
    ("modalwatch_disk_free_bytes", "Free room beside the database."),
    ("modalwatch_findings", "What is degraded, by GET /readyz."),
    ("modalwatch_http_request_seconds", "Time of an answer."),
    ("modalwatch_http_requests_total", "Requests answered."),
    ("modalwatch_last_backup_timestamp_seconds", "When this process made its last backup; 0 = never."),
    ("modalwatch_measurements_received_total", "Measurements in new batches."),
    ("modalwatch_model_reloads_total", "Reloads of a trained baseline, by outcome."),
    ("modalwatch_mqtt_connected", "1 while batches can arrive from the broker."),
    ("modalwatch_mqtt_messages_total", "Messages from the broker, by outcome."),
    ("modalwatch_open_alarms", "Alarms that last."),
    ("modalwatch_open_files", "Files open in this process."),
    ("modalwatch_pending_batches", "Batches that wait for their assessment."),
    ("modalwatch_queue_free_places", "Assessments that could still be taken in."),
    ("modalwatch_ready", "1 when batches are taken and assessed."),
    ("modalwatch_resident_memory_bytes", "Memory of this process."),
    ("modalwatch_retention_deleted_batches_total", "Batches deleted because they were old."),
    ("modalwatch_structures", "Structures defined."),
    ("modalwatch_unacknowledged_alarms", "Alarms that last and that nobody has acknowledged."),
    ("modalwatch_uptime_seconds", "Time since the start."),
    ("modalwatch_wal_bytes", "Size of the write-ahead log."),
    ("modalwatch_webhook_dead", "Messages that were given up."),
    ("modalwatch_webhook_deliveries_total", "Attempts to deliver a message, by outcome."),
    ("modalwatch_webhook_pending", "Messages that wait for their receiver."),
    ("modalwatch_worker_restarts_total", "Background tasks started again after a panic."),
    ("modalwatch_write_failures_total", "Writes that the disk refused, by cause."),
];

/// Makes the metrics known that would otherwise appear with their first event: a rate over a counter that begins with 1
/// misses that one, and an alert on what is not there never fires. To be called when the recorder is in place.
pub fn declare_metrics(sqlite_version: &str) {
    for (name, meaning) in MEANINGS {
        match name {
            _ if name.ends_with("_total") => metrics::describe_counter!(name, meaning),
            "modalwatch_assessment_seconds" | "modalwatch_http_request_seconds" => {
                metrics::describe_histogram!(name, meaning);
            }
            _ => metrics::describe_gauge!(name, meaning),
        }
    }
    let labels = [("version", env!("CARGO_PKG_VERSION").to_owned()), ("sqlite_version", sqlite_version.to_owned())];
    metrics::gauge!("modalwatch_build_info", &labels).set(1.0);
    for name in [
        "modalwatch_batches_received_total",
        "modalwatch_measurements_received_total",
        "modalwatch_assessments_total",
        "modalwatch_assessments_failed_total",
        "modalwatch_retention_deleted_batches_total",
    ] {
        metrics::counter!(name).increment(0);
    }
    for kind in ALARM_KINDS {
        metrics::counter!("modalwatch_alarms_total", "kind" => kind).increment(0);
    }
    for outcome in ["done", "failed"] {
        metrics::counter!("modalwatch_backups_total", "outcome" => outcome).increment(0);
    }
    for outcome in ["swapped", "unchanged", "refused"] {
        metrics::counter!("modalwatch_model_reloads_total", "outcome" => outcome).increment(0);
    }
    for cause in ["disk_full", "disk_failed", "read_only", "database_busy"] {
        metrics::counter!("modalwatch_write_failures_total", "cause" => cause).increment(0);
    }
    for worker in ["silence", "retention"] {
        metrics::counter!("modalwatch_worker_restarts_total", "worker" => worker).increment(0);
    }
    metrics::gauge!("modalwatch_last_backup_timestamp_seconds").set(0.0);
}

/// Runs a background task for as long as the service does; one that panics is logged, counted and started again.
pub(super) fn supervise<F, Fut>(name: &'static str, work: F)
where
    F: Fn() -> Fut + Send + 'static,
    Fut: Future<Output = ()> + Send + 'static,
{
    tokio::spawn(async move {
        while let Err(ended) = tokio::spawn(work()).await {
            if !ended.is_panic() {
                return;
            }
            error!(worker = name, "The task {name} panicked and is started again: a bug");
            metrics::counter!("modalwatch_worker_restarts_total", "worker" => name).increment(1);
            tokio::time::sleep(PAUSE_AFTER_PANIC).await;
        }
    });
}

fn seconds_since_1970() -> f64 {
    Timestamp::now().micros() as f64 / 1e6
}

/// Bytes in memory and files open, as Linux counts them; 0 elsewhere.
fn process_figures() -> (f64, f64) {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let resident = status.lines().find_map(|line| line.strip_prefix("VmRSS:")?.trim().strip_suffix(" kB"));
    let kilobytes: f64 = resident.and_then(|text| text.trim().parse().ok()).unwrap_or(0.0);
    let files = std::fs::read_dir("/proc/self/fd").map_or(0, std::iter::Iterator::count);
    (kilobytes * 1024.0, files as f64)
}

impl Error {
    /// The failure of the disk or the database behind this, if that is what it is.
    pub fn store_failure(&self) -> Option<&store::Error> {
        match self {
            Self::Store(error) | Self::Backup(backup::Error::Store(error)) => Some(error),
            _ => None,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::sync::Arc;

    #[tokio::test]
    async fn a_task_that_panics_is_started_again_and_one_that_ends_is_not() {
        let runs = Arc::new(AtomicUsize::new(0));
        let counted = Arc::clone(&runs);
        supervise("test", move || {
            let counted = Arc::clone(&counted);
            async move {
                assert!(counted.fetch_add(1, Ordering::SeqCst) >= 2, "the first two runs panic");
            }
        });
        // Two pauses, and as many again for a machine that is busy; one that ended is not started in the third.
        tokio::time::sleep(5 * PAUSE_AFTER_PANIC).await;
        assert_eq!(runs.load(Ordering::SeqCst), 3);
    }
}
