//! Modes that, by their measured shapes, are another mode of the simulation than that of their number.

use serde::{Deserialize, Serialize};

use super::effect::FittedEffect;
use super::fit::Fit;
use super::study::Study;
use structures::physics::effect::Target;
use structures::physics::shapes::{modes_to_pair, pair_modes};
use structures::physics::tangent::TangentSpace;
use structures::simulator::law::Input;
use structures::stats::squared_cosine;

/// A mode is reported if the modal assurance criterion with the mode that its shape is paired with exceeds that with the mode of its
/// number by this.
const CLEARER: f64 = 0.2;

/// A measured mode that, by its shape, is another mode of the simulation than that of its number.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, utoipa::ToSchema)]
pub struct ModeNumber {
    /// Its number, from 1, in the measurements.
    pub listed: usize,
    /// The number, from 1, of the mode of the simulation that has its shape.
    pub simulated: usize,
    /// Modal assurance criterion (MAC) of its mean measured shape with that mode.
    pub mac: f64,
    /// MAC with the mode of the simulation that has its number in the measurements.
    pub mac_as_listed: f64,
}

/// The modes whose shapes are those of other modes than their numbers say, at the means of a fit and under its constant effects. Modes
/// are paired by MAC and frequency ([`pair_modes`]).
pub(super) fn mode_numbers(study: &Study<'_>, fit: &Fit) -> Vec<ModeNumber> {
    found(study, fit).unwrap_or_default()
}

/// `None` without shapes, or where the shapes cannot be computed.
fn found(study: &Study<'_>, fit: &Fit) -> Option<Vec<ModeNumber>> {
    let (simulator, shapes) = (study.simulator, study.data.shapes.as_ref()?);
    let (mut targets, mut sizes) = (Vec::new(), Vec::new());
    let constant = |(effect, _): &(&FittedEffect, &Vec<f64>)| effect.law.covariate.is_none();
    for (effect, psi) in fit.effects.iter().zip(&fit.psi).filter(constant) {
        let (mut own, mut slopes) = (vec![0.0; effect.target.sizes()], vec![0.0; psi.len()]);
        effect.sizes(Input::Number(0.0), psi, &mut own, &mut slopes);
        sizes.extend(own);
        targets.push(effect.target.clone());
    }
    // A known order of modes is that of the numbers in the measurements.
    let order = targets.iter().find_map(|t| if let Target::ModeOrder(order) = t { Some(order.clone()) } else { None });
    targets.retain(|t| !matches!(t, Target::ModeOrder(_)));
    let modes = modes_to_pair(simulator.modes(), simulator.available_modes());
    let frequencies_hz = simulator.respond(&fit.mean, modes, &targets, &sizes).ok()?.frequencies_hz;
    let simulated = simulator.shapes_under(&fit.mean, modes, (&targets, &sizes), simulator.shape_dofs()).ok()??;
    let measured: Vec<(f64, Option<&[f64]>)> =
        shapes.reference.iter().map(|m| (m.frequency_hz, m.shape.as_ref().map(TangentSpace::centre))).collect();
    let mut all = Vec::new();
    for (listed, paired) in pair_modes(&measured, &frequencies_hz, &simulated).into_iter().enumerate() {
        let Some(shape) = measured[listed].1 else { continue };
        let expected = order.as_ref().and_then(|order| order.get(listed).copied()).unwrap_or(listed);
        let mac = |mode: usize| squared_cosine(shape, simulated.column(mode).as_slice());
        if paired != expected && mac(paired) > mac(expected) + CLEARER {
            let (listed, simulated) = (listed + 1, paired + 1);
            all.push(ModeNumber { listed, simulated, mac: mac(paired), mac_as_listed: mac(expected) });
        }
    }
    Some(all)
}

/// The modes in a sentence without its first capital and its full stop; empty without any.
pub(super) fn sentence(numbers: &[ModeNumber]) -> String {
    if numbers.is_empty() {
        return String::new();
    }
    let join = |texts: Vec<String>| texts.join(", ");
    let listed = join(numbers.iter().map(|n| n.listed.to_string()).collect());
    let simulated = join(numbers.iter().map(|n| n.simulated.to_string()).collect());
    let mac = join(numbers.iter().map(|n| format!("{:.2}", n.mac)).collect());
    let as_listed = join(numbers.iter().map(|n| format!("{:.2}", n.mac_as_listed)).collect());
    let (mode, are) = if numbers.len() == 1 { ("mode", "is mode") } else { ("modes", "are modes") };
    format!(
        "by the measured shapes, {mode} {listed} of the measurements {are} {simulated} of the simulation (MAC {mac}; by the numbers \
         {as_listed}), and the comparison takes them as such: correct the numbers, or find out which mode was not identified"
    )
}
