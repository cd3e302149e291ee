//! Alarms for structures that have sent nothing for too long.

use std::sync::Arc;
use std::time::Duration;

use tracing::{error, info, warn};

use super::alarms::Alarms;
use super::error::Error;
use super::structures::ActiveStructures;
use super::supervise::supervise;
use crate::clock;
use crate::quantity::Timestamp;
use crate::store::Store;

/// Pause between two checks, which is also the largest delay of an alarm.
const EVERY: Duration = Duration::from_secs(5);

/// Opens and ends alarms of silence.
#[derive(Clone)]
pub struct Silence {
    store: Store,
    structures: Arc<ActiveStructures>,
    alarms: Arc<Alarms>,
    /// Seconds without a batch after which a structure is silent; 0 switches this off.
    after_s: u64,
}

impl Silence {
    pub(super) fn new(store: Store, structures: Arc<ActiveStructures>, alarms: Arc<Alarms>, after_s: u64) -> Self {
        Self { store, structures, alarms, after_s }
    }

    /// Checks for silent structures for as long as the service runs, in the background. When this is switched off, alarms of silence
    /// that an earlier run left open are ended.
    pub fn watch(&self) {
        let started = clock::now();
        let silence = self.clone();
        supervise("silence", move || {
            let silence = silence.clone();
            async move {
                let mut ticks = tokio::time::interval(EVERY);
                ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
                loop {
                    ticks.tick().await;
                    if let Err(failure) = silence.check(started, clock::now).await {
                        error!(error = %failure, "Could not check for silent structures: {failure}");
                    }
                    if silence.after_s == 0 {
                        return;
                    }
                }
            }
        });
    }

    /// Opens and ends alarms of silence. A structure that never sent a batch is not silent. The time before the service `started`
    /// is ignored, because nothing could be received then. During maintenance no alarm is opened.
    async fn check(&self, started: Timestamp, clock: impl Fn() -> Timestamp) -> Result<(), Error> {
        let allowed = self.after_s as i64 * 1_000_000;
        for structure in self.structures.ids() {
            let now = clock();
            let Some(last) = self.store.batches().last_received(&structure).await? else { continue };
            let overdue = allowed > 0 && now.micros() - last.max(started).micros() > allowed;
            let silent = overdue && !self.store.alarms().is_in_maintenance(&structure, now).await?;
            if self.store.alarms().set_silent(&structure, silent.then_some(last), now).await? {
                if silent {
                    warn!(structure.id = %structure, "No batch of {structure} since {last}");
                    self.alarms.report(&structure).await;
                } else {
                    info!(structure.id = %structure, "{structure} is not silent any more");
                    self.alarms.publish_changes(&structure).await;
                }
            }
        }
        Ok(())
    }
}
