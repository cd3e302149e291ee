//! Repeating what failed because the database failed for a moment.

use std::future::Future;
use std::time::Duration;

use tracing::warn;

use crate::store::{Error, Store};

/// Pause between two attempts, for example while the disk is full.
const BETWEEN_ATTEMPTS: Duration = Duration::from_secs(2);

/// Waits before the next attempt.
pub(super) async fn pause() {
    tokio::time::sleep(between_attempts()).await;
}

fn between_attempts() -> Duration {
    fault_point!("monitor::pause", |_| Duration::from_millis(1));
    BETWEEN_ATTEMPTS
}

/// Whether an operation of a background task, which nobody would repeat, is worth another attempt.
pub(super) fn is_worth_another(error: &Error, store: &Store) -> bool {
    error.is_temporary() && !store.file().is_closed()
}

/// Attempts an operation of a background task until it succeeds or fails for good; `what` completes "Could not …".
///
/// # Errors
/// An error that does not pass by itself; any error once the store is closed.
pub(super) async fn patiently<T, F>(store: &Store, what: &str, operation: impl Fn() -> F) -> Result<T, Error>
where
    F: Future<Output = Result<T, Error>>,
{
    loop {
        match operation().await {
            Err(error) if is_worth_another(&error, store) => {
                warn!(%error, "Could not {what}, trying again: {error}");
                pause().await;
            }
            outcome => return outcome,
        }
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;
    use crate::fault::Faults;

    #[tokio::test]
    async fn what_fails_for_a_moment_is_repeated_and_what_fails_for_good_is_not() {
        let folder = tempfile::tempdir().unwrap();
        let store = Store::open(folder.path()).await.unwrap();
        let faults = Faults::arm();
        faults.set("monitor::pause", "return");
        let (calls, busy) = (Cell::new(0), || Error::Busy("a lock".to_owned()));
        let fails = |times: i32, error: fn() -> Error| {
            calls.set(0);
            let calls = &calls;
            move || {
                calls.set(calls.get() + 1);
                std::future::ready(if calls.get() > times { Ok(calls.get()) } else { Err(error()) })
            }
        };
        assert_eq!(patiently(&store, "test", fails(3, busy)).await.unwrap(), 4);
        let gone = || Error::UnknownStructure("a".to_owned());
        assert!(matches!(patiently(&store, "test", fails(3, gone)).await, Err(Error::UnknownStructure(_))));
        assert_eq!(calls.get(), 1);
        // A job does not outlive the store.
        store.close().await;
        assert!(matches!(patiently(&store, "test", fails(3, busy)).await, Err(Error::Busy(_))));
        assert_eq!(calls.get(), 1);
    }
}
