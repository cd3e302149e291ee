//! Maintenance windows.

use super::alarm::Alarms;
use super::column::timestamp;
use super::error::Error;
use super::sql;
use crate::quantity::{StructureId, Timestamp};

/// A period in which batches do not change the alarm charts.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MaintenanceWindow {
    /// Beginning.
    pub from: Timestamp,
    /// End.
    pub to: Timestamp,
    /// Reason.
    pub reason: String,
}

impl Alarms<'_> {
    /// Stores a maintenance window. Points of batches that are already on the charts do not change.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn insert_maintenance(
        self,
        structure: &StructureId,
        window: MaintenanceWindow,
        now: Timestamp,
    ) -> Result<(), Error> {
        let id = structure.to_string();
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    sql::query(
                        "insert into maintenance_window values ($1, $2, $3, $4, $5)
                     on conflict (structure_id, from_us, to_us) do update
                     set reason = excluded.reason, created_at_us = excluded.created_at_us",
                    )
                    .bind(&id)
                    .bind(window.from.micros())
                    .bind(window.to.micros())
                    .bind(&window.reason)
                    .bind(now.micros())
                    .execute(&mut *transaction)
                    .await?;
                    Ok(())
                })
            })
            .await
    }

    /// Whether a time is in a maintenance window.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn is_in_maintenance(self, structure: &StructureId, at: Timestamp) -> Result<bool, Error> {
        let (found,): (bool,) = sql::query_as(
            "select exists (select 1 from maintenance_window where structure_id = $1 and from_us <= $2 and to_us > $2)",
        )
        .bind(structure.as_str())
        .bind(at.micros())
        .fetch_one(&self.database.reader)
        .await?;
        Ok(found)
    }

    /// Maintenance windows of a structure, newest first, at most 1000.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn maintenance(self, structure: &StructureId) -> Result<Vec<MaintenanceWindow>, Error> {
        let statement = sql::query_as(
            "select from_us, to_us, reason from maintenance_window where structure_id = $1 order by from_us desc limit 1000",
        )
        .bind(structure.as_str());
        let window = |(from, to, reason)| {
            let what = "maintenance window";
            Ok(MaintenanceWindow { from: timestamp(what, from)?, to: timestamp(what, to)?, reason })
        };
        self.database.damaged.leave_out(statement, &self.database.reader, 2, window).await
    }
}
