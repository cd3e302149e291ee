//! Background tasks that are started again after a panic.

use std::future::Future;
use std::time::Duration;

use tracing::error;

/// Pause before a task that panicked is started again, so that one that always panics does not spin.
const PAUSE_AFTER_PANIC: Duration = Duration::from_secs(1);

/// Runs a background task for as long as the service runs; after a panic, which is logged and counted, it is started again.
pub(super) fn supervise<F, Fut>(name: &'static str, work: F)
where
    F: Fn() -> Fut + Send + 'static,
    Fut: Future<Output = ()> + Send + 'static,
{
    tokio::spawn(async move {
        while let Err(ended) = tokio::spawn(work()).await {
            if !ended.is_panic() {
                return;
            }
            error!(worker = name, "The task {name} panicked and is started again: a bug");
            metrics::counter!("modalwatch_worker_restarts_total", "worker" => name).increment(1);
            tokio::time::sleep(PAUSE_AFTER_PANIC).await;
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::sync::Arc;

    #[tokio::test]
    async fn a_task_that_panics_is_started_again_and_one_that_ends_is_not() {
        let runs = Arc::new(AtomicUsize::new(0));
        let counted = Arc::clone(&runs);
        supervise("test", move || {
            let counted = Arc::clone(&counted);
            async move {
                assert!(counted.fetch_add(1, Ordering::SeqCst) >= 2, "the first two runs panic");
            }
        });
        for _ in 0..600 {
            if runs.load(Ordering::SeqCst) == 3 {
                break;
            }
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
        // One that ended is not started again.
        tokio::time::sleep(2 * PAUSE_AFTER_PANIC).await;
        assert_eq!(runs.load(Ordering::SeqCst), 3);
    }
}
