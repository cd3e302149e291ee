//! `modalwatch design-alarm --batch-correlation`: the losses that the charts of a process will detect, where the parameters follow
//! unmeasured weather.

use anyhow::Context as _;
use indicatif::{ProgressBar, ProgressStyle};
use rand::Rng as _;
use rand_distr::StandardNormal;
use serde::Serialize;

use crate::parameter::{DamageDirection, Parameter};
use crate::plot::{table, Line, Plot};
use crate::process::detectable::Detectable;
use crate::process::estimate::BatchEstimate;
use crate::process::fit::{Progress, Quantities, FEWEST_BATCHES};
use crate::process::limits::Limits;
use crate::process::reference::ReferenceProcess;
use crate::quantity::Timestamp;
use crate::stats;

/// Batches of the table that are printed; the page has all.
const PRINTED: [usize; 5] = [1, 3, 8, 30, 60];

/// Most batches of the simulated reference.
const MOST_BATCHES: usize = 2_000;

/// Time between batches of the simulated reference; the result does not depend on it.
const STEP_MICROS: i64 = 86_400_000_000;

/// A structure under weather.
pub(super) struct Weather {
    /// Correlation of successive batches.
    pub correlation: f64,
    /// Share of the variance of each parameter that all have in common.
    pub common: f64,
    /// Number of batches of the reference.
    pub reference: usize,
    /// Wanted mean number of batches to a false alarm.
    pub mean_run_batches: f64,
    /// Seed of the simulated reference.
    pub seed: u64,
}

/// A parameter, its mean and standard deviation over the seasons, and the standard error of a batch.
pub(super) struct Moving {
    pub parameter: Parameter,
    pub mean: f64,
    pub std: f64,
    pub error: f64,
}

/// The charts of a process.
#[derive(Debug, Serialize)]
pub(super) struct ProcessReport {
    batch_correlation: f64,
    common_share: f64,
    reference_batches: usize,
    factors: usize,
    limits: Limits,
    detectable: Vec<Detectable>,
}

impl Weather {
    fn check(&self) -> anyhow::Result<()> {
        anyhow::ensure!(
            (0.0..1.0).contains(&self.correlation),
            "--batch-correlation is {}: it must be at least 0 and below 1",
            self.correlation
        );
        anyhow::ensure!((0.0..=1.0).contains(&self.common), "--common is {}: it must be between 0 and 1", self.common);
        anyhow::ensure!(
            self.reference >= FEWEST_BATCHES,
            "--reference-batches is {}: a process is learned from at least {FEWEST_BATCHES} batches",
            self.reference
        );
        anyhow::ensure!(
            self.reference <= MOST_BATCHES,
            "--reference-batches is {}: at most {MOST_BATCHES} are simulated, because the time of the search grows with their number",
            self.reference
        );
        Ok(())
    }

    /// Simulates an undamaged reference, learns its process as the service does, and returns its charts.
    pub(super) fn report(&self, parameters: &[Moving]) -> anyhow::Result<ProcessReport> {
        self.check()?;
        let bar = progress_bar()?;
        let watch = |progress: Progress| match progress {
            Progress::Search { evaluations } => {
                bar.set_message(format!("process of the weather, step {evaluations} of its search"));
            }
            Progress::Limits { done, all } => bar.set_message(format!("limits, operation {done} of {all}")),
        };
        let quantities = Quantities {
            names: parameters.iter().map(|p| p.parameter.name.clone()).collect(),
            units: parameters.iter().map(|p| p.parameter.unit.clone()).collect(),
            directions: parameters.iter().map(|p| p.parameter.damage.into()).collect(),
            misfit: None,
        };
        let estimates = self.estimates(parameters)?;
        let found = ReferenceProcess::watched(&quantities, &[], estimates, (self.mean_run_batches, [1.0; 2]), &watch)?;
        bar.finish_and_clear();
        let watched = |name: &str| {
            parameters.iter().any(|p| p.parameter.name == name && p.parameter.damage != DamageDirection::None)
        };
        Ok(ProcessReport {
            batch_correlation: self.correlation,
            common_share: self.common,
            reference_batches: self.reference,
            factors: found.process.factors,
            limits: found.limits,
            detectable: found.detectable.into_iter().filter(|d| watched(&d.name)).collect(),
        })
    }

    /// Batches of a healthy structure: common weather, what each parameter does by itself, and the error of the estimate.
    fn estimates(&self, parameters: &[Moving]) -> anyhow::Result<Vec<BatchEstimate>> {
        let d = parameters.len();
        let mut stream = stats::stream(self.seed, "design of the alarms of a process");
        let mut normal = || stream.sample::<f64, _>(StandardNormal);
        let jump = (1.0 - self.correlation.powi(2)).sqrt();
        // State 0 is the weather; the others belong to one parameter each.
        let mut states: Vec<f64> = (0..=d).map(|_| normal()).collect();
        let mut estimates = Vec::with_capacity(self.reference);
        for batch in 0..self.reference {
            for state in &mut states {
                *state = self.correlation * *state + jump * normal();
            }
            let value = |k: usize, noise: f64| {
                let p = &parameters[k];
                let moved = self.common.sqrt() * states[0] + (1.0 - self.common).sqrt() * states[k + 1];
                Some(p.mean + p.std * moved + p.error * noise)
            };
            let mut covariance = vec![0.0; d * d];
            for (k, p) in parameters.iter().enumerate() {
                covariance[k * d + k] = p.error * p.error;
            }
            estimates.push(BatchEstimate {
                at: Timestamp::from_micros(STEP_MICROS * batch as i64)?,
                mean: (0..d).map(|k| value(k, normal())).collect(),
                covariance,
                covariates: Vec::new(),
            });
        }
        Ok(estimates)
    }
}

/// A line with the time and the step on a terminal. Elsewhere, such as in a log, one line says that it takes a while.
fn progress_bar() -> anyhow::Result<ProgressBar> {
    let bar = ProgressBar::new_spinner();
    bar.set_style(ProgressStyle::with_template("{elapsed} {msg}").context("the template of the progress bar")?);
    if bar.is_hidden() {
        eprintln!(
            "the process of a reference under weather is simulated and learned, which takes seconds to some minutes"
        );
    }
    bar.enable_steady_tick(std::time::Duration::from_millis(200));
    Ok(bar)
}

impl ProcessReport {
    fn names(&self) -> Vec<&str> {
        let mut names: Vec<&str> = self.detectable.iter().map(|d| d.name.as_str()).collect();
        names.dedup();
        names
    }

    fn of(&self, name: &str) -> impl Iterator<Item = &Detectable> {
        let name = name.to_owned();
        self.detectable.iter().filter(move |d| d.name == name)
    }

    /// The facts about the charts in a sentence.
    fn facts(&self) -> String {
        format!(
            "With a correlation of successive batches of {}, {:.0} % of the variance in common and a reference of {} batches, in which \
             {}, the charts alarm above {:.2} (fast) and {:.2} (slow) standard deviations.",
            self.batch_correlation,
            100.0 * self.common_share,
            self.reference_batches,
            if self.factors == 1 { "one common factor shows".to_owned() } else { format!("{} common factors show", self.factors) },
            self.limits.quantity.fast,
            self.limits.quantity.slow
        )
    }

    /// Prints the losses that are found.
    pub(super) fn print(&self) {
        println!("\n{}", self.facts());
        let header: Vec<String> = PRINTED.iter().map(|batches| format!("{batches:>8}")).collect();
        println!("lasting loss found with 90 %, % of the mean, within so many batches:");
        println!("{:>16} {}", "parameter", header.join(" "));
        for name in self.names() {
            let shown = self.of(name).filter(|d| PRINTED.contains(&d.batches));
            let cells: Vec<String> = shown.map(|d| format!("{:>8.2}", d.loss_percent)).collect();
            println!("{name:>16} {}", cells.join(" "));
        }
    }

    /// The same as a section of a page, with a plot.
    pub(super) fn section(&self) -> (String, String) {
        let line = |name: &str| Line {
            name: name.to_owned(),
            points: self.of(name).map(|d| (d.batches as f64, d.loss_percent)).collect(),
        };
        let plot = Plot {
            title: "Lasting loss found with a probability of 90 %".to_owned(),
            x_label: "batches since the loss".to_owned(),
            y_label: "loss, % of the mean".to_owned(),
            lines: self.names().into_iter().map(line).collect(),
            ..Plot::default()
        };
        let ages: Vec<usize> = self.of(self.names().first().copied().unwrap_or_default()).map(|d| d.batches).collect();
        let mut header = vec!["parameter".to_owned()];
        header.extend(ages.iter().map(|age| format!("{age} batches")));
        let row = |name: &str| {
            std::iter::once(name.to_owned()).chain(self.of(name).map(|d| format!("{:.2} %", d.loss_percent))).collect()
        };
        let rows: Vec<Vec<String>> = self.names().into_iter().map(row).collect();
        let header: Vec<&str> = header.iter().map(String::as_str).collect();
        let body = format!("<p>{}</p>{}<div class=\"plots\">{}</div>", self.facts(), table(&header, &rows), plot.svg());
        ("Under unmeasured weather".to_owned(), body)
    }
}
