//! The table of the gain.

use super::figures::{digits, plus, signed};
use crate::describe::rounded;
use crate::gain::{Change, Gain, GainMethod};
use crate::gain_words::Modes;
use crate::left_out_modes::{LeftOutMode, LeftOutModes};
use crate::sentence::capitalised;
use structures::plot::{escaped, table_of_html};

/// The table of the modes that were left out in turn.
pub(super) fn left_out_modes(found: &LeftOutModes) -> String {
    let error = |value: f64, std: f64| {
        let (value, std) = rounded(value, std);
        escaped(&format!("{} ± {std}", signed(&value)))
    };
    let row = |m: &LeftOutMode| {
        let (errors, stds) = (&m.error_percent, &m.standard_error_percent);
        vec![m.mode.to_string(), error(errors.before, stds.before), error(errors.after, stds.after)]
    };
    let rows: Vec<Vec<String>> = found.modes.iter().map(row).collect();
    let header = [("mode left out", true), ("error without the causes, %", false), ("error with the causes, %", false)];
    let caption = "Mean deviation of the measured frequency from the prediction by a fit to all other modes, \
                   with its standard error";
    format!(
        "<p>Rows of the same state confirm any constant correction, because it was fitted to their mean. A mode that is left out of the fit \
         can contradict it: {}</p>{}",
        escaped(&found.sentence("with the causes")),
        table_of_html(caption, &header, &rows)
    )
}

/// The table of the gain: each figure without and with the causes, its change and its meaning.
pub(super) fn gain(g: &Gain) -> String {
    let mut rows = Vec::new();
    let mut add = |name: String, values: [String; 3], meaning: &str| {
        rows.push([vec![escaped(&name)], values.map(|v| escaped(&v)).to_vec(), vec![meaning.to_owned()]].concat());
    };
    let rms = &g.rms_error_percent;
    for (mode, [low, high]) in g.rms_difference_interval90.iter().enumerate() {
        let (before, after) = (rms.before[mode], rms.after[mode]);
        let interval = format!("{} ({} to {})", plus(after - before), plus(*low), plus(*high));
        let meaning = if mode == 0 {
            "Root mean square deviation of the measured from the predicted frequency; for its change, the 90 % interval. \
             Smaller is better."
        } else {
            "As above."
        };
        add(format!("error of mode {}, %", mode + 1), [digits(before), digits(after), interval], meaning);
    }
    let l = &g.log_density_per_row;
    let change = rounded(l.difference, l.standard_error);
    add(
        "log density of a row".to_owned(),
        [format!("{:.2}", l.before), format!("{:.2}", l.after), format!("{} ± {}", signed(&change.0), change.1)]
            .map(|v| signed(&v)),
        "Logarithm of the probability density that the simulation predicts for the measurements; ± one standard error. \
         Larger is better; 1 more means 2.7 times as probable.",
    );
    let mut simple = |name: String, c: &Change<f64>, meaning: &str| {
        add(name, [digits(c.before), digits(c.after), plus(c.after - c.before)], meaning);
    };
    let coverage = "Share of the frequencies inside their predicted 90 % interval. It should be 0.90: with less, the intervals are too narrow, \
                    with more, too wide.";
    simple("coverage of 90 % intervals".to_owned(), &g.coverage90, coverage);
    let spread = &g.spread_of_parameters_percent;
    for (place, (name, before)) in spread.before.iter().enumerate() {
        let after = spread.after.get(name).copied().unwrap_or(f64::NAN);
        let meaning = if place == 0 {
            "Standard deviation of the parameter between batches of ten rows, % of its mean. Smaller is better."
        } else {
            "As above."
        };
        simple(format!("spread of {name}, %"), &Change { before: *before, after }, meaning);
    }
    let alarms = format!(
        "Batches of ten of these rows beyond a limit that 1 in 1000 should exceed; the limit is set from the first quarter of the rows \
         searched. {}.",
        capitalised(&g.condition())
    );
    if let Some(change) = &g.false_alarms_per_1000 {
        simple("of 1000 batches, beyond an alarm limit".to_owned(), change, &alarms);
    }
    let loss =
        "Smallest loss of the parameter that is identified worst which one batch of ten rows detects with a probability of \
         90 %. Smaller is better.";
    if let Some(change) = &g.smallest_detectable_loss_percent {
        simple("smallest detectable loss, %".to_owned(), change, loss);
    }
    let header = [
        ("figure", true),
        ("without the causes", false),
        ("with the causes", false),
        ("change", false),
        ("meaning", true),
    ];
    let caption = match g.method {
        GainMethod::HeldOut => {
            format!("Measured on the {} rows held out, which were used neither to find nor to fit the causes", g.holdout_rows)
        }
        GainMethod::CrossValidation => format!(
            "Measured by cross-validation: each of the {} rows is predicted by a fit without its block of rows. The causes were \
             found with all rows, so that the gain is measured a little too large",
            g.holdout_rows
        ),
    };
    format!("<p>{}.</p>{}", escaped(&Modes::of(g).sentence()), table_of_html(&caption, &header, &rows))
}
