//! One structure as lines of text, for another installation.
//!
//! ```text
//!  {"record":"archive", …}            what follows, and what does not
//!  {"record":"structure", …}          the present definition
//!  {"record":"version", …}            earlier versions of it
//!  {"record":"model", …}              trained baselines
//!  {"record":"batch", …}              measurements, in the order of their arrival
//!  {"record":"undamaged_state", …}
//!  {"record":"maintenance", …}
//!  {"record":"acknowledgement", …}
//!  {"record":"end", …}                count and SHA-256 of all lines before
//! ```
//!
//! Assessments, charts and alarms are not carried: they are functions of what is, and the importing installation computes
//! them again with the same seeds.

use std::collections::BTreeMap;

use base64::engine::general_purpose::STANDARD;
use base64::Engine as _;
use serde::{Deserialize, Serialize};
use sqlx::FromRow;
use tokio::sync::mpsc::Sender;

use super::{bad_row, from_blob, timestamp, Error, Store};
use crate::measurement::{CovariateValue, MeasurementBatch};
use crate::quantity::{StructureId, Timestamp};

/// Version of the archive.
pub const FORMAT: u32 = 1;

/// What an archive does not carry, in its first line.
pub const NOT_CARRIED: &str =
    "assessments, charts and alarms (computed again on import), diagnoses and their reports, silence alarms, other structures, \
     settings, tokens, webhooks";

/// Batches read at a time.
const PAGE: i64 = 200;

/// A line.
#[derive(Debug, Serialize, Deserialize)]
#[serde(tag = "record", rename_all = "snake_case", deny_unknown_fields)]
pub enum Record {
    /// The first.
    Archive(Head),
    /// A version of the definition that is not the present one, or that was made by an extension.
    Version(Version),
    /// The present definition.
    Structure(Structure),
    /// A trained baseline.
    Model(Model),
    /// A batch.
    Batch(Batch),
    /// An undamaged state.
    UndamagedState(Undamaged),
    /// A maintenance window.
    Maintenance(Maintenance),
    /// An acknowledgement of an alarm.
    Acknowledgement(Acknowledged),
    /// The last.
    End(End),
}

/// What follows.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Head {
    /// Version of the archive.
    pub format: u32,
    /// The structure.
    pub structure: StructureId,
    /// When it was written.
    pub exported_at: String,
    /// Program that wrote it.
    pub program_version: String,
    /// Settings that the answers depend on.
    pub settings: serde_json::Value,
    /// What is left out.
    pub not_carried: String,
}

/// A version of a structure.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Version {
    /// Digest of the definition.
    pub digest: String,
    /// The definition, canonical JSON as text: its digest is that of these very characters.
    pub definition: String,
    /// Version that it extends.
    pub parent_digest: Option<String>,
    /// When it was made.
    pub created_at: String,
}

/// The present definition.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Structure {
    /// Digest of the definition.
    pub digest: String,
    /// The definition, canonical JSON as text.
    pub definition: String,
    /// When it was first put.
    pub created_at: String,
}

/// A trained baseline with its files.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Model {
    /// Version of the structure it was trained for.
    pub structure_digest: String,
    /// Digest of the manifest.
    pub model_digest: String,
    /// The manifest file.
    pub manifest: String,
    /// The weight file.
    pub weights_base64: String,
    /// To be used although it failed its calibration.
    pub accepted: bool,
}

/// A batch with its measurements.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Batch {
    /// Its id.
    pub batch: String,
    /// Where it came from.
    pub source: String,
    /// The client's key.
    pub idempotency_key: Option<String>,
    /// Digest of what was measured.
    pub content_digest: String,
    /// When it arrived.
    pub received_at: String,
    /// What was measured.
    pub measurements: Vec<Measurement>,
}

/// A measurement.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Measurement {
    /// When.
    pub measured_at: String,
    /// Natural frequencies; null where a mode was not identified.
    pub frequencies_hz: Vec<Option<f64>>,
    /// Their standard deviations.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub std_hz: Option<Vec<Option<f64>>>,
    /// Their shapes.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mode_shapes: Option<Vec<Option<Vec<f64>>>>,
    /// Conditions.
    pub covariates: BTreeMap<String, CovariateValue>,
    /// Known parameters.
    pub settings: BTreeMap<String, f64>,
}

/// An undamaged state, as it was taken: its draws are part of it, so that thresholds stay what they were.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Undamaged {
    /// Its version.
    pub version: u32,
    /// Baseline it was taken with.
    pub model_digest: String,
    /// When.
    pub created_at: String,
    /// Probability that marks an exceedance.
    pub threshold_probability: f64,
    /// Measurements.
    pub measurements: i64,
    /// Covariates it saw, JSON text.
    pub conditions: String,
    /// Doubts, JSON text.
    pub doubts: String,
    /// Its batches.
    pub batches: Vec<String>,
    /// Its quantities.
    pub quantities: Vec<UndamagedQuantity>,
}

/// A quantity of an undamaged state.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, FromRow)]
#[serde(deny_unknown_fields)]
pub struct UndamagedQuantity {
    /// Its name.
    pub quantity: String,
    /// Its place in the order.
    pub position: i64,
    /// Mean.
    pub mean: f64,
    /// Standard deviation.
    pub std: f64,
    /// δ.
    pub threshold: Option<f64>,
    /// Interval and chart reference, JSON text.
    pub detail: Option<String>,
    /// Posterior draws of the mean: f64, little-endian, base64.
    #[serde(with = "blob")]
    pub mean_draws: Option<Vec<u8>>,
    /// Posterior draws of the standard deviation.
    #[serde(with = "blob")]
    pub std_draws: Option<Vec<u8>>,
}

/// A maintenance window.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Maintenance {
    /// Its beginning.
    pub from: String,
    /// Its end.
    pub to: String,
    /// Why.
    pub reason: String,
    /// When it was declared.
    pub created_at: String,
}

/// An acknowledgement, with what its alarm is known by.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Acknowledged {
    /// Kind of the alarm.
    pub kind: String,
    /// Its series.
    pub series: String,
    /// Batch that opened it.
    pub opened_batch: String,
    /// When it was acknowledged.
    pub at: String,
    /// By whom.
    pub by: String,
    /// What they said.
    pub note: Option<String>,
}

/// The end.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct End {
    /// Lines before this one.
    pub lines: u64,
    /// SHA-256 of them, line ends included.
    pub sha256: String,
}

/// Bytes as base64 text.
mod blob {
    use base64::engine::general_purpose::STANDARD;
    use base64::Engine as _;
    use serde::{Deserialize as _, Deserializer, Serialize as _, Serializer};

    #[allow(clippy::ref_option, reason = "the shape that serde takes")]
    pub fn serialize<S: Serializer>(bytes: &Option<Vec<u8>>, serializer: S) -> Result<S::Ok, S::Error> {
        bytes.as_ref().map(|bytes| STANDARD.encode(bytes)).serialize(serializer)
    }

    pub fn deserialize<'d, D: Deserializer<'d>>(deserializer: D) -> Result<Option<Vec<u8>>, D::Error> {
        let text = Option::<String>::deserialize(deserializer)?;
        text.map(|text| STANDARD.decode(text).map_err(serde::de::Error::custom)).transpose()
    }
}

impl Model {
    /// A baseline by its files.
    pub fn new(structure_digest: &str, model_digest: &str, manifest: &[u8], weights: &[u8], accepted: bool) -> Self {
        Self {
            structure_digest: structure_digest.to_owned(),
            model_digest: model_digest.to_owned(),
            manifest: String::from_utf8_lossy(manifest).into_owned(),
            weights_base64: STANDARD.encode(weights),
            accepted,
        }
    }

    /// The weight file.
    ///
    /// # Errors
    /// What is wrong with the text.
    pub fn weights(&self) -> Result<Vec<u8>, String> {
        STANDARD.decode(&self.weights_base64).map_err(|e| e.to_string())
    }
}

#[derive(FromRow)]
struct MeasurementRow {
    batch_id: String,
    measured_at_us: i64,
    frequency_hz: Vec<u8>,
    std_hz: Option<Vec<u8>>,
    mode_shapes: Option<String>,
    covariates: String,
    settings: String,
}

/// A batch's row: id, source, key, digest, arrival in µs.
type BatchRow = (String, String, Option<String>, String, i64);

/// An undamaged state's row: version, model, created in µs, probability, measurements, conditions, doubts.
type StateRow = (u32, String, i64, f64, i64, String, String);

/// The receiver of an export is gone.
fn gone<T>(_: T) -> Error {
    Error::Row { what: "archive", detail: "nobody reads it any more".to_owned() }
}

/// Digests of version and baseline, manifest, weights, and whether it is used although it failed its calibration.
type ModelRow = (String, String, Vec<u8>, Vec<u8>, bool);

impl Store {
    /// Sends what the archive of a structure holds between its first and its last line, in order; the models are given.
    ///
    /// # Errors
    /// [`Error::UnknownStructure`], [`Error::Sqlite`], [`Error::Row`] when nobody reads it any more.
    pub async fn export(
        &self,
        structure: &StructureId,
        models: Vec<Model>,
        records: &Sender<Record>,
    ) -> Result<(), Error> {
        let present = self.structure(structure).await?;
        let present = present.ok_or_else(|| Error::UnknownStructure(structure.to_string()))?;
        let versions: Vec<(String, String, Option<String>, i64)> = sqlx::query_as(
            "select digest, definition, parent_digest, created_at_us from structure_version where structure_id = ?
             order by created_at_us, digest",
        )
        .bind(structure.as_str())
        .fetch_all(&self.reader)
        .await?;
        let present = Structure {
            digest: present.digest.to_string(),
            definition: present.definition_json,
            created_at: present.created_at.to_string(),
        };
        records.send(Record::Structure(present)).await.map_err(gone)?;
        for (digest, definition, parent_digest, created) in versions {
            let created_at = timestamp("version", created)?.to_string();
            let version = Version { digest, definition, parent_digest, created_at };
            records.send(Record::Version(version)).await.map_err(gone)?;
        }
        for model in models {
            records.send(Record::Model(model)).await.map_err(gone)?;
        }
        self.export_batches(structure, records).await?;
        self.export_states(structure, records).await?;
        self.export_notes(structure, records).await
    }

    async fn export_batches(&self, structure: &StructureId, records: &Sender<Record>) -> Result<(), Error> {
        let (mut received, mut last) = (i64::MIN, String::new());
        loop {
            let rows: Vec<BatchRow> = sqlx::query_as(
                "select batch_id, source, idempotency_key, content_digest, received_at_us from measurement_batch
                 where structure_id = ? and (received_at_us, batch_id) > (?, ?) order by received_at_us, batch_id limit ?",
            )
            .bind(structure.as_str())
            .bind(received)
            .bind(&last)
            .bind(PAGE)
            .fetch_all(&self.reader)
            .await?;
            let Some(end) = rows.last() else { return Ok(()) };
            (received, last) = (end.4, end.0.clone());
            let ids: Vec<&String> = rows.iter().map(|row| &row.0).collect();
            let ids = serde_json::to_string(&ids).map_err(|e| bad_row("batch")(&e))?;
            let measured: Vec<MeasurementRow> = sqlx::query_as(
                "select batch_id, measured_at_us, frequency_hz, std_hz, mode_shapes, covariates, settings
                 from measurement
                 where structure_id = ? and batch_id in (select value from json_each(?)) order by batch_id, ordinal",
            )
            .bind(structure.as_str())
            .bind(ids)
            .fetch_all(&self.reader)
            .await?;
            let mut by_batch = BTreeMap::<String, Vec<Measurement>>::new();
            for row in measured {
                by_batch.entry(row.batch_id.clone()).or_default().push(measurement(row)?);
            }
            for (batch, source, idempotency_key, content_digest, received) in rows {
                let measurements = by_batch.remove(&batch).unwrap_or_default();
                let received_at = timestamp("batch", received)?.to_string();
                let record = Batch { batch, source, idempotency_key, content_digest, received_at, measurements };
                records.send(Record::Batch(record)).await.map_err(gone)?;
            }
        }
    }

    async fn export_states(&self, structure: &StructureId, records: &Sender<Record>) -> Result<(), Error> {
        let rows: Vec<StateRow> = sqlx::query_as(
            "select version, model_digest, created_at_us, threshold_probability, measurement_count, conditions, doubts
             from undamaged_state where structure_id = ? order by version",
        )
        .bind(structure.as_str())
        .fetch_all(&self.reader)
        .await?;
        for (version, model_digest, created, threshold_probability, measurements, conditions, doubts) in rows {
            let batches: Vec<(String,)> = sqlx::query_as(
                "select batch_id from undamaged_batch where structure_id = ? and version = ? order by batch_id",
            )
            .bind(structure.as_str())
            .bind(version)
            .fetch_all(&self.reader)
            .await?;
            let quantities: Vec<UndamagedQuantity> = sqlx::query_as(
                "select quantity, position, mean, std, threshold, detail, mean_draws, std_draws
                 from undamaged_quantity where structure_id = ? and version = ? order by position",
            )
            .bind(structure.as_str())
            .bind(version)
            .fetch_all(&self.reader)
            .await?;
            let state = Undamaged {
                version,
                model_digest,
                created_at: timestamp("undamaged state", created)?.to_string(),
                threshold_probability,
                measurements,
                conditions,
                doubts,
                batches: batches.into_iter().map(|(id,)| id).collect(),
                quantities,
            };
            records.send(Record::UndamagedState(state)).await.map_err(gone)?;
        }
        Ok(())
    }

    async fn export_notes(&self, structure: &StructureId, records: &Sender<Record>) -> Result<(), Error> {
        let windows: Vec<(i64, i64, String, i64)> = sqlx::query_as(
            "select from_us, to_us, reason, created_at_us from maintenance_window where structure_id = ? order by from_us, to_us",
        )
        .bind(structure.as_str())
        .fetch_all(&self.reader)
        .await?;
        let time = |micros| timestamp("maintenance window", micros).map(|t| t.to_string());
        for (from, to, reason, created) in windows {
            let window = Maintenance { from: time(from)?, to: time(to)?, reason, created_at: time(created)? };
            records.send(Record::Maintenance(window)).await.map_err(gone)?;
        }
        let seen: Vec<(String, String, String, i64, String, Option<String>)> = sqlx::query_as(
            "select kind, series, opened_batch, acknowledged_at_us, acknowledged_by, acknowledgement_note
             from alarm_episode where structure_id = ? and acknowledged_at_us is not null and acknowledged_by is not null
               and opened_batch is not null and withdrawn = 0 order by episode",
        )
        .bind(structure.as_str())
        .fetch_all(&self.reader)
        .await?;
        for (kind, series, opened_batch, at, by, note) in seen {
            let at = timestamp("acknowledgement", at)?.to_string();
            let record = Acknowledged { kind, series, opened_batch, at, by, note };
            records.send(Record::Acknowledgement(record)).await.map_err(gone)?;
        }
        Ok(())
    }

    /// The baselines that the service trained for the versions of a structure.
    ///
    /// # Errors
    /// [`Error::Sqlite`].
    pub async fn trained_models(&self, structure: &StructureId) -> Result<Vec<Model>, Error> {
        let rows: Vec<ModelRow> = sqlx::query_as(
            "select structure_digest, model_digest, manifest, weights, accepted from trained_baseline
             where structure_id = ? order by created_at_us, structure_digest",
        )
        .bind(structure.as_str())
        .fetch_all(&self.reader)
        .await?;
        let model = |(version, digest, manifest, weights, accepted): ModelRow| {
            Model::new(&version, &digest, &manifest, &weights, accepted)
        };
        Ok(rows.into_iter().map(model).collect())
    }

    /// Stores batches of an archive under their own ids, in one transaction; those that are there already are passed over.
    /// How many were new.
    ///
    /// # Errors
    /// [`Error::Row`] naming the batch when its id or one of its measurements is taken by other content.
    pub async fn import_batches(&self, batches: Vec<(String, MeasurementBatch, Timestamp)>) -> Result<u64, Error> {
        self.write(move |connection| {
            Box::pin(async move {
                let mut stored = 0;
                for (id, batch, received_at) in batches {
                    stored += u64::from(super::batch::import(connection, &id, &batch, received_at).await?);
                }
                Ok(stored)
            })
        })
        .await
    }

    /// Stores a version of a structure and, with it, a trained baseline, unless they are there. Whether something was new.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`] for a time that is none.
    pub async fn import_version(&self, structure: &StructureId, version: Version) -> Result<bool, Error> {
        let structure = structure.to_string();
        let created = Timestamp::parse(&version.created_at).map_err(|e| bad_row("version of the archive")(&e))?;
        self.write(move |connection| {
            Box::pin(async move {
                let inserted = sqlx::query("insert or ignore into structure_version values (?, ?, ?, ?, null, ?)")
                    .bind(&structure)
                    .bind(&version.digest)
                    .bind(&version.definition)
                    .bind(&version.parent_digest)
                    .bind(created.micros())
                    .execute(&mut *connection)
                    .await?;
                Ok(inserted.rows_affected() > 0)
            })
        })
        .await
    }

    /// Stores a trained baseline, unless there is one for that version. Whether it was new.
    ///
    /// # Errors
    /// [`Error::Sqlite`], [`Error::Row`] for weights that are none.
    pub async fn import_model(&self, structure: &StructureId, model: Model) -> Result<bool, Error> {
        let structure = structure.to_string();
        let weights = model.weights().map_err(|e| bad_row("model of the archive")(&e))?;
        let now = Timestamp::now().micros();
        self.write(move |connection| {
            Box::pin(async move {
                let inserted = sqlx::query("insert or ignore into trained_baseline values (?, ?, ?, ?, ?, ?, ?)")
                    .bind(&structure)
                    .bind(&model.structure_digest)
                    .bind(&model.model_digest)
                    .bind(model.manifest.into_bytes())
                    .bind(weights)
                    .bind(model.accepted)
                    .bind(now)
                    .execute(&mut *connection)
                    .await?;
                Ok(inserted.rows_affected() > 0)
            })
        })
        .await
    }

    /// Stores an undamaged state under its own version, unless it is there; with a new one, all batches outside it go back to
    /// be assessed. Whether it was new.
    ///
    /// # Errors
    /// [`Error::Row`] when that version is another state here.
    pub async fn import_undamaged(&self, structure: &StructureId, state: Undamaged) -> Result<bool, Error> {
        let structure = structure.to_string();
        let wrong = |detail: &dyn std::fmt::Display| bad_row("undamaged state of the archive")(detail);
        let created = Timestamp::parse(&state.created_at).map_err(|e| wrong(&e))?;
        for quantity in &state.quantities {
            for draws in [&quantity.mean_draws, &quantity.std_draws].into_iter().flatten() {
                from_blob("undamaged quantity of the archive", draws)?;
            }
        }
        self.write(move |connection| {
            Box::pin(async move {
                let known: Option<(String, i64)> = sqlx::query_as(
                    "select model_digest, created_at_us from undamaged_state where structure_id = ? and version = ?",
                )
                .bind(&structure)
                .bind(state.version)
                .fetch_optional(&mut *connection)
                .await?;
                if let Some((model_digest, created_here)) = known {
                    if model_digest == state.model_digest && created_here == created.micros() {
                        return Ok(false);
                    }
                    let detail = format!("{structure} has another undamaged state {} here", state.version);
                    return Err(bad_row("undamaged state of the archive")(&detail));
                }
                insert_undamaged(connection, &structure, &state, created).await?;
                sqlx::query(
                    "update measurement_batch set state = 'received' where structure_id = ?1 and state = 'assessed'
                       and batch_id not in (select batch_id from undamaged_batch where structure_id = ?1 and version = ?2)",
                )
                .bind(&structure)
                .bind(state.version)
                .execute(&mut *connection)
                .await?;
                Ok(true)
            })
        })
        .await
    }

    /// Stores a maintenance window, unless it is there. Whether it was new.
    ///
    /// # Errors
    /// [`Error::Row`] for a time that is none.
    pub async fn import_maintenance(&self, structure: &StructureId, window: Maintenance) -> Result<bool, Error> {
        let time = |text: &str| Timestamp::parse(text).map_err(|e| bad_row("maintenance window of the archive")(&e));
        let (from, to, created) = (time(&window.from)?, time(&window.to)?, time(&window.created_at)?);
        let structure = structure.to_string();
        self.write(move |connection| {
            Box::pin(async move {
                let inserted = sqlx::query("insert or ignore into maintenance_window values (?, ?, ?, ?, ?)")
                    .bind(&structure)
                    .bind(from.micros())
                    .bind(to.micros())
                    .bind(&window.reason)
                    .bind(created.micros())
                    .execute(&mut *connection)
                    .await?;
                Ok(inserted.rows_affected() > 0)
            })
        })
        .await
    }

    /// Notes an acknowledgement with the alarm that it belongs to. Whether something changed: not when nobody raised that
    /// alarm here, or when it is acknowledged.
    ///
    /// # Errors
    /// [`Error::Row`] for a time that is none.
    pub async fn import_acknowledgement(&self, structure: &StructureId, note: Acknowledged) -> Result<bool, Error> {
        let at = Timestamp::parse(&note.at).map_err(|e| bad_row("acknowledgement of the archive")(&e))?;
        let structure = structure.to_string();
        self.write(move |connection| {
            Box::pin(async move {
                let updated = sqlx::query(
                    "update alarm_episode set acknowledged_at_us = ?, acknowledged_by = ?, acknowledgement_note = ?
                     where structure_id = ? and kind = ? and series = ? and opened_batch = ? and withdrawn = 0
                       and acknowledged_at_us is null",
                )
                .bind(at.micros())
                .bind(&note.by)
                .bind(&note.note)
                .bind(&structure)
                .bind(&note.kind)
                .bind(&note.series)
                .bind(&note.opened_batch)
                .execute(&mut *connection)
                .await?;
                Ok(updated.rows_affected() > 0)
            })
        })
        .await
    }
}

async fn insert_undamaged(
    connection: &mut sqlx::SqliteConnection,
    structure: &str,
    state: &Undamaged,
    created: Timestamp,
) -> Result<(), Error> {
    sqlx::query("insert into undamaged_state values (?, ?, ?, ?, ?, ?, ?, ?)")
        .bind(structure)
        .bind(state.version)
        .bind(&state.model_digest)
        .bind(created.micros())
        .bind(state.threshold_probability)
        .bind(state.measurements)
        .bind(&state.conditions)
        .bind(&state.doubts)
        .execute(&mut *connection)
        .await?;
    for batch in &state.batches {
        sqlx::query("insert into undamaged_batch values (?, ?, ?)")
            .bind(structure)
            .bind(state.version)
            .bind(batch)
            .execute(&mut *connection)
            .await?;
    }
    for q in &state.quantities {
        sqlx::query("insert into undamaged_quantity values (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)")
            .bind(structure)
            .bind(state.version)
            .bind(&q.quantity)
            .bind(q.position)
            .bind(q.mean)
            .bind(q.std)
            .bind(q.threshold)
            .bind(&q.detail)
            .bind(&q.mean_draws)
            .bind(&q.std_draws)
            .execute(&mut *connection)
            .await?;
    }
    Ok(())
}

fn measurement(row: MeasurementRow) -> Result<Measurement, Error> {
    let what = "measurement";
    let present = |values: Vec<f64>| values.into_iter().map(|v| Some(v).filter(|v| !v.is_nan())).collect();
    Ok(Measurement {
        measured_at: timestamp(what, row.measured_at_us)?.to_string(),
        frequencies_hz: present(from_blob(what, &row.frequency_hz)?),
        std_hz: row.std_hz.map(|blob| from_blob(what, &blob)).transpose()?.map(present),
        mode_shapes: super::batch::mode_shapes(row.mode_shapes.as_deref())?,
        covariates: serde_json::from_str(&row.covariates).map_err(|e| bad_row(what)(&e))?,
        settings: serde_json::from_str(&row.settings).map_err(|e| bad_row(what)(&e))?,
    })
}
