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

/// Pause between two checks where the time allowed is at least an hour.
const EVERY_MINUTE: Duration = Duration::from_mins(1);

/// Number of pauses between batches from which the rhythm of a structure is learned.
const PAUSES: usize = 20;

/// Multiple of a long pause that is still no silence, and the shortest time that is one, µs.
const PATIENCE: i64 = 4;
const LEAST_US: i64 = 3_600_000_000;

/// Opens and ends alarms of silence.
#[derive(Clone)]
pub struct Silence {
    store: Store,
    structures: Arc<ActiveStructures>,
    alarms: Arc<Alarms>,
    /// Seconds without a batch after which a structure is silent; 0 switches this off, `None` learns it from each structure's rhythm.
    after_s: Option<u64>,
}

impl Silence {
    pub(super) fn new(
        store: Store,
        structures: Arc<ActiveStructures>,
        alarms: Arc<Alarms>,
        after_s: Option<u64>,
    ) -> Self {
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
                let mut ticks = tokio::time::interval(if silence.after_s.is_some() { EVERY } else { EVERY_MINUTE });
                ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
                loop {
                    ticks.tick().await;
                    if let Err(failure) = silence.check(started, clock::now).await {
                        error!(error = %failure, "Could not check for silent structures: {failure}");
                    }
                    if silence.after_s == Some(0) {
                        return;
                    }
                }
            }
        });
    }

    /// Opens and ends alarms of silence. A structure that never sent a batch is not silent. The time before the service `started`
    /// is ignored, because nothing could be received then. During maintenance no alarm is opened.
    async fn check(&self, started: Timestamp, clock: impl Fn() -> Timestamp) -> Result<(), Error> {
        for structure in self.structures.ids() {
            let now = clock();
            let arrivals = self.store.batches().arrivals(&structure, PAUSES + 1).await?;
            let Some([last, _]) = arrivals.first().copied() else { continue };
            let allowed = match self.after_s {
                Some(after_s) => (after_s as i64).saturating_mul(1_000_000),
                None => learned(&arrivals),
            };
            // Without a rhythm, nothing is known: an alarm that is open stays.
            if allowed == 0 && self.after_s.is_none() {
                continue;
            }
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

/// Time without a batch that is silence, µs: a multiple of the second longest pause, because a single one may be a wrong clock or a repair; 0,
/// never, before a rhythm is known. `arrivals`: arrival and last measurement of the newest batches, the newest first.
fn learned(arrivals: &[[Timestamp; 2]]) -> i64 {
    if arrivals.len() <= PAUSES {
        return 0;
    }
    let long = |column: usize| {
        let pause = |pair: &[[Timestamp; 2]]| (pair[0][column].micros() - pair[1][column].micros()).abs();
        let mut pauses: Vec<i64> = arrivals.windows(2).map(pause).collect();
        pauses.sort_unstable();
        pauses[pauses.len() - 2]
    };
    long(0).max(long(1)).saturating_mul(PATIENCE).max(LEAST_US)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Batches that arrive a minute after their measurement, with these pauses in seconds before each.
    fn arrivals(pauses_s: &[i64]) -> Vec<[Timestamp; 2]> {
        let at = |second: i64| Timestamp::from_micros(1_000_000 * second).unwrap();
        let mut second = 0;
        let mut all = vec![[at(60), at(0)]];
        for pause in pauses_s {
            second += pause;
            all.push([at(second + 60), at(second)]);
        }
        all.reverse();
        all
    }

    #[test]
    fn silence_is_several_of_the_long_pauses_and_one_of_them_does_not_count() {
        let hours = |us: i64| us as f64 / 3_600e6;
        let mut daily = vec![86_400; 20];
        assert!((hours(learned(&arrivals(&daily))) - 96.0).abs() < 1e-9);
        daily[7] = 40 * 86_400;
        assert!((hours(learned(&arrivals(&daily))) - 96.0).abs() < 1e-9, "a single repair");
        assert!((hours(learned(&arrivals(&[60; 20]))) - 1.0).abs() < 1e-9, "at least an hour");
        assert_eq!(learned(&arrivals(&[60; 19])), 0, "no rhythm yet");
        // A table of the past that is uploaded at once has the rhythm of its measurements.
        let mut uploaded = arrivals(&[86_400; 20]);
        for [received, _] in &mut uploaded {
            *received = Timestamp::from_micros(0).unwrap();
        }
        assert!((hours(learned(&uploaded)) - 96.0).abs() < 1e-9);
    }
}
