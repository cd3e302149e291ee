//! The section on a lasting change.

use super::figures::{plus, signed};
use super::residuals::Drawn;
use crate::data::TIME;
use crate::describe::rounded;
use crate::lasting::found::{LastingChange, ModeChange};
use structures::plot::{escaped, table_of_html};

/// The finding in words, its size in each mode, and the mode in which it is clearest over time.
pub(super) fn lasting_change(change: &LastingChange, drawn: &Drawn<'_>) -> String {
    let clearness = |mode: &ModeChange| (mode.percent / mode.standard_error_percent).abs();
    let clearest = change.modes.iter().max_by(|a, b| clearness(a).total_cmp(&clearness(b)));
    let row = |mode: &ModeChange| {
        let (percent, error) = rounded(mode.percent, mode.standard_error_percent);
        vec![format!("mode {}", mode.mode), format!("{} ± {error}", signed(&percent))]
    };
    let rows: Vec<Vec<String>> = change.modes.iter().map(row).collect();
    let stiffness: Vec<String> = change
        .stiffness
        .iter()
        .map(|s| format!("{} {} ± {:.1} %", escaped(&s.name), plus(s.percent), s.standard_error_percent))
        .collect();
    let stiffness = match stiffness.as_slice() {
        [] => String::new(),
        some => format!("<p>As a change of one {}: {}.</p>", change.what_changed(), some.join(", or ")),
    };
    let plot = clearest.map_or_else(String::new, |mode| {
        let plot = drawn.before_and_after(mode.mode - 1, &drawn.axis(TIME));
        format!("<p>The mode in which it is clearest, over time:</p><div class=\"plots\">{plot}</div>")
    });
    format!(
        "<p class=\"lead\">{}</p><p>How sure this is: {}.</p>{stiffness}{}{plot}",
        escaped(&change.sentence),
        escaped(&change.reliability()),
        table_of_html(
            "Change of the frequencies, with one standard error",
            &[("mode", true), ("change, %", false)],
            &rows
        )
    )
}
