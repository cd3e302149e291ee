//! Deviations of a beam that are in no single part, against closed forms, beams that have them built in, and finite differences.

use std::f64::consts::PI;
use std::sync::Arc;

use modalwatch::physics::deviation::{Deviation, DeviationKind};
use modalwatch::physics::effect::{respond, Target};
use modalwatch::physics::natural_frequencies_hz;
use modalwatch::simulator::definition::StructureDefinition;
use modalwatch::simulator::Simulator;

const EI_N_M2: f64 = 2.0e9;
const KG_PER_M: f64 = 3.0e3;
const LENGTH_M: f64 = 24.0;

/// A beam on two hinges, in two spans of unequal length without a support between them. `further`: more lines of its file.
fn beam(further: &str) -> Simulator {
    let text = format!(
        r#"
id = "beam"
simulation = "beam"
modes = 4
node = [
    {{ name = "a", x_m = 0.0, support = "pinned" }},
    {{ name = "b", x_m = 9.0 }},
    {{ name = "c", x_m = {LENGTH_M:?}, support = "pinned" }},
]
beam = [
    {{ name = "ab", from = "a", to = "b", bending_stiffness_n_m2 = {EI_N_M2:?}, mass_kg_per_m = {KG_PER_M:?}, elements = 12 }},
    {{ name = "bc", from = "c", to = "b", bending_stiffness_n_m2 = {EI_N_M2:?}, mass_kg_per_m = {KG_PER_M:?}, elements = 20 }},
]
parameter = [{{ name = "stiffness", scale = true, prior = {{ uniform = [0.5, 1.5] }}, sets = [{{ beam = "ab" }}, {{ beam = "bc" }}] }}]
{further}
"#
    );
    Simulator::new(StructureDefinition::parse_toml(&text).unwrap()).unwrap()
}

fn under(simulator: &Simulator, kind: DeviationKind, size: f64) -> Vec<f64> {
    let structure = simulator.structure().unwrap();
    let target = Target::Deviation(Arc::new(Deviation::new(structure, kind).unwrap()));
    respond(structure, 4, &[target], &[size]).unwrap().frequencies_hz
}

/// The greatest relative difference of two lists of frequencies.
fn apart(a: &[f64], b: impl IntoIterator<Item = f64>) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a / b - 1.0).abs()).fold(0.0, f64::max)
}

#[test]
fn a_force_along_a_beam_and_its_rotary_inertia_have_closed_forms() {
    let beam = beam("");
    // f_n = (π/2) (n/L)² √(EI/ρA) · √(1 + g/n²), g = P L²/(π² EI), or / √(1 + g n²), g = r² π²/L²
    let plain = |n: f64| 0.5 * PI * (n / LENGTH_M).powi(2) * (EI_N_M2 / KG_PER_M).sqrt();
    let modes = || (1..=4).map(f64::from);
    for size in [-0.3, 0.2] {
        let hz = under(&beam, DeviationKind::AxialForce, size);
        // The finite elements are stiffer by 2e-5 in the fourth mode.
        assert!(apart(&hz, modes().map(|n| plain(n) * (1.0 + size / (n * n)).sqrt())) < 1e-4, "{hz:?}");
    }
    let hz = under(&beam, DeviationKind::RotaryInertia, 0.02);
    assert!(apart(&hz, modes().map(|n| plain(n) / (1.0 + 0.02 * n * n).sqrt())) < 1e-4, "{hz:?}");
}

#[test]
fn an_end_restraint_is_a_rotational_spring_at_both_hinges_and_its_size_is_that_of_the_first_mode() {
    let base = beam("");
    let plain = natural_frequencies_hz(base.structure().unwrap(), 4).unwrap();
    let hz = under(&base, DeviationKind::EndRestraint, 0.4);
    // φ = sin(πx/L): 2 c (π/L)² = EI (π/L)⁴ L/2 for a size of 1.
    let n_m_per_rad = 0.4 * EI_N_M2 * PI.powi(2) / (4.0 * LENGTH_M);
    let springs = ["a", "c"].map(|node| {
        format!("{{ name = \"at_{node}\", from = \"ground\", to = \"{node}\", n_m_per_rad = {n_m_per_rad:?} }}")
    });
    let built = beam(&format!("spring = [{}]", springs.join(", ")));
    let built = natural_frequencies_hz(built.structure().unwrap(), 4).unwrap();
    assert!(apart(&hz, built.iter().copied()) < 1e-6, "{hz:?}, {built:?}");
    let little = under(&base, DeviationKind::EndRestraint, 1e-4);
    assert!(((little[0] / plain[0]).powi(2) - 1.0 - 1e-4).abs() < 1e-7, "{little:?}");
}

#[test]
fn slopes_of_deviations_of_a_beam_are_central_differences() {
    let beam = beam("");
    let structure = beam.structure().unwrap();
    let kinds: Vec<DeviationKind> =
        DeviationKind::ALL.into_iter().filter(|kind| Deviation::new(structure, *kind).is_some()).collect();
    assert_eq!(kinds.len(), 5, "{kinds:?}");
    for kind in kinds {
        let target = [Target::Deviation(Arc::new(Deviation::new(structure, kind).unwrap()))];
        let slope = respond(structure, 4, &target, &[0.05]).unwrap().by_size;
        let (up, down) = (under(&beam, kind, 0.05 + 1e-4), under(&beam, kind, 0.05 - 1e-4));
        for mode in 0..4 {
            let difference = (up[mode] - down[mode]) / 2e-4;
            let slope = slope[(mode, 0)];
            assert!((slope - difference).abs() < 1e-5 * up[mode], "{kind:?}, mode {mode}: {slope} {difference}");
        }
    }
}

#[test]
fn a_gradient_of_a_beam_changes_its_spans_by_the_place_of_their_middles() {
    let base = beam("");
    let structure = base.structure().unwrap();
    let ei = |at: f64| EI_N_M2 * f64::exp(0.3 * at);
    let indices = ["ab", "bc"].map(|name| structure.springs().iter().position(|s| s.name == name).unwrap());
    let built = structure.with_stiffness(&[(indices[0], ei(-0.5)), (indices[1], ei(0.5))]).unwrap();
    let built = natural_frequencies_hz(&built, 4).unwrap();
    assert!(apart(&under(&base, DeviationKind::StiffnessGradient, 0.3), built) < 1e-10);
}
