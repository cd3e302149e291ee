//! Tables 3 to 6 and Figures 8 to 14.

use super::figure::{
    accuracy, damage, damage_text, frequencies, frequency_keys, method_keys, methods, posterior_keys, posteriors,
    CHANGED, OURS, TEXT,
};
use super::table;
use super::words::capital;
use crate::plot::{figure, key, Swatch};
use crate::reproduce::result::{Case, Quantity, State};

/// The case, in the order of the paper.
pub fn html(case: &Case) -> String {
    let undamaged = case.states.first();
    let scenarios = case.states.get(1..).unwrap_or_default();
    [
        "<h3>Training</h3>".to_owned(),
        accuracy("fig8", 8, &case.accuracy),
        "<h3>Undamaged state</h3>".to_owned(),
        measured(undamaged),
        found(undamaged),
        table::states(
            "table3",
            "Table 3. Undamaged state: mean and standard deviation of each stiffness from 50 measurements, by the cINN",
            &case.table3,
        ),
        "<h3>Damage scenarios</h3>".to_owned(),
        measured_damaged(scenarios),
        found_damaged(scenarios),
        compared(undamaged, scenarios),
        table::states(
            "table4",
            "Table 4. Damage scenarios: mean, standard deviation and probability of damage of each stiffness, by the \
             cINN",
            &case.table4,
        ),
        "<h3>Three methods</h3>".to_owned(),
        by_method(case),
        table::methods("table5", "Table 5. The three methods on the same 500 measurements", &case.table5),
        table::time(
            "table6",
            "Table 6. Wall clock of the methods, here and on the paper's laptop; compare the ratios, not the seconds",
            &case.table6,
        ),
    ]
    .concat()
}

/// Figure 9.
fn measured(undamaged: Option<&State>) -> String {
    let panels = undamaged.map_or_else(Vec::new, |state| frequencies(state, ""));
    let caption =
        "Figure 9. The natural frequencies measured in the undamaged state, with their mean and standard deviation: \
         nearly normal, since the stiffnesses are and the frequencies follow them almost linearly.";
    figure("fig9", &panels, &frequency_keys(), caption)
}

/// Figure 10.
fn found(undamaged: Option<&State>) -> String {
    let panels = undamaged.map_or_else(Vec::new, |state| posteriors(state, ""));
    let prior = undamaged.and_then(|state| state.quantities.first()).and_then(|q| Some((q.prior?, &q.unit)));
    let prior = prior.map_or_else(String::new, |([low, high], unit)| {
        format!(" The prior is uniform from {low} to {high} {unit}; the panels show a part of it.")
    });
    let caption = format!(
        "Figure 10. Posterior of each stiffness in the undamaged state. It should agree with the target, except for the \
         difference due to only 50 draws.{prior}"
    );
    figure("fig10", &panels, &posterior_keys(), &caption)
}

/// Beginning of the titles of the panels of a state.
fn title(state: &State) -> String {
    format!("{}, ", capital(&state.name))
}

/// Figure 11.
fn measured_damaged(scenarios: &[State]) -> String {
    let panels: Vec<String> = scenarios.iter().flat_map(|state| frequencies(state, &title(state))).collect();
    let caption =
        "Figure 11. The natural frequencies measured in the damage scenarios, a row each: the more stiffness \
         is lost, the lower they are compared with Figure 9.";
    figure("fig11", &panels, &frequency_keys(), caption)
}

/// Figure 12.
fn found_damaged(scenarios: &[State]) -> String {
    let panels: Vec<String> = scenarios.iter().flat_map(|state| posteriors(state, &title(state))).collect();
    let caption = "Figure 12. Posterior of each stiffness in the damage scenarios: it should follow the target, and \
                   stay where nothing has changed. It cannot follow a target that extends below the prior.";
    figure("fig12", &panels, &posterior_keys(), caption)
}

/// Figure 13.
fn compared(undamaged: Option<&State>, scenarios: &[State]) -> String {
    let panels = |state: &State| -> Vec<String> {
        let before = undamaged.map_or(&[][..], |state| &state.quantities);
        before.iter().zip(&state.quantities).map(|(before, now)| damage(before, now, &title(state), false)).collect()
    };
    let texts: Vec<String> = scenarios.iter().map(|state| damage_text(state, |_| true)).collect();
    let caption = format!(
        "Figure 13. Each stiffness in the damage scenarios compared with the undamaged state. The tinted area below δ is \
         the probability of damage (PoD), which is near 5 % where nothing has changed; the numbers are shares of the samples. {}.",
        texts.join(". ")
    );
    let keys = key(Swatch::Line, OURS, "undamaged")
        + &key(Swatch::Line, CHANGED, "damage scenario")
        + &key(Swatch::Upright, TEXT, "threshold δ");
    figure("fig13", &scenarios.iter().flat_map(panels).collect::<Vec<_>>(), &keys, &caption)
}

/// Figure 14.
fn by_method(case: &Case) -> String {
    let quantities = case.states.first().map_or(&[][..], |state| &state.quantities);
    let panel = |(k, q): (usize, &Quantity)| methods(&case.methods, k, [&q.name, &q.unit], q.target, &[]);
    let panels: Vec<String> = quantities.iter().enumerate().map(panel).collect();
    let caption =
        "Figure 14. The population of each stiffness that each method finds from the same 500 measurements: the \
                   curves should agree with the target and with each other.";
    figure("fig14", &panels, &(method_keys() + &key(Swatch::Dashed, TEXT, "target")), caption)
}
