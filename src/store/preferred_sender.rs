//! Senders for whom bulk writes wait.

use std::sync::Arc;

use super::writer::Writer;
use super::Store;

/// A sender who waits for an answer. Until it is dropped, bulk writes wait, but for no longer than about a second.
#[must_use = "bulk writes wait until it is dropped"]
pub struct PreferredSender(Arc<Writer>);

impl PreferredSender {
    /// A sender who waits from now on for an answer from a store.
    pub fn of(store: &Store) -> Self {
        let writer = &store.database.writer;
        writer.add_sender();
        Self(Arc::clone(writer))
    }
}

impl Drop for PreferredSender {
    fn drop(&mut self) {
        self.0.remove_sender();
    }
}
