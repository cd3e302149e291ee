//! A range as a small figure in the cell of a table, with a target to compare it with.

use std::fmt::Write as _;

use super::panel::{key, Swatch};

const WIDTH: f64 = 140.0;
const EDGE: f64 = 8.0;

/// A small figure as SVG: a bar from the low to the high end of a range with a line at its median, a dashed line at the target,
/// and a diamond at another value.
///
/// The strip spans all these values, but at least a range of `least`, so that nearly equal values are drawn close together.
pub fn strip([low, median, high]: [f64; 3], target: f64, other: Option<f64>, least: f64) -> String {
    let all = || [low, median, high, target].into_iter().chain(other).filter(|v| v.is_finite());
    let (first, last) = all().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
    if first > last {
        return String::new();
    }
    let middle = 0.5 * (first + last);
    let span = (last - first).max(least).max(f64::MIN_POSITIVE);
    let at = |v: f64| WIDTH / 2.0 + (WIDTH - 2.0 * EDGE) * (v - middle) / span;
    let mut svg = format!("<svg class=\"strip\" viewBox=\"0 0 {WIDTH} 18\" aria-hidden=\"true\">");
    let mut add = |shape: String| svg.write_str(&shape).expect("writing to memory cannot fail");
    if low.is_finite() && high.is_finite() {
        let (x, width) = (at(low), (at(high) - at(low)).max(2.0));
        add(format!(
            "<rect x=\"{x:.1}\" y=\"5\" width=\"{width:.1}\" height=\"8\" fill=\"#0072B2\" opacity=\"0.35\"/>"
        ));
    }
    if median.is_finite() {
        add(format!("<path d=\"M{:.1} 3v12\" stroke=\"#0072B2\" stroke-width=\"2.5\"/>", at(median)));
    }
    if target.is_finite() {
        add(format!(
            "<path d=\"M{:.1} 0v18\" stroke=\"#000000\" stroke-width=\"1.5\" stroke-dasharray=\"3 2\"/>",
            at(target)
        ));
    }
    if let Some(other) = other.filter(|v| v.is_finite()) {
        add(format!("<path d=\"M{:.1} 9l5-5 5 5-5 5z\" fill=\"#D55E00\"/>", at(other) - 5.0));
    }
    svg.push_str("</svg>");
    svg
}

/// The legend of [`strip`], given the names of the range, the median, the target and the other value.
pub fn strip_keys(names: [&str; 4]) -> String {
    let [range, median, target, other] = names;
    [
        key(Swatch::Bar, 0, range),
        key(Swatch::Upright, 0, median),
        key(Swatch::Broken, usize::MAX, target),
        key(Swatch::Diamond, 1, other),
    ]
    .concat()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_strip_stays_within_its_width_for_all_values() {
        let spans = [([1.0, 2.0, 3.0], 2.5, Some(9.0)), ([1.0; 3], 1.0, Some(1.0)), ([f64::NAN; 3], f64::NAN, None)];
        for (range, target, other) in spans {
            let svg = strip(range, target, other, 0.0);
            assert!(!svg.contains("NaN") && !svg.contains("inf"), "{svg}");
        }
        assert!(strip([1.0, 2.0, 3.0], 2.0, Some(9.0), 0.0).contains("M127.0 9l5"), "the largest value ends the strip");
        assert!(strip([1.0; 3], 1.0, None, 0.0).contains("M70.0 3v12"), "one value stands in the middle");
        assert!(strip([1.0; 3], 1.0, Some(1.1), 0.4).contains("M54.5 3v12"), "what is near stays near");
    }
}
