//! The page of a condition report.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::sync::Arc;

use super::alarms;
use super::words::{counted, list, time};
use crate::alarm::severity::SeverityLimits;
use crate::baseline::Baseline;
use crate::damage::UndamagedQuantity;
use crate::monitor::stored::{Episode, Handling, MaintenanceWindow, Note, QuantitySeries, ReferenceRecord};
use crate::monitor::Series;
use crate::parameter::in_words;
use crate::plot::{escaped, figure, key, page, table_of_html, Curve, Panel, Swatch};
use crate::quantity::{StructureId, Timestamp};
use crate::trust::TrustVerdict;

/// Length of a day, µs.
const DAY_US: f64 = 86_400e6;

/// A gap between measurements that is named in the report, days.
const LONG_GAP_DAYS: f64 = 2.0;

/// Share of measurements without a mode that is named in the report.
const OFTEN_MISSING: f64 = 0.2;

/// A period; `None` where there is no batch.
#[derive(Debug, Clone, Copy)]
pub struct Period {
    pub from: Option<Timestamp>,
    pub to: Option<Timestamp>,
}

impl Period {
    /// Whether something that lasted from `begin` to `end`, or still lasts, was in the period.
    pub fn overlaps(self, begin: Timestamp, end: Option<Timestamp>) -> bool {
        self.to.is_none_or(|to| begin <= to) && self.from.is_none_or(|from| end.is_none_or(|end| end >= from))
    }
}

/// What a report is made from.
pub struct Contents {
    /// The structure with the changes of its parts as SVG; `None` for a table of finite-element runs.
    pub drawing: Option<String>,
    pub structure: StructureId,
    pub description: Option<String>,
    pub modes: usize,
    pub verdict: String,
    pub made_at: Timestamp,
    pub period: Period,
    pub series: Series,
    pub alarms: Vec<Episode>,
    /// What people did with the alarms, by their numbers.
    pub handling: BTreeMap<i64, Handling>,
    /// Limits of the severity.
    pub limits: SeverityLimits,
    pub maintenance: Vec<MaintenanceWindow>,
    pub notes: Vec<Note>,
    /// The undamaged reference of the trained model in use.
    pub reference: Option<Arc<ReferenceRecord>>,
    /// Why the undamaged reference cannot be read.
    pub reference_unreadable: Option<String>,
    pub model: Result<Arc<Baseline>, String>,
}

/// One self-contained page.
pub fn html(c: &Contents) -> String {
    let sections = [
        ("Verdict".to_owned(), verdict(c) + &structure(c)),
        (
            "Alarms in the period".to_owned(),
            alarms::section(&c.alarms, &c.handling, c.limits) + &alarms::maintenance(&c.maintenance),
        ),
        ("Notes on the time line".to_owned(), alarms::notes(&c.notes)),
        ("Stiffnesses and other parameters".to_owned(), parameters(c)),
        ("Quality of the data".to_owned(), quality(c)),
        ("Undamaged reference and model".to_owned(), basis(c)),
        ("What is not known".to_owned(), list(&unknown(c))),
    ];
    page(&format!("Condition of {}", c.structure), &sections)
}

fn verdict(c: &Contents) -> String {
    let mut text = format!("<p class=\"lead\">{}</p>", escaped(&c.verdict));
    if let Some(description) = &c.description {
        let _ = write!(text, "<p>{}</p>", escaped(description));
    }
    let period = match (c.period.from, c.period.to) {
        (Some(from), Some(to)) => format!("{} to {}", time(from), time(to)),
        _ => "no measurements".to_owned(),
    };
    let _ = write!(
        text,
        "<p class=\"facts\">Period: {period} (UTC), {} with {}. The verdict is that of {} (UTC) and follows from the alarm \
         charts. Made by modalwatch {}.</p>",
        counted(c.series.extent.batches, "batch", "batches"),
        counted(c.series.extent.measurements, "measurement", "measurements"),
        time(c.made_at),
        env!("CARGO_PKG_VERSION")
    );
    text
}

fn structure(c: &Contents) -> String {
    let caption = "Orange: the part has become softer than in the undamaged reference; blue: stiffer; grey: no change or no comparison; outlined: \
                   open alarm. As of the latest assessed batch.";
    c.drawing.as_ref().map_or_else(String::new, |svg| {
        format!("<div class=\"plots\"><figure>{svg}<figcaption>{}</figcaption></figure></div>", escaped(caption))
    })
}

fn undamaged<'a>(c: &'a Contents, name: &str) -> Option<&'a UndamagedQuantity> {
    c.reference.as_ref()?.state.quantities.iter().find(|q| q.name == name)
}

/// A factor and a unit in which numbers of about this size are easy to read: 3·10⁷ N/m are 30 MN/m. The dashboard has the same rule
/// (`scale` in `format.js`); both are tested by `tests/units.json`.
fn readable(unit: &str, size: f64) -> (f64, String) {
    let goes_on = |c: char| c.is_ascii_alphanumeric() || c == '_';
    let shown = if unit == "1" { "" } else { unit };
    let takes_prefix =
        ["N", "Pa"].iter().any(|base| unit.strip_prefix(base).is_some_and(|rest| !rest.starts_with(goes_on)));
    if !takes_prefix || !size.is_finite() || size == 0.0 {
        return (1.0, shown.to_owned());
    }
    let power = (size.abs().log10() / 3.0 + 1e-9).floor().clamp(-2.0, 4.0) as i32;
    let prefix = ["µ", "m", "", "k", "M", "G", "T"][(power + 2) as usize];
    (1e3_f64.powi(-power), format!("{prefix}{shown}"))
}

/// Four significant digits.
fn number(value: f64) -> String {
    let digits = if value == 0.0 { 0 } else { (3 - value.abs().log10().floor() as i32).clamp(0, 9) as usize };
    format!("{value:.digits$}")
}

fn change_percent(unit: &str, value: f64, reference: f64) -> f64 {
    100.0 * if unit == "ln" { (value - reference).exp_m1() } else { value / reference - 1.0 }
}

fn parameters(c: &Contents) -> String {
    if c.series.quantities.iter().all(|q| q.batches.rows.is_empty()) {
        return "<p>No batch of this period is assessed.</p>".to_owned();
    }
    let shown = c.series.quantities.iter().filter(|q| !q.batches.rows.is_empty());
    let (mut panels, mut rows) = (Vec::new(), Vec::new());
    for quantity in shown {
        panels.push(panel(c, quantity));
        rows.push(latest(c, quantity));
    }
    let header = [
        ("Latest batch", false),
        ("Mean", false),
        ("90 % interval", false),
        ("Change", false),
        ("Damage threshold δ", false),
        ("Probability of damage", false),
    ];
    let keys = [
        key(Swatch::Line, 0, "mean of each batch"),
        key(Swatch::Bar, 6, "90 % interval"),
        key(Swatch::Dashed, 2, "mean of the undamaged reference"),
        key(Swatch::Dashed, 1, "damage threshold δ"),
    ]
    .concat();
    let caption = "Probability of damage: that the parameter lies below δ, the 5 % quantile of the undamaged reference. One of twenty healthy \
                   batches exceeds it by chance; the verdict follows from the alarm charts.";
    table_of_html("", &header, &rows) + &figure("parameters-over-time", &panels, &keys, caption)
}

fn latest(c: &Contents, q: &QuantitySeries) -> Vec<String> {
    let row = q.batches.rows.last().expect("only quantities with batches are shown");
    let (mean, probability) = (row.values[0], row.values[1]);
    let reference = undamaged(c, &q.name);
    let (factor, unit) = readable(&q.unit, reference.map_or(mean, |r| r.mean));
    let with_unit = |value: f64| format!("{} {unit}", number(factor * value)).trim_end().to_owned();
    let interval = match row.tag.mean_interval {
        [Some(low), Some(high)] => format!("{} to {}", number(factor * low), number(factor * high)),
        _ => "–".to_owned(),
    };
    let change = reference.map_or_else(
        || "–".to_owned(),
        |r| format!("{:+.1} %", change_percent(&q.unit, mean, r.mean)).replace('-', "−"),
    );
    let threshold = reference.and_then(|r| r.threshold).map_or_else(|| "–".to_owned(), with_unit);
    let probability = match probability {
        p if !p.is_finite() => "–".to_owned(),
        p if p > 0.0 && p < 0.001 => "< 0.1 %".to_owned(),
        p if p > 0.999 => "> 99.9 %".to_owned(),
        p => format!("{:.1} %", 100.0 * p),
    };
    [in_words(&q.name), with_unit(mean), interval, change, threshold, probability].map(|cell| escaped(&cell)).to_vec()
}

fn panel(c: &Contents, q: &QuantitySeries) -> String {
    let rows = &q.batches.rows;
    let begin = rows[0].time_us;
    let day = |time_us: i64| (time_us - begin) as f64 / DAY_US;
    let last = day(rows[rows.len() - 1].time_us);
    let reference = undamaged(c, &q.name);
    let (factor, unit) = readable(&q.unit, reference.map_or(rows[0].values[0], |r| r.mean));
    let mean: Vec<(f64, f64)> = rows.iter().map(|r| (day(r.time_us), factor * r.values[0])).collect();
    let band = rows.iter().filter_map(|r| match r.tag.mean_interval {
        [Some(low), Some(high)] => Some((day(r.time_us), factor * low, factor * high)),
        _ => None,
    });
    let level = |value: Option<f64>, colour: usize| {
        let points = value.map_or_else(Vec::new, |v| vec![(0.0, factor * v), (last, factor * v)]);
        Curve { colour, dashed: true, filled_to: None, points }
    };
    Panel {
        title: in_words(&q.name),
        x_label: format!("days after {}", Timestamp::from_micros(begin).map_or_else(|_| String::new(), Timestamp::day)),
        y_label: if unit.is_empty() { in_words(&q.name) } else { unit },
        band: band.collect(),
        curves: vec![
            level(reference.map(|r| r.mean), 2),
            level(reference.and_then(|r| r.threshold), 1),
            Curve { colour: 0, dashed: false, filled_to: None, points: mean },
        ],
        ..Panel::default()
    }
    .svg()
}

/// Number of batches by finding, and of rejected ones.
fn findings(c: &Contents) -> (usize, BTreeMap<String, usize>) {
    let mut found = BTreeMap::new();
    for mark in &c.series.trust.rows {
        for code in &mark.tag.findings {
            let name =
                serde_json::to_value(code).ok().and_then(|name| name.as_str().map(|name| name.replace('_', " ")));
            *found.entry(name.unwrap_or_default()).or_insert(0) += 1;
        }
    }
    let rejected = c.series.trust.rows.iter().filter(|mark| mark.tag.verdict == TrustVerdict::Rejected).count();
    (rejected, found)
}

/// The share of measurements without each mode.
fn missing_modes(c: &Contents) -> Vec<f64> {
    let rows = &c.series.measured.rows;
    let share = |mode: usize| {
        let missing = rows.iter().filter(|row| !row.values[mode].is_finite()).count();
        missing as f64 / rows.len().max(1) as f64
    };
    (0..c.modes).map(share).collect()
}

fn quality(c: &Contents) -> String {
    let (rejected, found) = findings(c);
    let shown = c.series.trust.rows.len();
    let mut items =
        vec![format!("Rejected: {rejected} of {}.", counted(shown as u64, "assessed batch", "assessed batches"))];
    items.extend(
        found
            .iter()
            .map(|(code, count)| format!("{} with the finding “{code}”.", counted(*count as u64, "batch", "batches"))),
    );
    for (mode, share) in missing_modes(c).into_iter().enumerate().filter(|(_, share)| *share > 0.0) {
        items.push(format!("Mode {} is missing in {:.1} % of the measurements.", mode + 1, 100.0 * share));
    }
    items.extend(gaps(c));
    if c.series.trust.reduced || c.series.measured.reduced {
        items.push(
            "The period has more batches or measurements than are counted here: these figures are those of a selection that keeps extremes."
                .to_owned(),
        );
    }
    list(&items)
}

/// Long periods without measurements.
fn gaps(c: &Contents) -> Vec<String> {
    let times: Vec<i64> = c.series.trust.rows.iter().map(|row| row.time_us).collect();
    let mut long: Vec<(i64, i64)> =
        times.windows(2).map(|w| (w[0], w[1])).filter(|(a, b)| (b - a) as f64 > LONG_GAP_DAYS * DAY_US).collect();
    long.sort_by_key(|(a, b)| a - b);
    let words = |(a, b): &(i64, i64)| {
        let at = |us: i64| Timestamp::from_micros(us).map_or_else(|_| String::new(), time);
        format!("No batch from {} to {} (UTC).", at(*a), at(*b))
    };
    long.iter().take(5).map(words).collect()
}

fn basis(c: &Contents) -> String {
    let mut items = Vec::new();
    items.extend(c.series.unreadable.iter().map(|what| format!("{what}.")));
    items.extend(c.reference_unreadable.iter().map(|why| format!("The undamaged reference is missing: {why}.")));
    match &c.reference {
        None if c.reference_unreadable.is_some() => {}
        None => items.push("There is no undamaged reference for the trained model in use.".to_owned()),
        Some(record) => {
            let state = &record.state;
            items.push(format!(
                "Undamaged reference, version {}, declared {}: {} with {}.",
                state.version,
                time(record.created_at),
                counted(record.batches.len() as u64, "batch", "batches"),
                counted(state.measurements as u64, "measurement", "measurements")
            ));
            items.extend(state.origin.reason.iter().map(|reason| format!("Its reason: {reason}.")));
            items.extend(state.doubts.iter().map(|doubt| format!("Doubt about it: {doubt}.")));
        }
    }
    match &c.model {
        Err(reason) => items.push(format!("There is no trained model: {reason}.")),
        Ok(baseline) => items.push(format!(
            "Trained model {}, {}.",
            baseline.digest().as_str().chars().take(12).collect::<String>(),
            if baseline.manifest().calibration.passed() {
                "whose calibration passed"
            } else {
                "whose calibration did not pass"
            }
        )),
    }
    list(&items)
}

/// What these data cannot show.
fn unknown(c: &Contents) -> Vec<String> {
    let mut items = Vec::new();
    if c.reference.is_none() {
        items.push("Whether anything has changed: there is nothing to compare with.".to_owned());
    }
    let state = c.reference.as_ref().map(|record| &record.state);
    match state.and_then(|state| state.process.as_ref()) {
        Some(process) => {
            let mut longest: BTreeMap<&str, &crate::process::detectable::Detectable> = BTreeMap::new();
            for found in &process.detectable {
                longest.insert(&found.name, found);
            }
            for (name, found) in longest {
                items.push(format!(
                    "Lasting losses of {} below {:.1} %: these charts find larger ones with a probability of 90 % within {} batches.",
                    in_words(name),
                    found.loss_percent,
                    found.batches
                ));
            }
            if let Some(coverage) = process.process.coverage.as_ref().filter(|coverage| coverage.months.len() < 12) {
                items.push(format!(
                    "How the healthy structure behaves in the {} months that the undamaged reference has not seen.",
                    12 - coverage.months.len()
                ));
            }
        }
        None => {
            if let Some(reason) = state.and_then(|state| state.without_process.as_ref()) {
                items.push(format!(
                    "How the healthy structure moves in time, so that batches are taken as independent: {reason}."
                ));
            }
        }
    }
    if let Ok(baseline) = &c.model {
        let manifest = baseline.manifest();
        for group in &manifest.identifiability.groups {
            items.push(format!("Which of {} has changed: these modes cannot distinguish them.", group.join(" and ")));
        }
        if !manifest.calibration.passed() {
            items.push(
                "Whether the intervals have the stated width: the calibration of the model did not pass.".to_owned(),
            );
        }
    }
    let (rejected, _) = findings(c);
    if rejected > 0 {
        items.push(format!(
            "The condition during {}: nothing is concluded from what was rejected.",
            counted(rejected as u64, "rejected batch", "rejected batches")
        ));
    }
    for (mode, _) in missing_modes(c).into_iter().enumerate().filter(|(_, share)| *share > OFTEN_MISSING) {
        items.push(format!("Changes that only mode {} shows, while it is missing.", mode + 1));
    }
    items.push(
        "Damage that does not change the measured natural frequencies, and anything that the structure file does not describe.".to_owned(),
    );
    items
}

#[cfg(test)]
mod tests {
    use super::readable;

    #[test]
    fn numbers_have_the_prefixes_that_the_dashboard_gives_them() {
        let table: Vec<(String, f64, String, f64)> =
            serde_json::from_str(include_str!("../../../tests/units.json")).unwrap();
        for (unit, size, shown, factor) in table {
            let (found, found_unit) = readable(&unit, size);
            assert_eq!(found_unit, shown, "{size} {unit}");
            assert!((found / factor - 1.0).abs() < 1e-12, "{size} {unit}: factor {found}");
        }
    }
}
