//! Plots as SVG, and the self-contained page they stand in.

use std::fmt::Write as _;

use plotters::prelude::*;
use plotters::style::FontFamily;

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
        self.draw(&mut svg).expect("drawing into memory cannot fail");
        svg
    }

    fn draw(&self, svg: &mut String) -> Result<(), Box<dyn std::error::Error>> {
        let xs = || self.lines.iter().flat_map(|l| l.points.iter().map(|p| p.0));
        let ys = || {
            let lines = self.lines.iter().flat_map(|l| l.points.iter().map(|p| p.1));
            let band = self.band.iter().flat_map(|b| [b.1, b.2]);
            lines.chain(band).chain(self.marks.iter().map(|m| m.0)).filter(|y| y.is_finite())
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
        chart
            .configure_mesh()
            .x_desc(&self.x_label)
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

/// A self-contained HTML page: sections of title and content, which must already be HTML.
pub fn page(title: &str, sections: &[(String, String)]) -> String {
    let mut html = String::new();
    let style = "body{font:16px/1.5 system-ui,sans-serif;max-width:72rem;margin:2rem auto;padding:0 1rem;color:#1a1a1a;\
                 background:#fff}table{border-collapse:collapse;margin:1rem 0}td,th{padding:.25rem .7rem;text-align:right;\
                 border-bottom:1px solid #ddd}th:first-child,td:first-child{text-align:left}.plots{display:flex;\
                 flex-wrap:wrap;gap:1rem}.plots svg{max-width:100%;height:auto}.bad{color:#b00020;font-weight:600}";
    let title = escaped(title);
    write!(
        html,
        "<!doctype html><html lang=\"en\"><head><meta charset=\"utf-8\"><meta name=\"viewport\" \
         content=\"width=device-width,initial-scale=1\"><title>{title}</title><style>{style}</style></head><body><h1>{title}</h1>"
    )
    .expect("writing to memory cannot fail");
    for (heading, content) in sections {
        write!(html, "<section><h2>{}</h2>{content}</section>", escaped(heading))
            .expect("writing to memory cannot fail");
    }
    html.push_str("</body></html>\n");
    html
}

/// A table as HTML.
pub fn table(header: &[&str], rows: &[Vec<String>]) -> String {
    let line = |tag: &str, cells: &mut dyn Iterator<Item = String>| {
        let cells: Vec<String> = cells.map(|cell| format!("<{tag}>{}</{tag}>", escaped(&cell))).collect();
        format!("<tr>{}</tr>", cells.concat())
    };
    let head = line("th", &mut header.iter().map(ToString::to_string));
    let body: String = rows.iter().map(|row| line("td", &mut row.iter().cloned())).collect();
    format!("<table><thead>{head}</thead><tbody>{body}</tbody></table>")
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
    fn a_plot_of_nothing_is_still_a_plot() {
        assert!(Plot::default().svg().starts_with("<svg"));
    }
}
