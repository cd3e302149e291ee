//! A service with tokens.

use std::path::Path;
use std::process::{Command, Output};

use reqwest::{Method, RequestBuilder, Response};
use serde_json::{json, Value};
use tempfile::TempDir;

use crate::helpers::{self, command, created, Service};

/// A service that requires tokens, and its first token.
pub struct World {
    pub service: Service,
    pub folder: TempDir,
    pub admin: String,
}

/// Runs `modalwatch` to its end.
pub fn program(arguments: &[&str], data_dir: &Path) -> Output {
    let mut command = Command::new(crate::helpers::program());
    command.args(arguments).arg("--data-dir").arg(data_dir).output().unwrap()
}

/// Creates a token on the command line, as the first token is created.
pub fn first_token(data_dir: &Path) -> String {
    let made = program(&["token", "create", "--name", "first", "--scope", "admin"], data_dir);
    let text = String::from_utf8(made.stdout).unwrap();
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
    text.trim().to_owned()
}

/// The public part of a token.
pub fn id_of(token: &str) -> &str {
    token.split('_').nth(1).unwrap()
}

impl World {
    pub fn start() -> Self {
        Self::with(|command| command)
    }

    /// A service with these settings.
    pub fn with(prepare: impl FnOnce(&mut Command) -> &mut Command) -> Self {
        let folder = tempfile::tempdir().unwrap();
        let admin = first_token(folder.path());
        let mut command = command(folder.path());
        let service = Service::spawn(prepare(&mut command));
        Self { service, folder, admin }
    }

    pub fn ask(&self, method: Method, path: &str, token: &str) -> RequestBuilder {
        self.service.request(method, path).bearer_auth(token)
    }

    pub async fn get(&self, path: &str, token: &str) -> Response {
        self.ask(Method::GET, path, token).send().await.unwrap()
    }

    pub async fn read(&self, path: &str, token: &str) -> Value {
        let response = self.get(path, token).await;
        assert!(response.status().is_success(), "GET {path}: {}", response.text().await.unwrap());
        response.json().await.unwrap()
    }

    pub async fn post(&self, path: &str, token: &str, body: &Value) -> Response {
        self.ask(Method::POST, path, token).json(body).send().await.unwrap()
    }

    /// A token with these scopes, for these structures (none: all).
    pub async fn token(&self, scopes: &[&str], structures: &[&str]) -> String {
        let name = format!("{} {}", scopes.join(" "), structures.join(" "));
        let mut body = json!({ "name": name, "scopes": scopes });
        if !structures.is_empty() {
            body["structures"] = json!(structures);
        }
        let made = created(self.post("/v1/tokens", &self.admin, &body).await).await;
        made["token"].as_str().unwrap().to_owned()
    }
}

/// Repeats a request until its answer has this status and code.
pub async fn eventually(world: &World, path: &str, token: &str, status: u16, code: &str) {
    helpers::eventually(&format!("an answer {status} of {path}"), async || {
        let response = world.get(path, token).await;
        if response.status() != status {
            return None;
        }
        let body: Value = response.json().await.unwrap();
        assert_eq!(body["code"], code, "{body}");
        Some(())
    })
    .await;
}
