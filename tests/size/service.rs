//! Batches with and without shapes, in the real program.

use serde_json::{json, Value};

use crate::helpers::{command, created, time, Service};
use crate::size::start::CHAIN;

const BATCHES: &str = "/v1/structures/chain/batches";

/// Measurements of the nominal chain, a minute apart; the noise is that of rounding.
fn measurements(count: usize, shapes: bool) -> Vec<Value> {
    let simulator = CHAIN.baseline.simulator();
    let set = simulator.training_set(count, 21).unwrap();
    let one = |row: usize| {
        let hz: Vec<f64> = set.frequencies_hz.row(row).iter().copied().collect();
        let mut measurement = json!({ "measured_at": time(60 * row), "frequencies_hz": hz });
        if shapes {
            let of_modes: Vec<Vec<f64>> =
                set.shapes[row].column_iter().map(|shape| shape.iter().map(|x| -2.5 * x).collect()).collect();
            measurement["mode_shapes"] = json!(of_modes);
        }
        measurement
    };
    (0..count).map(one).collect()
}

fn spawn() -> (Service, tempfile::TempDir) {
    let folder = tempfile::tempdir().unwrap();
    let models = folder.path().join("models/chain");
    std::fs::create_dir_all(&models).unwrap();
    std::fs::write(models.join("structure.json"), CHAIN.baseline.simulator().definition().canonical_json()).unwrap();
    std::fs::write(models.join("baseline.json"), &CHAIN.manifest_json).unwrap();
    std::fs::write(models.join("baseline.safetensors"), &CHAIN.weights).unwrap();
    let mut command = command(&folder.path().join("data"));
    command.arg("--models").arg(folder.path().join("models"));
    // A training of a few seconds does not always pass the calibration; this test is only about the handling of shapes.
    command.env("MODALWATCH__MONITOR__ACCEPT_UNCALIBRATED", format!("[\"{}\"]", CHAIN.baseline.digest()));
    (Service::spawn(&mut command), folder)
}

#[tokio::test]
async fn batches_with_shapes_and_without_are_assessed_and_kept() {
    let (service, _folder) = spawn();
    let with = measurements(6, true);
    let answer = service.post_batch("chain", &with).await;
    assert_eq!(answer["state"], "assessed", "{answer}");
    let kept =
        service.get("/v1/structures/chain/measurements?format=ndjson").send().await.unwrap().text().await.unwrap();
    let lines: Vec<Value> = kept.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert_eq!(lines.len(), 6, "{kept}");
    for (line, sent) in lines.iter().zip(&with) {
        assert_eq!(line["mode_shapes"], sent["mode_shapes"]);
    }
    let mut later = measurements(6, false);
    for (row, measurement) in later.iter_mut().enumerate() {
        measurement["measured_at"] = json!(time(86_400 + 60 * row));
    }
    let blind = service.post_batch("chain", &later).await;
    assert_eq!(blind["state"], "assessed", "{blind}");
}

#[tokio::test]
async fn mistakes_in_a_shape_are_reported_with_their_place() {
    let (service, _folder) = spawn();
    let right = measurements(1, true).remove(0);
    let points = right["mode_shapes"][0].as_array().unwrap().len();
    let cases: Vec<(Value, &str, &str)> = vec![
        (json!([[1.0, 2.0], null, null, null, null]), "/0", "2 numbers, expected 5: one for each of m2, m4, m6"),
        (json!([vec![0.0; points], null, null, null, null]), "/0", "all components are 0"),
        (json!([null, null]), "", "2 shapes, expected 5"),
    ];
    for (shapes, place, message) in cases {
        let mut measurement = right.clone();
        measurement["mode_shapes"] = shapes.clone();
        let refused = service.post(BATCHES, &json!({ "measurements": [measurement] })).await;
        assert_eq!(refused.status(), 422, "{shapes}");
        let body: Value = refused.json().await.unwrap();
        let text = body.to_string();
        assert!(text.contains(&format!("/measurements/0/mode_shapes{place}\"")) && text.contains(message), "{text}");
    }
    let answer = created(service.post(BATCHES, &json!({ "measurements": [right] })).await).await;
    assert_eq!(answer["state"], "assessed", "{answer}");
}

#[tokio::test]
async fn shapes_of_a_structure_without_instrumented_points_are_refused() {
    let (service, _folder) = spawn();
    let body = json!({ "measurements": [{ "measured_at": time(0), "frequencies_hz": [0.4949, 0.9250, 1.2434],
        "mode_shapes": [[1.0, 2.0], null, null] }] });
    let refused = service.post("/v1/structures/three-dof/batches", &body).await;
    assert_eq!(refused.status(), 422);
    let text = refused.text().await.unwrap();
    assert!(text.contains("this structure has no instrumented points"), "{text}");
}
