//! The page of a diagnosis.

use super::data::Data;
use super::Outcome;
use crate::simulator::Simulator;

/// One self-contained HTML page.
pub fn html(_simulator: &Simulator, _data: &Data, _study: &Outcome) -> Option<String> {
    None
}
