//! Figures that both cases have.

use super::words::{capital, fixed};
use crate::plot::density::{columns, histogram, kernel, normal_curve};
use crate::plot::{figure, key, Bars, Cloud, Curve, Panel, Swatch};
use crate::reproduce::result::{Accuracy, Method, MethodSamples, Quantity, State};
use crate::stats;

/// Indices of colours by their meaning; an index beyond the last is the colour of the text.
pub const OURS: usize = 0;
pub const CHANGED: usize = 1;
pub const PRIOR: usize = 6;
pub const TEXT: usize = usize::MAX;
const MEASURED: usize = 4;
const METHODS: [(Method, usize, &str); 3] =
    [(Method::Sensitivity, 2, "sensitivity"), (Method::Tmcmc, 3, "TMCMC"), (Method::Cinn, 0, "cINN")];

/// Name of a quantity without the `spring:` of a stiffness.
pub fn name(quantity: &Quantity) -> &str {
    quantity.name.rsplit(':').next().unwrap_or_default()
}

/// Label of an axis: a name with its unit.
pub fn with_unit(name: &str, unit: &str) -> String {
    if unit.is_empty() {
        name.to_owned()
    } else {
        format!("{name}, {unit}")
    }
}

/// Label of the axis of a density over a quantity with this unit.
pub fn per(unit: &str) -> String {
    if unit.is_empty() {
        "density".to_owned()
    } else {
        format!("density per {unit}")
    }
}

/// Figures 8 and 19: a parameter's true values against one posterior sample each.
pub fn accuracy(id: &str, number: usize, accuracy: &[Accuracy]) -> String {
    let panel = |a: &Accuracy| {
        let points: Vec<(f64, f64)> = a.truth.iter().copied().zip(a.estimate.iter().copied()).collect();
        let ends = [stats::quantile(&a.truth, 0.0), stats::quantile(&a.truth, 1.0)];
        let diagonal = ends.map(|end| (end, end)).to_vec();
        let all = [a.truth.clone(), a.estimate.clone()].concat();
        let panel = Panel {
            title: format!("{}: R² = {}", a.parameter, fixed(a.r_squared, 4)),
            x_label: with_unit("truth", &a.unit),
            y_label: with_unit("estimate", &a.unit),
            clouds: vec![Cloud { colour: OURS, radius: 2, points, ..Cloud::default() }],
            curves: vec![Curve { colour: TEXT, dashed: true, points: diagonal, ..Curve::default() }],
            reach: [all.clone(), all],
            square: true,
            ..Panel::default()
        };
        panel.svg()
    };
    let panels: Vec<String> = accuracy.iter().map(panel).collect();
    let keys = key(Swatch::Dot, OURS, "one posterior sample") + &key(Swatch::Dashed, TEXT, "estimate = truth");
    let caption = format!(
        "Figure {number}. Estimates of the trained flow from simulated measurements at points that it was not trained on. \
         The closer the points are to the diagonal, the better; their scatter is the uncertainty that the measurement leaves."
    );
    figure(id, &panels, &keys, &caption)
}

/// Figures 9 and 11: measured frequencies of a state, with the normal curve of their mean and spread.
pub fn frequencies(state: &State, prefix: &str) -> Vec<String> {
    let panel = |(mode, values): (usize, &Vec<f64>)| {
        let (mean, std) = (stats::mean(values), stats::sample_std(values).unwrap_or(f64::NAN));
        let panel = Panel {
            title: format!("{prefix}f{}: {} ± {} Hz", mode + 1, fixed(mean, 4), fixed(std, 4)),
            x_label: format!("f{}, Hz", mode + 1),
            y_label: per("Hz"),
            bars: vec![Bars { colour: MEASURED, bars: histogram(values) }],
            curves: vec![Curve { colour: OURS, points: normal_curve(mean, std), ..Curve::default() }],
            ..Panel::default()
        };
        panel.svg()
    };
    state.frequencies_hz.iter().enumerate().map(panel).collect()
}

/// Legend of [`frequencies`], as HTML.
pub fn frequency_keys() -> String {
    key(Swatch::Bar, MEASURED, "measurements") + &key(Swatch::Line, OURS, "normal curve fitted to them")
}

/// Figures 10 and 12: prior, posterior and target of the parameters of a state.
pub fn posteriors(state: &State, prefix: &str) -> Vec<String> {
    let panel = |q: &Quantity| {
        let posterior = kernel(&q.samples);
        let target = q.target.map_or_else(Vec::new, |[mean, std]| normal_curve(mean, std));
        let ends = |points: &[(f64, f64)]| Some([points.first()?.0, points.last()?.0]);
        let shown: Vec<[f64; 2]> = [&posterior, &target].into_iter().filter_map(|points| ends(points)).collect();
        let low = shown.iter().map(|e| e[0]).fold(f64::INFINITY, f64::min);
        let high = shown.iter().map(|e| e[1]).fold(f64::NEG_INFINITY, f64::max);
        // Only the visible part of the prior: on the scale of the whole prior the posterior would be too narrow to see.
        let prior = |[a, b]: [f64; 2]| (low.max(a) < high.min(b)).then(|| (low.max(a), high.min(b), 1.0 / (b - a)));
        let panel = Panel {
            title: format!("{prefix}{}", q.name),
            x_label: with_unit(name(q), &q.unit),
            y_label: per(&q.unit),
            bars: vec![
                Bars { colour: PRIOR, bars: q.prior.and_then(prior).into_iter().collect() },
                Bars { colour: OURS, bars: histogram(&q.samples) },
            ],
            curves: vec![
                Curve { colour: OURS, points: posterior, ..Curve::default() },
                Curve { colour: CHANGED, dashed: true, points: target, ..Curve::default() },
            ],
            ..Panel::default()
        };
        panel.svg()
    };
    state.quantities.iter().filter(|q| q.prior.is_some()).map(panel).collect()
}

/// Legend of [`posteriors`], as HTML.
pub fn posterior_keys() -> String {
    key(Swatch::Bar, PRIOR, "prior")
        + &key(Swatch::Bar, OURS, "posterior samples")
        + &key(Swatch::Line, OURS, "their density")
        + &key(Swatch::Dashed, CHANGED, "target")
}

/// Figures 13 and 21: a quantity in the undamaged and in another state, and the part of the latter below δ.
pub fn damage(undamaged: &Quantity, other: &Quantity, prefix: &str, bars: bool) -> String {
    let curve =
        |q: &Quantity, colour, filled_to| Curve { colour, filled_to, points: kernel(&q.samples), dashed: false };
    let histogram = |q: &Quantity, colour| Bars { colour, bars: histogram(&q.samples) };
    let bars = if bars { vec![histogram(undamaged, OURS), histogram(other, CHANGED)] } else { Vec::new() };
    let filled_to = if bars.is_empty() { Some(other.threshold) } else { None };
    let panel = Panel {
        title: format!("{prefix}{}: PoD {} %", name(other), fixed(100.0 * other.probability_of_damage, 1)),
        x_label: with_unit(name(other), &other.unit),
        y_label: per(&other.unit),
        bars,
        curves: vec![curve(undamaged, OURS, None), curve(other, CHANGED, filled_to)],
        verticals: Some((other.threshold, "δ".to_owned())).into_iter().filter(|v| v.0.is_finite()).collect(),
        ..Panel::default()
    };
    panel.svg()
}

/// The probabilities of damage of a state, for a caption.
pub fn damage_text(state: &State, wanted: impl Fn(&Quantity) -> bool) -> String {
    let one = |q: &Quantity| format!("{} {} %", name(q), fixed(100.0 * q.probability_of_damage, 1));
    let texts: Vec<String> = state.quantities.iter().filter(|q| wanted(q)).map(one).collect();
    format!("{}: {}", capital(&state.name), texts.join(", "))
}

/// Figures 14 and 22: densities of a parameter by each method. `target` gives the normal curve that the values were drawn from,
/// or `drawn` the values themselves.
pub fn methods(
    methods: &[MethodSamples],
    k: usize,
    title: [&str; 2],
    target: Option<[f64; 2]>,
    drawn: &[f64],
) -> String {
    let [name, unit] = title;
    let mut curves: Vec<Curve> = METHODS
        .iter()
        .filter_map(|(method, colour, _)| {
            let samples = methods.iter().find(|m| m.method == *method)?.samples.get(k)?;
            Some(Curve { colour: *colour, points: kernel(samples), ..Curve::default() })
        })
        .collect();
    if let Some([mean, std]) = target {
        curves.push(Curve { colour: TEXT, dashed: true, points: normal_curve(mean, std), ..Curve::default() });
    }
    let panel = Panel {
        title: name.to_owned(),
        x_label: with_unit(name, unit),
        y_label: per(unit),
        bars: vec![Bars { colour: PRIOR, bars: columns(drawn) }],
        curves,
        ..Panel::default()
    };
    panel.svg()
}

/// Legend of the methods in [`methods`], as HTML.
pub fn method_keys() -> String {
    METHODS.iter().map(|(_, colour, name)| key(Swatch::Line, *colour, name)).collect()
}
