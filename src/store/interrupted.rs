//! Jobs that had not ended when the process did.

use super::diagnosis::Diagnoses;
use super::error::Error;
use super::jobs::JobKind;
use super::sql;
use crate::quantity::Timestamp;

/// Unexpected ends of the program after which a job is not begun again: it may be their cause.
const MOST_INTERRUPTIONS: i64 = 3;

/// What became of the jobs that had not ended.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Interrupted {
    /// Number of jobs that were marked as failed.
    pub failed: u64,
    /// Ids of the diagnoses that begin again, in the order of their requests.
    pub diagnoses: Vec<String>,
    /// Extensions that begin again: id of the diagnosis, and the request as JSON.
    pub extensions: Vec<(String, String)>,
}

impl Diagnoses<'_> {
    /// Notes that a job begins to run.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn note_begun(self, id: &str, kind: JobKind) -> Result<(), Error> {
        let update = match kind {
            // A diagnosis that runs has no extension, whose number of interruptions is its own until then.
            JobKind::Diagnosis | JobKind::Extension => {
                "update diagnosis set extension_interruptions = extension_interruptions + 1 where diagnosis_id = $1"
            }
            JobKind::Training => "update training set interruptions = interruptions + 1 where training_id = $1",
        };
        let id = id.to_owned();
        self.database
            .write_without_floor(move |transaction| {
                Box::pin(async move {
                    sql::query(update).bind(&id).execute(&mut *transaction).await?;
                    Ok(())
                })
            })
            .await
    }

    /// Finds the jobs that ran or waited when an earlier process ended. They begin again, unless the program ended unexpectedly several times
    /// in a row while they were running: then they are marked as failed.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn end_interrupted_jobs(self, now: Timestamp) -> Result<Interrupted, Error> {
        const WHY: &str = "the service stopped while it was running: request it again";
        const TOO_OFTEN: &str =
            "the service ended unexpectedly several times in a row while it was running; its log may say why";
        let now = now.micros();
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    let mut failed = 0;
                    for (update, why) in [
                        (
                            "update diagnosis set state = 'failed', failure = $1, finished_at_us = $2
                             where state = 'running' and extension_interruptions >= $3",
                            TOO_OFTEN,
                        ),
                        (
                            "update diagnosis set extension_state = 'failed', extension_failure = $1, extended_at_us = $2
                             where extension_state = 'running' and extension_request is null",
                            WHY,
                        ),
                        (
                            "update diagnosis set extension_state = 'failed', extension_failure = $1, extended_at_us = $2
                             where extension_state = 'running' and extension_interruptions >= $3",
                            TOO_OFTEN,
                        ),
                        (
                            "update training set state = 'failed', failure = $1, finished_at_us = $2
                             where state = 'waiting' and interruptions >= $3",
                            TOO_OFTEN,
                        ),
                    ] {
                        let query = sql::query(update).bind(why).bind(now);
                        let query = if update.contains("$3") { query.bind(MOST_INTERRUPTIONS) } else { query };
                        failed += query.execute(&mut *transaction).await?.rows_affected();
                    }
                    let diagnoses: Vec<(String,)> = sql::query_as(
                        "select diagnosis_id from diagnosis where state = 'running' order by diagnosis_id",
                    )
                    .fetch_all(&mut *transaction)
                    .await?;
                    let diagnoses = diagnoses.into_iter().map(|(id,)| id).collect();
                    let extensions = sql::query_as(
                        "select diagnosis_id, extension_request from diagnosis
                         where extension_state = 'running' order by extension_begun_at_us",
                    )
                    .fetch_all(&mut *transaction)
                    .await?;
                    Ok(Interrupted { failed, diagnoses, extensions })
                })
            })
            .await
    }

    /// Notes that the present end of the process is an orderly one, which no job has caused.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn note_orderly_stop(self) -> Result<(), Error> {
        self.database
            .write(move |transaction| {
                Box::pin(async move {
                    for update in [
                        "update diagnosis set extension_interruptions = 0 where state = 'running' or extension_state = 'running'",
                        "update training set interruptions = 0 where state = 'waiting'",
                    ] {
                        sql::query(update).execute(&mut *transaction).await?;
                    }
                    Ok(())
                })
            })
            .await
    }
}
