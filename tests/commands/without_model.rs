//! Measurements are answered without a trained model, by one that is made in a second.

use serde_json::Value;

use crate::commands::world::World;

const DATA: [&str; 9] =
    ["simulate", "tower.toml", "--start", "2026-01-01", "--every", "1h", "--measurements", "40", "--out"];

/// Runs a command that must succeed, and say that no trained model was found; its JSON.
fn answer(world: &World, arguments: &[&str]) -> Value {
    let output = world.output(arguments);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{arguments:?}: {said}");
    assert!(said.contains("there is no trained model of this version of tower"), "{said}");
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn a_loss_is_assessed_and_a_population_estimated_without_a_trained_model() {
    let world = World::new();
    let simulate = |k2: &str, out: &str| {
        let moments = ["--parameter", "k1=3e7,1.5e5", "--parameter", k2, "--parameter", "k3=2.5e7,1.2e5"];
        world.run(&[&DATA[..], &[out], &moments[..]].concat());
    };
    simulate("k2=3e7,1.5e5", "healthy.csv");
    simulate("k2=2.7e7,1.5e5", "lost.csv");
    let files = ["--structure", "tower.toml", "--reference", "healthy.csv", "--data", "lost.csv", "--json"];
    let assessed = answer(&world, &[&["assess"], &files[..]].concat());
    for (parameter, truth) in assessed["assessment"]["quantities"].as_array().unwrap().iter().zip([0.0, -0.1, 0.0]) {
        let edge = |side: usize| parameter["damage"]["relative_change_interval"][side].as_f64().unwrap();
        // The 90 % interval is narrow, and its middle at most four of its half-widths, 6.6 standard errors, from the truth.
        let (middle, half) = (f64::midpoint(edge(0), edge(1)), (edge(1) - edge(0)) / 2.0);
        assert!(half < 0.01 && (middle - truth).abs() < 4.0 * half, "{parameter}: {truth}");
    }
    let update = ["update", "--method", "cinn", "--structure", "tower.toml", "--data", "lost.csv", "--json"];
    let updated = answer(&world, &update);
    for (parameter, truth) in updated["parameters"].as_array().unwrap().iter().zip([3e7, 2.7e7, 2.5e7]) {
        assert!((parameter["mean"].as_f64().unwrap() / truth - 1.0).abs() < 0.01, "{parameter}: {truth}");
    }
}
