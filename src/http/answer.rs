//! JSON bodies of answers: units in field names, times in RFC 3339 UTC, never NaN.

use serde::Serialize;

use crate::assessment::{Assessment, BatchState};
use crate::damage::{QuantityAssessment, QuantityKind};
use crate::measurement::ModalMeasurement;
use crate::monitor::BatchView;
use crate::quantity::Timestamp;
use crate::store::{HistoryEntry, UndamagedRecord};

/// One batch.
#[derive(Debug, Serialize)]
pub struct Batch {
    structure: String,
    batch: String,
    source: String,
    received_at: Timestamp,
    measured_from: Timestamp,
    measured_to: Timestamp,
    measurement_count: usize,
    state: BatchState,
    #[serde(skip_serializing_if = "Option::is_none")]
    failure: Option<String>,
    #[serde(skip_serializing_if = "Option::is_none")]
    next_step: Option<String>,
    content_digest: String,
    assessment: Option<AssessmentBody>,
    #[serde(skip_serializing_if = "Option::is_none")]
    measurements: Option<Vec<ModalMeasurement>>,
}

impl Batch {
    /// The answer for a batch, with its measurements if they are wanted.
    pub fn new(view: BatchView, with_measurements: bool) -> Self {
        let BatchView { record, assessment, next_step } = view;
        let (measured_from, measured_to) = record.batch.time_span();
        Self {
            structure: record.batch.structure.to_string(),
            batch: record.batch_id,
            source: record.batch.source,
            received_at: record.received_at,
            measured_from,
            measured_to,
            measurement_count: record.batch.measurements.len(),
            state: record.state,
            failure: record.failure,
            next_step,
            content_digest: record.content_digest.to_string(),
            assessment: assessment.map(AssessmentBody::from),
            measurements: with_measurements.then_some(record.batch.measurements),
        }
    }

    /// Path of the batch.
    pub fn location(&self) -> String {
        format!("/v1/structures/{}/batches/{}", self.structure, self.batch)
    }
}

/// What a batch says of the structure.
#[derive(Debug, Serialize)]
pub struct AssessmentBody {
    model_digest: String,
    structure_digest: String,
    undamaged_version: Option<u32>,
    /// As text: JSON numbers lose digits above 2^53 in many readers.
    seed: String,
    draws_per_measurement: usize,
    measurements_used: usize,
    measurements_left_out: usize,
    measurements_outside: usize,
    misfit_percent: Vec<f64>,
    assessed_at: Timestamp,
    exceeds: bool,
    /// What a reader must know before believing the figures.
    warnings: Vec<String>,
    parameters: Vec<ParameterBody>,
}

/// One monitored quantity of a batch.
#[derive(Debug, Serialize)]
pub struct ParameterBody {
    name: String,
    unit: String,
    kind: QuantityKind,
    mean: f64,
    std: Option<f64>,
    variance_within: f64,
    variance_between: Option<f64>,
    edge_mass: f64,
    threshold: Option<f64>,
    probability_of_damage: Option<f64>,
    exceeds: Option<bool>,
    relative_change: Option<f64>,
}

impl From<Assessment> for AssessmentBody {
    fn from(a: Assessment) -> Self {
        let warnings = a.warnings();
        let exceeds = a.quantities.iter().any(|q| q.damage.as_ref().is_some_and(|d| d.exceeds));
        Self {
            model_digest: a.model_digest.to_string(),
            structure_digest: a.structure_digest.to_string(),
            undamaged_version: a.undamaged_version,
            seed: a.seed.to_string(),
            draws_per_measurement: a.draws_per_measurement,
            measurements_used: a.measurements_used,
            measurements_left_out: a.measurements_left_out,
            measurements_outside: a.measurements_outside,
            misfit_percent: a.misfit_percent,
            assessed_at: a.assessed_at,
            exceeds,
            warnings,
            parameters: a.quantities.into_iter().map(ParameterBody::from).collect(),
        }
    }
}

impl From<QuantityAssessment> for ParameterBody {
    fn from(q: QuantityAssessment) -> Self {
        let damage = q.damage.as_ref();
        Self {
            mean: q.hyperparameters.mean,
            std: q.hyperparameters.std,
            variance_within: q.hyperparameters.within,
            variance_between: q.hyperparameters.between,
            edge_mass: q.edge_mass,
            threshold: damage.map(|d| d.threshold),
            probability_of_damage: damage.map(|d| d.probability_of_damage),
            exceeds: damage.map(|d| d.exceeds),
            relative_change: damage.map(|d| d.relative_change),
            name: q.name,
            unit: q.unit,
            kind: q.kind,
        }
    }
}

/// One batch of the history.
#[derive(Debug, Serialize)]
pub struct HistoryItem {
    batch: String,
    source: String,
    measured_from: Timestamp,
    measured_to: Timestamp,
    received_at: Timestamp,
    measurement_count: usize,
    state: BatchState,
    #[serde(skip_serializing_if = "Option::is_none")]
    failure: Option<String>,
    assessment: Option<AssessmentBody>,
}

impl From<HistoryEntry> for HistoryItem {
    fn from(entry: HistoryEntry) -> Self {
        Self {
            batch: entry.batch_id,
            source: entry.source,
            measured_from: entry.measured_from,
            measured_to: entry.measured_to,
            received_at: entry.received_at,
            measurement_count: entry.measurement_count,
            state: entry.state,
            failure: entry.failure,
            assessment: entry.assessment.map(AssessmentBody::from),
        }
    }
}

/// Columns of the history as CSV: one row for each batch and quantity, or one with empty places without an assessment.
pub const HISTORY_COLUMNS: [&str; 16] = [
    "batch",
    "source",
    "measured_from",
    "measured_to",
    "measurement_count",
    "state",
    "parameter",
    "unit",
    "mean",
    "std",
    "edge_mass",
    "threshold",
    "probability_of_damage",
    "exceeds",
    "relative_change",
    "model_digest",
];

impl HistoryItem {
    /// Rows in the order of [`HISTORY_COLUMNS`].
    pub fn csv_rows(&self) -> Vec<Vec<String>> {
        let batch = [
            self.batch.clone(),
            self.source.clone(),
            self.measured_from.to_string(),
            self.measured_to.to_string(),
            self.measurement_count.to_string(),
            self.state.as_str().to_owned(),
        ];
        let Some(assessment) = &self.assessment else {
            return vec![batch.into_iter().chain(vec![String::new(); 10]).collect()];
        };
        let row = |p: &ParameterBody| {
            let quantity = [
                p.name.clone(),
                p.unit.clone(),
                p.mean.to_string(),
                cell(p.std),
                p.edge_mass.to_string(),
                cell(p.threshold),
                cell(p.probability_of_damage),
                cell(p.exceeds),
                cell(p.relative_change),
                assessment.model_digest.clone(),
            ];
            batch.iter().cloned().chain(quantity).collect()
        };
        assessment.parameters.iter().map(row).collect()
    }
}

fn cell<T: ToString>(value: Option<T>) -> String {
    value.map_or_else(String::new, |v| v.to_string())
}

/// The undamaged state of a structure.
#[derive(Debug, Serialize)]
pub struct Undamaged {
    structure: String,
    version: u32,
    created_at: Timestamp,
    model_digest: String,
    threshold_probability: f64,
    measurement_count: usize,
    batches: Vec<String>,
    parameters: Vec<crate::damage::UndamagedQuantity>,
}

impl Undamaged {
    /// The answer for an undamaged state.
    pub fn new(structure: &crate::quantity::StructureId, record: UndamagedRecord) -> Self {
        Self {
            structure: structure.to_string(),
            version: record.state.version,
            created_at: record.created_at,
            model_digest: record.model_digest.to_string(),
            threshold_probability: record.state.threshold_probability,
            measurement_count: record.state.measurements,
            batches: record.batches,
            parameters: record.state.quantities,
        }
    }
}
