//! Traces: the real program, built with the feature `otel`, and a collector that reads its spans.

#![allow(clippy::unwrap_used, reason = "a test fails by panicking, in its helpers too")]

#[allow(dead_code, reason = "shared with the tests of the API, which use all of it")]
#[path = "../api/helpers.rs"]
mod helpers;

use std::path::Path;
use std::process::Stdio;
use std::sync::{Arc, Mutex};

use axum::body::Bytes;
use axum::extract::State;
use axum::http::StatusCode;
use axum::routing::post;
use axum::Router;
use helpers::{command, measurements, Service};
use serde_json::json;
use tokio::net::TcpListener;

const BATCHES: &str = "/v1/structures/three-dof/batches";
const TRACE: &str = "0af7651916cd43dd8448eb211c80319c";
const CALLER: &str = "b7ad6b7169203331";

/// The fields of a protobuf message: number, and bytes where it has a length.
fn fields(mut bytes: &[u8]) -> Vec<(u64, &[u8])> {
    fn varint(bytes: &mut &[u8]) -> u64 {
        let mut value = 0;
        for shift in (0..64).step_by(7) {
            let byte = bytes[0];
            *bytes = &bytes[1..];
            value |= u64::from(byte & 0x7f) << shift;
            if byte < 0x80 {
                break;
            }
        }
        value
    }
    let mut found = Vec::new();
    while !bytes.is_empty() {
        let key = varint(&mut bytes);
        let length = match key & 7 {
            0 => {
                varint(&mut bytes);
                0
            }
            1 => 8,
            2 => varint(&mut bytes) as usize,
            5 => 4,
            wire => panic!("wire type {wire}"),
        };
        found.push((key >> 3, &bytes[..length]));
        bytes = &bytes[length..];
    }
    found
}

fn all(bytes: &[u8], number: u64) -> Vec<&[u8]> {
    fields(bytes).into_iter().filter(|(found, _)| *found == number).map(|(_, value)| value).collect()
}

/// A span as defined in opentelemetry/proto/trace/v1/trace.proto.
#[derive(Debug, Clone)]
struct Span {
    trace: String,
    id: String,
    parent: String,
    name: String,
}

fn spans(export: &[u8]) -> Vec<Span> {
    let hex = |bytes: Vec<&[u8]>| data_encoding::HEXLOWER.encode(&bytes.concat());
    let of_resources = all(export, 1).into_iter().flat_map(|resource| all(resource, 2));
    let found = of_resources.flat_map(|scope| all(scope, 2)).map(|span| Span {
        trace: hex(all(span, 1)),
        id: hex(all(span, 2)),
        parent: hex(all(span, 4)),
        name: String::from_utf8(all(span, 5).concat()).unwrap(),
    });
    found.collect()
}

/// A collector: its address and the spans that it received, with the names of their resources.
async fn collector() -> (String, Arc<Mutex<Vec<Bytes>>>) {
    let exports: Arc<Mutex<Vec<Bytes>>> = Arc::default();
    let take = |State(exports): State<Arc<Mutex<Vec<Bytes>>>>, body: Bytes| async move {
        exports.lock().unwrap().push(body);
        StatusCode::OK
    };
    let router = Router::new().route("/v1/traces", post(take)).with_state(Arc::clone(&exports));
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}", listener.local_addr().unwrap());
    tokio::spawn(async move { axum::serve(listener, router).await });
    (url, exports)
}

fn start(folder: &Path, variables: &[(&str, &str)]) -> Service {
    Service::spawn(command(folder).envs(variables.iter().copied()))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_spans_of_a_batch_are_in_the_trace_of_its_sender_and_are_sent_before_the_end() {
    // The standard variable, and the program's own setting, which takes precedence.
    for ours in [false, true] {
        let (url, exports) = collector().await;
        let folder = tempfile::tempdir().unwrap();
        // Spans are sent only when the service stops.
        let mut variables = vec![("OTEL_BSP_SCHEDULE_DELAY", "3600000")];
        let elsewhere = "http://127.0.0.1:9";
        if ours {
            variables.push(("MODALWATCH__LOG__OTLP_ENDPOINT", &url));
            variables.push(("OTEL_EXPORTER_OTLP_ENDPOINT", elsewhere));
        } else {
            variables.push(("OTEL_EXPORTER_OTLP_ENDPOINT", &url));
        }
        let mut service = start(folder.path(), &variables);
        let traceparent = format!("00-{TRACE}-{CALLER}-01");
        let body = json!({ "measurements": measurements([4.0, 5.0, 6.0], 3, 0) });
        let request = service.request(reqwest::Method::POST, BATCHES).header("traceparent", traceparent).json(&body);
        assert_eq!(request.send().await.unwrap().status(), 201);
        // A request with an invalid header gets a new trace.
        let other = service.get("/healthz").header("traceparent", "00-xyz").send().await.unwrap();
        assert_eq!(other.status(), 200);
        assert!(exports.lock().unwrap().is_empty());
        assert_eq!(service.stop("TERM").code(), Some(0));

        let exports = exports.lock().unwrap().clone();
        assert!(exports.iter().any(|export| String::from_utf8_lossy(export).contains("modalwatch")));
        let found: Vec<Span> = exports.iter().flat_map(|export| spans(export)).collect();
        let request = found.iter().find(|s| s.name == "POST /v1/structures/{id}/batches").expect("the request's span");
        assert_eq!((request.trace.as_str(), request.parent.as_str()), (TRACE, CALLER));
        for part in ["assess", "store transaction"] {
            let parts: Vec<&Span> = found.iter().filter(|s| s.name == part && s.trace == TRACE).collect();
            assert!(!parts.is_empty() && parts.iter().all(|s| s.parent == request.id), "{part}: {found:?}");
        }
        let health = found.iter().find(|s| s.name == "GET /healthz").unwrap();
        assert!(health.trace != TRACE && health.parent.is_empty(), "{health:?}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_collector_that_is_away_or_never_answers_holds_up_nothing() {
    let silent = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let away = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    for address in [silent.local_addr().unwrap(), away] {
        let folder = tempfile::tempdir().unwrap();
        let url = format!("http://{address}");
        let few = [("OTEL_BSP_MAX_QUEUE_SIZE", "8"), ("OTEL_BSP_MAX_EXPORT_BATCH_SIZE", "4")];
        let mut service = start(folder.path(), &[few[0], few[1], ("OTEL_EXPORTER_OTLP_ENDPOINT", &url)]);
        // More spans than the queue holds.
        for i in 0..20 {
            service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 3, 4_000 * i)).await;
        }
        assert_eq!(service.read("/readyz").await["ready"], true);
        assert_eq!(service.stop("TERM").code(), Some(0));
    }
}

#[test]
fn an_invalid_address_is_refused_with_its_key() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = command(folder.path());
    command.env("MODALWATCH__LOG__OTLP_ENDPOINT", "localhost:4318").stdout(Stdio::null());
    let output = command.output().unwrap();
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(!output.status.success() && said.contains("log.otlp_endpoint"), "{said}");
}
