//! What decides whether the service starts a diagnosis by itself.

use super::alarm::kind_of;
use super::column::{bad_row, timestamp};
use super::diagnosis::Diagnoses;
use super::error::Error;
use super::sql;
use crate::alarm::chart::FIT_SERIES;
use crate::quantity::{Digest, StructureId, Timestamp};

/// An open alarm of the kind `simulation_does_not_fit`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RejectedEpisode {
    /// The structure.
    pub structure: StructureId,
    /// Number of the alarm.
    pub alarm: i64,
    /// When the service raised it.
    pub noticed_at: Timestamp,
}

/// The times of the latest diagnoses of a structure.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LatestDiagnoses {
    /// Start of the latest diagnosis.
    pub any: Option<Timestamp>,
    /// Start of the latest diagnosis that the service started by itself.
    pub automatic: Option<Timestamp>,
}

impl Diagnoses<'_> {
    /// The open alarms of the kind `simulation_does_not_fit`, at most one for each structure.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn rejected_episodes(self) -> Result<Vec<RejectedEpisode>, Error> {
        let what = "alarm episode";
        let statement = sql::query_as(
            "select structure_id, episode, noticed_at_us from alarm_episode e
             where kind = $1 and ended_at_us is null and withdrawn = 0
               and not exists (select 1 from alarm_episode later where later.structure_id = e.structure_id and later.kind = e.kind
                   and later.ended_at_us is null and later.withdrawn = 0 and later.episode > e.episode)
             order by structure_id",
        )
        .bind(kind_of(FIT_SERIES));
        let episode = |(structure, alarm, noticed_at_us): (String, i64, i64)| {
            let structure = StructureId::parse(&structure).map_err(|e| bad_row(what)(&e))?;
            Ok(RejectedEpisode { structure, alarm, noticed_at: timestamp(what, noticed_at_us)? })
        };
        self.database.damaged.leave_out(statement, &self.database.reader, 2, episode).await
    }

    /// The latest diagnoses of a structure among those that started before `until`. A diagnosis with a later start was started
    /// while the clock was wrong.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn latest(self, structure: &StructureId, until: Timestamp) -> Result<LatestDiagnoses, Error> {
        let (any, automatic): (Option<i64>, Option<i64>) = sql::query_as(
            "select max(created_at_us), max(created_at_us) filter (where started_by <> 'requested')
             from diagnosis where structure_id = $1 and created_at_us < $2",
        )
        .bind(structure.as_str())
        .bind(until.micros())
        .fetch_one(&self.database.reader)
        .await?;
        let time = |at: Option<i64>| at.map(|at| timestamp("diagnosis", at)).transpose();
        Ok(LatestDiagnoses { any: time(any)?, automatic: time(automatic)? })
    }

    /// Whether a diagnosis of this version of a structure that started at `since` or later named causes.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn named_causes_since(
        self,
        structure: &StructureId,
        version: &Digest,
        since: Timestamp,
    ) -> Result<bool, Error> {
        let (found,): (bool,) = sql::query_as(
            "select exists (select 1 from diagnosis
                 where structure_id = $1 and created_at_us >= $2 and structure_digest = $3
                   and case when json_valid(result) = 1 then result ->> 'verdict' end in ('cause', 'several', 'ambiguous', 'distributed'))",
        )
        .bind(structure.as_str())
        .bind(since.micros())
        .bind(version.as_str())
        .fetch_one(&self.database.reader)
        .await?;
        Ok(found)
    }
}
