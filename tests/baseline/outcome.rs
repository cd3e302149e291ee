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

#[test]
fn an_overconfident_model_ends_in_an_exit_status_and_the_next_command() {
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("briefly");
    let out = out.to_str().unwrap();
    let trained = modalwatch(&["train", "--structure", "three-dof", "--samples", "300", "--epochs", "1", "--out", out]);
    let (said, complained) = (text(&trained.stdout), text(&trained.stderr));
    assert_eq!(trained.status.code(), Some(1), "{said}{complained}");
    assert!(said.contains("calibration overconfident"), "{said}");
    assert!(
        complained.contains(&format!("Next: modalwatch train --structure three-dof --out {out} --units 8 --epochs 2")),
        "{complained}"
    );
    // The sentences name the parameter, the situation and the share, and none of the words of the method.
    assert!(said.contains("The intervals of k1 are too narrow when all modes are measured and the noise is"), "{said}");
    for word in ["ranks of", "TARP", "noise ×", "log-likelihood", "nats over"] {
        assert!(!said.contains(word), "{word}: {said}");
    }
    // The files are written, so that the model can be looked at and accepted.
    let model = Path::new(out).join("baseline.safetensors");
    let again = modalwatch(&["calibrate", "--structure", "three-dof", "--model", model.to_str().unwrap()]);
    assert_eq!(again.status.code(), Some(1));
    let complained = text(&again.stderr);
    assert!(complained.contains("Next: modalwatch train --structure three-dof --epochs 2"), "{complained}");
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
