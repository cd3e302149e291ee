//! Measurements from a CSV file.

use std::path::Path;

use anyhow::Context as _;

use crate::clock;
use crate::measurement::check::check_measurements;
use crate::measurement::csv::{self, CsvOptions, Times};
use crate::measurement::ModalMeasurement;
use crate::simulator::Simulator;

/// Reads and checks the measurements of a structure, without the columns in `ignore`.
///
/// # Errors
/// A file that cannot be read, or all errors in it, with line and column.
pub fn read_measurements(
    simulator: &Simulator,
    path: &Path,
    ignore: &[String],
) -> anyhow::Result<Vec<ModalMeasurement>> {
    let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
    let points = simulator.instrumented_points().map_or_else(Vec::new, |points| points.names.clone());
    let options = CsvOptions { times: Times::RowNumber, ignore: ignore.to_vec(), points, ..CsvOptions::default() };
    let expectation = simulator.expectation(clock::now(), usize::MAX);
    csv::read(&bytes, simulator.modes(), simulator.covariates(), &options)
        .and_then(|raw| check_measurements(raw, &expectation))
        .map_err(|problems| {
            let lines: Vec<String> = problems.iter().map(|p| format!("  {}: {}", p.pointer, p.message)).collect();
            anyhow::anyhow!("{} is refused:\n{}", path.display(), lines.join("\n"))
        })
}
