//! Seasonal false alarms, their cause, the structure extended by it, and a real loss afterwards, all through HTTP.

use std::time::Duration;

use rand::SeedableRng as _;
use rand_distr::StandardNormal;
use serde_json::{json, Value};

use crate::api::world;
use crate::helpers::{command, created, eventually, spawn, train_model, within, Service};

/// Two springs of a chain are unknown; the simulation does not depend on temperature.
const STRUCTURE: &str = r#"
id = "soft"
modes = 3
measurement_noise = { relative = 0.002 }
mass = [{ name = "m1", kg = 1.0 }, { name = "m2", kg = 0.8 }, { name = "m3", kg = 1.2 }]
spring = [
    { name = "k1", from = "ground", to = "m1", n_per_m = 1000.0 },
    { name = "k2", from = "m1", to = "m2", n_per_m = 1400.0 },
    { name = "k3", from = "m2", to = "m3", n_per_m = 900.0 },
    { name = "k4", from = "ground", to = "m3", n_per_m = 700.0 },
]
parameter = [
    { name = "k1", prior = { uniform = [500.0, 1500.0] }, sets = { spring = "k1" } },
    { name = "k2", prior = { uniform = [700.0, 2100.0] }, sets = { spring = "k2" } },
]
covariate = [{ name = "temperature_c" }]
"#;

/// Relative change of k2 per °C.
const SOFTENING: f64 = -0.004;

const PER_BATCH: i64 = 10;

/// Air temperature of a day, °C: cold when the data begin.
fn temperature_c(day: f64) -> f64 {
    10.0 - 13.0 * (std::f64::consts::TAU * day / 365.0).cos()
}

/// A batch of one day; `k1_factor` is the remaining fraction of k1.
fn batch(day: f64, k1_factor: f64, rng: &mut impl rand::Rng) -> Vec<Value> {
    let mut one = |i: i64| {
        let mut normal = || rng.sample::<f64, _>(StandardNormal);
        let t = temperature_c(day) + 2.0 * normal();
        let k1 = 1000.0 * k1_factor * (1.0 + 0.006 * normal());
        let k2 = 1400.0 * (1.0 + SOFTENING * (t - 10.0)) * (1.0 + 0.006 * normal());
        let springs = [(None, 0, k1), (Some(0), 1, k2), (Some(1), 2, 900.0), (None, 2, 700.0)];
        let exact = world::frequencies_hz(&[1.0, 0.8, 1.2], &springs).unwrap();
        let f: Vec<f64> = exact.iter().map(|f| f * (1.0 + 0.002 * normal())).collect();
        let seconds = (day * 86_400.0) as i64 + 600 * i;
        json!({ "measured_at": world::rfc3339(world::EPOCH_2024_S + seconds), "frequencies_hz": f, "covariates": { "temperature_c": t } })
    };
    (0..PER_BATCH).map(&mut one).collect()
}

/// Waits until a state in the answer of a diagnosis is no longer "running".
async fn finished(service: &Service, id: &str, pointer: &str) -> Value {
    within(Duration::from_mins(10), pointer, async || {
        let answer = service.read(&format!("/v1/diagnoses/{id}")).await;
        match answer.pointer(pointer).and_then(Value::as_str) {
            Some("running") | None => None,
            Some("done") => Some(answer),
            Some(other) => panic!("{pointer} is {other}: {answer}"),
        }
    })
    .await
}

/// Damage alarms of a structure: (parameter, opened at).
async fn damage_alarms(service: &Service) -> Vec<(String, String)> {
    let alarms = service.read("/v1/structures/soft/alarms?limit=200").await;
    let items = alarms["items"].as_array().unwrap().iter();
    let damage = items.filter(|a| a["kind"] == "damage");
    damage
        .map(|a| (a["parameter"].as_str().unwrap_or_default().to_owned(), a["opened_at"].as_str().unwrap().to_owned()))
        .collect()
}

/// Waits until this number of batches is assessed under the present version.
async fn wait_until_assessed(service: &Service, batches: usize) {
    within(Duration::from_mins(2), "the assessment of all batches", async || {
        let history = service.read("/v1/structures/soft/history?limit=1000").await;
        let assessed = history["items"].as_array().unwrap().iter().filter(|i| i["state"] == "assessed").count();
        (assessed >= batches).then_some(())
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_seasons_false_alarms_end_with_the_extension_and_a_real_loss_is_found_after_it() {
    let folder = tempfile::tempdir().unwrap();
    let models = folder.path().join("models");
    train_model(&models.join("soft"), STRUCTURE, "0.5,2", 10_000, 20);

    let data = folder.path().join("data");
    let start = || Service::spawn(command(&data).arg("--models").arg(&models));
    let mut service = start();
    let mut rng = rand_chacha::ChaCha12Rng::seed_from_u64(7);
    let path = "/v1/structures/soft/batches";

    // A year without damage.
    let mut ids = Vec::new();
    for number in 0..122 {
        let day = 3.0 * f64::from(number);
        let answer = created(service.post(path, &json!({ "measurements": batch(day, 1.0, &mut rng) })).await).await;
        ids.push(answer["batch"].as_str().unwrap().to_owned());
    }
    // The undamaged reference: the first weeks of winter and two hot days, so that it covers all temperatures. A batch outside the
    // covered temperatures would raise no alarm. With 17 batches the influence of temperature is not learned by the charts themselves.
    let undamaged: Vec<&String> = ids[..15].iter().chain(&ids[60..62]).collect();
    created(service.post("/v1/structures/soft/reference", &json!({ "batches": undamaged })).await).await;
    wait_until_assessed(&service, ids.len()).await;
    let before = damage_alarms(&service).await;
    println!("damage alarms under the original model: {before:?}");
    assert!(!before.is_empty(), "the season should have raised false alarms");

    // The cause.
    let asked = service.post("/v1/structures/soft/diagnoses", &json!({})).await;
    assert_eq!(asked.status(), 202);
    let id = asked.json::<Value>().await.unwrap()["diagnosis"].as_str().unwrap().to_owned();
    let diagnosis = finished(&service, &id, "/state").await;
    println!("{}", diagnosis["result"]["summary"].as_str().unwrap());
    let cause = &diagnosis["result"]["causes"][0];
    assert_eq!(diagnosis["result"]["verdict"], "cause", "{diagnosis}");
    assert_eq!((&cause["target"]["name"], &cause["covariate"]), (&json!("k2"), &json!("temperature_c")));
    let page = service.get(&format!("/v1/diagnoses/{id}/report")).send().await.unwrap().text().await.unwrap();
    assert!(page.contains("<svg") && page.contains("k2"));

    // The rows held out are not in the reference: nothing says that they are undamaged. Of its own rows the reference says so.
    let gain = &diagnosis["result"]["gain"];
    assert_eq!(gain["undamaged_rows"], 0, "{gain}");
    assert!(diagnosis["result"]["summary"].as_str().unwrap().contains("is not known"), "{diagnosis}");
    let asked =
        service.post("/v1/structures/soft/diagnoses", &json!({ "batches": undamaged, "holdout": "last:0.2" })).await;
    let own = asked.json::<Value>().await.unwrap()["diagnosis"].as_str().unwrap().to_owned();
    let gain = finished(&service, &own, "/state").await["result"]["gain"].clone();
    assert_eq!((&gain["undamaged_rows"], &gain["holdout_rows"]), (&json!(34), &json!(34)), "{gain}");

    // The extension.
    let asked = service.post(&format!("/v1/diagnoses/{id}/extension"), &json!({})).await;
    assert_eq!(asked.status(), 202);
    let extended = finished(&service, &id, "/extension/state").await;
    println!("{}", extended["extension"]["result"]);
    // A second extension finds the structure changed.
    assert_eq!(service.post(&format!("/v1/diagnoses/{id}/extension"), &json!({})).await.status(), 409);
    wait_until_assessed(&service, ids.len()).await;
    let since = extended["extension"]["result"]["undamaged_version"].as_i64().unwrap();
    // The false alarms of the year are the history of the earlier model.
    let now = damage_alarms(&service).await;
    assert!(now.is_empty(), "alarms of the re-assessed year: {now:?}");
    let all = service.read("/v1/structures/soft/alarms?limit=200&superseded=true").await;
    let earlier: Vec<&Value> = all["items"].as_array().unwrap().iter().filter(|a| a["kind"] == "damage").collect();
    assert_eq!(earlier.len(), before.len(), "{all}");
    let is_history = |a: &&Value| {
        a["state"] == "superseded" && a["superseded_by"] == since && a["undamaged_version"].as_i64().unwrap() < since
    };
    assert!(earlier.iter().all(is_history), "{all}");

    // The next spring: 10 % of k1 is lost. The service was restarted in between.
    service.stop("TERM");
    let service = start();
    for number in 0..20 {
        let day = 366.0 + 3.0 * f64::from(number);
        let left = if number < 10 { 1.0 } else { 0.9 };
        let answer = created(service.post(path, &json!({ "measurements": batch(day, left, &mut rng) })).await).await;
        assert_eq!(answer["state"], "assessed", "{answer}");
    }
    let found: Vec<String> = damage_alarms(&service).await.into_iter().map(|(parameter, _)| parameter).collect();
    println!("alarms after the loss: {found:?}");
    assert!(found.contains(&"k1".to_owned()), "the loss of k1 was not alarmed");
    assert!(!found.contains(&"k2".to_owned()), "an alarm for k2, which has lost no stiffness");

    // A batch without a temperature is assessed over all temperatures, with a finding that says so.
    let mut blind = batch(430.0, 0.9, &mut rng);
    for m in &mut blind {
        m["covariates"] = json!({});
    }
    let answer = created(service.post(path, &json!({ "measurements": blind })).await).await;
    let findings = answer.to_string();
    assert!(findings.contains("covariate_missing"), "{findings}");

    // The extension is reverted.
    let back = service.request(reqwest::Method::DELETE, "/v1/structures/soft/extension").send().await.unwrap();
    assert_eq!(back.status(), 200);
    let structure = service.read("/v1/structures/soft").await;
    assert_eq!(structure["digest"], diagnosis["structure_digest"]);
    assert!(structure["definition"]["effect"].is_null());
}

#[tokio::test]
async fn diagnoses_that_cannot_be_made_say_why() {
    let (service, _folder) = spawn();
    let path = "/v1/structures/three-dof/diagnoses";
    let code = |response: reqwest::Response| async move {
        let status = response.status().as_u16();
        let body: Value = response.json().await.unwrap();
        (status, body["code"].as_str().unwrap_or_default().to_owned())
    };
    let unknown = service.get("/v1/diagnoses/none").send().await.unwrap();
    assert_eq!(code(unknown).await, (404, "unknown_diagnosis".to_owned()));
    let unknown = service.post("/v1/diagnoses/none/extension", &json!({})).await;
    assert_eq!(code(unknown).await, (404, "unknown_diagnosis".to_owned()));
    for holdout in ["last:1.5", "first:0.2", "where:lab"] {
        let answer = service.post(path, &json!({ "holdout": holdout })).await;
        assert_eq!(code(answer).await, (422, "invalid".to_owned()), "{holdout}");
    }
    let unknown = service.post(path, &json!({ "batches": ["none"] })).await;
    assert_eq!(code(unknown).await, (404, "unknown_batch".to_owned()));
    let unknown = service.post("/v1/structures/bridge/diagnoses", &json!({})).await;
    assert_eq!(code(unknown).await, (404, "unknown_structure".to_owned()));
    let wrong = service.post("/v1/diagnoses/none/extension", &json!({ "epochs": 0 })).await;
    assert_eq!(code(wrong).await, (422, "invalid".to_owned()));
    let back = service.request(reqwest::Method::DELETE, "/v1/structures/three-dof/extension").send().await.unwrap();
    assert_eq!(code(back).await, (409, "no_step_back".to_owned()));

    // With too few measurements the job ends and reports how many are needed.
    let asked: Value = service.post(path, &json!({})).await.json().await.unwrap();
    let id = asked["diagnosis"].as_str().unwrap();
    let answer = eventually("the end of the diagnosis", async || {
        Some(service.read(&format!("/v1/diagnoses/{id}")).await).filter(|answer| answer["state"] != "running")
    });
    let answer = answer.await;
    assert_eq!(answer["state"], "failed");
    assert!(answer["failure"].as_str().unwrap().contains("at least 8"), "{answer}");
    let none = service.get(&format!("/v1/diagnoses/{id}/report")).send().await.unwrap();
    assert_eq!(code(none).await, (409, "no_report".to_owned()));
    let none = service.post(&format!("/v1/diagnoses/{id}/extension"), &json!({})).await;
    assert_eq!(code(none).await, (409, "no_extension".to_owned()));
    let listed = service.read(path).await;
    assert_eq!(listed["items"][0]["state"], "failed");
}
