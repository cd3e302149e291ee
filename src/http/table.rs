//! Tables for spreadsheets and programs: the same rows as CSV or, where it is built in, Parquet.

use axum::http::{header, HeaderMap, StatusCode};

use super::error::ApiError;
use crate::quantity::{shown, Timestamp};

/// What the cells of a column hold.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Text.
    Text,
    /// A number.
    Number,
    /// A whole number.
    Count,
    /// Yes or no.
    Flag,
    /// A point in time.
    Time,
}

/// A cell.
#[derive(Debug, Clone, PartialEq)]
pub enum Cell {
    /// Nothing.
    Empty,
    /// Of a column of [`Kind::Text`].
    Text(String),
    /// Of a column of [`Kind::Number`].
    Number(f64),
    /// Of a column of [`Kind::Count`].
    Count(i64),
    /// Of a column of [`Kind::Flag`].
    Flag(bool),
    /// Of a column of [`Kind::Time`].
    Time(Timestamp),
}

impl Cell {
    /// A number that may be missing.
    pub fn number(value: Option<f64>) -> Self {
        value.map_or(Self::Empty, Self::Number)
    }

    fn into_text(self) -> String {
        match self {
            Self::Empty => String::new(),
            Self::Text(text) => text,
            Self::Number(number) => number.to_string(),
            Self::Count(count) => count.to_string(),
            Self::Flag(flag) => flag.to_string(),
            Self::Time(time) => time.to_string(),
        }
    }
}

/// How an answer is written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// One JSON object, a page.
    Json,
    /// Comma-separated values.
    Csv,
    /// One JSON object a line.
    Ndjson,
    /// Apache Parquet.
    Parquet,
}

impl Format {
    /// The format that the query names, or else `Accept`; JSON without either.
    ///
    /// # Errors
    /// 422 for another name than those `allowed`, 406 for Parquet where it is not built in.
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
                let message = format!("{} is none of {}", shown(name), names.join(", "));
                ApiError::invalid_field("query/format", message)
            })?,
        };
        if format == Self::Parquet && !cfg!(feature = "parquet") {
            let detail = "this modalwatch was built without Parquet (cargo feature \"parquet\"): take csv or json";
            return Err(ApiError::new(StatusCode::NOT_ACCEPTABLE, "not_acceptable", detail));
        }
        Ok(format)
    }

    /// Its name in a query, and the ending of a file's name.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Json => "json",
            Self::Csv => "csv",
            Self::Ndjson => "ndjson",
            Self::Parquet => "parquet",
        }
    }

    /// Its media type.
    pub const fn content_type(self) -> &'static str {
        match self {
            Self::Json => "application/json",
            Self::Csv => "text/csv; charset=utf-8",
            Self::Ndjson => "application/x-ndjson",
            Self::Parquet => "application/vnd.apache.parquet",
        }
    }
}

/// Writes a table part by part; each part is given out as soon as it is written.
pub enum TableWriter {
    /// CSV, with the header until it has been given out.
    Csv(Option<Vec<String>>),
    /// Parquet.
    #[cfg(feature = "parquet")]
    Parquet(Box<super::parquet::ParquetWriter>),
}

impl TableWriter {
    /// A table with these columns.
    ///
    /// # Errors
    /// 500 for columns that the format cannot have: a bug.
    #[cfg_attr(not(feature = "parquet"), expect(clippy::unnecessary_wraps, reason = "Parquet can fail"))]
    pub fn new<N: AsRef<str>>(format: Format, columns: &[(N, Kind)]) -> Result<Self, ApiError> {
        #[cfg(feature = "parquet")]
        if format == Format::Parquet {
            let writer = super::parquet::ParquetWriter::new(columns).map_err(|e| ApiError::internal(&e))?;
            return Ok(Self::Parquet(Box::new(writer)));
        }
        debug_assert!(format == Format::Csv, "{format:?} is no table");
        Ok(Self::Csv(Some(columns.iter().map(|(name, _)| name.as_ref().to_owned()).collect())))
    }

    /// The next rows as bytes.
    ///
    /// # Errors
    /// 500 for a row that does not fit the columns: a bug.
    #[cfg_attr(not(feature = "parquet"), expect(clippy::unnecessary_wraps, reason = "Parquet can fail"))]
    pub fn rows(&mut self, rows: Vec<Vec<Cell>>) -> Result<Vec<u8>, ApiError> {
        match self {
            Self::Csv(header) => Ok(csv(header.take(), rows)),
            #[cfg(feature = "parquet")]
            Self::Parquet(writer) => writer.rows(&rows).map_err(|e| ApiError::internal(&e)),
        }
    }

    /// What stands behind the last row.
    ///
    /// # Errors
    /// 500 for a bug.
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
    let mut writer = csv::Writer::from_writer(Vec::new());
    let rows = rows.into_iter().map(|row| row.into_iter().map(Cell::into_text).collect());
    let write = |row: Vec<String>| writer.write_record(row).expect("rows have as many cells as the header");
    header.into_iter().chain(rows).for_each(write);
    writer.into_inner().expect("writing to memory cannot fail")
}
