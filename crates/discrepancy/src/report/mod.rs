//! The HTML page of a diagnosis: the causes, the evidence for them, their gain, and how to read the page.

mod everywhere;
mod figures;
mod gain;
mod lasting;
mod learned;
mod next;
mod residuals;

use super::chance::{cases, chance, times_less};
use super::data::{Data, TIME};
use super::describe::Cause;
use super::diagnosis::{Diagnosis, DiagnosisVerdict, Outcome, SURE};
use super::grammar::Class;
use super::misfit::{Misfit, Remainder};
use super::sentence::capitalised;
use figures::{digits, probability, signed};
use residuals::{figure, Axis, Drawn};
use structures::plot::{escaped, page, table_of_html, Points};
use structures::quantity::Digest;
use structures::simulator::law::LawKind;
use structures::simulator::Simulator;
use structures::stats;

/// Greatest number of misfits in the table.
const MISFITS: usize = 12;

/// One self-contained HTML page; `None` if the frequencies cannot be computed in some row under one of the fits.
pub fn html(simulator: &Simulator, data: &Data, outcome: &Outcome) -> Option<String> {
    let d = &outcome.diagnosis;
    let drawn = Drawn::new(simulator, data, outcome)?;
    let mut sections = vec![
        ("In short".to_owned(), in_short(d)),
        ("Causes".to_owned(), causes(d)),
        ("Candidates".to_owned(), candidates(d)),
        ("Residuals".to_owned(), residual_plots(d, &drawn)),
        ("Deviations before any cause is added".to_owned(), misfits(d)),
    ];
    if let Some(section) = everywhere::everywhere(simulator, outcome) {
        sections.insert(2, ("Off everywhere".to_owned(), section));
    }
    if let Some(change) = &d.lasting_change {
        sections.insert(1, ("A lasting change, perhaps damage".to_owned(), lasting::lasting_change(change, &drawn)));
    }
    if !d.next_measurements.is_empty() {
        let candidates = sections.iter().position(|(title, _)| title == "Candidates").unwrap_or_default();
        sections
            .insert(candidates + 1, ("What to measure next".to_owned(), next::next_measurements(&d.next_measurements)));
    }
    if let Some(left) = &d.remainder {
        sections.push(("Deviation that no cause explains".to_owned(), remainder(left, &drawn)));
    }
    if let Some(offered) = &outcome.offered {
        let title = match d.verdict {
            DiagnosisVerdict::Distributed => "What can be accepted",
            _ => "Not understood, but predictable",
        };
        sections.push((title.to_owned(), learned::learned(offered, outcome)));
    }
    sections.push((
        "Gain on rows that were not used for the fit".to_owned(),
        d.gain.as_ref().map_or_else(|| no_gain(d), gain::gain)
            + &d.left_out_modes.as_ref().map_or_else(String::new, gain::left_out_modes),
    ));
    sections.push(("Notes".to_owned(), notes(d)));
    sections.push(("How to read this".to_owned(), GLOSSARY.to_owned()));
    Some(page(&format!("Diagnosis of the simulation of {}", d.structure), &sections))
}

fn in_short(d: &Diagnosis) -> String {
    let verdict = match d.verdict {
        DiagnosisVerdict::Cause => "one cause, with high probability",
        DiagnosisVerdict::Several => "several causes at the same time",
        DiagnosisVerdict::Ambiguous => "one cause out of a few that these data cannot distinguish",
        DiagnosisVerdict::Distributed => "off by a little everywhere, in no single place",
        DiagnosisVerdict::UnexplainedScatter => "more scatter than noise and spread explain",
        DiagnosisVerdict::NoneOfThese => "a deviation that no known cause explains",
        DiagnosisVerdict::NothingFound => "no cause found",
    };
    let set_aside = match d.set_aside_rows {
        0 => String::new(),
        rows => format!(", and {rows} set aside because of a lasting change"),
    };
    let short = |digest: &Digest| digest.as_str().chars().take(12).collect::<String>();
    format!(
        "<p class=\"lead\">{}</p><p class=\"facts\"><strong>Verdict:</strong> {verdict}. <strong>Rows:</strong> {}, \
         of which \
         {} were searched for causes, {} held out{}. <strong>Data</strong> {}, <strong>structure</strong> {} \
         (SHA-256, \
         first 12 digits), <strong>seed</strong> {}.</p>",
        escaped(&d.summary),
        d.training_rows + d.holdout_rows + d.set_aside_rows,
        d.training_rows,
        d.holdout_rows,
        set_aside,
        short(&d.data_digest),
        short(&d.structure_digest),
        d.seed
    )
}

fn causes(d: &Diagnosis) -> String {
    let lead = match d.verdict {
        _ if d.causes.is_empty() => "No cause is named.",
        DiagnosisVerdict::NoneOfThese => {
            "These causes explain only a part of the deviation: do not rely on them before the rest is understood."
        }
        DiagnosisVerdict::Ambiguous => {
            "One of these is the cause. A section below lists the measurements that would decide between them."
        }
        _ if d.causes.iter().any(|c| c.probability <= SURE) => {
            "For a cause with a low probability, the next section lists the alternatives and the measurements that would \
             distinguish them."
        }
        _ => "",
    };
    format!("<p>{lead}</p>{}", d.causes.iter().map(cause).collect::<String>())
}

fn cause(cause: &Cause) -> String {
    let everywhere = cause.target.kind == "everywhere";
    let advice = if everywhere { EVERYWHERE_ADVICE } else { advice(cause.class) };
    let class = cause.class.in_words();
    // For categories, the size repeats the number of the first category.
    let repeated = usize::from(cause.law == LawKind::Category);
    let rows: Vec<Vec<String>> = cause
        .parameters
        .iter()
        .skip(repeated)
        .map(|n| n.in_words(cause).iter().map(|cell| escaped(cell)).collect())
        .collect();
    let header = [("number", true), ("most probable", false), ("90 % interval", false)];
    let table = if rows.is_empty() { String::new() } else { table_of_html("", &header, &rows) };
    format!(
        "<article class=\"card\"><h3>{}</h3><p>Probability <strong>{}</strong>. Kind: <strong>{class}</strong>. \
         {advice}</p>{table}</article>",
        escaped(&capitalised(&cause.sentence)),
        probability(cause.probability)
    )
}

/// What should be done about a simulation that is off everywhere.
const EVERYWHERE_ADVICE: &str = "Do not look for it in a single part: compare the assumptions that concern the whole structure (supports and \
                                 foundation, bending, how mass is spread, material, calibration) with the structure itself.";

/// What should be done about a cause of a class.
fn advice(class: Class) -> &'static str {
    match class {
        Class::Environment => "Extend the simulation by this effect.",
        Class::Instrument => "Check the calibration and mounting of the instrument before changing the simulation.",
        Class::SetUp => "Check how the test was set up and recorded, and correct the record or the procedure.",
        Class::Structure => {
            "Compare the simulation with drawings or the structure itself at this place, and correct it."
        }
        Class::PossibleDamage => "Do not compensate for it: first inspect the structure at this place.",
        Class::Rise => "Do not compensate for it: first find out what has changed at this place.",
    }
}

fn candidates(d: &Diagnosis) -> String {
    let intro = format!(
        "<p>{} combinations of what may change (a target), a recorded quantity that it may depend on, and the form of this dependence (a \
         law) were compared.</p>",
        d.candidates
    );
    // With an ambiguous verdict, the further causes are listed among the alternatives as well.
    let own = d.causes.iter().filter(|c| !d.alternatives.iter().any(|a| a.cause == **c));
    let tables: String = own.enumerate().map(|(i, cause)| candidate_table(d, i + 1, cause)).collect();
    if tables.is_empty() {
        return intro + "<p>None of them was probable enough to be a cause.</p>";
    }
    intro + &tables
}

/// The table of a cause and its alternatives.
fn candidate_table(d: &Diagnosis, number: usize, cause: &Cause) -> String {
    let row = |text: &str, difference: String, p: f64, measurement: &str| {
        let bar = format!(
            "<svg class=\"bar\" viewBox=\"0 0 100 8\" preserveAspectRatio=\"none\" aria-hidden=\"true\"><rect \
             width=\"{:.1}\" \
             height=\"8\"/></svg>",
            100.0 * p.clamp(0.0, 1.0)
        );
        vec![escaped(&capitalised(text)), difference, probability(p), bar, escaped(measurement)]
    };
    let others = || d.alternatives.iter().filter(|a| a.instead_of == number);
    let mut rows = vec![row(&cause.sentence, "–".to_owned(), cause.probability, "chosen")];
    rows.extend(others().map(|a| {
        let difference = times_less(a.log_evidence_difference);
        row(&a.cause.sentence, difference, a.cause.probability, &a.discriminating_measurement)
    }));
    let rest = 1.0 - cause.probability - others().map(|a| a.cause.probability).sum::<f64>();
    rows.push(row("all other candidates, and no further cause", "–".to_owned(), rest.max(0.0), ""));
    let header = [
        ("candidate", true),
        ("compared with the chosen cause", false),
        ("probability", false),
        ("", false),
        ("measurement that would distinguish it from the chosen cause", true),
    ];
    table_of_html(&format!("Cause {number} and its alternatives"), &header, &rows)
}

/// Plots of the residuals of every mode over the most important covariate, and of the mode with the largest misfit over time.
fn residual_plots(d: &Diagnosis, drawn: &Drawn<'_>) -> String {
    let of_cause = d.causes.first().and_then(|c| c.covariate.as_deref());
    let of_misfit = || d.misfit.iter().find_map(|m| m.covariate.as_deref());
    let covariate = of_cause.or_else(of_misfit).unwrap_or(TIME);
    let axis = drawn.axis(covariate);
    let plots: String = (0..drawn.before.len()).map(|mode| drawn.before_and_after(mode, &axis)).collect();
    let colours = if drawn.after.is_some() {
        "Orange: simulation without the causes. Blue: with the causes above. With a good simulation, the points form a narrow, \
         horizontal band around 0."
    } else {
        "With a good simulation, the points form a narrow, horizontal band around 0."
    };
    let few = if drawn.rows.len() < drawn.data.rows() {
        format!(" {} of {} rows are drawn, evenly distributed.", drawn.rows.len(), drawn.data.rows())
    } else {
        String::new()
    };
    let aside = if d.set_aside_rows > 0 { ", green ones rows set aside because of a lasting change" } else { "" };
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
        "<p>Each point is one measured frequency minus the predicted one, in per cent, over {}. {colours} Open circles \
         are rows held out{aside}.{few}</p><div class=\"plots\">{plots}</div>{over_time}",
        escaped(&axis.label)
    )
}

fn misfits(d: &Diagnosis) -> String {
    if d.misfit.is_empty() {
        return "<p>No deviation is larger than chance would explain.</p>".to_owned();
    }
    let row = |m: &Misfit| {
        let parameter = || format!("parameter {}", m.parameter.as_deref().unwrap_or_default());
        let what = m.mode.map_or_else(parameter, |mode| format!("frequency of mode {mode}"));
        let over = m.covariate.as_deref().unwrap_or("no covariate: constant deviation");
        vec![escaped(&what), escaped(over), signed(&digits(m.size_percent)), cases(m.p_value)]
    };
    let rows: Vec<Vec<String>> = d.misfit.iter().take(MISFITS).map(row).collect();
    let header = [
        ("quantity that deviates", true),
        ("depends on", true),
        ("size, %", false),
        ("cases in which chance gives it", false),
    ];
    format!(
        "<p>Deviations of the simulation before any cause is added, the most significant first. A parameter is listed if its \
         best value varies with a covariate, because it compensates for an effect that the simulation lacks. The last column \
         says how often chance alone would give at least this deviation, corrected for the number of tests.</p>{}",
        table_of_html(&format!("The {} most significant of {}", rows.len(), d.misfit.len()), &header, &rows)
    )
}

/// The remainder over its first covariate; colours show ranges or categories of the second.
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
        "<p>{} <strong>{}</strong> ({}). {} for each mode: {}. No cause known to this program \
         explains this{}.</p>\
         <div class=\"plots\">{plots}</div>",
        if drawn.after.is_some() { "With all causes above," } else { "Without a known cause," },
        escaped(&left.sentence()),
        chance(left.p_value),
        if left.covariates.is_empty() { "Deviation" } else { "Effect range" },
        sizes.join(", "),
        if left.covariates.is_empty() { "" } else { ": look for another quantity that varies with it" }
    )
}

/// Name and range, without its upper end, of the groups that a covariate is divided into: categories, or thirds of the rows.
fn groups(split: Option<&Axis>) -> Vec<(String, f64, f64)> {
    let Some(axis) = split else { return vec![("residuals".to_owned(), -1.0, 1.0)] };
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
    let why = if d.causes.is_empty() {
        "Without a cause, no gain can be measured."
    } else {
        "The gain was not measured; the notes give the reason."
    };
    format!("<p>{why}</p>")
}

fn notes(d: &Diagnosis) -> String {
    if d.notes.is_empty() {
        return "<p>None.</p>".to_owned();
    }
    let items: Vec<String> = d.notes.iter().map(|note| format!("<li>{}</li>", escaped(note))).collect();
    format!("<ul>{}</ul>", items.concat())
}

const GLOSSARY: &str = "<dl>\
    <dt>Probability of a cause</dt><dd>Posterior probability among all candidates and no cause at all, given these data and on \
    the assumption that no cause outside the list acts. 0.97 leaves 3 in 100 for the others. If the page has a section \
    \u{201c}Deviation that no cause explains\u{201d}, this assumption is wrong, and the probabilities only rank the \
    candidates.</dd>\
    <dt>90 % interval</dt><dd>Contains the number with a probability of 90 %, if the cause is right.</dd>\
    <dt>Effect range</dt><dd>Difference between the effect at the 95 % quantile and at the 5 % quantile of the covariate.</dd>\
    <dt>Log density</dt><dd>Natural logarithm of the probability density of the measurements under a model. 1 more means 2.7 times as \
    probable, 3 more 20 times.</dd>\
    <dt>Rows held out</dt><dd>Rows that were used neither to find nor to fit the causes, so that an improvement on them is not \
    due to overfitting.</dd>\
    <dt>Residual</dt><dd>Measured frequency minus the predicted one. Noise alone gives a horizontal band around 0; a pattern \
    means that the simulation lacks something.</dd>\
    <dt>Lasting change</dt><dd>From a time on, the frequencies differ from those before, and neither the causes found, nor a recorded \
    quantity with any linear or quadratic influence on each mode, nor a yearly or daily cycle explains it.</dd>\
    <dt>Covariate</dt><dd>A quantity that was recorded with the frequencies: temperature, load, operator, time.</dd></dl>";
