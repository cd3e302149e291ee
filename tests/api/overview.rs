//! The overview of all structures while batches arrive.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::Arc;

use serde_json::{json, Value};

use crate::helpers::{command, created, measurements, Service};

/// Clients that read the overview while batches arrive.
const READERS: usize = 4;

/// What the overview says about the structure.
async fn said(service: &Service) -> Value {
    let overview = service.read("/v1/overview").await;
    overview["items"].as_array().unwrap().iter().find(|item| item["id"] == "three-dof").unwrap().clone()
}

/// A verdict that is sent to somebody at night must not be made of two moments: the text of one batch beside the counts of the next.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_overview_read_while_batches_arrive_is_of_one_moment() {
    let folder = tempfile::tempdir().unwrap();
    let service = Service::spawn(command(folder.path()).env("MODALWATCH__HTTP__RATE_LIMIT__REQUESTS_PER_S", "0"));
    let first = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 50, 0)).await;
    created(service.post("/v1/structures/three-dof/reference", &json!({ "batches": [first["batch"]] })).await).await;
    let (service, stopped) = (Arc::new(service), Arc::new(AtomicBool::new(false)));
    let read = || {
        let (service, stopped) = (Arc::clone(&service), Arc::clone(&stopped));
        tokio::spawn(async move {
            let mut all = Vec::new();
            while !stopped.load(Ordering::Relaxed) {
                all.push(said(&service).await);
            }
            all
        })
    };
    let readers: Vec<_> = (0..READERS).map(|_| read()).collect();
    // The loss grows, so that each batch has a verdict of its own.
    let mut settled = BTreeMap::from([(1, said(&service).await)]);
    for number in 1..40 {
        let k2 = 5.0 - 0.02 * number as f64;
        service.post_batch("three-dof", &measurements([4.0, k2, 6.0], 20, 100_000 * number)).await;
        let item = said(&service).await;
        settled.insert(item["batches"].as_u64().unwrap(), item);
    }
    stopped.store(true, Ordering::Relaxed);
    let mut verdicts: Vec<&Value> = settled.values().map(|item| &item["verdict"]).collect();
    verdicts.dedup();
    assert!(verdicts.len() > 20, "{verdicts:?}");
    let mut compared = 0;
    for reader in readers {
        for item in reader.await.unwrap() {
            if item["waiting_batches"] == 0 {
                assert_eq!(item, settled[&item["batches"].as_u64().unwrap()]);
                compared += 1;
            }
        }
    }
    assert!(compared > 100, "{compared} answers");
}
