//! What was understood of a table, for its sender to check.

use serde::Serialize;
use utoipa::ToSchema;

use super::clock::DateOrder;

/// Largest number of refused rows that are listed.
pub const MOST_REFUSED: usize = 100;

/// Role of a column.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum ColumnRole {
    /// Times, dates, or times of day.
    Time,
    /// Frequencies of a mode, or their standard deviations.
    Mode,
    /// Components of a mode shape.
    Shape,
    /// A covariate.
    Covariate,
    /// A parameter that the experimenter set.
    Setting,
    /// Not read.
    Ignored,
    /// Not recognised: the table is refused until the column is assigned or ignored.
    Unknown,
}

/// A column and what it was taken for.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
#[schema(as = TableColumn)]
pub struct UnderstoodColumn {
    /// Number, from 1.
    pub number: usize,
    /// Text in the header.
    pub name: String,
    /// Role.
    pub role: ColumnRole,
    /// What its cells become, such as `f1_hz` or `temperature_c`; `null` for a column that is not read.
    #[schema(required)]
    pub target: Option<String>,
    /// Why, and in which unit.
    pub reason: String,
    /// Its first cells that are not empty.
    pub examples: Vec<String>,
}

/// A row that was not taken.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, ToSchema)]
pub struct RefusedRow {
    /// Line in the file, from 1.
    pub line: u64,
    /// Text in the header of the column with the mistake, if it is in one column.
    #[schema(required)]
    pub column: Option<String>,
    /// What is wrong.
    pub reason: String,
}

/// An option that the table needs, because what it says has more than one reading.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(as = TableNeed)]
pub enum Need {
    /// `zone`: times do not state theirs.
    Zone,
    /// `date_order`: 03/04/2026 may be in March or in April.
    DateOrder,
    /// `time_unit`: times are numbers.
    TimeUnit,
    /// `decimal`: some numbers have a comma, others a point.
    Decimal,
    /// `columns` or `ignore`: a column is not recognised, or one is missing.
    Columns,
    /// `split`: the measurements span more than 48 h.
    Split,
}

/// What was understood of a table.
#[derive(Debug, Clone, PartialEq, Serialize, ToSchema)]
#[schema(as = TableUnderstood)]
pub struct Understood {
    /// `,`, `;`, or a tab.
    pub separator: char,
    /// `.` or `,`.
    pub decimal_sign: char,
    /// Zone in which times without one are read; `null` if every time states its own.
    #[schema(required)]
    pub zone: Option<String>,
    /// Order of day and month, if dates need one.
    #[schema(required)]
    pub date_order: Option<DateOrder>,
    /// The columns in the order of the file.
    pub columns: Vec<UnderstoodColumn>,
    /// Number of rows that are not empty.
    pub rows: usize,
    /// Number of rows that are taken.
    pub accepted: usize,
    /// Number of rows that are refused.
    pub refused: usize,
    /// The first 100 rows that are refused.
    pub refused_rows: Vec<RefusedRow>,
    /// Number of batches that the rows make.
    pub batches: usize,
}
