//! A panic while a request is answered: the client receives an error, and the next request is answered.

use std::sync::Arc;
use std::time::Duration;

use metrics_exporter_prometheus::PrometheusBuilder;
use serde_json::{json, Value};
use tokio::net::TcpListener;
use utoipa_axum::router::OpenApiRouter;
use utoipa_axum::routes;

use super::access::AccessControl;
use super::{batches, guarded, server, HttpSettings, Service};
use crate::access::AccessSettings;
use crate::alarm::severity::SeverityLimits;
use crate::baseline::library::Library;
use crate::fault::Faults;
use crate::monitor::{Monitor, MonitorSettings};
use crate::notify::{Notifier, NotifySettings};
use crate::store::Store;

#[tokio::test]
async fn a_panic_is_a_500_with_the_requests_id_and_the_next_request_is_served() {
    let folder = tempfile::tempdir().unwrap();
    let faults = Faults::arm();
    let store = Store::open(folder.path()).await.unwrap();
    let monitor = Monitor::open(store.clone(), Library::open(None).unwrap(), MonitorSettings::default()).await.unwrap();
    let settings = HttpSettings { drain_s: 1, ..HttpSettings::default() };
    let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}/v1/structures/three-dof/batches", listener.local_addr().unwrap());
    let place = (listener.local_addr().unwrap(), folder.path());
    let access = AccessControl::open(store.clone(), &AccessSettings::default(), &settings, place, 100).await.unwrap();
    let notifier = Notifier::new(store, NotifySettings::default(), SeverityLimits::default(), Arc::default()).unwrap();
    let metrics = PrometheusBuilder::new().build_recorder().handle();
    // Only the routes that it needs: the whole API would be compiled a second time for this test.
    let (batches, _) =
        OpenApiRouter::new().routes(routes!(batches::create)).routes(routes!(batches::read)).split_for_parts();
    let routes = guarded(batches, Service { monitor, notifier, access, metrics }, &settings);
    let (stop, stopped) = tokio::sync::oneshot::channel::<()>();
    let running = tokio::spawn(async move {
        let duty = tokio::sync::watch::channel(server::Duty::Serving(routes)).1;
        server::run(listener, duty, &settings, async { drop(stopped.await) }).await;
    });
    let client = crate::notify::client_builder().timeout(Duration::from_secs(20)).build().unwrap();
    let row = |second: u32| {
        let time = format!("2026-01-01T00:00:{second:02}Z");
        json!({ "measurements": [{ "measured_at": time, "frequencies_hz": [0.49, 0.67, 0.92] }] })
    };
    let first: Value = client.post(&url).json(&row(0)).send().await.unwrap().json().await.unwrap();
    let path = format!("{url}/{}", first["batch"].as_str().unwrap());

    // The panic occurs in the handler itself, and then in the task that writes.
    for (point, second) in [("store::read", None), ("store::commit", Some(1))] {
        let ask = |id: &'static str| match second {
            Some(second) => client.post(&url).json(&row(second)).header("x-request-id", id).send(),
            None => client.get(&path).header("x-request-id", id).send(),
        };
        faults.set(point, "1*panic");
        let response = ask("first").await.unwrap();
        assert_eq!((response.status().as_u16(), &response.headers()["x-request-id"]), (500, &"first".parse().unwrap()));
        let problem: Value = response.json().await.unwrap();
        assert_eq!((&problem["code"], &problem["request_id"]), (&json!("internal"), &json!("first")), "{problem}");
        assert!(!problem.to_string().contains("fault"), "the client learns nothing internal: {problem}");
        let response = ask("second").await.unwrap();
        assert!(response.status().is_success(), "{point}: {}", response.text().await.unwrap());
    }
    stop.send(()).unwrap();
    running.await.unwrap();
}
