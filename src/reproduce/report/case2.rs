//! Tables 8 to 10 and Figures 16 to 22.

use super::figure::{accuracy, damage, damage_text, method_keys, methods, with_unit, CHANGED, OURS, PRIOR, TEXT};
use super::table::{self, framed, head, interval};
use super::words::{capital, decimals, fixed, grouped};
use crate::gsa::{Index, Sensitivity};
use crate::plot::density::grid;
use crate::plot::{escaped, figure, key, Cloud, Curve, Heat, Panel, Swatch};
use crate::reproduce::result::{Case, Configuration, LawFit, Quantity, State};
use crate::updating::law::Estimate;

/// Range of positions that a plot shows at least, m.
const SHOWN_M: [f64; 2] = [0.01, 0.08];

/// The case, in the order of the paper.
pub fn html(case: &Case) -> String {
    let rig = case.rig.as_ref();
    [
        "<h3>What was measured</h3>".to_owned(),
        configurations(rig.map_or(&[], |rig| &rig.configurations)),
        "<h3>Which inputs matter, and the laws of the couplings</h3>".to_owned(),
        rig.map_or_else(String::new, |rig| sensitivity(&rig.sensitivity)),
        laws(rig.map_or(&[], |rig| &rig.laws)),
        "<h3>Training</h3>".to_owned(),
        accuracy("fig19", 19, &case.accuracy),
        "<h3>Undamaged and damaged</h3>".to_owned(),
        settings(&case.states),
        table::states(
            "table8",
            "Table 8. Mean and standard deviation of the positions, and probability of damage, by the cINN: 50 \
             undamaged and 11 damaged configurations",
            &case.table8,
        ),
        compared(&case.states),
        "<h3>Three methods</h3>".to_owned(),
        by_method(case),
        table::methods("table9", "Table 9. The three methods on all 61 configurations", &case.table9),
        table::time(
            "table10",
            "Table 10. Wall clock of the methods, here and on the paper's laptop; compare the ratios, not the seconds",
            &case.table10,
        ),
    ]
    .concat()
}

/// A cloud of dots.
fn cloud(colour: usize, radius: u32, points: Vec<(f64, f64)>) -> Cloud {
    Cloud { colour, radius, points, crosses: false }
}

/// A square plot of the positions of both links.
fn links(title: String, clouds: Vec<Cloud>) -> Panel {
    let [x_label, y_label] = ["p12, m", "p23, m"].map(str::to_owned);
    Panel {
        title,
        x_label,
        y_label,
        clouds,
        reach: [SHOWN_M.to_vec(), SHOWN_M.to_vec()],
        square: true,
        ..Panel::default()
    }
}

/// Figure 16.
fn configurations(all: &[Configuration]) -> String {
    let of = |damaged: bool| -> Vec<(f64, f64)> {
        all.iter().filter(|c| c.damaged == damaged).map(|c| (c.p12_m, c.p23_m)).collect()
    };
    let (undamaged, damaged) = (of(false), of(true));
    let caption = format!(
        "Figure 16. The {} settings of the two links. In {} of them, which are the damaged ones, one of the links \
         has its smallest p, where its coupling is softest.",
        all.len(),
        damaged.len()
    );
    let crosses = Cloud { crosses: true, ..cloud(CHANGED, 4, damaged) };
    let panel = links("Settings of the links".to_owned(), vec![cloud(OURS, 4, undamaged), crosses]);
    let keys = key(Swatch::Dot, OURS, "undamaged") + &key(Swatch::Cross, CHANGED, "damaged");
    figure("fig16", &[panel.svg()], &keys, &caption)
}

/// The total index of an input on an output.
fn total(sensitivity: &Sensitivity, input: usize, output: usize) -> Option<Index> {
    sensitivity.outputs.get(output)?.indices.as_ref()?.total.get(input).copied()
}

/// Figure 17 and the table of its indices.
fn sensitivity(s: &Sensitivity) -> String {
    let outputs = 0..s.outputs.len();
    let row = |output: usize| (0..s.inputs.len()).map(|input| Some(total(s, input, output)?.value)).collect();
    let rows: Vec<String> = outputs.clone().map(|o| format!("f{}", o + 1)).collect();
    let heat = Heat {
        title: "Total Sobol' indices of the inputs on the natural frequencies".to_owned(),
        columns: s.inputs.clone(),
        rows: rows.clone(),
        cells: outputs.clone().map(row).collect(),
    };
    let caption = "Figure 17. Total Sobol' indices: the share of the variance of each frequency to which an input \
                   contributes. In the paper, f1 depends on p23 and less on p12, f2 on p12, f3 on p23, and hardly any \
                   frequency on the other inputs. This agrees with one exception: here the index of p12 for f1 is no larger \
                   than that of m2. Both depend on the ranges of masses and ground springs, which the paper does not state.";
    let shown = |input, output| {
        total(s, input, output).map_or_else(|| "–".to_owned(), |index| interval(index.value, index.interval_90, 3))
    };
    let line = |(input, name): (usize, &String)| {
        let cell = |output| format!("<td>{}</td>", shown(input, output));
        let cells: String = outputs.clone().map(cell).collect();
        format!("<tr class=\"first\"><th class=\"words\" scope=\"row\">{}</th>{cells}</tr>", escaped(name))
    };
    let body = format!("<tbody>{}</tbody>", s.inputs.iter().enumerate().map(line).collect::<String>());
    let titles: Vec<(&str, bool)> =
        std::iter::once(("input", true)).chain(rows.iter().map(|r| (r.as_str(), false))).collect();
    let text = format!(
        "The indices of Figure 17 with their 90 % intervals, from {} runs of the model",
        grouped(s.evaluations)
    );
    figure("fig17", &[heat.svg()], "", caption) + &framed("fig17-table", &text, &head(&titles), &body)
}

/// Figure 18 and the table of its constants.
fn laws(laws: &[LawFit]) -> String {
    let panel = |law: &LawFit| {
        let ends = |pick: fn(f64, f64) -> f64, from: f64| law.points.iter().map(|p| p.0).fold(from, pick);
        let (low, high) = (ends(f64::min, f64::INFINITY), ends(f64::max, f64::NEG_INFINITY));
        let positions: Vec<f64> = if low <= high { grid(low, high).collect() } else { Vec::new() };
        let [a, b, c] = law.paper;
        let link = law.coupling.replacen('k', "p", 1);
        let over = |curve: &dyn Fn(f64) -> f64| positions.iter().map(|p| (*p, curve(*p))).collect::<Vec<_>>();
        let band = |p: &f64| {
            let [low, high] = law.fit.band_95(*p);
            (*p, low, high)
        };
        let panel = Panel {
            title: format!("{} over {link}", law.coupling),
            x_label: with_unit(&link, "m"),
            y_label: with_unit(&law.coupling, "N/m"),
            band: positions.iter().map(band).collect(),
            clouds: vec![cloud(OURS, 3, law.points.clone())],
            curves: vec![
                Curve { colour: CHANGED, points: over(&|p| law.fit.curve(p)), ..Curve::default() },
                Curve { colour: TEXT, dashed: true, points: over(&|p| a * (b * p).exp() + c), ..Curve::default() },
            ],
            ..Panel::default()
        };
        panel.svg()
    };
    let caption =
        "Figure 18. Stiffness of each coupling, identified from the frequencies of one configuration at a time, over \
                   the position of its link: the fitted curve should agree with Eq. 26 of the paper, with which the \
                   measurements were simulated.";
    let keys = key(Swatch::Dot, OURS, "identified")
        + &key(Swatch::Line, CHANGED, "fitted")
        + &key(Swatch::Bar, PRIOR, "95 % band of the fit")
        + &key(Swatch::Dashed, TEXT, "Eq. 26");
    let panels: Vec<String> = laws.iter().map(panel).collect();
    let body: String = laws.iter().map(constants).collect();
    let titles =
        [("constant", true), ("fitted", false), ("95 % interval", false), ("Eq. 26", false), ("Eq. 26 is", true)];
    figure("fig18", &panels, &keys, caption)
        + &framed("fig18-table", "The constants of k = A·exp(B·p) + C in Figure 18", &head(&titles), &body)
}

/// A, B and C of a coupling, compared with those of the paper.
fn constants(law: &LawFit) -> String {
    let fitted: [(&str, &Estimate); 3] = [("A, N/m", &law.fit.a), ("B, 1/m", &law.fit.b), ("C, N/m", &law.fit.c)];
    let line = |((name, estimate), paper): ((&str, &Estimate), f64)| {
        let [low, high] = estimate.interval_95;
        let digits = decimals(estimate.standard_error).min(4);
        let place = if (low..=high).contains(&paper) { "inside" } else { "<strong>outside</strong>" };
        format!(
            "<tr class=\"first\"><th class=\"words\" scope=\"row\">{name}</th><td>{}</td><td>{} to {}</td><td>{}</td>\
             <td class=\"words\">{place}</td></tr>",
            fixed(estimate.value, digits),
            fixed(low, digits),
            fixed(high, digits),
            fixed(paper, 2)
        )
    };
    let lines: String = fitted.into_iter().zip(law.paper).map(line).collect();
    format!(
        "<tbody><tr><th class=\"group\" scope=\"rowgroup\" colspan=\"5\">{}, {} points</th></tr>{lines}</tbody>",
        escaped(&law.coupling),
        law.points.len()
    )
}

/// The two positions of a state, in pairs.
fn pairs(state: &State, of: fn(&Quantity) -> &Vec<f64>) -> Vec<(f64, f64)> {
    let [first, second] = [0, 1].map(|k| state.quantities.get(k).map(of));
    let Some((first, second)) = first.zip(second) else { return Vec::new() };
    first.iter().copied().zip(second.iter().copied()).collect()
}

/// Figure 20.
fn settings(states: &[State]) -> String {
    let all: Vec<f64> =
        states.iter().flat_map(|s| s.quantities.iter().take(2)).flat_map(|q| &q.samples).copied().collect();
    let panel = |state: &State| {
        let samples = cloud(CHANGED, 2, pairs(state, |q| &q.samples));
        let set = Cloud { crosses: true, ..cloud(TEXT, 3, pairs(state, |q| &q.realised)) };
        let mut panel = links(capital(&state.name), vec![samples, set]);
        panel.reach.iter_mut().for_each(|reach| reach.extend(&all));
        panel.svg()
    };
    let caption =
        "Figure 20. Posterior samples of the two positions, ten for each configuration: the undamaged ones fill \
                   the square of the settings, the damaged ones form an L, because one of the links is at 0.02 m.";
    let keys = key(Swatch::Dot, CHANGED, "posterior samples") + &key(Swatch::Cross, TEXT, "positions set");
    figure("fig20", &states.iter().map(panel).collect::<Vec<_>>(), &keys, caption)
}

/// Figure 21.
fn compared(states: &[State]) -> String {
    let [undamaged, damaged] = [0, 1].map(|index| states.get(index).map_or(&[][..], |state| &state.quantities));
    let stiffness = |q: &Quantity| q.prior.is_none();
    let pairs = undamaged.iter().zip(damaged).filter(|(q, _)| stiffness(q));
    let panels: Vec<String> = pairs.map(|(before, now)| damage(before, now, "", true)).collect();
    let text = states.get(1).map_or_else(String::new, |state| format!(" {}.", damage_text(state, stiffness)));
    let caption = format!(
        "Figure 21. Stiffness of the couplings, undamaged and damaged: the peak at the soft end is the damage; in \
         about half of the damaged configurations the other coupling is soft. The curves are smoothed and extend beyond \
         the samples; the probability of damage is the share of the samples to the left of δ. Table 8 judges positions \
         instead, with their own δ.{text}"
    );
    let keys = key(Swatch::Line, OURS, "undamaged")
        + &key(Swatch::Line, CHANGED, "damaged")
        + &key(Swatch::Bar, PRIOR, "samples, in the same colours")
        + &key(Swatch::Upright, TEXT, "threshold δ");
    figure("fig21", &panels, &keys, &caption)
}

/// Figure 22.
fn by_method(case: &Case) -> String {
    let configurations = case.rig.as_ref().map_or(&[][..], |rig| &rig.configurations);
    let set = [
        configurations.iter().map(|c| c.p12_m).collect::<Vec<_>>(),
        configurations.iter().map(|c| c.p23_m).collect::<Vec<_>>(),
    ];
    let quantities = case.states.first().map_or(&[][..], |state| &state.quantities);
    let panel =
        |(k, (q, set)): (usize, (&Quantity, &Vec<f64>))| methods(&case.methods, k, [&q.name, &q.unit], None, set);
    let panels: Vec<String> = quantities.iter().zip(&set).enumerate().map(panel).collect();
    let caption = "Figure 22. The population of each position that each method finds from all 61 configurations: \
                   TMCMC assumes a normal distribution and can only match the mean and the width of the uniform one \
                   that was set.";
    figure("fig22", &panels, &(method_keys() + &key(Swatch::Bar, PRIOR, "positions set")), caption)
}
