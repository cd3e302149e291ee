//! Masses and deviations that parameters set: the same structures as with these built in, slopes against finite differences, and mistakes.

use modalwatch::simulator::definition::StructureDefinition;
use modalwatch::simulator::{SimulationModel, Simulator};

/// A tower of three storeys with heights, shapes at two floors and these parameters.
fn text(kg: [f64; 2], parameters: &str) -> String {
    let [low, top] = kg;
    format!(
        r#"
id = "tower"
modes = 3
measurement_noise = {{ relative = 0.002 }}
mode_shapes = {{ points = ["m1", "m3"], noise = 0.01 }}
mass = [
    {{ name = "m1", kg = {low:?}, at_m = 4.0 }}, {{ name = "m2", kg = {low:?}, at_m = 7.0 }}, {{ name = "m3", kg = {top:?}, at_m = 10.5 }},
]
spring = [
    {{ name = "k1", from = "ground", to = "m1", n_per_m = 3e7 }},
    {{ name = "k2", from = "m1", to = "m2", n_per_m = 2e7 }},
    {{ name = "k3", from = "m2", to = "m3", n_per_m = 2.5e7 }},
]
[[parameter]]
name = "k"
scale = true
prior = {{ uniform = [0.5, 1.5] }}
sets = [{{ spring = "k1" }}, {{ spring = "k2" }}]
{parameters}
"#
    )
}

fn simulator(text: &str) -> Simulator {
    Simulator::new(StructureDefinition::parse_toml(text).unwrap()).unwrap()
}

const FLOORS: &str = r#"
[[parameter]]
name = "floors"
scale = true
prior = { uniform = [0.75, 1.25] }
sets = [{ mass = "m1" }, { mass = "m2" }]
damage = "none"
[[parameter]]
name = "roof"
prior = { uniform = [6e4, 1e5] }
sets = { mass = "m3" }
damage = "none"
"#;

const GROUND: &str = r#"
[[parameter]]
name = "rotation"
prior = { uniform = [0.0, 0.6] }
sets = { deviation = "base_rotation" }
damage = "increase"
[[parameter]]
name = "spread"
prior = { uniform = [0.0, 1.0] }
sets = { deviation = "spread_mass" }
damage = "none"
[[parameter]]
name = "gradient"
prior = { normal = { mean = 0.0, std = 0.1 } }
sets = { deviation = "stiffness_gradient" }
damage = "none"
"#;

fn apart(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (a / b - 1.0).abs()).fold(0.0, f64::max)
}

#[test]
fn a_parameter_that_is_a_mass_gives_the_frequencies_and_shapes_of_the_structure_with_that_mass() {
    let set = simulator(&text([1e5, 8e4], FLOORS));
    let units: Vec<&str> = set.space().iter().map(|p| p.unit.as_str()).collect();
    assert_eq!(units, ["% of nominal", "% of nominal", "kg"]);
    assert!(apart(&set.nominal_parameters(), &[100.0, 100.0, 8e4]) < 1e-12);
    let built = simulator(&text([1.1e5, 7e4], ""));
    let theta = [80.0, 110.0, 7e4];
    let (hz, shapes) = set.frequencies_and_shapes(&theta).unwrap();
    let (built_hz, built_shapes) = built.frequencies_and_shapes(&theta[..1]).unwrap();
    assert!(apart(&hz, &built_hz) < 1e-10, "{hz:?} {built_hz:?}");
    assert!(apart(&set.frequencies_hz(&theta).unwrap(), &built_hz) < 1e-10);
    // The sign of a shape is arbitrary.
    assert!((shapes.abs() - built_shapes.abs()).amax() < 1e-10);
}

#[test]
fn a_parameter_that_is_a_deviation_gives_the_frequencies_of_a_constant_effect_of_its_size() {
    let set = simulator(&text([1e5, 8e4], GROUND));
    let sizes = [("base_rotation", 0.25), ("spread_mass", 0.4), ("stiffness_gradient", -0.15)];
    let effects = sizes.map(|(kind, size)| {
        format!("[[effect]]\nname = \"{kind}\"\ntarget = {{ deviation = \"{kind}\" }}\nlaw = \"constant\"\nnumbers = {{ size = {size:?} }}\n")
    });
    let built = simulator(&text([1e5, 8e4], &effects.concat()));
    let theta = [90.0, 0.25, 0.4, -0.15];
    let (hz, built_hz) = (set.frequencies_hz(&theta).unwrap(), built.frequencies_hz(&theta[..1]).unwrap());
    assert!(apart(&hz, &built_hz) < 1e-10, "{hz:?} {built_hz:?}");
    // A deviation has no nominal size: it is at the median of its prior.
    assert!(apart(&set.nominal_parameters()[1..3], &[0.3, 0.5]) < 1e-12);
    let nominal = set.frequencies_hz(&set.nominal_parameters()).unwrap();
    assert!(apart(&set.nominal_frequencies_hz(), &nominal) < 1e-10);
}

#[test]
fn slopes_of_frequencies_and_shapes_by_masses_and_deviations_are_central_differences() {
    for (parameters, theta) in [(FLOORS, vec![80.0, 110.0, 7e4]), (GROUND, vec![90.0, 0.25, 0.4, -0.15])] {
        let simulator = simulator(&text([1e5, 8e4], parameters));
        let found = simulator.linearise(&theta, 3, true).unwrap();
        let (_, jacobian) = simulator.frequencies_and_jacobian(&theta).unwrap();
        assert!((&jacobian - &found.frequency_slopes).amax() < 1e-9 * jacobian.amax());
        for column in 0..theta.len() {
            let step = 1e-5 * theta[column].abs();
            let at = |sign: f64| {
                let mut moved = theta.clone();
                moved[column] += sign * step;
                let (hz, mut shapes) = simulator.frequencies_and_shapes(&moved).unwrap();
                for (mut shape, own) in shapes.column_iter_mut().zip(found.shapes.column_iter()) {
                    let sign = shape.dot(&own).signum();
                    shape *= sign;
                }
                (hz, shapes)
            };
            let ((up_hz, up), (down_hz, down)) = (at(1.0), at(-1.0));
            for mode in 0..3 {
                let difference = (up_hz[mode] - down_hz[mode]) / (2.0 * step);
                let slope = found.frequency_slopes[(mode, column)];
                assert!(
                    (slope - difference).abs() * theta[column].abs() < 1e-6 * up_hz[mode],
                    "{column}: {slope} {difference}"
                );
                let difference = (up.column(mode) - down.column(mode)) / (2.0 * step);
                let error = (found.shape_slopes[mode].column(column) - &difference).amax() * theta[column].abs();
                assert!(
                    error < 1e-6,
                    "mode {mode} by {column}: {} {difference}",
                    found.shape_slopes[mode].column(column)
                );
            }
        }
    }
}

#[test]
fn a_calibration_changes_the_measured_frequencies_with_the_square_of_the_frequency_and_no_shape() {
    let effect = |size: f64| {
        let text = format!(
            "[[effect]]\nname = \"curve\"\ntarget = {{ deviation = \"calibration\" }}\nlaw = \"constant\"\nnumbers = {{ size = {size:?} }}\n"
        );
        simulator(&self::text([1e5, 8e4], &text))
    };
    let plain = simulator(&text([1e5, 8e4], ""));
    let nominal = plain.nominal_frequencies_hz();
    let (hz, shapes) = plain.frequencies_and_shapes(&[90.0]).unwrap();
    let (curved, same) = effect(0.03).frequencies_and_shapes(&[90.0]).unwrap();
    for (mode, (f, curved)) in hz.iter().zip(&curved).enumerate() {
        let along = (nominal[mode].powi(2) - nominal[0].powi(2)) / (nominal[2].powi(2) - nominal[0].powi(2)) - 0.5;
        assert!(((curved / f).ln() - 0.03 * along).abs() < 1e-12, "mode {mode}");
    }
    assert!((shapes - same).amax() < 1e-12);
    // As a parameter, also of a structure without shapes.
    let parameter = "[[parameter]]\nname = \"curve\"\nprior = { normal = { mean = 0.0, std = 0.01 } }\nsets = { deviation = \"calibration\" }\ndamage = \"none\"";
    let set = simulator(&text([1e5, 8e4], parameter));
    assert!(apart(&set.frequencies_hz(&[90.0, 0.03]).unwrap(), &curved) < 1e-12);
    let slopes = set.jacobian(&[90.0, 0.03]).unwrap();
    for (mode, f) in curved.iter().enumerate() {
        let along = (nominal[mode].powi(2) - nominal[0].powi(2)) / (nominal[2].powi(2) - nominal[0].powi(2)) - 0.5;
        assert!((slopes[(mode, 1)] - f * along).abs() < 1e-9 * f, "mode {mode}");
    }
}

#[test]
fn masses_and_deviations_keep_the_structure_from_the_eigensolver_for_stiffnesses_only() {
    let set = simulator(&text([1e5, 8e4], FLOORS));
    let SimulationModel::Matrices(matrices) = set.model() else { panic!("no matrices") };
    assert_eq!(matrices.sizes.len(), 3);
    let theta = nalgebra::DMatrix::from_row_slice(2, 3, &[80.0, 110.0, 7e4, 120.0, 90.0, 9e4]);
    let rows = set.frequencies_of_rows_hz(&theta, 0..2);
    for row in 0..2 {
        let own: Vec<f64> = theta.row(row).iter().copied().collect();
        assert!(apart(&rows[3 * row..3 * row + 3], &set.frequencies_hz(&own).unwrap()) < 1e-12);
    }
}

#[test]
fn each_mistake_is_named_with_its_place() {
    let one = |prior: &str, sets: &str, further: &str| {
        format!("[[parameter]]\nname = \"p\"\nprior = {prior}\nsets = {sets}\n{further}\n")
    };
    let cases = [
        (
            one("{ uniform = [0.5, 1.5] }", "{ mass = \"m9\" }", "scale = true\ndamage = \"none\""),
            "/parameter/1/sets",
            "there is no mass \"m9\"",
        ),
        (
            one("{ uniform = [0.5, 1.5] }", "{ mass = \"m1\" }", "scale = true"),
            "/parameter/1/damage",
            "whose decrease is no damage: give damage = \"none\"",
        ),
        (
            one("{ uniform = [0.5, 1.5] }", "{ mass = \"m1\" }", "damage = \"none\""),
            "/parameter/1/prior",
            "a relative change of the mass",
        ),
        (
            one(
                "{ uniform = [0.5, 1.5] }",
                "[{ mass = \"m1\" }, { mass = \"m1\" }]",
                "scale = true\ndamage = \"none\"",
            ),
            "/parameter/1/sets/1/mass",
            "mass m1 is set already",
        ),
        (
            one("{ uniform = [-0.1, 0.5] }", "{ deviation = \"bending\" }", "damage = \"none\""),
            "/parameter/1/prior",
            "the deviation bending be -0.1: it must be at least 0",
        ),
        (
            one("{ uniform = [0.1, 0.5] }", "{ deviation = \"bending\" }", "scale = true\ndamage = \"none\""),
            "/parameter/1/sets",
            "remove scale",
        ),
        (one("{ uniform = [0.1, 0.5] }", "{ deviation = \"axial_force\" }", ""), "/parameter/1/sets", "needs a beam"),
        (
            one("{ uniform = [0.1, 0.5] }", "{ mass = \"m1\", deviation = \"bending\" }", "damage = \"none\""),
            "/parameter/1/sets",
            "name one spring, one beam, one mass or one deviation",
        ),
        (
            one("{ uniform = [0.1, 0.5] }", "{ spring = \"k3\", mass = \"m1\" }", "damage = \"none\""),
            "/parameter/1/sets",
            "name one spring, one beam, one mass or one deviation",
        ),
        (
            one(
                "{ uniform = [0.1, 0.5] }",
                "{ mass = \"m1\", law = { exponential = { a = 1.0, b = 1.0, c = 1.0 } } }",
                "damage = \"none\"",
            ),
            "/parameter/1/sets",
            "remove law",
        ),
    ];
    for (parameter, pointer, part) in cases {
        let read = StructureDefinition::parse_toml(&text([1e5, 8e4], &parameter)).and_then(Simulator::new);
        let problems = read.unwrap_err().problems;
        let found = problems.iter().any(|p| p.pointer.starts_with(pointer) && p.message.contains(part));
        assert!(found, "{parameter}: {problems:?}");
    }
}
