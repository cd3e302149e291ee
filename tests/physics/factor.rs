//! Parameters that are factors of the nominal stiffness: the same structure as with stiffnesses, on another scale.

use modalwatch::simulator::definition::StructureDefinition;
use modalwatch::simulator::Simulator;
use nalgebra::DMatrix;

/// A tower whose two lower springs share a parameter `low`, and a third with a parameter of its own.
fn tower(low: &str, top: &str) -> Simulator {
    simulator(&format!(
        r#"
id = "tower"
modes = 3
measurement_noise = {{ relative = 0.002 }}
mode_shapes = {{ points = ["m1", "m3"], noise = 0.01 }}
mass = [{{ name = "m1", kg = 1e5 }}, {{ name = "m2", kg = 1e5 }}, {{ name = "m3", kg = 8e4 }}]
spring = [
    {{ name = "k1", from = "ground", to = "m1", n_per_m = 3e7 }},
    {{ name = "k2", from = "m1", to = "m2", n_per_m = 2e7 }},
    {{ name = "k3", from = "m2", to = "m3", n_per_m = 2.5e7 }},
]
{low}
{top}
"#
    ))
}

fn simulator(text: &str) -> Simulator {
    Simulator::new(StructureDefinition::parse_toml(text).unwrap()).unwrap()
}

fn factors() -> Simulator {
    tower(
        "[[parameter]]\nname = \"low\"\nscale = true\nprior = { uniform = [0.5, 1.5] }\nsets = [{ spring = \"k1\" }, { spring = \"k2\" }]",
        "[[parameter]]\nname = \"top\"\nscale = true\nprior = { uniform = [0.25, 1.25] }\nsets = { spring = \"k3\" }",
    )
}

fn stiffnesses() -> Simulator {
    tower(
        "[[parameter]]\nname = \"k1\"\nprior = { uniform = [1.5e7, 4.5e7] }\nsets = { spring = \"k1\" }\n\
         [[parameter]]\nname = \"k2\"\nprior = { uniform = [1e7, 3e7] }\nsets = { spring = \"k2\" }",
        "[[parameter]]\nname = \"k3\"\nprior = { uniform = [6.25e6, 3.125e7] }\nsets = { spring = \"k3\" }",
    )
}

#[test]
fn values_priors_and_units_are_per_cent_of_the_nominal_stiffness() {
    let factors = factors();
    for (parameter, [lower, upper]) in factors.space().iter().zip([[50.0, 150.0], [25.0, 125.0]]) {
        assert_eq!((parameter.lower, parameter.upper, parameter.unit.as_str()), (lower, upper, "% of nominal"));
    }
    assert_eq!(factors.nominal_parameters(), [100.0, 100.0]);
    assert_eq!(factors.nominal_frequencies_hz(), stiffnesses().nominal_frequencies_hz());
    assert!(factors.derived_stiffnesses().is_empty(), "the factor itself is monitored");
    // d ln k/dp of a factor of 80 %.
    assert!((factors.stiffness_share(0, 80.0) - 1.0 / 80.0).abs() < 1e-15);
}

#[test]
fn a_factor_gives_the_frequencies_and_shapes_of_the_stiffnesses_that_it_stands_for() {
    let (factors, stiffnesses) = (factors(), stiffnesses());
    for [low, top] in [[100.0, 100.0], [92.0, 100.0], [61.0, 118.0]] {
        let absolute = [0.03 * low, 0.02 * low, 0.025 * top].map(|k| 1e7 * k);
        let (f, shapes) = factors.frequencies_and_shapes(&[low, top]).unwrap();
        let (expected, expected_shapes) = stiffnesses.frequencies_and_shapes(&absolute).unwrap();
        let batched = factors.frequencies_of_rows_hz(&DMatrix::from_row_slice(1, 2, &[low, top]), 0..1);
        for mode in 0..3 {
            assert!((f[mode] / expected[mode] - 1.0).abs() < 1e-12, "{f:?} {expected:?}");
            assert!((batched[mode] / expected[mode] - 1.0).abs() < 1e-10, "{batched:?} {expected:?}");
            assert!((shapes.column(mode).dot(&expected_shapes.column(mode)).abs() - 1.0).abs() < 1e-12);
        }
        // Chain rule: ∂f/∂low = Σ ∂f/∂k · k_nominal/100 over the springs that it sets.
        let (own, by_stiffness) = (factors.jacobian(&[low, top]).unwrap(), stiffnesses.jacobian(&absolute).unwrap());
        for mode in 0..3 {
            let expected =
                [by_stiffness[(mode, 0)] * 3e5 + by_stiffness[(mode, 1)] * 2e5, by_stiffness[(mode, 2)] * 2.5e5];
            for column in 0..2 {
                assert!((own[(mode, column)] / expected[column] - 1.0).abs() < 1e-10, "{own} {expected:?}");
            }
        }
    }
}

#[test]
fn derivatives_of_frequencies_and_shapes_agree_with_central_differences() {
    let factors = factors();
    let theta = [87.0, 104.0];
    let found = factors.linearise(&theta, 3, true).unwrap();
    let h = 1e-3;
    for column in 0..2 {
        let at = |sign: f64| {
            let mut moved = theta;
            moved[column] += sign * h;
            factors.frequencies_and_shapes(&moved).unwrap()
        };
        let ((f_up, up), (f_down, down)) = (at(1.0), at(-1.0));
        for mode in 0..3 {
            let difference = (f_up[mode] - f_down[mode]) / (2.0 * h);
            let slope = found.frequency_slopes[(mode, column)];
            assert!((difference - slope).abs() < 1e-8 * (1.0 + slope.abs()), "{difference} {slope}");
            // Signs of shapes are arbitrary.
            let same = |shape: nalgebra::DVector<f64>| {
                if shape.dot(&found.shapes.column(mode)) < 0.0 {
                    -shape
                } else {
                    shape
                }
            };
            let difference = (same(up.column(mode).into_owned()) - same(down.column(mode).into_owned())) / (2.0 * h);
            let error = (difference - found.shape_slopes[mode].column(column)).norm();
            assert!(error < 1e-8, "mode {mode}, column {column}: {error}");
        }
    }
}

#[test]
fn a_factor_of_beams_and_rotational_springs_scales_their_stiffness() {
    let beam = |parameter: &str| {
        simulator(&format!(
            r#"
id = "bridge"
simulation = "beam"
modes = 3
node = [{{ name = "a", x_m = 0.0, support = "pinned" }}, {{ name = "b", x_m = 20.0 }}, {{ name = "c", x_m = 45.0, support = "pinned" }}]
beam = [
    {{ name = "west", from = "a", to = "b", mass_kg_per_m = 9e3, bending_stiffness_n_m2 = 2e10 }},
    {{ name = "east", from = "b", to = "c", mass_kg_per_m = 9e3, bending_stiffness_n_m2 = 3e10 }},
]
spring = [{{ name = "hinge", from = "ground", to = "a", n_m_per_rad = 1e9 }}]
{parameter}
"#
        ))
    };
    let all = beam(
        "[[parameter]]\nname = \"all\"\nscale = true\nprior = { uniform = [0.5, 1.5] }\n\
         sets = [{ beam = \"west\" }, { beam = \"east\" }, { spring = \"hinge\" }]",
    );
    // All stiffnesses together: frequencies go with the root of the factor.
    let nominal = all.frequencies_hz(&[100.0]).unwrap();
    for percent in [60.0, 81.0, 144.0] {
        for (f, nominal) in all.frequencies_hz(&[percent]).unwrap().iter().zip(&nominal) {
            assert!((f / nominal - (0.01_f64 * percent).sqrt()).abs() < 1e-10, "{f} {nominal}");
        }
    }
}

#[test]
fn existing_files_keep_their_digest_and_factors_are_in_it() {
    for folder in ["three-dof", "rig", "ruler-frame-4dof"] {
        let read = |name: &str| std::fs::read_to_string(format!("models/{folder}/{name}")).unwrap();
        let definition = StructureDefinition::parse_toml(&read("structure.toml")).unwrap();
        let json = definition.canonical_json();
        assert!(!json.contains("\"scale\"") && !json.contains("\"unit\":null"), "{json}");
        // The manifest of the shipped model names the structure that it was trained for.
        assert!(read("baseline.json").contains(definition.digest().as_str()), "{folder}");
    }
    assert!(factors().definition().canonical_json().contains("\"scale\":true"));
    assert_ne!(factors().digest(), stiffnesses().digest());
}
