//! Tables as CSV or, if built in, Parquet.

use axum::http::{header, HeaderMap, StatusCode};

use super::cell::{Cell, ColumnKind};
use super::error::ApiError;
use crate::measurement::csv_text::add_row;
use crate::quantity::shown;

/// Format of an answer.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// One JSON object with one page.
    Json,
    /// Comma-separated values.
    Csv,
    /// One JSON object per line.
    Ndjson,
    /// Apache Parquet.
    Parquet,
}

impl Format {
    /// The format named in the query, else the one in `Accept`, else JSON.
    ///
    /// # Errors
    /// 422 for a format that is not `allowed`, 406 for Parquet if it is not built in.
    pub fn of(name: Option<&str>, headers: &HeaderMap, allowed: &[Self]) -> Result<Self, ApiError> {
        let accepted = |format: &Self| {
            let accept = headers.get(header::ACCEPT).map_or(&b""[..], header::HeaderValue::as_bytes);
            let essence = format.content_type().split(';').next().unwrap_or_default();
            *format != Self::Json && accept.starts_with(essence.as_bytes())
        };
        let format = match name {
            None => allowed.iter().copied().find(accepted).unwrap_or(Self::Json),
            Some(name) => allowed.iter().copied().find(|f| f.name() == name).ok_or_else(|| {
                let names: Vec<&str> = allowed.iter().map(|f| f.name()).collect();
                let message = format!("{} is not one of {}", shown(name), names.join(", "));
                ApiError::invalid_field("query/format", message)
            })?,
        };
        if format == Self::Parquet && !cfg!(feature = "parquet") {
            let detail = "this modalwatch was built without Parquet (cargo feature \"parquet\"): use csv or json";
            return Err(ApiError::new(StatusCode::NOT_ACCEPTABLE, "not_acceptable", detail));
        }
        Ok(format)
    }

    /// Name in a query, and extension of a file.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Json => "json",
            Self::Csv => "csv",
            Self::Ndjson => "ndjson",
            Self::Parquet => "parquet",
        }
    }

    /// Media type.
    pub const fn content_type(self) -> &'static str {
        match self {
            Self::Json => "application/json",
            Self::Csv => "text/csv; charset=utf-8",
            Self::Ndjson => "application/x-ndjson",
            Self::Parquet => "application/vnd.apache.parquet",
        }
    }
}

/// Writes a table in parts.
pub enum TableWriter {
    /// CSV. Holds the header until it has been written.
    Csv(Option<Vec<String>>),
    /// Parquet.
    #[cfg(feature = "parquet")]
    Parquet(Box<super::parquet::ParquetWriter>),
}

impl TableWriter {
    /// A table with these columns.
    ///
    /// # Errors
    /// 500 if the format cannot represent the columns, which is a bug.
    #[cfg_attr(not(feature = "parquet"), expect(clippy::unnecessary_wraps, reason = "Parquet can fail"))]
    pub fn new<N: AsRef<str>>(format: Format, columns: &[(N, ColumnKind)]) -> Result<Self, ApiError> {
        #[cfg(feature = "parquet")]
        if format == Format::Parquet {
            let writer = super::parquet::ParquetWriter::new(columns).map_err(|e| ApiError::internal(&e))?;
            return Ok(Self::Parquet(Box::new(writer)));
        }
        debug_assert!(format == Format::Csv, "{format:?} is not a table");
        Ok(Self::Csv(Some(columns.iter().map(|(name, _)| name.as_ref().to_owned()).collect())))
    }

    /// Writes the next rows and returns their bytes.
    ///
    /// # Errors
    /// 500 if a row does not fit the columns, which is a bug.
    #[cfg_attr(not(feature = "parquet"), expect(clippy::unnecessary_wraps, reason = "Parquet can fail"))]
    pub fn rows(&mut self, rows: Vec<Vec<Cell>>) -> Result<Vec<u8>, ApiError> {
        match self {
            Self::Csv(header) => Ok(csv(header.take(), rows)),
            #[cfg(feature = "parquet")]
            Self::Parquet(writer) => writer.rows(&rows).map_err(|e| ApiError::internal(&e)),
        }
    }

    /// Returns the bytes after the last row.
    ///
    /// # Errors
    /// 500 if the file cannot be completed, which is a bug.
    #[cfg_attr(not(feature = "parquet"), expect(clippy::unnecessary_wraps, reason = "Parquet can fail"))]
    pub fn end(self) -> Result<Vec<u8>, ApiError> {
        match self {
            Self::Csv(header) => Ok(csv(header, Vec::new())),
            #[cfg(feature = "parquet")]
            Self::Parquet(writer) => writer.end().map_err(|e| ApiError::internal(&e)),
        }
    }
}

fn csv(header: Option<Vec<String>>, rows: Vec<Vec<Cell>>) -> Vec<u8> {
    let mut table = String::new();
    if let Some(names) = header {
        add_row(&mut table, names);
    }
    for row in rows {
        add_row(&mut table, row.into_iter().map(Cell::into_text));
    }
    table.into_bytes()
}
