//! A service with a history, all its answers, and commands that run beside it.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Command, Output};

use serde_json::{json, Value};

use crate::helpers::{created, eventually, measurements, Service};

/// The program with its arguments.
pub fn program(arguments: &[&str]) -> Command {
    let mut command = Command::new(crate::helpers::program());
    command.args(arguments);
    command
}

/// Runs a command that must succeed; returns its output.
pub async fn run(arguments: &[&str]) -> String {
    let output = output(arguments).await;
    let (out, err) = (String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{arguments:?}: {out}{err}");
    out.into_owned()
}

/// Runs a command that must fail; returns its error message.
pub async fn fails(arguments: &[&str]) -> String {
    let output = output(arguments).await;
    let text = format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert_eq!(output.status.code(), Some(1), "{arguments:?} should fail: {text}");
    text
}

async fn output(arguments: &[&str]) -> Output {
    let mut command = program(arguments);
    // The service answers on the same runtime as the test's client.
    tokio::task::spawn_blocking(move || command.output().unwrap()).await.unwrap()
}

pub fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// A structure with an undamaged reference, `later` batches of which the last are damaged, an acknowledged alarm and a maintenance
/// window.
pub async fn with_past(service: &Service, later: usize) {
    let first = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 20, 0)).await;
    let second = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 20, 86_400)).await;
    let window = json!({ "from": "2026-01-10T00:00:00Z", "to": "2026-01-11T00:00:00Z", "reason": "new bearings" });
    created(service.post("/v1/structures/three-dof/maintenance", &window).await).await;
    let batches = json!({ "batches": [first["batch"], second["batch"]] });
    created(service.post("/v1/structures/three-dof/reference", &batches).await).await;
    for i in 0..later {
        let k2 = if i * 2 < later { 5.0 } else { 4.0 };
        service.post_batch("three-dof", &measurements([4.0, k2, 6.0], 10, 86_400 * (i + 2))).await;
    }
    settled(service).await;
    let open = service.read("/v1/structures/three-dof/alarms?state=open").await;
    let alarm = open["items"][0]["alarm"].as_i64().unwrap_or_else(|| panic!("no alarm: {open}"));
    let seen = json!({ "by": "Ida", "note": "on my way" });
    let path = format!("/v1/structures/three-dof/alarms/{alarm}/acknowledgement");
    assert!(service.post(&path, &seen).await.status().is_success());
    let alarm = format!("/v1/structures/three-dof/alarms/{alarm}");
    let comment = json!({ "text": "a crack\nat the bearing", "author": "Ida" });
    created(service.post(&format!("{alarm}/comments"), &comment).await).await;
    let closing = json!({ "reason": "other", "text": "test", "author": "Ida" });
    created(service.post(&format!("{alarm}/closing"), &closing).await).await;
    created(service.post(&format!("{alarm}/reopening"), &json!({ "author": "Ida" })).await).await;
    let note = json!({ "at": "2026-01-05T00:00:00Z", "text": "new road surface", "author": "Ida" });
    created(service.post("/v1/structures/three-dof/notes", &note).await).await;
}

/// Waits until no batch waits for its assessment.
pub async fn settled(service: &Service) {
    eventually("the assessment of all batches", async || {
        let page = service.read("/v1/structures/three-dof/history?limit=1000").await;
        page["items"].as_array().unwrap().iter().all(|item| item["state"] == "assessed").then_some(())
    })
    .await;
}

/// Everything that a service answers about `three-dof`, by path.
pub async fn answers(service: &Service) -> BTreeMap<String, Value> {
    let mut all = BTreeMap::new();
    let history = "/v1/structures/three-dof/history?limit=1000";
    let page = service.read(history).await;
    for item in page["items"].as_array().unwrap() {
        let path = format!("/v1/structures/three-dof/batches/{}", item["batch"].as_str().unwrap());
        let answer = service.read(&path).await;
        all.insert(path, answer);
    }
    all.insert(history.to_owned(), page);
    for path in ["", "/exceedances", "/alarms", "/charts?limit=1000", "/maintenance", "/notes", "/diagnoses"] {
        let path = format!("/v1/structures/three-dof{path}");
        let answer = service.read(&path).await;
        all.insert(path, answer);
    }
    let structures = service.read("/v1/structures").await;
    all.insert("/v1/structures".to_owned(), structures);
    all
}

/// Removes fields of this name at every depth.
pub fn without(value: &mut Value, fields: &[&str]) {
    match value {
        Value::Object(members) => {
            members.retain(|name, _| !fields.contains(&name.as_str()));
            members.values_mut().for_each(|member| without(member, fields));
        }
        Value::Array(items) => items.iter_mut().for_each(|item| without(item, fields)),
        _ => {}
    }
}
