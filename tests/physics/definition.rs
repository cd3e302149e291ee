//! Structure files: every mistake its own error, with its place.

use modalwatch::simulator::definition::StructureDefinition;
use modalwatch::simulator::population::Population;
use modalwatch::simulator::Simulator;

const RIG: &str = include_str!("../../models/rig/structure.toml");
const THREE_DOF: &str = include_str!("../../models/three-dof/structure.toml");
const FRAME: &str = include_str!("../../models/ruler-frame-4dof/structure.toml");

const SMALL: &str = r#"id = "small"
modes = 2
[[mass]]
name = "m1"
kg = 1.0
[[mass]]
name = "m2"
kg = 1.0
[[spring]]
name = "k1"
from = "ground"
to = "m1"
n_per_m = 10.0
[[spring]]
name = "k2"
from = "m1"
to = "m2"
[[parameter]]
name = "p"
prior = { uniform = [5.0, 15.0] }
sets = { spring = "k2" }
[[covariate]]
name = "temperature_c"
"#;

#[test]
fn the_shipped_structures_are_read_and_differ() {
    let digests: Vec<_> = [RIG, THREE_DOF, FRAME, SMALL]
        .iter()
        .map(|text| Simulator::new(StructureDefinition::parse_toml(text).unwrap()).unwrap().digest().clone())
        .collect();
    assert!((0..digests.len()).all(|i| !digests[..i].contains(&digests[i])));
}

#[test]
fn json_and_toml_of_the_same_structure_have_the_same_digest() {
    for text in [RIG, THREE_DOF, FRAME, SMALL] {
        let from_toml = StructureDefinition::parse_toml(text).unwrap();
        let from_json = StructureDefinition::parse_json(&from_toml.canonical_json()).unwrap();
        assert_eq!(from_toml, from_json);
        assert_eq!(from_toml.digest(), from_json.digest());
    }
}

#[expect(clippy::too_many_lines, reason = "a table of cases")]
#[test]
fn each_mistake_is_named_with_its_line_and_place() {
    // Text to be replaced in the file, its replacement, and the line, the pointer and a part of the message of the mistake.
    let cases: &[(&str, &str, usize, &str, &str)] = &[
        ("modes = 2", "modes = 2\nmods = 3", 3, "", "unknown field `mods`"),
        (
            "name = \"p\"",
            "name = \"p\"\nlaw = \"linear\"",
            20,
            "/parameter/0",
            "belongs into sets of its [[parameter]]",
        ),
        ("to = \"m2\"\n", "to = \"m2\"\nlaw = \"linear\"\n", 18, "/spring/1", "belongs into sets of its [[parameter]]"),
        (
            "name = \"temperature_c\"",
            "name = \"temperature_c\"\nlaw = \"linear\"",
            24,
            "/covariate/0",
            "is an [[effect]]",
        ),
        ("name = \"p\"", "name = \"p\"\ncovariate = \"temperature_c\"", 20, "/parameter/0", "is an [[effect]]"),
        ("modes = 2", "modes = 2\nlaw = \"linear\"", 3, "", "belongs into sets of its [[parameter]]"),
        (
            "sets = { spring = \"k2\" }",
            "sets = { spring = \"k2\", law = \"linear\" }",
            21,
            "/parameter/0/sets",
            "those of an [[effect]]",
        ),
        (
            "sets = { spring = \"k2\" }",
            "sets = { spring = \"k2\", scale = true }",
            21,
            "/parameter/0/sets",
            "belongs to the [[parameter]]",
        ),
        ("to = \"m2\"\n", "to = \"m2\"\nscale = true\n", 18, "/spring/1", "belongs to the [[parameter]]"),
        (
            "to = \"m2\"\n",
            "to = \"m2\"\nprior = { uniform = [5.0, 15.0] }\n",
            18,
            "/spring/1",
            "a prior belongs to a [[parameter]]",
        ),
        (
            "sets = { spring = \"k2\" }",
            "scale = true\nsets = { spring = \"k2\" }",
            22,
            "/parameter/0/sets",
            "must be stated and above 0",
        ),
        (
            "sets = { spring = \"k2\" }",
            "scale = true\nunit = \"N/m\"\nsets = { spring = \"k2\" }",
            22,
            "/parameter/0/unit",
            "remove unit",
        ),
        (
            "sets = { spring = \"k2\" }",
            "scale = true\nsets = { spring = \"k2\", law = { exponential = { a = 1.0, b = 1.0, c = 0.0 } } }",
            22,
            "/parameter/0/sets",
            "remove one of the two",
        ),
        (
            "name = \"temperature_c\"",
            "name = \"temperature_c\"\nunit = \" \"",
            24,
            "/covariate/0/unit",
            "1 to 20 characters",
        ),
        (
            "name = \"temperature_c\"",
            "name = \"lab\"\nkind = \"category\"\nunit = \"°C\"",
            25,
            "/covariate/0/unit",
            "no unit",
        ),
        (
            "name = \"temperature_c\"",
            "name = \"temperature_c\"\nrange = [60.0, -40.0]",
            24,
            "/covariate/0/range",
            "ascending order",
        ),
        (
            "name = \"temperature_c\"",
            "name = \"lab\"\nkind = \"category\"\nrange = [0.0, 1.0]",
            25,
            "/covariate/0/range",
            "no range",
        ),
        ("modes = 2", "modes = 3", 2, "/modes", "1 to 2"),
        ("modes = 2", "modes = 0", 2, "/modes", "0 modes"),
        ("modes = 2", "modes = \"two\"", 2, "/modes", "invalid type"),
        ("modes = 2", "modes = 2\nmeasurement_noise = { relative = -0.1 }", 3, "/measurement_noise/relative", "-0.1"),
        ("modes = 2", "modes = 2\nmeasurement_noise = { percent = 1 }", 3, "/measurement_noise", "unknown variant"),
        ("id = \"small\"", "id = \"Small Bridge\"", 1, "/id", "structure id"),
        ("name = \"m2\"", "name = \"m1\"", 7, "/mass/1/name", "used already by /mass/0"),
        ("name = \"m2\"", "name = \"ground\"", 7, "/mass/1/name", "fixed end"),
        ("name = \"m2\"", "name = \"m 2\"", 7, "/mass/1/name", "letters, digits"),
        ("kg = 1.0\n[[spring]]", "kg = -1.0\n[[spring]]", 8, "/mass/1/kg", "-1 kg"),
        ("kg = 1.0\n[[spring]]", "kg = nan\n[[spring]]", 8, "/mass/1/kg", "NaN kg"),
        ("n_per_m = 10.0", "n_per_m = -10.0", 13, "/spring/0/n_per_m", "not negative"),
        ("to = \"m2\"", "to = \"m9\"", 17, "/spring/1/to", "\"m9\", which is neither a mass nor"),
        ("to = \"m2\"", "to = \"m1\"", 17, "/spring/1/to", "to itself"),
        ("name = \"k2\"", "name = \"k1\"", 15, "/spring/1/name", "used already by /spring/0"),
        ("to = \"m1\"\nn_per_m = 10.0", "to = \"m1\"", 9, "/spring/0", "no n_per_m and no parameter"),
        ("n_per_m = 10.0", "n_per_m = 0.0", 9, "/spring", "mechanism"),
        ("n_per_m = 10.0", "n_per_m = 1e-20", 9, "/spring", "numerically a mechanism"),
        ("uniform = [5.0, 15.0]", "uniform = [15.0, 5.0]", 20, "/parameter/0/prior/uniform", "first below the second"),
        ("uniform = [5.0, 15.0]", "uniform = [-5.0, 15.0]", 20, "/parameter/0/prior/uniform", "stiffness of -5"),
        ("uniform = [5.0, 15.0]", "uniform = [0.0, 15.0]", 20, "/parameter/0/prior/uniform", "allows a mechanism"),
        ("uniform = [5.0, 15.0]", "triangular = [5.0, 15.0]", 20, "/parameter/0/prior", "unknown variant"),
        ("sets = { spring = \"k2\" }", "sets = { spring = \"k9\" }", 21, "/parameter/0/sets", "no spring \"k9\""),
        ("sets = { spring = \"k2\" }", "sets = []", 21, "/parameter/0/sets", "sets nothing"),
        (
            "sets = { spring = \"k2\" }",
            "sets = [{ spring = \"k2\" }, { spring = \"k2\" }]",
            21,
            "/parameter/0/sets/1/spring",
            "set by parameter \"p\" already",
        ),
        (
            "sets = { spring = \"k2\" }",
            "sets = { spring = \"k2\", law = { exponential = { a = -1.0, b = 1.0, c = 0.0 } } }",
            20,
            "/parameter/0/prior/uniform",
            "lets spring \"k2\" have a stiffness of -",
        ),
        (
            "sets = { spring = \"k2\" }",
            "sets = { spring = \"k2\", law = { exponential = { a = 0.0, b = 1e6, c = 1.0 } } }",
            20,
            "/parameter/0/prior/uniform",
            "must be finite",
        ),
        ("sets = { spring = \"k2\" }", "sets = { sprong = \"k2\" }", 21, "/parameter/0/sets", "unknown field `sprong`"),
        ("name = \"temperature_c\"", "name = \"f1_hz\"", 23, "/covariate/0/name", "taken"),
        ("name = \"temperature_c\"", "name = \"set_p\"", 23, "/covariate/0/name", "taken"),
        ("modes = 2", "modes = ", 2, "", ""),
    ];
    for (from, to, line, pointer, message) in cases {
        assert!(SMALL.contains(from), "{from:?} is not in the file");
        let error = StructureDefinition::parse_toml(&SMALL.replacen(from, to, 1)).unwrap_err();
        let found = &error.problems[0];
        assert!(found.message.contains(message), "{to:?}: {found}");
        assert!(found.pointer.starts_with(pointer), "{to:?}: {found}");
        assert_eq!(found.line, Some(*line), "{to:?}: {found}");
    }
}

#[test]
fn several_mistakes_are_reported_together() {
    let text = SMALL.replace("kg = 1.0", "kg = 0.0").replace("to = \"m2\"", "to = \"m3\"");
    let error = StructureDefinition::parse_toml(&text).unwrap_err();
    assert_eq!(error.problems.len(), 3, "{error}");
}

#[test]
fn a_structure_without_masses_or_parameters_is_refused() {
    let error = StructureDefinition::parse_toml("id = \"x\"\nmodes = 1\n").unwrap_err().to_string();
    assert!(error.contains("0 masses") && error.contains("no [[parameter]]"), "{error}");
}

#[test]
fn json_mistakes_have_a_pointer_too() {
    let good = StructureDefinition::parse_toml(SMALL).unwrap().canonical_json();
    let error = StructureDefinition::parse_json(&good.replace("\"kg\":1.0", "\"kg\":\"one\"")).unwrap_err();
    assert_eq!(error.problems[0].pointer, "/mass/0/kg", "{error}");
}

#[test]
fn the_jacobian_agrees_with_finite_differences_through_the_exponential_law() {
    let simulator = Simulator::new(StructureDefinition::parse_toml(RIG).unwrap()).unwrap();
    for theta in [[0.02, 0.07], [0.0475, 0.0475], [0.1, 0.01]] {
        let jacobian = simulator.jacobian(&theta).unwrap();
        let h = 1e-6;
        for column in 0..2 {
            let at = |sign: f64| {
                let mut moved = theta;
                moved[column] += sign * h;
                simulator.frequencies_hz(&moved).unwrap()
            };
            let (up, down) = (at(1.0), at(-1.0));
            for mode in 0..3 {
                let slope = (up[mode] - down[mode]) / (2.0 * h);
                let error = (jacobian[(mode, column)] - slope).abs();
                assert!(error < 1e-6 * (1.0 + slope.abs()), "{theta:?}, mode {mode}, column {column}: {error}");
            }
        }
    }
}

#[test]
fn a_training_set_repeats_with_its_seed_and_begins_with_the_shorter_one() {
    let simulator = Simulator::new(StructureDefinition::parse_toml(RIG).unwrap()).unwrap();
    let set = |samples, seed| simulator.training_set(samples, seed).unwrap();
    assert_eq!(set(50, 1), set(50, 1));
    assert_ne!(set(50, 1).theta, set(50, 2).theta);
    assert_eq!(set(80, 1).theta.rows(0, 50), set(50, 1).theta.rows(0, 50));
    let prior = simulator.space().as_slice()[0].prior();
    assert!(set(500, 3).theta.iter().all(|p| prior.contains(p)));
}

#[test]
fn simulated_noise_has_the_stated_size() {
    let rig = Simulator::new(StructureDefinition::parse_toml(RIG).unwrap()).unwrap();
    let moments = [("p12".to_owned(), 0.05, 0.01), ("p23".to_owned(), 0.05, 0.01)];
    let population = Population::new(rig.space(), &moments).unwrap();
    let measured = |multiple| population.draw(&rig, 4_000, multiple, 1).unwrap().frequencies_hz;
    let ratios = measured(1.0).component_div(&measured(0.0));
    let deviations: Vec<f64> = ratios.iter().map(|r| r - 1.0).collect();
    let std = modalwatch::stats::sample_std(&deviations).unwrap();
    // For 12,000 draws the standard error of a standard deviation is σ/√(2n) = 0.65 %; the tolerance is four of them.
    assert!((std / 0.005 - 1.0).abs() < 4.0 * 0.0065, "{std}");
}

#[test]
fn a_population_must_name_every_parameter_once() {
    let simulator = Simulator::new(StructureDefinition::parse_toml(RIG).unwrap()).unwrap();
    let refused = |moments: &[(&str, f64, f64)]| {
        let moments: Vec<_> = moments.iter().map(|(n, m, s)| ((*n).to_owned(), *m, *s)).collect();
        Population::new(simulator.space(), &moments).unwrap_err().to_string()
    };
    assert!(refused(&[("p12", 0.05, 0.01)]).contains("p23 is not given"));
    assert!(refused(&[("p13", 0.05, 0.01)]).contains("p12, p23"));
    assert!(refused(&[("p12", 0.05, 0.01), ("p12", 0.05, 0.01)]).contains("twice"));
    assert!(refused(&[("p12", 0.05, -0.01)]).contains("not negative"));
}

/// A text of a hundred thousand mistakes is answered by the first hundred and the number of the others.
#[test]
fn of_very_many_mistakes_the_first_are_listed_with_their_lines_and_the_others_are_counted() {
    const SPRINGS: usize = 15_000;
    let mut text = "id = \"bad\"\nmodes = 1\n[[mass]]\nname = \"m\"\nkg = 1\n".to_owned();
    for _ in 0..SPRINGS {
        text += "[[spring]]\nname = \"s\"\nfrom = \"x\"\nto = \"y\"\nn_per_m = -1\n";
    }
    let problems = StructureDefinition::parse_toml(&text).unwrap_err().problems;
    assert_eq!(problems.len(), 101);
    let last = problems.last().unwrap();
    assert_eq!((last.pointer.as_str(), last.line), ("", None));
    let further: usize = last.message.split(' ').next().unwrap().parse().unwrap();
    // Each spring has two unknown ends and a negative stiffness, and each but the first a name that is taken.
    assert!(further + 100 >= 4 * SPRINGS - 1, "{last}");
    for problem in &problems[..100] {
        let Some(rest) = problem.pointer.strip_prefix("/spring/") else { continue };
        let (index, key) = rest.split_once('/').unwrap();
        let place = ["name", "from", "to", "n_per_m"].iter().position(|name| *name == key).unwrap();
        assert_eq!(problem.line, Some(6 + 5 * index.parse::<usize>().unwrap() + 1 + place), "{problem}");
    }
}
