//! Deleting old batches, where somebody asked for it.

use std::time::Duration;

use serde::{Deserialize, Serialize};
use tracing::{error, info};

use super::upkeep::supervise;
use super::{Error, Monitor};
use crate::quantity::Timestamp;
use crate::store::{Deleted, Expired, Store};

/// Batches deleted in one transaction: others get their turn in between.
const AT_A_TIME: usize = 20;

/// Pause between two transactions.
const PAUSE: Duration = Duration::from_millis(20);

/// Wait after the start: a service that was down for long has better things to do first.
const FIRST_AFTER: Duration = Duration::from_secs(30);

const MICROS_A_DAY: i64 = 86_400_000_000;

/// How long batches are kept.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct RetentionSettings {
    /// Days after which a batch is deleted; 0 = never.
    pub measurements_days: u32,
    /// Seconds between two looks.
    pub every_s: u64,
}

impl Default for RetentionSettings {
    fn default() -> Self {
        Self { measurements_days: 0, every_s: 3_600 }
    }
}

impl RetentionSettings {
    /// The time before which measurements are not kept; `None` when all are.
    pub fn before(&self, now: Timestamp) -> Option<Timestamp> {
        let span = i64::from(self.measurements_days) * MICROS_A_DAY;
        (span > 0).then(|| Timestamp::from_micros(now.micros() - span).ok()).flatten()
    }
}

/// What became of the last look.
#[derive(Debug, Clone, PartialEq, Serialize, utoipa::ToSchema)]
pub struct RetentionRun {
    /// When it ended.
    pub at: Timestamp,
    /// What went.
    pub deleted: Deleted,
    /// Why it ended early.
    #[schema(required)]
    pub failure: Option<String>,
}

/// What is kept, and what would go.
#[derive(Debug, Clone, PartialEq, Serialize, utoipa::ToSchema)]
pub struct RetentionPlan {
    /// Days; 0 = everything is kept for ever.
    pub measurements_days: u32,
    /// The time before which measurements would go.
    #[schema(required)]
    pub before: Option<Timestamp>,
    /// What would go, by structure.
    pub would_delete: Vec<Expired>,
    /// What became of the last look of this process.
    #[schema(required)]
    pub last_run: Option<RetentionRun>,
}

/// What a number of days, or without it the settings, would delete now; nothing is deleted.
///
/// # Errors
/// [`crate::store::Error`].
pub async fn plan(store: &Store, settings: RetentionSettings) -> Result<RetentionPlan, crate::store::Error> {
    let before = settings.before(Timestamp::now());
    let would_delete = match before {
        Some(before) => store.retention().expired(before).await?,
        None => Vec::new(),
    };
    Ok(RetentionPlan { measurements_days: settings.measurements_days, before, would_delete, last_run: None })
}

/// Deletes everything older than the settings say, a few batches at a time.
///
/// # Errors
/// [`crate::store::Error`]; what was deleted before stays deleted.
pub async fn delete_expired(store: &Store, settings: RetentionSettings) -> Result<Deleted, crate::store::Error> {
    let mut all = Deleted::default();
    let Some(before) = settings.before(Timestamp::now()) else { return Ok(all) };
    loop {
        let deleted = store.retention().delete_expired(before, AT_A_TIME).await?;
        if deleted.batches == 0 {
            return Ok(all);
        }
        metrics::counter!("modalwatch_retention_deleted_batches_total").increment(deleted.batches);
        all.batches += deleted.batches;
        all.measurements += deleted.measurements;
        tokio::time::sleep(PAUSE).await;
    }
}

impl Monitor {
    /// Sets how long batches are kept.
    pub fn set_retention(&self, settings: RetentionSettings) {
        *self.upkeep.retention.lock().expect("no holder of this lock panics") = settings;
    }

    /// What became of the last look.
    pub fn last_retention(&self) -> Option<RetentionRun> {
        self.upkeep.last_retention.lock().expect("no holder of this lock panics").clone()
    }

    /// What a number of days, or without it the settings, would delete now.
    ///
    /// # Errors
    /// [`Error::Store`].
    pub async fn retention_plan(&self, days: Option<u32>) -> Result<RetentionPlan, Error> {
        let mut settings = *self.upkeep.retention.lock().expect("no holder of this lock panics");
        settings.measurements_days = days.unwrap_or(settings.measurements_days);
        Ok(RetentionPlan { last_run: self.last_retention(), ..plan(&self.store, settings).await? })
    }

    /// Deletes what is older than the settings say, again and again, for as long as the service runs. While they say that
    /// everything is kept, it only looks at them.
    pub fn watch_retention(&self) {
        let monitor = self.clone();
        supervise("retention", move || {
            let monitor = monitor.clone();
            async move {
                let settings = || *monitor.upkeep.retention.lock().expect("no holder of this lock panics");
                tokio::time::sleep(FIRST_AFTER.min(Duration::from_secs(settings().every_s))).await;
                loop {
                    let settings = settings();
                    if settings.measurements_days > 0 {
                        monitor.apply_retention(settings).await;
                    }
                    tokio::time::sleep(Duration::from_secs(settings.every_s)).await;
                }
            }
        });
    }

    async fn apply_retention(&self, settings: RetentionSettings) {
        let days = settings.measurements_days;
        let (deleted, failure) = match delete_expired(&self.store, settings).await {
            Ok(deleted) => {
                if deleted.batches > 0 {
                    let Deleted { batches, measurements } = deleted;
                    info!(
                        batches,
                        measurements,
                        days,
                        "Deleted {batches} batches older than {days} days, as retention.measurements_days says"
                    );
                }
                (deleted, None)
            }
            Err(error) => {
                error!(%error, days, "Could not delete batches older than {days} days: {error}");
                (Deleted::default(), Some(format!("batches older than {days} days could not be deleted: {error}")))
            }
        };
        let run = RetentionRun { at: Timestamp::now(), deleted, failure };
        *self.upkeep.last_retention.lock().expect("no holder of this lock panics") = Some(run);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn nothing_is_old_unless_days_are_given() {
        let now = Timestamp::parse("2026-03-31T00:00:00Z").unwrap();
        assert_eq!(RetentionSettings::default().before(now), None);
        let thirty = RetentionSettings { measurements_days: 30, ..RetentionSettings::default() };
        assert_eq!(thirty.before(now), Some(Timestamp::parse("2026-03-01T00:00:00Z").unwrap()));
    }
}
