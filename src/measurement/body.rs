//! A batch as JSON: the body of a post, and of a message from a broker.

use std::collections::BTreeMap;

use serde::Deserialize;
use utoipa::ToSchema;

use super::check::{Place, RawMeasurement};
use super::json::{read_object, JsonError};
use super::CovariateValue;

/// A batch as it came, of a structure named elsewhere.
#[derive(Debug, Clone, PartialEq)]
pub struct RawBatch {
    /// The instrument, gateway or campaign, if it was named.
    pub source: Option<String>,
    /// The client's own key for the batch, if it gave one.
    pub idempotency_key: Option<String>,
    /// The measurements, unchecked.
    pub measurements: Vec<RawMeasurement>,
}

/// A batch as JSON.
///
/// The client's own key for it is a header.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = BatchInput)]
pub struct PostBody {
    /// Instrument, gateway or campaign; with the time it names a measurement. `default` without.
    #[schema(min_length = 1, max_length = 64, pattern = "^[A-Za-z0-9_.:-]+$")]
    source: Option<String>,
    #[schema(min_items = 1)]
    measurements: Vec<MeasurementBody>,
}

/// A line of NDJSON, or a message: one batch.
///
/// It has no headers: the key is a field.
#[derive(Debug, Deserialize, ToSchema)]
#[serde(deny_unknown_fields)]
#[schema(as = BatchLine)]
pub struct MessageBody {
    /// Where the measurements come from; that of the query without.
    #[schema(min_length = 1, max_length = 64, pattern = "^[A-Za-z0-9_.:-]+$")]
    source: Option<String>,
    /// The client's own key for this batch.
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
    /// When it was measured: RFC 3339 with an offset, at most five minutes ahead of the service's clock.
    #[schema(value_type = String, format = DateTime, required)]
    measured_at: Option<String>,
    /// One entry for each mode of the structure, Hz, from the lowest; `null` for a mode that was not identified.
    #[schema(min_items = 1)]
    frequencies_hz: Vec<Option<f64>>,
    /// Standard deviation of each frequency, Hz, where it is known.
    std_hz: Option<Vec<Option<f64>>>,
    /// Mode shapes, where the structure has instrumented points: one entry for each mode, in the order of `frequencies_hz`; a
    /// list with a number for each point of `mode_shapes.points` of the structure file, in that order, of any norm and sign;
    /// `null` for a shape that was not identified. Modes are paired with those of the simulation by MAC and frequency.
    mode_shapes: Option<Vec<Option<Vec<f64>>>>,
    /// Values of covariates that the structure declares, by name.
    #[serde(default)]
    covariates: BTreeMap<String, CovariateValue>,
    /// Parameters that the experimenter set and therefore knows, in their own units.
    #[serde(default)]
    settings: BTreeMap<String, f64>,
}

impl RawBatch {
    /// The body of a post, whose key came as a header.
    ///
    /// # Errors
    /// [`JsonError`].
    pub fn of_post(bytes: &[u8], idempotency_key: Option<String>) -> Result<Self, JsonError> {
        let body: PostBody = read_object(bytes)?;
        Ok(Self { source: body.source, idempotency_key, measurements: raw(body.measurements) })
    }

    /// A message: the body of a post, which may have `idempotency_key` too.
    ///
    /// # Errors
    /// [`JsonError`].
    pub fn of_message(bytes: &[u8]) -> Result<Self, JsonError> {
        let MessageBody { source, idempotency_key, measurements } = read_object(bytes)?;
        Ok(Self { source, idempotency_key, measurements: raw(measurements) })
    }
}

fn raw(measurements: Vec<MeasurementBody>) -> Vec<RawMeasurement> {
    let one = |(index, m): (usize, MeasurementBody)| RawMeasurement {
        place: Place::Json { index },
        measured_at: m.measured_at,
        frequencies_hz: m.frequencies_hz,
        std_hz: m.std_hz,
        mode_shapes: m.mode_shapes,
        covariates: m.covariates,
        settings: m.settings,
    };
    measurements.into_iter().enumerate().map(one).collect()
}
