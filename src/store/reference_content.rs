//! Batches, origin and process of a stored undamaged reference.

use super::column::bad_row;
use super::database::Database;
use super::error::Error;
use super::sql;
use crate::damage::ReferenceOrigin;
use crate::process::reference::ReferenceProcess;
use crate::quantity::StructureId;

/// The ids of the batches of a version, in alphabetical order; none if there is no such version.
pub(super) async fn batches_of(
    database: &Database,
    structure: &StructureId,
    version: u32,
) -> Result<Vec<String>, Error> {
    let batches: Vec<(String,)> = sql::query_as(
        "select batch_id from undamaged_batch where structure_id = $1 and version = $2 order by batch_id",
    )
    .bind(structure.as_str())
    .bind(version)
    .fetch_all(&database.reader)
    .await?;
    Ok(batches.into_iter().map(|(id,)| id).collect())
}

/// The stored origin of a reference.
pub(super) fn stored_origin(text: Option<&str>) -> Result<ReferenceOrigin, Error> {
    text.map_or_else(
        || Ok(ReferenceOrigin::default()),
        |text| serde_json::from_str(text).map_err(|e| bad_row("undamaged reference")(&e)),
    )
}

/// The stored process of a reference, with which the filter can compute.
pub(super) fn stored_process(text: &str) -> Result<ReferenceProcess, Error> {
    let bad = bad_row("undamaged process");
    let process: ReferenceProcess = serde_json::from_str(text).map_err(|e| bad(&e))?;
    process.defect().map_or(Ok(process), |defect| Err(bad(&defect)))
}
