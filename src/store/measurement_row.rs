//! A measurement as it is stored.

use sqlx::FromRow;

use super::column::{bad_row, from_blob, timestamp};
use super::error::Error;
use crate::measurement::ModalMeasurement;
use crate::quantity::Hertz;

#[derive(FromRow)]
pub(super) struct MeasurementRow {
    measured_at_us: i64,
    frequency_hz: Vec<u8>,
    std_hz: Option<Vec<u8>>,
    mode_shapes: Option<String>,
    covariates: String,
    settings: String,
}

/// The measurement of a row.
pub(super) fn measurement(row: MeasurementRow) -> Result<ModalMeasurement, Error> {
    let what = "measurement";
    let std = row.std_hz.map(|blob| from_blob(what, &blob)).transpose()?;
    Ok(ModalMeasurement {
        measured_at: timestamp(what, row.measured_at_us)?,
        frequencies_hz: frequencies(what, &row.frequency_hz)?,
        std_hz: std.map(|values| values.into_iter().map(|s| Some(s).filter(|s| !s.is_nan())).collect()),
        mode_shapes: mode_shapes(row.mode_shapes.as_deref())?,
        covariates: serde_json::from_str(&row.covariates).map_err(|e| bad_row(what)(&e))?,
        settings: serde_json::from_str(&row.settings).map_err(|e| bad_row(what)(&e))?,
    })
}

/// The mode shapes of a row, `[modes][sensors]`; `None` for a mode that was not identified.
pub(super) fn mode_shapes(json: Option<&str>) -> Result<Option<Vec<Option<Vec<f64>>>>, Error> {
    json.map(|text| serde_json::from_str(text).map_err(|e| bad_row("mode shapes")(&e))).transpose()
}

/// The frequencies of a blob; NaN marks a mode that was not identified.
pub(super) fn frequencies(what: &'static str, blob: &[u8]) -> Result<Vec<Option<Hertz>>, Error> {
    let frequency = |value: f64| match value {
        missing if missing.is_nan() => Ok(None),
        value => Hertz::new(value).map(Some).map_err(|e| bad_row(what)(&e)),
    };
    from_blob(what, blob)?.into_iter().map(frequency).collect()
}
