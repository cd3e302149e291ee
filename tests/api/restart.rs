//! `kill -9` between and within posts: each 201 is in the history exactly once.

use std::collections::BTreeSet;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use rand::Rng as _;
use serde_json::json;

use crate::helpers::{eventually, measurements, Service};

const ROUNDS: usize = 6;
const CLIENTS: usize = 4;
/// Batches acknowledged before a kill.
const LEAST_IN_A_LIFE: usize = 4;

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_201_is_in_the_history_exactly_once_whenever_the_service_is_killed() {
    let folder = tempfile::tempdir().unwrap();
    let mut stream = modalwatch::stats::stream(20_260_301, "times of death");
    let acknowledged = Arc::new(Mutex::new(BTreeSet::new()));
    let next = Arc::new(AtomicUsize::new(0));
    for _ in 0..ROUNDS {
        let mut service = Service::start(folder.path());
        let url = format!("http://{}/v1/structures/three-dof/batches", service.address());
        let clients: Vec<_> = (0..CLIENTS)
            .map(|_| {
                let (url, client) = (url.clone(), service.client.clone());
                let (acknowledged, next) = (Arc::clone(&acknowledged), Arc::clone(&next));
                tokio::spawn(async move {
                    loop {
                        // Times never repeat, so every post is a new batch.
                        let number = next.fetch_add(1, Ordering::Relaxed);
                        let body = json!({ "measurements": measurements([4.0, 5.0, 6.0], 3, number * 2_000) });
                        let Ok(response) = client.post(&url).json(&body).send().await else { return };
                        if response.status() != 201 {
                            return;
                        }
                        // The status line is the acknowledgement, even if the connection breaks before the end of the
                        // body.
                        let Ok(answer) = response.json::<serde_json::Value>().await else { return };
                        let id = answer["batch"].as_str().unwrap().to_owned();
                        assert!(acknowledged.lock().unwrap().insert(id), "an id was assigned twice");
                    }
                })
            })
            .collect();
        // The first answers may take long on a busy machine; the kill comes at a random moment after some of them.
        let enough = acknowledged.lock().unwrap().len() + LEAST_IN_A_LIFE;
        eventually("answers", async || (acknowledged.lock().unwrap().len() >= enough).then_some(())).await;
        tokio::time::sleep(Duration::from_millis(stream.random_range(0..300))).await;
        service.kill();
        for client in clients {
            client.await.unwrap();
        }
    }

    let service = Service::start(folder.path());
    let (mut stored, mut path) = (Vec::new(), "/v1/structures/three-dof/history?limit=100".to_owned());
    loop {
        let page = service.read(&path).await;
        for item in page["items"].as_array().unwrap() {
            stored.push(item["batch"].as_str().unwrap().to_owned());
            assert_eq!(item["measurement_count"], 3);
        }
        let Some(cursor) = page["next"].as_str() else { break };
        path = format!("/v1/structures/three-dof/history?limit=100&cursor={cursor}");
    }
    let once: BTreeSet<String> = stored.iter().cloned().collect();
    assert_eq!(once.len(), stored.len(), "a batch is in the history twice");
    let acknowledged = std::mem::take(&mut *acknowledged.lock().unwrap());
    assert!(
        acknowledged.len() >= ROUNDS * LEAST_IN_A_LIFE,
        "only {} posts were acknowledged: the test shows little",
        acknowledged.len()
    );
    let lost: Vec<&String> = acknowledged.difference(&once).collect();
    assert!(lost.is_empty(), "{} of {} acknowledged batches are lost", lost.len(), acknowledged.len());
    println!("{} acknowledged, {} stored, {ROUNDS} times killed", acknowledged.len(), stored.len());

    // What was stored but not assessed when the service died is assessed after the restart.
    eventually("the assessment of all batches", async || {
        let pending = service.read("/v1/structures/three-dof/history?limit=1000").await;
        pending["items"].as_array().unwrap().iter().all(|item| item["state"] == "assessed").then_some(())
    })
    .await;
}
