//! Rows of a database that cannot be read as what they are.

use std::collections::BTreeMap;

use sqlx::sqlite::SqliteConnection;

use super::column::bad_row;
use super::error::Error;
use super::reference_content::stored_origin;
use super::undamaged::{quantity, stored_process, ReferenceQuantityRow};
use crate::damage::{JointReference, SeenCovariate};

/// Rows that are named.
const MOST_NAMED: i64 = 5;

/// Columns with JSON text, with the columns that name their row.
const JSON: [(&str, &str, &str); 14] = [
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
];

/// The rows that cannot be read, as sentences: undamaged references are read as the service does, of other texts it is checked that they
/// are JSON.
pub(super) async fn unreadable(connection: &mut SqliteConnection) -> Result<Vec<String>, Error> {
    let mut found = Vec::new();
    let states: Vec<(String, u32)> =
        sqlx::query_as("select structure_id, version from undamaged_state order by structure_id, version")
            .fetch_all(&mut *connection)
            .await?;
    for (structure, version) in states {
        if let Err(error) = read_reference(connection, &structure, version).await {
            found.push(format!("undamaged reference {version} of {structure}: {error}"));
        }
    }
    for (table, column, name) in JSON {
        let select = format!(
            "select distinct {name} from {table} where {column} is not null and json_valid({column}) = 0 limit $1"
        );
        let rows: Vec<(String,)> =
            sqlx::query_as(sqlx::AssertSqlSafe(select)).bind(MOST_NAMED).fetch_all(&mut *connection).await?;
        found.extend(rows.into_iter().map(|(row,)| format!("{column} of {table} {row} is not JSON")));
    }
    Ok(found)
}

/// The texts of a reference.
type Texts = (String, String, Option<String>, Option<String>, i64, Option<String>);

async fn read_reference(connection: &mut SqliteConnection, structure: &str, version: u32) -> Result<(), Error> {
    let bad = bad_row("undamaged reference");
    let (conditions, doubts, joint, origin, measurements, process): Texts = sqlx::query_as(
        "select conditions, doubts, joint, origin, measurement_count, process from undamaged_state
         left join undamaged_process using (structure_id, version) where structure_id = $1 and version = $2",
    )
    .bind(structure)
    .bind(version)
    .fetch_one(&mut *connection)
    .await?;
    let _: BTreeMap<String, SeenCovariate> = serde_json::from_str(&conditions).map_err(|e| bad(&e))?;
    let _: Vec<String> = serde_json::from_str(&doubts).map_err(|e| bad(&e))?;
    let _: Option<JointReference> = joint.as_deref().map(serde_json::from_str).transpose().map_err(|e| bad(&e))?;
    stored_origin(origin.as_deref())?;
    process.as_deref().map(stored_process).transpose()?;
    let rows: Vec<ReferenceQuantityRow> = sqlx::query_as(
        "select quantity, mean, std, threshold, detail, mean_draws, std_draws from undamaged_quantity
         where structure_id = $1 and version = $2 order by position",
    )
    .bind(structure)
    .bind(version)
    .fetch_all(&mut *connection)
    .await?;
    for row in rows {
        quantity(row, usize::try_from(measurements).unwrap_or_default())?;
    }
    Ok(())
}
