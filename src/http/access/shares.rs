//! How much of a resource one client may have at a time: of the event streams, of the computations for readers.

use std::collections::HashMap;
use std::sync::{Arc, Mutex};

use super::client::Key;

/// Counts what each client has at present.
pub struct Shares {
    most: usize,
    taken: Arc<Mutex<HashMap<Key, usize>>>,
}

/// One share of a client, given back when dropped.
pub struct Share {
    key: Key,
    taken: Arc<Mutex<HashMap<Key, usize>>>,
}

impl Shares {
    /// At most `most` for each client.
    pub fn new(most: usize) -> Self {
        Self { most, taken: Arc::default() }
    }

    /// Largest number for each client.
    pub fn most(&self) -> usize {
        self.most
    }

    /// A share of this client, unless it has all that it may have.
    pub fn take(&self, key: &Key) -> Option<Share> {
        let mut taken = self.taken.lock().expect("no holder of this lock panics");
        let count = taken.entry(key.clone()).or_insert(0);
        if *count >= self.most {
            return None;
        }
        *count += 1;
        Some(Share { key: key.clone(), taken: Arc::clone(&self.taken) })
    }
}

impl Drop for Share {
    fn drop(&mut self) {
        let mut taken = self.taken.lock().expect("no holder of this lock panics");
        if let Some(count) = taken.get_mut(&self.key) {
            *count -= 1;
            if *count == 0 {
                taken.remove(&self.key);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_client_has_its_share_and_gives_it_back() {
        let (shares, one, other) = (Shares::new(2), Key::Token("one".to_owned()), Key::Token("other".to_owned()));
        let mut held: Vec<Share> = (0..2).filter_map(|_| shares.take(&one)).collect();
        assert!(held.len() == 2 && shares.take(&one).is_none() && shares.take(&other).is_some());
        held.pop();
        assert!(shares.take(&one).is_some());
        held.clear();
        assert!(shares.taken.lock().unwrap().is_empty(), "nothing is kept of clients that have nothing");
    }
}
