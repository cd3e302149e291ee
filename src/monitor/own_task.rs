//! Work that continues when its client disconnects.

use std::future::Future;

use tracing::Instrument as _;

use super::error::Error;

/// Runs `work` in a separate task, so that it completes even if the caller is dropped.
///
/// # Errors
/// Those of `work`; [`Error::Panicked`].
pub(super) async fn in_own_task<T, E>(work: impl Future<Output = Result<T, E>> + Send + 'static) -> Result<T, E>
where
    T: Send + 'static,
    E: From<Error> + Send + 'static,
{
    tokio::spawn(work.in_current_span()).await.unwrap_or_else(|_| Err(Error::Panicked.into()))
}
