//! `modalwatch simulate`: simulated measurements, as a table or JSON that the service accepts; with seasons, trends, losses, missing
//! modes and outliers for a rehearsal.

use std::collections::BTreeMap;
use std::path::PathBuf;

use clap::Args;

use super::output::write_whole;
use super::parameter::parameter_moments;
use super::rehearsal::{course, effect, loss, probability, seconds, time, trend, EffectFlag, LossFlag, TrendFlag};
use crate::baseline::library::find_structure;
use crate::measurement::{at_intervals, csv_output, ModalMeasurement};
use crate::quantity::{Hertz, Timestamp};
use crate::simulator::population::Population;
use crate::simulator::rehearsal::{Change, Course, Rehearsal};
use crate::simulator::Simulator;

const EXAMPLE: &str = "Example: a year of a tower, one measurement an hour, whose stiffness k1 falls by 0.2 % per °C and whose k2 loses 8 % in August:

  modalwatch simulate tower.toml --parameter k1=3e7,1e5 --from 2026-01-01 --days 360 --every 1h \\
      --covariate temperature_c=10,year=12,day=4,weather=3 --effect k1=-0.2%/temperature_c \\
      --loss k2=8% --from-date 2026-08-07 --missing 0.02 --outliers 0.005 --out year.csv

Declare the covariate in the structure file ([[covariate]] name = \"temperature_c\"), so that the service reads its column. Effects of
the structure file act as well.";

/// Simulate measurements of a structure.
#[derive(Debug, Args)]
#[command(after_help = EXAMPLE)]
pub struct SimulateArgs {
    /// Structure file (TOML or JSON), or the id of a shipped structure
    #[arg(value_name = "STRUCTURE", required_unless_present = "structure")]
    file: Option<String>,
    /// The same as a flag
    #[arg(long, conflicts_with = "file")]
    structure: Option<String>,
    /// Population of one parameter, as name=mean,std in its unit; once per parameter [default: the nominal value, without scatter]
    #[arg(long = "parameter", value_parser = parameter_moments)]
    parameters: Vec<(String, f64, f64)>,
    /// Number of measurements
    #[arg(long, default_value_t = 50, conflicts_with = "days")]
    measurements: usize,
    /// Number of days to simulate, instead of --measurements
    #[arg(long)]
    days: Option<f64>,
    /// Noise as a multiple of the structure's noise; 0 = no noise
    #[arg(long, default_value_t = 1.0)]
    noise: f64,
    /// Seed of all random numbers
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Time of the first measurement: a date (midnight in UTC) or RFC 3339
    #[arg(long, visible_alias = "from", default_value = "2026-01-01T00:00:00Z", value_parser = time)]
    start: Timestamp,
    /// Time between measurements, with its unit: 30s, 10m, 1h, 1d
    #[arg(long, default_value = "10m", value_parser = seconds)]
    every: f64,
    /// The same in seconds
    #[arg(long, conflicts_with = "every")]
    interval_s: Option<u32>,
    /// Course of a covariate: name=MEAN,year=AMPLITUDE,day=AMPLITUDE,weather=STD,lasting=3d, all but the mean optional. It is warmest in
    /// July and at 15:00 UTC; the weather is normal and its correlation falls to 1/e after the time `lasting`. Or name=A|B: categories at
    /// random. Once per covariate
    #[arg(long = "covariate", visible_alias = "season", value_name = "NAME=COURSE", value_parser = course)]
    covariates: Vec<(String, Course)>,
    /// Relative change of a parameter per unit of a covariate above its mean: k1=-0.2%/temperature_c; may be repeated
    #[arg(long = "effect", value_name = "NAME=SHARE/COVARIATE", value_parser = effect, allow_hyphen_values = true)]
    effects: Vec<EffectFlag>,
    /// Trend of a parameter: k1=-1%/month (or day, year), relative to its value at the start; may be repeated
    #[arg(long = "trend", value_name = "NAME=SHARE/TIME", value_parser = trend)]
    trends: Vec<TrendFlag>,
    /// Loss of a parameter: k2=8% from --from-date on, or k2=8%@2026-08-07; may be repeated
    #[arg(long = "loss", value_name = "NAME=SHARE", value_parser = loss)]
    losses: Vec<LossFlag>,
    /// Date of the losses that state none
    #[arg(long, value_name = "DATE", value_parser = time, requires = "losses")]
    from_date: Option<Timestamp>,
    /// Probability that a mode is not identified in a measurement
    #[arg(long, default_value_t = 0.0, value_parser = probability)]
    missing: f64,
    /// Probability that the frequency of a mode is an outlier
    #[arg(long, default_value_t = 0.0, value_parser = probability)]
    outliers: f64,
    /// Standard deviation of an outlier, as a share of the frequency
    #[arg(long, default_value_t = 0.05, value_parser = probability)]
    outlier_std: f64,
    /// Write JSON, the body of POST /v1/structures/{id}/batches, instead of CSV
    #[arg(long)]
    json: bool,
    /// File to write [default: standard output]
    #[arg(long)]
    out: Option<PathBuf>,
}

/// Draws parameters from the population, simulates the measurements and writes them.
///
/// # Errors
/// A structure, population or course that is refused, a file that cannot be written.
pub fn simulate(args: &SimulateArgs) -> anyhow::Result<()> {
    let structure = args.file.as_ref().or(args.structure.as_ref()).expect("clap requires one of them");
    let simulator = find_structure(structure)?;
    anyhow::ensure!(args.noise >= 0.0 && args.noise.is_finite(), "--noise is {}: it must be 0 or above", args.noise);
    let interval_s = args.interval_s.map_or(args.every, f64::from);
    let count = count(args, interval_s)?;
    let population = population(&simulator, &args.parameters)?;
    let still =
        args.covariates.is_empty() && args.effects.is_empty() && args.trends.is_empty() && args.losses.is_empty();
    let rehearsed = !still || args.missing > 0.0 || args.outliers > 0.0;
    let measurements = if rehearsed {
        rehearse(args, &simulator, &population, (count, interval_s))?
    } else {
        anyhow::ensure!(
            interval_s.fract() == 0.0 && interval_s <= f64::from(u32::MAX),
            "--every must be whole seconds"
        );
        draw(args, &simulator, &population, (count, interval_s as u32))?
    };
    let text = if args.json {
        serde_json::json!({ "source": "simulation", "measurements": measurements }).to_string() + "\n"
    } else {
        csv_output::write(&measurements)
    };
    match &args.out {
        Some(path) => write_whole(path, text.as_bytes())?,
        None => print!("{text}"),
    }
    Ok(())
}

/// Number of measurements.
fn count(args: &SimulateArgs, interval_s: f64) -> anyhow::Result<usize> {
    const MOST: f64 = 10_000_000.0;
    let Some(days) = args.days else {
        anyhow::ensure!(args.measurements > 0, "--measurements is 0: at least 1 is needed");
        return Ok(args.measurements);
    };
    let count = (days * 86_400.0 / interval_s).round();
    anyhow::ensure!(
        (1.0..=MOST).contains(&count),
        "{days} days with one measurement every {interval_s} s are {count} measurements: at least 1 and at most {MOST} are possible"
    );
    Ok(count as usize)
}

/// The population of the flags. A parameter that is not given has its nominal value, which is said.
fn population(simulator: &Simulator, given: &[(String, f64, f64)]) -> anyhow::Result<Population> {
    let mut moments = given.to_vec();
    let mut assumed = Vec::new();
    for (parameter, nominal) in simulator.space().iter().zip(simulator.nominal_parameters()) {
        if !given.iter().any(|(name, ..)| *name == parameter.name) {
            assumed.push(format!("{} = {nominal} {}", parameter.name, parameter.unit));
            moments.push((parameter.name.clone(), nominal, 0.0));
        }
    }
    if !assumed.is_empty() {
        eprintln!("note: nominal values, without scatter, of what --parameter does not give: {}", assumed.join(", "));
    }
    Ok(Population::new(simulator.space(), &moments)?)
}

/// Measurements of one state.
fn draw(
    args: &SimulateArgs,
    simulator: &Simulator,
    population: &Population,
    (count, interval_s): (usize, u32),
) -> anyhow::Result<Vec<ModalMeasurement>> {
    let drawn = population.draw(simulator, count, args.noise, args.seed)?;
    let rows: Vec<Vec<f64>> = drawn.frequencies_hz.row_iter().map(|row| row.iter().copied().collect()).collect();
    let mut measurements = at_intervals(&rows, args.start, interval_s, None)?;
    let theta: Vec<Vec<f64>> = drawn.theta.row_iter().map(|row| row.iter().copied().collect()).collect();
    let discrepancy = simulator.draw_discrepancy(&theta, args.seed)?;
    for (measurement, ((covariates, settings), factors)) in measurements.iter_mut().zip(discrepancy) {
        for (frequency, factor) in measurement.frequencies_hz.iter_mut().zip(factors) {
            *frequency = frequency.map(|f| Hertz::new(f.get() * factor)).transpose()?;
        }
        (measurement.covariates, measurement.settings) = (covariates, settings);
    }
    Ok(measurements)
}

/// Measurements over seasons, with what happens to the structure meanwhile.
fn rehearse(
    args: &SimulateArgs,
    simulator: &Simulator,
    population: &Population,
    (count, interval_s): (usize, f64),
) -> anyhow::Result<Vec<ModalMeasurement>> {
    let at =
        |index: usize| Timestamp::from_micros(args.start.micros() + (index as f64 * interval_s * 1e6).round() as i64);
    let times = (0..count).map(at).collect::<Result<Vec<_>, _>>()?;
    let last = times[times.len() - 1];
    for (name, _) in &args.covariates {
        if !simulator.covariates().iter().any(|c| c.name == *name) {
            eprintln!(
                "note: the structure file does not declare the covariate {name}: the service and the commands refuse its column until \
                 [[covariate]] name = \"{name}\" stands there"
            );
        }
    }
    let changes = changes(args, simulator, last)?;
    let covariates: BTreeMap<String, Course> = args.covariates.iter().cloned().collect();
    anyhow::ensure!(covariates.len() == args.covariates.len(), "a covariate is given twice with --covariate");
    let rehearsal = Rehearsal {
        covariates,
        changes,
        noise_multiple: args.noise,
        missing: args.missing,
        outliers: args.outliers,
        outlier_std: args.outlier_std,
    };
    let found = rehearsal.run(simulator, population, &times, args.seed)?;
    if found.without_modes > 0 {
        eprintln!("note: {} measurements have no mode at all and are left out", found.without_modes);
    }
    if found.beyond_effects > 0 {
        eprintln!(
            "note: in {} measurements a covariate lies outside the range that an effect of the structure was learned from",
            found.beyond_effects
        );
    }
    anyhow::ensure!(!found.measurements.is_empty(), "no measurement has a mode: lower --missing");
    Ok(found.measurements)
}

/// The changes of the parameters, whose names and dates are checked.
fn changes(args: &SimulateArgs, simulator: &Simulator, last: Timestamp) -> anyhow::Result<Vec<Change>> {
    let column = |flag: &str, name: &str| {
        let known = || simulator.space().iter().map(|p| p.name.as_str()).collect::<Vec<_>>().join(", ");
        let found = simulator.space().position(name);
        found
            .ok_or_else(|| anyhow::anyhow!("{flag} {name}: there is no such parameter; the parameters are {}", known()))
    };
    let mut changes = Vec::new();
    for EffectFlag { parameter, share_per_unit, covariate } in &args.effects {
        let (parameter, share_per_unit, covariate) =
            (column("--effect", parameter)?, *share_per_unit, covariate.clone());
        changes.push(Change::Covariate { parameter, covariate, share_per_unit });
    }
    for TrendFlag { parameter, share_per_day } in &args.trends {
        changes.push(Change::Trend { parameter: column("--trend", parameter)?, share_per_day: *share_per_day });
    }
    for LossFlag { parameter: name, share, from } in &args.losses {
        let from = from.or(args.from_date);
        let from = from.ok_or_else(|| {
            anyhow::anyhow!(
                "--loss {name}: its date is missing; give --from-date 2026-08-07, or write {name}=8%@2026-08-07"
            )
        })?;
        anyhow::ensure!(
            from <= last,
            "--loss {name}: its date {from} is after the last measurement, {last}: give an earlier date or more --days"
        );
        changes.push(Change::Loss { parameter: column("--loss", name)?, share: *share, from });
    }
    Ok(changes)
}
