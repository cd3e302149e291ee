//! Moving everything that is stored between a SQLite file and a database of a PostgreSQL server, in either direction.
//!
//! Both sides are read side by side, table by table, in the order of the primary keys. Rows that the target lacks or has otherwise are
//! written, and rows that only the target has are removed. A move that was broken off, or a rehearsal while the source was serving, is
//! therefore continued by running it again, and what is equal already is only read. At the end both sides are read once more and must be
//! equal in every row; the counts and digests of that reading are the result.
//!
//! The source is read in one transaction, so that it is one state of the data, also while a service writes to it.

mod error;
mod location;
mod schema;
mod side;
mod synchronize;
mod table;

use serde::Serialize;

pub use error::TransferError;
pub use location::Location;
use side::{Source, Target};

/// A table after a move.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct MovedTable {
    /// Its name.
    pub table: String,
    /// Number of its rows, the same on both sides.
    pub rows: u64,
    /// SHA-256 of its rows, the same on both sides.
    pub sha256: String,
    /// Rows that this move has written.
    pub written: u64,
    /// Rows that this move has removed from the target.
    pub removed: u64,
}

/// The result of a move.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Moved {
    /// The tables.
    pub tables: Vec<MovedTable>,
    /// A service was using the source: what it has stored since the beginning of the move is not in the target.
    pub rehearsal: bool,
}

/// A step of a move, for its progress.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Step<'t> {
    /// A table is being compared and written.
    Writing(&'t str),
    /// A table is being compared once more.
    Checking(&'t str),
}

/// Moves everything from one place to another. The target is not used by a service in the meantime. With `replace`, a database of a server
/// that has data already is made equal to the source.
///
/// # Errors
/// [`TransferError`]; the target then cannot be served until a move into it has been completed.
pub async fn transfer(
    from: &Location,
    to: &Location,
    replace: bool,
    progress: &mut (dyn FnMut(Step<'_>, u64) + Send),
) -> Result<Moved, TransferError> {
    let mut source = Source::open(from).await?;
    let mut target = Target::open(to, replace).await?;
    let tables = schema::tables(&mut source, &mut target).await?;
    target.begin().await?;
    let mut changes = Vec::new();
    // Rows that refer to others are removed before them and written after them.
    for table in tables.iter().rev() {
        changes.push(synchronize::remove(&mut source, &mut target, table).await?);
    }
    changes.reverse();
    let mut moved = Vec::new();
    for (table, removed) in tables.iter().zip(changes) {
        let written =
            synchronize::write(&mut source, &mut target, table, |rows| progress(Step::Writing(table.name()), rows))
                .await?;
        moved.push(MovedTable { table: table.name().to_owned(), rows: 0, sha256: String::new(), written, removed });
    }
    for (table, moved) in tables.iter().zip(&mut moved) {
        let step = |rows| progress(Step::Checking(table.name()), rows);
        (moved.rows, moved.sha256) = synchronize::compare(&mut source, &mut target, table, step).await?;
    }
    target.finish(&tables).await?;
    let rehearsal = source.close().await;
    Ok(Moved { tables: moved, rehearsal })
}
