//! The id of the request that the current task answers.

use std::future::Future;

tokio::task_local! {
    static CURRENT_ID: String;
}

/// Id of the request that this task answers; `None` outside a request.
pub fn current_id() -> Option<String> {
    CURRENT_ID.try_with(String::clone).ok()
}

/// Runs `part` with `id` as the current request id. A spawned task does not inherit the id of the task that spawned it.
pub async fn with_current_id<F: Future>(id: String, part: F) -> F::Output {
    CURRENT_ID.scope(id, part).await
}
