//! Drawings of structures: bodies, springs, beams and supports at given places, with colours for changes and a displaced shape.

use std::fmt::Write as _;

use super::html::escaped;
use super::ticks::Ticks;

/// Width of a drawing, and the margin around its parts, px.
const WIDTH: f64 = 640.0;
const MARGIN: f64 = 90.0;

/// Largest displacement of a shape, as a share of the extent of the drawing.
const SWING: f64 = 0.12;

/// Most points of a line of a shape that are drawn as dots.
const MOST_DOTS: usize = 12;

/// Farthest that a spring goes aside, px.
const BEND_PX: f64 = 0.55 * MARGIN;

/// A white edge, so that text can be read on lines.
const HALO: &str = "paint-order=\"stroke\" stroke=\"#ffffff\" stroke-width=\"3\"";

/// Half the size of a body, px.
const BODY: f64 = 16.0;

/// Points along a spring, and the half height of its zigzag, px.
const ZIGZAG: usize = 14;
const ZIGZAG_PX: f64 = 6.0;

/// Colours of a loss, of no change and of a gain; they differ for all kinds of colour vision.
const LOSS: [f64; 3] = [213.0, 94.0, 0.0];
const SAME: [f64; 3] = [90.0, 90.0, 90.0];
const GAIN: [f64; 3] = [0.0, 114.0, 178.0];

/// A point of a drawing: to the right and upwards, in the unit of the drawing.
pub type Place = [f64; 2];

/// A body, or a node of a beam.
#[derive(Debug, Clone, PartialEq)]
pub struct Body {
    /// Its name, which is written beside it.
    pub name: String,
    /// A second line, such as its mass.
    pub label: String,
    /// Where it is.
    pub at: Place,
    /// Whether it is drawn as a square; a node without a body is a point.
    pub solid: bool,
}

/// Kind of a link.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LinkKind {
    /// A zigzag.
    Spring,
    /// A spiral about a point, for a rotational spring.
    Rotation,
    /// A straight bar.
    Beam,
}

/// A spring or a beam span between two places.
#[derive(Debug, Clone, PartialEq)]
pub struct Link {
    /// Its name, which is written beside it.
    pub name: String,
    /// A second line, such as its stiffness.
    pub label: String,
    /// How it is drawn.
    pub kind: LinkKind,
    /// Its ends.
    pub ends: [Place; 2],
    /// Index of the body at each end; `None` at the ground.
    pub bodies: [Option<usize>; 2],
    /// Distance of its middle from the straight line, as a share of its length: it goes around what lies between.
    pub bend: f64,
    /// Change in per cent, which gives it its colour.
    pub change_percent: Option<f64>,
    /// Whether it is outlined, for an open alarm.
    pub alarm: bool,
}

/// A hatched line: the ground, or a support.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Fixed {
    /// Holds the end of a spring or the displacement of a node.
    Ground(Place),
    /// Holds displacement and rotation.
    Clamp(Place),
    /// Holds the rotation only.
    Guide(Place),
}

/// A drawing of a structure.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Drawing {
    /// Its title, which is read aloud too.
    pub title: String,
    /// Bodies and nodes.
    pub bodies: Vec<Body>,
    /// Springs and beam spans.
    pub links: Vec<Link>,
    /// The ground and the supports.
    pub fixed: Vec<Fixed>,
    /// Unit of an axis below the drawing, if its places have a unit.
    pub axis: Option<String>,
    /// A displaced shape: polylines of a place and its displacement, which is scaled to be seen.
    pub shape: Vec<Vec<(Place, Place)>>,
    /// What the shape is, such as `mode 1, 0.95 Hz`.
    pub shape_label: String,
    /// Measured displacements of single places, on the scale of `shape`.
    pub measured: Vec<(Place, Place)>,
    /// What was measured, such as `measured, MAC 0.998`.
    pub measured_label: String,
    /// Change at which the colours are strongest, per cent.
    pub full_percent: f64,
}

/// Places in px.
struct Frame {
    low: Place,
    scale: Place,
    height: f64,
}

impl Frame {
    fn at(&self, place: Place) -> Place {
        let [x, y] = [0, 1].map(|i| (place[i] - self.low[i]) * self.scale[i]);
        [MARGIN + x, self.height - MARGIN - y]
    }
}

/// The colour of a change: grey for none, orange for a loss, blue for a gain, strongest from `full_percent` on.
pub fn colour_of_change(percent: f64, full_percent: f64) -> String {
    let share = (percent.abs() / full_percent.max(1e-9)).clamp(0.0, 1.0);
    let end = if percent < 0.0 { LOSS } else { GAIN };
    let [r, g, b] = [0, 1, 2].map(|i| (SAME[i] + share * (end[i] - SAME[i])).round() as u8);
    format!("#{r:02x}{g:02x}{b:02x}")
}

impl Drawing {
    /// The drawing as SVG. Each part is a group with its name in `data-name`, so that a page can react to it.
    pub fn svg(&self) -> String {
        let frame = self.frame();
        let mut svg = String::new();
        let mut add = |part: String| svg.push_str(&part);
        let title = escaped(&self.title);
        add(format!(
            "<svg xmlns=\"http://www.w3.org/2000/svg\" viewBox=\"0 0 {WIDTH:.0} {:.0}\" width=\"{WIDTH:.0}\" role=\"img\" \
             aria-label=\"{title}\" font-family=\"system-ui,sans-serif\" font-size=\"12\" fill=\"#1a1a1a\"><title>{title}</title>\
             <rect width=\"100%\" height=\"100%\" fill=\"#ffffff\"/><text x=\"12\" y=\"22\" font-size=\"14\" \
             font-weight=\"600\">{title}</text>",
            frame.height
        ));
        self.fixed.iter().for_each(|fixed| add(fixed_svg(*fixed, &frame)));
        add(self.shape_svg(&frame));
        (0..self.links.len()).for_each(|index| add(self.link_svg(index, &frame)));
        self.bodies.iter().for_each(|body| add(body_svg(body, &frame, self.axis.is_some())));
        add(self.axis_svg(&frame));
        add(self.key_svg(&frame));
        svg.push_str("</svg>\n");
        svg
    }

    fn frame(&self) -> Frame {
        let fixed = self.fixed.iter().map(|fixed| match fixed {
            Fixed::Ground(at) | Fixed::Clamp(at) | Fixed::Guide(at) => *at,
        });
        let places =
            || self.bodies.iter().map(|b| b.at).chain(self.links.iter().flat_map(|l| l.ends)).chain(fixed.clone());
        let end = |i: usize, start: f64, pick: fn(f64, f64) -> f64| places().map(|p| p[i]).fold(start, pick);
        let low = [0, 1].map(|i| end(i, f64::INFINITY, f64::min)).map(|v| if v.is_finite() { v } else { 0.0 });
        let high = [0, 1].map(|i| end(i, f64::NEG_INFINITY, f64::max)).map(|v| if v.is_finite() { v } else { 1.0 });
        let extent = [0, 1].map(|i| high[i] - low[i]);
        let across = WIDTH - 2.0 * MARGIN;
        // Without an axis a step is equally long in both directions; with one the vertical direction has no unit.
        let x_scale = if extent[0] > 0.0 { across / extent[0] } else { 0.0 };
        let step = if self.axis.is_some() || x_scale == 0.0 { 110.0 } else { x_scale.min(110.0) };
        let x_scale = if self.axis.is_some() { x_scale } else { step };
        let low_x = if self.axis.is_some() { low[0] } else { low[0] - 0.5 * (across / step - extent[0]) };
        Frame { low: [low_x, low[1]], scale: [x_scale, step], height: 2.0 * MARGIN + step * extent[1] }
    }

    fn link_svg(&self, index: usize, frame: &Frame) -> String {
        let link = &self.links[index];
        // Springs side by side between the same bodies have their names one above the other.
        let above = 30.0 * self.links[..index].iter().filter(|other| other.bodies == link.bodies).count() as f64;
        let [from, to] = link.ends.map(|end| frame.at(end));
        let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
        let length = dx.hypot(dy).max(1.0);
        let (nx, ny) = (-dy / length, dx / length);
        // A positive bend goes upwards, or to the left of what is upright, and stays within the margin.
        let aside = (link.bend * length).clamp(-BEND_PX, BEND_PX);
        let middle = [0.5 * (from[0] + to[0]) - nx * aside, 0.5 * (from[1] + to[1]) - ny * aside];
        let points: Vec<Place> = match link.kind {
            LinkKind::Beam => vec![from, to],
            LinkKind::Spring => zigzag(from, to, middle),
            LinkKind::Rotation => spiral(from),
        };
        let path: Vec<String> = points.iter().map(|[x, y]| format!("{x:.1},{y:.1}")).collect();
        let path = path.join(" ");
        let colour = link
            .change_percent
            .map_or_else(|| colour_of_change(0.0, 1.0), |percent| colour_of_change(percent, self.full_percent));
        let width = if link.kind == LinkKind::Beam { 7.0 } else { 2.0 };
        let name = escaped(&link.name);
        let mut svg = format!("<g class=\"link\" data-name=\"{name}\">");
        if link.alarm {
            write!(
                svg,
                "<polyline points=\"{path}\" fill=\"none\" stroke=\"#000000\" stroke-width=\"{}\"/>",
                width + 4.0
            )
            .expect("writing to memory cannot fail");
        }
        let change = link.change_percent.map_or_else(String::new, |p| format!(" {p:+.1} %").replace('-', "−"));
        let label = escaped(&link.label);
        // Beside the middle of the link: to the right of what is upright, above what is level.
        let (x, y, anchor) = match link.kind {
            LinkKind::Beam => (middle[0], middle[1] - 22.0, "middle"),
            LinkKind::Rotation => (from[0] + 16.0, from[1] + 26.0, "start"),
            LinkKind::Spring if dy.abs() > dx.abs() => (middle[0] + 12.0, middle[1] - 2.0 - above, "start"),
            LinkKind::Spring => (middle[0], middle[1] - 24.0, "middle"),
        };
        write!(
            svg,
            "<polyline points=\"{path}\" fill=\"none\" stroke=\"{colour}\" stroke-width=\"{width}\" stroke-linejoin=\"round\"/>\
             <text {HALO} x=\"{x:.1}\" y=\"{y:.1}\" text-anchor=\"{anchor}\" font-weight=\"600\">{name}{change}</text><text {HALO} x=\"{x:.1}\" \
             y=\"{:.1}\" text-anchor=\"{anchor}\" font-size=\"11\">{label}</text></g>",
            y + 13.0
        )
        .expect("writing to memory cannot fail");
        svg
    }

    fn shape_svg(&self, frame: &Frame) -> String {
        let all = || self.shape.iter().flatten().chain(&self.measured);
        let largest = all().map(|(_, moved)| moved[0].hypot(moved[1])).fold(0.0, f64::max);
        if largest <= 0.0 {
            return String::new();
        }
        let swing = SWING * (WIDTH - 2.0 * MARGIN) / largest;
        let mut svg = String::from("<g class=\"shape\" fill=\"none\" stroke=\"#009e73\" stroke-width=\"2\">");
        // A page that animates the shape needs each point at rest and its displacement.
        let motion = |(place, moved): &(Place, Place)| (frame.at(*place), [swing * moved[0], -swing * moved[1]]);
        for line in &self.shape {
            let moving: Vec<(Place, Place)> = line.iter().map(motion).collect();
            let joined = |place: &dyn Fn(&(Place, Place)) -> Place| {
                let pair = |one: &(Place, Place)| {
                    let [x, y] = place(one);
                    format!("{x:.1},{y:.1}")
                };
                moving.iter().map(pair).collect::<Vec<_>>().join(" ")
            };
            write!(
                svg,
                "<polyline points=\"{}\" data-rest=\"{}\" data-moved=\"{}\" stroke-dasharray=\"5 3\"/>",
                joined(&displaced),
                joined(&|one| one.0),
                joined(&|one| one.1)
            )
            .expect("writing to memory cannot fail");
            if moving.len() <= MOST_DOTS {
                let dot = "r=\"4\" fill=\"#009e73\" stroke=\"none\"";
                svg.extend(moving.iter().map(|one| dot_svg(one, dot)));
            }
        }
        svg.push_str("</g>");
        if !self.measured.is_empty() {
            svg.push_str("<g class=\"measured-shape\">");
            let dot = "r=\"7\" fill=\"none\" stroke=\"#7b2d8b\" stroke-width=\"2.5\"";
            svg.extend(self.measured.iter().map(|one| dot_svg(&motion(one), dot)));
            write!(
                svg,
                "<text x=\"{:.0}\" y=\"40\" text-anchor=\"end\" fill=\"#7b2d8b\">{}</text></g>",
                WIDTH - 12.0,
                escaped(&self.measured_label)
            )
            .expect("writing to memory cannot fail");
        }
        write!(
            svg,
            "<text x=\"{:.0}\" y=\"22\" text-anchor=\"end\" fill=\"#006b4e\">{}</text>",
            WIDTH - 12.0,
            escaped(&self.shape_label)
        )
        .expect("writing to memory cannot fail");
        svg
    }

    fn axis_svg(&self, frame: &Frame) -> String {
        let Some(unit) = &self.axis else { return String::new() };
        let (first, last) = (frame.low[0], frame.low[0] + (WIDTH - 2.0 * MARGIN) / frame.scale[0].max(1e-12));
        let y = frame.height - 42.0;
        let mut svg = format!(
            "<g class=\"axis\" font-size=\"11\" text-anchor=\"middle\"><line x1=\"{MARGIN}\" x2=\"{:.1}\" y1=\"{y:.1}\" y2=\"{y:.1}\" \
             stroke=\"#1a1a1a\"/>",
            WIDTH - MARGIN
        );
        let ticks = Ticks::between(first, last, 8);
        for tick in &ticks.at {
            let [x, _] = frame.at([*tick, frame.low[1]]);
            write!(
                svg,
                "<line x1=\"{x:.1}\" x2=\"{x:.1}\" y1=\"{y:.1}\" y2=\"{:.1}\" stroke=\"#1a1a1a\"/><text x=\"{x:.1}\" y=\"{:.1}\">{}</text>",
                y + 4.0,
                y + 16.0,
                ticks.label(*tick)
            )
            .expect("writing to memory cannot fail");
        }
        write!(svg, "<text x=\"{:.1}\" y=\"{:.1}\">{}</text></g>", WIDTH - 0.5 * MARGIN, y + 4.0, escaped(unit))
            .expect("writing to memory cannot fail");
        svg
    }

    /// What the colours mean, if a part has one.
    fn key_svg(&self, frame: &Frame) -> String {
        if self.links.iter().all(|link| link.change_percent.is_none()) {
            return String::new();
        }
        let full = self.full_percent;
        let y = frame.height - 8.0;
        let words = [format!("−{full:.0} %"), "no change".to_owned(), format!("+{full:.0} %")];
        let one = |(place, percent): (usize, f64)| {
            let x = 12.0 + 92.0 * place as f64;
            format!(
                "<line x1=\"{x}\" x2=\"{}\" y1=\"{}\" y2=\"{}\" stroke=\"{}\" stroke-width=\"5\"/><text x=\"{}\" y=\"{y}\" \
                 font-size=\"11\">{}</text>",
                x + 24.0,
                y - 4.0,
                y - 4.0,
                colour_of_change(percent, full),
                x + 30.0,
                words[place]
            )
        };
        [-full, 0.0, full].into_iter().enumerate().map(one).collect()
    }
}

/// Where a place at rest is after its displacement.
fn displaced((rest, moved): &(Place, Place)) -> Place {
    [rest[0] + moved[0], rest[1] + moved[1]]
}

/// A dot at a displaced place, with its place at rest and its displacement for a page that animates it.
fn dot_svg(one: &(Place, Place), style: &str) -> String {
    let ([x, y], [rest_x, rest_y], [dx, dy]) = (displaced(one), one.0, one.1);
    format!(
        "<circle cx=\"{x:.1}\" cy=\"{y:.1}\" data-rest=\"{rest_x:.1},{rest_y:.1}\" data-moved=\"{dx:.1},{dy:.1}\" {style}/>"
    )
}

/// A body with its label: beside it, or below it on a beam, whose own label stands beside it.
fn body_svg(body: &Body, frame: &Frame, on_beam: bool) -> String {
    let [x, y] = frame.at(body.at);
    let name = escaped(&body.name);
    let form = if body.solid {
        let (left, top, size) = (x - BODY, y - BODY, 2.0 * BODY);
        format!(
            "<rect x=\"{left:.1}\" y=\"{top:.1}\" width=\"{size}\" height=\"{size}\" rx=\"3\" fill=\"#d7e3ee\" stroke=\"#1a1a1a\"/>"
        )
    } else {
        format!("<circle cx=\"{x:.1}\" cy=\"{y:.1}\" r=\"4\" fill=\"#1a1a1a\"/>")
    };
    let (text_y, label_x, label_y, anchor) = match (body.solid, on_beam) {
        (true, false) => (y + 4.0, x - BODY - 4.0, y - BODY + 2.0, "end"),
        (true, true) => (y + 4.0, x - BODY, y + BODY + 14.0, "end"),
        (false, _) => (y + 18.0, x, y + 31.0, "middle"),
    };
    format!(
        "<g class=\"body\" data-name=\"{name}\">{form}<text x=\"{x:.1}\" y=\"{text_y:.1}\" text-anchor=\"middle\">{name}</text>\
         <text {HALO} x=\"{label_x:.1}\" y=\"{label_y:.1}\" text-anchor=\"{anchor}\" font-size=\"11\">{}</text></g>",
        escaped(&body.label)
    )
}

/// A hatched line below a place, or beside it for what holds the rotation.
fn fixed_svg(fixed: Fixed, frame: &Frame) -> String {
    let (at, upright, triangle) = match fixed {
        Fixed::Ground(at) => (at, false, false),
        Fixed::Clamp(at) => (at, true, false),
        Fixed::Guide(at) => (at, true, true),
    };
    let [x, y] = frame.at(at);
    let mut svg = String::from("<g class=\"fixed\" stroke=\"#1a1a1a\" stroke-width=\"1.5\" fill=\"none\">");
    let mut line = |x1: f64, y1: f64, x2: f64, y2: f64| {
        write!(svg, "<line x1=\"{x1:.1}\" y1=\"{y1:.1}\" x2=\"{x2:.1}\" y2=\"{y2:.1}\"/>")
            .expect("writing to memory cannot fail");
    };
    if upright {
        line(x, y - 18.0, x, y + 18.0);
        (-2..=2).map(f64::from).for_each(|i| line(x - 7.0, y + 8.0 * i + 6.0, x, y + 8.0 * i));
    } else {
        line(x - 20.0, y, x + 20.0, y);
        (-2..=2).map(f64::from).for_each(|i| line(x + 8.0 * i - 6.0, y + 8.0, x + 8.0 * i, y));
    }
    if triangle {
        line(x + 4.0, y - 18.0, x + 4.0, y + 18.0);
    }
    svg.push_str("</g>");
    svg
}

/// A zigzag along the curve from one place to another whose middle is at `middle`, px.
fn zigzag(from: Place, to: Place, middle: Place) -> Vec<Place> {
    let control = [0, 1].map(|i| 2.0 * middle[i] - 0.5 * (from[i] + to[i]));
    let on = |t: f64| [0, 1].map(|i| (1.0 - t).powi(2) * from[i] + 2.0 * t * (1.0 - t) * control[i] + t * t * to[i]);
    let along = |t: f64| [0, 1].map(|i| 2.0 * (1.0 - t) * (control[i] - from[i]) + 2.0 * t * (to[i] - control[i]));
    let point = |step: usize| {
        let t = step as f64 / ZIGZAG as f64;
        let ([x, y], [dx, dy]) = (on(t), along(t));
        let length = dx.hypot(dy).max(1e-9);
        // Straight at both ends.
        let side = if step < 3 || step + 3 > ZIGZAG {
            0.0
        } else if step.is_multiple_of(2) {
            ZIGZAG_PX
        } else {
            -ZIGZAG_PX
        };
        [x - side * dy / length, y + side * dx / length]
    };
    (0..=ZIGZAG).map(point).collect()
}

/// A spiral about a place, px.
fn spiral([x, y]: Place) -> Vec<Place> {
    (0..=40)
        .map(f64::from)
        .map(|i| [x + (4.0 + 0.35 * i) * (0.35 * i).cos(), y + (4.0 + 0.35 * i) * (0.35 * i).sin()])
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn one_spring(change_percent: Option<f64>, alarm: bool) -> Drawing {
        let body = Body { name: "<m1>".to_owned(), label: "5 kg".to_owned(), at: [0.0, 1.0], solid: true };
        let link = Link {
            name: "k1".to_owned(),
            label: "3 MN/m".to_owned(),
            kind: LinkKind::Spring,
            ends: [[0.0, 0.0], [0.0, 1.0]],
            bodies: [None, Some(0)],
            bend: 0.0,
            change_percent,
            alarm,
        };
        Drawing {
            title: "a & b".to_owned(),
            bodies: vec![body],
            links: vec![link],
            fixed: vec![Fixed::Ground([0.0, 0.0])],
            full_percent: 10.0,
            ..Drawing::default()
        }
    }

    #[test]
    fn a_drawing_names_its_parts_and_shows_changes_and_alarms() {
        let svg = one_spring(None, false).svg();
        assert!(svg.contains("data-name=\"k1\"") && svg.contains("&lt;m1&gt;") && svg.contains("a &amp; b"), "{svg}");
        assert!(!svg.contains("NaN") && !svg.contains("inf") && !svg.contains("<m1>"), "{svg}");
        let changed = one_spring(Some(-7.9), true).svg();
        assert!(changed.contains("k1 −7.9 %") && changed.contains(&colour_of_change(-7.9, 10.0)), "{changed}");
        let lines = |svg: &str| svg.matches("<polyline").count();
        assert_eq!(lines(&changed), lines(&svg) + 1, "the outline of an alarm");
    }

    #[test]
    fn springs_side_by_side_have_their_names_at_different_heights() {
        let mut drawing = one_spring(None, false);
        let first = drawing.links[0].clone();
        drawing.links.push(Link { name: "k2".to_owned(), ends: [[0.5, 0.0], [0.0, 1.0]], ..first });
        let svg = drawing.svg();
        let height = |name: &str| -> f64 {
            let before = svg.split(&format!(">{name}</text>")).next().unwrap();
            before.rsplit(" y=\"").next().unwrap().split('"').next().unwrap().parse().unwrap()
        };
        assert!((height("k1") - height("k2")).abs() > 26.0, "{svg}");
    }

    #[test]
    fn colours_go_from_a_loss_over_grey_to_a_gain() {
        let colours = [-20.0, -10.0, 0.0, 10.0].map(|percent| colour_of_change(percent, 10.0));
        assert_eq!(colours, ["#d55e00", "#d55e00", "#5a5a5a", "#0072b2"]);
    }

    #[test]
    fn an_empty_drawing_and_a_shape_of_zeros_are_valid() {
        let mut drawing = Drawing { shape: vec![vec![([0.0, 0.0], [0.0, 0.0])]], ..Drawing::default() };
        assert!(drawing.svg().ends_with("</svg>\n"));
        drawing.shape = vec![vec![([0.0, 0.0], [1e-9, 0.0]), ([0.0, 1.0], [0.0, 0.0])]];
        assert!(!drawing.svg().contains("NaN"));
    }
}
