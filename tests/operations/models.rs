//! Trained models are replaced while batches are posted.

use std::collections::BTreeSet;
use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};

use data_encoding::HEXLOWER;
use serde_json::{json, Value};
use sha2::{Digest as _, Sha256};

use crate::helpers::{command, eventually, measurements, problem, repository, Service};
use crate::operations::world::{settled, with_past};

/// A models folder with the shipped `three-dof`.
fn models() -> tempfile::TempDir {
    let folder = tempfile::tempdir().unwrap();
    let to = folder.path().join("three-dof");
    std::fs::create_dir(&to).unwrap();
    for name in ["structure.toml", "baseline.json", "baseline.safetensors"] {
        std::fs::copy(repository("models/three-dof").join(name), to.join(name)).unwrap();
    }
    folder
}

fn manifest(models: &Path) -> Value {
    serde_json::from_slice(&std::fs::read(repository("models/three-dof/baseline.json")).unwrap()).unwrap_or_else(|e| {
        panic!("{}: {e}", models.display());
    })
}

fn put_manifest(models: &Path, manifest: &Value) {
    std::fs::write(models.join("three-dof/baseline.json"), serde_json::to_vec(manifest).unwrap()).unwrap();
}

/// Writes weights, and their digest into the manifest.
fn put_weights(models: &Path, weights: &[u8]) {
    let mut manifest = manifest(models);
    manifest["weights_sha256"] = json!(HEXLOWER.encode(&Sha256::digest(weights)));
    std::fs::write(models.join("three-dof/baseline.safetensors"), weights).unwrap();
    put_manifest(models, &manifest);
}

fn weights() -> Vec<u8> {
    std::fs::read(repository("models/three-dof/baseline.safetensors")).unwrap()
}

fn restore_weights(models: &Path) {
    std::fs::write(models.join("three-dof/baseline.safetensors"), weights()).unwrap();
}

async fn in_use(service: &Service) -> String {
    let structure = service.read("/v1/structures/three-dof").await;
    structure["model"]["digest"].as_str().unwrap().to_owned()
}

/// Clients that post one batch after the other; each must be answered 201.
struct Load {
    stop: Arc<AtomicBool>,
    posted: Arc<Mutex<Vec<Value>>>,
    clients: Vec<tokio::task::JoinHandle<()>>,
}

impl Load {
    fn begin(service: &Service) -> Self {
        let (stop, next) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicUsize::new(0)));
        let posted = Arc::new(Mutex::new(Vec::new()));
        let client = |_| {
            let url = format!("http://{}/v1/structures/three-dof/batches", service.address());
            let http = service.client.clone();
            let (stop, next, posted) = (Arc::clone(&stop), Arc::clone(&next), Arc::clone(&posted));
            tokio::spawn(async move {
                while !stop.load(Ordering::Relaxed) {
                    let number = next.fetch_add(1, Ordering::Relaxed);
                    let body =
                        json!({ "measurements": measurements([4.0, 5.0, 6.0], 4, 86_400 * 10 + number * 4_000) });
                    let response = http.post(&url).json(&body).send().await.unwrap();
                    let status = response.status();
                    let answer: Value = response.json().await.unwrap();
                    assert_eq!(status, 201, "{answer}");
                    posted.lock().unwrap().push(answer);
                }
            })
        };
        let clients = (0..4).map(client).collect();
        Self { stop, posted, clients }
    }

    /// The answers.
    async fn end(self) -> Vec<Value> {
        self.stop.store(true, Ordering::Relaxed);
        for client in self.clients {
            client.await.unwrap();
        }
        std::mem::take(&mut *self.posted.lock().unwrap())
    }
}

const RELOAD: &str = "/v1/structures/three-dof/model/reload";

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn good_and_bad_models_are_swapped_in_under_load_without_a_failed_post() {
    let models = models();
    let folder = tempfile::tempdir().unwrap();
    let service = Service::spawn(command(folder.path()).arg("--models").arg(models.path()));
    with_past(&service, 4).await;
    let first = in_use(&service).await;

    let load = Load::begin(&service);
    // Each of four clients may have begun its post before the last switch; the fifth answer comes from the current model.
    let more_posts = async || {
        let enough = load.posted.lock().unwrap().len() + 5;
        eventually("more posts", async || (load.posted.lock().unwrap().len() >= enough).then_some(())).await;
    };
    more_posts().await;

    // The same weights with another manifest: a valid model with another digest.
    let mut other = manifest(models.path());
    other["program_version"] = json!("0.0.1-other");
    put_manifest(models.path(), &other);
    let swapped: Value = service.post(RELOAD, &json!({})).await.json().await.unwrap();
    assert_eq!((&swapped["changed"], &swapped["previous_model_digest"]), (&json!(true), &json!(first)), "{swapped}");
    let second = swapped["model_digest"].as_str().unwrap().to_owned();
    assert_ne!(first, second);
    assert_eq!(swapped["undamaged_version"], 2, "{swapped}");
    assert_eq!(in_use(&service).await, second);
    more_posts().await;

    // Each of these is refused with its reason, and the valid model remains in use.
    let refused = async |reason: &str| {
        let body = problem(service.post(RELOAD, &json!({})).await, 409, "model_refused").await;
        let detail = body["detail"].as_str().unwrap();
        assert!(detail.contains(reason) && detail.contains(&second), "{reason}: {detail}");
        assert_eq!(in_use(&service).await, second);
        let ready = service.read("/readyz").await;
        let codes: Vec<&Value> = ready["findings"].as_array().unwrap().iter().map(|f| &f["code"]).collect();
        assert!(ready["ready"] == true && codes.contains(&&json!("model_reload_refused")), "{ready}");
        more_posts().await;
    };
    std::fs::write(models.path().join("three-dof/baseline.safetensors"), &weights()[..5_000]).unwrap();
    refused("SHA-256").await;
    put_weights(models.path(), &weights()[..5_000]);
    refused("safetensors").await;
    let mut nan = weights();
    let header = u64::from_le_bytes(nan[..8].try_into().unwrap()) as usize;
    for value in nan[8 + header..].chunks_exact_mut(4) {
        value.copy_from_slice(&f32::NAN.to_le_bytes());
    }
    put_weights(models.path(), &nan);
    refused("not finite").await;
    restore_weights(models.path());
    let mut deeper = manifest(models.path());
    let units = deeper["architecture"]["units"].as_u64().unwrap();
    deeper["architecture"]["units"] = json!(units + 1);
    put_manifest(models.path(), &deeper);
    refused("architecture.permutations").await;
    let mut wider = manifest(models.path());
    wider["architecture"]["width"] = json!(65);
    put_manifest(models.path(), &wider);
    refused("baseline.safetensors").await;
    let mut newer = manifest(models.path());
    newer["format"] = json!(99);
    put_manifest(models.path(), &newer);
    refused("format 99").await;
    let mut biased = manifest(models.path());
    biased["calibration"]["failures"] = json!(["coverage of k1 is 0.7 instead of 0.9"]);
    put_manifest(models.path(), &biased);
    refused("failed its calibration").await;
    std::fs::write(models.path().join("three-dof/structure.toml"), "id = 7").unwrap();
    refused("structure.toml").await;
    std::fs::copy(repository("models/three-dof/structure.toml"), models.path().join("three-dof/structure.toml"))
        .unwrap();
    std::fs::remove_file(models.path().join("three-dof/baseline.json")).unwrap();
    refused("manifest").await;

    // The first model again.
    std::fs::copy(repository("models/three-dof/baseline.json"), models.path().join("three-dof/baseline.json")).unwrap();
    let back: Value = service.post(RELOAD, &json!({})).await.json().await.unwrap();
    assert_eq!((&back["model_digest"], &back["changed"]), (&json!(first), &json!(true)), "{back}");
    let same: Value = service.post(RELOAD, &json!({})).await.json().await.unwrap();
    assert_eq!(same["changed"], false, "{same}");
    let ready = service.read("/readyz").await;
    assert_eq!(ready["findings"], json!([]), "{ready}");
    let posted = load.end().await;
    settled(&service).await;

    let known = BTreeSet::from([first.clone(), second.clone()]);
    let mut used = BTreeSet::new();
    for answer in &posted {
        let digest = answer["assessment"]["model_digest"].as_str().unwrap_or_else(|| panic!("{answer}")).to_owned();
        assert!(known.contains(&digest), "{answer}");
        used.insert(digest);
        // Whichever model answered the post, the current assessment is that of the model in use, compared with the reference that was
        // renewed with it.
        let path = format!("/v1/structures/three-dof/batches/{}", answer["batch"].as_str().unwrap());
        let now = service.read(&path).await;
        assert_eq!(now["assessment"]["model_digest"], json!(first), "{now}");
        assert_eq!(now["assessment"]["undamaged_version"], 3, "{now}");
    }
    assert_eq!(used, known, "{} batches were posted: not under both models", posted.len());
    let metrics = service.get("/metrics").send().await.unwrap().text().await.unwrap();
    assert!(!metrics.contains("status=\"5"), "a request was answered with a 5xx: {metrics}");
}

#[tokio::test]
async fn after_a_reload_an_alarm_is_listed_once_and_that_of_the_earlier_reference_on_request() {
    let models = models();
    let folder = tempfile::tempdir().unwrap();
    let service = Service::spawn(command(folder.path()).arg("--models").arg(models.path()));
    with_past(&service, 4).await;
    let alarms = "/v1/structures/three-dof/alarms";
    let damage = |page: Value| -> Vec<Value> {
        page["items"].as_array().unwrap().iter().filter(|alarm| alarm["kind"] == "damage").cloned().collect()
    };
    let before = damage(service.read(alarms).await);
    assert_eq!((before.len(), &before[0]["undamaged_version"]), (1, &json!(1)), "{before:?}");
    let mut other = manifest(models.path());
    other["program_version"] = json!("0.0.1-other");
    put_manifest(models.path(), &other);
    let swapped: Value = service.post(RELOAD, &json!({})).await.json().await.unwrap();
    assert_eq!(swapped["undamaged_version"], 2, "{swapped}");
    settled(&service).await;

    let now = damage(service.read(alarms).await);
    let facts =
        |alarm: &Value| ["state", "undamaged_version", "parameter", "opened_at"].map(|name| alarm[name].clone());
    let expected = [json!("open"), json!(2), before[0]["parameter"].clone(), before[0]["opened_at"].clone()];
    assert_eq!(now.iter().map(facts).collect::<Vec<_>>(), [expected], "{now:?}");
    assert_eq!(now[0]["continues"], before[0]["alarm"], "{now:?}");
    let all = damage(service.read(&format!("{alarms}?superseded=true")).await);
    let earlier: Vec<&Value> = all.iter().filter(|alarm| alarm["undamaged_version"] == 1).collect();
    assert_eq!((all.len(), earlier.len()), (2, 1), "{all:?}");
    assert_eq!((&earlier[0]["state"], &earlier[0]["superseded_by"]), (&json!("superseded"), &json!(2)), "{all:?}");
}

#[tokio::test]
async fn a_reload_may_leave_the_undamaged_reference_to_a_person() {
    let models = models();
    let folder = tempfile::tempdir().unwrap();
    let service = Service::spawn(command(folder.path()).arg("--models").arg(models.path()));
    with_past(&service, 4).await;
    let mut other = manifest(models.path());
    other["program_version"] = json!("0.0.1-other");
    put_manifest(models.path(), &other);
    let swapped: Value = service.post(RELOAD, &json!({ "retake_undamaged": false })).await.json().await.unwrap();
    assert_eq!(swapped["undamaged_version"], Value::Null, "{swapped}");
    assert!(swapped["next_step"].as_str().unwrap().contains("/reference"), "{swapped}");
    let batch = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 4, 86_400 * 30)).await;
    assert_eq!(batch["assessment"]["undamaged_version"], Value::Null, "{batch}");
    problem(service.post("/v1/structures/bridge/model/reload", &json!({})).await, 404, "unknown_structure").await;
    problem(service.post(RELOAD, &json!({ "from": "/tmp" })).await, 422, "invalid").await;
}
