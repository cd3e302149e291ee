//! Structures that fell silent.

use std::time::Duration;

use tracing::{error, info, warn};

use super::{Error, Monitor};
use crate::quantity::Timestamp;

/// Seconds between two looks: an alarm for silence is never later than this.
const EVERY: Duration = Duration::from_secs(5);

impl Monitor {
    /// Looks after silent structures for as long as the service runs, in a task of its own. When it is switched off, alarms of
    /// silence that an earlier run left are ended.
    pub fn watch_for_silence(&self) {
        let started = Timestamp::now();
        let monitor = self.clone();
        super::upkeep::supervise("silence", move || {
            let monitor = monitor.clone();
            async move {
                let mut ticks = tokio::time::interval(EVERY);
                ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
                loop {
                    ticks.tick().await;
                    if let Err(failure) = monitor.look_for_silence(started).await {
                        error!(error = %failure, "Could not look for silent structures: {failure}");
                    }
                    if monitor.settings.alarm.silence_after_s == 0 {
                        return;
                    }
                }
            }
        });
    }

    /// Opens and ends alarms of silence. A structure that never sent anything is not silent, it has not begun; while the
    /// service was down, nobody could send; and in maintenance silence is no news.
    async fn look_for_silence(&self, started: Timestamp) -> Result<(), Error> {
        let allowed = self.settings.alarm.silence_after_s as i64 * 1_000_000;
        let structures: Vec<_> = self.lock_read().keys().cloned().collect();
        for structure in structures {
            let now = Timestamp::now();
            let Some(last) = self.store.batches().last_received(&structure).await? else { continue };
            let overdue = allowed > 0 && now.micros() - last.max(started).micros() > allowed;
            let silent = overdue && !self.store.alarms().is_in_maintenance(&structure, now).await?;
            if self.store.alarms().set_silent(&structure, silent.then_some(last), now).await? {
                if silent {
                    warn!(structure.id = %structure, "No batch of {structure} since {last}");
                    self.report_episodes(&structure).await;
                } else {
                    info!(structure.id = %structure, "{structure} is not silent any more");
                    self.tell_alarms(&structure).await;
                }
            }
        }
        Ok(())
    }
}
