//! Values of columns: vectors as blobs, times as microseconds, and lists as parameters of a statement.

use std::fmt::Display;

use serde::Serialize;

use super::error::Error;
use crate::quantity::Timestamp;

/// Little-endian f64 blob of a vector.
pub(super) fn to_blob(values: impl Iterator<Item = f64>) -> Vec<u8> {
    values.flat_map(f64::to_le_bytes).collect()
}

/// The vector of a blob.
pub(super) fn from_blob(what: &'static str, blob: &[u8]) -> Result<Vec<f64>, Error> {
    let (chunks, rest) = blob.as_chunks::<8>();
    if rest.is_empty() {
        Ok(chunks.iter().map(|chunk| f64::from_le_bytes(*chunk)).collect())
    } else {
        Err(Error::Row { what, detail: format!("a vector has {} bytes, which is not a multiple of 8", blob.len()) })
    }
}

/// Makes the error of a row that cannot be decoded.
pub(super) fn bad_row(what: &'static str) -> impl Fn(&dyn Display) -> Error {
    move |detail| Error::Row { what, detail: detail.to_string() }
}

/// The time of a number of microseconds since 1970.
pub(super) fn timestamp(what: &'static str, micros: i64) -> Result<Timestamp, Error> {
    Timestamp::from_micros(micros).map_err(|e| bad_row(what)(&e))
}

/// A list as the parameter of [`elements`].
pub(super) fn list<T: Serialize>(values: &[T]) -> String {
    serde_json::to_string(values).expect("a list of texts or numbers is plain data")
}

/// The elements of a [`list`] as a table of `key` (index from 0) and `value`, given the parameter of the statement.
///
/// SQLite has no array parameters. For a database that has them, only this macro would have to change.
macro_rules! elements {
    ($parameter:literal) => {
        concat!("json_each(", $parameter, ")")
    };
}
pub(super) use elements;
