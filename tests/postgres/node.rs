//! A service as a node of a database: on a port that is known before it serves, whether it serves or stands by.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use reqwest::{Client, Method, RequestBuilder, Response};
use serde_json::Value;

use crate::helpers::{eventually, exit_within};

/// A node with its own process, which is ended when this value is dropped.
pub struct Node {
    child: Child,
    pub url: String,
    pub client: Client,
}

impl Node {
    /// Starts a node that takes over from a silent one after some seconds.
    pub fn start(folder: &Path, database: &str, takeover_s: &str) -> Self {
        Self::with(folder, database, &[("STORE__TAKEOVER_S", takeover_s)])
    }

    /// Starts a node with settings, named as in the environment without the prefix.
    pub fn with(folder: &Path, database: &str, settings: &[(&str, &str)]) -> Self {
        Self::listening("127.0.0.1", folder, database, settings)
    }

    /// As [`Self::with`], on another address of this machine.
    pub fn listening(address: &str, folder: &Path, database: &str, settings: &[(&str, &str)]) -> Self {
        let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        Self::at((address, port), folder, database, settings)
    }

    /// As [`Self::with`], at a port that was chosen before.
    pub fn at((address, port): (&str, u16), folder: &Path, database: &str, settings: &[(&str, &str)]) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_modalwatch"));
        command.args(["serve", "--listen", &format!("{address}:{port}"), "--data-dir"]).arg(folder);
        command.env("MODALWATCH__STORE__URL", database).env("MODALWATCH__STORE__STANDBY", "true");
        command.env("MODALWATCH__LOG__LEVEL", "warn");
        for (name, value) in settings {
            command.env(format!("MODALWATCH__{name}"), value);
        }
        let child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        let client = modalwatch::notify::client_builder().timeout(Duration::from_secs(30)).build().unwrap();
        Self { child, url: format!("http://127.0.0.1:{port}"), client }
    }

    /// Id of the process.
    pub fn pid(&self) -> u32 {
        self.child.id()
    }

    pub fn port(&self) -> u16 {
        self.url.rsplit_once(':').unwrap().1.parse().unwrap()
    }

    pub fn request(&self, method: Method, path: &str) -> RequestBuilder {
        self.client.request(method, format!("{}{path}", self.url))
    }

    pub async fn get(&self, path: &str) -> Response {
        self.request(Method::GET, path).send().await.unwrap()
    }

    pub async fn post(&self, path: &str, body: &Value) -> Response {
        self.request(Method::POST, path).json(body).send().await.unwrap()
    }

    /// Status of an answer; 0 if there is none.
    pub async fn status(&self, path: &str) -> u16 {
        self.request(Method::GET, path).send().await.map_or(0, |response| response.status().as_u16())
    }

    pub async fn read(&self, path: &str) -> Value {
        self.get(path).await.json().await.unwrap()
    }

    /// What `/readyz` answers; null if there is no answer.
    pub async fn readiness(&self) -> Value {
        let Ok(response) = self.request(Method::GET, "/readyz").send().await else { return Value::Null };
        response.json().await.unwrap_or_default()
    }

    /// Whether it is ready in this role: `serving` or `standby`.
    pub async fn is(&self, role: &str) -> bool {
        let readiness = self.readiness().await;
        readiness["ready"] == true && readiness["role"] == role
    }

    /// Waits until it is ready in this role.
    pub async fn becomes(&self, role: &str) {
        eventually(&format!("it is {role}"), async || self.is(role).await.then_some(())).await;
    }

    /// The value of a metric with its labels.
    pub async fn metric(&self, name: &str) -> Option<f64> {
        let text = self.get("/metrics").await.text().await.unwrap();
        let line = text.lines().find(|line| line.starts_with(&format!("{name} ")))?;
        line.rsplit_once(' ').unwrap().1.parse().ok()
    }

    pub fn signal(&self, signal: &str) {
        assert!(Command::new("kill")
            .args([&format!("-{signal}"), &self.pid().to_string()])
            .status()
            .unwrap()
            .success());
    }

    /// `kill -9`.
    pub fn kill(&mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }

    /// Whether its process has ended by itself.
    pub fn has_ended(&mut self) -> bool {
        exit_within(&mut self.child, Duration::ZERO).is_some()
    }
}

impl Drop for Node {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Index of the node that serves.
pub async fn serving(nodes: &[Node]) -> usize {
    eventually("one serves", async || {
        for (i, node) in nodes.iter().enumerate() {
            if node.is("serving").await {
                return Some(i);
            }
        }
        None
    })
    .await
}
