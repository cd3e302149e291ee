//! What people do with alarms over the API, and notes on the time line.

use serde_json::{json, Value};

use crate::helpers::{created, measurements, problem, spawn, time, Service};

const DAY_S: usize = 86_400;
const ALARM: &str = "/v1/structures/three-dof/alarms/1";

/// A structure with a loss of 12 % in k2, which raises alarm 1.
async fn alarmed(service: &Service) {
    let mut ids = Vec::new();
    for day in 0..3 {
        let batch = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 20, day * DAY_S)).await;
        ids.push(batch["batch"].clone());
    }
    created(service.post("/v1/structures/three-dof/reference", &json!({ "batches": ids })).await).await;
    for day in 9..12 {
        service.post_batch("three-dof", &measurements([4.0, 4.4, 6.0], 20, day * DAY_S)).await;
    }
}

async fn alarm(service: &Service) -> Value {
    let page = service.read("/v1/structures/three-dof/alarms").await;
    let items = page["items"].as_array().unwrap();
    items.iter().find(|item| item["alarm"] == 1).unwrap_or_else(|| panic!("no alarm: {page}")).clone()
}

async fn put(service: &Service, path: &str, body: &Value) -> reqwest::Response {
    service.request(reqwest::Method::PUT, path).json(body).send().await.unwrap()
}

#[tokio::test]
async fn an_alarm_has_a_severity_and_a_history_of_what_people_did() {
    let (service, _folder) = spawn();
    alarmed(&service).await;
    let fresh = alarm(&service).await;
    let severity = &fresh["severity"];
    let certain = severity["certain_loss_percent"].as_f64().unwrap();
    assert!(certain > 0.0 && certain < 12.5, "{fresh}");
    let grade = match certain {
        l if l >= 10.0 => "critical",
        l if l >= 5.0 => "severe",
        l if l >= 2.0 => "moderate",
        _ => "slight",
    };
    assert_eq!(severity["grade"], grade, "{fresh}");
    assert!(severity["sentence"].as_str().unwrap().contains("95 % certainty"), "{fresh}");
    assert_eq!((&fresh["actions"], &fresh["closing"], &fresh["assignee"]), (&json!([]), &Value::Null, &Value::Null));

    let post = async |path: &str, body: Value| service.post(&format!("{ALARM}/{path}"), &body).await;
    created(post("comments", json!({ "text": "crack at\nthe bearing", "author": "Ann" })).await).await;
    let assigned = put(&service, &format!("{ALARM}/assignee"), &json!({ "assignee": "Cid", "author": "Ann" })).await;
    let assigned = created(assigned).await;
    let seen = assigned["actions"].as_array().unwrap().last().unwrap()["action"].clone();
    let closing = json!({ "reason": "repaired", "text": "new bearing", "author": "Ben", "seen": seen });
    let closed = created(post("closing", closing).await).await;
    assert_eq!((&closed["closing"]["reason"], &closed["closing"]["author"]), (&json!("repaired"), &json!("Ben")));
    assert_eq!((&closed["state"], &closed["acknowledgement"]["by"]), (&fresh["state"], &json!("Ben")));
    problem(post("closing", json!({ "reason": "false_alarm", "author": "Ann" })).await, 409, "alarm_closed").await;
    let late = json!({ "assignee": null, "author": "Dot", "seen": seen });
    problem(put(&service, &format!("{ALARM}/assignee"), &late).await, 409, "alarm_changed").await;
    let reopened = created(post("reopening", json!({ "text": "it grows", "author": "Ann" })).await).await;
    assert_eq!(reopened["closing"], Value::Null);
    problem(post("reopening", json!({ "author": "Ann" })).await, 409, "alarm_not_closed").await;

    let found = alarm(&service).await;
    let kinds: Vec<&str> = found["actions"].as_array().unwrap().iter().map(|a| a["kind"].as_str().unwrap()).collect();
    assert_eq!(kinds, ["comment", "assignment", "closing", "reopening"]);
    assert!(found["actions"].as_array().unwrap().iter().all(|a| a["at"].is_string() && a["alarm"] == 1));
    let audit = service.read("/v1/audit?limit=100").await;
    let actions: Vec<&str> = audit["items"].as_array().unwrap().iter().filter_map(|e| e["action"].as_str()).collect();
    for action in
        ["POST /v1/structures/{id}/alarms/{alarm}/comments", "PUT /v1/structures/{id}/alarms/{alarm}/assignee"]
    {
        assert!(actions.contains(&action), "{action} is not in {actions:?}");
    }
    let report = service.get("/v1/structures/three-dof/report").send().await.unwrap().text().await.unwrap();
    for part in ["assigned to Cid", "closed (repaired): new bearing", "the bearing", "95 % certainty"] {
        assert!(report.contains(part), "{part} is not in the report");
    }
}

#[tokio::test]
async fn what_people_must_not_send_is_refused_with_its_place() {
    let (service, _folder) = spawn();
    alarmed(&service).await;
    for (path, body, pointer) in [
        ("comments", json!({ "text": "", "author": "Ann" }), "/text"),
        ("comments", json!({ "text": " \n", "author": "Ann" }), "/text"),
        ("comments", json!({ "text": "x".repeat(2_001), "author": "Ann" }), "/text"),
        ("comments", json!({ "text": "bell\u{7}", "author": "Ann" }), "/text"),
        ("comments", json!({ "text": "who?" }), "/author"),
        ("closing", json!({ "reason": "other", "author": "Ann" }), "/text"),
        ("closing", json!({ "reason": "tired", "author": "Ann" }), "/reason"),
        ("reopening", json!({ "author": "line\nbreak" }), "/author"),
    ] {
        let refused = problem(service.post(&format!("{ALARM}/{path}"), &body).await, 422, "invalid").await;
        assert_eq!(refused["errors"][0]["pointer"], pointer, "{body}: {refused}");
    }
    let path = "/v1/structures/three-dof/alarms/99/comments";
    let nobody = service.post(path, &json!({ "text": "x", "author": "Ann" })).await;
    problem(nobody, 404, "unknown_alarm").await;
    assert_eq!(alarm(&service).await["actions"], json!([]));
}

#[tokio::test]
async fn notes_mark_moments_and_periods_of_the_time_line() {
    let (service, _folder) = spawn();
    alarmed(&service).await;
    let path = "/v1/structures/three-dof/notes";
    let moment = json!({ "at": time(10 * DAY_S), "text": "truck <on> the bridge", "author": "Ann" });
    let moment = created(service.post(path, &moment).await).await;
    assert_eq!((&moment["to"], &moment["author"]), (&Value::Null, &json!("Ann")));
    let period = json!({ "from": time(2 * DAY_S), "to": time(3 * DAY_S), "text": "road works", "author": "Ben" });
    let period = created(service.post(path, &period).await).await;
    let listed = service.read(path).await;
    assert_eq!(listed["items"], json!([moment, period]));
    let series = service.read("/v1/structures/three-dof/series").await;
    assert_eq!(series["notes"], listed["items"]);
    let before = format!("/v1/structures/three-dof/series?from={}&to={}", time(0), time(5 * DAY_S));
    assert_eq!(service.read(&before).await["notes"], json!([period]));
    let report = service.get("/v1/structures/three-dof/report").send().await.unwrap().text().await.unwrap();
    assert!(report.contains("truck &lt;on&gt; the bridge") && report.contains("road works"), "{report}");

    for (body, pointer) in [
        (json!({ "text": "when?", "author": "Ann" }), "/at"),
        (json!({ "at": time(0), "from": time(0), "to": time(9), "text": "both", "author": "Ann" }), "/at"),
        (json!({ "from": time(9), "to": time(9), "text": "empty", "author": "Ann" }), "/to"),
        (json!({ "at": "yesterday", "text": "vague", "author": "Ann" }), "/at"),
    ] {
        let refused = problem(service.post(path, &body).await, 422, "invalid").await;
        assert_eq!(refused["errors"][0]["pointer"], pointer, "{body}: {refused}");
    }
    let one = format!("{path}/{}", moment["note"].as_str().unwrap());
    let delete = async || service.request(reqwest::Method::DELETE, &one).send().await.unwrap();
    assert_eq!(delete().await.status(), 204);
    problem(delete().await, 404, "unknown_note").await;
    assert_eq!(service.read(path).await["items"], json!([period]));
}

/// A gateway that states ten times the noise that its measurements have, and more than any model was trained for.
#[tokio::test]
async fn a_loss_is_found_although_the_stated_noise_is_far_too_large() {
    let (service, _folder) = spawn();
    let mut healthy = Vec::new();
    for day in 0..6 {
        let batch = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 20, day * 86_400)).await;
        healthy.push(batch["batch"].clone());
    }
    created(service.post("/v1/structures/three-dof/reference", &json!({ "batches": healthy })).await).await;
    for day in 6..9 {
        let mut damaged = measurements([3.2, 5.0, 6.0], 20, day * 86_400);
        for measurement in &mut damaged {
            let hz: Vec<f64> = serde_json::from_value(measurement["frequencies_hz"].clone()).unwrap();
            measurement["std_hz"] = json!(hz.iter().map(|f| 0.01 * f).collect::<Vec<f64>>());
        }
        let batch = service.post_batch("three-dof", &damaged).await;
        assert_eq!(batch["state"], "assessed", "{batch}");
        let findings = batch["assessment"]["findings"].as_array().unwrap();
        assert!(findings.iter().any(|finding| finding["code"] == "noise_above_range"), "{findings:?}");
        let k1 = &batch["assessment"]["parameters"][0];
        assert!(k1["probability_of_damage"].as_f64().unwrap() > 0.99, "{k1}");
    }
    let alarms = service.read("/v1/structures/three-dof/alarms").await;
    let of_k1 = |alarm: &Value| alarm["kind"] == "damage" && alarm.to_string().contains("k1");
    assert!(alarms["items"].as_array().unwrap().iter().any(of_k1), "{alarms}");
}
