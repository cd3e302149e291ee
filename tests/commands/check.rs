//! `modalwatch check`.

use serde_json::Value;

use crate::commands::world::{World, TOWER};

fn figures(world: &World, arguments: &[&str]) -> Value {
    serde_json::from_str(&world.run(&[&["check"], arguments, &["--json"]].concat())).unwrap()
}

#[test]
fn frequencies_scale_with_stiffness_and_bound_the_prior() {
    let world = World::new();
    let found = figures(&world, &["tower.toml"]);
    for mode in found["modes"].as_array().unwrap() {
        // With k4 known, the relative sensitivities to k1, k2 and k3 sum to less than ½, that of all stiffnesses together.
        let sensitivity: Vec<f64> = serde_json::from_value(mode["sensitivity"].clone()).unwrap();
        let sum: f64 = sensitivity.iter().sum();
        assert!(sensitivity.iter().all(|s| *s > 0.0) && sum < 0.5, "{sensitivity:?}");
        let prior: [f64; 2] = serde_json::from_value(mode["prior_hz"].clone()).unwrap();
        let nominal = mode["nominal_hz"].as_f64().unwrap();
        assert!(prior[0] < nominal && nominal < prior[1], "{mode}");
    }
    // With all springs unknown, each row sums to ½, because frequencies grow with the root of a common factor.
    let all = TOWER.replace(
        "parameter = [",
        "parameter = [\n    { name = \"k4\", prior = { uniform = [1.25e7, 3.75e7] }, sets = { spring = \"k4\" } },",
    );
    std::fs::write(world.path("all.toml"), all).unwrap();
    for mode in figures(&world, &["all.toml"])["modes"].as_array().unwrap() {
        let sum: f64 = mode["sensitivity"].as_array().unwrap().iter().map(|s| s.as_f64().unwrap()).sum();
        assert!((sum - 0.5).abs() < 1e-9, "{mode}");
    }
}

#[test]
fn measured_frequencies_are_compared_with_the_prior() {
    let world = World::new();
    let nominal: Vec<f64> = figures(&world, &["tower.toml"])["modes"]
        .as_array()
        .unwrap()
        .iter()
        .map(|m| m["nominal_hz"].as_f64().unwrap())
        .collect();
    let text = |factor: f64| nominal.iter().map(|f| (f * factor).to_string()).collect::<Vec<_>>().join(",");
    assert!(world.run(&["check", "tower.toml", "--measured", &text(1.0)]).contains("inside"));
    let (_, said) = world.fails(&["check", "tower.toml", "--measured", &text(2.0)]);
    assert!(
        said.contains("mode 1:") && said.contains("outside the prior's range") && !said.contains("scale = true"),
        "{said}"
    );

    // A prior that is a factor, with and without a nominal stiffness that shows it.
    let factors = TOWER
        .replace("[1.5e7, 4.5e7]", "[0.5, 1.5]")
        .replace("[1.25e7, 3.75e7]", "[0.5, 1.5]")
        .replace("n_per_m = 2.5e7 },\n]", "n_per_m = 1.0 },\n]");
    std::fs::write(world.path("factors.toml"), &factors).unwrap();
    let (_, said) = world.fails(&["check", "factors.toml"]);
    assert!(
        said.contains("the prior of k1 runs from 0.5 to 1.5 N/m, but the nominal stiffness of spring k1 is 30 MN/m: did you mean `scale = true`")
            && said.contains("[1.5e7, 4.5e7]"),
        "{said}"
    );
    // As said: with `scale = true` the same file has the frequencies of the tower.
    let scaled = factors
        .replace("prior = { uniform = [0.5", "scale = true, prior = { uniform = [0.5")
        .replace("n_per_m = 1.0", "n_per_m = 2.5e7");
    std::fs::write(world.path("scaled.toml"), scaled).unwrap();
    assert!(!world.run(&["check", "scaled.toml", "--measured", &text(1.0)]).contains("PROBLEM"));
    std::fs::write(world.path("bare.toml"), factors.replace(", n_per_m = 3e7", "").replace(", n_per_m = 2.5e7", ""))
        .unwrap();
    assert!(world.run(&["check", "bare.toml"]).contains("modes at the nominal parameters"));
    let (_, said) = world.fails(&["check", "bare.toml", "--measured", &text(1.0)]);
    assert!(
        said.contains("the measured frequency of mode 1 is ")
            && said.contains("the prior of k1 runs from 0.5 to 1.5 N/m: did you mean `scale = true`"),
        "{said}"
    );
}

#[test]
fn parameters_that_the_modes_cannot_tell_apart_are_named() {
    let world = World::new();
    // Two springs beside each other, of which only the sum matters.
    let twins = TOWER
        .replace("spring = [", "spring = [\n    { name = \"k0\", from = \"ground\", to = \"m1\", n_per_m = 3e7 },")
        .replace(
            "parameter = [",
            "parameter = [\n    { name = \"k0\", prior = { uniform = [1.5e7, 4.5e7] }, sets = { spring = \"k0\" } },",
        );
    std::fs::write(world.path("twins.toml"), twins).unwrap();
    let found = figures(&world, &["twins.toml"]);
    let together: Vec<(String, String, f64)> = serde_json::from_value(found["together"].clone()).unwrap();
    assert!(
        together.len() == 1 && together[0].0 == "k0" && together[0].1 == "k1" && together[0].2 < -0.95,
        "{together:?}"
    );
    assert!(found["condition"].is_null() || found["condition"].as_f64().unwrap() > 1e6, "{found}");
    let alone = figures(&world, &["tower.toml"]);
    assert!(
        alone["together"].as_array().unwrap().is_empty() && alone["condition"].as_f64().unwrap() < 100.0,
        "{alone}"
    );
}

#[test]
fn towers_beams_and_frames_are_drawn_with_all_their_parts() {
    let world = World::new();
    let beam = r#"
        id = "footbridge"
        simulation = "beam"
        modes = 2
        measurement_noise = { relative = 0.002 }
        node = [{ name = "a", x_m = 0, support = "pinned" }, { name = "b", x_m = 20 }, { name = "c", x_m = 45, support = "clamped" }]
        beam = [
            { name = "west", from = "a", to = "b", bending_stiffness_n_m2 = 4e8, mass_kg_per_m = 900 },
            { name = "east", from = "b", to = "c", bending_stiffness_n_m2 = 4e8, mass_kg_per_m = 900 },
        ]
        mass = [{ name = "crane", kg = 2000, at = "b" }]
        spring = [{ name = "pier", from = "ground", to = "b", n_per_m = 1e6 }, { name = "joint", from = "ground", to = "a", n_m_per_rad = 1e6 }]
        parameter = [{ name = "west_ei", prior = { uniform = [2e8, 6e8] }, sets = { beam = "west" } }]
    "#;
    std::fs::write(world.path("footbridge.toml"), beam).unwrap();
    for (structure, parts) in [
        ("tower.toml", vec!["m1", "m2", "m3", "m4", "k1", "k2", "k3", "k4"]),
        ("footbridge.toml", vec!["a", "b", "c", "west", "east", "pier", "joint"]),
        ("three-dof", vec!["m1", "m2", "m3", "k1", "k2", "k3", "k4", "k5", "k6"]),
    ] {
        for mode in ["1", "2"] {
            world.run(&["check", structure, "--svg", "drawing.svg", "--mode", mode]);
            let svg = std::fs::read_to_string(world.path("drawing.svg")).unwrap();
            for part in &parts {
                assert!(svg.contains(&format!("data-name=\"{part}\"")), "{structure}: {part}");
            }
            assert!(svg.contains(&format!("mode {mode}, ")) && svg.contains("class=\"shape\""), "{structure}: {svg}");
            assert!(!svg.contains("NaN") && !svg.contains("inf"), "{structure}");
            // A bridge has an axis in metres; masses on springs have no coordinates.
            let axis = svg.split("<g class=\"axis\"").nth(1).and_then(|rest| rest.split("</g>").next());
            assert_eq!(axis.is_some(), structure == "footbridge.toml", "{structure}: {svg}");
            if let Some(axis) = axis {
                assert!(axis.contains(">m</text>") && axis.contains(">20</text>"), "{axis}");
            }
        }
    }
}

#[test]
fn a_narrower_prior_leaves_a_smaller_standard_deviation_and_a_larger_share_of_its_variance() {
    let world = World::new();
    let of = |name: &str, prior: &str| {
        let text = TOWER.replacen("{ uniform = [1.5e7, 4.5e7] }", prior, 1);
        std::fs::write(world.path(name), text).unwrap();
        figures(&world, &[name])["parameters"][0].clone()
    };
    let uniform = of("uniform.toml", "{ uniform = [1.5e7, 4.5e7] }");
    let normal = of("normal.toml", "{ normal = { mean = 3e7, std = 1e5 } }");
    let log_normal = of("log_normal.toml", "{ log_normal = { median = 3e7, relative_std = 0.00333333 } }");
    let number = |figures: &Value, key: &str| figures[key].as_f64().unwrap();
    // The information of the prior adds to that of the measurement, of which the uniform prior has hardly a share.
    let of_data = number(&uniform, "std").powi(-2) - 12.0 / 3e7_f64.powi(2);
    let expected = (of_data + 1e5_f64.powi(-2)).sqrt().recip();
    for (figures, key) in [(&normal, "normal"), (&log_normal, "log_normal")] {
        assert!((number(figures, "std") / expected - 1.0).abs() < 0.02, "{figures} {expected}");
        let left = (number(figures, "std") / 1e5).powi(2);
        assert!((number(figures, "variance_left") / left - 1.0).abs() < 0.02, "{figures} {left}");
        assert!(figures["prior_form"][key].is_object(), "{figures}");
    }
    assert_eq!(uniform["prior_form"], "uniform");
    assert!(number(&uniform, "variance_left") < number(&normal, "variance_left"));
}
