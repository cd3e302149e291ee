//! Plots as SVG, and the self-contained page they stand in.
//!
//! - [`Plot`] and [`Scatter`]: one large plot on a light card;
//! - [`Panel`] and [`Heat`]: small ones that stand side by side and follow the scheme of the page;
//! - [`density`]: what a panel draws of samples.

pub mod density;
mod heat;
mod panel;
mod strip;
mod ticks;

use std::fmt::Write as _;

use plotters::prelude::*;
use plotters::style::FontFamily;

pub use heat::Heat;
pub use panel::{figure, key, Bars, Cloud, Curve, Panel, Swatch};
pub use strip::{strip, strip_keys};

const WIDTH: u32 = 560;
const HEIGHT: u32 = 320;

/// Colours that people with any colour vision tell apart (Okabe and Ito).
const COLOURS: [RGBColor; 7] = [
    RGBColor(0, 114, 178),
    RGBColor(213, 94, 0),
    RGBColor(0, 158, 115),
    RGBColor(204, 121, 167),
    RGBColor(86, 180, 233),
    RGBColor(230, 159, 0),
    RGBColor(90, 90, 90),
];

/// A named line.
#[derive(Debug, Clone)]
pub struct Line {
    /// Name in the legend.
    pub name: String,
    /// Its points, in the order of x.
    pub points: Vec<(f64, f64)>,
}

/// A named cloud of points, drawn as small circles.
#[derive(Debug, Clone)]
pub struct Points {
    /// Name in the key.
    pub name: String,
    /// Index of its colour.
    pub colour: usize,
    /// Circles that are not filled.
    pub hollow: bool,
    /// Its points.
    pub points: Vec<(f64, f64)>,
}

/// A plot of lines over x.
#[derive(Debug, Clone, Default)]
pub struct Plot {
    /// Title.
    pub title: String,
    /// Label of the x axis, with its unit.
    pub x_label: String,
    /// Label of the y axis, with its unit.
    pub y_label: String,
    /// The lines.
    pub lines: Vec<Line>,
    /// A grey band: lower and upper edge over x.
    pub band: Vec<(f64, f64, f64)>,
    /// Thin horizontal lines with what they stand for.
    pub marks: Vec<(f64, String)>,
}

impl Plot {
    /// The plot as SVG.
    ///
    /// # Panics
    /// Never: drawing into memory cannot fail.
    pub fn svg(&self) -> String {
        let mut svg = String::new();
        self.draw(&mut svg, &[], &[]).expect("drawing into memory cannot fail");
        svg
    }

    fn draw(&self, svg: &mut String, points: &[Points], x_names: &[String]) -> Result<(), Box<dyn std::error::Error>> {
        let all = || self.lines.iter().map(|l| &l.points).chain(points.iter().map(|p| &p.points)).flatten();
        let xs = || all().map(|p| p.0);
        let ys = || {
            let band = self.band.iter().flat_map(|b| [b.1, b.2]);
            all().map(|p| p.1).chain(band).chain(self.marks.iter().map(|m| m.0)).filter(|y| y.is_finite())
        };
        let range = |values: &mut dyn Iterator<Item = f64>| {
            let (low, high) = values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
            let margin = 0.04 * (high - low).max(1e-9);
            if low.is_finite() {
                low - margin..high + margin
            } else {
                0.0..1.0
            }
        };
        let root = SVGBackend::with_string(svg, (WIDTH, HEIGHT)).into_drawing_area();
        let font = |size: i32| (FontFamily::SansSerif, size);
        let mut chart = ChartBuilder::on(&root)
            .caption(&self.title, font(15))
            .margin(8)
            .x_label_area_size(38)
            .y_label_area_size(52)
            .build_cartesian_2d(range(&mut xs()), range(&mut ys()))?;
        let x_name = |x: &f64| {
            let near = (x - x.round()).abs() < 1e-6 && *x > -0.5;
            x_names.get(x.round() as usize).filter(|_| near).cloned().unwrap_or_default()
        };
        let mut mesh = chart.configure_mesh();
        if !x_names.is_empty() {
            mesh.x_labels(2 * x_names.len()).x_label_formatter(&x_name).disable_x_mesh();
        }
        mesh.x_desc(&self.x_label)
            .y_desc(&self.y_label)
            .label_style(font(12))
            .axis_desc_style(font(13))
            .light_line_style(TRANSPARENT)
            .bold_line_style(RGBColor(225, 225, 225))
            .draw()?;
        if !self.band.is_empty() {
            let upper = self.band.iter().map(|b| (b.0, b.2));
            let lower = self.band.iter().rev().map(|b| (b.0, b.1));
            let outline: Vec<(f64, f64)> = upper.chain(lower).collect();
            chart.draw_series([Polygon::new(outline, RGBColor(150, 150, 150).mix(0.3))])?;
        }
        let ends = xs().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), x| (l.min(x), h.max(x)));
        for (y, name) in &self.marks {
            chart.draw_series(LineSeries::new([(ends.0, *y), (ends.1, *y)], RGBColor(110, 110, 110)))?;
            chart.draw_series([Text::new(name.clone(), (ends.0, *y), font(11))])?;
        }
        for series in points {
            let colour = COLOURS[series.colour % COLOURS.len()].mix(0.6);
            let style = if series.hollow { colour.stroke_width(1) } else { colour.filled() };
            chart.draw_series(series.points.iter().map(|point| Circle::new(*point, 2, style)))?;
        }
        for (index, line) in self.lines.iter().enumerate() {
            let style = COLOURS[index % COLOURS.len()].stroke_width(2);
            chart
                .draw_series(LineSeries::new(line.points.iter().copied(), style))?
                .label(&line.name)
                .legend(move |(x, y)| PathElement::new([(x, y), (x + 16, y)], style));
        }
        if self.lines.len() > 1 {
            chart
                .configure_series_labels()
                .label_font(font(12))
                .background_style(WHITE.mix(0.8))
                .border_style(TRANSPARENT)
                .position(SeriesLabelPosition::MiddleRight)
                .draw()?;
        }
        root.present()?;
        Ok(())
    }
}

/// A plot of points over x, and lines where it has some.
#[derive(Debug, Clone, Default)]
pub struct Scatter {
    /// Title, labels, lines, band and marks.
    pub plot: Plot,
    /// Clouds of points.
    pub points: Vec<Points>,
    /// Names that stand at 0, 1, … on the x axis instead of numbers; empty for numbers.
    pub x_names: Vec<String>,
}

impl Scatter {
    /// The plot as an HTML figure that a screen reader can name, with the key of its points and a caption.
    pub fn figure(&self, caption: &str) -> String {
        let Plot { title, x_label, y_label, .. } = &self.plot;
        let label = escaped(&format!("{title}: {y_label} over {x_label}"));
        let mut svg = String::new();
        self.plot.draw(&mut svg, &self.points, &self.x_names).expect("drawing into memory cannot fail");
        // Ticks at 0 may lie a rounding error below it.
        let svg = svg.replace("\n-0.0\n", "\n0.0\n").replacen(
            "<svg ",
            &format!("<svg role=\"img\" aria-label=\"{label}\" "),
            1,
        );
        let key = |p: &Points| {
            let RGBColor(r, g, b) = COLOURS[p.colour % COLOURS.len()];
            let dot = if p.hollow { '○' } else { '●' };
            let name = escaped(&p.name);
            format!("<span class=\"key\"><span style=\"color:rgb({r},{g},{b})\">{dot}</span> {name}</span> ")
        };
        let key: String = self.points.iter().filter(|p| !p.points.is_empty()).map(key).collect();
        let caption = if caption.is_empty() { String::new() } else { format!("<br>{}", escaped(caption)) };
        format!("<figure>{svg}<figcaption>{key}{caption}</figcaption></figure>")
    }
}

/// Style of a page: light and dark, narrow screens, paper. Plots stand on a light card in any scheme.
const STYLE: &str =
    ":root{color-scheme:light dark;--text:#1a1a1a;--page:#fff;--rule:#ddd;--soft:#f3f5f8;--bad:#b00020;--bar:#0072b2}\
     @media(prefers-color-scheme:dark){:root{--text:#e8e8e8;--page:#16181c;--rule:#3c4048;--soft:#22262c;--bad:#ff8a80;\
     --bar:#56b4e9}}body{font:16px/1.5 system-ui,sans-serif;max-width:72rem;margin:2rem auto;padding:0 1rem;\
     color:var(--text);background:var(--page)}h1,h2,h3{line-height:1.25}h2{margin-top:2.5rem}p,dd,li{max-width:52rem}\
     .scroll{overflow-x:auto;margin:1rem 0}table{border-collapse:collapse;font-variant-numeric:tabular-nums}\
     caption{text-align:left;padding:.25rem 0}td,th{padding:.25rem .7rem;text-align:right;vertical-align:top;\
     border-bottom:1px solid var(--rule)}th:first-child,td.words,th.words{text-align:left}td.words{min-width:13rem}\
     td:not(.words){white-space:nowrap}\
     tbody th{font-weight:400;min-width:9rem}.plots{display:flex;flex-wrap:wrap;gap:1rem}\
     .plots svg{max-width:100%;height:auto;background:#fff;border-radius:6px}figure{margin:0;padding:.25rem;\
     background:#fff;color:#1a1a1a;border:1px solid var(--rule);border-radius:6px;flex:0 1 34.25rem}\
     .key{white-space:nowrap;margin-right:.6rem}figcaption{font-size:.85rem;padding:0 .5rem .4rem}\
     .lead{font-size:1.3rem;line-height:1.45}.facts{color:var(--text);\
     opacity:.85;font-size:.9rem}.card{background:var(--soft);border-radius:6px;padding:.75rem 1rem;margin:1rem 0}\
     .card h3{margin:0 0 .4rem}.bar{display:block;width:8rem;height:.6rem;background:var(--soft);fill:var(--bar)}\
     dt{font-weight:600}dd{margin:0 0 .6rem}.bad{color:var(--bad);font-weight:600}\
     .dense th{white-space:nowrap}.dense tbody th{min-width:0}.dense td,.dense th{padding:.2rem .5rem}\
     th.group{font-weight:600;text-align:left;padding-top:.8rem}\
     .dense tbody tr.first>*{border-top:1px solid var(--rule)}.dense tbody td,.dense tbody th{border-bottom:0}\
     .dense{border-bottom:1px solid var(--rule)}caption span{display:inline-block;position:sticky;left:0;\
     max-width:min(52rem,calc(100vw - 2.5rem))}svg.strip{display:block;width:8.75rem;height:1.1rem;margin-top:.2rem}\
     nav ul{padding-left:1.1rem}nav a{white-space:nowrap}a{color:var(--bar)}.quiet{opacity:.75;font-size:.85em}\
     details>summary{cursor:pointer}@media(max-width:40rem){.dense{font-size:.88rem}}@media print{body{margin:0;\
     max-width:none;font-size:11pt}figure,tr,.card{break-inside:avoid}.scroll{overflow:visible}}";

/// A self-contained HTML page: sections of title and content, which must already be HTML.
pub fn page(title: &str, sections: &[(String, String)]) -> String {
    let mut html = String::new();
    let title = escaped(title);
    write!(
        html,
        "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" \
         content=\"width=device-width,initial-scale=1\"><title>{title}</title><style>{STYLE}{}</style></head><body>\
         <h1>{title}</h1>",
        panel::STYLE
    )
    .expect("writing to memory cannot fail");
    for (heading, content) in sections {
        write!(html, "<section id=\"{}\"><h2>{}</h2>{content}</section>", anchor(heading), escaped(heading))
            .expect("writing to memory cannot fail");
    }
    html.push_str("</body></html>\n");
    html
}

/// The id of the section under a heading: its letters and digits, small, with hyphens between.
pub fn anchor(heading: &str) -> String {
    let words = heading.split(|c: char| !c.is_alphanumeric()).filter(|word| !word.is_empty());
    words.map(str::to_lowercase).collect::<Vec<_>>().join("-")
}

/// A table as HTML; the first cell of a row names it.
pub fn table(header: &[&str], rows: &[Vec<String>]) -> String {
    let header: Vec<(&str, bool)> = header.iter().map(|title| (*title, false)).collect();
    let rows: Vec<Vec<String>> = rows.iter().map(|row| row.iter().map(|cell| escaped(cell)).collect()).collect();
    table_of_html("", &header, &rows)
}

/// A table whose cells are HTML already; columns that hold words (`true`) are flush left. It scrolls in its own box.
pub fn table_of_html(caption: &str, header: &[(&str, bool)], rows: &[Vec<String>]) -> String {
    let class = |words: bool| if words { " class=\"words\"" } else { "" };
    let title = |(title, words): &(&str, bool)| format!("<th scope=\"col\"{}>{}</th>", class(*words), escaped(title));
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

/// Text that may hold anything, for HTML.
pub fn escaped(text: &str) -> String {
    text.replace('&', "&amp;").replace('<', "&lt;").replace('>', "&gt;").replace('"', "&quot;")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_plot_is_svg_and_names_are_escaped() {
        let line = |name: &str| Line { name: name.to_owned(), points: vec![(0.0, 1.0), (1.0, 2.0)] };
        let plot = Plot { title: "a <b>".to_owned(), lines: vec![line("k1"), line("<k2>")], ..Plot::default() };
        let svg = plot.svg();
        assert!(svg.starts_with("<svg") && svg.contains("polyline") && !svg.contains("<k2>"), "{svg}");
        let page = page("<x>", &[("y & z".to_owned(), table(&["a"], &[vec!["<i>".to_owned()]]))]);
        assert!(page.contains("&lt;x&gt;") && page.contains("y &amp; z") && page.contains("&lt;i&gt;"));
    }

    #[test]
    fn points_are_circles_and_their_key_is_escaped() {
        let points = vec![(0.1, 1.0), (0.9, 2.0)];
        let series = Points { name: "<held out>".to_owned(), colour: 1, hollow: true, points };
        let x_names = vec!["a".to_owned(), "b".to_owned()];
        let plot = Scatter { plot: Plot::default(), points: vec![series], x_names };
        let figure = plot.figure("x & y");
        assert_eq!(figure.matches("<circle").count(), 2);
        assert!(figure.contains("role=\"img\"") && figure.contains("&lt;held out&gt;") && figure.contains("x &amp; y"));
    }

    #[test]
    fn a_plot_of_nothing_is_still_a_plot() {
        assert!(Plot::default().svg().starts_with("<svg"));
    }
}
