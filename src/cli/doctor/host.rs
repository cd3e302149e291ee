//! Checks of the configuration, the clock, the limits of the process, the port, and a running service.

use std::time::Duration;

use reqwest::Method;
use rustix::process::{getrlimit, Resource};
use serde_json::Value;

use super::super::remote::{LocationArgs, Service};
use super::check::Check;
use crate::clock;
use crate::config::Config;
use crate::quantity::Timestamp;
use crate::telemetry;

/// A clock before this time is wrong, because the program is newer.
const WRITTEN_AFTER: &str = "2026-01-01T00:00:00Z";
/// Maximum time by which the clock may be behind the newest batch, µs.
const SKEW_MICROS: i64 = 5 * 60 * 1_000_000;
/// Number of open files besides the connections: database, log, standard streams, models during loading.
const OTHER_FILES: usize = 64;
/// Maximum time to wait for the service.
const PATIENCE: Duration = Duration::from_secs(8);

/// The configuration has been read already; only the filter of the log level is parsed here.
pub fn configuration(config: &Config) -> Check {
    match telemetry::filter(&config.log.level) {
        Ok(_) => Check::ok("configuration", "all keys and values are valid"),
        Err(error) => Check::fail("configuration", error, "set log.level to info"),
    }
}

/// Compares the clock with the age of the program and the newest batch.
pub fn clock(newest: Option<Timestamp>) -> Check {
    let now = clock::now();
    let written = Timestamp::parse(WRITTEN_AFTER).expect("the constant is a time");
    let next = "set the clock and synchronise it by NTP: the times of batches are compared with it";
    if now < written {
        return Check::fail("clock", format!("it shows {now}, a time before this program was written"), next);
    }
    match newest {
        Some(newest) if newest.micros() - now.micros() > SKEW_MICROS => {
            Check::fail("clock", format!("it shows {now}, but a batch was received at {newest}: it was set back"), next)
        }
        _ => Check::ok("clock", now.to_string()),
    }
}

/// Compares the limit of open files with the configured number of connections.
pub fn open_files(config: &Config) -> Check {
    let soft = getrlimit(Resource::Nofile).current.and_then(|files| usize::try_from(files).ok());
    let needed = config.http.max_connections + OTHER_FILES;
    match soft {
        Some(soft) if soft < needed => {
            let next = format!("raise the limit (ulimit -n, LimitNOFILE) to {needed}, or lower http.max_connections");
            Check::warn("open files", format!("{soft} are allowed, {needed} may be needed"), next)
        }
        Some(soft) => Check::ok("open files", format!("{soft} are allowed")),
        None => Check::ok("open files", "there is no limit"),
    }
}

/// Whether the port is free if no service runs, otherwise the state that the service reports.
pub async fn service(location: &LocationArgs, config: &Config, in_use: bool) -> Vec<Check> {
    let listen = &config.http.listen;
    if !in_use && location.url.is_none() {
        return vec![match tokio::net::TcpListener::bind(listen).await {
            Ok(_) => Check::ok("port", format!("{listen} is free")),
            Err(error) => {
                let next = "stop the program that uses the port, or choose another port with --listen";
                Check::fail("port", format!("cannot listen on {listen}: {error}"), next)
            }
        }];
    }
    let service = match location.service(config) {
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
        Ok(_) => {
            return vec![Check::fail(
                "service",
                format!("another program answers at {url}"),
                "give the URL of the service with --url",
            )]
        }
        Err(error) => {
            let next = "give the URL of the service with --url; if the URL is right, see the log of the service";
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
            "see the log of the service",
        )
    });
    for finding in listed("findings") {
        checks.push(Check::warn("service", finding, "see docs/operations.md"));
    }
    checks
}
