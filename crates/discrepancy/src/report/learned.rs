//! The learned discrepancy: a curve with its band over each input, and its gain.

use super::figures::{digits, signed};
use crate::diagnosis::Outcome;
use crate::learned::offer::Offered;
use structures::plot::{escaped, table_of_html, Line, Plot, Points, Scatter};
use structures::simulator::discrepancy::definition::InputDefinition;
use structures::stats;

/// Number of points of a curve.
const CURVE: usize = 61;

/// Greatest number of plots: the inputs and modes on which the discrepancy depends most.
const MOST_PLOTS: usize = 9;

/// Half width of a 90 % interval in standard deviations.
const EDGE: f64 = 1.645;

/// The section about a discrepancy that could be learned.
pub(super) fn learned(offered: &Offered, outcome: &Outcome) -> String {
    let offer = &offered.offer;
    let modes = offered.learned.discrepancy.modes();
    let sizes: Vec<String> =
        offer.size_percent.iter().enumerate().map(|(m, s)| format!("mode {} {} %", m + 1, digits(*s))).collect();
    let command = if offer.gain.is_clear() && offer.change_in_time.is_none() {
        "<p><code>modalwatch extend --learned</code> adds it to the structure.</p>"
    } else {
        ""
    };
    if offer.inputs.is_empty() {
        return format!(
            "<p class=\"lead\">{}</p><p>The constants, beside the most probable parameters: {}.</p>{}{command}",
            escaped(&offer.summary),
            sizes.join(", ").replace('-', "\u{2212}"),
            gain(offered)
        );
    }
    let refused: Vec<String> = offer.refused.iter().map(|text| format!("<p>{}.</p>", escaped(text))).collect();
    let refused = refused.concat();
    let mut curves: Vec<(f64, String)> = Vec::new();
    for mode in (0..modes.len()).filter(|mode| modes[*mode].is_some()) {
        for input in 0..offer.inputs.len() {
            curves.extend(curve(offered, outcome, mode, input));
        }
    }
    curves.sort_by(|a, b| b.0.total_cmp(&a.0));
    let plots: String = curves.into_iter().take(MOST_PLOTS).map(|(_, figure)| figure).collect();
    format!(
        "<p class=\"lead\">{}</p><p>A Gaussian process for each mode describes what the simulation does not: the deviation of the \
         frequency as a function of {}. Nobody knows why it has this form. Effect range (5–95 %): {}.</p>{refused}<p>Each curve is the \
         mean of the process over one input, with all others at their median; the grey band contains the deviation with a \
         probability of 90 %, and is wide where nothing was measured. Dots are measured deviations from the simulation; those of \
         rows held out are open.</p><div class=\"plots\">{plots}</div>{}{command}",
        escaped(&offer.summary),
        escaped(&offer.inputs.join(", ")),
        sizes.join(", "),
        gain(offered)
    )
}

/// Range of the mean over one input for one mode, and the plot of it; `None` for a category or an input without values.
fn curve(offered: &Offered, outcome: &Outcome, mode: usize, input: usize) -> Option<(f64, String)> {
    let discrepancy = &offered.learned.discrepancy;
    let own: &InputDefinition = &discrepancy.definition().inputs[input];
    let [low, high] = own.seen?;
    let known: Vec<&Vec<f64>> = outcome.training.iter().filter_map(|row| offered.u[*row].as_ref()).collect();
    let middle = |other: usize| {
        let mut values: Vec<f64> = known.iter().map(|u| u[other]).collect();
        values.sort_by(f64::total_cmp);
        // Of categories, the median would not be one of them.
        values.get(values.len() / 2).copied()
    };
    let mut u: Vec<f64> = (0..discrepancy.definition().inputs.len()).map(middle).collect::<Option<_>>()?;
    let (mut mean, mut band) = (Vec::with_capacity(CURVE), Vec::with_capacity(CURVE));
    let margin = 0.15 * (high - low);
    for i in 0..CURVE {
        let x = low - margin + (high - low + 2.0 * margin) * i as f64 / (CURVE - 1) as f64;
        u[input] = own.standardised(x);
        let moments = discrepancy.at(Some(&u))[mode];
        let half = EDGE * moments.variance.sqrt();
        mean.push((x, 100.0 * moments.mean));
        band.push((x, 100.0 * (moments.mean - half), 100.0 * (moments.mean + half)));
    }
    let inside = mean.iter().filter(|p| (low..=high).contains(&p.0)).map(|p| p.1);
    let (least, most) = inside.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), y| (l.min(y), h.max(y)));
    let clouds = [(false, &outcome.training), (true, &outcome.holdout)].map(|(hollow, rows)| {
        let name = if hollow { "measured, held out" } else { "measured" };
        let point = |row: &usize| {
            let x = offered.u[*row].as_ref()?[input] * own.scale + own.centre;
            let y = 100.0 * offered.deviations.get(*row)?[mode];
            Some((x, y)).filter(|p| p.1.is_finite())
        };
        Points { name: name.to_owned(), colour: 1, hollow, points: rows.iter().filter_map(point).collect() }
    });
    // A gross outlier would make the curve a flat line.
    let shown: Vec<f64> = clouds.iter().flat_map(|c| c.points.iter().map(|p| p.1)).collect();
    let (bottom, top) = (stats::quantile(&shown, 0.01), stats::quantile(&shown, 0.99));
    let clouds = clouds.map(|mut cloud| {
        cloud.points.retain(|p| (bottom..=top).contains(&p.1));
        cloud
    });
    let plot = Plot {
        title: format!("Mode {} over {}", mode + 1, own.name()),
        x_label: own.name().to_owned(),
        y_label: "deviation of the frequency, %".to_owned(),
        lines: vec![Line { name: "learned".to_owned(), points: mean }],
        band,
        marks: vec![(0.0, String::new())],
    };
    let figure = Scatter { plot, points: clouds.into(), x_names: Vec::new() }.figure("");
    Some((most - least, figure))
}

/// The table of the gain on rows that the discrepancy was not learned from.
fn gain(offered: &Offered) -> String {
    let gain = &offered.offer.gain;
    let density = &gain.log_density_per_row;
    let mut rows: Vec<Vec<String>> = (0..gain.rms_error_percent.before.len())
        .map(|mode| {
            let shown = |values: &[f64]| digits(values[mode]);
            let rms = &gain.rms_error_percent;
            vec![format!("error of mode {}, %", mode + 1), shown(&rms.before), shown(&rms.after)]
        })
        .collect();
    rows.push(vec![
        "log density of a row".to_owned(),
        signed(&format!("{:.2}", density.before)),
        signed(&format!("{:.2}", density.after)),
    ]);
    let inside = |share: f64| format!("{:.0} %", 100.0 * share);
    let coverage = &gain.coverage90;
    rows.push(vec!["inside 90 % intervals".to_owned(), inside(coverage.before), inside(coverage.after)]);
    let title = if gain.held_out {
        format!("On the {} rows held out", gain.rows)
    } else {
        format!("On {} rows, in blocks that were left out in turn", gain.rows)
    };
    table_of_html(&title, &[("figure", true), ("simulation", false), ("with the discrepancy", false)], &rows)
}
