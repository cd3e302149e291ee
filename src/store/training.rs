//! Trainings of models by the service.

use serde::de::IgnoredAny;
use sqlx::FromRow;

use super::column::{bad_row, timestamp};
use super::database::Database;
use super::diagnosis::{job_state, JobState};
use super::error::Error;
use super::job_end::JobEnd;
use super::sql::{self, Whole};
use crate::quantity::{Digest, StructureId, Timestamp};

/// A training that is about to wait for its turn.
#[derive(Debug, Clone, PartialEq)]
pub struct NewTraining {
    /// Its id.
    pub id: String,
    /// The structure.
    pub structure: StructureId,
    /// Digest of the version that the model is for.
    pub structure_digest: Digest,
    /// The request, JSON.
    pub request: String,
}

/// A stored training.
#[derive(Debug, Clone, PartialEq)]
pub struct TrainingJobRecord {
    /// Its id.
    pub id: String,
    /// The structure.
    pub structure: StructureId,
    /// Digest of the version that the model is for.
    pub structure_digest: Digest,
    /// The request, JSON.
    pub request: String,
    /// Its state: `waiting` until it has ended, also while it runs.
    pub state: JobState,
    /// Unexpected ends of the program since the last orderly one.
    pub interruptions: u32,
    /// Why it failed.
    pub failure: Option<String>,
    /// The result, JSON.
    pub result: Option<String>,
    /// When it was requested.
    pub created_at: Timestamp,
    /// When it ended.
    pub finished_at: Option<Timestamp>,
}

#[derive(FromRow)]
struct TrainingRow {
    training_id: String,
    structure_id: String,
    structure_digest: String,
    request: String,
    state: String,
    interruptions: Whole<u32>,
    failure: Option<String>,
    result: Option<String>,
    created_at_us: i64,
    finished_at_us: Option<i64>,
}

const COLUMNS: &str = "training_id, structure_id, structure_digest, request, state, interruptions, failure, result, \
                       created_at_us, finished_at_us";

fn record(row: TrainingRow) -> Result<TrainingJobRecord, Error> {
    let what = "training";
    Ok(TrainingJobRecord {
        structure: StructureId::parse(&row.structure_id).map_err(|e| bad_row(what)(&e))?,
        id: row.training_id,
        structure_digest: Digest::from_stored(row.structure_digest),
        request: row.request,
        state: job_state(&row.state)?,
        interruptions: row.interruptions.0,
        failure: row.failure,
        result: row.result,
        created_at: timestamp(what, row.created_at_us)?,
        finished_at: row.finished_at_us.map(|at| timestamp(what, at)).transpose()?,
    })
}

/// Trainings.
#[derive(Clone, Copy)]
pub struct Trainings<'s> {
    pub(super) database: &'s Database,
}

impl Trainings<'_> {
    /// Stores a training that waits.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn insert(self, new: NewTraining, now: Timestamp) -> Result<(), Error> {
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    sql::query(
                        "insert into training (training_id, structure_id, structure_digest, request, state, created_at_us)
                         values ($1, $2, $3, $4, 'waiting', $5)",
                    )
                    .bind(&new.id)
                    .bind(new.structure.as_str())
                    .bind(new.structure_digest.as_str())
                    .bind(&new.request)
                    .bind(now.micros())
                    .execute(&mut *transaction)
                    .await?;
                    Ok(())
                })
            })
            .await
    }

    /// Stores the end of a training; its result is JSON.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn finish(self, id: &str, end: JobEnd<String>, now: Timestamp) -> Result<(), Error> {
        let (id, now) = (id.to_owned(), now.micros());
        // A job is ended below the minimum of free space as well.
        let takes_away = end == JobEnd::Cancelled;
        let (state, failure, result) = match end {
            JobEnd::Done(result) => ("done", None, Some(result)),
            JobEnd::Failed(failure) => ("failed", Some(failure), None),
            JobEnd::Cancelled => ("cancelled", None, None),
        };
        self.database
            .write_or_take_away(takes_away, move |transaction| {
                Box::pin(async move {
                    sql::query(
                        "update training set state = $1, failure = $2, result = $3, finished_at_us = $4
                         where training_id = $5",
                    )
                    .bind(state)
                    .bind(failure)
                    .bind(result)
                    .bind(now)
                    .bind(&id)
                    .execute(&mut *transaction)
                    .await?;
                    Ok(())
                })
            })
            .await
    }

    /// A training.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn training(self, id: &str) -> Result<Option<TrainingJobRecord>, Error> {
        let select = format!("select {COLUMNS} from training where training_id = $1");
        let row: Option<TrainingRow> =
            sql::query_as(sqlx::AssertSqlSafe(select)).bind(id).fetch_optional(&self.database.reader).await?;
        row.map(record).transpose()
    }

    /// Trainings of a structure, newest first.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn list(self, structure: &StructureId, limit: usize) -> Result<Vec<TrainingJobRecord>, Error> {
        let select =
            format!("select {COLUMNS} from training where structure_id = $1 order by training_id desc limit $2");
        let statement = sql::query_as(sqlx::AssertSqlSafe(select)).bind(structure.as_str()).bind(limit as i64);
        let whole = |row: TrainingRow| {
            for text in std::iter::once(&row.request).chain(&row.result) {
                serde_json::from_str::<IgnoredAny>(text).map_err(|e| bad_row("training")(&e))?;
            }
            record(row)
        };
        self.database.damaged.leave_out(statement, &self.database.reader, 1, whole).await
    }

    /// Trainings that have not ended, oldest first.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn unfinished(self) -> Result<Vec<TrainingJobRecord>, Error> {
        let select = format!("select {COLUMNS} from training where state = 'waiting' order by training_id");
        let statement = sql::query_as(sqlx::AssertSqlSafe(select));
        self.database.damaged.leave_out(statement, &self.database.reader, 1, record).await
    }
}
