//! Batches as JSON: the body of a POST request, and of a message from a broker.

use std::collections::BTreeMap;

use serde::Deserialize;
use utoipa::ToSchema;

use super::check::{FieldPath, RawMeasurement};
use super::json::{read_object, JsonError};
use super::CovariateValue;

/// A batch as received. The URL or the topic names the structure.
#[derive(Debug, Clone, PartialEq)]
pub struct RawBatch {
    /// The instrument, gateway or campaign, if the client gave one.
    pub source: Option<String>,
    /// Idempotency key of the batch, if the client gave one.
    pub idempotency_key: Option<String>,
    /// Id of the access token with which it was posted, if it was posted with one; no body states it.
    pub posted_by: Option<String>,
    /// The measurements, not checked yet.
    pub measurements: Vec<RawMeasurement>,
}

/// A batch as JSON.
///
/// The idempotency key of the batch is a header.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = BatchInput)]
pub struct PostBody {
    /// Instrument, gateway or campaign, `default` if omitted. A measurement is identified by its source and its time.
    #[schema(min_length = 1, max_length = 64, pattern = "^[A-Za-z0-9_.:-]+$")]
    source: Option<String>,
    #[schema(min_items = 1)]
    measurements: Vec<MeasurementBody>,
}

/// One batch as a line of NDJSON or a message.
///
/// There are no headers, so that the idempotency key is a field.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = BatchLine)]
pub struct MessageBody {
    /// Instrument, gateway or campaign; if omitted, that of the query.
    #[schema(min_length = 1, max_length = 64, pattern = "^[A-Za-z0-9_.:-]+$")]
    source: Option<String>,
    /// Idempotency key of this batch.
    #[schema(min_length = 1, max_length = 128, pattern = "^[!-~]+$")]
    idempotency_key: Option<String>,
    #[schema(min_items = 1)]
    measurements: Vec<MeasurementBody>,
}

/// The natural frequencies identified from one record.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = MeasurementInput)]
struct MeasurementBody {
    /// When it was measured: RFC 3339 with an offset, at most five minutes ahead of the clock of the service.
    #[schema(value_type = String, format = DateTime, required)]
    measured_at: Option<String>,
    /// One entry for each mode of the structure, Hz, from the lowest; `null` for a mode that was not identified.
    #[schema(min_items = 1)]
    frequencies_hz: Vec<Option<f64>>,
    /// Standard deviation of each frequency, Hz; `null` if it is unknown.
    std_hz: Option<Vec<Option<f64>>>,
    /// Mode shapes, if the structure has instrumented points: one entry for each mode, in the order of `frequencies_hz`. Each is a
    /// list with one number for each point of `mode_shapes.points` in the structure file, in that order and with any norm and
    /// sign, or `null` for a shape that was not identified. Modes are paired with those of the simulation by MAC and frequency.
    mode_shapes: Option<Vec<Option<Vec<f64>>>>,
    /// Values of covariates that the structure declares, by name.
    #[serde(default)]
    covariates: BTreeMap<String, CovariateValue>,
    /// Parameters that the experimenter set and therefore knows, in their own units.
    #[serde(default)]
    settings: BTreeMap<String, f64>,
}

impl RawBatch {
    /// Reads the body of a POST request, whose idempotency key is a header.
    ///
    /// # Errors
    /// [`JsonError`] for text that is not JSON or has another shape.
    pub fn of_post(bytes: &[u8], idempotency_key: Option<String>) -> Result<Self, JsonError> {
        let body: PostBody = read_object(bytes)?;
        Ok(Self { source: body.source, idempotency_key, posted_by: None, measurements: raw(body.measurements) })
    }

    /// Reads a message, in which `idempotency_key` is a field.
    ///
    /// # Errors
    /// [`JsonError`] for text that is not JSON or has another shape.
    pub fn of_message(bytes: &[u8]) -> Result<Self, JsonError> {
        let MessageBody { source, idempotency_key, measurements } = read_object(bytes)?;
        Ok(Self { source, idempotency_key, posted_by: None, measurements: raw(measurements) })
    }
}

fn raw(measurements: Vec<MeasurementBody>) -> Vec<RawMeasurement> {
    let one = |(index, m): (usize, MeasurementBody)| RawMeasurement {
        path: FieldPath::Json { index },
        measured_at: m.measured_at,
        frequencies_hz: m.frequencies_hz,
        std_hz: m.std_hz,
        mode_shapes: m.mode_shapes,
        covariates: m.covariates,
        settings: m.settings,
    };
    measurements.into_iter().enumerate().map(one).collect()
}
