//! Rows of a database that cannot be read as what they are.

use std::collections::BTreeMap;

use sqlx_postgres::PgConnection;
use sqlx_sqlite::SqliteConnection;

use super::column::bad_row;
use super::error::Error;
use super::reference_content::{stored_origin, stored_process};
use super::sql::{self, On, Whole};
use super::undamaged::{quantity, ReferenceQuantityRow};
use crate::damage::{JointReference, SeenCovariate};
use crate::quantity::Timestamp;

/// Rows that are named.
const MOST_NAMED: i64 = 5;

/// A column: its table, its name, and the column that names its row.
type Column = (&'static str, &'static str, &'static str);

/// Columns with JSON text.
const JSON: [Column; 24] = [
    ("structure", "definition", "structure_id"),
    ("structure_version", "definition", "structure_id"),
    ("measurement", "covariates", "batch_id"),
    ("measurement", "settings", "batch_id"),
    ("measurement", "mode_shapes", "batch_id"),
    ("assessment", "trust", "batch_id"),
    ("assessment", "joint", "batch_id"),
    ("process_point", "estimate", "batch_id"),
    ("process_point", "changes", "batch_id"),
    ("process_point", "memory", "batch_id"),
    ("webhook", "events", "webhook_id"),
    ("webhook", "alarm_kinds", "webhook_id"),
    ("webhook", "structures", "webhook_id"),
    ("imported_action", "record", "structure_id"),
    ("diagnosis", "request", "diagnosis_id"),
    ("diagnosis", "result", "diagnosis_id"),
    ("diagnosis", "extension", "diagnosis_id"),
    ("diagnosis", "extension_request", "diagnosis_id"),
    ("training", "request", "training_id"),
    ("training", "result", "training_id"),
    ("outbox_event", "facts", "message_id"),
    ("mail_recipient", "events", "address"),
    ("mail_recipient", "alarm_kinds", "address"),
    ("api_token", "sources", "token_id"),
];

/// Columns with vectors of f64.
const VECTORS: [Column; 5] = [
    ("measurement", "frequency_hz", "batch_id"),
    ("measurement", "std_hz", "batch_id"),
    ("assessment", "misfit_percent", "batch_id"),
    ("assessment", "plotted", "batch_id"),
    ("process_point", "known", "batch_id"),
];

/// A connection of either database, whose rows are looked at.
pub(super) enum Inspected<'c> {
    File(&'c mut SqliteConnection),
    Server(&'c mut PgConnection),
}

impl Inspected<'_> {
    fn on(&mut self) -> On<'_> {
        match self {
            Self::File(connection) => On::Sqlite(connection),
            Self::Server(connection) => On::Postgres(connection),
        }
    }

    /// Columns with a time in microseconds, with their tables.
    const fn times(&self) -> &'static str {
        match self {
            Self::File(_) => {
                "select t.name, c.name from sqlite_schema t join pragma_table_info(t.name) c
                 where t.type = 'table' and c.name like '%\\_us' escape '\\' order by 1, 2"
            }
            Self::Server(_) => {
                "select c.table_name::text, c.column_name::text from information_schema.columns c
                 join information_schema.tables t using (table_schema, table_name)
                 where c.table_schema = current_schema() and t.table_type = 'BASE TABLE'
                   and c.column_name like '%\\_us' order by 1, 2"
            }
        }
    }
}

/// The rows that cannot be read, as sentences: undamaged references are read as the service does, of other texts it is checked that they
/// are JSON, of vectors that they consist of whole numbers of 8 bytes, and of times that they are within the calendar.
pub(super) async fn unreadable(mut connection: Inspected<'_>) -> Result<Vec<String>, Error> {
    let connection = &mut connection;
    let mut found = Vec::new();
    let states: Vec<(String, Whole<u32>)> =
        sql::query_as("select structure_id, version from undamaged_state order by structure_id, version")
            .fetch_all(connection.on())
            .await?;
    for (structure, Whole(version)) in states {
        if let Err(error) = read_reference(connection, &structure, version).await {
            found.push(format!("undamaged reference {version} of {structure}: {error}"));
        }
    }
    for column in JSON {
        found.extend(named(connection, column, "json_valid(@) = 0", "is not JSON").await?);
    }
    for column in VECTORS {
        found.extend(named(connection, column, "length(@) % 8 <> 0", "is no vector of f64").await?);
    }
    let outside = format!("@ not between {} and {}", Timestamp::MIN.micros(), Timestamp::MAX.micros());
    let times: Vec<(String, String)> = sql::query_as(connection.times()).fetch_all(connection.on()).await?;
    for (table, column) in &times {
        let column = (table.as_str(), column.as_str(), name_of(table));
        found.extend(named(connection, column, &outside, "is no time").await?);
    }
    Ok(found)
}

/// The column that names a row of a table with times.
fn name_of(table: &str) -> &'static str {
    match table {
        "measurement" | "measurement_batch" | "assessment" | "chart_point" | "process_point" => "batch_id",
        "webhook" | "webhook_delivery" => "webhook_id",
        "mail_delivery" => "address",
        "outbox_event" => "message_id",
        "diagnosis" => "diagnosis_id",
        "training" => "training_id",
        "note" => "note_id",
        "api_token" => "token_id",
        "audit_entry" => "action",
        "quarantine" => "topic",
        _ => "structure_id",
    }
}

/// The first rows in which a column, `@` of the condition, is not what it should be.
async fn named(
    connection: &mut Inspected<'_>,
    (table, column, name): (&str, &str, &str),
    condition: &str,
    is: &str,
) -> Result<Vec<String>, Error> {
    let condition = condition.replace('@', column);
    let select = format!("select distinct {name} from {table} where {column} is not null and {condition} limit $1");
    let rows: Vec<(String,)> =
        sql::query_as(sqlx::AssertSqlSafe(select)).bind(MOST_NAMED).fetch_all(connection.on()).await?;
    Ok(rows.into_iter().map(|(row,)| format!("{column} of {table} {row} {is}")).collect())
}

/// The texts of a reference.
type Texts = (String, String, Option<String>, Option<String>, i64, Option<String>);

async fn read_reference(connection: &mut Inspected<'_>, structure: &str, version: u32) -> Result<(), Error> {
    let bad = bad_row("undamaged reference");
    let (conditions, doubts, joint, origin, measurements, process): Texts = sql::query_as(
        "select conditions, doubts, joint, origin, measurement_count, process from undamaged_state
         left join undamaged_process using (structure_id, version) where structure_id = $1 and version = $2",
    )
    .bind(structure)
    .bind(version)
    .fetch_one(connection.on())
    .await?;
    let _: BTreeMap<String, SeenCovariate> = serde_json::from_str(&conditions).map_err(|e| bad(&e))?;
    let _: Vec<String> = serde_json::from_str(&doubts).map_err(|e| bad(&e))?;
    let _: Option<JointReference> = joint.as_deref().map(serde_json::from_str).transpose().map_err(|e| bad(&e))?;
    stored_origin(origin.as_deref())?;
    process.as_deref().map(stored_process).transpose()?;
    let rows: Vec<ReferenceQuantityRow> = sql::query_as(
        "select quantity, mean, std, threshold, detail, mean_draws, std_draws from undamaged_quantity
         where structure_id = $1 and version = $2 order by position",
    )
    .bind(structure)
    .bind(version)
    .fetch_all(connection.on())
    .await?;
    for row in rows {
        quantity(row, usize::try_from(measurements).unwrap_or_default())?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::path::Path;

    use sqlx::Connection as _;
    use sqlx_sqlite::SqliteConnectOptions;

    use super::super::{Store, DATABASE_FILE};
    use super::*;

    /// A database with a row in each table of [`JSON`] and [`VECTORS`].
    async fn with_rows(folder: &Path) -> SqliteConnection {
        Store::open(folder).await.unwrap().close().await;
        let options = SqliteConnectOptions::new().filename(folder.join(DATABASE_FILE)).foreign_keys(false);
        let mut connection = SqliteConnection::connect_with(&options).await.unwrap();
        sqlx::raw_sql("pragma ignore_check_constraints = on").execute(&mut connection).await.unwrap();
        let tables: BTreeSet<&str> = JSON.iter().chain(&VECTORS).map(|(table, ..)| *table).collect();
        for table in tables {
            let columns: Vec<(String, String)> = sqlx::query_as("select name, type from pragma_table_info($1)")
                .bind(table)
                .fetch_all(&mut connection)
                .await
                .unwrap();
            let value = |(name, kind): &(String, String)| match kind.to_lowercase().as_str() {
                "blob" => "zeroblob(16)",
                "integer" | "real" => "1",
                _ if JSON.iter().any(|(of, column, _)| (*of, *column) == (table, name.as_str())) => "'[]'",
                _ => "'row'",
            };
            let values: Vec<&str> = columns.iter().map(value).collect();
            let insert = format!("insert into {table} values ({})", values.join(", "));
            sqlx::raw_sql(sqlx::AssertSqlSafe(insert)).execute(&mut connection).await.unwrap();
        }
        connection
    }

    #[tokio::test]
    async fn each_column_that_cannot_be_read_is_named_with_its_row() {
        let folder = tempfile::tempdir().unwrap();
        let mut connection = with_rows(folder.path()).await;
        assert_eq!(unreadable(Inspected::File(&mut connection)).await.unwrap(), Vec::<String>::new());
        let json = JSON.map(|column| (column, "'}{'", "'[]'"));
        let vectors = VECTORS.map(|column| (column, "zeroblob(15)", "zeroblob(16)"));
        for ((table, column, _), damaged, whole) in json.into_iter().chain(vectors) {
            for (value, named) in [(damaged, 1), (whole, 0)] {
                let update = format!("update {table} set {column} = {value}");
                sqlx::raw_sql(sqlx::AssertSqlSafe(update)).execute(&mut connection).await.unwrap();
                let found = unreadable(Inspected::File(&mut connection)).await.unwrap();
                assert_eq!(found.len(), named, "{table}.{column}: {found:?}");
                let sentence = format!("{column} of {table} row is no");
                assert!(found.iter().all(|found| found.starts_with(&sentence)), "{found:?}");
            }
        }
    }

    /// The columns that a migration says are JSON: in the comment on their line, or in that before the statement that adds them.
    fn said_to_be_json(migration: &str) -> Vec<(String, String)> {
        let (mut table, mut comment, mut found) = (String::new(), String::new(), Vec::new());
        for line in migration.lines() {
            let words: Vec<&str> = line.split_whitespace().collect();
            let said = line.split_once("--").is_some_and(|(_, comment)| comment.contains("JSON"));
            match words.as_slice() {
                ["--", ..] => {
                    comment.push_str(line);
                    continue;
                }
                ["create", "table", name, ..] => table = name.trim_end_matches("_2").to_owned(),
                ["alter", "table", name, "add", "column", column, ..] if said || comment.contains("JSON") => {
                    found.push(((*name).to_owned(), (*column).to_owned()));
                }
                [column, ..] if said => found.push((table.clone(), (*column).to_owned())),
                _ => {}
            }
            comment.clear();
        }
        found
    }

    #[test]
    fn every_column_with_json_is_checked() {
        let migrations = std::fs::read_dir(Path::new(env!("CARGO_MANIFEST_DIR")).join("migrations")).unwrap();
        let files = migrations.map(|file| file.unwrap().path()).filter(|path| path.is_file());
        let texts = files.map(|file| std::fs::read_to_string(file).unwrap());
        let all: Vec<(String, String)> = texts.flat_map(|text| said_to_be_json(&text)).collect();
        assert!(all.len() > JSON.len(), "the comments of the migrations are not understood: {all:?}");
        // These are read whole.
        let read = ["undamaged_state", "undamaged_quantity", "undamaged_process"];
        for (table, column) in all.iter().filter(|(table, _)| !read.contains(&table.as_str())) {
            let known = JSON.iter().any(|(of, name, _)| of == table && name == column);
            assert!(known, "the doctor does not check {column} of {table}");
        }
    }
}
