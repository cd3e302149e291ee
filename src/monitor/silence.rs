//! Alarms for structures that have sent nothing for too long.
//!
//! How long a structure is silent is measured by the monotonic clock: the system clock of a small computer may be hours wrong after its start, until
//! it is set. It says only when within the pause between two checks a batch arrived.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use tracing::{error, info, warn};

use super::alarms::Alarms;
use super::error::Error;
use super::structures::ActiveStructures;
use super::supervise::supervise;
use crate::clock;
use crate::quantity::{StructureId, Timestamp};
use crate::store::{Arrival, Store};

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
        let started = Instant::now();
        let silence = self.clone();
        supervise("silence", move || {
            let silence = silence.clone();
            async move {
                let mut watched = Watched::since(started);
                let mut ticks = tokio::time::interval(if silence.after_s.is_some() { EVERY } else { EVERY_MINUTE });
                ticks.set_missed_tick_behavior(tokio::time::MissedTickBehavior::Delay);
                loop {
                    ticks.tick().await;
                    if let Err(failure) = silence.check(&mut watched, clock::now).await {
                        error!(error = %failure, "Could not check for silent structures: {failure}");
                    }
                    if silence.after_s == Some(0) {
                        return;
                    }
                }
            }
        });
    }

    /// Opens and ends alarms of silence. A structure that never sent a batch is not silent. The time before the watch began is ignored,
    /// because nothing could be received then. During maintenance no alarm is opened.
    async fn check(&self, watched: &mut Watched, clock: impl Fn() -> Timestamp) -> Result<(), Error> {
        let (began, structures) = (Instant::now(), self.structures.ids());
        watched.newest.retain(|structure, _| structures.contains(structure));
        for structure in structures {
            let arrivals = self.store.batches().arrivals(&structure, PAUSES + 1).await?;
            let Some(last) = arrivals.first() else {
                watched.newest.remove(&structure);
                continue;
            };
            let now = clock();
            let silent_us = watched.silent_us(&structure, last, now, Instant::now());
            let allowed = match self.after_s {
                Some(after_s) => (after_s as i64).saturating_mul(1_000_000),
                None => learned(&arrivals),
            };
            // Without a rhythm, nothing is known: an alarm that is open stays.
            if allowed == 0 && self.after_s.is_none() {
                continue;
            }
            let overdue = allowed > 0 && silent_us > allowed;
            let silent = overdue && !self.store.alarms().is_in_maintenance(&structure, now).await?;
            // A clock that was ahead has given the batch a time that is still to come.
            let since = last.received_at.min(now);
            if self.store.alarms().set_silent(&structure, silent.then_some(since), now).await? {
                if silent {
                    warn!(structure.id = %structure, "No batch of {structure} since {since}");
                    self.alarms.report(&structure).await;
                } else {
                    info!(structure.id = %structure, "{structure} is not silent any more");
                    self.alarms.publish_changes(&structure).await;
                }
            }
        }
        watched.looked_at = began;
        Ok(())
    }
}

/// What the checks of this process have seen.
struct Watched {
    /// Beginning of the last check of all structures; before the first one, of the watch.
    looked_at: Instant,
    /// The batch of each structure that was stored last, and when it arrived, or when the watch began if it arrived before.
    newest: BTreeMap<StructureId, (String, Instant)>,
}

impl Watched {
    /// Nothing, since the watch began.
    const fn since(began: Instant) -> Self {
        Self { looked_at: began, newest: BTreeMap::new() }
    }

    /// How long nothing has come from a structure whose batch `last` was stored last, µs, at the time `here` of the monotonic clock and `now` of
    /// the system clock.
    ///
    /// A batch that the last check has not seen has arrived since then, whatever the system clock says.
    fn silent_us(&mut self, structure: &StructureId, last: &Arrival, now: Timestamp, here: Instant) -> i64 {
        let micros = |since: Instant| here.saturating_duration_since(since).as_micros() as i64;
        // The newest one may have been deleted meanwhile: one that was stored before it is no news.
        if let Some((_, since)) = self.newest.get(structure).filter(|(newest, _)| *newest >= last.batch_id) {
            return micros(*since);
        }
        let silent_us = (now.micros() - last.received_at.micros()).clamp(0, micros(self.looked_at));
        let since = here.checked_sub(Duration::from_micros(silent_us.unsigned_abs())).unwrap_or(self.looked_at);
        self.newest.insert(structure.clone(), (last.batch_id.clone(), since));
        silent_us
    }
}

/// Time without a batch that is silence, µs: a multiple of the second longest pause, because a single one may be a wrong clock or a repair; 0,
/// never, before a rhythm is known. `arrivals`: those of the batches that were stored last, the last one first.
fn learned(arrivals: &[Arrival]) -> i64 {
    if arrivals.len() <= PAUSES {
        return 0;
    }
    let long = |pause: fn(&Arrival, &Arrival) -> i64| {
        let mut pauses: Vec<i64> = arrivals.windows(2).map(|pair| pause(&pair[0], &pair[1])).collect();
        pauses.sort_unstable();
        pauses[pauses.len() - 2]
    };
    // A batch that arrived before the one that was stored before it shows that the clock was set back, and no pause.
    let received = long(|next, last| (next.received_at.micros() - last.received_at.micros()).max(0));
    let measured = long(|next, last| (next.measured_to.micros() - last.measured_to.micros()).abs());
    received.max(measured).saturating_mul(PATIENCE).max(LEAST_US)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(second: i64) -> Timestamp {
        Timestamp::from_micros(1_000_000 * second).unwrap()
    }

    fn arrival(number: usize, received_s: i64, measured_s: i64) -> Arrival {
        Arrival { batch_id: format!("b{number:03}"), received_at: at(received_s), measured_to: at(measured_s) }
    }

    /// Batches that arrive a minute after their measurement, with these pauses in seconds before each.
    fn arrivals(pauses_s: &[i64]) -> Vec<Arrival> {
        let mut second = 0;
        let mut all = vec![arrival(0, 60, 0)];
        for (number, pause) in pauses_s.iter().enumerate() {
            second += pause;
            all.push(arrival(number + 1, second + 60, second));
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
        for arrival in &mut uploaded {
            arrival.received_at = at(0);
        }
        assert!((hours(learned(&uploaded)) - 96.0).abs() < 1e-9);
        // A clock that was ahead by a day for some batches is one long pause, and not two.
        let mut ahead = arrivals(&[60; 20]);
        for arrival in &mut ahead[5..9] {
            arrival.received_at = at(arrival.received_at.micros() / 1_000_000 + 86_400);
        }
        assert!((hours(learned(&ahead)) - 1.0).abs() < 1e-9);
    }

    /// A process whose system clock differs from the time by some seconds, and a structure.
    struct World {
        started: Instant,
        watched: Watched,
        clock_ahead_s: i64,
        last: Arrival,
    }

    impl World {
        /// A process that starts at a second, of whose structure this batch was stored last.
        fn start(last: Arrival, clock_ahead_s: i64) -> Self {
            let started = Instant::now();
            Self { started, watched: Watched::since(started), clock_ahead_s, last }
        }

        /// A batch arrives some seconds after the start.
        fn receive(&mut self, number: usize, second: i64) {
            self.last = arrival(number, second + self.clock_ahead_s, 0);
        }

        /// For how many seconds a check at this time finds the structure silent.
        fn check(&mut self, second: u64) -> i64 {
            let structure = StructureId::parse("bridge").unwrap();
            let (now, here) = (at(second as i64 + self.clock_ahead_s), self.started + Duration::from_secs(second));
            let silent_us = self.watched.silent_us(&structure, &self.last, now, here);
            self.watched.looked_at = here;
            silent_us / 1_000_000
        }
    }

    const TWO_HOURS_S: i64 = 7_200;

    #[test]
    fn silence_is_noticed_after_a_clock_that_was_ahead_is_set_right() {
        let mut world = World::start(arrival(0, -1_000, 0), TWO_HOURS_S);
        assert_eq!((world.check(0), world.check(5)), (0, 5), "what was before the start is no silence");
        world.receive(1, 7);
        assert_eq!(world.check(10), 3);
        world.clock_ahead_s = 0;
        assert_eq!(world.check(15), 8);
        world.receive(2, 16);
        assert_eq!((world.check(20), world.check(25), world.check(3_000)), (4, 9, 2_984));
    }

    #[test]
    fn a_clock_that_is_set_ahead_or_back_is_no_silence_and_no_batch() {
        let mut world = World::start(arrival(0, -1_000, 0), 0);
        world.receive(1, 3);
        assert_eq!(world.check(5), 2);
        world.clock_ahead_s = TWO_HOURS_S;
        assert_eq!(world.check(10), 7);
        world.clock_ahead_s = 0;
        // Between two checks, a batch arrives and the clock is set: it has arrived within the pause between them.
        world.receive(2, 12);
        world.clock_ahead_s = TWO_HOURS_S;
        assert_eq!((world.check(15), world.check(20)), (5, 10));
        world.receive(3, 22);
        world.clock_ahead_s = -TWO_HOURS_S;
        assert_eq!((world.check(25), world.check(30)), (0, 5));
        // The batch that was stored last is deleted.
        world.receive(2, 12);
        assert_eq!(world.check(35), 10);
    }

    #[test]
    fn a_restart_ignores_the_time_before_it_whatever_the_clock_was() {
        for received_s in [-TWO_HOURS_S, 0, TWO_HOURS_S] {
            let mut world = World::start(arrival(7, received_s, 0), 0);
            assert_eq!((world.check(0), world.check(5), world.check(100)), (0, 5, 100), "{received_s}");
            world.receive(8, 102);
            assert_eq!(world.check(105), 3);
        }
    }
}
