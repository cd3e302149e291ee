//! `modalwatch diagnose` and `modalwatch extend`: the effects that a simulation lacks, from a structure file and measurements.

use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

use anyhow::Context as _;
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};

use super::model::present_model;
use super::output::write_whole;
use super::training::{print_record, train_extension_into};
use crate::baseline::extension::ExtensionPlan;
use crate::baseline::library::find_structure;
use crate::discrepancy::data::{Data, MOST_LEVELS};
use crate::discrepancy::extend::extend as extend_structure;
use crate::discrepancy::{diagnose as run, report, Diagnosis, Holdout, Outcome, Step};
use crate::measurement::check::{check_measurements, Expectation, Problem, RawMeasurement};
use crate::measurement::csv::{self, CsvOptions, Offered, Times};
use crate::measurement::{Covariate, CovariateKind, ModalMeasurement};
use crate::quantity::Timestamp;
use crate::simulator::Simulator;

/// The structure and the data of a diagnosis.
#[derive(Debug, Args)]
pub struct StudyArgs {
    /// Structure file (TOML or JSON), or the id of a shipped structure
    #[arg(long)]
    structure: String,
    /// CSV file of measurements; several files are joined in the order given
    #[arg(long, required = true)]
    data: Vec<PathBuf>,
    /// Rows held out for measuring the gain: last:SHARE, or where:COLUMN=CATEGORY
    #[arg(long, default_value = "last:0.25")]
    holdout: Holdout,
    /// Column that holds the time [default: measured_at, or the order of the rows]
    #[arg(long)]
    time: Option<String>,
    /// Columns that hold settings: PARAMETER=COLUMN, separated by commas; columns named set_<parameter> are recognised without it
    #[arg(long, value_delimiter = ',')]
    settings: Vec<String>,
    /// Columns to ignore, separated by commas
    #[arg(long, value_delimiter = ',')]
    ignore: Vec<String>,
    /// Seed of the bootstrap
    #[arg(long, default_value_t = 1)]
    seed: u64,
}

/// Find the effects that a simulation lacks.
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

/// Measurements read from tables.
pub struct Tables {
    /// All rows.
    pub measurements: Vec<ModalMeasurement>,
    /// Covariates, those of the structure first, then those found in the tables.
    pub covariates: Vec<Covariate>,
    /// The assumptions made in reading the tables, as text.
    pub notes: Vec<String>,
    /// Whether the tables have times; if not, the order of the rows is used.
    pub timed: bool,
}

/// Options for reading tables.
#[derive(Debug, Clone, Default)]
pub struct TableArgs<'a> {
    /// Column that holds the time.
    pub time: Option<&'a str>,
    /// `PARAMETER=COLUMN`.
    pub settings: &'a [String],
    /// Columns to ignore.
    pub ignore: &'a [String],
}

/// Diagnoses, prints the result and writes the report.
///
/// # Errors
/// Invalid files, or data that do not allow a diagnosis.
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

/// A diagnosis with what it was made from.
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

/// Diagnose, add the causes to a new version of the structure, and train its model.
#[derive(Debug, Args)]
pub struct ExtendArgs {
    #[command(flatten)]
    study: StudyArgs,
    /// Folder for structure.json, baseline.safetensors and baseline.json
    #[arg(long)]
    out: PathBuf,
    /// Only write the structure; its model can be trained later with `modalwatch train`
    #[arg(long)]
    no_training: bool,
    /// Trained model of the structure, from whose weights the training starts: its .safetensors file, with its .json beside it
    /// [default: the one in the folder of the structure file, or the shipped one]
    #[arg(long, conflicts_with = "from_scratch")]
    model: Option<PathBuf>,
    /// Start the training from random weights
    #[arg(long)]
    from_scratch: bool,
    /// Number of simulated training samples [default: as for the model that the training starts from; without one, as for
    /// `modalwatch train`]
    #[arg(long)]
    samples: Option<usize>,
    /// Number of passes over the training samples [default: a quarter of those of the model that the training starts from; without
    /// one, as for `modalwatch train`]
    #[arg(long)]
    epochs: Option<usize>,
    /// Write the report of the diagnosis as one HTML page
    #[arg(long)]
    report: Option<PathBuf>,
}

/// Diagnoses, extends the structure and trains its model.
///
/// # Errors
/// As [`diagnose`]; there is no cause to add; the training fails.
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
    let extension = Simulator::new(extended.definition)?;
    let parent = present_model(&args.study.structure, &simulator, args.model.as_deref())?;
    let plan = ExtensionPlan {
        parent: parent.as_deref(),
        from_scratch: args.from_scratch,
        samples: args.samples,
        epochs: args.epochs,
        seed: args.study.seed,
    };
    let trained = train_extension_into(&args.out, &extension, &plan)?;
    print_record(trained.baseline.manifest());
    Ok(())
}

fn print(d: &Diagnosis) {
    println!("{}", d.summary);
    println!();
    for cause in &d.causes {
        println!("cause ({:?}, probability {:.3}): {}", cause.class, cause.probability, cause.sentence);
        for n in &cause.parameters {
            let name = if n.name == "swing" { "effect range" } else { &n.name };
            println!("    {name:>24} {:>12.5} ({:.5} … {:.5}) {}", n.value, n.interval90[0], n.interval90[1], n.unit);
        }
    }
    for a in d.alternatives.iter().take(5) {
        println!(
            "instead of cause {}: {} ({:+.1} nats); distinguished by {}",
            a.instead_of, a.cause.sentence, a.log_evidence_difference, a.discriminating_measurement
        );
    }
    for m in d.misfit.iter().take(8) {
        let what = m.mode.map_or_else(|| m.parameter.clone().unwrap_or_default(), |mode| format!("mode {mode}"));
        let covariate = m.covariate.as_ref().map_or_else(|| "constant".to_owned(), |c| format!("depends on {c}"));
        println!("misfit: {what}, {covariate}: {:.3} %, p = {:.1e}", m.size_percent, m.p_value);
    }
    if let Some(r) = &d.remainder {
        println!("unexplained: residuals depend on {} (p = {:.1e})", r.function, r.p_value);
    }
    if let Some(g) = &d.gain {
        println!("on {} rows held out:            before      after", g.holdout_rows);
        for (mode, (a, b)) in g.rms_error_percent.before.iter().zip(&g.rms_error_percent.after).enumerate() {
            println!("  error of mode {:<2} (%)        {a:>10.4} {b:>10.4}", mode + 1);
        }
        let l = &g.log_density_per_row;
        println!(
            "  log density per row (nats) {:>10.3} {:>10.3}   gain {:.3} ± {:.3}",
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

/// A table that has been read into memory.
type Table<'a> = (&'a Path, Vec<u8>);

/// Reads tables of one structure. Columns that the structure does not declare become covariates.
///
/// # Errors
/// An invalid table, with line and column.
pub fn read_tables(simulator: &Simulator, paths: &[PathBuf], how: &TableArgs<'_>) -> anyhow::Result<Tables> {
    let mut files: Vec<Table<'_>> = Vec::new();
    for path in paths {
        let bytes = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
        files.push((path, renamed(bytes, how.settings)?));
    }
    let mut options =
        CsvOptions { times: Times::RowNumber, ignore: how.ignore.to_vec(), time_column: how.time.map(str::to_owned) };
    let mut covariates = simulator.covariates().to_vec();
    let mut notes = Vec::new();
    for file in &files {
        notes.extend(add_covariates(file, &mut covariates, &mut options)?);
    }
    let mut tables = Tables { measurements: Vec::new(), covariates, notes, timed: false };
    read_rows(simulator, &files, &options, how.time, &mut tables)?;
    anyhow::ensure!(!tables.measurements.is_empty(), "the {} tables hold no measurements", files.len());
    Ok(tables)
}

fn refused(path: &Path, problems: &[Problem]) -> anyhow::Error {
    let lines: Vec<String> = problems.iter().map(|p| format!("  {}: {}", p.pointer, p.message)).collect();
    anyhow::anyhow!("{} is invalid:\n{}", path.display(), lines.join("\n"))
}

/// Adds the undeclared columns of a table to the covariates, or to the ignored columns; returns a note for each.
fn add_covariates(
    (path, bytes): &Table<'_>,
    covariates: &mut Vec<Covariate>,
    options: &mut CsvOptions,
) -> anyhow::Result<Vec<String>> {
    let offers = csv::offered(bytes, covariates, options, MOST_LEVELS).map_err(|p| refused(path, &p))?;
    let mut notes = Vec::new();
    for offer in offers {
        match offer {
            Offered::Covariate(covariate) => {
                let kind = if covariate.kind == CovariateKind::Number { "numeric" } else { "categorical" };
                notes.push(format!("column {} is not declared: it is used as a {kind} covariate", covariate.name));
                covariates.push(covariate);
            }
            Offered::Ignored { name, values } => {
                let more = if values > MOST_LEVELS { "more than " } else { "" };
                notes.push(format!(
                    "column {name} is text with {more}{MOST_LEVELS} different values: it is not used as a covariate"
                ));
                options.ignore.push(name);
            }
        }
    }
    Ok(notes)
}

/// Reads the measurements of all files into `tables`, and notes how times and empty rows were handled.
fn read_rows(
    simulator: &Simulator,
    files: &[Table<'_>],
    options: &CsvOptions,
    time_column: Option<&str>,
    tables: &mut Tables,
) -> anyhow::Result<()> {
    let expectation =
        Expectation { covariates: &tables.covariates, ..simulator.expectation(Timestamp::now(), usize::MAX) };
    let mut times = BTreeSet::new();
    let (mut empty, mut local, mut moved, mut earlier_rows) = (0, 0, 0, 0_i64);
    for (path, bytes) in files {
        let mut raw =
            csv::read(bytes, simulator.modes(), &tables.covariates, options).map_err(|p| refused(path, &p))?;
        let rows = raw.len();
        if let Some(column) = time_column.filter(|_| raw.iter().all(|r| r.measured_at.is_none() || untimed(r))) {
            anyhow::bail!("{} has no column {column}, which --time requires", path.display());
        }
        // The rows of a table without times follow those of the tables before it.
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
        if !raw.is_empty() {
            tables.measurements.extend(check_measurements(raw, &expectation).map_err(|p| refused(path, &p))?);
        }
    }
    if empty > 0 {
        tables.notes.push(format!("{empty} rows without any frequency were ignored"));
    }
    if local > 0 {
        tables.notes.push(format!("{local} times have no offset and are read as UTC"));
    }
    if moved > 0 && time_column.is_some() {
        tables.notes.push(format!("{moved} times occurred before: each was moved by microseconds"));
    }
    Ok(())
}

/// Whether the time of a row is only a placeholder for its number, because the table has no times.
fn untimed(row: &RawMeasurement) -> bool {
    row.measured_at.as_deref().is_some_and(|time| time.starts_with("1970-"))
}

/// Reads a time without an offset as UTC, and moves a time that occurred before by microseconds; returns whether each was done.
fn settle_time(row: &mut RawMeasurement, times: &mut BTreeSet<i64>) -> (bool, bool) {
    let Some(text) = &row.measured_at else { return (false, false) };
    let exact = Timestamp::parse(text).map(|time| (time, false));
    let local = |_| Timestamp::parse(&format!("{}Z", text.trim().replace(' ', "T"))).map(|time| (time, true));
    // An invalid time is reported with its line when the measurements are checked.
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

/// The table with the columns of settings renamed to `set_<parameter>`.
fn renamed(bytes: Vec<u8>, settings: &[String]) -> anyhow::Result<Vec<u8>> {
    if settings.is_empty() {
        return Ok(bytes);
    }
    let text = String::from_utf8(bytes).context("the table is not UTF-8: save it as UTF-8")?;
    let (mut header, rest) = {
        let (header, rest) = text.split_once('\n').unwrap_or((&text, ""));
        (header.to_owned(), rest.to_owned())
    };
    for setting in settings {
        let (parameter, column) =
            setting.split_once('=').with_context(|| format!("{setting:?} must read PARAMETER=COLUMN"))?;
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
