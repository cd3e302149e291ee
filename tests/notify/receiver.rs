//! A receiver of webhooks that records messages and answers as configured.

use std::net::SocketAddr;
use std::sync::{Arc, Mutex};
use std::time::Instant;

use axum::body::Bytes;
use axum::extract::State;
use axum::http::{HeaderMap, StatusCode, Uri};
use axum::response::{IntoResponse as _, Response};
use axum::serve::Listener;
use axum::Router;
use serde_json::Value;
use tokio::net::TcpListener;

use crate::helpers::eventually;

/// How a receiver answers.
#[derive(Debug, Clone)]
pub enum Answer {
    Status(u16),
    /// 500 to a body that contains this text, 200 to others.
    Refusing(String),
    RedirectTo(String),
    Never,
}

/// A received message.
#[derive(Debug, Clone)]
pub struct Received {
    pub at: Instant,
    pub path: String,
    pub headers: HeaderMap,
    pub body: Bytes,
    pub answered: u16,
}

#[derive(Clone)]
pub struct Receiver {
    pub address: SocketAddr,
    received: Arc<Mutex<Vec<Received>>>,
    answer: Arc<Mutex<Answer>>,
}

impl Received {
    pub fn json(&self) -> Value {
        serde_json::from_slice(&self.body).unwrap()
    }

    pub fn id(&self) -> &str {
        self.headers["webhook-id"].to_str().unwrap()
    }

    /// Such as `structures/three-dof/alarms/1`.
    pub fn subject(&self) -> String {
        self.json()["subject"].as_str().unwrap().to_owned()
    }

    pub fn kind(&self) -> String {
        self.json()["type"].as_str().unwrap().to_owned()
    }

    /// Whether the Standard Webhooks library accepts the signature under a secret.
    pub fn is_signed_with(&self, secret: &Value) -> bool {
        let webhook = standardwebhooks::Webhook::new(secret.as_str().unwrap()).unwrap();
        webhook.verify(&self.body, &self.headers).is_ok()
    }
}

impl Receiver {
    pub async fn start(answer: Answer) -> Self {
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let address = listener.local_addr().unwrap();
        Self::serve(listener, address, answer)
    }

    pub fn serve<L: Listener<Addr: std::fmt::Debug>>(listener: L, address: SocketAddr, answer: Answer) -> Self {
        let receiver = Self { address, received: Arc::default(), answer: Arc::new(Mutex::new(answer)) };
        let router = Router::new().fallback(take).with_state(receiver.clone());
        tokio::spawn(async move { axum::serve(listener, router).await });
        receiver
    }

    pub fn url(&self, path: &str) -> String {
        format!("http://{}{path}", self.address)
    }

    pub fn answer(&self, answer: Answer) {
        *self.answer.lock().unwrap() = answer;
    }

    pub fn all(&self) -> Vec<Received> {
        self.received.lock().unwrap().clone()
    }

    pub fn taken(&self) -> Vec<Received> {
        self.all().into_iter().filter(|r| r.answered == 200).collect()
    }

    /// Waits for this number of messages, and returns all messages received.
    pub async fn wait_for(&self, count: usize) -> Vec<Received> {
        eventually("messages", async || Some(self.all()).filter(|all| all.len() >= count)).await
    }
}

async fn take(State(receiver): State<Receiver>, uri: Uri, headers: HeaderMap, body: Bytes) -> Response {
    let answer = receiver.answer.lock().unwrap().clone();
    let answered = match &answer {
        Answer::Status(status) => *status,
        Answer::Refusing(text) if String::from_utf8_lossy(&body).contains(text) => 500,
        Answer::Refusing(_) => 200,
        Answer::RedirectTo(_) => 307,
        Answer::Never => 0,
    };
    let received = Received { at: Instant::now(), path: uri.path().to_owned(), headers, body, answered };
    receiver.received.lock().unwrap().push(received);
    match answer {
        Answer::Status(_) | Answer::Refusing(_) => StatusCode::from_u16(answered).unwrap().into_response(),
        Answer::RedirectTo(location) => (StatusCode::TEMPORARY_REDIRECT, [("location", location)]).into_response(),
        Answer::Never => std::future::pending().await,
    }
}
