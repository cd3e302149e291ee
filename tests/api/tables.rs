//! Times of a table that are numbers, and measurements that a diagnosis cannot use.

use serde_json::{json, Value};

use crate::helpers::{eventually, measurements, problem, spawn};

const BATCHES: &str = "/v1/structures/three-dof/batches";

#[tokio::test]
async fn numeric_times_of_a_table_need_their_unit() {
    let (service, _folder) = spawn();
    let csv = |times: [&str; 2]| {
        format!("measured_at;f1_hz;f2_hz;f3_hz\n{};0,41;0,74;0,93\n{};0,42;0,75;0,94\n", times[0], times[1])
    };
    // 2026-01-01T00:00:00Z and ten minutes later.
    let first = json!({ "measured_at": "2026-01-01T00:00:00Z", "frequencies_hz": [0.41, 0.74, 0.93] });
    let second = json!({ "measured_at": "2026-01-01T00:10:00Z", "frequencies_hz": [0.42, 0.75, 0.94] });
    let batch = service.post_batch("three-dof", &[first, second]).await["batch"].clone();
    for (unit, times) in [
        ("seconds", ["1767225600", "1767226200"]),
        ("milliseconds", ["1767225600000", "1767226200000"]),
        ("serial-days", ["46023", "46023,006944444445"]),
    ] {
        let answer = service.post_text(&format!("{BATCHES}?time_unit={unit}"), "text/csv", csv(times)).await;
        let replayed = answer.headers().contains_key("idempotency-replayed");
        let answer: Value = answer.json().await.unwrap();
        // Ten minutes in days, written with twelve digits, round to the same microsecond.
        assert!(replayed && answer["batch"] == batch, "{unit}: {answer}");
    }
    let numbers = csv(["1767225600", "1767226200"]);
    let refused = problem(service.post_text(BATCHES, "text/csv", numbers.clone()).await, 422, "invalid").await;
    assert_eq!(refused["errors"][0]["pointer"], "line 2, column measured_at", "{refused}");
    for (unit, words) in
        [("days", "do not say when they begin"), ("hours", "serial-days"), ("decimal-year", "outside the calendar")]
    {
        let path = format!("{BATCHES}?time_unit={unit}");
        let refused = problem(service.post_text(&path, "text/csv", numbers.clone()).await, 422, "invalid").await;
        assert!(refused["detail"].as_str().unwrap().contains(words), "{unit}: {refused}");
    }
}

#[tokio::test]
async fn a_diagnosis_leaves_out_measurements_with_equal_modes_and_says_so() {
    let (service, _folder) = spawn();
    let mut rows = measurements([4.0, 5.0, 6.0], 80, 0);
    for index in [7, 30] {
        rows[index]["frequencies_hz"][2] = rows[index]["frequencies_hz"][1].clone();
    }
    service.post_batch("three-dof", &rows).await;
    let asked = service.post("/v1/structures/three-dof/diagnoses", &json!({})).await;
    let id = asked.json::<Value>().await.unwrap()["diagnosis"].as_str().unwrap().to_owned();
    let diagnosis = eventually("the diagnosis", async || {
        Some(service.read(&format!("/v1/diagnoses/{id}")).await).filter(|answer| answer["state"] != "running")
    })
    .await;
    let result = &diagnosis["result"];
    let rows = result["training_rows"].as_u64().unwrap() + result["holdout_rows"].as_u64().unwrap();
    assert_eq!(rows, 78, "{diagnosis}");
    let note = result["notes"][0].as_str().unwrap();
    assert!(note.starts_with("2 of 80 measurements cannot be used") && note.contains("modes 2 and 3"), "{note}");
    assert!(note.contains("2026-01-01T01:10:00Z"), "{note}");
}
