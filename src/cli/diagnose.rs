//! `modalwatch diagnose`: what the simulation gets wrong, from a structure file and measurements.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};

use super::write_whole;
use crate::baseline::library::find_structure;
use crate::baseline::observation::DEFAULT_NOISE_RANGE;
use crate::discrepancy::data::{Data, MOST_LEVELS};
use crate::discrepancy::extend::extend as extend_structure;
use crate::discrepancy::{diagnose as run, report, Diagnosis, Holdout, Outcome, Step};
use crate::flow::train::TrainSettings;
use crate::flow::FlowSettings;
use crate::measurement::check::{check_measurements, Expectation, RawMeasurement};
use crate::measurement::csv::{self, CsvOptions, Offered, Times};
use crate::measurement::{Covariate, CovariateKind, ModalMeasurement};
use crate::quantity::Timestamp;
use crate::simulator::Simulator;

/// What is diagnosed.
#[derive(Debug, Args)]
pub struct StudyArgs {
    /// Structure file (TOML or JSON), or the id of a shipped structure
    #[arg(long)]
    structure: String,
    /// CSV of measurements; several are taken as one after another
    #[arg(long, required = true)]
    data: Vec<PathBuf>,
    /// Rows kept for measuring the gain: last:SHARE, or where:COLUMN=CATEGORY
    #[arg(long, default_value = "last:0.25")]
    holdout: Holdout,
    /// Column of the time [default: measured_at, or the order of the rows]
    #[arg(long)]
    time: Option<String>,
    /// Columns that hold settings: PARAMETER=COLUMN, separated by commas; set_<parameter> is known without
    #[arg(long, value_delimiter = ',')]
    settings: Vec<String>,
    /// Columns that are not read, separated by commas
    #[arg(long, value_delimiter = ',')]
    ignore: Vec<String>,
    /// Seed of the bootstrap
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

/// Find what the simulation gets wrong.
#[derive(Debug, Args)]
pub struct DiagnoseArgs {
    #[command(flatten)]
    study: StudyArgs,
    /// Write the report as one HTML page
    #[arg(long)]
    report: Option<PathBuf>,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// Measurements of tables, and what had to be guessed about them.
pub struct Tables {
    /// All rows.
    pub measurements: Vec<ModalMeasurement>,
    /// Covariates, declared or guessed.
    pub covariates: Vec<Covariate>,
    /// What was guessed, for people.
    pub notes: Vec<String>,
    /// Whether the tables have times; without, the order of the rows stands for them.
    pub timed: bool,
}

/// How tables are read.
#[derive(Debug, Clone, Default)]
pub struct TableArgs<'a> {
    /// Column of the time.
    pub time: Option<&'a str>,
    /// `PARAMETER=COLUMN`.
    pub settings: &'a [String],
    /// Columns that are not read.
    pub ignore: &'a [String],
}

/// Diagnoses, prints, and writes the report.
///
/// # Errors
/// Files that are refused, data that no verdict can stand on.
pub fn diagnose(args: &DiagnoseArgs) -> anyhow::Result<()> {
    let Study { simulator, data, outcome } = studied(&args.study)?;
    if let Some(path) = &args.report {
        let html = report::html(&simulator, &data, &outcome).context("the report cannot be drawn")?;
        write_whole(path, html.as_bytes())?;
    }
    if args.json {
        println!("{}", serde_json::to_string_pretty(&outcome.diagnosis)?);
    } else {
        print(&outcome.diagnosis);
        if let Some(path) = &args.report {
            println!("report: {}", path.display());
        }
    }
    Ok(())
}

struct Study {
    simulator: Simulator,
    data: Data,
    outcome: Outcome,
}

fn studied(args: &StudyArgs) -> anyhow::Result<Study> {
    let simulator = find_structure(&args.structure)?;
    let how = TableArgs { time: args.time.as_deref(), settings: &args.settings, ignore: &args.ignore };
    let tables = read_tables(&simulator, &args.data, &how)?;
    let data = Data::new(&simulator, &tables.measurements);
    let data = if tables.timed { data } else { data.by_order() };
    let bar = ProgressBar::new_spinner();
    let style = ProgressStyle::with_template("{spinner} {elapsed} {msg}");
    bar.set_style(style.context("the template of the progress bar")?);
    bar.enable_steady_tick(std::time::Duration::from_millis(100));
    let progress = |step: Step| bar.set_message(step.to_string());
    let mut outcome = run(&simulator, &data, &args.holdout, args.seed, &progress)?;
    bar.finish_and_clear();
    outcome.diagnosis.notes.splice(0..0, tables.notes);
    Ok(Study { simulator, data, outcome })
}

/// Diagnose, write the causes into a new version of the structure, and train its baseline.
#[derive(Debug, Args)]
pub struct ExtendArgs {
    #[command(flatten)]
    study: StudyArgs,
    /// Folder for structure.json, baseline.safetensors and baseline.json
    #[arg(long)]
    out: PathBuf,
    /// Write the structure only; train later with `modalwatch train`
    #[arg(long)]
    no_training: bool,
    /// Simulated training samples [default: as `modalwatch train`]
    #[arg(long)]
    samples: Option<usize>,
    /// Passes over the training samples [default: as `modalwatch train`]
    #[arg(long)]
    epochs: Option<usize>,
    /// Write the report of the diagnosis as one HTML page
    #[arg(long)]
    report: Option<PathBuf>,
}

/// Diagnoses, extends and trains.
///
/// # Errors
/// As [`diagnose`]; nothing to extend with; a training that gives no flow.
pub fn extend(args: &ExtendArgs) -> anyhow::Result<()> {
    let Study { simulator, data, outcome } = studied(&args.study)?;
    println!("{}", outcome.diagnosis.summary);
    if let Some(path) = &args.report {
        let html = report::html(&simulator, &data, &outcome).context("the report cannot be drawn")?;
        write_whole(path, html.as_bytes())?;
    }
    let extended = extend_structure(&simulator, &data, &outcome)?;
    for added in &extended.added {
        println!("added: {added}");
    }
    for left in &extended.left_out {
        println!("not added: {left}");
    }
    let text = serde_json::to_string_pretty(&extended.definition)?;
    write_whole(&args.out.join("structure.json"), format!("{text}\n").as_bytes())?;
    println!("structure: {}", args.out.join("structure.json").display());
    if args.no_training {
        return Ok(());
    }
    let simulator = Simulator::new(extended.definition)?;
    let (samples, epochs) = super::train::sizes(&simulator, args.samples, args.epochs);
    let settings = TrainSettings { epochs, seed: args.study.seed, ..TrainSettings::default() };
    let flow = FlowSettings::default();
    let trained = super::train::train_into(&args.out, &simulator, samples, DEFAULT_NOISE_RANGE, &flow, &settings)?;
    super::train::print_record(trained.baseline.manifest());
    Ok(())
}

fn print(d: &Diagnosis) {
    println!("{}", d.summary);
    println!();
    for cause in &d.causes {
        println!("cause ({:?}, probability {:.3}): {}", cause.class, cause.probability, cause.sentence);
        for n in &cause.parameters {
            println!(
                "    {:>24} {:>12.5} ({:.5} … {:.5}) {}",
                n.name, n.value, n.interval90[0], n.interval90[1], n.unit
            );
        }
    }
    for a in d.alternatives.iter().take(5) {
        println!(
            "instead of {}: {} ({:+.1} nats); told apart by {}",
            a.instead_of, a.cause.sentence, a.log_evidence_difference, a.told_apart_by
        );
    }
    for m in d.misfit.iter().take(8) {
        let what = m.mode.map_or_else(|| m.parameter.clone().unwrap_or_default(), |mode| format!("mode {mode}"));
        let covariate = m.covariate.as_deref().unwrap_or("constant");
        println!("misfit: {what} with {covariate}: {:.3} %, p = {:.1e}", m.size_percent, m.p_value);
    }
    if let Some(r) = &d.remainder {
        println!("left unexplained: {} (p = {:.1e})", r.function, r.p_value);
    }
    if let Some(g) = &d.gain {
        println!("on {} rows held out:            before      after", g.holdout_rows);
        for (mode, (a, b)) in g.rms_error_percent.before.iter().zip(&g.rms_error_percent.after).enumerate() {
            println!("  error of mode {:<2} (%)        {a:>10.4} {b:>10.4}", mode + 1);
        }
        let l = &g.log_density_per_row;
        println!(
            "  log density a row (nats)   {:>10.3} {:>10.3}   gain {:.3} ± {:.3}",
            l.before, l.after, l.difference, l.standard_error
        );
        println!("  inside 90 % intervals      {:>10.3} {:>10.3}", g.coverage90.before, g.coverage90.after);
        let f = &g.false_alarms_per_1000;
        println!("  false alarms per 1000      {:>10.0} {:>10.0}", f.before, f.after);
        let s = &g.smallest_detectable_loss_percent;
        println!("  smallest detectable loss % {:>10.1} {:>10.1}", s.before, s.after);
    }
    for note in &d.notes {
        println!("note: {note}");
    }
}

/// Reads tables of one structure; columns that it does not declare become covariates.
///
/// # Errors
/// A table that is refused, with line and column.
pub fn read_tables(simulator: &Simulator, paths: &[PathBuf], how: &TableArgs<'_>) -> anyhow::Result<Tables> {
    let mut tables = Tables {
        measurements: Vec::new(),
        covariates: simulator.covariates().to_vec(),
        notes: Vec::new(),
        timed: false,
    };
    let mut texts: Vec<(&Path, Vec<u8>)> = Vec::new();
    for path in paths {
        let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
        texts.push((path, renamed(bytes, how.settings)?));
    }
    let mut options =
        CsvOptions { times: Times::RowNumber, ignore: how.ignore.to_vec(), time_column: how.time.map(str::to_owned) };
    let refused = |path: &Path, problems: Vec<crate::measurement::check::Problem>| {
        let lines: Vec<String> = problems.iter().map(|p| format!("  {}: {}", p.pointer, p.message)).collect();
        anyhow::anyhow!("{} is refused:\n{}", path.display(), lines.join("\n"))
    };
    for (path, bytes) in &texts {
        let offers = csv::offered(bytes, &tables.covariates, &options, MOST_LEVELS).map_err(|p| refused(path, p))?;
        for offer in offers {
            match offer {
                Offered::Covariate(covariate) => {
                    let kind = if covariate.kind == CovariateKind::Number { "a number" } else { "a category" };
                    tables
                        .notes
                        .push(format!("column {} is not declared: taken as a covariate, {kind}", covariate.name));
                    tables.covariates.push(covariate);
                }
                Offered::Ignored { name, values } => {
                    let more = if values > MOST_LEVELS { "more than" } else { "" };
                    tables.notes.push(format!(
                        "column {name} is text with {more} {MOST_LEVELS} different values: not taken as a covariate"
                    ));
                    options.ignore.push(name);
                }
            }
        }
    }
    let expectation =
        Expectation { covariates: &tables.covariates, ..simulator.expectation(Timestamp::now(), usize::MAX) };
    let mut times = BTreeSet::new();
    let (mut empty, mut local, mut moved, mut earlier_rows) = (0, 0, 0, 0_i64);
    let mut all = Vec::new();
    for (path, bytes) in &texts {
        let mut raw =
            csv::read(bytes, simulator.modes(), &tables.covariates, &options).map_err(|p| refused(path, p))?;
        let rows = raw.len();
        if let Some(column) = how.time.filter(|_| raw.iter().all(|r| r.measured_at.is_none() || untimed(r))) {
            anyhow::bail!("{} has no column {column}, which --time names", path.display());
        }
        // Tables without times follow one another.
        for row in raw.iter_mut().filter(|row| untimed(row)) {
            let time = row.measured_at.as_deref().and_then(|text| Timestamp::parse(text).ok());
            let later = time.and_then(|t| Timestamp::from_micros(t.micros() + earlier_rows * 1_000_000).ok());
            row.measured_at = later.map(|t| t.to_string());
        }
        earlier_rows += rows as i64;
        tables.timed |= raw.iter().any(|r| !untimed(r));
        raw.retain(|r| r.frequencies_hz.iter().any(Option::is_some));
        empty += rows - raw.len();
        for row in &mut raw {
            let (was_local, was_moved) = settle_time(row, &mut times);
            local += usize::from(was_local);
            moved += usize::from(was_moved);
        }
        if raw.is_empty() {
            continue;
        }
        all.extend(check_measurements(raw, &expectation).map_err(|p| refused(path, p))?);
    }
    anyhow::ensure!(!all.is_empty(), "no measurements in {} tables", texts.len());
    if empty > 0 {
        tables.notes.push(format!("{empty} rows without any frequency were left out"));
    }
    if local > 0 {
        tables.notes.push(format!("{local} times have no offset: taken as UTC"));
    }
    if moved > 0 && how.time.is_some() {
        tables.notes.push(format!("{moved} times were there already: each moved by a microsecond"));
    }
    tables.measurements = all;
    Ok(tables)
}

/// Whether a row has the number of its row for its time.
fn untimed(row: &RawMeasurement) -> bool {
    row.measured_at.as_deref().is_some_and(|time| time.starts_with("1970-"))
}

/// A time without an offset is UTC; one that was there already moves on by microseconds.
fn settle_time(row: &mut RawMeasurement, times: &mut BTreeSet<i64>) -> (bool, bool) {
    let Some(text) = &row.measured_at else { return (false, false) };
    let exact = Timestamp::parse(text).map(|time| (time, false));
    let local = |_| Timestamp::parse(&format!("{}Z", text.trim().replace(' ', "T"))).map(|time| (time, true));
    // The check names a mistake with its line.
    let Ok((time, local)) = exact.or_else(local) else { return (false, false) };
    let mut micros = time.micros();
    while !times.insert(micros) {
        micros += 1;
    }
    let moved = micros != time.micros();
    if let Ok(time) = Timestamp::from_micros(micros) {
        row.measured_at = Some(time.to_string());
    }
    (local, moved)
}

/// The table with the columns of settings named as such.
fn renamed(bytes: Vec<u8>, settings: &[String]) -> anyhow::Result<Vec<u8>> {
    if settings.is_empty() {
        return Ok(bytes);
    }
    let text = String::from_utf8(bytes).context("not UTF-8: save the table as UTF-8")?;
    let (mut header, rest) = {
        let (header, rest) = text.split_once('\n').unwrap_or((&text, ""));
        (header.to_owned(), rest.to_owned())
    };
    for setting in settings {
        let (parameter, column) =
            setting.split_once('=').with_context(|| format!("{setting:?} should read PARAMETER=COLUMN"))?;
        let separator = |c: char| matches!(c, ',' | ';' | '\t');
        let mut found = false;
        let mut renamed = String::new();
        for piece in header.split_inclusive(separator) {
            let name = piece.trim_end_matches(separator);
            if name.trim().trim_matches('"') == column {
                found = true;
                renamed.push_str(&piece.replacen(name.trim(), &format!("set_{parameter}"), 1));
            } else {
                renamed.push_str(piece);
            }
        }
        anyhow::ensure!(found, "--settings names the column {column}, which the table does not have");
        header = renamed;
    }
    Ok(format!("{header}\n{rest}").into_bytes())
}
