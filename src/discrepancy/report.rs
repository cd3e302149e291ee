//! The page of a diagnosis: what was found, what it rests on, what it gains, and how to read it.

use super::data::{Data, Values, TIME};
use super::describe::{rounded, Cause, NamedNumber};
use super::gain::{Change, Gain};
use super::grammar::Class;
use super::misfit::{Misfit, Remainder};
use super::model::{Fit, Study};
use super::{Diagnosis, Outcome, Verdict, SURE};
use crate::plot::{escaped, page, table_of_html, Plot, Points, Scatter};
use crate::quantity::Digest;
use crate::simulator::law::LawKind;
use crate::simulator::Simulator;
use crate::stats;

/// Most rows that a plot draws.
const MOST_DRAWN: usize = 1500;

/// Misfits that are told.
const MISFITS: usize = 12;

/// Stride that spreads over an interval, whatever the period of the data: the golden ratio.
const GOLDEN: f64 = 0.618_033_988_749_895;

/// Colours of [`Points`]: orange before, blue after.
const BEFORE: usize = 1;
const AFTER: usize = 0;

/// What every residual plot says of its axis.
const RESIDUAL: &str = "measured against predicted, %";

/// One self-contained HTML page; `None` when the structure has no frequencies under one of the fits.
pub fn html(simulator: &Simulator, data: &Data, outcome: &Outcome) -> Option<String> {
    let d = &outcome.diagnosis;
    let drawn = Drawn::new(simulator, data, outcome)?;
    let mut sections = vec![
        ("In short".to_owned(), in_short(d)),
        ("Causes".to_owned(), causes(d)),
        ("Candidates".to_owned(), candidates(d)),
        ("What is wrong now".to_owned(), now(d, &drawn)),
        ("Where the simulation deviates".to_owned(), misfits(d)),
    ];
    if let Some(left) = &d.remainder {
        sections.push(("What no cause explains".to_owned(), remainder(left, &drawn)));
    }
    sections.push(("What the causes gain".to_owned(), d.gain.as_ref().map_or_else(|| no_gain(d), gain)));
    sections.push(("Notes".to_owned(), notes(d)));
    sections.push(("How to read this".to_owned(), GLOSSARY.to_owned()));
    Some(page(&format!("What the simulation of {} gets wrong", d.structure), &sections))
}

fn in_short(d: &Diagnosis) -> String {
    let verdict = match d.verdict {
        Verdict::Cause => "one cause, nearly sure",
        Verdict::Several => "several causes at once",
        Verdict::Ambiguous => "one cause; these data cannot tell which of a few",
        Verdict::NoneOfThese => "something is wrong that no known cause explains",
        Verdict::NothingFound => "nothing wrong was found",
    };
    let short = |digest: &Digest| digest.as_str().chars().take(12).collect::<String>();
    format!(
        "<p class=\"lead\">{}</p><p class=\"facts\"><strong>Verdict:</strong> {verdict}. <strong>Rows:</strong> {}, \
         of which \
         {} were searched for causes and {} held out. <strong>Data</strong> {}, <strong>structure</strong> {} \
         (SHA-256, \
         first 12 digits), <strong>seed</strong> {}.</p>",
        escaped(&d.summary),
        d.training_rows + d.holdout_rows,
        d.training_rows,
        d.holdout_rows,
        short(&d.data_digest),
        short(&d.structure_digest),
        d.seed
    )
}

fn causes(d: &Diagnosis) -> String {
    let lead = match d.verdict {
        _ if d.causes.is_empty() => "No cause is named.",
        Verdict::NoneOfThese => "These explain a part only: do not rely on them before the rest is understood.",
        Verdict::Ambiguous => "One of these is the cause. The next section says what would tell them apart.",
        _ if d.causes.iter().any(|c| c.probability <= SURE) => {
            "Where a probability is low, the next section says what else it may be and what would tell them apart."
        }
        _ => "",
    };
    format!("<p>{lead}</p>{}", d.causes.iter().map(cause).collect::<String>())
}

fn cause(cause: &Cause) -> String {
    let (class, advice) = class(cause.class);
    // A difference between categories gives the first of them as its size as well.
    let repeated = usize::from(cause.law == LawKind::Category);
    let rows: Vec<Vec<String>> = cause.parameters.iter().skip(repeated).map(|n| number(cause, n)).collect();
    let header = [("number", true), ("most probable", false), ("90 % interval", false)];
    let table = if rows.is_empty() { String::new() } else { table_of_html("", &header, &rows) };
    format!(
        "<article class=\"card\"><h3>{}</h3><p>Probability <strong>{}</strong>. Kind: <strong>{class}</strong>. \
         {advice}</p>{table}</article>",
        escaped(&sentence(&cause.sentence)),
        probability(cause.probability)
    )
}

/// What a class is called and what to do about it.
fn class(class: Class) -> (&'static str, &'static str) {
    match class {
        Class::Environment => ("environment", "Extend the simulation with this covariate."),
        Class::Instrument => {
            ("instrument", "Check the calibration and mounting of the instrument before touching the simulation.")
        }
        Class::SetUp => ("set-up", "Check how this was set up and recorded, and correct the record or the procedure."),
        Class::Structure => {
            ("structure", "Compare the simulation with drawings or the structure itself at this place, and correct it.")
        }
        Class::PossibleDamage => {
            ("possible damage", "Do not compensate it: inspect the structure there before anything else.")
        }
    }
}

/// A row of a cause's numbers: name, value and interval with unit; shares in per cent.
fn number(cause: &Cause, n: &NamedNumber) -> Vec<String> {
    let over = cause.covariate.as_deref().unwrap_or_default();
    let name = match n.name.as_str() {
        _ if cause.law == LawKind::Category => format!("where {over} is {}", n.name),
        "swing" => format!("change over the middle 90 % of {over}"),
        "level" => format!("level at the middle of {over}"),
        "slope_per_unit" => "slope".to_owned(),
        "slope_below_per_unit" => "slope below the knee".to_owned(),
        "slope_above_per_unit" => "slope above the knee".to_owned(),
        "curvature_per_unit2" => "curvature".to_owned(),
        "rate_per_unit" => "rate".to_owned(),
        "lag_days" => "lag".to_owned(),
        "frequency_hz" => "frequency it is tuned to".to_owned(),
        "time_days" => "time of the step".to_owned(),
        other => other.replace('_', " "),
    };
    let (factor, unit) = match n.unit.strip_prefix("share") {
        Some(rest) => (100.0, format!("%{rest}")),
        None => (1.0, n.unit.clone()),
    };
    let [low, high] = n.interval90.map(|edge| factor * edge);
    let std = (high - low) / (2.0 * stats::normal_quantile(0.95));
    let shown = |value: f64| signed(&rounded(value, std).0);
    let interval =
        if std > 0.0 { format!("{} to {} {unit}", shown(low), shown(high)) } else { "not estimated".to_owned() };
    let value = format!("{} {unit}", shown(factor * n.value));
    vec![escaped(&name), escaped(&value), escaped(&interval)]
}

fn candidates(d: &Diagnosis) -> String {
    let intro = format!(
        "<p>{} combinations of a target, a law and a covariate were compared. The difference is in nats: −3 means \
         about 20 \
         times less probable than the cause that was chosen, priors included.</p>",
        d.candidates
    );
    // Causes that stand for one another are among the alternatives as well.
    let own = d.causes.iter().filter(|c| !d.alternatives.iter().any(|a| a.cause == **c));
    let tables: String = own.enumerate().map(|(i, cause)| candidate_table(d, i + 1, cause)).collect();
    if tables.is_empty() {
        return intro + "<p>None of them was probable enough to be chosen.</p>";
    }
    intro + &tables
}

/// The cause of a number and what else it may be.
fn candidate_table(d: &Diagnosis, number: usize, cause: &Cause) -> String {
    let row = |text: &str, difference: String, p: f64, told_apart_by: &str| {
        let bar = format!(
            "<svg class=\"bar\" viewBox=\"0 0 100 8\" preserveAspectRatio=\"none\" aria-hidden=\"true\"><rect \
             width=\"{:.1}\" \
             height=\"8\"/></svg>",
            100.0 * p.clamp(0.0, 1.0)
        );
        vec![escaped(&sentence(text)), difference, probability(p), bar, escaped(told_apart_by)]
    };
    let others = || d.alternatives.iter().filter(|a| a.instead_of == number);
    let mut rows = vec![row(&cause.sentence, "0".to_owned(), cause.probability, "chosen")];
    rows.extend(others().map(|a| {
        let difference = signed(&format!("{:.1}", a.log_evidence_difference));
        row(&a.cause.sentence, difference, a.cause.probability, &a.told_apart_by)
    }));
    let rest = 1.0 - cause.probability - others().map(|a| a.cause.probability).sum::<f64>();
    rows.push(row("all others, and no such cause", "–".to_owned(), rest.max(0.0), ""));
    let header = [
        ("candidate", true),
        ("Δ log evidence, nats", false),
        ("probability", false),
        ("", false),
        ("told apart from the chosen one by", true),
    ];
    table_of_html(&format!("Cause {number} and what else it may be"), &header, &rows)
}

/// Rows that are drawn, with the residuals of each mode before and after, per cent.
struct Drawn<'a> {
    data: &'a Data,
    rows: Vec<usize>,
    held: Vec<bool>,
    before: Vec<Vec<f64>>,
    /// `None` without causes.
    after: Option<Vec<Vec<f64>>>,
}

/// A covariate at the rows that are drawn.
struct Axis {
    label: String,
    names: Vec<String>,
    values: Vec<f64>,
}

impl<'a> Drawn<'a> {
    fn new(simulator: &'a Simulator, data: &'a Data, outcome: &Outcome) -> Option<Self> {
        let stride = (data.rows() as f64 / MOST_DRAWN as f64).max(1.0);
        let count = (data.rows() as f64 / stride).floor() as usize;
        // Evenly, but at no fixed phase: a fixed one would show the same hour of every day.
        let place = |i: usize| if stride > 1.0 { (i as f64 * GOLDEN).fract() } else { 0.0 };
        let rows: Vec<usize> = (0..count).map(|i| ((i as f64 + place(i)) * stride) as usize).collect();
        // Both fits carry the effects of the structure themselves.
        let bare = simulator.without_effects();
        let study = Study::new(&bare, data);
        let residuals = |fit: &Fit| -> Option<Vec<Vec<f64>>> {
            let mut by_mode = vec![vec![f64::NAN; rows.len()]; simulator.modes()];
            for (row, view) in study.view(&rows, fit)?.iter().enumerate() {
                for (mode, residual) in view.present.iter().zip(view.residual.iter()) {
                    by_mode[*mode][row] = 100.0 * residual;
                }
            }
            Some(by_mode)
        };
        let before = residuals(&outcome.before)?;
        let after = if outcome.diagnosis.causes.is_empty() { None } else { Some(residuals(&outcome.after)?) };
        let mut held = vec![false; data.rows()];
        outcome.holdout.iter().for_each(|row| held[*row] = true);
        Some(Self { data, held: rows.iter().map(|row| held[*row]).collect(), rows, before, after })
    }

    fn axis(&self, name: &str) -> Axis {
        let (names, values) = match self.data.column(name).map(|c| &c.values) {
            Some(Values::Numbers(values)) => (Vec::new(), self.rows.iter().map(|r| values[*r]).collect()),
            Some(Values::Categories(names, indices)) => {
                let index = |r: &usize| indices[*r].map_or(f64::NAN, |i| i as f64);
                (names.clone(), self.rows.iter().map(index).collect())
            }
            None => (Vec::new(), self.rows.iter().map(|r| self.data.times_days[*r]).collect()),
        };
        let label = if name == TIME { "days since the first row".to_owned() } else { name.to_owned() };
        Axis { label, names, values }
    }

    /// Mode and its usual frequency.
    fn title(&self, mode: usize) -> String {
        let logs = self.rows.iter().map(|r| self.data.log_frequencies[*r][mode]).filter(|y| y.is_finite());
        let logs: Vec<f64> = logs.collect();
        if logs.is_empty() {
            return format!("Mode {}, never measured", mode + 1);
        }
        format!("Mode {}, about {} Hz", mode + 1, digits(stats::quantile(&logs, 0.5).exp()))
    }

    /// Residuals of a mode over an axis, before and after.
    fn before_and_after(&self, mode: usize, axis: &Axis) -> String {
        let fits = match &self.after {
            Some(after) => vec![("as it is", BEFORE, &self.before[mode]), ("with the causes", AFTER, &after[mode])],
            None => vec![("as it is", BEFORE, &self.before[mode])],
        };
        let mut clouds = Vec::new();
        for (place, (name, colour, residuals)) in fits.iter().enumerate() {
            let shift = if fits.len() > 1 { 0.4 * place as f64 - 0.2 } else { 0.0 };
            for held in [false, true] {
                let what = if held { ", held out" } else { "" };
                let points = self.points(residuals, axis, shift, |row| self.held[row] == held);
                clouds.push(Points { name: format!("{name}{what}"), colour: *colour, hollow: held, points });
            }
        }
        figure(self.title(mode), axis, clouds)
    }

    /// Points of the rows that `chosen` takes; those of a category are spread into a column about it, `shift` aside.
    fn points(&self, residuals: &[f64], axis: &Axis, shift: f64, chosen: impl Fn(usize) -> bool) -> Vec<(f64, f64)> {
        let jitter = |row: usize| {
            if axis.names.is_empty() {
                0.0
            } else {
                shift + 0.3 * ((row as f64 * GOLDEN).fract() - 0.5)
            }
        };
        let known = (0..self.rows.len()).filter(|row| chosen(*row));
        let points = known.map(|row| (axis.values[row] + jitter(row), residuals[row]));
        points.filter(|(x, y)| x.is_finite() && y.is_finite()).collect()
    }
}

/// Clouds over an axis; points far beyond the others are drawn at the edge.
fn figure(title: String, axis: &Axis, mut clouds: Vec<Points>) -> String {
    let all: Vec<f64> = clouds.iter().flat_map(|c| c.points.iter().map(|p| p.1)).collect();
    let (low, high) = (stats::quantile(&all, 0.005), stats::quantile(&all, 0.995));
    let margin = 0.35 * (high - low);
    let mut beyond = 0;
    for (_, y) in clouds.iter_mut().flat_map(|c| &mut c.points) {
        let inside = y.max(low - margin).min(high + margin);
        beyond += usize::from((inside - *y).abs() > 0.0);
        *y = inside;
    }
    let told = format!("Beyond the scale and drawn at its edge: {beyond} of {} points.", all.len());
    let caption = if beyond == 0 { "" } else { &told };
    let y_label = RESIDUAL.to_owned();
    let marks = vec![(0.0, String::new())];
    let plot = Plot { title, x_label: axis.label.clone(), y_label, marks, ..Plot::default() };
    Scatter { plot, points: clouds, x_names: axis.names.clone() }.figure(caption)
}

/// Plots of every mode over the covariate that matters most, and of the worst mode over time.
fn now(d: &Diagnosis, drawn: &Drawn<'_>) -> String {
    let of_cause = d.causes.first().and_then(|c| c.covariate.as_deref());
    let of_misfit = || d.misfit.iter().find_map(|m| m.covariate.as_deref());
    let covariate = of_cause.or_else(of_misfit).unwrap_or(TIME);
    let axis = drawn.axis(covariate);
    let plots: String = (0..drawn.before.len()).map(|mode| drawn.before_and_after(mode, &axis)).collect();
    let colours = if drawn.after.is_some() {
        "Orange: the simulation as it is. Blue: with the causes above. A good simulation leaves a level, narrow band \
         about 0."
    } else {
        "A good simulation leaves a level, narrow band about 0."
    };
    let few = if drawn.rows.len() < drawn.data.rows() {
        format!(" {} of {} rows are drawn, spread evenly.", drawn.rows.len(), drawn.data.rows())
    } else {
        String::new()
    };
    let over_time = if covariate == TIME {
        String::new()
    } else {
        let size = |m: &&Misfit| m.size_percent.abs();
        let modes = d.misfit.iter().filter(|m| m.mode.is_some());
        let mode = modes.max_by(|a, b| size(a).total_cmp(&size(b))).and_then(|m| m.mode).unwrap_or(1) - 1;
        let plot = drawn.before_and_after(mode, &drawn.axis(TIME));
        format!("<p>The mode with the largest misfit, over time:</p><div class=\"plots\">{plot}</div>")
    };
    format!(
        "<p>Each point is one measured frequency less the predicted one, per cent, over {}. {colours} Open circles \
         are rows \
         held out.{few}</p><div class=\"plots\">{plots}</div>{over_time}",
        escaped(&axis.label)
    )
}

fn misfits(d: &Diagnosis) -> String {
    if d.misfit.is_empty() {
        return "<p>Nowhere more than chance allows.</p>".to_owned();
    }
    let row = |m: &Misfit| {
        let parameter = || format!("parameter {}", m.parameter.as_deref().unwrap_or_default());
        let what = m.mode.map_or_else(parameter, |mode| format!("frequency of mode {mode}"));
        let over = m.covariate.as_deref().unwrap_or("nothing: the same everywhere");
        vec![escaped(&what), escaped(over), signed(&digits(m.size_percent)), p_value(m.p_value)]
    };
    let rows: Vec<Vec<String>> = d.misfit.iter().take(MISFITS).map(row).collect();
    let header = [("what deviates", true), ("goes with", true), ("size, %", false), ("p", false)];
    format!(
        "<p>Deviations of the simulation as it is, before any cause is added; the clearest first. A parameter is \
         listed when \
         its best value drifts with a covariate, because it took up what the simulation lacks. p: probability of as \
         much by \
         chance, all looks counted.</p>{}",
        table_of_html(&format!("The {} clearest of {}", rows.len(), d.misfit.len()), &header, &rows)
    )
}

/// What is left, over its first covariate; colours tell ranges or categories of the second apart.
fn remainder(left: &Remainder, drawn: &Drawn<'_>) -> String {
    let axis = drawn.axis(left.covariates.first().map_or(TIME, String::as_str));
    let split = left.covariates.get(1).map(|name| drawn.axis(name));
    let residuals = drawn.after.as_ref().unwrap_or(&drawn.before);
    let groups = groups(split.as_ref());
    let group = |row: usize| split.as_ref().map_or(0.0, |s| s.values[row]);
    let plot = |mode: usize| {
        let cloud = |(colour, (name, low, high)): (usize, &(String, f64, f64))| {
            let points = drawn.points(&residuals[mode], &axis, 0.0, |row| (*low..*high).contains(&group(row)));
            Points { name: name.clone(), colour, hollow: false, points }
        };
        figure(drawn.title(mode), &axis, groups.iter().enumerate().map(cloud).collect())
    };
    let plots: String = (0..residuals.len()).map(plot).collect();
    let sizes: Vec<String> = left
        .size_percent
        .iter()
        .enumerate()
        .map(|(m, s)| format!("mode {} {} %", m + 1, signed(&digits(*s))))
        .collect();
    format!(
        "<p>With all causes above in place, the residuals still go with <strong>{}</strong> (p {}). Their change along \
         it: {}. No cause that this program knows has that shape: look for what else changes with it.</p>\
         <div class=\"plots\">{plots}</div>",
        escaped(&left.function),
        p_compared(left.p_value),
        sizes.join(", ")
    )
}

/// Name and range, upper end excluded, of the parts that a covariate is split into: categories, or thirds of the rows.
fn groups(split: Option<&Axis>) -> Vec<(String, f64, f64)> {
    let Some(axis) = split else { return vec![("what is left".to_owned(), -1.0, 1.0)] };
    if !axis.names.is_empty() {
        return axis.names.iter().enumerate().map(|(i, name)| (name.clone(), i as f64 - 0.5, i as f64 + 0.5)).collect();
    }
    let known: Vec<f64> = axis.values.iter().copied().filter(|v| v.is_finite()).collect();
    let edge = |level: f64| stats::quantile(&known, level);
    let (low, high, label) = (edge(1.0 / 3.0), edge(2.0 / 3.0), &axis.label);
    vec![
        (format!("{label} below {}", digits(low)), f64::NEG_INFINITY, low),
        (format!("{label} between"), low, high),
        (format!("{label} above {}", digits(high)), high, f64::INFINITY),
    ]
}

fn no_gain(d: &Diagnosis) -> String {
    let why =
        if d.causes.is_empty() { "Without a cause there is nothing to gain." } else { "Too few rows were held out." };
    format!("<p>{why}</p>")
}

/// The gain table; `Change` before and after, the difference, and what it means.
fn gain(g: &Gain) -> String {
    let mut rows = Vec::new();
    let mut add = |name: String, values: [String; 3], meaning: &str| {
        rows.push([vec![escaped(&name)], values.map(|v| escaped(&v)).to_vec(), vec![meaning.to_owned()]].concat());
    };
    let rms = &g.rms_error_percent;
    for (mode, [low, high]) in g.rms_difference_interval90.iter().enumerate() {
        let (before, after) = (rms.before[mode], rms.after[mode]);
        let interval = format!("{} ({} to {})", plus(after - before), plus(*low), plus(*high));
        let meaning = if mode == 0 {
            "Root mean square of measured against predicted frequency, and the 90 % interval of the change. Smaller \
             is better."
        } else {
            "As above."
        };
        add(format!("error of mode {}, %", mode + 1), [digits(before), digits(after), interval], meaning);
    }
    let l = &g.log_density_per_row;
    let change = rounded(l.difference, l.standard_error);
    add(
        "log density per row, nats".to_owned(),
        [format!("{:.2}", l.before), format!("{:.2}", l.after), format!("{} ± {}", signed(&change.0), change.1)]
            .map(|v| signed(&v)),
        "How probable the prediction made what was measured; ± one standard error. Larger is better.",
    );
    let mut simple = |name: String, c: &Change<f64>, meaning: &str| {
        add(name, [digits(c.before), digits(c.after), plus(c.after - c.before)], meaning);
    };
    let coverage = "Share of frequencies inside their 90 % interval. Right is 0.90: less is too sure, more too unsure.";
    simple("coverage of 90 % intervals".to_owned(), &g.coverage90, coverage);
    let spread = &g.spread_of_parameters_percent;
    for (place, (name, before)) in spread.before.iter().enumerate() {
        let after = spread.after.get(name).copied().unwrap_or(f64::NAN);
        let meaning = if place == 0 {
            "How much the parameter seems to vary between batches of ten rows, % of its mean. Smaller is better."
        } else {
            "As above."
        };
        simple(format!("spread of {name}, %"), &Change { before: *before, after }, meaning);
    }
    let alarms = "Batches of ten rows that raise an alarm at a limit set for 1 in 1000, taking these rows as healthy.";
    simple("false alarms per 1000 batches".to_owned(), &g.false_alarms_per_1000, alarms);
    let loss =
        "Loss of the parameter seen worst that one batch of ten rows shows with 90 % probability. Smaller is better.";
    simple("smallest detectable loss, %".to_owned(), &g.smallest_detectable_loss_percent, loss);
    let header =
        [("figure", true), ("as it is", false), ("with the causes", false), ("change", false), ("meaning", true)];
    let caption = format!("Measured on {} rows held out, which no fit and no choice has seen", g.holdout_rows);
    table_of_html(&caption, &header, &rows)
}

fn notes(d: &Diagnosis) -> String {
    if d.notes.is_empty() {
        return "<p>None.</p>".to_owned();
    }
    let items: Vec<String> = d.notes.iter().map(|note| format!("<li>{}</li>", escaped(note))).collect();
    format!("<ul>{}</ul>", items.concat())
}

const GLOSSARY: &str = "<dl><dt>Probability of a cause</dt><dd>Among all candidates and no cause at all, given these \
data and \
    that nothing outside the list acts. 0.97 leaves 3 in 100 for something else. When the section \u{201c}What no \
    cause \
    explains\u{201d} is there, something outside the list does act, and the probabilities only rank the \
    candidates.</dd>\
    <dt>90 % interval</dt><dd>The number lies inside with 90 % probability, if the cause is right.</dd>\
    <dt>Nat, log density, log evidence</dt><dd>Logarithms, base e, of how probable the data are under a model. One \
    nat more: \
    2.7 times as probable. 3 nats: 20 times. Evidence also charges for every number that was fitted.</dd>\
    <dt>Hold-out</dt><dd>Rows kept aside until everything was chosen and fitted. Only on them is a gain a gain.</dd>\
    <dt>Residual</dt><dd>Measured frequency less the predicted one. Noise leaves a level band about 0; a shape means \
    that \
    something is missing.</dd><dt>p</dt><dd>Probability that chance alone makes as large a deviation. Below 0.001 it \
    is hardly \
    chance.</dd><dt>Covariate</dt><dd>What was recorded beside the frequencies: temperature, load, operator, \
    time.</dd></dl>";

/// Three significant digits.
fn digits(value: f64) -> String {
    if !value.is_finite() {
        return "–".to_owned();
    }
    if value == 0.0 {
        return "0".to_owned();
    }
    let size = value.abs().max(1e-4).log10().floor();
    let digits = (2.0 - size).clamp(0.0, 5.0) as usize;
    format!("{value:.digits$}")
}

/// Three significant digits with a sign.
fn plus(value: f64) -> String {
    let text = digits(value);
    signed(&if value > 0.0 { format!("+{text}") } else { text })
}

/// A minus that is as wide as a plus.
fn signed(text: &str) -> String {
    text.replace('-', "−")
}

fn probability(p: f64) -> String {
    match p {
        p if p > 0.9995 => "&gt; 0.999".to_owned(),
        p if p < 0.0005 => "&lt; 0.001".to_owned(),
        p => format!("{p:.3}"),
    }
}

/// A p-value, as HTML.
fn p_value(p: f64) -> String {
    match p {
        p if p < 1e-12 => "&lt; 1e-12".to_owned(),
        p if p < 1e-3 => format!("{p:.0e}"),
        p => format!("{p:.3}"),
    }
}

/// A p-value after the letter p, as HTML.
fn p_compared(p: f64) -> String {
    let text = p_value(p);
    let text = if text.starts_with('&') { text } else { format!("= {text}") };
    text.replace('-', "\u{2011}")
}

/// Begins with a capital.
fn sentence(text: &str) -> String {
    let mut rest = text.chars();
    rest.next().map_or_else(String::new, |first| first.to_uppercase().chain(rest).collect())
}
