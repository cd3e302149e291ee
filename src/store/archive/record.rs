//! The lines of an archive.

use std::collections::BTreeMap;

use base64::engine::general_purpose::STANDARD;
use base64::Engine as _;
use serde::{Deserialize, Serialize};
use sqlx::FromRow;

use crate::measurement::CovariateValue;
use crate::quantity::StructureId;

/// Version of the format. Version 2 added actions on alarms and notes, version 3 the undamaged references that each batch is compared with,
/// version 4 the tokens with which batches were posted; all earlier versions are read as well.
pub const FORMAT: u32 = 4;

/// What an archive does not contain, as its first line says.
pub const NOT_CARRIED: &str =
    "assessments, charts and alarms (computed again on import), diagnoses and their reports, silence alarms, other structures, \
     settings, tokens, webhooks";

/// A line of an archive.
#[derive(Debug, Serialize, Deserialize)]
#[serde(tag = "record", rename_all = "snake_case", deny_unknown_fields)]
pub enum Record {
    /// The first line.
    Archive(Head),
    /// A version of the structure that is not the present one, or that was made by an extension.
    Version(Version),
    /// The present definition.
    Structure(Structure),
    /// A trained baseline.
    Model(ArchivedModel),
    /// A batch.
    Batch(Batch),
    /// An undamaged reference.
    UndamagedReference(Undamaged),
    /// A maintenance window.
    Maintenance(Maintenance),
    /// An acknowledgement of an alarm.
    Acknowledgement(Acknowledged),
    /// An action of a person on an alarm.
    AlarmAction(ArchivedAction),
    /// A note on the time line.
    Note(ArchivedNote),
    /// The last line.
    End(End),
}

/// What an archive contains.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Head {
    /// Version of the format.
    pub format: u32,
    /// The structure.
    pub structure: StructureId,
    /// When it was written.
    pub exported_at: String,
    /// Version of the program that wrote it.
    pub program_version: String,
    /// Settings that the results depend on.
    pub settings: serde_json::Value,
    /// What is left out, as [`NOT_CARRIED`].
    pub not_carried: String,
}

/// A version of a structure.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Version {
    /// Digest of the definition.
    pub digest: String,
    /// The definition as canonical JSON text, of which the digest was computed.
    pub definition: String,
    /// The version that it extends.
    pub parent_digest: Option<String>,
    /// When it was created.
    pub created_at: String,
}

/// The present definition.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Structure {
    /// Digest of the definition.
    pub digest: String,
    /// The definition as canonical JSON text, of which the digest was computed.
    pub definition: String,
    /// When the structure was created.
    pub created_at: String,
}

/// A trained baseline with its files.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ArchivedModel {
    /// Digest of the version of the structure that it was trained for.
    pub structure_digest: String,
    /// Digest of the manifest.
    pub model_digest: String,
    /// The manifest file.
    pub manifest: String,
    /// The weight file.
    pub weights_base64: String,
    /// True if it is used although it failed its calibration check.
    pub accepted: bool,
}

/// A batch with its measurements.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Batch {
    /// Its id.
    pub batch: String,
    /// Its source.
    pub source: String,
    /// The idempotency key of the client.
    pub idempotency_key: Option<String>,
    /// Id of the token with which it was posted. Absent for a batch that was posted without one, or in archives of versions that did not
    /// state it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub posted_by: Option<String>,
    /// Digest of its content.
    pub content_digest: String,
    /// When it arrived.
    pub received_at: String,
    /// Versions of the undamaged references that it was compared with, in this order, 0 for none; the last is the present one. Absent for a
    /// batch that waits, that failed, or in archives of versions that did not state it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub compared_with: Option<Vec<u32>>,
    /// Its measurements.
    pub measurements: Vec<Measurement>,
}

/// A measurement.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Measurement {
    /// Time of the measurement.
    pub measured_at: String,
    /// Natural frequencies, Hz; null for a mode that was not identified.
    pub frequencies_hz: Vec<Option<f64>>,
    /// Their standard deviations, Hz.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub std_hz: Option<Vec<Option<f64>>>,
    /// Mode shapes, `[modes][sensors]`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub mode_shapes: Option<Vec<Option<Vec<f64>>>>,
    /// Covariates.
    pub covariates: BTreeMap<String, CovariateValue>,
    /// Known parameters.
    pub settings: BTreeMap<String, f64>,
}

/// An undamaged reference with its posterior draws, so that its thresholds do not change.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Undamaged {
    /// Its version.
    pub version: u32,
    /// Digest of the trained baseline it was computed with.
    pub model_digest: String,
    /// When it was stored.
    pub created_at: String,
    /// Probability of damage above which a batch exceeds the reference.
    pub threshold_probability: f64,
    /// Number of measurements.
    pub measurements: i64,
    /// Ranges of the covariates of its measurements, JSON text.
    pub conditions: String,
    /// Reasons to doubt it, a JSON list of sentences.
    pub doubts: String,
    /// Joint probability of damage of the undamaged population and its correlations, JSON text; absent in archives of versions that
    /// did not estimate them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub joint: Option<String>,
    /// The process of its parameters in time, JSON text; absent without one and in archives of versions without it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub process: Option<String>,
    /// Why there is no process.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub without_process: Option<String>,
    /// Where it comes from, JSON.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub origin: Option<String>,
    /// Its batches.
    pub batches: Vec<String>,
    /// Its quantities.
    pub quantities: Vec<UndamagedQuantity>,
}

/// A quantity of an undamaged reference.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, FromRow)]
#[serde(deny_unknown_fields)]
pub struct UndamagedQuantity {
    /// Its name.
    pub quantity: String,
    /// Its position in the order of the quantities.
    pub position: i64,
    /// Mean.
    pub mean: f64,
    /// Standard deviation.
    pub std: f64,
    /// Threshold δ in the unit of the quantity.
    pub threshold: Option<f64>,
    /// Interval of the threshold and reference of the alarm chart, JSON text.
    pub detail: Option<String>,
    /// Posterior draws of the mean: f64, little-endian, base64.
    #[serde(with = "blob")]
    pub mean_draws: Option<Vec<u8>>,
    /// Posterior draws of the standard deviation, in the same encoding.
    #[serde(with = "blob")]
    pub std_draws: Option<Vec<u8>>,
}

/// A maintenance window.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Maintenance {
    /// Beginning.
    pub from: String,
    /// End.
    pub to: String,
    /// Reason.
    pub reason: String,
    /// When it was stored.
    pub created_at: String,
}

/// An acknowledgement, with the properties that identify its alarm.
#[derive(Debug, Clone, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Acknowledged {
    /// Kind of the alarm.
    pub kind: String,
    /// Series of the alarm.
    pub series: String,
    /// Version of the undamaged reference of the alarm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub undamaged_version: Option<u32>,
    /// Batch that opened the alarm.
    pub opened_batch: String,
    /// When the alarm was acknowledged.
    pub at: String,
    /// By whom.
    pub by: String,
    /// Their note.
    pub note: Option<String>,
}

/// An action on an alarm, with the properties that identify the alarm.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ArchivedAction {
    /// Kind of the alarm.
    pub alarm_kind: String,
    /// Series of the alarm.
    pub series: String,
    /// Version of the undamaged reference of the alarm.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub undamaged_version: Option<u32>,
    /// Batch that opened the alarm.
    pub opened_batch: String,
    /// When the alarm was opened.
    pub opened_at: String,
    /// When it ended.
    pub ended_at: Option<String>,
    /// Unique id of the action.
    pub uid: String,
    /// `comment`, `assignment`, `closing` or `reopening`.
    pub kind: String,
    /// When it was done.
    pub at: String,
    /// By whom.
    pub author: String,
    /// Comment or explanation.
    pub text: Option<String>,
    /// Reason of a closing.
    pub reason: Option<String>,
    /// Assignee of an assignment; none for nobody.
    pub assignee: Option<String>,
}

/// A note on the time line.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ArchivedNote {
    /// Its id.
    pub note: String,
    /// The moment, or the beginning of the period.
    pub from: String,
    /// End of the period; none for a moment.
    pub to: Option<String>,
    /// The text.
    pub text: String,
    /// Who wrote it.
    pub author: String,
    /// When it was written.
    pub created_at: String,
}

/// The last line.
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

impl ArchivedModel {
    /// Makes the record of a trained baseline from its files.
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
    /// A message if the text is not base64.
    pub fn weights(&self) -> Result<Vec<u8>, String> {
        STANDARD.decode(&self.weights_base64).map_err(|e| e.to_string())
    }
}
