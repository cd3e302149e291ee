//! The section on measurements that would decide between candidates.

use crate::next::experiment::NextMeasurement;
use structures::plot::{escaped, table_of_html};

/// The measurements as a table, the best first.
pub(super) fn next_measurements(measurements: &[NextMeasurement]) -> String {
    let row = |m: &NextMeasurement| {
        let repeats = m.repeats_to_95.map_or_else(|| "not with 100".to_owned(), |repeats| repeats.to_string());
        let after = format!("{:.3} ± {:.3}", m.probability_after, m.standard_error);
        vec![escaped(&m.sentence), format!("{:.3}", m.probability_now), after, m.repeats.to_string(), repeats]
    };
    let rows: Vec<Vec<String>> = measurements.iter().map(row).collect();
    let header = [
        ("measurement", true),
        ("expected probability of the right cause now", false),
        ("afterwards", false),
        ("with rows in each of the conditions", false),
        ("rows until 0.95", false),
    ];
    let intro = "<p>Each of these measurements was simulated many times with each candidate as the cause, and the \
         probabilities of the candidates were computed again with it. The table shows the mean probability of the candidate \
         that was simulated, with the standard error of the simulation. Measure the first that is practical, and join it to \
         these data with <code>modalwatch diagnose --next</code>.</p>";
    format!("{intro}{}", table_of_html("", &header, &rows))
}
