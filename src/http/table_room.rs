//! Room for large tables: how many bytes of them are in memory at a time, and which of them is read.
//!
//! A table waits for room in the buffers of its connection, for a bounded time, and keeps the room until its batches are stored. Its bytes are most of the memory
//! that it takes; what else it takes while it is read, some 50 bytes for each row, one table takes at a time. Small tables, like batches as
//! JSON, need no room and wait for no other table.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};
use std::time::Duration;

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::access::Key;

/// A table of at most this size needs no room: as many of them as there are connections take 64 MiB.
pub const SMALL_BYTES: usize = 64 * 1024;

/// Number of tables of the largest size for which there is room; one client has room for one.
const MOST_OF_THE_LARGEST: usize = 2;

/// Longest wait for room. Clients and proxies that cannot send for half a minute take the connection for broken, and would not know why.
const PATIENCE: Duration = Duration::from_secs(20);

/// Unit in which room is counted, bytes.
const UNIT_BYTES: usize = 1_024;

const NEVER_CLOSED: &str = "the semaphore is never closed";

/// The room for tables, of all clients and of each.
pub struct TableRoom {
    all: Arc<Semaphore>,
    clients: Mutex<HashMap<Key, Arc<Semaphore>>>,
    units_of_a_client: u32,
    turns: Arc<Semaphore>,
}

/// Room that a table has, given back when dropped.
pub struct Room {
    _of_client: OwnedSemaphorePermit,
    _of_all: OwnedSemaphorePermit,
}

/// The turn of the table that is read, given back when dropped.
pub struct Turn {
    _permit: OwnedSemaphorePermit,
}

impl TableRoom {
    /// Room for tables of at most this number of bytes.
    pub fn new(largest_bytes: usize) -> Self {
        let units_of_a_client = units(largest_bytes);
        Self {
            all: Arc::new(Semaphore::new(MOST_OF_THE_LARGEST * units_of_a_client as usize)),
            clients: Mutex::default(),
            units_of_a_client,
            turns: Arc::new(Semaphore::new(1)),
        }
    }

    /// Waits for room for a table of at most this number of bytes, in the order of the calls; `None` if there is none within 20 s.
    pub async fn take(&self, client: &Key, bytes: usize) -> Option<Room> {
        tokio::time::timeout(PATIENCE, self.wait(client, bytes)).await.ok()
    }

    async fn wait(&self, client: &Key, bytes: usize) -> Room {
        let units = units(bytes).min(self.units_of_a_client);
        let of_client = self.of_client(client).acquire_many_owned(units).await.expect(NEVER_CLOSED);
        let of_all = Arc::clone(&self.all).acquire_many_owned(units).await.expect(NEVER_CLOSED);
        Room { _of_client: of_client, _of_all: of_all }
    }

    /// Waits for the turn of a table with room to be read, in the order of the calls.
    pub async fn turn(&self) -> Turn {
        Turn { _permit: Arc::clone(&self.turns).acquire_owned().await.expect(NEVER_CLOSED) }
    }

    /// The room of a client. Nothing is kept of clients that neither have nor want any.
    fn of_client(&self, client: &Key) -> Arc<Semaphore> {
        let mut clients = self.clients.lock().expect("no holder of this lock panics");
        clients.retain(|_, room| Arc::strong_count(room) > 1);
        let new = || Arc::new(Semaphore::new(self.units_of_a_client as usize));
        Arc::clone(clients.entry(client.clone()).or_insert_with(new))
    }
}

/// Units of this number of bytes, at least one.
fn units(bytes: usize) -> u32 {
    u32::try_from(bytes.div_ceil(UNIT_BYTES)).unwrap_or(u32::MAX).max(1)
}

#[cfg(test)]
mod tests {
    use futures_util::FutureExt as _;

    use super::*;

    const MIB: usize = 1 << 20;

    fn client(name: &str) -> Key {
        Key::Token(name.to_owned())
    }

    #[tokio::test]
    async fn a_client_has_room_for_one_of_the_largest_tables_and_all_have_for_two() {
        let room = TableRoom::new(32 * MIB);
        let (a, b, c) = (client("a"), client("b"), client("c"));
        let first = room.take(&a, 20 * MIB).await;
        let mut second = Box::pin(room.take(&a, 20 * MIB));
        assert!((&mut second).now_or_never().is_none(), "a has 12 MiB left");
        let other = room.take(&b, 32 * MIB).await;
        assert!(room.take(&c, 32 * MIB).now_or_never().is_none(), "all have 12 MiB left");
        drop(other);
        drop(room.take(&c, 32 * MIB).now_or_never().expect("b has given back"));
        drop(first);
        drop(second.await);
        // Whatever a client announces, it can be taken at last.
        drop(room.take(&a, usize::MAX).now_or_never().expect("all room is free"));
        drop(room.take(&a, 0).await);
        assert_eq!(room.all.available_permits(), 64 * 1_024);
        drop(room.take(&b, 1).await);
        assert_eq!(room.clients.lock().unwrap().len(), 1, "nothing is kept of clients that have no table");
    }

    #[tokio::test]
    async fn one_table_is_read_at_a_time_and_who_leaves_does_not_wait() {
        let room = TableRoom::new(MIB);
        let turn = room.turn().await;
        let mut second = Box::pin(room.turn());
        assert!((&mut second).now_or_never().is_none());
        drop(second);
        let mut third = Box::pin(room.turn());
        assert!((&mut third).now_or_never().is_none());
        drop(turn);
        drop(third.await);
    }
}
