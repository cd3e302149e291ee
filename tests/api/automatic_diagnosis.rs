//! Diagnoses that the service starts by itself after rejected batches. `tests/faults/clock.rs` has those on schedule.

use std::path::Path;
use std::time::Duration;

use serde_json::{json, Value};

use crate::helpers::{command, created, measurements, within, Service};

const DIAGNOSES: &str = "/v1/structures/three-dof/diagnoses";

/// Longer than two checks of the service, which come every five seconds.
const TWO_CHECKS: Duration = Duration::from_secs(11);

fn start(data: &Path, settings: &[(&str, &str)]) -> Service {
    let mut command = command(data);
    for (key, value) in settings {
        command.env(format!("MODALWATCH__DIAGNOSIS__{key}"), value);
    }
    Service::spawn(&mut command)
}

/// Posts a batch of ten measurements of a day; with `fits` false, the second mode is where the simulation cannot have it.
async fn post(service: &Service, day: usize, fits: bool) -> Value {
    let mut rows = measurements([4.0, 5.0, 6.0], 10, day * 86_400);
    for row in rows.iter_mut().filter(|_| !fits) {
        row["frequencies_hz"][1] = json!(0.8 * row["frequencies_hz"][1].as_f64().unwrap());
    }
    service.post_batch("three-dof", &rows).await
}

/// Six batches that fit, the first two of which are the undamaged reference, and three that are rejected: an alarm.
async fn rejected_episode(service: &Service) {
    let mut ids = Vec::new();
    for day in 0..6 {
        ids.push(post(service, day, true).await["batch"].clone());
    }
    created(service.post("/v1/structures/three-dof/reference", &json!({ "batches": ids[..2] })).await).await;
    for day in 6..9 {
        let answer = post(service, day, false).await;
        assert_eq!(answer["assessment"]["trust"], "rejected", "{answer}");
    }
    let alarms = service.read("/v1/structures/three-dof/alarms?state=open").await;
    assert_eq!(alarms["items"][0]["kind"], "simulation_does_not_fit", "{alarms}");
}

async fn diagnoses(service: &Service) -> Vec<Value> {
    service.read(DIAGNOSES).await["items"].as_array().unwrap().clone()
}

/// Waits for the end of the newest diagnosis.
async fn finished(service: &Service) -> Value {
    within(Duration::from_mins(3), "the end of a diagnosis", async || {
        let newest = diagnoses(service).await.into_iter().next()?;
        let answer = service.read(&format!("/v1/diagnoses/{}", newest["diagnosis"].as_str().unwrap())).await;
        (answer["state"] != "running").then_some(answer)
    })
    .await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn rejected_batches_start_one_diagnosis_by_themselves_and_a_restart_does_not_repeat_it() {
    let folder = tempfile::tempdir().unwrap();
    let settings = [("DELAY_S", "0")];
    let mut service = start(folder.path(), &settings);
    let mut events = service.get("/v1/events").send().await.unwrap();
    rejected_episode(&service).await;
    let diagnosis = finished(&service).await;
    assert_eq!(diagnosis["state"], "done", "{diagnosis}");
    assert_eq!((&diagnosis["trigger"], &diagnosis["alarm"]), (&json!("rejected_episode"), &json!(1)));
    let verdict = diagnosis["result"]["verdict"].as_str().expect("a verdict");
    println!("{verdict}: {}", diagnosis["result"]["summary"]);
    // The rejected batches are searched for causes and not held out.
    let rows = (&diagnosis["result"]["training_rows"], &diagnosis["result"]["holdout_rows"]);
    assert!(rows.0.as_u64().unwrap() >= 80 && *rows.1 == json!(0), "{rows:?}");
    let report = service.get(diagnosis["report"].as_str().unwrap()).send().await.unwrap();
    assert_eq!(report.status(), 200);

    // The alarm, the list of jobs and the audit log name it.
    let alarms = service.read("/v1/structures/three-dof/alarms").await;
    let id = &diagnosis["diagnosis"];
    let linked = json!({ "diagnosis": id, "state": "done", "verdict": verdict });
    assert_eq!(alarms["items"][0]["diagnosis"], linked, "{alarms}");
    let jobs = service.read("/v1/jobs").await;
    assert_eq!((&jobs["items"][0]["job"], &jobs["items"][0]["trigger"]), (id, &json!("rejected_episode")), "{jobs}");
    let audit = service.read("/v1/audit").await;
    let entries = audit["items"].as_array().unwrap();
    let entry = entries.iter().find(|e| e["action"] == "start diagnosis (rejected_episode)").expect("an audit entry");
    assert_eq!((&entry["structure"], &entry["status"]), (&json!("three-dof"), &json!(200)), "{entry}");

    let mut told = String::new();
    within(Duration::from_secs(20), "the end of the diagnosis among the events", async || {
        let end = r#""state":"done","progress":null,"trigger":"rejected_episode""#;
        told.push_str(&String::from_utf8_lossy(&events.chunk().await.unwrap()?));
        told.contains(end).then_some(())
    })
    .await;

    // A further rejected batch on the same day starts none, neither in this process nor in the next.
    post(&service, 9, false).await;
    tokio::time::sleep(TWO_CHECKS).await;
    assert_eq!(diagnoses(&service).await.len(), 1);
    service.kill();
    let service = start(folder.path(), &settings);
    tokio::time::sleep(TWO_CHECKS).await;
    let listed = diagnoses(&service).await;
    assert_eq!((listed.len(), &listed[0]["diagnosis"], &listed[0]["state"]), (1, id, &json!("done")), "{listed:?}");

    // A requested diagnosis is not limited.
    let asked: Value = service.post(DIAGNOSES, &json!({})).await.json().await.unwrap();
    assert_eq!((&asked["trigger"], &asked["alarm"]), (&json!("requested"), &Value::Null), "{asked}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn without_the_switch_rejected_batches_start_no_diagnosis() {
    let folder = tempfile::tempdir().unwrap();
    let service = start(folder.path(), &[("AFTER_REJECTED_EPISODE", "false"), ("DELAY_S", "0")]);
    rejected_episode(&service).await;
    tokio::time::sleep(TWO_CHECKS).await;
    assert_eq!(diagnoses(&service).await, Vec::<Value>::new());
    let alarms = service.read("/v1/structures/three-dof/alarms").await;
    assert_eq!(alarms["items"][0]["diagnosis"], Value::Null, "{alarms}");
}
