//! A structure whose batches cannot be judged is not normal: it says so, and why, and an alarm says so after three batches.

use serde_json::{json, Value};

use crate::helpers::{created, eventually, measurements, spawn, Service};

const BATCHES: &str = "/v1/structures/three-dof/batches";
const HEALTHY: [f64; 3] = [4.0, 5.0, 6.0];
const DAY_S: usize = 86_400;

async fn item(service: &Service) -> Value {
    let all = service.read("/v1/overview").await;
    all["items"].as_array().unwrap().iter().find(|item| item["id"] == "three-dof").unwrap().clone()
}

/// The open alarms: their kinds.
async fn open_alarms(service: &Service) -> Vec<String> {
    let alarms = service.read("/v1/structures/three-dof/alarms?state=open").await;
    alarms["items"].as_array().unwrap().iter().map(|alarm| alarm["kind"].as_str().unwrap().to_owned()).collect()
}

async fn post(service: &Service, rows: &[Value]) -> Value {
    created(service.post(BATCHES, &json!({ "measurements": rows })).await).await
}

/// The gateway sends the last batch of the healthy structure again, with new times.
fn repeated(rows: &mut [Value]) {
    for (row, old) in rows.iter_mut().zip(measurements(HEALTHY, 20, 6 * DAY_S)) {
        row["frequencies_hz"] = old["frequencies_hz"].clone();
    }
}

/// What a broken chain of measurement makes of a batch of the damaged structure.
type Broken = fn(&mut [Value]);

/// The logger hangs: all rows are the first one, with times of their own.
fn hung(rows: &mut [Value]) {
    let first = rows[0]["frequencies_hz"].clone();
    for row in rows {
        row["frequencies_hz"] = first.clone();
    }
}

/// The table has two decimals, of frequencies below 1 Hz.
fn rounded(rows: &mut [Value]) {
    for f in rows.iter_mut().flat_map(|row| row["frequencies_hz"].as_array_mut().unwrap()) {
        *f = json!((f.as_f64().unwrap() * 100.0).round() / 100.0);
    }
}

/// All frequencies are given in rad/s.
fn in_radians(rows: &mut [Value]) {
    for f in rows.iter_mut().flat_map(|row| row["frequencies_hz"].as_array_mut().unwrap()) {
        *f = json!(f.as_f64().unwrap() * std::f64::consts::TAU);
    }
}

#[tokio::test]
async fn while_no_batch_moves_a_chart_a_structure_is_not_normal() {
    for (name, breaks) in
        [("hung", hung as Broken), ("rounded", rounded), ("in rad/s", in_radians), ("repeated", repeated)]
    {
        let (service, _folder) = spawn();
        let mut ids = Vec::new();
        for day in 0..6 {
            ids.push(post(&service, &measurements(HEALTHY, 20, day * DAY_S)).await["batch"].clone());
        }
        created(service.post("/v1/structures/three-dof/reference", &json!({ "batches": ids })).await).await;
        post(&service, &measurements(HEALTHY, 20, 6 * DAY_S)).await;
        assert_eq!(item(&service).await["state"], "normal", "{name}");
        // 10 % of k2 is lost while the chain of measurement is broken.
        for day in 7..10 {
            let mut rows = measurements([4.0, 4.5, 6.0], 20, day * DAY_S);
            breaks(&mut rows);
            post(&service, &rows).await;
            let said = item(&service).await["verdict"].as_str().unwrap().to_owned();
            assert!(day > 7 || said.contains("The latest batch is not judged"), "{name}: {said}");
            // A logger that hangs and a gateway that repeats itself are alarmed with the second batch.
            let second = day == 8 && ["hung", "repeated"].contains(&name);
            assert!(!second || open_alarms(&service).await == ["not_assessed"], "{name}: {said}");
        }
        let now = item(&service).await;
        assert!(["not_judged", "alarming"].contains(&now["state"].as_str().unwrap()), "{name}: {now}");
        let open = open_alarms(&service).await;
        assert_eq!(open.len(), 1, "{name}: {open:?}");
        assert!(["not_assessed", "simulation_does_not_fit"].contains(&open[0].as_str()), "{name}: {open:?}");
        if open[0] == "not_assessed" {
            let said = now["verdict"].as_str().unwrap();
            assert!(
                said.starts_with(
                    "Not judged: none of the newest batches moves a chart. The latest that was assessed: "
                ),
                "{said}"
            );
        }
        // Repaired: the loss is seen with the first batch, and nothing is said to be unjudged any more.
        post(&service, &measurements([4.0, 4.5, 6.0], 20, 10 * DAY_S)).await;
        eventually("the loss is alarmed", async || {
            let kinds = open_alarms(&service).await;
            (kinds.contains(&"damage".to_owned()) && !kinds.contains(&"not_assessed".to_owned())).then_some(())
        })
        .await;
        assert_eq!(item(&service).await["state"], "alarming", "{name}");
    }
}

#[tokio::test]
async fn a_table_that_comes_from_two_sources_counts_once() {
    let (service, _folder) = spawn();
    post(&service, &measurements(HEALTHY, 20, 0)).await;
    let rows = measurements(HEALTHY, 20, DAY_S);
    post(&service, &rows).await;
    // Of sources whose measurements have the same times, the first in the alphabet counts, whichever arrives first.
    let twice = json!({ "source": "second-logger", "measurements": rows });
    let answer = created(service.post(BATCHES, &twice).await).await;
    assert_eq!(answer["assessment"]["trust"], "rejected", "{answer}");
    assert!(answer.to_string().contains("repeat earlier ones to the last digit"), "{answer}");
    assert!(answer["next_step"].as_str().unwrap().ends_with("this one is rejected"), "{answer}");
    // A table that repeats the end of the earlier one counts from there on.
    let mut overlapping = measurements(HEALTHY, 20, 2 * DAY_S);
    for (row, old) in overlapping.iter_mut().zip(&rows[12..]) {
        row["frequencies_hz"] = old["frequencies_hz"].clone();
    }
    let answer = post(&service, &overlapping).await;
    assert_eq!(answer["assessment"]["measurements_used"], 12, "{answer}");
}

#[tokio::test]
async fn values_sent_twice_count_once_and_their_batch_is_judged() {
    let (service, _folder) = spawn();
    let mut ids = Vec::new();
    for day in 0..6 {
        ids.push(post(&service, &measurements(HEALTHY, 20, day * DAY_S)).await["batch"].clone());
    }
    created(service.post("/v1/structures/three-dof/reference", &json!({ "batches": ids })).await).await;
    let mut rows = measurements([4.0, 4.5, 6.0], 20, 7 * DAY_S);
    for row in (1..20).step_by(2) {
        rows[row]["frequencies_hz"] = rows[row - 1]["frequencies_hz"].clone();
    }
    let answer = post(&service, &rows).await;
    assert_eq!(answer["assessment"]["measurements_used"], 10, "{answer}");
    assert_eq!(open_alarms(&service).await, ["damage"], "{answer}");
}
