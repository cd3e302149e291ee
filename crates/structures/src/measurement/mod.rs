//! Measured natural frequencies. Values of these types have been checked.
//!
//! [`body`] reads raw measurements from JSON, [`csv`] reads them as tables, [`table`] reads tables as people export them, [`csv_output`] writes such tables, and [`check`] checks them. [`times`] are
//! those that a table gives as numbers, and [`order`] is that of the modes.

pub mod body;
pub mod check;
pub mod csv;
pub mod csv_output;
pub mod csv_text;
pub mod json;
pub mod mistaken_unit;
pub mod order;
pub mod shape;
pub mod table;
pub mod times;

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::quantity::{Digest, Hertz, OutOfRange, StructureId, Timestamp};

/// Temperatures that can occur in a structure or a machine, °C.
const POSSIBLE_C: [f64; 2] = [-60.0, 150.0];

/// Numbers that sensors and loggers give instead of a measurement.
const ERROR_VALUES: [f64; 7] = [-9999.0, -999.0, -127.0, 9999.0, -32768.0, 32767.0, 65535.0];

/// Kind of a covariate's values.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum CovariateKind {
    /// A finite number, in the unit of the covariate.
    #[default]
    Number,
    /// A label such as an operator or a laboratory.
    Category,
}

/// A covariate that a structure declares.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Covariate {
    /// Name, such as `temperature_c`.
    pub name: String,
    /// Kind of its values.
    pub kind: CovariateKind,
    /// Unit of a number, as the structure file states it.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub unit: Option<String>,
    /// Least and largest possible number, as the structure file states them.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub range: Option<[f64; 2]>,
}

impl Covariate {
    /// A covariate whose unit is at most in its name.
    pub fn new(name: impl Into<String>, kind: CovariateKind) -> Self {
        Self { name: name.into(), kind, unit: None, range: None }
    }

    /// Its unit: the stated one, or else that of [`unit_of_name`]; `None` for a category and for an unknown unit.
    pub fn unit(&self) -> Option<&str> {
        let number = self.kind == CovariateKind::Number;
        number.then(|| self.unit.as_deref().or_else(|| unit_of_name(&self.name))).flatten()
    }

    /// The numbers that it can have: the stated range, or else that of a temperature; `None` where nothing is known.
    pub fn possible(&self) -> Option<[f64; 2]> {
        self.range.or_else(|| match self.unit()? {
            "°C" => Some(POSSIBLE_C),
            "K" => Some(POSSIBLE_C.map(|celsius| celsius + 273.15)),
            _ => None,
        })
    }

    /// Why a number cannot be a value of the covariate; `None` if it can.
    pub fn impossible(&self, value: f64) -> Option<String> {
        let unit = self.unit().map_or_else(String::new, |unit| format!(" {unit}"));
        match self.possible() {
            Some([low, high]) => {
                (!(low..=high).contains(&value)).then(|| format!("{value}{unit}, outside {low} to {high}{unit}"))
            }
            None => ERROR_VALUES.contains(&value).then(|| format!("{value}{unit}, an error value of sensors")),
        }
    }
}

/// The unit of a number that a name ends with, such as °C for `temperature_c`; `None` if the end is not known.
pub fn unit_of_name(name: &str) -> Option<&'static str> {
    let lower = name.to_ascii_lowercase();
    if lower.ends_with("_m_per_s") {
        return Some("m/s");
    }
    let (_, last) = lower.rsplit_once('_')?;
    let unit = match last {
        "c" | "degc" => "°C",
        "k" => "K",
        "percent" => "%",
        "um" => "µm",
        "mm" => "mm",
        "m" => "m",
        "hz" => "Hz",
        "n" => "N",
        "kn" => "kN",
        "pa" => "Pa",
        "kpa" => "kPa",
        "bar" => "bar",
        "kg" => "kg",
        "t" => "t",
        "v" => "V",
        "s" => "s",
        _ => return None,
    };
    Some(unit)
}

/// Value of a covariate in one measurement.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
#[serde(untagged)]
pub enum CovariateValue {
    /// A finite number.
    Number(f64),
    /// A label.
    Category(String),
}

/// The modal parameters identified from one record.
#[derive(Debug, Clone, PartialEq, Serialize, utoipa::ToSchema)]
pub struct ModalMeasurement {
    /// Time of the measurement.
    pub measured_at: Timestamp,
    /// Frequency of each mode, Hz; `None` for a mode that was not identified. At least one is present.
    pub frequencies_hz: Vec<Option<Hertz>>,
    /// Standard deviation of each frequency, Hz, if the identification gives it.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub std_hz: Option<Vec<Option<f64>>>,
    /// Shape of each mode at the instrumented points of the structure, with any norm and sign; `None` for a shape that was not
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
    /// All frequencies, Hz; `None` if a mode is missing.
    pub fn complete_hz(&self) -> Option<Vec<f64>> {
        self.frequencies_hz.iter().map(|f| f.map(Hertz::get)).collect()
    }
}

/// Measurements of one structure in one state, in the order in which they were received; never empty.
#[derive(Debug, Clone, PartialEq)]
pub struct MeasurementBatch {
    /// The measured structure.
    pub structure: StructureId,
    /// The instrument, gateway or campaign. A measurement is identified by structure, source and time.
    pub source: String,
    /// Idempotency key of this batch, if the client gave one.
    pub idempotency_key: Option<String>,
    /// Id of the access token with which it was posted, if it was posted with one.
    pub posted_by: Option<String>,
    /// The measurements, whose times differ.
    pub measurements: Vec<ModalMeasurement>,
}

impl MeasurementBatch {
    /// Digest of structure, source and measurements. It does not depend on the format (JSON or CSV), the idempotency key or the token.
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

/// Complete measurements at equal intervals. `rows` holds the frequencies, Hz, `[n][m]`; `relative_std` is their standard deviation
/// as a share of each frequency.
///
/// # Errors
/// [`OutOfRange`] for a frequency that is not positive or a time outside the calendar.
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
