//! Beams against the closed forms of Euler and Bernoulli.

use std::f64::consts::{PI, TAU};

use modalwatch::simulator::definition::{DefinitionProblem, StructureDefinition};
use modalwatch::simulator::Simulator;

const LENGTH_M: f64 = 3.0;
const KG_PER_M: f64 = 7.0;
const EI: f64 = 2_000.0;

fn simulator(text: &str) -> Simulator {
    Simulator::new(StructureDefinition::parse_toml(text).unwrap()).unwrap()
}

/// One span of unknown bending stiffness between two supports; `rest` is appended to the file.
fn span(supports: [&str; 2], elements: usize, modes: usize, rest: &str) -> String {
    let (left, right) = (supports[0], supports[1]);
    let (end_m, low, high) = (1.0 + LENGTH_M, 0.5 * EI, 1.5 * EI);
    format!(
        "id = \"beam\"\nsimulation = \"beam\"\nmodes = {modes}\n\
         [[node]]\nname = \"left\"\nx_m = 1.0\nsupport = \"{left}\"\n\
         [[node]]\nname = \"right\"\nx_m = {end_m}\nsupport = \"{right}\"\n\
         [[beam]]\nname = \"span\"\nfrom = \"left\"\nto = \"right\"\nmass_kg_per_m = {KG_PER_M}\nelements = {elements}\n\
         [[parameter]]\nname = \"ei\"\nprior = {{ uniform = [{low}, {high}] }}\nsets = {{ beam = \"span\" }}\n{rest}"
    )
}

fn frequencies_hz(text: &str) -> Vec<f64> {
    simulator(text).frequencies_hz(&[EI]).unwrap()
}

/// ```text
///  f = (βL)²/(2π L²) √(EI/μ)
/// ```
fn closed_form_hz(beta_l: f64) -> f64 {
    beta_l.powi(2) / (TAU * LENGTH_M.powi(2)) * (EI / KG_PER_M).sqrt()
}

/// A root of `equation` by bisection, near a guess.
fn root(equation: impl Fn(f64) -> f64, near: f64) -> f64 {
    let (mut low, mut high) = (near - 0.3, near + 0.3);
    assert!(equation(low) * equation(high) < 0.0, "no root near {near}");
    for _ in 0..80 {
        let middle = f64::midpoint(low, high);
        if equation(low) * equation(middle) <= 0.0 {
            high = middle;
        } else {
            low = middle;
        }
    }
    f64::midpoint(low, high)
}

/// βL of the first three modes under each pair of supports, from the frequency equations.
fn closed_forms() -> Vec<([&'static str; 2], [f64; 3])> {
    // Divided by cosh, so that the terms of the equations are of order 1.
    let clamped = |x: f64| x.cos() - 1.0 / x.cosh();
    let cantilever = |x: f64| x.cos() + 1.0 / x.cosh();
    let propped = |x: f64| x.sin() - x.cos() * x.tanh();
    vec![
        (["pinned", "pinned"], [PI, 2.0 * PI, 3.0 * PI]),
        (["clamped", "free"], [1.9, 4.7, 7.85].map(|x| root(cantilever, x))),
        (["clamped", "clamped"], [4.7, 7.85, 11.0].map(|x| root(clamped, x))),
        (["clamped", "pinned"], [3.9, 7.07, 10.2].map(|x| root(propped, x))),
        (["pinned", "clamped"], [3.9, 7.07, 10.2].map(|x| root(propped, x))),
        // One, three and five quarters of a wavelength.
        (["guided", "pinned"], [0.5 * PI, 1.5 * PI, 2.5 * PI]),
    ]
}

#[test]
fn one_span_has_the_frequencies_of_the_closed_forms() {
    for (supports, roots) in closed_forms() {
        for (f, beta_l) in frequencies_hz(&span(supports, 40, 3, "")).iter().zip(roots) {
            let exact = closed_form_hz(beta_l);
            assert!((f / exact - 1.0).abs() < 1e-5, "{supports:?}: {f} against {exact}");
        }
    }
}

#[test]
fn frequencies_converge_from_above_with_the_fourth_power_of_the_element_length() {
    for (supports, roots) in closed_forms() {
        let error = |elements: usize, mode: usize| {
            frequencies_hz(&span(supports, elements, 3, ""))[mode] / closed_form_hz(roots[mode]) - 1.0
        };
        for mode in 0..3 {
            let (coarse, fine) = (error(6, mode), error(12, mode));
            assert!(coarse > 0.0 && fine > 0.0, "{supports:?}, mode {mode}: {coarse:e}, {fine:e}");
            let order = (coarse / fine).log2();
            println!("{supports:?}, mode {}: error {coarse:.1e} with 6 elements, order {order:.2}", mode + 1);
            // The next term of the error is of sixth order: with 6 elements it changes the order of the third mode by about 0.2.
            assert!((order - 4.0).abs() < 0.25, "{supports:?}, mode {mode}: order {order}");
        }
    }
}

#[test]
fn a_heavy_tip_on_a_light_cantilever_swings_as_on_a_spring() {
    let tip = span(["clamped", "free"], 8, 1, "[[mass]]\nname = \"tip\"\nkg = 50.0\nat = \"right\"\n");
    let light = tip.replace(&format!("mass_kg_per_m = {KG_PER_M}"), "mass_kg_per_m = 0.01");
    let found = frequencies_hz(&light)[0];
    // Rayleigh: 33/140 of the mass of the beam moves with the tip; the error is of second order in the ratio of the masses.
    let moving_kg = 50.0 + 33.0 / 140.0 * 0.01 * LENGTH_M;
    let exact = (3.0 * EI / LENGTH_M.powi(3) / moving_kg).sqrt() / TAU;
    assert!((found / exact - 1.0).abs() < 1e-6, "{found} against {exact}");
}

#[test]
fn springs_stand_between_the_supports_they_replace() {
    let held = |n_m_per_rad: f64| {
        let ends = "from = \"ground\"\nto = \"right\"";
        let rest = format!("[[spring]]\nname = \"rotation\"\n{ends}\nn_m_per_rad = {n_m_per_rad}\n");
        frequencies_hz(&span(["clamped", "pinned"], 20, 2, &rest))
    };
    let bare = |supports| frequencies_hz(&span(supports, 20, 2, ""));
    for mode in 0..2 {
        assert!((held(1e-6)[mode] / bare(["clamped", "pinned"])[mode] - 1.0).abs() < 1e-8);
        assert!((held(1e10)[mode] / bare(["clamped", "clamped"])[mode] - 1.0).abs() < 1e-5);
        assert!(held(1e3)[mode] > held(1e2)[mode]);
    }
    let rest = "[[spring]]\nname = \"bearing\"\nfrom = \"ground\"\nto = \"right\"\nn_per_m = 1e9\n";
    let sprung = frequencies_hz(&span(["clamped", "free"], 20, 2, rest));
    assert!((sprung[0] / bare(["clamped", "pinned"])[0] - 1.0).abs() < 1e-5);
}

#[test]
fn a_span_cut_in_two_is_the_same_span() {
    let whole = frequencies_hz(&span(["clamped", "pinned"], 12, 3, ""));
    let rest = format!(
        "[[node]]\nname = \"middle\"\nx_m = 2.0\n[[beam]]\nname = \"rest\"\nfrom = \"middle\"\nto = \"right\"\n\
         mass_kg_per_m = {KG_PER_M}\nelements = 8\n"
    );
    let cut = span(["clamped", "pinned"], 4, 3, &rest)
        .replacen("to = \"right\"", "to = \"middle\"", 1)
        .replace("sets = { beam = \"span\" }", "sets = [{ beam = \"span\" }, { beam = \"rest\" }]");
    for (a, b) in whole.iter().zip(frequencies_hz(&cut)) {
        assert!((a / b - 1.0).abs() < 1e-9, "{a} {b}");
    }
}

/// Two spans of different stiffness with a mass, a bearing of unknown stiffness and a rotational spring.
const TWO_SPANS: &str = r#"id = "two-spans"
simulation = "beam"
modes = 4
measurement_noise = { relative = 0.002 }
[[node]]
name = "abutment"
x_m = 0.0
support = "pinned"
[[node]]
name = "pier"
x_m = 12.0
[[node]]
name = "end"
x_m = 20.0
support = "pinned"
[[beam]]
name = "west"
from = "abutment"
to = "pier"
bending_stiffness_n_m2 = 4.0e8
mass_kg_per_m = 900.0
[[beam]]
name = "east"
from = "end"
to = "pier"
bending_stiffness_n_m2 = 3.0e8
mass_kg_per_m = 800.0
elements = 6
[[mass]]
name = "vehicle"
kg = 2000.0
at = "pier"
[[spring]]
name = "bearing"
from = "ground"
to = "pier"
n_per_m = 1.5e7
[[spring]]
name = "clamp"
from = "ground"
to = "end"
n_m_per_rad = 2.0e7
[[parameter]]
name = "west_ei"
prior = { uniform = [3.0e8, 5.0e8] }
sets = { beam = "west" }
[[parameter]]
name = "bearing"
prior = { uniform = [1.0e7, 3.0e7] }
sets = { spring = "bearing" }
[[parameter]]
name = "clamp"
prior = { uniform = [1.0e7, 4.0e7] }
sets = { spring = "clamp" }
"#;

#[test]
fn slopes_of_a_beam_agree_with_central_differences() {
    let simulator = simulator(TWO_SPANS);
    let units: Vec<&str> = simulator.space().iter().map(|p| p.unit.as_str()).collect();
    assert_eq!(units, ["N·m²", "N/m", "N·m/rad"]);
    let theta = [4.2e8, 1.7e7, 2.5e7];
    let jacobian = simulator.jacobian(&theta).unwrap();
    for column in 0..3 {
        let step = 1e-4 * theta[column];
        let at = |sign: f64| {
            let mut moved = theta;
            moved[column] += sign * step;
            simulator.frequencies_hz(&moved).unwrap()
        };
        let (up, down) = (at(1.0), at(-1.0));
        for mode in 0..4 {
            let difference = (up[mode] - down[mode]) / (2.0 * step);
            let relative = (jacobian[(mode, column)] - difference).abs() * theta[column];
            assert!(relative < 1e-6 * up[mode], "mode {mode}, {column}: {} {difference}", jacobian[(mode, column)]);
        }
    }
}

#[test]
fn mistakes_in_a_beam_are_named_with_their_place() {
    #[rustfmt::skip]
    let cases = [
        ("support = \"pinned\"", "support = \"glued\"", "/node/0/support", "unknown variant `glued`"),
        ("x_m = 12.0", "x_m = 0.0", "/beam/0/to", "no length"),
        ("to = \"pier\"\nbending", "to = \"peer\"\nbending", "/beam/0/to", "\"peer\", which is not a node"),
        ("bending_stiffness_n_m2 = 3.0e8\n", "", "/beam/1", "no bending_stiffness_n_m2"),
        ("bending_stiffness_n_m2 = 3.0e8", "bending_stiffness_n_m2 = -1.0", "/beam/1/bending_stiffness_n_m2", "above 0"),
        ("mass_kg_per_m = 800.0", "mass_kg_per_m = 0.0", "/beam/1/mass_kg_per_m", "above 0"),
        ("elements = 6", "elements = 0", "/beam/1/elements", "at least one"),
        ("elements = 6", "elements = 600", "/beam/1/elements", "at most 200"),
        ("at = \"pier\"", "at = \"end\"", "/mass/0/at", "does not move"),
        ("at = \"pier\"\n", "", "/mass/0/at", "has no `at`"),
        ("at = \"pier\"", "at = \"peer\"", "/mass/0/at", "\"peer\", which is not a node"),
        ("to = \"end\"\nn_m_per_rad", "to = \"end\"\nn_per_m", "/spring/1/to", "support fixes this degree of freedom already"),
        ("n_m_per_rad = 2.0e7", "n_m_per_rad = 2.0e7\nn_per_m = 1.0", "/spring/1/n_m_per_rad", "not both"),
        ("sets = { beam = \"west\" }", "sets = { beam = \"wast\" }", "/parameter/0/sets", "no beam \"wast\""),
        ("sets = { beam = \"west\" }", "sets = { beam = \"west\", spring = \"clamp\" }", "/parameter/0/sets", "name one spring, one beam, one mass or one deviation"),
        ("name = \"vehicle\"", "name = \"west\"", "/beam/0/name", "name of a mass"),
        ("simulation = \"beam\"\n", "", "/node", "a simulation \"spring_mass\" has no node"),
        ("modes = 4", "modes = 99", "/modes", "degrees of freedom"),
    ];
    for (from, to, pointer, message) in cases {
        assert!(TWO_SPANS.contains(from), "{from:?}");
        let error = StructureDefinition::parse_toml(&TWO_SPANS.replacen(from, to, 1)).unwrap_err();
        let fits =
            |p: &DefinitionProblem| p.pointer.starts_with(pointer) && p.message.contains(message) && p.line.is_some();
        assert!(error.problems.iter().any(fits), "{to:?}: {error}");
    }
    let error = StructureDefinition::parse_toml(&span(["free", "free"], 5, 2, "")).unwrap_err().to_string();
    assert!(error.contains("hold the beam with supports"), "{error}");
}

#[test]
fn elements_whose_error_shows_beside_the_noise_are_told() {
    let told = |elements: usize, noise: f64| {
        let text = span(["pinned", "pinned"], elements, 4, "")
            .replace("modes = 4", &format!("modes = 4\nmeasurement_noise = {{ relative = {noise} }}"));
        let simulator = Simulator::new(StructureDefinition::parse_toml(&text).unwrap()).unwrap();
        (simulator.mesh_warning(), simulator.nominal_frequencies_hz())
    };
    let (fine, exact_hz) = told(64, 1e-3);
    assert_eq!(fine, None);
    let (coarse, hz) = told(6, 1e-3);
    let error_percent = 100.0 * (hz[3] / exact_hz[3] - 1.0);
    let coarse = coarse.unwrap();
    assert!(coarse.contains("mode 4") && error_percent > 0.5, "{coarse}");
    let stated: f64 = coarse.split(" by ").nth(1).unwrap().split(' ').next().unwrap().parse().unwrap();
    assert!((stated / error_percent - 1.0).abs() < 0.05, "{coarse}, {error_percent} %");
    assert_eq!(told(6, 0.1).0, None, "beside a noise of 10 %");
}
