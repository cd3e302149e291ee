//! `modalwatch simulate`: simulated measurements as CSV that the service accepts.

use std::path::PathBuf;

use anyhow::Context as _;
use clap::Args;

use super::output::write_whole;
use super::parameter::parameter_moments;
use crate::baseline::library::find_structure;
use crate::measurement::{at_intervals, csv_output};
use crate::quantity::Timestamp;
use crate::simulator::population::Population;

/// Simulate measurements of a structure as CSV.
#[derive(Debug, Args)]
pub struct SimulateArgs {
    /// Structure file (TOML or JSON), or the id of a shipped structure
    #[arg(long)]
    structure: String,
    /// Population of one parameter, as name=mean,std in its unit; once per parameter
    #[arg(long = "parameter", required = true, value_parser = parameter_moments)]
    parameters: Vec<(String, f64, f64)>,
    /// Number of measurements
    #[arg(long, default_value_t = 50)]
    measurements: usize,
    /// Noise as a multiple of the structure's noise; 0 = no noise
    #[arg(long, default_value_t = 1.0)]
    noise: f64,
    /// Seed of all random numbers
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Time of the first measurement
    #[arg(long, default_value = "2026-01-01T00:00:00Z")]
    start: String,
    /// Seconds between measurements
    #[arg(long, default_value_t = 600)]
    interval_s: u32,
    /// File to write [default: standard output]
    #[arg(long)]
    out: Option<PathBuf>,
}

/// Draws parameters from the population, simulates the measurements and writes them as CSV.
///
/// # Errors
/// A structure or population that is refused, a file that cannot be written.
pub fn simulate(args: &SimulateArgs) -> anyhow::Result<()> {
    let simulator = find_structure(&args.structure)?;
    anyhow::ensure!(args.measurements > 0, "--measurements is 0: at least 1 is needed");
    anyhow::ensure!(args.noise >= 0.0 && args.noise.is_finite(), "--noise is {}: it must be 0 or above", args.noise);
    let population = Population::new(simulator.space(), &args.parameters)?;
    let drawn = population.draw(&simulator, args.measurements, args.noise, args.seed)?;
    let start = Timestamp::parse(&args.start).context("--start")?;
    let rows: Vec<Vec<f64>> = drawn.frequencies_hz.row_iter().map(|row| row.iter().copied().collect()).collect();
    let measurements = at_intervals(&rows, start, args.interval_s, None)?;
    let text = csv_output::write(&measurements);
    match &args.out {
        Some(path) => write_whole(path, text.as_bytes())?,
        None => print!("{text}"),
    }
    Ok(())
}
