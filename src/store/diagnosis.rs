//! Diagnoses, versions of structures, and baselines that the service trained.

use sqlx::FromRow;

use super::structure::is_present;
use super::{bad_row, timestamp, Error, Store};
use crate::measurement::ModalMeasurement;
use crate::quantity::{Digest, StructureId, Timestamp};

/// State of a job.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum JobState {
    /// It runs.
    Running,
    /// It ended with a result.
    Done,
    /// It ended without one.
    Failed,
}

/// A stored diagnosis.
#[derive(Debug, Clone, PartialEq)]
pub struct DiagnosisRecord {
    /// Its id.
    pub id: String,
    /// The structure.
    pub structure: StructureId,
    /// Version that was diagnosed.
    pub structure_digest: Digest,
    /// What was asked, JSON.
    pub request: String,
    /// Where it is.
    pub state: JobState,
    /// Why it failed.
    pub failure: Option<String>,
    /// The result, JSON.
    pub result: Option<String>,
    /// When it was asked for.
    pub created_at: Timestamp,
    /// When it ended.
    pub finished_at: Option<Timestamp>,
    /// Where its extension is.
    pub extension_state: Option<JobState>,
    /// Why its extension failed.
    pub extension_failure: Option<String>,
    /// What the extension did, JSON.
    pub extension: Option<String>,
}

/// A version of a structure with the baseline trained for it.
#[derive(Debug, Clone, PartialEq)]
pub struct NewVersion {
    /// Digest of the definition.
    pub digest: Digest,
    /// Canonical JSON.
    pub definition_json: String,
    /// Version that it extends.
    pub parent: Option<Digest>,
    /// Diagnosis that made it.
    pub diagnosis: Option<String>,
    /// A baseline that is not in the library.
    pub baseline: Option<StoredBaseline>,
}

/// A baseline that the service trained.
#[derive(Debug, Clone, PartialEq, FromRow)]
pub struct StoredBaseline {
    /// Digest of the manifest.
    pub model_digest: String,
    /// The manifest file.
    pub manifest: Vec<u8>,
    /// The weight file.
    pub weights: Vec<u8>,
    /// To be used although it failed its calibration.
    pub accepted: bool,
}

#[derive(FromRow)]
struct Row {
    diagnosis_id: String,
    structure_id: String,
    structure_digest: String,
    request: String,
    state: String,
    failure: Option<String>,
    result: Option<String>,
    created_at_us: i64,
    finished_at_us: Option<i64>,
    extension_state: Option<String>,
    extension_failure: Option<String>,
    extension: Option<String>,
}

const COLUMNS: &str = "diagnosis_id, structure_id, structure_digest, request, state, failure, result, created_at_us, \
                       finished_at_us, extension_state, extension_failure, extension";

pub(super) fn job_state(text: &str) -> Result<JobState, Error> {
    match text {
        "running" => Ok(JobState::Running),
        "done" => Ok(JobState::Done),
        "failed" => Ok(JobState::Failed),
        other => Err(Error::Row { what: "diagnosis", detail: format!("state {other:?}") }),
    }
}

fn record(row: Row) -> Result<DiagnosisRecord, Error> {
    Ok(DiagnosisRecord {
        structure: StructureId::parse(&row.structure_id).map_err(|e| bad_row("diagnosis")(&e))?,
        id: row.diagnosis_id,
        structure_digest: Digest::from_stored(row.structure_digest),
        request: row.request,
        state: job_state(&row.state)?,
        failure: row.failure,
        result: row.result,
        created_at: timestamp("diagnosis", row.created_at_us)?,
        finished_at: row.finished_at_us.map(|t| timestamp("diagnosis", t)).transpose()?,
        extension_state: row.extension_state.as_deref().map(job_state).transpose()?,
        extension_failure: row.extension_failure,
        extension: row.extension,
    })
}

impl Store {
    /// Stores a diagnosis that begins.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn insert_diagnosis(
        &self,
        id: &str,
        structure: &StructureId,
        structure_digest: &Digest,
        request: &str,
        now: Timestamp,
    ) -> Result<(), Error> {
        let (id, structure, digest) = (id.to_owned(), structure.to_string(), structure_digest.to_string());
        let (request, now) = (request.to_owned(), now.micros());
        self.write(move |connection| {
            Box::pin(async move {
                sqlx::query(
                    "insert into diagnosis (diagnosis_id, structure_id, structure_digest, request, state, created_at_us)
                     values (?, ?, ?, ?, 'running', ?)",
                )
                .bind(&id)
                .bind(&structure)
                .bind(&digest)
                .bind(&request)
                .bind(now)
                .execute(&mut *connection)
                .await?;
                Ok(())
            })
        })
        .await
    }

    /// Stores the end of a diagnosis: result and report, or why there are none.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn finish_diagnosis(
        &self,
        id: &str,
        outcome: Result<(String, Option<String>), String>,
        now: Timestamp,
    ) -> Result<(), Error> {
        let (id, now) = (id.to_owned(), now.micros());
        let (state, failure, result, report) = match outcome {
            Ok((result, report)) => ("done", None, Some(result), report),
            Err(failure) => ("failed", Some(failure), None, None),
        };
        self.write(move |connection| {
            Box::pin(async move {
                sqlx::query(
                    "update diagnosis set state = ?, failure = ?, result = ?, report = ?, finished_at_us = ?
                     where diagnosis_id = ?",
                )
                .bind(state)
                .bind(failure)
                .bind(result)
                .bind(report)
                .bind(now)
                .bind(&id)
                .execute(&mut *connection)
                .await?;
                Ok(())
            })
        })
        .await
    }

    /// Marks the extension of a diagnosis as begun, unless one runs; whether it was marked.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn begin_extension(&self, id: &str, now: Timestamp) -> Result<bool, Error> {
        let (id, now) = (id.to_owned(), now.micros());
        self.write(move |connection| {
            Box::pin(async move {
                let updated = sqlx::query(
                    "update diagnosis set extension_state = 'running', extension_failure = null,
                         extension_begun_at_us = ?, extended_at_us = null
                     where diagnosis_id = ? and state = 'done'
                       and (extension_state is null or extension_state <> 'running')",
                )
                .bind(now)
                .bind(&id)
                .execute(&mut *connection)
                .await?;
                Ok(updated.rows_affected() == 1)
            })
        })
        .await
    }

    /// Stores the end of an extension.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn finish_extension(
        &self,
        id: &str,
        outcome: Result<String, String>,
        now: Timestamp,
    ) -> Result<(), Error> {
        let (id, now) = (id.to_owned(), now.micros());
        let (state, failure, extension) = match outcome {
            Ok(extension) => ("done", None, Some(extension)),
            Err(failure) => ("failed", Some(failure), None),
        };
        self.write(move |connection| {
            Box::pin(async move {
                sqlx::query(
                    "update diagnosis set extension_state = ?, extension_failure = ?, extension = ?, extended_at_us = ?
                     where diagnosis_id = ?",
                )
                .bind(state)
                .bind(failure)
                .bind(extension)
                .bind(now)
                .bind(&id)
                .execute(&mut *connection)
                .await?;
                Ok(())
            })
        })
        .await
    }

    /// Marks jobs that a stopped process left as failed; how many there were.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn end_interrupted_jobs(&self, now: Timestamp) -> Result<u64, Error> {
        const WHY: &str = "the service stopped while it ran: ask for it again";
        let now = now.micros();
        self.write(move |connection| {
            Box::pin(async move {
                let diagnoses = sqlx::query(
                    "update diagnosis set state = 'failed', failure = ?, finished_at_us = ? where state = 'running'",
                )
                .bind(WHY)
                .bind(now)
                .execute(&mut *connection)
                .await?;
                let extensions = sqlx::query(
                    "update diagnosis set extension_state = 'failed', extension_failure = ?, extended_at_us = ?
                     where extension_state = 'running'",
                )
                .bind(WHY)
                .bind(now)
                .execute(&mut *connection)
                .await?;
                Ok(diagnoses.rows_affected() + extensions.rows_affected())
            })
        })
        .await
    }

    /// A diagnosis.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn diagnosis(&self, id: &str) -> Result<Option<DiagnosisRecord>, Error> {
        let select = format!("select {COLUMNS} from diagnosis where diagnosis_id = ?");
        let row: Option<Row> =
            sqlx::query_as(sqlx::AssertSqlSafe(select)).bind(id).fetch_optional(&self.reader).await?;
        row.map(record).transpose()
    }

    /// Diagnoses of a structure, the newest first.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`].
    pub async fn diagnoses(&self, structure: &StructureId, limit: usize) -> Result<Vec<DiagnosisRecord>, Error> {
        let select =
            format!("select {COLUMNS} from diagnosis where structure_id = ? order by diagnosis_id desc limit ?");
        let rows: Vec<Row> = sqlx::query_as(sqlx::AssertSqlSafe(select))
            .bind(structure.as_str())
            .bind(limit as i64)
            .fetch_all(&self.reader)
            .await?;
        rows.into_iter().map(record).collect()
    }

    /// The structure that a diagnosis is about.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn structure_of_diagnosis(&self, id: &str) -> Result<Option<String>, Error> {
        let row: Option<(String,)> = sqlx::query_as("select structure_id from diagnosis where diagnosis_id = ?")
            .bind(id)
            .fetch_optional(&self.reader)
            .await?;
        Ok(row.map(|(structure,)| structure))
    }

    /// The report of a diagnosis, HTML.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn diagnosis_report(&self, id: &str) -> Result<Option<String>, Error> {
        let row: Option<(Option<String>,)> = sqlx::query_as("select report from diagnosis where diagnosis_id = ?")
            .bind(id)
            .fetch_optional(&self.reader)
            .await?;
        Ok(row.and_then(|row| row.0))
    }

    /// All batches of a structure with their numbers of measurements, in the order of their time.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn batch_sizes(&self, structure: &StructureId) -> Result<Vec<(String, usize)>, Error> {
        let rows: Vec<(String, i64)> = sqlx::query_as(
            "select batch_id, measurement_count from measurement_batch where structure_id = ?
             order by measured_from_us, batch_id",
        )
        .bind(structure.as_str())
        .fetch_all(&self.reader)
        .await?;
        Ok(rows.into_iter().map(|(id, count)| (id, count.unsigned_abs() as usize)).collect())
    }

    /// Measurements of several batches.
    ///
    /// # Errors
    /// [`Error::UnknownBatch`], [`Error::Sqlite`], [`Error::Row`].
    pub async fn measurements_of(
        &self,
        structure: &StructureId,
        batches: &[String],
    ) -> Result<Vec<ModalMeasurement>, Error> {
        let mut all = Vec::new();
        for id in batches {
            let unknown = || Error::UnknownBatch { structure: structure.to_string(), batch: id.clone() };
            all.extend(self.batch(structure, id).await?.ok_or_else(unknown)?.batch.measurements);
        }
        Ok(all)
    }

    /// Puts another version of a structure in the place of the version `expected`, which is kept; with it the baseline trained
    /// for it. All batches go back to be assessed under it; what they were assessed as before stays beside it. Nothing is done
    /// where `expected` is not the present version; whether it was.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn switch_version(
        &self,
        structure: &StructureId,
        expected: &Digest,
        version: NewVersion,
        now: Timestamp,
    ) -> Result<bool, Error> {
        let (structure, expected, now) = (structure.to_string(), expected.clone(), now.micros());
        self.write(move |connection| {
            Box::pin(async move {
                if !is_present(connection, &structure, &expected).await? {
                    return Ok(false);
                }
                sqlx::query(
                    "insert or ignore into structure_version
                     select structure_id, digest, definition, null, null, created_at_us from structure
                     where structure_id = ?",
                )
                .bind(&structure)
                .execute(&mut *connection)
                .await?;
                sqlx::query("insert or ignore into structure_version values (?, ?, ?, ?, ?, ?)")
                    .bind(&structure)
                    .bind(version.digest.as_str())
                    .bind(&version.definition_json)
                    .bind(version.parent.as_ref().map(Digest::as_str))
                    .bind(&version.diagnosis)
                    .bind(now)
                    .execute(&mut *connection)
                    .await?;
                if let Some(baseline) = &version.baseline {
                    sqlx::query("insert or replace into trained_baseline values (?, ?, ?, ?, ?, ?, ?)")
                        .bind(&structure)
                        .bind(version.digest.as_str())
                        .bind(&baseline.model_digest)
                        .bind(&baseline.manifest)
                        .bind(&baseline.weights)
                        .bind(baseline.accepted)
                        .bind(now)
                        .execute(&mut *connection)
                        .await?;
                }
                sqlx::query(
                    "update structure set definition = ?, digest = ?, updated_at_us = ? where structure_id = ?",
                )
                .bind(&version.definition_json)
                .bind(version.digest.as_str())
                .bind(now)
                .bind(&structure)
                .execute(&mut *connection)
                .await?;
                sqlx::query("update measurement_batch set state = 'received', failure = null where structure_id = ?")
                    .bind(&structure)
                    .execute(&mut *connection)
                    .await?;
                Ok(true)
            })
        })
        .await
    }

    /// A version of a structure: its definition and the version that it extends.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn structure_version(
        &self,
        structure: &StructureId,
        digest: &Digest,
    ) -> Result<Option<(String, Option<Digest>)>, Error> {
        let row: Option<(String, Option<String>)> = sqlx::query_as(
            "select definition, parent_digest from structure_version where structure_id = ? and digest = ?",
        )
        .bind(structure.as_str())
        .bind(digest.as_str())
        .fetch_optional(&self.reader)
        .await?;
        Ok(row.map(|(definition, parent)| (definition, parent.map(Digest::from_stored))))
    }

    /// The baseline that the service trained for a version.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn trained_baseline(
        &self,
        structure: &StructureId,
        structure_digest: &Digest,
    ) -> Result<Option<StoredBaseline>, Error> {
        Ok(sqlx::query_as(
            "select model_digest, manifest, weights, accepted from trained_baseline
             where structure_id = ? and structure_digest = ?",
        )
        .bind(structure.as_str())
        .bind(structure_digest.as_str())
        .fetch_optional(&self.reader)
        .await?)
    }
}
