//! Why a job ends without a result, and how this comes out of the thread that computes.
//!
//! A computation is ended by unwinding its thread with a [`Halt`], which [`computed`] turns into a value where the thread was started. Unwinding by
//! `resume_unwind` leaves no trace in the log, and spares each loop of the computation a special result.

use std::any::Any;

/// Why a job ends without a result.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) enum Halt {
    /// Somebody cancelled it.
    Cancelled,
    /// The service stops: the job begins again after the next start.
    Stopping,
    /// It failed.
    Failed(String),
}

impl From<String> for Halt {
    fn from(failure: String) -> Self {
        Self::Failed(failure)
    }
}

/// Runs the computation of a job on a thread of its own.
///
/// # Errors
/// Those of `work`; [`Halt`] where the job was ended; a panic as a failure.
pub(super) async fn computed<T: Send + 'static>(
    what: &str,
    work: impl FnOnce() -> Result<T, String> + Send + 'static,
) -> Result<T, Halt> {
    let failure = match tokio::task::spawn_blocking(work).await {
        Ok(found) => return found.map_err(Halt::Failed),
        Err(failure) => failure,
    };
    let panic: Option<Box<dyn Any + Send>> = failure.try_into_panic().ok();
    match panic.and_then(|panic| panic.downcast::<Halt>().ok()) {
        Some(halt) => Err(*halt),
        None => Err(Halt::Failed(format!("the {what} panicked"))),
    }
}
