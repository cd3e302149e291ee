//! Deletion of old batches, which happens only if it is configured.

use std::sync::{Arc, Mutex};
use std::time::Duration;

use serde::{Deserialize, Serialize};
use tracing::{error, info};

use super::error::Error;
use super::supervise::supervise;
use crate::clock;
use crate::quantity::{StructureId, Timestamp};
use crate::store::{Deleted, Expired, Store};

/// Batches deleted in one transaction; other writes take place between two transactions.
const AT_A_TIME: usize = 20;

/// Pause between two transactions.
const PAUSE: Duration = Duration::from_millis(20);

/// Delay after the start, when assessments that wait are more urgent.
const FIRST_AFTER: Duration = Duration::from_secs(30);

const MICROS_A_DAY: i64 = 86_400_000_000;

/// How long batches are kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RetentionSettings {
    /// Days after which a batch is deleted; 0 = never.
    pub measurements_days: u32,
    /// Seconds between two runs.
    pub every_s: u64,
}

impl Default for RetentionSettings {
    fn default() -> Self {
        Self { measurements_days: 0, every_s: 3_600 }
    }
}

impl RetentionSettings {
    /// The time before which measurements are deleted; `None` when all are kept.
    pub fn before(&self, now: Timestamp) -> Option<Timestamp> {
        let span = i64::from(self.measurements_days) * MICROS_A_DAY;
        (span > 0).then(|| Timestamp::from_micros(now.micros() - span).ok()).flatten()
    }
}

/// The result of a run.
#[derive(Debug, Clone, PartialEq, Serialize, utoipa::ToSchema)]
pub struct RetentionRun {
    /// When it ended.
    pub at: Timestamp,
    /// What was deleted.
    pub deleted: Deleted,
    /// Why it ended early.
    #[schema(required)]
    pub failure: Option<String>,
}

/// What is kept, and what would be deleted.
#[derive(Debug, Clone, PartialEq, Serialize, utoipa::ToSchema)]
pub struct RetentionPlan {
    /// Days for which batches are kept; 0 means that they are never deleted.
    pub measurements_days: u32,
    /// The time before which measurements would be deleted.
    #[schema(required)]
    pub before: Option<Timestamp>,
    /// What would be deleted, by structure.
    pub would_delete: Vec<Expired>,
    /// The result of the last run of this process.
    #[schema(required)]
    pub last_run: Option<RetentionRun>,
}

/// What these settings would delete at the time `now`; nothing is deleted.
///
/// # Errors
/// [`crate::store::Error`].
pub async fn plan(
    store: &Store,
    settings: RetentionSettings,
    now: Timestamp,
) -> Result<RetentionPlan, crate::store::Error> {
    let before = settings.before(now);
    let would_delete = match before {
        Some(before) => store.retention().expired(before).await?,
        None => Vec::new(),
    };
    Ok(RetentionPlan { measurements_days: settings.measurements_days, before, would_delete, last_run: None })
}

/// Deletes the batches that are too old at the time `now` according to the settings, a few at a time.
///
/// # Errors
/// [`crate::store::Error`]; what was deleted before stays deleted.
pub async fn delete_expired(
    store: &Store,
    settings: RetentionSettings,
    now: Timestamp,
) -> Result<Deleted, crate::store::Error> {
    let mut all = Deleted::default();
    let Some(before) = settings.before(now) else { return Ok(all) };
    // Read without keeping anybody from writing.
    for expired in store.retention().expired(before).await? {
        let Ok(structure) = StructureId::parse(&expired.structure) else { continue };
        loop {
            let deleted = store.retention().delete_expired(&structure, before, AT_A_TIME).await?;
            if deleted.batches == 0 {
                break;
            }
            metrics::counter!("modalwatch_retention_deleted_batches_total").increment(deleted.batches);
            all.batches += deleted.batches;
            all.measurements += deleted.measurements;
            tokio::time::sleep(PAUSE).await;
        }
    }
    Ok(all)
}

/// Deletes old batches while the service runs.
#[derive(Clone)]
pub struct Retention {
    store: Store,
    settings: Arc<Mutex<RetentionSettings>>,
    last_run: Arc<Mutex<Option<RetentionRun>>>,
}

impl Retention {
    pub(super) fn new(store: Store) -> Self {
        Self { store, settings: Arc::default(), last_run: Arc::default() }
    }

    /// Sets how long batches are kept.
    pub fn set(&self, settings: RetentionSettings) {
        *self.settings.lock().expect("no holder of this lock panics") = settings;
    }

    /// The result of the last run of this process.
    pub fn last_run(&self) -> Option<RetentionRun> {
        self.last_run.lock().expect("no holder of this lock panics").clone()
    }

    /// What would be deleted now when batches are kept for this number of days, by default that of the settings.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn plan(&self, days: Option<u32>) -> Result<RetentionPlan, Error> {
        let mut settings = self.settings();
        settings.measurements_days = days.unwrap_or(settings.measurements_days);
        Ok(RetentionPlan { last_run: self.last_run(), ..plan(&self.store, settings, clock::now()).await? })
    }

    /// Deletes old batches regularly for as long as the service runs, in the background.
    pub fn watch(&self) {
        let retention = self.clone();
        supervise("retention", move || {
            let retention = retention.clone();
            async move {
                tokio::time::sleep(FIRST_AFTER.min(Duration::from_secs(retention.settings().every_s))).await;
                loop {
                    let settings = retention.settings();
                    if settings.measurements_days > 0 {
                        retention.apply(settings).await;
                    }
                    tokio::time::sleep(Duration::from_secs(settings.every_s)).await;
                }
            }
        });
    }

    fn settings(&self) -> RetentionSettings {
        *self.settings.lock().expect("no holder of this lock panics")
    }

    async fn apply(&self, settings: RetentionSettings) {
        let days = settings.measurements_days;
        let (deleted, failure) = match delete_expired(&self.store, settings, clock::now()).await {
            Ok(deleted) => {
                if deleted.batches > 0 {
                    let Deleted { batches, measurements } = deleted;
                    info!(
                        batches,
                        measurements,
                        days,
                        "Deleted {batches} batches older than {days} days, according to retention.measurements_days"
                    );
                }
                (deleted, None)
            }
            Err(error) => {
                error!(%error, days, "Could not delete batches older than {days} days: {error}");
                (Deleted::default(), Some(format!("batches older than {days} days could not be deleted: {error}")))
            }
        };
        let run = RetentionRun { at: clock::now(), deleted, failure };
        *self.last_run.lock().expect("no holder of this lock panics") = Some(run);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_expires_unless_days_are_configured() {
        let now = Timestamp::parse("2026-03-31T00:00:00Z").unwrap();
        assert_eq!(RetentionSettings::default().before(now), None);
        let thirty = RetentionSettings { measurements_days: 30, ..RetentionSettings::default() };
        assert_eq!(thirty.before(now), Some(Timestamp::parse("2026-03-01T00:00:00Z").unwrap()));
    }
}
