//! What commands print about a structure has no word that only its authors understand.

use crate::world::World;

/// Labels that were on pages and in outputs, each of which has been replaced.
const RIDDLES: [&str; 12] = [
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
];

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
    let commands: [Vec<&str>; 5] = [
        vec!["check", "rig"],
        vec!["calibrate", "--structure", "rig"],
        [&["design-alarm", "--structure", "rig", "--parameter", "p12=0.05,0.002"][..], &rig[..]].concat(),
        [&["assess", "--reference", "healthy.csv"][..], &data[..]].concat(),
        [&["update", "--method", "cinn"][..], &data[..]].concat(),
    ];
    for command in commands {
        let said = world.run(&command);
        assert!(said.len() > 200, "{command:?}: {said}");
        for riddle in RIDDLES {
            assert!(!said.contains(riddle), "{command:?} says {riddle:?}: {said}");
        }
    }
    let assessed = world.run(&[&["assess", "--reference", "healthy.csv"][..], &data[..]].concat());
    assert!(
        assessed.contains("stiffness of spring k12 (N/m)") && assessed.contains("PoD: probability of damage"),
        "{assessed}"
    );
}
