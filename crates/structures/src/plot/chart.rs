//! Large plots: lines, bands and points over x.

use plotters::prelude::*;
use plotters::style::FontFamily;

use super::colours::COLOURS;
use super::html::escaped;

const WIDTH: u32 = 560;
const HEIGHT: u32 = 320;

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
    /// Whether the circles are drawn without filling.
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
    /// Positions and names of thin horizontal lines.
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

/// A plot of points over x, with optional lines.
#[derive(Debug, Clone, Default)]
pub struct Scatter {
    /// Title, labels, lines, band and marks.
    pub plot: Plot,
    /// Clouds of points.
    pub points: Vec<Points>,
    /// Names at 0, 1, … on the x axis instead of numbers; empty for numbers.
    pub x_names: Vec<String>,
}

impl Scatter {
    /// The plot as an HTML figure with a description for screen readers, the legend of its points and a caption.
    pub fn figure(&self, caption: &str) -> String {
        let Plot { title, x_label, y_label, .. } = &self.plot;
        let label = escaped(&format!("{title}: {y_label} over {x_label}"));
        let mut svg = String::new();
        self.plot.draw(&mut svg, &self.points, &self.x_names).expect("drawing into memory cannot fail");
        // A tick at 0 may be slightly negative because of rounding.
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
