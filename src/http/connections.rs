//! How many connections are served: in all, by address, and the reserve for what comes beyond.
//!
//! A connection beyond a limit is still accepted, into a small reserve. There a probe of a supervisor (`/healthz`, `/readyz`) is answered at
//! once, and any other request waits for a place among the served connections. When the reserve is full, the oldest connection in it whose
//! request can be refused by an answer makes room, or that has been silent for a second; so the newest one can always be heard, and a client
//! whose request is late is not cut off without an answer while others can be told to come later.

use std::collections::{HashMap, VecDeque};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use rustix::process::{getrlimit, Resource};
use tokio::sync::{watch, OwnedSemaphorePermit, Semaphore};
use tracing::warn;

use super::access::Key;
use super::settings::HttpSettings;

/// Longest time that a request waits in the reserve for a place.
pub const PATIENCE: Duration = Duration::from_secs(10);

/// File descriptors reserved for other uses than connections: database, log, model files, outgoing requests.
const RESERVED_FILES: usize = 64;

/// Largest number of connections in the reserve.
const MOST_IN_RESERVE: usize = 128;

/// Time for which a connection may stay in the reserve even if it is full, so that a request can arrive.
const SAFE_FOR: Duration = Duration::from_millis(100);

/// Time after which a connection without a request makes room before connections that wait with one.
const SILENT_FOR: Duration = Duration::from_secs(1);

/// Number of addresses from which unused entries are removed.
const MANY_ADDRESSES: usize = 1_024;

/// The limits of connections, and those in use.
pub struct Connections {
    all: Arc<Semaphore>,
    each_address: usize,
    addresses: Mutex<HashMap<Key, Arc<Semaphore>>>,
    reserve: Arc<Semaphore>,
    /// Connections in the reserve, the oldest first.
    in_reserve: Arc<Mutex<VecDeque<Waiting>>>,
    /// Number of the next connection in the reserve.
    next: AtomicU64,
}

struct Waiting {
    number: u64,
    since: Instant,
    /// Whether its request has arrived, so that it can be refused by an answer.
    has_request: Arc<AtomicBool>,
    evicted: watch::Sender<bool>,
}

/// A place among the served connections.
pub struct Slot {
    _of_address: Option<OwnedSemaphorePermit>,
    _of_all: OwnedSemaphorePermit,
}

/// A place in the reserve.
pub struct ReservePlace {
    _permit: OwnedSemaphorePermit,
    in_reserve: Arc<Mutex<VecDeque<Waiting>>>,
    number: u64,
    has_request: Arc<AtomicBool>,
    evicted: watch::Receiver<bool>,
}

impl Connections {
    /// The limits of the settings, or fewer if the process may not open so many files.
    pub fn new(settings: &HttpSettings) -> Self {
        let (served, reserve) = most_connections(settings.max_connections, open_files_limit());
        Self {
            all: Arc::new(Semaphore::new(served)),
            each_address: settings.max_connections_per_address.min(served),
            addresses: Mutex::default(),
            reserve: Arc::new(Semaphore::new(reserve)),
            in_reserve: Arc::default(),
            next: AtomicU64::new(0),
        }
    }

    /// A place among the served connections, if one is free. Without a key the connection counts for no address.
    pub fn try_slot(&self, key: Option<&Key>) -> Option<Slot> {
        let of_address = match key {
            Some(key) => Some(self.of_address(key).try_acquire_owned().ok()?),
            None => None,
        };
        let of_all = Arc::clone(&self.all).try_acquire_owned().ok()?;
        Some(Slot { _of_address: of_address, _of_all: of_all })
    }

    /// Waits for a place among the served connections, in the order of the calls.
    pub async fn slot(&self, key: Option<&Key>) -> Slot {
        let never = "the semaphore is never closed";
        let of_address = match key {
            Some(key) => Some(self.of_address(key).acquire_owned().await.expect(never)),
            None => None,
        };
        Slot { _of_address: of_address, _of_all: Arc::clone(&self.all).acquire_owned().await.expect(never) }
    }

    /// A place in the reserve; if it is full, that of the connection there that makes room.
    pub async fn reserve_place(&self) -> ReservePlace {
        let permit = if let Ok(permit) = Arc::clone(&self.reserve).try_acquire_owned() {
            permit
        } else {
            let since = {
                let all = self.in_reserve.lock().expect("no holder of this lock panics");
                all.get(makes_room(&all)).map(|waiting| waiting.since)
            };
            if let Some(since) = since {
                tokio::time::sleep(SAFE_FOR.saturating_sub(since.elapsed())).await;
            }
            {
                let mut all = self.in_reserve.lock().expect("no holder of this lock panics");
                let position = makes_room(&all);
                if let Some(waiting) = all.remove(position) {
                    // Sending fails if it has just ended.
                    let _ = waiting.evicted.send(true);
                }
            }
            Arc::clone(&self.reserve).acquire_owned().await.expect("the semaphore is never closed")
        };
        let (sender, evicted) = watch::channel(false);
        let number = self.next.fetch_add(1, Ordering::Relaxed);
        let has_request = Arc::<AtomicBool>::default();
        let waiting = Waiting { number, since: Instant::now(), has_request: Arc::clone(&has_request), evicted: sender };
        self.in_reserve.lock().expect("no holder of this lock panics").push_back(waiting);
        ReservePlace { _permit: permit, in_reserve: Arc::clone(&self.in_reserve), number, has_request, evicted }
    }

    fn of_address(&self, key: &Key) -> Arc<Semaphore> {
        let mut addresses = self.addresses.lock().expect("no holder of this lock panics");
        if addresses.len() >= MANY_ADDRESSES {
            addresses.retain(|_, places| Arc::strong_count(places) > 1);
        }
        let new = || Arc::new(Semaphore::new(self.each_address));
        Arc::clone(addresses.entry(key.clone()).or_insert_with(new))
    }
}

impl ReservePlace {
    /// Tells when this place is needed for a newer connection.
    pub fn eviction(&self) -> Eviction {
        Eviction { has_request: Arc::clone(&self.has_request), evicted: self.evicted.clone() }
    }
}

impl Drop for ReservePlace {
    fn drop(&mut self) {
        let mut all = self.in_reserve.lock().expect("no holder of this lock panics");
        all.retain(|waiting| waiting.number != self.number);
    }
}

/// Whether a connection in the reserve has to make room.
#[derive(Clone)]
pub struct Eviction {
    has_request: Arc<AtomicBool>,
    evicted: watch::Receiver<bool>,
}

impl Eviction {
    /// Notes that a request has arrived on this connection: it waits, or was refused, in the reserve.
    pub fn note_request(&self) {
        self.has_request.store(true, Ordering::Release);
    }

    /// Whether a request has arrived on this connection.
    pub fn has_request(&self) -> bool {
        self.has_request.load(Ordering::Acquire)
    }

    /// Completes when the place is needed for a newer connection; never if the place was given back before.
    pub async fn happens(&mut self) {
        if self.evicted.wait_for(|evicted| *evicted).await.is_err() {
            std::future::pending::<()>().await;
        }
    }
}

/// Position of the connection in the reserve that makes room for the newest: the oldest that can be refused by an answer or has been silent
/// for long, otherwise the oldest.
fn makes_room(in_reserve: &VecDeque<Waiting>) -> usize {
    let can_go =
        |waiting: &Waiting| waiting.has_request.load(Ordering::Acquire) || waiting.since.elapsed() >= SILENT_FOR;
    in_reserve.iter().position(can_go).unwrap_or(0)
}

/// Numbers of served connections and of those in the reserve: `wanted`, or fewer if the process may not open so many files.
/// Otherwise idle connections could use the last descriptor, and the database could not be opened for the next reader.
fn most_connections(wanted: usize, files: Option<usize>) -> (usize, usize) {
    let Some(files) = files else { return (wanted, MOST_IN_RESERVE) };
    let possible = files.saturating_sub(RESERVED_FILES).max(files / 4).max(2);
    let reserve = (possible / 8).clamp(1, MOST_IN_RESERVE);
    let served = possible - reserve;
    if served < wanted {
        warn!("The limit of open files is {files}: at most {served} connections are served at a time instead of {wanted}; raise the limit with `ulimit -n`");
    }
    (wanted.min(served), reserve)
}

/// Soft limit of open files; `None` if there is no limit.
fn open_files_limit() -> Option<usize> {
    getrlimit(Resource::Nofile).current.and_then(|files| usize::try_from(files).ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn connections(all: usize, each_address: usize) -> Connections {
        let settings =
            HttpSettings { max_connections: all, max_connections_per_address: each_address, ..HttpSettings::default() };
        Connections::new(&settings)
    }

    fn address(number: u8) -> Key {
        Key::of_address(Some([192, 0, 2, number].into()))
    }

    #[tokio::test]
    async fn an_address_has_its_share_and_what_is_given_back_can_be_taken() {
        let limits = connections(4, 2);
        let first = [limits.try_slot(Some(&address(1))), limits.try_slot(Some(&address(1)))];
        assert!(first.iter().all(Option::is_some) && limits.try_slot(Some(&address(1))).is_none());
        let other = limits.try_slot(Some(&address(2)));
        let proxy = limits.try_slot(None);
        assert!(other.is_some() && proxy.is_some(), "other addresses and proxies have places");
        assert!(limits.try_slot(Some(&address(2))).is_none(), "there are four in all");
        drop(first);
        drop(limits.slot(Some(&address(1))).await);
    }

    #[tokio::test]
    async fn a_full_reserve_gives_the_place_of_the_oldest_to_the_newest() {
        let limits = Arc::new(Connections { reserve: Arc::new(Semaphore::new(3)), ..connections(4, 2) });
        let mut held = Vec::new();
        for _ in 0..3 {
            held.push(limits.reserve_place().await);
        }
        let mut eviction = held[0].eviction();
        let newest = tokio::spawn({
            let limits = Arc::clone(&limits);
            async move { limits.reserve_place().await }
        });
        eviction.happens().await;
        assert!(!*held[1].evicted.borrow() && !*held[2].evicted.borrow());
        drop(held.remove(0));
        drop(newest.await.unwrap());
        drop(held);
        assert_eq!((limits.reserve.available_permits(), limits.in_reserve.lock().unwrap().len()), (3, 0));
    }

    #[tokio::test]
    async fn a_connection_whose_request_can_be_answered_makes_room_before_one_that_is_not_heard_yet() {
        let limits = Connections { reserve: Arc::new(Semaphore::new(2)), ..connections(4, 2) };
        let (not_heard, heard) = (limits.reserve_place().await, limits.reserve_place().await);
        heard.eviction().note_request();
        assert_eq!(makes_room(&limits.in_reserve.lock().unwrap()), 1);
        limits.in_reserve.lock().unwrap()[0].since = Instant::now().checked_sub(SILENT_FOR).unwrap();
        assert_eq!(makes_room(&limits.in_reserve.lock().unwrap()), 0, "it has been silent for a second");
        drop((not_heard, heard));
    }

    #[test]
    fn few_files_leave_room_for_the_database() {
        for files in [16, 96, 256, 1_024, 65_536] {
            let (served, reserve) = most_connections(1_024, Some(files));
            assert!(served >= 1 && reserve >= 1 && served <= 1_024, "{files}: {served}, {reserve}");
            assert!(served + reserve <= files.saturating_sub(RESERVED_FILES).max(files / 4).max(2), "{files}");
        }
        assert_eq!(most_connections(1_024, None), (1_024, MOST_IN_RESERVE));
    }
}
