//! The HTML report of a reproduction, with every table and figure of the paper in comparison.

mod case1;
mod case2;
mod figure;
mod summary;
mod table;
mod words;

use super::result::{Case, Reproduction};
use crate::plot::{anchor, escaped, page, strip_keys};

/// Headings of the cases, and the numbers of their tables and figures.
const CASES: [(&str, [&[usize]; 2]); 2] = [
    ("Case 1: three masses on springs", [&[3, 4, 5, 6], &[8, 9, 10, 11, 12, 13, 14]]),
    ("Case 2: the rig with two sliding links", [&[8, 9, 10], &[16, 17, 18, 19, 20, 21, 22]]),
];

/// One self-contained HTML page. A case that was not run is omitted.
pub fn html(reproduction: &Reproduction) -> String {
    let Reproduction { case1, case2, settings, .. } = reproduction;
    let mut sections = vec![
        ("Summary".to_owned(), summary::html(reproduction)),
        ("Contents".to_owned(), contents([case1.is_some(), case2.is_some()])),
        ("How to read the tables".to_owned(), reading(settings.repetitions)),
    ];
    if let Some(case) = case1 {
        sections.push((CASES[0].0.to_owned(), notes(case) + &case1::html(case)));
    }
    if let Some(case) = case2 {
        sections.push((CASES[1].0.to_owned(), notes(case) + &case2::html(case)));
    }
    page("Wang et al. (2025), repeated by modalwatch", &sections)
}

/// Links to the cases, their tables and their figures.
fn contents(present: [bool; 2]) -> String {
    let links = |what: &str, id: &str, numbers: &[usize]| -> String {
        let link = |n: &usize| format!("<a href=\"#{id}{n}\">{n}</a>");
        format!("{what} {}", numbers.iter().map(link).collect::<Vec<_>>().join(", "))
    };
    let case = |(heading, [tables, figures]): &(&str, [&[usize]; 2])| {
        format!(
            "<li><a href=\"#{}\">{}</a><br>{}. {}.</li>",
            anchor(heading),
            escaped(heading),
            links("Tables", "table", tables),
            links("Figures", "fig", figures)
        )
    };
    let cases: String = CASES.iter().zip(present).filter(|(_, present)| *present).map(|(c, _)| case(c)).collect();
    format!(
        "<nav aria-label=\"Contents\"><ul>{cases}</ul><p>Tables and figures are numbered as in the paper.</p></nav>"
    )
}

/// How to read the tables.
fn reading(repetitions: usize) -> String {
    let word = if repetitions == 1 { "repetition" } else { "repetitions" };
    let keys = strip_keys(["5–95 % of ours", "our median", "target", "paper"]);
    format!(
        "<p>Each row is one value found by a method. <strong>Ours</strong>: the median over {repetitions} {word} with \
         different measurements, and their 5–95 % range. <strong>Target</strong>: the value that the measurements were \
         simulated with. <strong>Paper</strong>: the value printed in the paper, from one run. <strong>Paper at</strong>: \
         the share of our repetitions below the value of the paper, in bold if that value is outside our range. \
         <strong>Error</strong>: the absolute difference from the mean, standard deviation or share of the values that \
         were actually drawn in the same repetition, averaged over the repetitions. A comparison with the target would not \
         be fair, because the mean of a few dozen draws always differs from that of their distribution. \
         <strong>PoD</strong>: the probability of damage, which is the share of the distribution below δ = μ − 1.645 σ of \
         the undamaged state. The figures show the first repetition.</p><p class=\"keys\">The strips, each with its own \
         scale: {keys}</p>"
    )
}

fn notes(case: &Case) -> String {
    if case.notes.is_empty() {
        return String::new();
    }
    let items: Vec<String> = case.notes.iter().map(|note| escaped(note)).collect();
    format!("<div class=\"card\"><h3>Notes</h3><ul><li>{}</li></ul></div>", items.join("</li><li>"))
}
