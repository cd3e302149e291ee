//! Small plots that are shown side by side, or below each other on a phone, in the light or dark colours of the page.

use plotters::coord::ranged1d::{KeyPointHint, Ranged};
use plotters::coord::types::RangedCoordf64;
use plotters::prelude::*;
use plotters::style::FontFamily;

use super::colours::COLOURS;
use super::html::escaped;
use super::ticks::Ticks;

/// Width, px: narrow enough for a phone, so that text is never scaled down.
pub(super) const WIDTH: u32 = 340;
const HEIGHT: u32 = 250;
const SQUARE: u32 = 330;

/// Font sizes, px. Plotters writes text in 1/1.24 of the requested size.
pub(super) const SMALL: f64 = 14.5;
const MIDDLE: f64 = 15.5;
const LARGE: f64 = 16.5;

/// Greatest number of points of a cloud that are drawn.
const MOST_DRAWN: usize = 1200;

/// Style sheet of small plots: text in the colour of the page, and on a dark page data in lighter shades of the same colours.
pub(super) const STYLE: &str =
    "figure.small{background:none;color:inherit;border:0;border-radius:0;padding:0;margin:1rem 0 2rem}\
     figure.small figcaption{font-size:.95rem;padding:.35rem 0;max-width:52rem}\
     .panels{display:flex;flex-wrap:wrap;gap:.5rem 1rem}svg.panel{max-width:100%;height:auto;display:block}\
     svg.swatch{width:1.7em;height:.8em;vertical-align:-.05em}.keys{margin:.4rem 0 0;font-size:.9rem}\
     :is(.panel,.strip,.swatch) [fill=\"#000000\"]{fill:var(--text)}\
     :is(.panel,.strip,.swatch) [stroke=\"#000000\"]{stroke:var(--text)}\
     :is(.panel,.strip,.swatch) [stroke=\"#E1E1E1\"]{stroke:var(--rule)}@media(prefers-color-scheme:dark){\
     :is(.panel,.strip,.swatch) [fill=\"#0072B2\"]{fill:#5ab8f0}\
     :is(.panel,.strip,.swatch) [stroke=\"#0072B2\"]{stroke:#5ab8f0}\
     :is(.panel,.strip,.swatch) [fill=\"#D55E00\"]{fill:#ff8a3d}\
     :is(.panel,.strip,.swatch) [stroke=\"#D55E00\"]{stroke:#ff8a3d}\
     :is(.panel,.strip,.swatch) [fill=\"#009E73\"]{fill:#34cfa3}\
     :is(.panel,.strip,.swatch) [stroke=\"#009E73\"]{stroke:#34cfa3}\
     :is(.panel,.strip,.swatch) [fill=\"#CC79A7\"]{fill:#eaa5cb}\
     :is(.panel,.strip,.swatch) [stroke=\"#CC79A7\"]{stroke:#eaa5cb}\
     :is(.panel,.strip,.swatch) [fill=\"#5A5A5A\"]{fill:#a9afb8}\
     :is(.panel,.strip,.swatch) [stroke=\"#5A5A5A\"]{stroke:#a9afb8}}";

/// Bars of a histogram.
#[derive(Debug, Clone, Default)]
pub struct Bars {
    /// Index of their colour.
    pub colour: usize,
    /// Lower edge, upper edge and height.
    pub bars: Vec<(f64, f64, f64)>,
}

/// A curve.
#[derive(Debug, Clone, Default)]
pub struct Curve {
    /// Index of its colour; the colour of text beyond the last.
    pub colour: usize,
    /// Whether the curve is dashed.
    pub dashed: bool,
    /// The area below the curve is tinted up to this x.
    pub filled_to: Option<f64>,
    /// Its points, in the order of x.
    pub points: Vec<(f64, f64)>,
}

/// A cloud of points.
#[derive(Debug, Clone, Default)]
pub struct Cloud {
    /// Index of its colour; the colour of text beyond the last.
    pub colour: usize,
    /// Whether points are crosses instead of dots.
    pub crosses: bool,
    /// Radius, px.
    pub radius: u32,
    /// Its points.
    pub points: Vec<(f64, f64)>,
}

/// A small plot.
#[derive(Debug, Clone, Default)]
pub struct Panel {
    /// Title.
    pub title: String,
    /// Label of the x axis, with its unit.
    pub x_label: String,
    /// Label of the y axis, with its unit.
    pub y_label: String,
    /// Histograms, drawn behind everything else.
    pub bars: Vec<Bars>,
    /// A grey band: lower and upper edge over x.
    pub band: Vec<(f64, f64, f64)>,
    /// Clouds of points.
    pub clouds: Vec<Cloud>,
    /// Curves, drawn in front of everything else.
    pub curves: Vec<Curve>,
    /// Vertical lines, with the text beside their upper end.
    pub verticals: Vec<(f64, String)>,
    /// Values of x and of y that the axes must include.
    pub reach: [Vec<f64>; 2],
    /// Whether the panel is as high as it is wide.
    pub square: bool,
}

/// The symbol before a name in a legend.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Swatch {
    /// A line.
    Line,
    /// A dashed line.
    Dashed,
    /// A bar of a histogram, or a band.
    Bar,
    /// A dot.
    Dot,
    /// A cross.
    Cross,
    /// A short vertical line.
    Upright,
    /// A dashed vertical line.
    Broken,
    /// A diamond.
    Diamond,
}

/// The colour with this index; beyond the last one black, which the page replaces by the colour of its text.
fn colour(index: usize) -> RGBColor {
    COLOURS.get(index).copied().unwrap_or(BLACK)
}

/// An entry of the legend of a figure, as HTML.
pub fn key(swatch: Swatch, index: usize, name: &str) -> String {
    let RGBColor(r, g, b) = colour(index);
    let hex = format!("#{r:02X}{g:02X}{b:02X}");
    let shape = match swatch {
        Swatch::Line => format!("<path d=\"M0 5h22\" stroke=\"{hex}\" stroke-width=\"2.5\"/>"),
        Swatch::Dashed => format!("<path d=\"M0 5h22\" stroke=\"{hex}\" stroke-width=\"2\" stroke-dasharray=\"5 3\"/>"),
        Swatch::Bar => format!("<path d=\"M2 0h18v10h-18z\" fill=\"{hex}\" opacity=\"0.35\"/>"),
        Swatch::Dot => format!("<circle cx=\"11\" cy=\"5\" r=\"3.5\" fill=\"{hex}\"/>"),
        Swatch::Cross => format!("<path d=\"M7 1l8 8M15 1l-8 8\" stroke=\"{hex}\" stroke-width=\"2\"/>"),
        Swatch::Upright => format!("<path d=\"M11 0v10\" stroke=\"{hex}\" stroke-width=\"2.5\"/>"),
        Swatch::Broken => {
            format!("<path d=\"M11 0v10\" stroke=\"{hex}\" stroke-width=\"2\" stroke-dasharray=\"3 2\"/>")
        }
        Swatch::Diamond => format!("<path d=\"M6 5l5-5 5 5-5 5z\" fill=\"{hex}\"/>"),
    };
    format!(
        "<span class=\"key\"><svg class=\"swatch\" viewBox=\"0 0 22 10\" aria-hidden=\"true\">{shape}</svg> {}</span> ",
        escaped(name)
    )
}

/// A figure of panels side by side, as HTML. `id` is its anchor, `keys` its legend as HTML.
pub fn figure(id: &str, panels: &[String], keys: &str, caption: &str) -> String {
    let keys = if keys.is_empty() { String::new() } else { format!("<p class=\"keys\">{keys}</p>") };
    format!(
        "<figure class=\"small\" id=\"{}\"><div class=\"panels\">{}</div>{keys}<figcaption>{}</figcaption></figure>",
        escaped(id),
        panels.concat(),
        escaped(caption)
    )
}

/// The SVG with a description for screen readers, scaled by the page.
pub(super) fn named(svg: &str, label: &str) -> String {
    let head = format!("<svg class=\"panel\" role=\"img\" aria-label=\"{}\" ", escaped(label));
    svg.replacen("<svg ", &head, 1)
}

/// An axis with round ticks.
#[derive(Clone)]
struct Axis {
    line: RangedCoordf64,
    ticks: Ticks,
}

impl Axis {
    /// An axis over all values with about `most` ticks; `from_zero` for densities, which start at 0.
    fn over(values: impl Iterator<Item = f64>, from_zero: bool, most: usize) -> Self {
        let ends = (f64::INFINITY, f64::NEG_INFINITY);
        let (low, high) = values.filter(|v| v.is_finite()).fold(ends, |(l, h), v| (l.min(v), h.max(v)));
        let (low, high) = if low <= high { (low, high) } else { (0.0, 1.0) };
        let margin = 0.04 * (high - low).max(1e-9 * low.abs().max(1e-9));
        let low = if from_zero { 0.0 } else { low - margin };
        let high = if from_zero { 1.07 * high.max(1e-9) } else { high + margin };
        Self { line: (low..high).into(), ticks: Ticks::between(low, high, most) }
    }
}

impl Ranged for Axis {
    type FormatOption = plotters::coord::ranged1d::NoDefaultFormatting;
    type ValueType = f64;

    fn map(&self, value: &f64, limit: (i32, i32)) -> i32 {
        self.line.map(value, limit)
    }

    fn key_points<Hint: KeyPointHint>(&self, _: Hint) -> Vec<f64> {
        self.ticks.at.clone()
    }

    fn range(&self) -> std::ops::Range<f64> {
        self.line.range()
    }
}

impl plotters::coord::ranged1d::ValueFormatter<f64> for Axis {
    fn format_ext(&self, value: &f64) -> String {
        self.ticks.label(*value)
    }
}

impl Panel {
    /// The panel as SVG.
    pub fn svg(&self) -> String {
        let mut svg = String::new();
        self.draw(&mut svg).expect("drawing into memory cannot fail");
        named(&svg, &format!("{}: {} over {}", self.title, self.y_label, self.x_label))
    }

    /// The axes of x and y, which include everything that is drawn.
    fn axes(&self) -> [Axis; 2] {
        let points = || {
            let curves = self.curves.iter().map(|c| &c.points);
            curves.chain(self.clouds.iter().map(|c| &c.points)).flatten()
        };
        let bars = || self.bars.iter().flat_map(|b| &b.bars);
        let x = points().map(|p| p.0).chain(bars().flat_map(|b| [b.0, b.1])).chain(self.verticals.iter().map(|v| v.0));
        let y = points().map(|p| p.1).chain(bars().map(|b| b.2)).chain(self.band.iter().flat_map(|b| [b.1, b.2]));
        let density = self.clouds.is_empty() && self.band.is_empty();
        // Leaves room for the text beside the upper end of vertical lines.
        let top = y.clone().fold(0.0, f64::max) * if self.verticals.is_empty() { 1.0 } else { 1.1 };
        let reach = self.reach[1].iter().copied().chain(density.then_some(top));
        let most = if self.square { 6 } else { 5 };
        [Axis::over(x.chain(self.reach[0].iter().copied()), false, 6), Axis::over(y.chain(reach), density, most)]
    }

    fn draw(&self, svg: &mut String) -> Result<(), Box<dyn std::error::Error>> {
        let root = SVGBackend::with_string(svg, (WIDTH, if self.square { SQUARE } else { HEIGHT })).into_drawing_area();
        let font = |size: f64| (FontFamily::SansSerif, size);
        let [x, y] = self.axes();
        let top = y.range().end;
        let left = y.ticks.widest() as f64 * 0.6 * SMALL / 1.24 + 26.0;
        let mut chart = ChartBuilder::on(&root)
            .caption(&self.title, (FontFamily::SansSerif, LARGE, FontStyle::Bold))
            .margin(4)
            .margin_right(12)
            .x_label_area_size(38)
            .y_label_area_size((left as u32).max(52))
            .build_cartesian_2d(x, y)?;
        chart
            .configure_mesh()
            .x_desc(&self.x_label)
            .y_desc(&self.y_label)
            .label_style(font(SMALL))
            .axis_desc_style(font(MIDDLE))
            .light_line_style(TRANSPARENT)
            .bold_line_style(RGBColor(225, 225, 225))
            .draw()?;
        for series in &self.bars {
            let style = colour(series.colour).mix(0.35).filled();
            chart.draw_series(series.bars.iter().map(|b| Rectangle::new([(b.0, 0.0), (b.1, b.2)], style)))?;
        }
        if !self.band.is_empty() {
            let upper = self.band.iter().map(|b| (b.0, b.2));
            let outline: Vec<(f64, f64)> = upper.chain(self.band.iter().rev().map(|b| (b.0, b.1))).collect();
            chart.draw_series([Polygon::new(outline, colour(6).mix(0.35))])?;
        }
        for cloud in &self.clouds {
            let (shade, radius) = (colour(cloud.colour), cloud.radius);
            let points = thinned(&cloud.points);
            if cloud.crosses {
                chart.draw_series(points.map(|p| Cross::new(p, radius, shade.stroke_width(2))))?;
            } else {
                chart.draw_series(points.map(|p| Circle::new(p, radius, shade.mix(0.55).filled())))?;
            }
        }
        for (x, name) in &self.verticals {
            chart.draw_series(LineSeries::new([(*x, 0.0), (*x, top)], BLACK.stroke_width(1)))?;
            chart.draw_series([EmptyElement::at((*x, top)) + Text::new(name.clone(), (4, 2), font(MIDDLE))])?;
        }
        for curve in &self.curves {
            if let Some(end) = curve.filled_to {
                let mut below: Vec<(f64, f64)> = curve.points.iter().copied().filter(|p| p.0 <= end).collect();
                if let (Some(first), Some(last)) = (below.first().copied(), below.last().copied()) {
                    below.extend([(last.0, 0.0), (first.0, 0.0)]);
                    chart.draw_series([Polygon::new(below, colour(curve.colour).mix(0.3))])?;
                }
            }
            let (points, style) = (curve.points.iter().copied(), colour(curve.colour).stroke_width(2));
            if curve.dashed {
                chart.draw_series(DashedLineSeries::new(points, 5, 3, style))?;
            } else {
                chart.draw_series(LineSeries::new(points, style))?;
            }
        }
        root.present()?;
        Ok(())
    }
}

/// The finite points; evenly thinned if there are too many.
fn thinned(points: &[(f64, f64)]) -> impl Iterator<Item = (f64, f64)> + '_ {
    let stride = points.len().div_ceil(MOST_DRAWN).max(1);
    points.iter().step_by(stride).copied().filter(|p| p.0.is_finite() && p.1.is_finite())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_panel_draws_all_its_parts_and_escapes_their_names() {
        let panel = Panel {
            title: "a <b>".to_owned(),
            bars: vec![Bars { colour: 0, bars: vec![(0.0, 1.0, 0.4), (1.0, 2.0, 0.6)] }],
            curves: vec![Curve { colour: 1, filled_to: Some(1.0), points: density_like(), ..Curve::default() }],
            verticals: vec![(0.7, "<δ>".to_owned())],
            ..Panel::default()
        };
        let svg = panel.svg();
        assert!(svg.matches("<rect").count() >= 2 && svg.contains("polyline") && svg.contains("polygon"), "{svg}");
        assert!(svg.contains("role=\"img\"") && !svg.contains("<b>") && !svg.contains("<δ>"));
        assert!(figure("f", &[svg], &key(Swatch::Dot, 9, "<k>"), "x & y").contains("&lt;k&gt;"));
    }

    fn density_like() -> Vec<(f64, f64)> {
        vec![(0.0, 0.0), (1.0, 1.0), (2.0, 0.0)]
    }

    #[test]
    fn an_empty_panel_and_points_that_are_not_finite_give_valid_svg() {
        let cloud = Cloud { points: vec![(f64::NAN, 1.0), (1.0, f64::INFINITY), (0.5, 0.5)], ..Cloud::default() };
        for panel in [Panel::default(), Panel { clouds: vec![cloud], ..Panel::default() }] {
            let svg = panel.svg();
            assert!(svg.contains("<svg") && !svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        }
    }
}
