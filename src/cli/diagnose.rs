//! `modalwatch diagnose` and `modalwatch extend`: the effects that a simulation lacks, from a structure file and measurements.

use std::path::PathBuf;

use anyhow::Context as _;
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};

use super::model::present_model;
use super::next::join;
use super::output::write_whole;
use super::tables::{read_tables, TableArgs, Tables};
use super::training::{print_record, refuse_overconfident, train_extension_into};
use crate::baseline::extension::ExtensionPlan;
use crate::baseline::library::find_structure;
use crate::discrepancy::chance::{cases, times_less};
use crate::discrepancy::data::Data;
use crate::discrepancy::extend::extend as extend_structure;
use crate::discrepancy::gain::{Gain, GainMethod};
use crate::discrepancy::learned::extension::{extend_learned, offer_anyway};
use crate::discrepancy::{diagnose as run, report, Diagnosis, Holdout, Outcome, Step};
use crate::measurement::times::TimeUnit;
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
    /// Only rows from this time on: a day (2025-08-07, midnight in UTC) or RFC 3339
    #[arg(long, value_parser = Timestamp::parse_day_or_time, conflicts_with = "next")]
    from: Option<Timestamp>,
    /// Only rows before this time, in the same form
    #[arg(long, value_parser = Timestamp::parse_day_or_time, conflicts_with = "next")]
    to: Option<Timestamp>,
    /// Rows held out for measuring the gain: last:SHARE, since:DAY, or where:COLUMN=CATEGORY
    #[arg(long, default_value = "last:0.25")]
    holdout: Holdout,
    /// Column that holds the time: RFC 3339, or numbers, whose unit is found from the whole column [default: measured_at, or the
    /// order of the rows]
    #[arg(long)]
    time: Option<String>,
    /// Unit of times that are numbers: days, seconds, milliseconds, serial-days (of a spreadsheet) or decimal-year
    #[arg(long)]
    time_unit: Option<TimeUnit>,
    /// Columns that hold settings: PARAMETER=COLUMN, separated by commas; columns named set_<parameter> are recognised without it
    #[arg(long, value_delimiter = ',')]
    settings: Vec<String>,
    /// Columns to ignore, separated by commas
    #[arg(long, value_delimiter = ',')]
    ignore: Vec<String>,
    /// Result of an earlier diagnosis of the same data, as JSON, to be decided with the rows of --further
    #[arg(long, requires = "further")]
    next: Option<PathBuf>,
    /// CSV file of what was measured after the earlier diagnosis; several files are joined in the order given
    #[arg(long, requires = "next")]
    further: Vec<PathBuf>,
    /// Refuse a table in which a row cannot be used, instead of leaving the row out
    #[arg(long)]
    strict: bool,
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
    /// Learn a discrepancy from the covariates and settings, whatever the verdict
    #[arg(long)]
    learned: bool,
    /// Print the result as JSON
    #[arg(long)]
    json: bool,
}

/// Diagnoses, prints the result and writes the report.
///
/// # Errors
/// Invalid files, or data that do not allow a diagnosis.
pub fn diagnose(args: &DiagnoseArgs) -> anyhow::Result<()> {
    let Study { simulator, data, mut outcome } = studied(&args.study)?;
    if args.learned {
        offer_anyway(&simulator, &data, &mut outcome)?;
    }
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
    let how = TableArgs {
        time: args.time.as_deref(),
        time_unit: args.time_unit,
        settings: &args.settings,
        ignore: &args.ignore,
        strict: args.strict,
    };
    let (data, mut notes, earlier) = if let Some(path) = &args.next {
        let joined = join(&simulator, path, (&args.data, &args.further), &how)?;
        (joined.data, joined.notes, Some(joined.earlier))
    } else {
        let mut tables = read_tables(&simulator, &args.data, &how)?;
        restrict(&mut tables, args.from, args.to)?;
        let data = Data::new(&simulator, &tables.measurements);
        (if tables.timed { data } else { data.by_order() }, tables.notes, None)
    };
    let bar = ProgressBar::new_spinner();
    let style = ProgressStyle::with_template("{spinner} {elapsed} {msg}");
    bar.set_style(style.context("the template of the progress bar")?);
    bar.enable_steady_tick(std::time::Duration::from_millis(100));
    let progress = |step: Step| bar.set_message(step.to_string());
    let mut outcome = run(&simulator, &data, &args.holdout, args.seed, &progress)?;
    bar.finish_and_clear();
    if let Some(earlier) = earlier {
        notes.extend(outcome.diagnosis.changes_since(&earlier));
    }
    outcome.diagnosis.notes.splice(0..0, notes);
    Ok(Study { simulator, data, outcome })
}

/// Leaves out the rows outside a period, with a note.
fn restrict(tables: &mut Tables, from: Option<Timestamp>, to: Option<Timestamp>) -> anyhow::Result<()> {
    if from.is_none() && to.is_none() {
        return Ok(());
    }
    anyhow::ensure!(tables.timed, "--from and --to need a column with the time of each row; --time names it");
    if let (Some(from), Some(to)) = (from, to) {
        anyhow::ensure!(from < to, "--to {to} must be after --from {from}");
    }
    let all = tables.measurements.len();
    let within = |at: Timestamp| from.is_none_or(|from| at >= from) && to.is_none_or(|to| at < to);
    tables.measurements.retain(|measurement| within(measurement.measured_at));
    let edge = |word: &str, time: Option<Timestamp>| time.map_or_else(String::new, |time| format!(" {word} {time}"));
    let used = tables.measurements.len();
    tables.notes.push(format!("only the {used} of {all} rows{}{} are used", edge("from", from), edge("before", to)));
    Ok(())
}

/// Diagnose, add the causes to a new version of the structure, and train its model.
#[derive(Debug, Args)]
pub struct ExtendArgs {
    #[command(flatten)]
    study: StudyArgs,
    /// Folder for structure.json, baseline.safetensors and baseline.json
    #[arg(long)]
    out: PathBuf,
    /// Add a discrepancy learned from the covariates and settings instead of the causes: not understood, but predictable
    #[arg(long)]
    learned: bool,
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
    let (definition, added, left_out) = if args.learned {
        let extended = extend_learned(&simulator, &data, &outcome)?;
        (extended.definition, vec![extended.added], extended.left_out)
    } else {
        let extended = extend_structure(&simulator, &data, &outcome)?;
        (extended.definition, extended.added, extended.left_out)
    };
    for added in &added {
        println!("added: {added}");
    }
    for left in &left_out {
        println!("not added: {left}");
    }
    let text = serde_json::to_string_pretty(&definition)?;
    write_whole(&args.out.join("structure.json"), format!("{text}\n").as_bytes())?;
    println!("structure: {}", args.out.join("structure.json").display());
    if args.no_training {
        return Ok(());
    }
    let extension = Simulator::new(definition)?;
    let parent = present_model(&args.study.structure, &simulator, args.model.as_deref())?;
    let plan = ExtensionPlan {
        parent: parent.as_deref(),
        from_scratch: args.from_scratch,
        samples: args.samples,
        epochs: args.epochs,
        seed: args.study.seed,
    };
    let trained = train_extension_into(&args.out, &extension, &plan)?;
    let manifest = trained.baseline.manifest();
    print_record(manifest);
    let (folder, epochs) = (args.out.display(), 2 * manifest.training.settings.epochs);
    let next =
        format!("modalwatch train --structure {folder}/structure.json --out {folder} --epochs {epochs} --rounds 4");
    refuse_overconfident(manifest, &next)
}

fn print(d: &Diagnosis) {
    println!("{}", d.summary);
    println!();
    for cause in &d.causes {
        let kind = cause.class.in_words();
        println!("cause ({kind}, probability {}): {}", shown_probability(cause.probability), cause.sentence);
        for n in &cause.parameters {
            let [name, value, interval] = n.in_words(cause);
            println!("    {name}: {value} (90 % interval: {interval})");
        }
    }
    for a in d.alternatives.iter().take(5) {
        println!(
            "instead of cause {}: {} ({} than it); distinguished by {}",
            a.instead_of,
            a.cause.sentence,
            times_less(a.log_evidence_difference),
            a.discriminating_measurement
        );
    }
    for m in d.next_measurements.iter().take(5) {
        println!("next: {}", m.sentence);
    }
    for m in d.misfit.iter().take(8) {
        let what = m.mode.map_or_else(|| m.parameter.clone().unwrap_or_default(), |mode| format!("mode {mode}"));
        let covariate = m.covariate.as_ref().map_or_else(|| "constant".to_owned(), |c| format!("depends on {c}"));
        println!("misfit: {what}, {covariate}: {:.3} %; by chance in {} cases", m.size_percent, cases(m.p_value));
    }
    if let Some(r) = &d.remainder {
        println!("unexplained: {}; by chance in {} cases", r.sentence(), cases(r.p_value));
    }
    if let Some(gain) = &d.gain {
        print_gain(gain);
    }
    for note in &d.notes {
        println!("note: {note}");
    }
}

fn shown_probability(probability: f64) -> String {
    if probability > 0.9995 {
        "above 0.999".to_owned()
    } else {
        format!("{probability:.3}")
    }
}

/// The gain as a table.
fn print_gain(g: &Gain) {
    let rows = match g.method {
        GainMethod::HeldOut => format!("on {} rows held out:", g.holdout_rows),
        GainMethod::CrossValidation => format!("by cross-validation, {} rows:", g.holdout_rows),
    };
    println!("{rows:<44} before      after");
    for (mode, (a, b)) in g.rms_error_percent.before.iter().zip(&g.rms_error_percent.after).enumerate() {
        println!("  {:<38} {a:>10.4} {b:>10.4}", format!("error of mode {}, %", mode + 1));
    }
    let l = &g.log_density_per_row;
    println!(
        "  {:<38} {:>10.3} {:>10.3}   gain {:.3} ± {:.3}; +1: rows are 2.7 times as probable",
        "log of the probability of a row", l.before, l.after, l.difference, l.standard_error
    );
    let name = "share inside 90 % intervals";
    println!("  {name:<38} {:>10.3} {:>10.3}   it should be 0.9", g.coverage90.before, g.coverage90.after);
    if let Some(f) = &g.false_alarms_per_1000 {
        let name = "of 1000 batches, beyond an alarm limit";
        println!("  {name:<38} {:>10.0} {:>10.0}   {}", f.before, f.after, g.condition());
    }
    if let Some(s) = &g.smallest_detectable_loss_percent {
        println!("  {:<38} {:>10.1} {:>10.1}", "smallest loss that ten rows show, %", s.before, s.after);
    }
}
