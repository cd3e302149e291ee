//! Three nodes that a supervisor starts again, and clients that ask any of them until they are answered.

use std::collections::BTreeMap;
use std::net::TcpListener;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use reqwest::{Client, Method};
use serde_json::Value;
use tempfile::TempDir;

use crate::postgres::node::Node;
use crate::postgres::server::Server;
use crate::postgres::world::database_with_tables;

/// Settings of all nodes and of the service with the file.
pub const SETTINGS: [(&str, &str); 5] = [
    ("NOTIFY__ALLOW_PRIVATE_TARGETS", "[\"127.0.0.0/8\"]"),
    ("NOTIFY__FIRST_RETRY_S", "1"),
    ("NOTIFY__LONGEST_RETRY_S", "2"),
    ("STORE__TAKEOVER_S", "2"),
    ("DIAGNOSIS__AFTER_REJECTED_EPISODE", "false"),
];

/// The three nodes, which a supervisor starts again when they have ended.
pub struct Cluster {
    pub ports: [u16; 3],
    folders: [TempDir; 3],
    pub models: TempDir,
    pub database: String,
    pub admin_file: String,
    nodes: Vec<Node>,
    /// Until when a node hangs.
    hangs: [Option<Instant>; 3],
}

impl Cluster {
    pub fn start(server: &Server, models: TempDir, admin_file: String) -> Self {
        let folders = [(); 3].map(|()| tempfile::tempdir().unwrap());
        let database = database_with_tables(server, folders[0].path());
        let listeners = [(); 3].map(|()| TcpListener::bind("127.0.0.1:0").unwrap());
        let ports = listeners.each_ref().map(|listener| listener.local_addr().unwrap().port());
        drop(listeners);
        let mut cluster = Self { ports, folders, models, database, admin_file, nodes: Vec::new(), hangs: [None; 3] };
        for which in 0..3 {
            let node = cluster.node(which);
            cluster.nodes.push(node);
        }
        cluster
    }

    pub fn node(&self, which: usize) -> Node {
        let mut settings = SETTINGS.to_vec();
        settings.push(("ACCESS__ADMIN_TOKEN_FILE", &self.admin_file));
        settings.push(("MODELS_DIR", self.models.path().to_str().unwrap()));
        Node::at(("127.0.0.1", self.ports[which]), self.folders[which].path(), &self.database, &settings)
    }

    pub fn kill(&mut self, which: usize) {
        self.hangs[which] = None;
        self.nodes[which].kill();
        self.nodes[which] = self.node(which);
    }

    pub fn hang(&mut self, which: usize, time: Duration) {
        self.nodes[which].signal("STOP");
        self.hangs[which] = Some(Instant::now() + time);
    }

    /// Wakes nodes that have hung long enough, and starts those again that have ended because they were taken over from.
    pub fn supervise(&mut self) {
        for which in 0..3 {
            if self.hangs[which].is_some_and(|until| Instant::now() >= until) {
                self.hangs[which] = None;
                self.nodes[which].signal("CONT");
            }
            if self.nodes[which].has_ended() {
                self.hangs[which] = None;
                self.nodes[which] = self.node(which);
            }
        }
    }

    /// A node that stands by, or that serves, and does not hang; the first one if nobody serves at present.
    pub async fn some(&self, role: &str) -> usize {
        for (which, node) in self.nodes.iter().enumerate() {
            if self.hangs[which].is_none() && node.is(role).await {
                return which;
            }
        }
        0
    }
}

/// The clients' side: where the nodes are, and what they have answered.
#[derive(Clone)]
pub struct Clients {
    pub urls: [String; 3],
    pub client: Client,
    pub admin: String,
    pub over: Arc<AtomicBool>,
    pub refusals: Arc<AtomicUsize>,
    /// Answers that may not be.
    pub odd: Arc<Mutex<Vec<String>>>,
    pub statuses: Arc<Mutex<BTreeMap<String, usize>>>,
}

impl Clients {
    pub fn new(ports: [u16; 3], admin: String) -> Self {
        // A node that hangs is left after some seconds, as a gateway with several addresses would do.
        let client = modalwatch::notify::client_builder().timeout(Duration::from_secs(8)).build().unwrap();
        Self {
            urls: ports.map(|port| format!("http://127.0.0.1:{port}")),
            client,
            admin,
            over: Arc::default(),
            refusals: Arc::default(),
            odd: Arc::default(),
            statuses: Arc::default(),
        }
    }

    /// One request to one node: status and answer, or `None` if the connection broke or the node asks to come back.
    pub async fn ask(&self, node: usize, method: Method, path: &str, body: Option<&Value>) -> Option<(u16, Value)> {
        let request =
            self.client.request(method.clone(), format!("{}{path}", self.urls[node])).bearer_auth(&self.admin);
        let request = body.into_iter().fold(request, reqwest::RequestBuilder::json);
        let response = request.send().await.ok()?;
        let (status, retry) = (response.status().as_u16(), response.headers().contains_key("retry-after"));
        let text = response.text().await.ok()?;
        let answer: Value = serde_json::from_str(&text).unwrap_or(Value::Null);
        let code = answer["code"].as_str().unwrap_or_default();
        *self.statuses.lock().unwrap().entry(format!("{status} {code}")).or_default() += 1;
        match status {
            503 if retry => {
                self.refusals.fetch_add(1, Ordering::Relaxed);
                None
            }
            500.. => {
                self.odd.lock().unwrap().push(format!("{method} {path}: {status} {text}"));
                None
            }
            _ => Some((status, answer)),
        }
    }

    /// Repeats a request at one node after the other until it is answered.
    pub async fn insist(&self, first: usize, method: Method, path: &str, body: Option<&Value>) -> (u16, Value) {
        let begun = Instant::now();
        for attempt in first.. {
            if let Some(answered) = self.ask(attempt % 3, method.clone(), path, body).await {
                return answered;
            }
            assert!(begun.elapsed() < Duration::from_mins(2), "{method} {path}: nobody has answered for two minutes");
            if attempt % 3 == 2 {
                tokio::time::sleep(Duration::from_millis(100)).await;
            }
        }
        unreachable!()
    }

    /// Posts a batch until it is acknowledged; returns its id.
    pub async fn deliver(&self, first: usize, structure: &str, body: &Value) -> String {
        let (status, answer) = self.insist(first, Method::POST, &format!("{structure}/batches"), Some(body)).await;
        assert_eq!(status, 201, "{answer}");
        answer["batch"].as_str().unwrap().to_owned()
    }

    pub async fn read(&self, path: &str) -> Value {
        let (status, answer) = self.insist(0, Method::GET, path, None).await;
        assert_eq!(status, 200, "{path}: {answer}");
        answer
    }

    pub fn is_over(&self) -> bool {
        self.over.load(Ordering::Relaxed)
    }
}
