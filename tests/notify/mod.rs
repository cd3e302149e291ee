//! The real program with a receiver of webhooks and a real MQTT broker.

mod broker;
mod filters;
mod hostile;
mod mail;
mod mail_server;
mod mqtt;
mod receiver;
mod tls;
mod webhooks;

use crate::helpers::{eventually, Service};

/// A value of `/metrics` by its name and labels as they are written there; 0 if it does not exist.
async fn metric(service: &Service, name: &str) -> f64 {
    let text = service.get("/metrics").send().await.unwrap().text().await.unwrap();
    let value = text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' ')?.parse().ok());
    value.unwrap_or(0.0)
}
