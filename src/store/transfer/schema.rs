//! The tables of both databases: their columns, their primary keys, and their order by what they refer to.

use std::collections::{BTreeMap, BTreeSet};

use sqlx_postgres::PgConnection;
use sqlx_sqlite::SqliteConnection;

use super::super::server::SCHEMA;
use super::error::TransferError;
use super::side::{Source, Target};
use super::table::{Column, Kind, Table};

/// Tables that belong to one database and not to the data.
const OF_THE_DATABASE: [&str; 8] = [
    "application",
    "_sqlx_migrations",
    "node",
    "node_secret",
    "computation_worker",
    "computation_job",
    "computation_piece",
    "computation_result",
];

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
        .flat_map(|table| table.columns.iter().map(|column| (table.name().to_owned(), column.name.clone())))
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
        let entry = tables.entry(table.clone()).or_insert_with(|| Table::named(table.clone()));
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
        return Err(TransferError::Tables(format!("{} has no primary key", table.name())));
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
