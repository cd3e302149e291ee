//! Rate limits: the generic cell rate algorithm (a leaky bucket) per token or address, in bounded memory.

use std::net::IpAddr;
use std::num::NonZeroU32;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

use axum::http::{HeaderName, HeaderValue, StatusCode};
use governor::clock::{Clock as _, DefaultClock};
use governor::{DefaultKeyedRateLimiter, Quota, RateLimiter};

use super::client::Key;
use crate::http::error::ApiError;
use crate::http::settings::RateLimitSettings;

/// Number of clients that a limit tracks separately; further clients share one allowance.
const MOST_KEYS: usize = 20_000;
/// Interval at which clients with a full allowance are removed.
const PURGE_EVERY: Duration = Duration::from_secs(10);

/// Changes a minute that a client may attempt below the minimum of free space. Each writes an entry of the audit into what is left.
const CHANGES_BELOW_FLOOR: NonZeroU32 = NonZeroU32::new(60).expect("60 is not zero");

/// All limits of the service.
pub(super) struct Limits {
    requests: Option<Limit>,
    measurements: Option<Limit>,
    failures: Option<Limit>,
    below_floor: Limit,
}

impl Limits {
    pub(super) fn new(settings: &RateLimitSettings, largest_batch: usize) -> Self {
        let largest_batch = u32::try_from(largest_batch).unwrap_or(u32::MAX);
        let per_second = |rate: u32, burst: u32| {
            NonZeroU32::new(rate).map(|rate| Quota::per_second(rate).allow_burst(at_least_one(burst)))
        };
        let requests = per_second(settings.requests_per_s, settings.burst);
        let measurements = per_second(settings.measurements_per_s, settings.measurements_per_s.max(largest_batch));
        let failures = NonZeroU32::new(settings.failed_authentications_per_min).map(Quota::per_minute);
        Self {
            requests: requests.map(|quota| Limit::new("requests", "too_many_requests", quota)),
            measurements: measurements.map(|quota| Limit::new("measurements", "too_many_measurements_a_second", quota)),
            failures: failures.map(|quota| Limit::new("failures", "too_many_failures", quota)),
            below_floor: Limit::new("changes", "too_many_requests", Quota::per_minute(CHANGES_BELOW_FLOOR)),
        }
    }

    /// Counts one request.
    pub(super) fn take_request(&self, key: &Key) -> Result<(), ApiError> {
        self.requests.as_ref().map_or(Ok(()), |limit| limit.take(key, NonZeroU32::MIN))
    }

    /// Counts the measurements of a batch.
    pub(super) fn take_measurements(&self, key: &Key, count: usize) -> Result<(), ApiError> {
        let (Some(limit), Some(count)) = (&self.measurements, u32::try_from(count).ok().and_then(NonZeroU32::new))
        else {
            return Ok(());
        };
        limit.take(key, count)
    }

    /// Counts one change that is attempted below the minimum of free space.
    pub(super) fn take_below_floor(&self, key: &Key) -> Result<(), ApiError> {
        self.below_floor.take(key, NonZeroU32::MIN)
    }

    /// Counts one failed authentication.
    pub(super) fn count_failure(&self, address: Option<IpAddr>) -> Result<(), ApiError> {
        self.failures.as_ref().map_or(Ok(()), |limit| limit.take(&Key::of_address(address), NonZeroU32::MIN))
    }
}

fn at_least_one(burst: u32) -> NonZeroU32 {
    NonZeroU32::new(burst).unwrap_or(NonZeroU32::MIN)
}

struct Limit {
    name: &'static str,
    code: &'static str,
    quota: Quota,
    buckets: DefaultKeyedRateLimiter<Key>,
    clock: DefaultClock,
    started: Instant,
    purged_at_s: AtomicU64,
}

impl Limit {
    fn new(name: &'static str, code: &'static str, quota: Quota) -> Self {
        Self {
            name,
            code,
            quota,
            buckets: RateLimiter::keyed(quota),
            clock: DefaultClock::default(),
            started: Instant::now(),
            purged_at_s: AtomicU64::new(0),
        }
    }

    fn take(&self, key: &Key, count: NonZeroU32) -> Result<(), ApiError> {
        self.purge();
        let key = if self.buckets.len() < MOST_KEYS { key } else { &Key::Others };
        // A count above the burst size is reduced to it: the size of a batch has a separate limit.
        let count = count.min(self.quota.burst_size());
        let Ok(Err(not_until)) = self.buckets.check_key_n(key, count) else { return Ok(()) };
        let wait = not_until.wait_time_from(self.clock.now());
        let wait_s = u32::try_from(wait.as_millis().div_ceil(1_000)).unwrap_or(u32::MAX).max(1);
        metrics::counter!("modalwatch_rate_limited_total", "limit" => self.name).increment(1);
        Err(self.refusal(wait_s))
    }

    /// Removes clients with a full allowance from time to time; a client that was never seen has one too.
    fn purge(&self) {
        let now_s = self.started.elapsed().as_secs();
        let last_s = self.purged_at_s.load(Ordering::Relaxed);
        let due = now_s >= last_s + PURGE_EVERY.as_secs();
        if due && self.purged_at_s.compare_exchange(last_s, now_s, Ordering::Relaxed, Ordering::Relaxed).is_ok() {
            self.buckets.retain_recent();
        }
    }

    /// 429 with `Retry-After` and the fields of draft-ietf-httpapi-ratelimit-headers.
    fn refusal(&self, wait_s: u32) -> ApiError {
        let burst = self.quota.burst_size();
        let window = self.quota.replenish_interval() * burst.get();
        let policy = format!("\"{}\";q={burst};w={}", self.name, window.as_secs().max(1));
        let state = format!("\"{}\";r=0;t={wait_s}", self.name);
        let detail = format!("too many {}: wait {wait_s} s", self.name);
        let header = |text: &str| HeaderValue::from_str(text).expect("names and numbers are plain text");
        ApiError::new(StatusCode::TOO_MANY_REQUESTS, self.code, detail)
            .with_retry_after(wait_s)
            .with_header(HeaderName::from_static("ratelimit-policy"), header(&policy))
            .with_header(HeaderName::from_static("ratelimit"), header(&state))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn address(number: u32) -> IpAddr {
        IpAddr::V4(number.into())
    }

    #[test]
    fn each_client_has_its_own_allowance() {
        let limits = Limits::new(&RateLimitSettings { requests_per_s: 1, burst: 3, ..Default::default() }, 10);
        let (one, other) = (Key::of_address(Some(address(1))), Key::Token("t".to_owned()));
        assert!((0..3).all(|_| limits.take_request(&one).is_ok()));
        assert!(limits.take_request(&one).is_err());
        assert!(limits.take_request(&other).is_ok());
    }

    #[test]
    fn a_batch_counts_its_measurements_and_the_largest_batch_is_always_accepted() {
        let limits = Limits::new(&RateLimitSettings { measurements_per_s: 10, ..Default::default() }, 5_000);
        assert!(limits.take_measurements(&Key::Others, 5_000).is_ok());
        assert!(limits.take_measurements(&Key::Others, 100).is_err());
    }

    #[test]
    fn below_the_floor_each_client_has_its_own_allowance_of_changes() {
        let limits = Limits::new(&RateLimitSettings::default(), 10);
        let (one, other) = (Key::Token("one".to_owned()), Key::Token("other".to_owned()));
        assert!((0..CHANGES_BELOW_FLOOR.get()).all(|_| limits.take_below_floor(&one).is_ok()));
        assert!(limits.take_below_floor(&one).is_err());
        assert!(limits.take_below_floor(&other).is_ok());
    }

    #[test]
    fn zero_sets_no_limit() {
        let off = RateLimitSettings { failed_authentications_per_min: 0, ..Default::default() };
        let limits = Limits::new(&off, 10);
        assert!((0..1_000).all(|_| limits.take_request(&Key::Others).is_ok()));
        assert!((0..1_000).all(|_| limits.count_failure(Some(address(1))).is_ok()));
    }

    #[test]
    fn memory_stays_bounded_with_any_number_of_clients() {
        let limits = Limits::new(&RateLimitSettings::default(), 10);
        for number in 0..2 * MOST_KEYS as u32 {
            let _ = limits.count_failure(Some(address(number)));
        }
        assert!(limits.failures.unwrap().buckets.len() <= MOST_KEYS + 1);
    }
}
