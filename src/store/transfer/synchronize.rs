//! Making the target equal to the source, table by table.

use std::cmp::Ordering;

use data_encoding::HEXLOWER;
use futures_util::TryStreamExt as _;
use sha2::{Digest as _, Sha256};

use super::error::TransferError;
use super::side::{Source, Target};
use super::table::{digest, same, Rows, Table, Values};

/// Rows between two reports of progress.
const REPORT_EVERY: u64 = 1_000;

/// Rows in one transaction of the target.
const ROWS_AT_A_TIME: usize = 500;

/// Where a row is.
enum Found {
    Source(Values),
    Target(Values),
    Both(Values, Values),
}

/// The next row of either side.
async fn next(table: &Table, source: &mut Rows<'_>, target: &mut Rows<'_>) -> Result<Option<Found>, sqlx::Error> {
    let order = match (std::pin::Pin::new(&mut *source).peek().await, std::pin::Pin::new(&mut *target).peek().await) {
        (Some(Ok(a)), Some(Ok(b))) => table.order(a, b),
        (None, None) => return Ok(None),
        // An error is taken from its stream below.
        (Some(Err(_)), _) | (Some(_), None) => Ordering::Less,
        (_, Some(Err(_))) | (None, Some(_)) => Ordering::Greater,
    };
    let one = |row: Option<Values>| row.ok_or(sqlx::Error::RowNotFound);
    Ok(Some(match order {
        Ordering::Less => Found::Source(one(source.try_next().await?)?),
        Ordering::Greater => Found::Target(one(target.try_next().await?)?),
        Ordering::Equal => Found::Both(one(source.try_next().await?)?, one(target.try_next().await?)?),
    }))
}

/// Removes the rows that only the target has. Returns their number.
pub(super) async fn remove(source: &mut Source, target: &mut Target, table: &Table) -> Result<u64, TransferError> {
    let (reading, writing) = target.both();
    let (mut ours, mut theirs) = (source.rows(table), reading.rows(table));
    let (mut surplus, mut removed) = (Vec::new(), 0);
    while let Some(found) = next(table, &mut ours, &mut theirs).await? {
        if let Found::Target(row) = found {
            surplus.push(row);
            removed += 1;
        }
        if surplus.len() >= ROWS_AT_A_TIME {
            writing.remove(table, &std::mem::take(&mut surplus)).await?;
        }
    }
    if !surplus.is_empty() {
        writing.remove(table, &surplus).await?;
    }
    Ok(removed)
}

/// Writes the rows that the target lacks or has otherwise. Returns their number.
pub(super) async fn write(
    source: &mut Source,
    target: &mut Target,
    table: &Table,
    mut progress: impl FnMut(u64),
) -> Result<u64, TransferError> {
    let (reading, writing) = target.both();
    let (mut ours, mut theirs) = (source.rows(table), reading.rows(table));
    let (mut missing, mut written, mut read) = (Vec::new(), 0, 0_u64);
    progress(0);
    while let Some(found) = next(table, &mut ours, &mut theirs).await? {
        read += 1;
        if read.is_multiple_of(REPORT_EVERY) {
            progress(read);
        }
        match found {
            Found::Source(row) => missing.push(row),
            Found::Both(row, other) if !same(&row, &other) => missing.push(row),
            // What only the target has was removed before; a row that came since is found by the comparison at the end.
            Found::Both(..) | Found::Target(_) => continue,
        }
        written += 1;
        if missing.len() >= ROWS_AT_A_TIME {
            writing.write(table, &std::mem::take(&mut missing)).await?;
        }
    }
    if !missing.is_empty() {
        writing.write(table, &missing).await?;
    }
    Ok(written)
}

/// Checks that both sides have the same rows. Returns their number and digest.
///
/// # Errors
/// [`TransferError::Differs`].
pub(super) async fn compare(
    source: &mut Source,
    target: &mut Target,
    table: &Table,
    mut progress: impl FnMut(u64),
) -> Result<(u64, String), TransferError> {
    let (reading, _) = target.both();
    let (mut ours, mut theirs) = (source.rows(table), reading.rows(table));
    let (mut sum, mut row) = (Sha256::new(), 0_u64);
    progress(0);
    loop {
        let (here, there) = (ours.try_next().await?, theirs.try_next().await?);
        row += 1;
        match (here, there) {
            (None, None) => break,
            (Some(here), Some(there)) if same(&here, &there) => digest(&mut sum, &here),
            _ => return Err(TransferError::Differs { table: table.name().to_owned(), row }),
        }
        if row.is_multiple_of(REPORT_EVERY) {
            progress(row);
        }
    }
    Ok((row - 1, HEXLOWER.encode(&sum.finalize())))
}
