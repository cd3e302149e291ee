//! The program on the server: its command line, and what a structure of it looks like from outside.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Command, Output};

use reqwest::Method;
use serde_json::{json, Value};

use crate::helpers::{command, Service};
use crate::postgres::server::Server;

/// The program with arguments; its output.
pub fn modalwatch(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_modalwatch")).args(arguments).output().unwrap()
}

/// What a command that must fail says.
pub fn refused(arguments: &[&str]) -> String {
    let output = modalwatch(arguments);
    assert!(!output.status.success(), "{arguments:?} should have failed");
    String::from_utf8(output.stderr).unwrap()
}

/// What a command that must succeed prints.
pub fn done(arguments: &[&str]) -> String {
    let output = modalwatch(arguments);
    assert!(output.status.success(), "{arguments:?}: {}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

/// URL of a new database with the tables of the program, whose name is that of a folder.
pub fn database_with_tables(server: &Server, folder: &Path) -> String {
    let url = server.database_of(folder);
    done(&["migrate", "schema", "--url", &url]);
    url
}

/// Command line of a service on a database.
pub fn serve(folder: &Path, url: &str) -> Command {
    let mut command = command(folder);
    command.env("MODALWATCH__STORE__URL", url);
    command
}

/// What a service answers to all reading requests of a structure, by path.
pub async fn answers(service: &Service, structure: &str) -> BTreeMap<String, Value> {
    let mut paths: Vec<String> =
        ["/v1/structures", "/v1/overview", "/v1/tokens", "/v1/webhooks", "/v1/quarantine", "/v1/retention"]
            .map(str::to_owned)
            .to_vec();
    let of_structure = [
        "",
        "/alarms",
        "/alarms?superseded=true",
        "/charts",
        "/diagnoses",
        "/exceedances",
        "/history?limit=1000",
        "/history?limit=7&parameter=k2",
        "/history?format=csv",
        "/maintenance",
        "/measurements?limit=1000",
        "/notes",
        "/references",
        "/series",
        "/trainings",
    ];
    paths.extend(of_structure.map(|path| format!("/v1/structures/{structure}{path}")));
    let mut answers = BTreeMap::new();
    for path in paths {
        answers.insert(path.clone(), answer(service, Method::GET, &path, None).await);
    }
    let batches: Vec<String> = answers[&format!("/v1/structures/{structure}/history?limit=1000")]["body"]["items"]
        .as_array()
        .unwrap()
        .iter()
        .map(|item| item["batch"].as_str().unwrap().to_owned())
        .collect();
    for batch in batches {
        let path = format!("/v1/structures/{structure}/batches/{batch}");
        answers.insert(path.clone(), answer(service, Method::GET, &path, None).await);
    }
    answers
}

/// Status and body of an answer. A member `idempotency_key` of the body is sent as the header that it is over HTTP.
pub async fn answer(service: &Service, method: Method, path: &str, body: Option<&Value>) -> Value {
    let mut request = service.request(method, path);
    if let Some(mut body) = body.cloned() {
        if let Some(Value::String(key)) = body.as_object_mut().and_then(|body| body.remove("idempotency_key")) {
            request = request.header("idempotency-key", key);
        }
        request = request.json(&body);
    }
    let response = request.send().await.unwrap();
    let status = response.status().as_u16();
    let text = response.text().await.unwrap();
    json!({ "status": status, "body": serde_json::from_str::<Value>(&text).unwrap_or(Value::String(text)) })
}

/// Number of batches that wait for their assessment.
pub async fn pending(service: &Service) -> f64 {
    let text = service.get("/metrics").send().await.unwrap().text().await.unwrap();
    let line = text.lines().find(|line| line.starts_with("modalwatch_pending_batches ")).unwrap().to_owned();
    line.rsplit_once(' ').unwrap().1.parse().unwrap()
}
