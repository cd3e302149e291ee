//! Trained models that are damaged, of another structure, huge or of a newer program are refused with the reason; all other
//! structures are served.

use std::fs::File;
use std::path::Path;

use modalwatch::quantity::Digest;
use serde_json::{json, Value};
use tempfile::TempDir;

use crate::faults::kit::{batch, post, resident_mib};
use crate::helpers::{command, repository, Service};

/// Change of the files in the folder of a trained model.
type Change = Box<dyn Fn(&Path)>;

fn weights(folder: &Path) -> std::path::PathBuf {
    folder.join("baseline.safetensors")
}

/// Changes the manifest.
fn manifest(folder: &Path, change: impl Fn(&mut Value)) {
    let path = folder.join("baseline.json");
    let mut manifest: Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    change(&mut manifest);
    std::fs::write(path, serde_json::to_vec(&manifest).unwrap()).unwrap();
}

/// Writes weights, and a manifest that matches them.
fn signed(folder: &Path, bytes: &[u8]) {
    std::fs::write(weights(folder), bytes).unwrap();
    let digest = Digest::of_file(bytes);
    manifest(folder, |manifest| manifest["weights_sha256"] = json!(digest.as_str()));
}

fn models_with(change: &Change) -> TempDir {
    let folder = tempfile::tempdir().unwrap();
    let target = folder.path().join("three-dof");
    std::fs::create_dir(&target).unwrap();
    for name in ["structure.toml", "baseline.json", "baseline.safetensors"] {
        std::fs::copy(repository("models/three-dof").join(name), target.join(name)).unwrap();
    }
    change(&target);
    folder
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn each_kind_of_invalid_model_is_refused_with_its_reason_and_batches_wait() {
    let cases: Vec<(&str, Change, &str)> = vec![
        (
            "a header that claims to be longer than memory",
            Box::new(|f| signed(f, &[&u64::MAX.to_le_bytes()[..], b"{}"].concat())),
            "safetensors",
        ),
        (
            "a header that claims 90 MB of a short file",
            Box::new(|f| signed(f, &[&90_000_000_u64.to_le_bytes()[..], &vec![b' '; 1_000][..]].concat())),
            "safetensors",
        ),
        (
            "a header of a million brackets",
            Box::new(|f| signed(f, &[&1_000_000_u64.to_le_bytes()[..], &vec![b'['; 1_000_000][..]].concat())),
            "safetensors",
        ),
        (
            "a file larger than any trained model",
            Box::new(|f| File::create(weights(f)).unwrap().set_len(20 << 30).unwrap()),
            "more than the 268435456 that are accepted",
        ),
        (
            "weights of another architecture",
            Box::new(|f| signed(f, &std::fs::read(repository("models/rig/baseline.safetensors")).unwrap())),
            "architecture",
        ),
        (
            "a manifest that claims a gigantic architecture",
            Box::new(|f| {
                manifest(f, |m| {
                    let sizes = m["architecture"].as_object_mut().unwrap();
                    for (_, size) in sizes.iter_mut().filter(|(name, _)| name.contains("width")) {
                        *size = json!(4_000_000_000_u64);
                    }
                });
            }),
            "architecture",
        ),
        ("a manifest of a newer format", Box::new(|f| manifest(f, |m| m["format"] = json!(99))), "format 99"),
        (
            "a manifest of a newer program",
            Box::new(|f| manifest(f, |m| m["attention_heads"] = json!(8))),
            "attention_heads",
        ),
        (
            "a self-test that does not come out",
            Box::new(|f| manifest(f, |m| m["self_test"]["seed"] = json!(999))),
            "self-test",
        ),
        (
            "weights that are all infinite",
            Box::new(|f| {
                let mut bytes = std::fs::read(weights(f)).unwrap();
                let header = u64::from_le_bytes(bytes[..8].try_into().unwrap()) as usize;
                for value in bytes[8 + header..].chunks_exact_mut(4) {
                    value.copy_from_slice(&f32::INFINITY.to_le_bytes());
                }
                signed(f, &bytes);
            }),
            "not finite",
        ),
        ("no weights", Box::new(|f| std::fs::remove_file(weights(f)).unwrap()), "no trained model"),
        (
            "weights that are a folder",
            Box::new(|f| {
                std::fs::remove_file(weights(f)).unwrap();
                std::fs::create_dir(weights(f)).unwrap();
            }),
            "no trained model",
        ),
    ];
    for (name, change, reason) in &cases {
        let models = models_with(change);
        let folder = tempfile::tempdir().unwrap();
        let service = Service::spawn(command(folder.path()).arg("--models").arg(models.path()));
        let ready = service.read("/readyz").await;
        assert_eq!((&ready["ready"], &ready["baselines_in_use"]), (&json!(true), &json!(2)), "{name}: {ready}");
        if *reason != "no trained model" {
            assert!(ready["baselines_refused"].to_string().contains(reason), "{name}: {ready}");
        }
        let structure = service.read("/v1/structures/three-dof").await;
        assert!(structure["model_missing"].to_string().contains(reason), "{name}: {structure}");
        let (status, answer) = post(&service, &batch("waits", 0, 3)).await.unwrap();
        assert_eq!((status, &answer["state"]), (201, &json!("received")), "{name}: {answer}");
        let memory = resident_mib(service.pid());
        assert!(memory < 400.0, "{name}: {memory:.0} MiB");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn without_any_trained_model_the_service_is_not_ready_and_still_accepts_batches() {
    let models = tempfile::tempdir().unwrap();
    for id in ["three-dof", "rig", "ruler-frame-4dof"] {
        let target = models.path().join(id);
        std::fs::create_dir(&target).unwrap();
        std::fs::copy(repository("models").join(id).join("structure.toml"), target.join("structure.toml")).unwrap();
        std::fs::write(target.join("baseline.safetensors"), "").unwrap();
    }
    let folder = tempfile::tempdir().unwrap();
    let service = Service::spawn(command(folder.path()).arg("--models").arg(models.path()));
    let response = service.get("/readyz").send().await.unwrap();
    assert_eq!(response.status(), 503);
    let ready: Value = response.json().await.unwrap();
    assert_eq!(ready["reasons"][0]["code"], "no_model", "{ready}");
    assert_eq!(ready["baselines_refused"].as_array().unwrap().len(), 3, "{ready}");
    let (status, answer) = post(&service, &batch("waits", 0, 3)).await.unwrap();
    assert_eq!((status, &answer["state"]), (201, &json!("received")), "{answer}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_model_that_failed_its_calibration_is_used_only_if_its_digest_is_accepted_and_says_so() {
    let failure = "all modes: ranks of k1 are not uniform (p = 1.0e-9)";
    let change: Change = Box::new(move |f| manifest(f, |m| m["calibration"]["failures"] = json!([failure])));
    let models = models_with(&change);
    let digest = Digest::of_file(&std::fs::read(models.path().join("three-dof/baseline.json")).unwrap());
    let folder = tempfile::tempdir().unwrap();
    let mut service = Service::spawn(command(folder.path()).arg("--models").arg(models.path()));
    let structure = service.read("/v1/structures/three-dof").await;
    let why = structure["model_missing"].as_str().unwrap();
    assert!(why.contains("failed its calibration") && why.contains(digest.as_str()), "{structure}");
    let waiting = batch("waits", 0, 5);
    assert_eq!(post(&service, &waiting).await.unwrap().1["state"], "received");
    assert!(service.stop("TERM").success());

    let mut accepting = command(folder.path());
    accepting.env("MODALWATCH__MONITOR__ACCEPT_UNCALIBRATED", format!("[\"{digest}\"]"));
    let service = Service::spawn(accepting.arg("--models").arg(models.path()));
    for given in [waiting, batch("next", 0, 5)] {
        let (status, answer) = post(&service, &given).await.unwrap();
        assert_eq!((status, &answer["state"]), (201, &json!("assessed")), "{answer}");
        let codes = answer["assessment"]["findings"].as_array().unwrap().iter().map(|f| &f["code"]);
        assert!(codes.into_iter().any(|code| code == "uncalibrated"), "{answer}");
    }
    assert_eq!(finding_about_the_model(&service).await, ["model_overconfident"]);
    let structure = service.read("/v1/structures/three-dof").await;
    assert_eq!(structure["model"]["calibration_outcome"], "overconfident", "{structure}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_cautious_model_is_used_and_named() {
    let caution = "The intervals of k1 are too wide when all modes are measured and the noise is the nominal one: 95 % of the true \
                   values lie inside the 90 % intervals";
    let change: Change = Box::new(move |f| manifest(f, |m| m["calibration"]["cautions"] = json!([caution])));
    let models = models_with(&change);
    let folder = tempfile::tempdir().unwrap();
    let service = Service::spawn(command(folder.path()).arg("--models").arg(models.path()));
    let (status, answer) = post(&service, &batch("usable", 0, 5)).await.unwrap();
    assert_eq!((status, &answer["state"]), (201, &json!("assessed")), "{answer}");
    assert_eq!(finding_about_the_model(&service).await, ["model_cautious"]);
    let structure = service.read("/v1/structures/three-dof").await;
    assert_eq!(structure["model"]["calibration_outcome"], "cautious", "{structure}");
    assert_eq!(structure["model"]["calibration"]["cautions"], json!([caution]), "{structure}");
    let list = service.read("/v1/structures").await;
    let outcomes: Vec<(&Value, &Value)> =
        list["items"].as_array().unwrap().iter().map(|item| (&item["id"], &item["calibration_outcome"])).collect();
    assert!(outcomes.contains(&(&json!("three-dof"), &json!("cautious"))), "{list}");
    assert!(outcomes.contains(&(&json!("rig"), &json!("passed"))), "{list}");
}

/// Codes of the findings of `/readyz` that name the model of three-dof.
async fn finding_about_the_model(service: &Service) -> Vec<String> {
    let ready = service.read("/readyz").await;
    let findings = ready["findings"].as_array().unwrap().clone();
    let about = findings.into_iter().filter(|finding| finding["message"].as_str().unwrap().starts_with("three-dof: "));
    about.map(|finding| finding["code"].as_str().unwrap().to_owned()).collect()
}
