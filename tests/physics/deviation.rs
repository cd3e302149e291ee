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
fn a_cantilever_whose_base_rotates_is_a_beam_on_a_hinge_with_a_rotational_spring() {
    let tower = |base: &str, further: &str, (clamped_right, finer): (bool, usize)| {
        let at = |x_m: f64| if clamped_right { LENGTH_M - x_m } else { x_m };
        let text = format!(
            r#"
id = "tower"
simulation = "beam"
modes = 4
node = [
    {{ name = "base", x_m = {:?}, support = "{base}" }},
    {{ name = "middle", x_m = {:?} }},
    {{ name = "top", x_m = {:?} }},
]
beam = [
    {{ name = "lower", from = "base", to = "middle", bending_stiffness_n_m2 = {EI_N_M2:?}, mass_kg_per_m = {KG_PER_M:?}, elements = {} }},
    {{ name = "upper", from = "middle", to = "top", bending_stiffness_n_m2 = {EI_N_M2:?}, mass_kg_per_m = {KG_PER_M:?}, elements = {} }},
]
mass = [{{ name = "head", at = "top", kg = 5000.0 }}]
parameter = [{{ name = "stiffness", scale = true, prior = {{ uniform = [0.5, 1.5] }}, sets = [{{ beam = "lower" }}, {{ beam = "upper" }}] }}]
{further}
"#,
            at(0.0),
            at(9.0),
            at(LENGTH_M),
            12 * finer,
            16 * finer
        );
        Simulator::new(StructureDefinition::parse_toml(&text).unwrap()).unwrap()
    };
    // The rotation adds L²/k to the deflection L³/(3EI) of the top under a unit force there.
    let size = 0.3;
    let n_m_per_rad = 3.0 * EI_N_M2 / (LENGTH_M * size);
    let spring =
        format!("spring = [{{ name = \"ground\", from = \"ground\", to = \"base\", n_m_per_rad = {n_m_per_rad:?} }}]");
    let difference = |form: (bool, usize)| {
        let built = tower("pinned", &spring, form);
        let built = natural_frequencies_hz(built.structure().unwrap(), 4).unwrap();
        apart(&under(&tower("clamped", "", form), DeviationKind::BaseRotation, size), built)
    };
    for clamped_right in [false, true] {
        // The rotation of the base is no degree of freedom of the first element: that is an error of its length to the third power.
        let [coarse, fine] = [1, 2].map(|finer| difference((clamped_right, finer)));
        assert!(coarse < 1e-4 && fine < coarse / 6.0, "{coarse} {fine}");
        let clamped = tower("clamped", "", (clamped_right, 1));
        let target = [Target::Deviation(Arc::new(
            Deviation::new(clamped.structure().unwrap(), DeviationKind::BaseRotation).unwrap(),
        ))];
        let slope = respond(clamped.structure().unwrap(), 4, &target, &[size]).unwrap().by_size;
        // The flexibility is the inverse of a stiffness matrix of condition 1e7, so that a smaller step would show its rounding.
        let (up, down) = [3e-3, -3e-3].map(|step| under(&clamped, DeviationKind::BaseRotation, size + step)).into();
        for mode in 0..4 {
            let (slope, difference) = (slope[(mode, 0)], (up[mode] - down[mode]) / 6e-3);
            assert!((slope - difference).abs() < 3e-5 * up[mode], "mode {mode}: {slope} {difference}");
        }
    }
    // A beam that something else holds is no cantilever.
    let held =
        tower("clamped", "spring = [{ name = \"guy\", from = \"ground\", to = \"top\", n_per_m = 1e6 }]", (false, 1));
    assert!(Deviation::new(held.structure().unwrap(), DeviationKind::BaseRotation).is_none());
    assert!(Deviation::new(beam("").structure().unwrap(), DeviationKind::BaseRotation).is_none());
}

#[test]
fn both_ends_of_a_beam_of_unequal_bays_are_held_in_proportion_to_their_ei_over_l() {
    let file = |springs: &str| {
        let text = format!(
            r#"
id = "beam"
simulation = "beam"
modes = 4
node = [
    {{ name = "a", x_m = 0.0, support = "pinned" }},
    {{ name = "middle", x_m = 4.0 }},
    {{ name = "b", x_m = 9.0, support = "pinned" }},
    {{ name = "c", x_m = 24.0, support = "pinned" }},
]
beam = [
    {{ name = "one", from = "a", to = "middle", bending_stiffness_n_m2 = 2e9, mass_kg_per_m = 3e3, elements = 6 }},
    {{ name = "two", from = "middle", to = "b", bending_stiffness_n_m2 = 2e9, mass_kg_per_m = 3e3, elements = 6 }},
    {{ name = "three", from = "b", to = "c", bending_stiffness_n_m2 = 3e9, mass_kg_per_m = 3e3, elements = 20 }},
]
parameter = [{{ name = "stiffness", scale = true, prior = {{ uniform = [0.5, 1.5] }}, sets = [{{ beam = "one" }}, {{ beam = "three" }}] }}]
{springs}
"#
        );
        Simulator::new(StructureDefinition::parse_toml(&text).unwrap()).unwrap()
    };
    // k = s EI/L, with L from each end to the next support.
    let share = 0.7;
    let springs = [("a", 2e9 / 9.0), ("c", 3e9 / 15.0)].map(|(node, stiffness)| {
        format!("{{ name = \"at_{node}\", from = \"ground\", to = \"{node}\", n_m_per_rad = {:?} }}", share * stiffness)
    });
    let built = file(&format!("spring = [{}]", springs.join(", ")));
    let built = natural_frequencies_hz(built.structure().unwrap(), 4).unwrap();
    // The size that gives the first frequency gives the others.
    let base = file("");
    let (mut low, mut high) = (0.0, 2.0);
    for _ in 0..60 {
        let middle = 0.5 * (low + high);
        let reached = under(&base, DeviationKind::EndRestraint, middle)[0] > built[0];
        *(if reached { &mut high } else { &mut low }) = middle;
    }
    let hz = under(&base, DeviationKind::EndRestraint, low);
    assert!(apart(&hz, built.iter().copied()) < 1e-9, "{hz:?}, {built:?}");
}

#[test]
fn slopes_of_deviations_of_a_beam_are_central_differences() {
    let beam = beam("");
    let structure = beam.structure().unwrap();
    let kinds: Vec<DeviationKind> =
        DeviationKind::OF_A_STRUCTURE.into_iter().filter(|kind| Deviation::new(structure, *kind).is_some()).collect();
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
fn a_gradient_of_a_beam_is_that_of_a_beam_of_many_short_spans_with_these_stiffnesses_and_masses() {
    // The elements of `beam`: twelve of 0.75 m, then twenty of 0.75 m.
    let base = beam("");
    for (kind, of_stiffness) in [(DeviationKind::StiffnessGradient, true), (DeviationKind::MassGradient, false)] {
        let nodes: Vec<String> = (0..=32)
            .map(|i| {
                let support = if i % 32 == 0 { ", support = \"pinned\"" } else { "" };
                format!("{{ name = \"n{i}\", x_m = {:?}{support} }}", 0.75 * f64::from(i))
            })
            .collect();
        let spans: Vec<String> = (0..32)
            .map(|i| {
                let factor = f64::exp(0.4 * ((f64::from(i) + 0.5) / 32.0 - 0.5));
                let (ei, kg) = if of_stiffness { (EI_N_M2 * factor, KG_PER_M) } else { (EI_N_M2, KG_PER_M * factor) };
                format!(
                    "{{ name = \"s{i}\", from = \"n{i}\", to = \"n{}\", bending_stiffness_n_m2 = {ei:?}, mass_kg_per_m = {kg:?}, elements = 1 }}",
                    i + 1
                )
            })
            .collect();
        let text = format!(
            "id = \"beam\"\nsimulation = \"beam\"\nmodes = 4\nnode = [{}]\nbeam = [{}]\n[[parameter]]\nname = \"p\"\nscale = true\nprior = {{ uniform = [0.5, 1.5] }}\nsets = {{ beam = \"s0\" }}",
            nodes.join(", "),
            spans.join(", ")
        );
        let built = Simulator::new(StructureDefinition::parse_toml(&text).unwrap()).unwrap();
        let built = natural_frequencies_hz(built.structure().unwrap(), 4).unwrap();
        let hz = under(&base, kind, 0.4);
        assert!(apart(&hz, built) < 1e-9, "{kind:?}");
        // Half of all stiffnesses halves the squares of the frequencies.
        let base_softer = base.structure().unwrap().with_stiffness(&[(0, 0.5 * EI_N_M2), (1, 0.5 * EI_N_M2)]).unwrap();
        let target = [Target::Deviation(Arc::new(Deviation::new(base.structure().unwrap(), kind).unwrap()))];
        let softer = respond(&base_softer, 4, &target, &[0.4]).unwrap().frequencies_hz;
        assert!(apart(&softer, hz.iter().map(|f| f * 0.5_f64.sqrt())) < 1e-9, "{kind:?}");
    }
}
