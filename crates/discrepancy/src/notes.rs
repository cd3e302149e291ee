//! Properties of the data that limit what a diagnosis can find.

use super::data::{Column, Data, Origin, Values, MOST_LEVELS};
use super::fit::Fit;
use super::grammar::spread;
use super::lasting::found::LastingChange;
use super::problem;
use super::study::Study;
use structures::simulator::Simulator;
use structures::stats;

/// Two covariates whose correlation exceeds this cannot be distinguished.
const COLLINEAR: f64 = 0.98;

/// Noise factor above which a shape scatters more than stated.
const NOISY: f64 = 2.0;

/// Share of independent rows below which the correlation in time is reported.
const CORRELATED: f64 = 0.9;

/// Number of rows below which small effects are likely to be missed.
const FEW_ROWS: usize = 100;

/// Notes on the data and the fit, for a person: modes and covariates without information, settings and parameters outside
/// their priors, noise, correlation in time. `of_differences`: the fit whose noise factors are those of the differences between rows, if they
/// differ.
pub(super) fn notes(
    study: &Study<'_>,
    rows: &[usize],
    fit: &Fit,
    of_differences: Option<&Fit>,
    independent_share: f64,
) -> Vec<String> {
    let (simulator, data) = (study.simulator, study.data);
    let mut notes = modes_seldom_measured(simulator, data, rows);
    notes.extend(simulator.mesh_warning());
    let mut numeric: Vec<(&str, Vec<f64>)> = Vec::new();
    let recorded = |origin: Origin| !matches!(origin, Origin::Product(..)) && origin.cycle().is_none();
    for column in data.columns.iter().filter(|column| recorded(column.origin)) {
        match &column.values {
            Values::Numbers(values) => {
                let Some(filled) = filled(column, values, rows, &mut notes) else { continue };
                for (other, values) in &numeric {
                    let r = correlation(values, &filled);
                    if r.abs() > COLLINEAR {
                        notes.push(format!(
                            "{other} and {} vary together (correlation {r:.3}): these data cannot tell which of the two is the \
                             cause",
                            column.name
                        ));
                    }
                }
                numeric.push((&column.name, filled));
            }
            Values::Categories(names, indices) => notes.extend(unusable_categories(&column.name, names, indices, rows)),
        }
    }
    notes.extend(outside_priors(simulator, fit));
    notes.extend(of_shapes(simulator, data, rows, of_differences.unwrap_or(fit)));
    if independent_share < CORRELATED {
        notes.push(format!(
            "residuals of successive rows are correlated: the rows carry as much information as {:.0} % of their number would if \
             they were independent",
            100.0 * independent_share
        ));
    }
    if rows.len() < FEW_ROWS {
        notes.push(format!("{} rows are few: small effects cannot be detected", rows.len()));
    }
    notes
}

/// Whether the shape of a mode seems to scatter more than stated.
pub(super) fn any_noisy_shape(fit: &Fit) -> bool {
    fit.shape_noise_factor.iter().any(|factor| *factor > NOISY)
}

/// Notes on a lasting change: how sure it is, or why it was not looked for.
pub(super) fn of_change(change: Option<&LastingChange>, untested: Option<String>) -> Vec<String> {
    let untested = untested.map(|why| format!("these rows were not tested for a lasting change in time: {why}"));
    change.map(LastingChange::reliability).into_iter().chain(untested).collect()
}

/// Notes on mode shapes: in how many rows they were measured, their order and their noise.
fn of_shapes(simulator: &Simulator, data: &Data, rows: &[usize], fit: &Fit) -> Vec<String> {
    let Some(shapes) = &data.shapes else { return Vec::new() };
    let points = simulator.instrumented_points().map_or_else(Vec::new, |points| points.names.clone());
    let measured = shapes.rows_with_shapes(rows);
    let mut notes =
        vec![format!("mode shapes at {} are compared in {measured} of {} rows", points.join(", "), rows.len())];
    if shapes.reordered > 0 {
        notes.push(format!(
            "in {} rows the modes were listed in another order than in the others, as their shapes show: they were put in the same \
             order",
            shapes.reordered
        ));
    }
    for (mode, factor) in fit.shape_noise_factor.iter().enumerate() {
        if *factor > NOISY {
            notes.push(format!(
                "the shape of mode {} scatters {factor:.1} times as much as the noise of the structure file states, beyond the \
                 scatter that the spread of the parameters explains",
                mode + 1
            ));
        }
    }
    notes
}

/// Notes on modes that were measured in few rows or in none.
fn modes_seldom_measured(simulator: &Simulator, data: &Data, rows: &[usize]) -> Vec<String> {
    let note = |mode: usize| {
        let measured = rows.iter().filter(|r| data.log_frequencies[**r][mode].is_finite()).count();
        if measured == 0 {
            Some(format!("mode {} was never measured: nothing can be concluded about it", mode + 1))
        } else if measured * 4 < rows.len() {
            Some(format!("mode {} was measured in only {measured} of {} rows", mode + 1, rows.len()))
        } else {
            None
        }
    };
    (0..simulator.modes()).filter_map(note).collect()
}

/// Values of a numeric column with its mean in place of missing ones; `None`, with a note, if they do not vary.
fn filled(column: &Column, values: &[f64], rows: &[usize], notes: &mut Vec<String>) -> Option<Vec<f64>> {
    let name = &column.name;
    let known = column.numbers(rows);
    if spread(column, rows) <= 0.0 {
        notes.push(match known.first() {
            Some(value) => format!("{name} is {value} in every row: no effect of it can be found"),
            None => format!("{name} has no value in any row: no effect of it can be found"),
        });
        return None;
    }
    if known.len() < rows.len() {
        let missing = rows.len() - known.len();
        notes.push(format!(
            "{name} is missing in {missing} of {} rows: in these rows each of its effects consists of its level alone",
            rows.len()
        ));
    }
    let mean = stats::mean(&known);
    Some(rows.iter().map(|r| if values[*r].is_finite() { values[*r] } else { mean }).collect())
}

/// A note on a covariate with too few or too many categories.
fn unusable_categories(name: &str, names: &[String], indices: &[Option<usize>], rows: &[usize]) -> Option<String> {
    let mut used: Vec<usize> = rows.iter().filter_map(|r| indices[*r]).collect();
    used.sort_unstable();
    used.dedup();
    if used.len() == 1 {
        let only = &names[used[0]];
        Some(format!("{name} is {only} in every row: no difference between its categories can be found"))
    } else if used.len() > MOST_LEVELS {
        Some(format!("{name} has {} categories: a covariate with more than {MOST_LEVELS} is not used", used.len()))
    } else {
        None
    }
}

/// Notes on estimated parameters outside their priors.
fn outside_priors(simulator: &Simulator, fit: &Fit) -> Vec<String> {
    let mut notes = Vec::new();
    for &k in &fit.free {
        let p = &simulator.space().as_slice()[k];
        let mean = fit.mean[k];
        if !p.prior().contains(&mean) {
            let (name, unit) = (&p.name, &p.unit);
            let found = if problem::is_searched_to_the_end(p, mean) {
                format!(
                    "no value of {name} that was searched fits best: the search ended at {mean:.4} {unit}, and the frequencies ask for \
                     a {} one. This lies",
                    if mean > p.upper { "larger" } else { "smaller" }
                )
            } else {
                format!("the data give {name} as {mean:.4} {unit},")
            };
            notes.push(format!(
                "{found} outside its prior ({} to {}): the units, the nominal values or the simulation must be wrong",
                p.lower, p.upper
            ));
        }
    }
    notes
}

/// Pearson's correlation coefficient.
fn correlation(a: &[f64], b: &[f64]) -> f64 {
    let (ma, mb) = (stats::mean(a), stats::mean(b));
    let sum = |x: &[f64], mx: f64, y: &[f64], my: f64| x.iter().zip(y).map(|(x, y)| (x - mx) * (y - my)).sum::<f64>();
    sum(a, ma, b, mb) / (sum(a, ma, a, ma) * sum(b, mb, b, mb)).sqrt()
}
