//! The time of the next attempt after a failed delivery.

use rand::rngs::OsRng;
use rand::TryRngCore as _;

use super::settings::NotifySettings;
use crate::quantity::Timestamp;

/// Ratio of successive delays.
const GROWTH: u64 = 3;

/// Consequence of a failed attempt.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Next {
    /// The message is sent again at this time.
    At(Timestamp),
    /// The message is given up as a dead letter.
    GiveUp,
}

/// Consequence of the `attempts`-th failure in a row of a message whose first attempt was planned for `started`.
///
/// ```text
///  delay = min(first · 3^(attempts−1), longest) · (0.8 + 0.4 u),    u uniform in [0, 1)
/// ```
///
/// The last attempt is made at the end of the time for which a message is retried. The random factor u prevents the
/// messages of many services from reaching a receiver at the same moment.
pub fn after_failure(settings: &NotifySettings, attempts: u32, started: Timestamp, now: Timestamp, u: f64) -> Next {
    let end = later(started, settings.give_up_after_s);
    // If the clock was set back to before the first attempt, the end would seem far away.
    if now >= end || now < started {
        return if now < started { Next::At(later(now, settings.longest_retry_s)) } else { Next::GiveUp };
    }
    let growth = GROWTH.saturating_pow(attempts.saturating_sub(1));
    let delay_s = settings.first_retry_s.saturating_mul(growth).min(settings.longest_retry_s);
    let delay_micros = (delay_s as f64 * 1e6 * (0.8 + 0.4 * u)) as i64;
    Next::At(Timestamp::from_micros(now.micros() + delay_micros).unwrap_or(end).min(end))
}

/// `at` plus seconds; the ranges of the settings keep the result within the calendar.
pub(super) fn later(at: Timestamp, seconds: u64) -> Timestamp {
    Timestamp::from_micros(at.micros() + seconds as i64 * 1_000_000).unwrap_or(at)
}

/// A random number in [0, 1) from the operating system; 0.5 if it provides none.
pub fn jitter() -> f64 {
    OsRng.try_next_u32().map_or(0.5, |n| f64::from(n) / (f64::from(u32::MAX) + 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(seconds: i64) -> Timestamp {
        Timestamp::from_micros(1_700_000_000_000_000 + seconds * 1_000_000).unwrap()
    }

    /// Times of the attempts for a message that is never accepted, seconds after the first attempt.
    fn attempts(settings: &NotifySettings, u: f64) -> Vec<i64> {
        let mut times = vec![0];
        loop {
            let now = at(*times.last().unwrap());
            match after_failure(settings, times.len() as u32, at(0), now, u) {
                Next::At(next) => times.push((next.micros() - at(0).micros()) / 1_000_000),
                Next::GiveUp => return times,
            }
        }
    }

    #[test]
    fn pauses_triple_up_to_the_longest_and_end_after_three_days() {
        let times = attempts(&NotifySettings::default(), 0.5);
        assert_eq!(times[..8], [0, 5, 20, 65, 200, 605, 1_820, 3_620]);
        assert_eq!(*times.last().unwrap(), 3 * 86_400);
        let pauses = times.windows(2).map(|w| w[1] - w[0]);
        assert!(pauses.clone().all(|pause| pause <= 1_800) && times.len() < 160, "{times:?}");
    }

    #[test]
    fn two_services_do_not_retry_at_the_same_time() {
        let (early, late) = (attempts(&NotifySettings::default(), 0.0), attempts(&NotifySettings::default(), 0.99));
        assert_eq!((early[1], late[1]), (4, 5));
        assert_eq!((early[6], late[6]), (1_456, 2_173));
        assert_eq!(early.last(), late.last());
        assert!((0..1_000).map(|_| jitter()).all(|u| (0.0..1.0).contains(&u)));
    }

    #[test]
    fn a_clock_that_was_set_back_neither_kills_a_message_nor_makes_it_wait_for_ever() {
        let settings = NotifySettings::default();
        let next = after_failure(&settings, 3, at(0), at(-365 * 86_400), 0.5);
        assert_eq!(next, Next::At(at(-365 * 86_400 + 1_800)));
    }

    #[test]
    fn any_number_of_attempts_has_a_pause() {
        let settings = NotifySettings { give_up_after_s: 30 * 86_400, ..NotifySettings::default() };
        assert_eq!(after_failure(&settings, u32::MAX, at(0), at(10), 0.5), Next::At(at(1_810)));
    }
}
