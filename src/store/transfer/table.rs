//! The tables of both databases: their columns, their primary keys, and their order by what they refer to.

use std::cmp::Ordering;
use std::collections::{BTreeMap, BTreeSet};

use sha2::{Digest as _, Sha256};
use sqlx::postgres::PgConnection;
use sqlx::sqlite::SqliteConnection;

use super::super::server::SCHEMA;
use super::super::sql::Value;
use super::side::{Source, Target};
use super::TransferError;

/// Tables that belong to one database and not to the data.
const OF_THE_DATABASE: [&str; 2] = ["application", "_sqlx_migrations"];

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

impl Table {
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

/// The tables that both sides have, those that others refer to first.
///
/// # Errors
/// [`TransferError::Tables`] if a side lacks a table or a column.
pub(super) async fn tables(source: &mut Source, target: &mut Target) -> Result<Vec<Table>, TransferError> {
    let (server, file) = match (source.server(), target.server()) {
        (Some(server), None) => (server, target.file()),
        (None, Some(server)) => (server, source.file()),
        _ => {
            return Err(TransferError::Kind("one of the two places must be a PostgreSQL server and the other a folder"))
        }
    };
    let file = file.expect("a side that is no server is a file");
    let tables = of_server(server).await?;
    let expected: BTreeSet<(String, String)> = tables
        .values()
        .flat_map(|table| table.columns.iter().map(|column| (table.name.clone(), column.name.clone())))
        .collect();
    let found = of_file(file).await?;
    let differing: Vec<String> =
        expected.symmetric_difference(&found).take(5).map(|(table, column)| format!("{table}.{column}")).collect();
    if !differing.is_empty() {
        return Err(TransferError::Tables(differing.join(", ")));
    }
    let references = references(server).await?;
    Ok(ordered(tables, &references))
}

async fn of_server(connection: &mut PgConnection) -> Result<BTreeMap<String, Table>, TransferError> {
    let rows: Vec<(String, String, String, bool, Option<i64>)> = sqlx::query_as(
        "select c.table_name::text, c.column_name::text, c.data_type::text, c.is_identity = 'YES',
                (select k.ordinal_position::bigint
                 from information_schema.table_constraints t
                 join information_schema.key_column_usage k using (constraint_schema, constraint_name, table_name)
                 where t.constraint_schema = $1 and t.constraint_type = 'PRIMARY KEY' and t.table_name = c.table_name
                   and k.column_name = c.column_name)
         from information_schema.columns c join information_schema.tables t using (table_schema, table_name)
         where c.table_schema = $1 and t.table_type = 'BASE TABLE'
         order by c.table_name, c.ordinal_position",
    )
    .bind(SCHEMA)
    .fetch_all(connection)
    .await?;
    let mut tables = BTreeMap::new();
    let mut keys: BTreeMap<String, Vec<(i64, usize)>> = BTreeMap::new();
    for (table, name, kind, numbered, position) in rows {
        if OF_THE_DATABASE.contains(&table.as_str()) {
            continue;
        }
        let kind = match kind.as_str() {
            "bigint" => Kind::Integer,
            "double precision" => Kind::Real,
            "text" => Kind::Text,
            "bytea" => Kind::Blob,
            "boolean" => Kind::Truth,
            other => return Err(TransferError::Tables(format!("{table}.{name} has the type {other}"))),
        };
        let entry = tables.entry(table.clone()).or_insert_with(|| Table {
            name: table.clone(),
            columns: Vec::new(),
            key: Vec::new(),
        });
        if let Some(position) = position {
            keys.entry(table).or_default().push((position, entry.columns.len()));
        }
        entry.columns.push(Column { name, kind, numbered });
    }
    for (table, mut key) in keys {
        key.sort_unstable();
        if let Some(table) = tables.get_mut(&table) {
            table.key = key.into_iter().map(|(_, column)| column).collect();
        }
    }
    if let Some(table) = tables.values().find(|table| table.key.is_empty()) {
        return Err(TransferError::Tables(format!("{} has no primary key", table.name)));
    }
    Ok(tables)
}

async fn of_file(connection: &mut SqliteConnection) -> Result<BTreeSet<(String, String)>, TransferError> {
    let rows: Vec<(String, String)> = sqlx::query_as(
        "select t.name, c.name from sqlite_schema t join pragma_table_info(t.name) c
         where t.type = 'table' and t.name not like 'sqlite\\_%' escape '\\'",
    )
    .fetch_all(connection)
    .await?;
    Ok(rows.into_iter().filter(|(table, _)| !OF_THE_DATABASE.contains(&table.as_str())).collect())
}

/// Pairs of a table and one that it refers to.
async fn references(connection: &mut PgConnection) -> Result<Vec<(String, String)>, TransferError> {
    let rows = sqlx::query_as(
        "select a.relname::text, b.relname::text from pg_constraint c
         join pg_class a on a.oid = c.conrelid join pg_class b on b.oid = c.confrelid
         join pg_namespace n on n.oid = c.connamespace
         where c.contype = 'f' and n.nspname = $1 and a.oid <> b.oid",
    )
    .bind(SCHEMA)
    .fetch_all(connection)
    .await?;
    Ok(rows)
}

/// The tables, each behind those that it refers to.
fn ordered(mut tables: BTreeMap<String, Table>, references: &[(String, String)]) -> Vec<Table> {
    let mut order = Vec::with_capacity(tables.len());
    while !tables.is_empty() {
        let waits = |name: &String| {
            references.iter().any(|(table, other)| table == name && other != name && tables.contains_key(other))
        };
        let next = tables.keys().find(|name| !waits(name)).or_else(|| tables.keys().next()).cloned();
        order.extend(next.and_then(|name| tables.remove(&name)));
    }
    order
}
