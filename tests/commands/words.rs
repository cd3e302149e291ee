//! What commands print about a structure has no word that only its authors understand.

use crate::commands::world::World;

/// Labels that were on pages and in outputs, each of which has been replaced.
const RIDDLES: [&str; 16] = [
    "not uniform",
    "noise ×",
    "× nominal",
    "log likelihood",
    "moved nothing",
    "p of fit",
    "(p = ",
    "(p < ",
    "spring:",
    "swing",
    "can absorb",
    "PossibleDamage",
    "nats",
    "flow",
    "share per unit",
    "to note",
];

/// Numbers such as `0.0e0`, which programs write and people do not.
fn programmers_numbers(said: &str) -> Vec<&str> {
    let words = said.split(|c: char| c.is_whitespace() || ",;()[]%".contains(c));
    words.filter(|word| word.ends_with("e0") && word.parse::<f64>().is_ok()).collect()
}

/// Fails if an output has a word that only the authors understand.
fn assert_plain(said: &str, what: &[&str]) {
    assert!(said.len() > 200, "{what:?}: {said}");
    for riddle in RIDDLES {
        assert!(!said.contains(riddle), "{what:?} says {riddle:?}: {said}");
    }
    assert_eq!(programmers_numbers(said), Vec::<&str>::new(), "{what:?}: {said}");
}

#[test]
fn outputs_have_no_names_that_only_the_authors_understand() {
    let world = World::new();
    // A rig whose stiffnesses follow from its parameters by a law, healthy and with a loss.
    let rig = ["--parameter", "p23=0.05,0.002"];
    let simulate = |p12: &str, out: &str| {
        let own = ["simulate", "--structure", "rig", "--parameter", p12, "--measurements", "30", "--out", out];
        world.run(&[&own[..], &rig[..]].concat());
    };
    simulate("p12=0.05,0.002", "healthy.csv");
    simulate("p12=0.035,0.002", "lost.csv");
    let data = ["--structure", "rig", "--data", "lost.csv"];
    // A tower whose lowest storey softens with temperature, so that a diagnosis finds a cause.
    let moments = ["k1=3e7,1e5", "k2=3e7,1e5", "k3=2.5e7,1e5"].map(|moments| ["--parameter", moments]).concat();
    let weather = ["--covariate", "temperature_c=10,year=10,day=4,weather=3", "--effect", "k1=-0.3%/temperature_c"];
    let days =
        ["simulate", "tower.toml", "--start", "2026-01-01", "--every", "12h", "--days", "100", "--out", "tower.csv"];
    world.run(&[&days[..], &moments[..], &weather[..]].concat());
    let commands: [Vec<&str>; 7] = [
        vec!["check", "rig"],
        vec!["calibrate", "--structure", "rig"],
        [&["design-alarm", "--structure", "rig", "--parameter", "p12=0.05,0.002"][..], &rig[..]].concat(),
        [&["assess", "--reference", "healthy.csv"][..], &data[..]].concat(),
        [&["update", "--method", "cinn"][..], &data[..]].concat(),
        [&["update", "--method", "tmcmc", "--samples", "200"][..], &data[..]].concat(),
        vec!["diagnose", "--structure", "tower.toml", "--data", "tower.csv"],
    ];
    for command in commands {
        assert_plain(&world.run(&command), &command);
    }
    let assessed = world.run(&[&["assess", "--reference", "healthy.csv"][..], &data[..]].concat());
    assert!(
        assessed.contains("stiffness of spring k12 (N/m)") && assessed.contains("PoD: probability of damage"),
        "{assessed}"
    );
}

/// Two masses on two springs, trained in seconds.
const SMALL: &str = r#"
id = "small"
modes = 2
measurement_noise = { relative = 0.002 }
mass = [{ name = "m1", kg = 1000.0 }, { name = "m2", kg = 800.0 }]
spring = [
    { name = "k1", from = "ground", to = "m1", n_per_m = 1.0e7 },
    { name = "k2", from = "m1", to = "m2", n_per_m = 1.4e7 },
]
parameter = [{ name = "k1", prior = { uniform = [5.0e6, 1.5e7] }, sets = { spring = "k1" } }]
"#;

#[test]
fn a_training_is_reported_in_plain_words_whether_its_calibration_passes_or_not() {
    let world = World::new();
    std::fs::write(world.path("small.toml"), SMALL).unwrap();
    let recipe = ["--samples", "2000", "--epochs", "2", "--rounds", "1", "--noise-range", "0.5,2"];
    let train = [&["train", "--structure", "small.toml", "--out", "model"][..], &recipe[..]].concat();
    let output = world.output(&train);
    let [out, err] = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
    assert_plain(&out, &train);
    assert_plain(&format!("{out}{err}"), &train);
    assert!(out.contains("times the probability density that the prior gives them"), "{out}");
}
