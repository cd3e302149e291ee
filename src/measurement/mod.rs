//! What arrives: measured natural frequencies, already checked. Values of these types are valid.
//!
//! [`check`] turns raw values into these types, [`body`] reads them from JSON, [`csv`] reads and writes them as tables.

pub mod body;
pub mod check;
pub mod csv;
pub mod json;
pub mod shape;

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::quantity::{Digest, Hertz, OutOfRange, StructureId, Timestamp};

/// Kind of a covariate's values.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum CovariateKind {
    /// A finite number, in the unit of the covariate's name.
    #[default]
    Number,
    /// A label such as an operator or a laboratory.
    Category,
}

/// A declared covariate of a structure.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Covariate {
    /// Name with its unit, such as `temperature_c`.
    pub name: String,
    /// Kind of its values.
    pub kind: CovariateKind,
}

/// Value of a covariate at one measurement.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(untagged)]
pub enum CovariateValue {
    /// A finite number.
    Number(f64),
    /// A label.
    Category(String),
}

/// The natural frequencies identified from one record, mode by mode.
#[derive(Debug, Clone, PartialEq, Serialize, utoipa::ToSchema)]
pub struct ModalMeasurement {
    /// When it was measured.
    pub measured_at: Timestamp,
    /// One entry a mode of the structure, Hz; `None` where the mode was not identified. At least one is present.
    pub frequencies_hz: Vec<Option<Hertz>>,
    /// Standard deviation of each frequency, Hz, where the identification gives it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub std_hz: Option<Vec<Option<f64>>>,
    /// Shape of each mode at the instrumented points of the structure, of any norm and sign; `None` for one that was not
    /// identified.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mode_shapes: Option<Vec<Option<Vec<f64>>>>,
    /// Values of declared covariates.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub covariates: BTreeMap<String, CovariateValue>,
    /// Parameters that the experimenter set and therefore knows, in their own units.
    #[serde(skip_serializing_if = "BTreeMap::is_empty")]
    pub settings: BTreeMap<String, f64>,
}

impl ModalMeasurement {
    /// All frequencies in Hz, or `None` when a mode is missing.
    pub fn complete_hz(&self) -> Option<Vec<f64>> {
        self.frequencies_hz.iter().map(|f| f.map(Hertz::get)).collect()
    }
}

/// Measurements of one structure taken in one state, in the order they came; never empty.
#[derive(Debug, Clone, PartialEq)]
pub struct MeasurementBatch {
    /// The structure measured.
    pub structure: StructureId,
    /// The instrument, gateway or campaign they come from; a measurement is known by (structure, source, time).
    pub source: String,
    /// The client's own key for this batch, if it gave one.
    pub idempotency_key: Option<String>,
    /// The measurements; times are distinct.
    pub measurements: Vec<ModalMeasurement>,
}

impl MeasurementBatch {
    /// Digest of everything that was measured; the same whether it came as JSON or CSV, and whatever its key.
    pub fn content_digest(&self) -> Digest {
        let measurements = serde_json::to_vec(&self.measurements).expect("checked measurements are plain data");
        Digest::of(&[self.structure.as_str().as_bytes(), self.source.as_bytes(), &measurements])
    }

    /// Earliest and latest time of measurement.
    pub fn time_span(&self) -> (Timestamp, Timestamp) {
        let times = || self.measurements.iter().map(|m| m.measured_at);
        let first = times().min().expect("a batch is never empty");
        (first, times().max().expect("a batch is never empty"))
    }
}

/// Complete measurements at equal intervals, with a standard deviation as a share of each frequency, if one is given.
///
/// # Errors
/// [`OutOfRange`] for a frequency or time that is none.
pub fn at_intervals(
    rows: &[Vec<f64>],
    start: Timestamp,
    interval_s: u32,
    relative_std: Option<f64>,
) -> Result<Vec<ModalMeasurement>, OutOfRange> {
    let measurement = |(index, row): (usize, &Vec<f64>)| {
        let micros = start.micros() + index as i64 * i64::from(interval_s) * 1_000_000;
        Ok(ModalMeasurement {
            measured_at: Timestamp::from_micros(micros)?,
            frequencies_hz: row.iter().map(|f| Hertz::new(*f).map(Some)).collect::<Result<_, _>>()?,
            std_hz: relative_std.map(|share| row.iter().map(|f| Some(share * f)).collect()),
            mode_shapes: None,
            covariates: BTreeMap::new(),
            settings: BTreeMap::new(),
        })
    };
    rows.iter().enumerate().map(measurement).collect()
}
