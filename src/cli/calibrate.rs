//! `modalwatch calibrate`: simulation-based calibration of a trained model, with plots.

use std::path::PathBuf;

use anyhow::Context as _;
use clap::Args;

use super::model::load;
use super::output::write_whole;
use crate::baseline::calibration::{calibrate as measure, cell_title, CellRanks, DRAWS};
use crate::baseline::manifest::{CalibrationRecord, Outcome};
use crate::baseline::train::renew;
use crate::baseline::Baseline;
use crate::plot::{escaped, page, table, Line, Plot};

/// Measure the calibration of a trained model.
#[derive(Debug, Args)]
pub struct CalibrateArgs {
    /// Structure file (TOML or JSON), or the id of a shipped structure
    #[arg(long)]
    structure: String,
    /// Trained model: its .safetensors file, with its .json beside it [default: the one beside the structure file or the shipped
    /// one; otherwise one that is made in a second]
    #[arg(long)]
    model: Option<PathBuf>,
    /// Seed of the simulations; the training uses other seeds
    #[arg(long, default_value_t = 1_000_003)]
    seed: u64,
    /// Write the measured calibration to the manifest beside --model, as a new training would: for a model that was trained by
    /// an earlier version of this program
    #[arg(long, requires = "model")]
    renew: bool,
    /// Write the plots as one HTML page
    #[arg(long)]
    out: Option<PathBuf>,
    /// Print the record as JSON
    #[arg(long)]
    json: bool,
}

/// Measures and prints the calibration.
///
/// # Errors
/// An invalid trained model, a file that cannot be written, a model that is overconfident.
pub fn calibrate(args: &CalibrateArgs) -> anyhow::Result<()> {
    let mut baseline = load(&args.structure, args.model.as_deref())?;
    if let Some(path) = args.model.as_deref().filter(|_| args.renew) {
        let weights = std::fs::read(path).with_context(|| format!("cannot read {}", path.display()))?;
        let renewed = renew(&baseline, weights)?;
        write_whole(&path.with_extension("json"), &renewed.manifest_json)?;
        baseline = renewed.baseline.into();
    }
    let (record, ranks) = measure(&baseline, args.seed)?;
    if let Some(path) = &args.out {
        write_whole(path, html(&baseline, &record, &ranks).as_bytes())?;
    }
    if args.json {
        println!("{}", serde_json::to_string_pretty(&record)?);
    } else {
        print(&record);
    }
    let epochs = 2 * baseline.manifest().training.settings.epochs;
    anyhow::ensure!(
        record.outcome() < Outcome::Overconfident,
        "the model is overconfident: {} of its intervals are too narrow or misplaced. Next: modalwatch train --structure {} --epochs {epochs} \
         --rounds 4{}",
        record.failures.len(),
        args.structure,
        args.model.as_deref().and_then(|path| path.parent()).map(|out| format!(" --out {}", out.display())).unwrap_or_default()
    );
    Ok(())
}

const HEADER: [&str; 6] =
    ["measured", "parameter", "in 90 % interval", "in 50 % interval", "ranks even, p", "together even, p"];

const LEGEND: &str = "The third and fourth column are the shares of the true values inside the 90 % and 50 % intervals. The last two are the \
    probabilities that a right model shows a less even distribution: of the place of the true value among the samples of the parameter, and \
    of its place in the uncertainty of all parameters together (TARP). Small values mean that something is wrong.";

fn rows(record: &CalibrationRecord) -> Vec<Vec<String>> {
    let cell_rows = record.cells.iter().flat_map(|cell| {
        cell.parameters.iter().map(move |p| {
            vec![
                cell_title(cell),
                p.name.clone(),
                format!("{:.3}", p.coverage_90),
                format!("{:.3}", p.coverage_50),
                format!("{:.3}", p.rank_p_value),
                format!("{:.3}", cell.tarp_p_value),
            ]
        })
    });
    cell_rows.collect()
}

fn print(record: &CalibrationRecord) {
    println!(
        "{:>42} {:>12} {:>16} {:>16} {:>14} {:>16}",
        HEADER[0], HEADER[1], HEADER[2], HEADER[3], HEADER[4], HEADER[5]
    );
    for row in rows(record) {
        println!("{:>42} {:>12} {:>16} {:>16} {:>14} {:>16}", row[0], row[1], row[2], row[3], row[4], row[5]);
    }
    println!("{LEGEND}");
    let (cells, simulations, draws) = (record.cells.len(), record.simulations, record.draws);
    match record.outcome() {
        Outcome::Passed => {
            println!("passed: {cells} situations of {simulations} simulated measurements, {draws} samples each");
        }
        Outcome::NotMeasured => println!("not measured"),
        Outcome::Cautious => {
            println!("cautious: intervals are too wide somewhere and nowhere too narrow; the service uses this model");
        }
        Outcome::Overconfident => println!("overconfident: intervals are too narrow or misplaced somewhere"),
    }
    for reason in record.reasons() {
        println!("  {reason}.");
    }
}

fn html(baseline: &Baseline, record: &CalibrationRecord, ranks: &[CellRanks]) -> String {
    let items: Vec<String> = record.reasons().map(|reason| format!("<li>{}</li>", escaped(reason))).collect();
    let items = items.concat();
    let verdict = match record.outcome() {
        Outcome::Passed => "<p>Passed: the intervals hold the stated share of the true values in every situation.</p>".to_owned(),
        Outcome::NotMeasured => "<p>Not measured.</p>".to_owned(),
        Outcome::Cautious => format!(
            "<p>Cautious: intervals are too wide somewhere and nowhere too narrow. The service uses this model.</p><ul>{items}</ul>"
        ),
        Outcome::Overconfident => format!(
            "<p class=\"bad\">Overconfident: the service does not use this model unless its digest is accepted in the configuration.</p><ul>{items}</ul>"
        ),
    };
    let verdict = format!("{verdict}<p>{LEGEND}</p>");
    let names: Vec<String> = baseline.space().iter().map(|p| p.name.clone()).collect();
    let plots: String = ranks.iter().map(|cell| plot(cell, &names).svg()).collect();
    let explain = "<p>Each line shows the share of simulations whose true value has at most this rank among the posterior draws, \
                   minus the share for a calibrated posterior. 99 % of calibrated posteriors stay inside the grey band. A line \
                   above the band on the left and below it on the right means that the posteriors are too narrow; the opposite \
                   means that they are too wide.</p>";
    page(
        &format!("Calibration of {}", baseline.simulator().id()),
        &[
            ("Verdict".to_owned(), verdict + &table(&HEADER, &rows(record))),
            ("Ranks".to_owned(), format!("{explain}<div class=\"plots\">{plots}</div>")),
        ],
    )
}

/// The distribution of the ranks in a cell minus the uniform distribution.
fn plot(cell: &CellRanks, names: &[String]) -> Plot {
    let difference = |ranks: &[usize]| -> Vec<(f64, f64)> {
        let mut counts = vec![0_usize; DRAWS + 1];
        for rank in ranks {
            counts[*rank] += 1;
        }
        let mut below = 0;
        counts
            .iter()
            .enumerate()
            .map(|(rank, count)| {
                below += count;
                let expected = (rank + 1) as f64 / (DRAWS + 1) as f64;
                (expected, below as f64 / ranks.len() as f64 - expected)
            })
            .collect()
    };
    let parameters = names.iter().zip(&cell.ranks);
    let mut lines: Vec<Line> =
        parameters.map(|(name, ranks)| Line { name: name.clone(), points: difference(ranks) }).collect();
    lines.push(Line { name: "all together".to_owned(), points: difference(&cell.tarp_ranks) });
    // 99 % quantile of the largest deviation of an empirical distribution by Kolmogorov: 1.63/√n.
    let width = 1.63 / (cell.tarp_ranks.len() as f64).sqrt();
    Plot {
        title: cell.title.clone(),
        x_label: "rank / number of draws".to_owned(),
        y_label: "share minus the right share".to_owned(),
        lines,
        band: vec![(0.0, -width, width), (1.0, -width, width)],
        ..Plot::default()
    }
}
