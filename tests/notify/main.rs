//! The real program with a receiver of webhooks and a real MQTT broker.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking, in its helpers too")]

mod broker;
mod filters;
#[allow(dead_code, reason = "shared with the tests of the API, which use all of it")]
#[path = "../api/helpers.rs"]
mod helpers;
mod hostile;
mod mail;
mod mail_server;
mod mqtt;
#[allow(dead_code, reason = "not every test binary needs every kind of thing")]
#[path = "../zz_skipped/needs.rs"]
mod needs;
mod receiver;
mod tls;
mod webhooks;

use helpers::{eventually, Service};

/// A value of `/metrics` by its name and labels as they are written there; 0 if it does not exist.
async fn metric(service: &Service, name: &str) -> f64 {
    let text = service.get("/metrics").send().await.unwrap().text().await.unwrap();
    let value = text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' ')?.parse().ok());
    value.unwrap_or(0.0)
}
