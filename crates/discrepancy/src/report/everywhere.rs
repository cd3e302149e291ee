//! A simulation that is off everywhere, drawn along the structure.

use crate::diagnosis::Outcome;
use structures::physics::effect::{Direction, Target};
use structures::plot::{Plot, Points, Scatter};
use structures::simulator::Simulator;

/// Colours of [`Points`]: blue for stiffnesses, orange for masses.
const STIFFNESS: usize = 0;
const MASS: usize = 1;

/// The section; `None` if the simulation is not off everywhere, or has no parts.
pub(super) fn everywhere(simulator: &Simulator, outcome: &Outcome) -> Option<String> {
    let structure = simulator.structure()?;
    let fit = &outcome.after;
    let index = fit.effects.iter().position(|effect| effect.mixture.is_some())?;
    let Target::Everywhere(directions) = &fit.effects[index].target else { return None };
    let mixture = fit.effects[index].mixture.as_ref()?;
    let (sizes, _) = mixture.posterior(&fit.psi[index], &fit.psi_covariance(index))?;
    let percent = |part: fn(&Direction) -> &Vec<f64>, place: usize| {
        100.0 * directions.iter().zip(sizes.iter()).map(|(d, size)| part(d)[place] * size).sum::<f64>()
    };
    let springs = structure.springs().len();
    let cloud = |name: &str, colour: usize, points: Vec<f64>, first: usize| Points {
        name: name.to_owned(),
        colour,
        hollow: false,
        points: points.into_iter().enumerate().map(|(place, y)| ((first + place) as f64, y)).collect(),
    };
    let stiffness = (0..springs).map(|place| percent(|d| &d.springs, place)).collect();
    let mass = (0..structure.masses().len()).map(|place| percent(|d| &d.masses, place)).collect();
    let names = structure.springs().iter().map(|s| s.name.clone());
    let x_names = names.chain(structure.masses().iter().map(|m| m.name.clone())).collect();
    let plot = Plot {
        title: "What would have to change everywhere".to_owned(),
        x_label: "part".to_owned(),
        y_label: "change against the structure file, %".to_owned(),
        marks: vec![(0.0, String::new())],
        ..Plot::default()
    };
    let points = vec![cloud("stiffness", STIFFNESS, stiffness, 0), cloud("mass", MASS, mass, springs)];
    let figure = Scatter { plot, points, x_names }.figure("");
    let by_mode = if directions.iter().any(|direction| !direction.frequencies.is_empty()) {
        " Single modes may be off as well, by what no span represents, such as supports that give way or hold the rotation; this is not drawn."
    } else {
        ""
    };
    Some(format!(
        "<p>No single place explains the deviation. This is the most probable change of all stiffnesses and masses that does, beside the \
         fitted parameters. The measured modes see only a few combinations of the parts, so that no single point of it is known, and \
         physics that the simulation lacks (bending, a foundation that gives way, spread mass) may look like this as well: check \
         assumptions that concern the whole structure before a single part. Modes that were not measured, or mode shapes, would \
         narrow it down.{by_mode}</p><div class=\"plots\">{figure}</div>"
    ))
}
