//! Extreme but valid batches: no answer contains a number that is not finite.

use proptest::prelude::*;
use proptest::test_runner::{Config, TestRunner};
use serde_json::{json, Value};

use crate::helpers::{created, measurements, spawn, time};

/// Frequency and standard deviation of one mode, Hz.
type Mode = (Option<f64>, Option<f64>);

/// One mode: missing, far from the structure but within the limits, or near it; with or without its standard deviation.
fn mode(nominal: f64) -> impl Strategy<Value = Mode> {
    let frequency = prop_oneof![
        1 => Just(None),
        2 => (0.02..50.0_f64).prop_map(move |factor| Some(nominal * factor)),
        6 => (0.9..1.1_f64).prop_map(move |factor| Some(nominal * factor)),
        1 => Just(Some(nominal)),
    ];
    let std = prop_oneof![Just(None), (-12.0..3.0_f64).prop_map(|power| Some(10.0_f64.powf(power)))];
    (frequency, std)
}

fn measurement() -> impl Strategy<Value = [Mode; 3]> {
    let one = (mode(0.49), mode(0.92), mode(1.24)).prop_map(|(a, b, c)| [a, b, c]);
    one.prop_filter("a measurement has a mode", |m| m.iter().any(|(f, _)| f.is_some()))
}

fn batch() -> impl Strategy<Value = Vec<[Mode; 3]>> {
    prop_oneof![
        prop::collection::vec(measurement(), 1..12),
        // Repeated identical values.
        (measurement(), 1..12_usize).prop_map(|(one, count)| vec![one; count]),
    ]
}

/// Every probability and fraction lies in [0, 1], and every estimate is finite.
fn check(answer: &Value) -> Result<(), TestCaseError> {
    let assessment = &answer["assessment"];
    for p in assessment["parameters"].as_array().into_iter().flatten() {
        for key in ["mean", "edge_mass"] {
            prop_assert!(p[key].is_f64() || p[key].is_i64(), "{key}: {p}");
        }
        for interval in ["mean_interval", "std_interval", "probability_of_damage_interval"] {
            let bounds = p[interval].as_array().into_iter().flatten();
            prop_assert!({ bounds }.all(|x| x.as_f64().is_some_and(f64::is_finite)), "{interval}: {p}");
        }
        let pod = [&p["probability_of_damage"], &p["pooled"]["probability_of_damage"]];
        prop_assert!(pod.iter().all(|x| x.is_null() || (0.0..=1.0).contains(&x.as_f64().unwrap())), "{p}");
        prop_assert!(assessment["trust"] == "accepted" || pod[0].is_null(), "{assessment}");
    }
    Ok(())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn no_answer_contains_a_number_that_is_not_finite() {
    let (service, _folder) = spawn();
    let healthy = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 20, 0)).await;
    created(service.post("/v1/structures/three-dof/reference", &json!({ "batches": [healthy["batch"]] })).await).await;
    let (service, runtime) = (&service, tokio::runtime::Handle::current());
    tokio::task::block_in_place(move || {
        let mut runner = TestRunner::new_with_rng(
            Config { cases: 60, failure_persistence: None, ..Config::default() },
            proptest::test_runner::TestRng::deterministic_rng(proptest::test_runner::RngAlgorithm::ChaCha),
        );
        let start = std::cell::Cell::new(1_000_000_usize);
        let result = runner.run(&batch(), |rows| {
            start.set(start.get() + 20_000);
            let row = |(i, modes): (usize, &[Mode; 3])| {
                let (f, s): (Vec<_>, Vec<_>) = modes.iter().copied().unzip();
                json!({ "measured_at": time(start.get() + 600 * i), "frequencies_hz": f, "std_hz": s })
            };
            let rows: Vec<Value> = rows.iter().enumerate().map(row).collect();
            let body = json!({ "measurements": rows });
            let (status, answer) = runtime.block_on(async {
                let response = service.post("/v1/structures/three-dof/batches", &body).await;
                (response.status().as_u16(), response.json::<Value>().await.unwrap())
            });
            // Values outside the range of the structure are refused, never answered with meaningless results.
            prop_assert!(status == 201 || status == 422, "{status}: {answer}");
            check(&answer)
        });
        result.unwrap();
    });
}
