//! The names under which states of batches are stored.

use super::column::bad_row;
use super::error::Error;
use crate::assessment::BatchState;

/// The state with a name.
pub(super) fn batch_state(name: &str) -> Result<BatchState, Error> {
    let states = [BatchState::Received, BatchState::Assessed, BatchState::Failed];
    states.into_iter().find(|s| s.as_str() == name).ok_or_else(|| bad_row("batch")(&name))
}
