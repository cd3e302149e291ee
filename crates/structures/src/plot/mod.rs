//! Plots as SVG, and self-contained HTML pages that contain them.
//!
//! - [`Plot`] and [`Scatter`]: one large plot on a light background;
//! - [`Panel`] and [`Heat`]: small plots side by side in the light or dark colours of the page;
//! - [`density`]: densities of samples;
//! - [`structure`]: drawings of structures.

mod chart;
mod colours;
pub mod density;
mod heat;
mod html;
mod page;
mod panel;
mod strip;
pub mod structure;
mod ticks;

pub use chart::{Line, Plot, Points, Scatter};
pub use heat::Heat;
pub use html::{anchor, escaped, table, table_of_html};
pub use page::page;
pub use panel::{figure, key, Bars, Cloud, Curve, Panel, Swatch};
pub use strip::{strip, strip_keys};

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
    fn an_empty_plot_is_valid_svg() {
        assert!(Plot::default().svg().starts_with("<svg"));
    }
}
