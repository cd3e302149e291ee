//! A table of both databases, and its rows.

use std::cmp::Ordering;

use futures_util::stream::{BoxStream, Peekable};
use sha2::{Digest as _, Sha256};

use super::super::sql::Value;

/// The type of a column.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Kind {
    Integer,
    Real,
    Text,
    Blob,
    Truth,
}

/// A column.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Column {
    pub name: String,
    pub kind: Kind,
    /// The server numbers its rows by it.
    pub numbered: bool,
}

/// A table.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(super) struct Table {
    name: String,
    pub columns: Vec<Column>,
    /// Indices of the columns of the primary key, in its order.
    pub key: Vec<usize>,
}

/// The values of a row, in the order of the columns.
pub(super) type Values = Vec<Value>;

/// The rows of a table, in the order of its primary key.
pub(super) type Rows<'c> = Peekable<BoxStream<'c, Result<Values, sqlx::Error>>>;

impl Table {
    /// A table without columns.
    pub(super) fn named(name: String) -> Self {
        Self { name, columns: Vec::new(), key: Vec::new() }
    }

    /// Its name.
    pub(super) fn name(&self) -> &str {
        &self.name
    }

    /// The names of its columns, for a statement.
    pub(super) fn column_list(&self) -> String {
        self.columns.iter().map(|column| quoted(&column.name)).collect::<Vec<_>>().join(", ")
    }

    /// The names of the columns of its primary key, for a statement.
    pub(super) fn key_list(&self) -> String {
        self.key.iter().map(|&i| quoted(&self.columns[i].name)).collect::<Vec<_>>().join(", ")
    }

    /// The order of two rows by the primary key, which is that of both databases: numbers by size, texts byte by byte.
    pub(super) fn order(&self, a: &[Value], b: &[Value]) -> Ordering {
        self.key.iter().map(|&i| key_order(&a[i], &b[i])).find(|order| order.is_ne()).unwrap_or(Ordering::Equal)
    }
}

fn key_order(a: &Value, b: &Value) -> Ordering {
    match (a, b) {
        (Value::Integer(a), Value::Integer(b)) => a.cmp(b),
        (Value::Text(a), Value::Text(b)) => a.as_deref().map(str::as_bytes).cmp(&b.as_deref().map(str::as_bytes)),
        (Value::Blob(a), Value::Blob(b)) => a.cmp(b),
        (Value::Truth(a), Value::Truth(b)) => a.cmp(b),
        (Value::Real(a), Value::Real(b)) => a.partial_cmp(b).unwrap_or(Ordering::Equal),
        // Both sides read a column as the same type.
        _ => Ordering::Equal,
    }
}

/// Whether two rows have the same bits.
pub(super) fn same(a: &[Value], b: &[Value]) -> bool {
    a.len() == b.len()
        && a.iter().zip(b).all(|(a, b)| match (a, b) {
            (Value::Real(a), Value::Real(b)) => a.map(f64::to_bits) == b.map(f64::to_bits),
            (Value::Integer(a), Value::Integer(b)) => a == b,
            (Value::Text(a), Value::Text(b)) => a == b,
            (Value::Blob(a), Value::Blob(b)) => a == b,
            (Value::Truth(a), Value::Truth(b)) => a == b,
            _ => false,
        })
}

/// Adds a row to the digest of a table: each value with its type and its length, so that no two tables have the same bytes.
pub(super) fn digest(digest: &mut Sha256, row: &[Value]) {
    let mut add = |kind: u8, bytes: Option<&[u8]>| {
        digest.update([kind, u8::from(bytes.is_some())]);
        if let Some(bytes) = bytes {
            digest.update((bytes.len() as u64).to_le_bytes());
            digest.update(bytes);
        }
    };
    for value in row {
        match value {
            Value::Integer(value) => add(0, value.map(i64::to_le_bytes).as_ref().map(<[u8; 8]>::as_slice)),
            Value::Real(value) => add(1, value.map(f64::to_le_bytes).as_ref().map(<[u8; 8]>::as_slice)),
            Value::Text(value) => add(2, value.as_deref().map(str::as_bytes)),
            Value::Blob(value) => add(3, value.as_deref()),
            Value::Truth(value) => add(4, value.map(|value| [u8::from(value)]).as_ref().map(<[u8; 1]>::as_slice)),
        }
    }
}

/// A name in a statement. The names are those of our own schema and have no quotes.
pub(super) fn quoted(name: &str) -> String {
    format!("\"{name}\"")
}
