//! The rows of a table that are refused: all are counted, and the first are kept. A table may have millions of them.

use crate::measurement::check::Problem;

/// Refused rows.
#[derive(Debug, Clone, PartialEq)]
pub struct Refused {
    most: usize,
    first: Vec<Problem>,
    count: usize,
}

impl Refused {
    /// Keeps at most this many of the rows that will be added.
    pub fn new(most: usize) -> Self {
        Self { most, first: Vec::new(), count: 0 }
    }

    /// Adds a row. Its problem is put into words only if it is kept.
    pub fn add(&mut self, problem: impl FnOnce() -> Problem) {
        if self.first.len() < self.most {
            self.first.push(problem());
        }
        self.count += 1;
    }

    /// Number of all rows.
    pub fn count(&self) -> usize {
        self.count
    }

    /// The rows that are kept, in the order of the file.
    pub fn first(&self) -> &[Problem] {
        &self.first
    }
}
