//! Whether the database can be written, tested at most once a second.
//!
//! The health can be read without a token and therefore any number of times, but each test is a transaction.

use std::future::Future;
use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::Mutex;

use super::reason::Reason;
use crate::store::Store;

/// How long a result is used.
const FRESH_FOR: Duration = Duration::from_secs(1);

/// Longest time that the writer gets to respond.
const PATIENCE: Duration = Duration::from_secs(5);

/// The result of a test, and its time.
struct Answer {
    at: Instant,
    finding: Option<Reason>,
    /// Number of refused writes of the store after the test. If another write was refused since then, the result is outdated.
    refused_writes: u64,
}

/// The last test of the writer of a store.
#[derive(Clone)]
pub(super) struct WriterProbe {
    store: Store,
    last: Arc<Mutex<Option<Answer>>>,
}

impl WriterProbe {
    pub(super) fn new(store: Store) -> Self {
        Self { store, last: Arc::default() }
    }

    /// Why nothing can be written, or `None`; at most one second old. Callers that arrive during a test wait for its result.
    pub(super) async fn finding(&self) -> Option<Reason> {
        self.finding_of(ask(self.store.clone())).await
    }

    async fn finding_of(&self, test: impl Future<Output = Option<Reason>> + Send + 'static) -> Option<Reason> {
        let probe = self.clone();
        // The test runs in a separate task: otherwise, if a client disconnected before the result, the next caller would have to
        // repeat the test.
        let task = tokio::spawn(async move {
            let mut last = probe.last.lock().await;
            let refused_writes = probe.store.file().refused_writes();
            let fresh = |a: &&Answer| a.at.elapsed() < FRESH_FOR && a.refused_writes == refused_writes;
            if let Some(answer) = last.as_ref().filter(fresh) {
                return answer.finding.clone();
            }
            let finding = test.await;
            let refused_writes = probe.store.file().refused_writes();
            *last = Some(Answer { at: Instant::now(), finding: finding.clone(), refused_writes });
            finding
        });
        task.await.unwrap_or_else(|_| Some(Reason::new("internal", "the test of the writer panicked: a bug")))
    }

    /// True unless the writer hangs. That is a reason to restart the service; a full disk is not.
    pub(super) async fn responds(&self) -> bool {
        self.finding().await.is_none_or(|reason| reason.code != STUCK)
    }
}

const STUCK: &str = "writer_stuck";

async fn ask(store: Store) -> Option<Reason> {
    match tokio::time::timeout(PATIENCE, store.file().is_writable()).await {
        Ok(Ok(())) => None,
        Ok(Err(error)) => {
            let code = error.disk_cause().unwrap_or("database_failed");
            Some(Reason::new(code, format!("nothing can be stored: {error}")))
        }
        Err(_) => Some(Reason::new(STUCK, format!("the writer has not responded for {} s", PATIENCE.as_secs()))),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::store::StoreSettings;
    use std::sync::atomic::{AtomicU64, Ordering};

    #[tokio::test]
    async fn many_callers_share_one_test_a_second_even_when_they_do_not_wait() {
        let folder = tempfile::tempdir().unwrap();
        let probe = WriterProbe::new(Store::open(folder.path()).await.unwrap());
        let asked = Arc::new(AtomicU64::new(0));
        let test = || {
            let asked = Arc::clone(&asked);
            async move {
                tokio::time::sleep(Duration::from_millis(5)).await;
                Some(Reason::new("test", asked.fetch_add(1, Ordering::SeqCst).to_string()))
            }
        };
        let started = Instant::now();
        for _ in 0..300 {
            // This caller stops waiting before the result.
            let _ = tokio::time::timeout(Duration::from_millis(1), probe.finding_of(test())).await;
            assert_eq!(probe.finding_of(test()).await.unwrap().code, "test");
        }
        let most = 1 + started.elapsed().as_secs();
        let times = asked.load(Ordering::SeqCst);
        assert!((1..=most).contains(&times), "{times} tests, at most {most} are expected");

        // A result is used for a limited time only.
        tokio::time::sleep(FRESH_FOR).await;
        assert_eq!(probe.finding_of(test()).await.unwrap().message, times.to_string());
    }

    #[tokio::test]
    async fn a_refused_write_makes_the_result_outdated_at_once() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).await.unwrap();
        let probe = WriterProbe::new(store.clone());
        assert_eq!(probe.finding().await, None);
        store.file().set_limits(&StoreSettings { min_free_bytes: u64::MAX, ..StoreSettings::default() });
        assert!(store.file().is_writable().await.is_err());
        assert_eq!(probe.finding().await.unwrap().code, "disk_full");
        assert!(probe.responds().await);
    }
}
