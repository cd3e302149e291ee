//! Configuration, clock, limits, ports, and the service that may be running.

use std::time::Duration;

use reqwest::Method;
use rustix::process::{getrlimit, Resource};
use serde_json::Value;

use super::super::remote::{PlaceArgs, Service};
use super::Check;
use crate::config::Config;
use crate::quantity::Timestamp;
use crate::telemetry;

/// This program was written after this time: a clock before it is wrong.
const WRITTEN_AFTER: &str = "2026-01-01T00:00:00Z";
/// The clock may lie this much behind the newest batch, µs.
const SKEW_MICROS: i64 = 5 * 60 * 1_000_000;
/// Files beside those of the connections: database, log, standard streams, models while they load.
const OTHER_FILES: usize = 64;
/// Longest wait for the service.
const PATIENCE: Duration = Duration::from_secs(8);

/// The configuration was read; the level of the log is a filter that only its parser knows.
pub fn configuration(config: &Config) -> Check {
    match telemetry::filter(&config.log.level) {
        Ok(_) => Check::ok("configuration", "every key and value is known"),
        Err(error) => Check::fail("configuration", error, "set log.level to info"),
    }
}

/// The clock against the program's age and the newest batch.
pub fn clock(newest: Option<Timestamp>) -> Check {
    let now = Timestamp::now();
    let written = Timestamp::parse(WRITTEN_AFTER).expect("the constant is a time");
    let next = "set the clock and keep it by NTP: batches are judged by their time";
    if now < written {
        return Check::fail("clock", format!("it says {now}, before this program was written"), next);
    }
    match newest {
        Some(newest) if newest.micros() - now.micros() > SKEW_MICROS => {
            Check::fail("clock", format!("it says {now}, but a batch arrived at {newest}: it went back"), next)
        }
        _ => Check::ok("clock", now.to_string()),
    }
}

/// Files that this process may open, against the connections that it is set to take.
pub fn open_files(config: &Config) -> Check {
    let soft = getrlimit(Resource::Nofile).current.and_then(|files| usize::try_from(files).ok());
    let needed = config.http.max_connections + OTHER_FILES;
    match soft {
        Some(soft) if soft < needed => {
            let next = format!("raise it (ulimit -n, LimitNOFILE) to {needed}, or lower http.max_connections");
            Check::warn("open files", format!("{soft} are allowed, {needed} may be needed"), next)
        }
        Some(soft) => Check::ok("open files", format!("{soft} are allowed")),
        None => Check::ok("open files", "no limit is known here"),
    }
}

/// The port when no service runs, else what the service says of itself.
pub async fn service(place: &PlaceArgs, config: &Config, in_use: bool) -> Vec<Check> {
    let listen = &config.http.listen;
    if !in_use && place.url.is_none() {
        return vec![match tokio::net::TcpListener::bind(listen).await {
            Ok(_) => Check::ok("port", format!("{listen} is free")),
            Err(error) => {
                let next = "stop what listens there, or choose another with --listen";
                Check::fail("port", format!("{listen} cannot be listened on: {error}"), next)
            }
        }];
    }
    let service = match place.service(config) {
        Ok(service) => service,
        Err(error) => return vec![Check::fail("service", error.to_string(), "give --url")],
    };
    ask(&service).await
}

async fn ask(service: &Service) -> Vec<Check> {
    let url = service.url();
    let answer = service.request(Method::GET, "/readyz").timeout(PATIENCE).send().await;
    let body: Result<Value, _> = match answer {
        Ok(response) => response.json().await,
        Err(error) => Err(error),
    };
    let body = match body {
        Ok(body) if body["ready"].is_boolean() => body,
        Ok(_) => return vec![Check::fail("service", format!("{url} is another program"), "give the service's --url")],
        Err(error) => {
            let next = "give the service's --url; if it is that one, its log says why it does not answer";
            return vec![Check::fail("service", format!("{url} does not answer: {error}"), next)];
        }
    };
    let mut checks = Vec::new();
    let listed = |key: &str| {
        let items = body[key].as_array().cloned().unwrap_or_default();
        items
            .iter()
            .map(|item| {
                format!("{}: {}", item["code"].as_str().unwrap_or("?"), item["message"].as_str().unwrap_or("?"))
            })
            .collect::<Vec<_>>()
    };
    checks.push(if body["ready"] == true {
        Check::ok("service", format!("{url} is ready"))
    } else {
        Check::fail(
            "service",
            format!("{url} is not ready: {}", listed("reasons").join("; ")),
            "its log has the causes",
        )
    });
    for finding in listed("findings") {
        checks.push(Check::warn("service", finding, "see README, Operations"));
    }
    checks
}
