//! What is shown while a history is assessed again.

use std::collections::BTreeSet;

use serde_json::{json, Value};

use crate::helpers::{command, created, measurements, Service};

const STRUCTURE: &str = "/v1/structures/three-dof";

/// Number of batches, and of those that are the undamaged reference.
const BATCHES: usize = 24;
const UNDAMAGED: usize = 5;

/// Somebody who looks at the plots must not see a history of which one half is compared with the reference and the other is not, without being
/// told: what waits for its assessment is not part of the series, and says in the history that it waits.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_series_that_is_read_during_a_replay_has_only_batches_that_are_assessed_again() {
    let folder = tempfile::tempdir().unwrap();
    let service = Service::spawn(
        command(folder.path())
            .env("MODALWATCH__HTTP__RATE_LIMIT__REQUESTS_PER_S", "0")
            // So many that the replay takes seconds.
            .env("MODALWATCH__MONITOR__DRAWS_FOR_POPULATION", "2048"),
    );
    let mut undamaged = Vec::new();
    for number in 0..BATCHES {
        let batch = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 60, 100_000 * number)).await;
        undamaged.push(batch["batch"].clone());
    }
    undamaged.truncate(UNDAMAGED);
    created(service.post(&format!("{STRUCTURE}/reference"), &json!({ "batches": undamaged })).await).await;
    let undamaged: BTreeSet<&str> = undamaged.iter().map(|batch| batch.as_str().unwrap()).collect();
    let mut incomplete = BTreeSet::new();
    loop {
        let history = service.read(&format!("{STRUCTURE}/history?limit=100")).await;
        let series = service.read(&format!("{STRUCTURE}/series")).await;
        let items: Vec<&Value> = history["items"].as_array().unwrap().iter().collect();
        assert_eq!(items.len(), BATCHES);
        let mut waiting = 0;
        for item in items.iter().filter(|item| !undamaged.contains(item["batch"].as_str().unwrap())) {
            // A page reads the states before the assessments, so that a batch that waits may have its new assessment already.
            if item["state"] == "received" {
                waiting += 1;
            } else {
                assert_eq!(item["assessment"]["undamaged_version"], 1, "{item}");
            }
        }
        for parameter in series["parameters"].as_array().unwrap() {
            let batches = parameter["batches"].as_array().unwrap();
            for (batch, probability) in batches.iter().zip(parameter["probability_of_damage"].as_array().unwrap()) {
                let batch = batch.as_str().unwrap();
                // The batches of the reference are not compared with themselves.
                assert!(undamaged.contains(batch) || probability.is_number(), "{batch}: {parameter}");
            }
            // Read later than the history, the series may have more.
            assert!(batches.len() >= BATCHES - waiting, "{} of {BATCHES}, {waiting} wait", batches.len());
        }
        if waiting == 0 {
            break;
        }
        incomplete.insert(waiting);
    }
    assert!(incomplete.len() >= 3, "the replay was over too soon to be seen: {incomplete:?}");
}
