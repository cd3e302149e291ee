//! The program that is attacked, and who uses it besides the attacker.

use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use reqwest::{Client, Method, RequestBuilder};
use serde_json::{json, Value};
use tempfile::TempDir;

use crate::helpers::{created, program, Service};

/// Command line of a service in `data_dir` on this address, with those of the settings (`http.write_timeout_s`, value) that the program
/// knows.
pub fn command(data_dir: &Path, listen: &str, settings: &[(&str, &str)]) -> Command {
    let printed = Command::new(program()).args(["config", "print", "--default"]).output().unwrap();
    let defaults = String::from_utf8(printed.stdout).unwrap();
    let mut command = Command::new(program());
    command.args(["serve", "--listen", listen, "--data-dir"]).arg(data_dir).env("MODALWATCH__LOG__LEVEL", "warn");
    for (key, value) in settings {
        let name = key.rsplit('.').next().unwrap();
        if defaults.lines().any(|line| line.starts_with(&format!("{name} ="))) {
            command.env(format!("MODALWATCH__{}", key.replace('.', "__").to_uppercase()), value);
        } else {
            println!("the program has no setting {key}");
        }
    }
    command
}

/// A service that requires tokens.
pub struct Target {
    pub service: Service,
    pub folder: TempDir,
    pub admin: String,
}

impl Target {
    pub fn start(settings: &[(&str, &str)]) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let arguments = ["token", "create", "--name", "first", "--scope", "admin", "--data-dir"];
        let made = Command::new(program()).args(arguments).arg(folder.path()).output().unwrap();
        assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
        let admin = String::from_utf8(made.stdout).unwrap().trim().to_owned();
        let service = Service::spawn(&mut command(folder.path(), "127.0.0.1:0", settings));
        Self { service, folder, admin }
    }

    /// A request with a connection of its own, which is given up after `patience`.
    pub fn ask(&self, method: Method, path: &str, token: Option<&str>, patience: Duration) -> RequestBuilder {
        let client: Client = modalwatch::notify::client_builder().timeout(patience).build().unwrap();
        let request = client.request(method, format!("http://{}{path}", self.service.address()));
        match token {
            Some(token) => request.bearer_auth(token),
            None => request,
        }
    }

    /// Status of a GET and the time that it took; an error is the reason why there is no answer.
    pub async fn get(&self, path: &str, token: Option<&str>, patience: Duration) -> Result<(u16, Duration), String> {
        let started = Instant::now();
        let response =
            self.ask(Method::GET, path, token, patience).send().await.map_err(|e| format!("{path}: {e:?}"))?;
        let status = response.status().as_u16();
        response.bytes().await.map_err(|e| format!("{path}: {e:?}"))?;
        Ok((status, started.elapsed()))
    }

    /// A token with this scope, for these structures (none: all).
    pub async fn token(&self, scope: &str, structures: &[&str]) -> String {
        let mut body = json!({ "name": scope, "scopes": [scope] });
        if !structures.is_empty() {
            body["structures"] = json!(structures);
        }
        created(self.post("/v1/tokens", &self.admin, &body).await).await["token"].as_str().unwrap().to_owned()
    }

    pub async fn post(&self, path: &str, token: &str, body: &Value) -> reqwest::Response {
        self.ask(Method::POST, path, Some(token), Duration::from_mins(1)).json(body).send().await.unwrap()
    }

    /// Posts a batch of three-dof that must be accepted; returns its id.
    pub async fn batch(&self, token: &str, measurements: &[Value]) -> String {
        let body = json!({ "measurements": measurements });
        let stored = created(self.post("/v1/structures/three-dof/batches", token, &body).await).await;
        assert_eq!(stored["state"], "assessed", "{stored}");
        stored["batch"].as_str().unwrap().to_owned()
    }
}

/// The public part of a token.
pub fn id_of(token: &str) -> &str {
    token.split('_').nth(1).unwrap()
}

/// Largest memory that the process has had so far, MiB.
pub fn peak_mib(pid: u32) -> f64 {
    let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap();
    let line = status.lines().find(|line| line.starts_with("VmHWM:")).unwrap();
    line.split_whitespace().nth(1).unwrap().parse::<f64>().unwrap() / 1024.0
}
