//! Valid measurements with little information: they have findings and move no alarm chart.

use serde_json::{json, Value};

use crate::faults::kit::{batch, body, BATCHES};
use crate::helpers::{command, created, problem, repository, spawn, Service};

/// Findings of an answer: code and effect.
fn findings(answer: &Value) -> Vec<(String, String)> {
    let text = |finding: &Value, key: &str| finding[key].as_str().unwrap_or_default().to_owned();
    let items = answer["assessment"]["findings"].as_array().unwrap().iter();
    items.map(|finding| (text(finding, "code"), text(finding, "effect"))).collect()
}

fn has(answer: &Value, code: &str, effect: &str) -> bool {
    findings(answer).contains(&(code.to_owned(), effect.to_owned()))
}

async fn posted(service: &Service, body: &Value) -> Value {
    created(service.post(BATCHES, body).await).await
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn repeated_values_count_once_and_rounding_that_the_scatter_hides_is_noise() {
    let (service, _folder) = spawn();
    // A gateway sends the second half again with new times.
    let mut repeated = body(&batch("gateway", 0, 20));
    for row in 10..20 {
        repeated["measurements"][row]["frequencies_hz"] = repeated["measurements"][row - 10]["frequencies_hz"].clone();
    }
    let answer = posted(&service, &repeated).await;
    assert!(has(&answer, "stale_repeat", "note"), "{answer}");
    assert_eq!((&answer["assessment"]["measurements_used"], &answer["state"]), (&json!(10), &json!("assessed")));

    // The frequencies are rounded to two digits, and scatter over several steps.
    let mut rounded = body(&batch("display", 1, 20));
    for row in rounded["measurements"].as_array_mut().unwrap() {
        for f in row["frequencies_hz"].as_array_mut().unwrap() {
            *f = json!((f.as_f64().unwrap() * 100.0).round() / 100.0);
        }
    }
    let answer = posted(&service, &rounded).await;
    assert!(has(&answer, "quantised", "note"), "{answer}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_posterior_at_the_edge_of_its_prior_says_so() {
    let (service, _folder) = spawn();
    let simulator = modalwatch::baseline::library::find_structure("three-dof").unwrap();
    let row = |i: i32| {
        let k1 = 3.01 + 0.002 * f64::from(i % 5);
        let f = simulator.frequencies_hz(&[k1, 5.0 + 0.03 * f64::from(i), 6.0 - 0.02 * f64::from(i)]).unwrap();
        json!({ "measured_at": format!("2026-01-01T00:00:{i:02}Z"), "frequencies_hz": f })
    };
    let rows: Vec<Value> = (0..12).map(row).collect();
    let answer = posted(&service, &json!({ "measurements": rows })).await;
    assert!(has(&answer, "prior_edge", "note"), "{answer}");
    let share = answer["assessment"]["parameters"][0]["edge_mass"].as_f64().unwrap();
    assert!(share > 0.05 && share <= 1.0, "{answer}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_missing_covariate_that_the_simulation_needs_is_refused_if_so_configured() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = command(folder.path());
    let service = Service::spawn(command.env("MODALWATCH__MONITOR__MISSING_COVARIATE", "refuse"));
    let text = std::fs::read_to_string(repository("tests/fuzz/seeds/structure_toml/effect")).unwrap();
    let put = service.request(reqwest::Method::PUT, "/v1/structures/small").header("content-type", "application/toml");
    assert_eq!(put.body(text).send().await.unwrap().status(), 201);
    let row = |covariates: Value| {
        let row =
            json!({ "measured_at": "2026-01-01T00:00:00Z", "frequencies_hz": [0.3, 0.9], "covariates": covariates });
        json!({ "measurements": [row] })
    };
    let path = "/v1/structures/small/batches";
    let refused = problem(service.post(path, &row(json!({ "operator": "B" }))).await, 422, "invalid").await;
    assert_eq!(refused["errors"][0]["pointer"], "/measurements/0/covariates/temperature_c", "{refused}");
    created(service.post(path, &row(json!({ "temperature_c": 4.5 }))).await).await;
}
