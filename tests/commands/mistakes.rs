//! Every command that cannot do what it was asked ends with another status than 0 and a sentence about it.

use crate::commands::world::{World, TOWER};

/// Arguments, and a part of the sentence. The status is 1, or 2 where the arguments themselves are wrong.
const CASES: &[(&[&str], i32, &str)] = &[
    (&["serve", "--listen", "localhost"], 1, "a port alone, such as 8080"),
    (&["serve", "--listen", "70000"], 1, "a port from 0 to 65535"),
    (&["serve", "--config", "missing.toml"], 1, "missing.toml cannot be read"),
    (&["serve", "--models", "missing"], 1, "the models folder missing cannot be read"),
    (&["demo", "--exit", "--listen", "http://127.0.0.1:80"], 1, "a port alone, such as 8080"),
    (&["new", "--id", "tower"], 1, "there is no answer to"),
    (&["new", "--id", "No Id"], 1, "structure id"),
    (&["new", "--mass", "m1=heavy"], 2, "such as m1=1e5"),
    (&["check", "missing.toml"], 1, "missing.toml"),
    (&["check", "tower.toml", "--measured", "1,2,3,4,5"], 1, "only 4 modes are measured"),
    (&["check", "tower.toml", "--measured", "-1"], 2, "unexpected argument"),
    (&["check", "tower.toml", "--measured", "0.05"], 1, "outside the prior's range"),
    (&["check", "tower.toml", "--svg", "a.svg", "--mode", "5"], 1, "the measured modes are 1 to 4"),
    (&["train", "--structure", "missing.toml"], 1, "missing.toml"),
    (&["calibrate", "--structure", "tower.toml", "--model", "missing.safetensors"], 1, "cannot read missing.json"),
    (&["calibrate", "--structure", "exact.toml"], 1, "train one with `modalwatch train"),
    (&["design-alarm", "--structure", "tower.toml", "--parameter", "k1=3e7,1e5"], 1, "parameter k2 is not given"),
    (
        &[
            "design-alarm",
            "--structure",
            "three-dof",
            "--parameter",
            "k1=4,0.3",
            "--parameter",
            "k2=5,0.1",
            "--parameter",
            "k3=6,0.2",
            "--batch-correlation",
            "0.9",
            "--reference-batches",
            "5000",
        ],
        1,
        "at most 2000 are simulated",
    ),
    (&["simulate", "missing.toml"], 1, "missing.toml"),
    (&["simulate"], 2, "STRUCTURE"),
    (&["simulate", "tower.toml", "--loss", "k2=8%"], 1, "give --from-date 2026-08-07"),
    (&["simulate", "tower.toml", "--loss", "k9=8%@2026-01-01"], 1, "the parameters are k1, k2, k3"),
    (&["simulate", "tower.toml", "--loss", "k2=8%@2027-01-01"], 1, "after the last measurement"),
    (&["simulate", "tower.toml", "--effect", "k1=-0.2%/temperature_c"], 1, "give it with --covariate temperature_c"),
    (&["simulate", "tower.toml", "--covariate", "temperature_c=warm"], 2, "the mean is not a number"),
    (&["simulate", "tower.toml", "--days", "1e9"], 1, "at most 10000000 are possible"),
    (&["simulate", "tower.toml", "--missing", "1"], 1, "lower --missing"),
    (
        &["assess", "--structure", "three-dof", "--reference", "missing.csv", "--data", "missing.csv"],
        1,
        "cannot read missing.csv",
    ),
    (
        &["update", "--method", "sensitivity", "--structure", "three-dof", "--data", "missing.csv"],
        1,
        "cannot read missing.csv",
    ),
    (&["reproduce", "--out", "out", "--repetitions", "0"], 1, "at least 1 is needed"),
    (&["diagnose", "--structure", "three-dof", "--data", "missing.csv"], 1, "missing.csv"),
    (&["extend", "--structure", "three-dof", "--data", "missing.csv", "--out", "out"], 1, "missing.csv"),
    (&["config", "print", "--config", "missing.toml"], 1, "missing.toml cannot be read"),
    (&["post", "missing.csv", "--structure", "tower"], 1, "missing.csv"),
    (&["report", "--structure", "No Id", "--out", "a.html"], 1, "--structure"),
    (&["report", "--structure", "tower", "--out", "a.html", "--from", "yesterday"], 1, "--from"),
    (&["report", "--structure", "tower", "--out", "a.html", "--url", "http://127.0.0.1:1"], 1, "cannot be reached"),
    (&["healthcheck", "--url", "http://127.0.0.1:1"], 1, "does not answer"),
    (&["restore", "--verify", "--from", "missing"], 1, "missing"),
    (&["export", "--structure", "three-dof", "--out", "out.ndjson"], 1, "has no database"),
    (&["retention", "--dry-run"], 1, "has no database"),
    (&["backup", "--url", "http://127.0.0.1:1"], 1, "cannot be reached"),
    (&["migrate", "schema"], 1, "the configuration has no store.url"),
    (&["migrate", "--from", "tower.toml", "--to", "postgres://watch@127.0.0.1:1/shm"], 1, "sqlite:FOLDER"),
    (
        &["migrate", "--from", "sqlite:absent", "--to", "postgres://watch@127.0.0.1:1/shm"],
        1,
        "has no database of modalwatch",
    ),
    // A folder that does not exist is a typing mistake: nothing is created.
    (&["token", "list", "--data-dir", "absent"], 1, "--data-dir absent does not exist"),
    (
        &["token", "create", "--name", "a", "--scope", "admin", "--data-dir", "absent"],
        1,
        "--data-dir absent does not exist",
    ),
    (&["doctor", "--data-dir", "absent"], 1, "--data-dir absent does not exist"),
    (&["backup", "--data-dir", "absent"], 1, "--data-dir absent does not exist"),
    (&["restore", "--from", "backup", "--data-dir", "absent"], 1, "--data-dir absent does not exist"),
    (
        &["export", "--structure", "three-dof", "--out", "out.ndjson", "--data-dir", "absent"],
        1,
        "--data-dir absent does not exist",
    ),
    (&["import", "--from", "tower.toml", "--data-dir", "absent"], 1, "--data-dir absent does not exist"),
    (&["retention", "--data-dir", "absent"], 1, "--data-dir absent does not exist"),
    // The last, because it creates the default data folder.
    (&["import", "--from", "missing.ndjson"], 1, "missing.ndjson"),
];

#[test]
fn each_failure_has_a_status_and_a_sentence_and_creates_no_data_folder() {
    let world = World::new();
    // Without noise, draws cannot be weighed by the simulation.
    let exact = TOWER.replace("measurement_noise = { relative = 0.002 }\n", "");
    std::fs::write(world.path("exact.toml"), exact).unwrap();
    for (arguments, status, part) in CASES {
        let (found, said) = world.fails(arguments);
        assert_eq!(found, *status, "{arguments:?}: {said}");
        assert!(said.contains(part), "{arguments:?} should say {part:?}: {said}");
        assert!(!said.contains("panicked") && !said.contains("RUST_BACKTRACE"), "{arguments:?}: {said}");
    }
    assert!(!world.path("absent").exists());
}

#[test]
fn every_command_has_a_case() {
    let world = World::new();
    let help = world.run(&["--help"]);
    let commands = help.lines().skip_while(|line| *line != "Commands:").skip(1).take_while(|line| !line.is_empty());
    let names: Vec<&str> =
        commands.filter_map(|line| line.split_whitespace().next()).filter(|name| *name != "help").collect();
    assert!(names.len() > 15, "{help}");
    for name in names {
        assert!(CASES.iter().any(|(arguments, ..)| arguments[0] == name), "{name} has no case in this table");
    }
}

#[test]
fn an_output_that_cannot_be_written_is_a_failure() {
    if !std::path::Path::new("/dev/full").exists() {
        return;
    }
    let world = World::new();
    let full = std::fs::OpenOptions::new().write(true).open("/dev/full").unwrap();
    let output = world.command(&["simulate", "tower.toml"]).stdout(full).output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!(output.status.code(), Some(1), "{said}");
    assert!(said.contains("the output cannot be written"), "{said}");
}

#[test]
fn measurements_that_are_not_accepted_are_not_taken_for_healthy() {
    let world = World::new();
    let population = ["--parameter", "k1=4,0.3", "--parameter", "k2=5,0.1", "--parameter", "k3=6,0.2"];
    world.run(&[&["simulate", "three-dof", "--out", "healthy.csv"], &population[..]].concat());
    let healthy = std::fs::read_to_string(world.path("healthy.csv")).unwrap();
    // Frequencies in rad/s instead of Hz.
    let mut lines = healthy.lines();
    let mut wrong = vec![lines.next().unwrap().to_owned()];
    for line in lines {
        let mut cells = line.split(',');
        let at = cells.next().unwrap().to_owned();
        let scaled = cells.map(|f| (f.parse::<f64>().unwrap() * std::f64::consts::TAU).to_string());
        wrong.push(std::iter::once(at).chain(scaled).collect::<Vec<_>>().join(","));
    }
    let wrong = wrong.join("\n") + "\n";
    std::fs::write(world.path("wrong.csv"), wrong).unwrap();
    let assess =
        |data: &'static str| ["assess", "--structure", "three-dof", "--reference", "healthy.csv", "--data", data];
    world.run(&assess("healthy.csv"));
    let (status, said) = world.fails(&assess("wrong.csv"));
    assert!(status == 1 && said.contains("wrong.csv is not accepted"), "{said}");
}
