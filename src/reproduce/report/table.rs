//! Tables that compare values and times with those of the paper.

use super::words::{capital, duration, factor, fixed, grouped, method, paper_is_inside, percent, row_decimals};
use crate::plot::{escaped, strip};
use crate::reproduce::result::{Compared, Method, Row, Spread, Time};

/// A table in a scrollable box; `head` and `body` are HTML.
pub fn framed(id: &str, caption: &str, head: &str, body: &str) -> String {
    let caption = escaped(caption);
    let label = caption.split(". ").next().unwrap_or_default();
    format!(
        "<div class=\"scroll\" tabindex=\"0\" role=\"region\" aria-label=\"{label}\"><table class=\"dense\" \
         id=\"{id}\"><caption><span>{caption}</span></caption><thead><tr>{head}</tr></thead>{body}</table></div>"
    )
}

/// Header cells of a table, as HTML: the title of each column (HTML) and whether it is left-aligned.
pub fn head(titles: &[(&str, bool)]) -> String {
    let class = |words: bool| if words { " class=\"words\"" } else { "" };
    let cell = |(title, words): &(&str, bool)| format!("<th scope=\"col\"{}>{title}</th>", class(*words));
    titles.iter().map(cell).collect()
}

/// One figure of a row, printed as one line of the table.
struct Line<'a> {
    row: &'a Row,
    figure: Figure,
}

#[derive(Clone, Copy, PartialEq, Eq)]
enum Figure {
    Mean,
    Std,
    Damage,
}

impl Figure {
    const ALL: [Self; 3] = [Self::Mean, Self::Std, Self::Damage];

    fn name(self, unit: &str) -> String {
        match self {
            Self::Mean => format!("mean, {}", escaped(unit)),
            Self::Std => format!("std, {}", escaped(unit)),
            Self::Damage => "PoD, %".to_owned(),
        }
    }

    fn of(self, row: &Row) -> Option<&Compared> {
        match self {
            Self::Mean => Some(&row.mean),
            Self::Std => Some(&row.std),
            Self::Damage => row.probability_of_damage.as_ref(),
        }
    }
}

const COLUMNS: [(&str, bool); 7] = [
    ("target", false),
    ("ours", false),
    ("5–95 %", false),
    ("paper", false),
    ("paper at", false),
    ("error", false),
    ("side by side", true),
];

/// Tables 3, 4 and 8: what the trained flow finds for each state, followed by a collapsed table of the other methods.
pub fn states(id: &str, caption: &str, rows: &[Row]) -> String {
    let one = |wanted: &[Method], id: &str, caption: &str| {
        let mut body = String::new();
        let mut groups: Vec<(&str, Method)> = Vec::new();
        for row in rows.iter().filter(|row| wanted.contains(&row.method)) {
            let group = (row.state.as_str(), row.method);
            if !groups.contains(&group) {
                groups.push(group);
            }
        }
        for (state, by) in groups {
            let of_group: Vec<&Row> = rows.iter().filter(|row| row.state == state && row.method == by).collect();
            let name = if wanted.len() > 1 { format!("{}, {}", capital(state), method(by)) } else { capital(state) };
            body += &group(&name, &by_parameter(&of_group));
        }
        let titles = [&[("parameter", true), ("number", true)], &COLUMNS[..]].concat();
        framed(id, caption, &head(&titles), &body)
    };
    let others = [Method::Sensitivity, Method::Tmcmc];
    let flow = one(&[Method::Cinn], id, caption);
    if !rows.iter().any(|row| others.contains(&row.method)) {
        return flow;
    }
    let caption = "The same values by the other two methods, which the paper does not print";
    let folded = one(&others, &format!("{id}-others"), caption);
    format!("{flow}<details><summary>The same measurements by the sensitivity method and by TMCMC</summary>{folded}</details>")
}

/// Tables 5 and 9: the three methods for each value.
pub fn methods(id: &str, caption: &str, rows: &[Row]) -> String {
    let mut names: Vec<(&str, &str)> = Vec::new();
    for row in rows {
        if !names.contains(&(&row.parameter, &row.unit)) {
            names.push((&row.parameter, &row.unit));
        }
    }
    let one = |(parameter, unit): (&str, &str)| {
        let of_group: Vec<&Row> = rows.iter().filter(|row| row.parameter == parameter).collect();
        let lines = Figure::ALL.into_iter().map(|figure| {
            let lines: Vec<Line> =
                of_group.iter().filter(|row| figure.of(row).is_some()).map(|row| Line { row, figure }).collect();
            let names = lines.iter().map(|line| method(line.row.method).to_owned()).collect();
            (figure.name(unit), names, lines)
        });
        group(parameter, &lines.collect::<Vec<_>>())
    };
    let body: String = names.into_iter().map(one).collect();
    let titles = [&[("number", true), ("method", true)], &COLUMNS[..]].concat();
    framed(id, caption, &head(&titles), &body)
}

/// A group of lines: its heading, the name of each line (both HTML), and the lines.
type Block<'a> = (String, Vec<String>, Vec<Line<'a>>);

fn by_parameter<'a>(rows: &[&'a Row]) -> Vec<Block<'a>> {
    let one = |row: &&'a Row| {
        let mut name = escaped(&row.parameter);
        if row.damaged {
            name += "<br><span class=\"quiet\">changed</span>";
        }
        if row.outside_prior_percent > 0.0 {
            let outside = percent(row.outside_prior_percent / 100.0);
            name += &["<br><span class=\"quiet\">", &outside, " % drawn<br>outside prior</span>"].concat();
        }
        let lines: Vec<Line> =
            Figure::ALL.into_iter().filter(|f| f.of(row).is_some()).map(|figure| Line { row, figure }).collect();
        (name, lines.iter().map(|line| line.figure.name(&row.unit)).collect(), lines)
    };
    rows.iter().map(one).collect()
}

fn group(title: &str, blocks: &[Block<'_>]) -> String {
    let heading = format!(
        "<tr><th class=\"group\" scope=\"rowgroup\" colspan=\"{}\">{}</th></tr>",
        COLUMNS.len() + 2,
        escaped(title)
    );
    let rows = |(name, names, lines): &Block<'_>| -> String {
        let row = |(i, (line, own)): (usize, (&Line<'_>, &String))| {
            let (count, cells) = (lines.len(), cells(line));
            let own = format!("<th class=\"words\" scope=\"row\">{own}</th>{cells}");
            match i {
                0 => format!(
                    "<tr class=\"first\"><th class=\"words\" scope=\"row\" rowspan=\"{count}\">{name}</th>{own}</tr>"
                ),
                _ => format!("<tr>{own}</tr>"),
            }
        };
        lines.iter().zip(names).enumerate().map(row).collect()
    };
    format!("<tbody>{heading}{}</tbody>", blocks.iter().map(rows).collect::<String>())
}

fn cells(line: &Line<'_>) -> String {
    let Some(compared) = line.figure.of(line.row) else { return String::new() };
    let Compared { ours: Spread { median, low, high }, target, paper, paper_percentile } = *compared;
    let decimals = row_decimals(line.row);
    let shown = |value: f64| match line.figure {
        Figure::Damage => percent(value),
        _ => fixed(value, decimals),
    };
    // Smaller differences do not matter.
    let least = if line.figure == Figure::Damage { 0.02 } else { 0.02 * line.row.std.target };
    let dash = || "–".to_owned();
    let at = paper_percentile.map_or_else(dash, |p| match paper_is_inside(compared) {
        Some(false) => format!("<strong>{} %</strong>", fixed(p, 0)),
        _ => format!("{} %", fixed(p, 0)),
    });
    let cells = [
        shown(target),
        shown(median),
        format!("{} to {}", shown(low), shown(high)),
        paper.map_or_else(dash, shown),
        at,
        error(line, decimals + 1),
        strip([low, median, high], target, paper, least),
    ];
    format!("<td>{}</td>", cells.join("</td><td>"))
}

/// Mean over the repetitions of the absolute difference from the values that were drawn.
fn error(line: &Line<'_>, decimals: usize) -> String {
    let row = line.row;
    match line.figure {
        Figure::Mean => fixed(row.mean_absolute_mean_error, decimals),
        Figure::Std => fixed(row.mean_absolute_std_error, decimals),
        Figure::Damage => row.mean_absolute_pod_error.map_or_else(|| "–".to_owned(), percent),
    }
}

/// Tables 6 and 10: the time of each step of each method, here and in the paper.
pub fn time(id: &str, caption: &str, rows: &[Time]) -> String {
    let reference = rows.iter().find(|t| t.method == Method::Tmcmc).map_or(f64::NAN, |t| t.paper_seconds);
    let one = |t: &Time| {
        let runs = t.model_runs.map_or_else(|| "–".to_owned(), grouped);
        format!(
            "<tr class=\"first\"><th class=\"words\" scope=\"row\">{}: {}</th><td>{}</td><td>{}</td><td>{}</td>\
             <td>{}</td><td>{runs}</td><td class=\"words\">{}</td></tr>",
            method(t.method),
            escaped(&t.step),
            duration(t.seconds),
            duration(t.paper_seconds),
            factor(t.times_faster_than_tmcmc),
            factor(reference / t.paper_seconds),
            escaped(&t.note)
        )
    };
    let body = format!("<tbody>{}</tbody>", rows.iter().map(one).collect::<String>());
    let titles = [
        ("step", true),
        ("here", false),
        ("paper", false),
        ("times as fast<br>as TMCMC, here", false),
        ("in the paper", false),
        ("model runs", false),
        ("on", true),
    ];
    framed(id, caption, &head(&titles), &body)
}

/// A number with its interval.
pub fn interval(value: f64, [low, high]: [f64; 2], decimals: usize) -> String {
    format!(
        "{} <span class=\"quiet\">({} to {})</span>",
        fixed(value, decimals),
        fixed(low, decimals),
        fixed(high, decimals)
    )
}
