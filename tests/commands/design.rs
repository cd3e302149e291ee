//! `modalwatch design-alarm` says what it is doing, and ends, for a large reference as well.

use crate::commands::world::World;

/// What the command writes on standard output and standard error.
fn designed(world: &World, flags: &[&str]) -> [String; 2] {
    let moments = ["k1=4,0.3", "k2=5,0.1", "k3=6,0.2"].map(|moments| ["--parameter", moments]).concat();
    let output = world.output(&[&["design-alarm", "--structure", "three-dof"][..], &moments[..], flags].concat());
    let [out, err] = [output.stdout, output.stderr].map(|text| String::from_utf8(text).unwrap());
    assert!(output.status.success(), "{flags:?}: {err}");
    [out, err]
}

/// The simulations in the order in which they are named.
const STEPS: [&str; 2] =
    ["simulating healthy batches: the limits", "simulating healthy and damaged batches: false alarms"];

#[test]
fn each_long_step_is_named_before_it_begins() {
    let world = World::new();
    let [out, err] = designed(&world, &["--baseline", "534"]);
    let lines: Vec<&str> = err.lines().collect();
    assert_eq!(lines.len(), STEPS.len(), "{err}");
    assert!(lines.iter().zip(STEPS).all(|(line, step)| line.starts_with(step)), "{err}");
    assert!(out.contains("undamaged reference of 534") && out.contains("a90: change that is detected"), "{out}");

    let weather = ["--baseline", "534", "--batch-correlation", "0.9", "--reference-batches", "60"];
    let [out, err] = designed(&world, &weather);
    let lines: Vec<&str> = err.lines().collect();
    assert!(
        lines.len() > STEPS.len() && lines[STEPS.len()].starts_with("the process of a reference under weather"),
        "{err}"
    );
    assert!(out.contains("lasting loss found with 90 %"), "{out}");
}

#[test]
fn steps_are_not_part_of_a_json_result() {
    let world = World::new();
    let [out, err] = designed(&world, &["--json"]);
    let read: serde_json::Value = serde_json::from_str(&out).unwrap_or_else(|e| panic!("{e}: {out}"));
    assert_eq!(read["structure"], "three-dof");
    assert!(err.contains(STEPS[0]), "{err}");
}
