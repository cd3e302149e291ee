//! The three outcomes of a calibration on the command line, and in manifests of earlier versions.

use std::path::Path;
use std::process::{Command, Output};

use modalwatch::baseline::manifest::{CalibrationRecord, Manifest, Outcome};

fn modalwatch(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_modalwatch")).args(arguments).output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// A structure with one parameter, whose effect has an uncertain coefficient, so that the simulation corrects no sample.
const UNCERTAIN: &str = r#"
id = "pair"
modes = 2
measurement_noise = { relative = 0.003 }
mass = [{ name = "m1", kg = 1.0 }, { name = "m2", kg = 2.0 }]
spring = [
    { name = "k1", from = "ground", to = "m1" },
    { name = "k2", from = "m1", to = "m2", n_per_m = 20.0 },
]
parameter = [{ name = "k1", prior = { uniform = [5.0, 15.0] }, sets = { spring = "k1" } }]
covariate = [{ name = "temperature_c" }]
[[effect]]
name = "warm"
target = { springs = ["k2"] }
law = "linear"
covariate = "temperature_c"
reference = 10.0
numbers = { slope_per_unit = -0.004 }
covariance = [[1e-6]]
seen = [-10.0, 10.0, 30.0]
"#;

#[test]
fn an_overconfident_model_ends_in_an_exit_status_and_the_next_command() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    std::fs::write(path("pair.toml"), UNCERTAIN).unwrap();
    let (structure, out) = (path("pair.toml"), path("pair"));
    modalwatch(&["train", "--structure", &structure, "--samples", "4000", "--epochs", "10", "--out", &out]);
    // The files are written whatever the outcome is. Samples at half their spread are too narrow.
    let (manifest, model) = (path("pair/baseline.json"), path("pair/baseline.safetensors"));
    let mut narrowed: serde_json::Value = serde_json::from_slice(&std::fs::read(&manifest).unwrap()).unwrap();
    narrowed["spread"] = serde_json::json!([{ "noise_multiple": 1.0, "missing_mode": null, "scales": [0.5] }]);
    std::fs::write(&manifest, serde_json::to_vec(&narrowed).unwrap()).unwrap();
    let measured = modalwatch(&["calibrate", "--structure", &structure, "--model", &model]);
    let (said, complained) = (text(&measured.stdout), text(&measured.stderr));
    assert_eq!(measured.status.code(), Some(1), "{said}{complained}");
    let next = format!("Next: modalwatch train --structure {structure} --epochs 20 --rounds 4 --out {out}");
    assert!(complained.contains(&next), "{complained}");
    // The sentences name the parameter, the situation and the share, and none of the words of the method.
    let sentence = "The intervals of k1 are too narrow when all modes are measured and the noise is the nominal one: ";
    assert!(said.contains("overconfident:") && said.contains(sentence), "{said}");
    for word in ["ranks of", "TARP coverage", "noise ×"] {
        assert!(!said.contains(word), "{word}: {said}");
    }
    // A factor of zero would make all samples equal.
    narrowed["spread"][0]["scales"] = serde_json::json!([0.0]);
    std::fs::write(&manifest, serde_json::to_vec(&narrowed).unwrap()).unwrap();
    let refused = modalwatch(&["calibrate", "--structure", &structure, "--model", &model]);
    assert!(text(&refused.stderr).contains("spread has the factor 0"), "{}", text(&refused.stderr));
}

#[test]
fn a_training_without_noise_ends_in_an_exit_status_and_says_what_to_state() {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let without_effect = UNCERTAIN.split("covariate = [").next().unwrap().replace("relative = 0.003", "relative = 0.0");
    std::fs::write(path("exact.toml"), without_effect).unwrap();
    let (structure, out) = (path("exact.toml"), path("exact"));
    let trained = modalwatch(&["train", "--structure", &structure, "--samples", "500", "--epochs", "2", "--out", &out]);
    let complained = text(&trained.stderr);
    assert_eq!(trained.status.code(), Some(1), "{complained}");
    let next = format!("Next: state measurement_noise in {structure}, then modalwatch train --structure {structure}");
    assert!(complained.contains(&next), "{complained}");
    assert!(Path::new(&path("exact/baseline.json")).exists());
}

#[test]
fn the_shipped_model_passes_and_its_manifest_of_an_earlier_version_is_read() {
    let measured = modalwatch(&["calibrate", "--structure", "three-dof"]);
    assert!(measured.status.success(), "{}", text(&measured.stderr));
    assert!(text(&measured.stdout).contains("passed: 12 situations of 1000 simulated measurements"));
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("models/three-dof/baseline.json");
    let bytes = std::fs::read(path).unwrap();
    let manifest: Manifest = serde_json::from_slice(&bytes).unwrap();
    assert_eq!(manifest.calibration.outcome(), Outcome::Passed);
    // Nothing that this version added is written to it, so that its digest would stay the same.
    let mut written = serde_json::to_vec_pretty(&manifest).unwrap();
    written.push(b'\n');
    assert!(written == bytes, "the manifest is written as it was read");
    // What an earlier version called a failure remains one until the calibration is measured again.
    let failed = CalibrationRecord { failures: vec!["…".to_owned()], ..manifest.calibration };
    assert_eq!(failed.outcome(), Outcome::Overconfident);
}
