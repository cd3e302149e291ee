//! The page of a reproduction: every table and figure of the paper, ours beside its own.

mod case1;
mod case2;
mod figure;
mod summary;
mod table;
mod words;

use super::{Case, Reproduction};
use crate::plot::{anchor, escaped, page, strip_keys};

/// Headings of the cases, and the tables and figures below each.
const CASES: [(&str, [&[usize]; 2]); 2] = [
    ("Case 1: three masses on springs", [&[3, 4, 5, 6], &[8, 9, 10, 11, 12, 13, 14]]),
    ("Case 2: the rig with two sliding links", [&[8, 9, 10], &[16, 17, 18, 19, 20, 21, 22]]),
];

/// One self-contained HTML page; a case that was not run is left out.
pub fn html(reproduction: &Reproduction) -> String {
    let Reproduction { case1, case2, settings, .. } = reproduction;
    let mut sections = vec![
        ("In short".to_owned(), summary::html(reproduction)),
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
    format!("<nav aria-label=\"Contents\"><ul>{cases}</ul><p>Tables and figures carry the paper's numbers.</p></nav>")
}

fn reading(repetitions: usize) -> String {
    let word = if repetitions == 1 { "repetition" } else { "repetitions" };
    let keys = strip_keys(["5–95 % of ours", "our median", "target", "the paper"]);
    format!(
        "<p>Each row is one number that a method finds. <strong>Ours</strong>: median over {repetitions} {word}, \
         each with measurements of its own, and the range from 5 to 95 % of them. <strong>Target</strong>: what the \
         measurements were drawn with. <strong>Paper</strong>: what the paper prints, from one run. \
         <strong>Paper at</strong>: the share of our repetitions below the paper's number, in bold where that \
         number lies outside our range: there it would be unusual as one of ours. <strong>Error</strong>: distance \
         from the mean, standard deviation or share of the values actually drawn in the same repetition, averaged over \
         the repetitions. The target alone is no fair measure: a few dozen draws never have exactly the mean that they \
         were drawn with. <strong>PoD</strong>: probability of damage, the share of the distribution found below δ = μ \
         − 1.645 σ of the undamaged state. The figures show the first repetition.</p><p class=\"keys\">The strips, each on a scale of its own: {keys}</p>"
    )
}

fn notes(case: &Case) -> String {
    if case.notes.is_empty() {
        return String::new();
    }
    let items: Vec<String> = case.notes.iter().map(|note| escaped(note)).collect();
    format!("<div class=\"card\"><h3>What to know first</h3><ul><li>{}</li></ul></div>", items.join("</li><li>"))
}
