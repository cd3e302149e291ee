//! The history as a table.

use super::{HistoryItem, ParameterBody};
use crate::http::cell::{Cell, ColumnKind};
use crate::trust::TrustVerdict;

/// Columns of the history as a table: one row for each batch and quantity; a batch without an assessment has one row
/// with empty cells.
pub const HISTORY_COLUMNS: [(&str, ColumnKind); 25] = [
    ("batch", ColumnKind::Text),
    ("source", ColumnKind::Text),
    ("measured_from", ColumnKind::Time),
    ("measured_to", ColumnKind::Time),
    ("measurement_count", ColumnKind::Count),
    ("state", ColumnKind::Text),
    ("parameter", ColumnKind::Text),
    ("unit", ColumnKind::Text),
    ("mean", ColumnKind::Number),
    ("mean_low", ColumnKind::Number),
    ("mean_high", ColumnKind::Number),
    ("std", ColumnKind::Number),
    ("std_low", ColumnKind::Number),
    ("std_high", ColumnKind::Number),
    ("edge_mass", ColumnKind::Number),
    ("threshold", ColumnKind::Number),
    ("probability_of_damage", ColumnKind::Number),
    ("probability_of_damage_low", ColumnKind::Number),
    ("probability_of_damage_high", ColumnKind::Number),
    ("exceeds", ColumnKind::Flag),
    ("relative_change", ColumnKind::Number),
    ("pooled_mean", ColumnKind::Number),
    ("pooled_std", ColumnKind::Number),
    ("trust", ColumnKind::Text),
    ("model_digest", ColumnKind::Text),
];

impl HistoryItem {
    /// Rows in the order of [`HISTORY_COLUMNS`].
    pub fn rows(&self) -> Vec<Vec<Cell>> {
        let batch = [
            Cell::Text(self.batch.clone()),
            Cell::Text(self.source.clone()),
            Cell::Time(self.measured_from),
            Cell::Time(self.measured_to),
            Cell::Count(self.measurement_count as i64),
            Cell::Text(self.state.as_str().to_owned()),
        ];
        let Some(assessment) = &self.assessment else {
            let empty = std::iter::repeat_n(Cell::Empty, HISTORY_COLUMNS.len() - batch.len());
            return vec![batch.into_iter().chain(empty).collect()];
        };
        let trust = if assessment.trust == TrustVerdict::Accepted { "accepted" } else { "rejected" };
        let low = |interval: Option<[f64; 2]>| Cell::number(interval.map(|i| i[0]));
        let high = |interval: Option<[f64; 2]>| Cell::number(interval.map(|i| i[1]));
        let row = |p: &ParameterBody| {
            let quantity = [
                Cell::Text(p.name.clone()),
                Cell::Text(p.unit.clone()),
                Cell::Number(p.mean),
                low(p.mean_interval),
                high(p.mean_interval),
                Cell::number(p.std),
                low(p.std_interval),
                high(p.std_interval),
                Cell::Number(p.edge_mass),
                Cell::number(p.threshold),
                Cell::number(p.probability_of_damage),
                low(p.probability_of_damage_interval),
                high(p.probability_of_damage_interval),
                p.exceeds.map_or(Cell::Empty, Cell::Flag),
                Cell::number(p.relative_change),
                Cell::Number(p.pooled.mean),
                Cell::number(p.pooled.std),
                Cell::Text(trust.to_owned()),
                Cell::Text(assessment.model_digest.clone()),
            ];
            batch.iter().cloned().chain(quantity).collect()
        };
        assessment.parameters.iter().map(row).collect()
    }
}
