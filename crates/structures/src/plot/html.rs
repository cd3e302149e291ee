//! Tables, anchors and text as HTML.

/// The id of the section with this heading: its words in lower case, joined by hyphens.
pub fn anchor(heading: &str) -> String {
    let words = heading.split(|c: char| !c.is_alphanumeric()).filter(|word| !word.is_empty());
    words.map(str::to_lowercase).collect::<Vec<_>>().join("-")
}

/// A table as HTML. `rows` is `[rows][columns]`; the first cell of each row is its heading.
pub fn table(header: &[&str], rows: &[Vec<String>]) -> String {
    let header: Vec<(&str, bool)> = header.iter().map(|title| (*title, false)).collect();
    let rows: Vec<Vec<String>> = rows.iter().map(|row| row.iter().map(|cell| escaped(cell)).collect()).collect();
    table_of_html("", &header, &rows)
}

/// A table whose cells `rows`, `[rows][columns]`, are already HTML. `header` holds the title of each column and whether it
/// contains text, which is left-aligned. A wide table scrolls horizontally.
pub fn table_of_html(caption: &str, header: &[(&str, bool)], rows: &[Vec<String>]) -> String {
    let class = |words: bool| if words { " class=\"words\"" } else { "" };
    // The corner above the headings of the rows is not a heading of a column.
    let title = |(title, words): &(&str, bool)| {
        if title.is_empty() {
            return "<td></td>".to_owned();
        }
        format!("<th scope=\"col\"{}>{}</th>", class(*words), escaped(title))
    };
    let head: String = header.iter().map(title).collect();
    let cell = |(column, cell): (usize, &String)| match column {
        0 => format!("<th scope=\"row\">{cell}</th>"),
        _ => format!("<td{}>{cell}</td>", class(header.get(column).is_some_and(|h| h.1))),
    };
    let line = |row: &Vec<String>| format!("<tr>{}</tr>", row.iter().enumerate().map(cell).collect::<String>());
    let body: String = rows.iter().map(line).collect();
    let caption = if caption.is_empty() { String::new() } else { format!("<caption>{}</caption>", escaped(caption)) };
    format!(
        "<div class=\"scroll\" tabindex=\"0\"><table>{caption}<thead><tr>{head}</tr></thead><tbody>{body}</tbody>\
         </table></div>"
    )
}

/// The text with the special characters of HTML escaped.
pub fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}
