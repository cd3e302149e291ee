//! Summary of what was run and of the results.

use super::words::{duration, factor, fixed, grouped, listed, method, paper_is_inside, percent, row_decimals};
use crate::plot::escaped;
use crate::reproduce::paper::FIVE_HUNDRED;
use crate::reproduce::result::{Case, Method, Reproduction, Row, Time};

/// Largest number of values of the paper that are listed individually.
const MOST_LISTED: usize = 6;

/// Smallest number of repetitions whose range is compared with single values.
const FEWEST: usize = 20;

/// A list of sentences.
pub fn html(reproduction: &Reproduction) -> String {
    let cases: Vec<(&str, &Case)> = [("Case 1", &reproduction.case1), ("Case 2", &reproduction.case2)]
        .into_iter()
        .filter_map(|(name, case)| Some((name, case.as_ref()?)))
        .collect();
    let mut lines = vec![run(reproduction, &cases), machine(reproduction)];
    let all: Vec<(&str, &Row)> =
        cases.iter().flat_map(|(name, case)| rows(case).into_iter().map(move |row| (*name, row))).collect();
    // The range over a few repetitions is too uncertain.
    if reproduction.settings.repetitions >= FEWEST {
        lines.extend(agreement(&all));
    }
    lines.extend(cases.iter().filter_map(|(name, case)| errors(name, &rows(case))));
    lines.extend(cases.iter().filter_map(|(name, case)| methods(name, case)));
    lines.extend(faster(&cases));
    let short =
        "<p class=\"bad\">This was a short demonstration: it has too few repetitions and too little training to judge \
                 the methods.</p>";
    let short = if reproduction.settings.quick { short } else { "" };
    format!("{short}<ul><li>{}</li></ul>", lines.join("</li><li>"))
}

fn rows(case: &Case) -> Vec<&Row> {
    [&case.table3, &case.table4, &case.table5, &case.table8, &case.table9].into_iter().flatten().collect()
}

fn run(reproduction: &Reproduction, cases: &[(&str, &Case)]) -> String {
    let s = &reproduction.settings;
    let names: Vec<String> = cases.iter().map(|(name, _)| (*name).to_owned()).collect();
    let names = if names.is_empty() { "Nothing".to_owned() } else { listed(&names) };
    format!(
        "{names} of Wang et al. (2025, Mechanical Systems and Signal Processing 232, 112743): {} repetitions with \
         new measurements, each by sensitivity-based updating, TMCMC ({} samples) and a cINN (trained once, on {} \
         simulated samples, {} epochs). Seed {}.",
        s.repetitions,
        grouped(s.tmcmc_samples),
        grouped(s.training_samples),
        s.training_epochs,
        s.seed
    )
}

fn machine(reproduction: &Reproduction) -> String {
    let m = &reproduction.machine;
    format!(
        "It took {} on {}, {} threads, {}; modalwatch {}.",
        duration(reproduction.seconds),
        escaped(&m.processor),
        m.threads,
        escaped(&m.system),
        escaped(&m.program_version)
    )
}

/// `k1, scenario 3`.
fn label(row: &Row) -> String {
    format!("{}, {}", escaped(&row.parameter), escaped(&row.state))
}

/// The largest average errors of the flow with respect to the values that were drawn.
fn errors(name: &str, rows: &[&Row]) -> Option<String> {
    let flow = || rows.iter().copied().filter(|row| row.method == Method::Cinn);
    let worst = |error: fn(&Row) -> f64| {
        let known = flow().filter(|row| error(row).is_finite());
        known.max_by(|a, b| (error(a) / a.std.target).total_cmp(&(error(b) / b.std.target)))
    };
    let text = |row: &Row, error: f64| {
        format!(
            "{} {} ({} % of the standard deviation; {})",
            fixed(error, row_decimals(row) + 1),
            escaped(&row.unit),
            fixed(100.0 * error / row.std.target, 1),
            label(row)
        )
    };
    let mean = worst(|row| row.mean_absolute_mean_error)?;
    let std = worst(|row| row.mean_absolute_std_error)?;
    let pod = flow().filter_map(|row| Some((row.mean_absolute_pod_error?, row)));
    let pod = pod.filter(|p| p.0.is_finite()).max_by(|a, b| a.0.total_cmp(&b.0));
    let pod = pod.map_or_else(String::new, |(error, row)| {
        format!(", of a probability of damage {} percentage points ({})", percent(error), label(row))
    });
    Some(format!(
        "{name}, the cINN compared with the values actually drawn: the largest average error of a mean is {}, of a standard \
         deviation {}{pod}.",
        text(mean, mean.mean_absolute_mean_error),
        text(std, std.mean_absolute_std_error)
    ))
}

/// How many of the values of the paper are in our range.
fn agreement(rows: &[(&str, &Row)]) -> Option<String> {
    let figures = rows.iter().flat_map(|(case, row)| {
        // The values of the cINN in Table 5 of the paper repeat those of Table 3.
        let repeated = row.state == FIVE_HUNDRED && row.method == Method::Cinn;
        let all = [("mean", Some(&row.mean)), ("std", Some(&row.std)), ("PoD", row.probability_of_damage.as_ref())];
        let counted = all.into_iter().filter(move |_| !repeated);
        counted.filter_map(move |(what, compared)| Some((*case, *row, what, compared?)))
    });
    let (mut within, mut outside) = (0_usize, Vec::new());
    for (case, row, what, compared) in figures {
        match paper_is_inside(compared) {
            Some(true) => within += 1,
            Some(false) => outside.push(format!("{case}: {what} of {} by {}", label(row), method(row.method))),
            None => {}
        }
    }
    let all = within + outside.len();
    if all == 0 {
        return None;
    }
    let share = fixed(100.0 * within as f64 / all as f64, 0);
    let named = match outside.len() {
        0 => String::new(),
        count if count > MOST_LISTED => " The tables print the others in bold.".to_owned(),
        _ => format!(" Outside: {}.", outside.join("; ")),
    };
    Some(format!("Of the {all} values printed in the paper, {within} ({share} %) are within our 5–95 % range.{named}"))
}

/// Average errors of each method on the same measurements.
fn methods(name: &str, case: &Case) -> Option<String> {
    let (rows, table) = if case.table5.is_empty() { (&case.table9, 9) } else { (&case.table5, 5) };
    let of = |by: Method| {
        let errors: Vec<[f64; 2]> = rows
            .iter()
            .filter(|row| row.method == by)
            .map(|row| [row.mean_absolute_mean_error, row.mean_absolute_std_error].map(|e| 100.0 * e / row.std.target))
            .collect();
        let average = |k: usize| errors.iter().map(|e| e[k]).sum::<f64>() / errors.len() as f64;
        let text = format!("{} {} and {} %", method(by), fixed(average(0), 1), fixed(average(1), 1));
        (!errors.is_empty()).then_some(text)
    };
    let texts: Vec<String> = [Method::Sensitivity, Method::Tmcmc, Method::Cinn].into_iter().filter_map(of).collect();
    (!texts.is_empty()).then(|| {
        format!(
            "{name}, all methods on the same measurements (<a href=\"#table{table}\">Table {table}</a>), average \
             errors of mean and of standard deviation in % of the standard deviation: {}.",
            listed(&texts)
        )
    })
}

/// Speed of the flow relative to TMCMC, here and in the paper.
fn faster(cases: &[(&str, &Case)]) -> Option<String> {
    let one = |(name, case): &(&str, &Case)| {
        let all: Vec<&Time> = case.table6.iter().chain(&case.table10).collect();
        let find = |by: Method, step: &str| all.iter().copied().find(|t| t.method == by && t.step == step);
        let chain = find(Method::Tmcmc, "updating")?;
        let (training, inference) = (find(Method::Cinn, "training")?, find(Method::Cinn, "inference")?);
        let ratio = |own: f64, paper: f64| {
            format!("× {} (paper: × {})", factor(chain.seconds / own), factor(chain.paper_seconds / paper))
        };
        Some(format!(
            "{name} {}, including its training {}",
            ratio(inference.seconds, inference.paper_seconds),
            ratio(inference.seconds + training.seconds, inference.paper_seconds + training.paper_seconds)
        ))
    };
    let texts: Vec<String> = cases.iter().filter_map(one).collect();
    (!texts.is_empty())
        .then(|| format!("Speed of the trained cINN as a multiple of that of TMCMC: {}.", texts.join("; ")))
}
