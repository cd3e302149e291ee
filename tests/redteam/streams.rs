//! Event streams of tokens that are no longer valid, and of one token that wants all of them.

use std::time::{Duration, Instant};

use reqwest::{Method, Response};
use serde_json::json;

use crate::helpers::{created, measurements, problem};
use crate::redteam::target::{id_of, Target};

/// Longest time that a stream may outlive its token.
const SOON: Duration = Duration::from_secs(3);

const PATIENCE: Duration = Duration::from_mins(1);

async fn stream(target: &Target, token: &str) -> Response {
    target.ask(Method::GET, "/v1/events", Some(token), PATIENCE).send().await.unwrap()
}

/// Waits for the end of a stream, which must be a regular one.
async fn ends(mut stream: Response, why: &str) {
    let started = Instant::now();
    let end = tokio::time::timeout(SOON, async { while stream.chunk().await.unwrap().is_some() {} }).await;
    assert!(end.is_ok(), "a stream goes on although {why}");
    println!("ended {:?} after {why}", started.elapsed());
}

#[tokio::test]
async fn a_stream_ends_with_the_secret_that_opened_it() {
    let target = Target::start(&[]);
    let reader = target.token("read", &[]).await;
    let rotation = format!("/v1/tokens/{}/rotation", id_of(&reader));

    // An overlap keeps the previous secret, and its stream, until it ends.
    let before = stream(&target, &reader).await;
    let rotated = target.post(&rotation, &target.admin, &json!({ "overlap_s": 2 })).await;
    assert!(rotated.status().is_success());
    let second: serde_json::Value = rotated.json().await.unwrap();
    let second = second["token"].as_str().unwrap().to_owned();
    let started = Instant::now();
    ends(before, "the overlap of its secret is over").await;
    assert!(started.elapsed() > Duration::from_millis(1_500), "it ended before its secret: {:?}", started.elapsed());

    let before = stream(&target, &second).await;
    let rotated = target.post(&rotation, &target.admin, &json!({ "overlap_s": 0 })).await;
    let third: serde_json::Value = rotated.json().await.unwrap();
    ends(before, "its secret was replaced").await;

    let before = stream(&target, third["token"].as_str().unwrap()).await;
    let path = format!("/v1/tokens/{}", id_of(&reader));
    let revoked = target.ask(Method::DELETE, &path, Some(&target.admin), PATIENCE).send().await.unwrap();
    assert!(revoked.status().is_success());
    ends(before, "its token was revoked").await;
}

#[tokio::test]
async fn one_token_cannot_take_all_streams() {
    let target = Target::start(&[]);
    let (greedy, other) = (target.token("read", &[]).await, target.token("read", &[]).await);
    let mut open = Vec::new();
    for _ in 0..64 {
        let response = stream(&target, &greedy).await;
        if response.status() != 200 {
            problem(response, 503, "too_many_streams").await;
            break;
        }
        open.push(response);
    }
    assert_eq!(stream(&target, &other).await.status(), 200, "another token has streams, too");
    assert_eq!(open.len(), 16);
    open.pop();
    let started = Instant::now();
    while stream(&target, &greedy).await.status() != 200 {
        assert!(started.elapsed() < SOON, "a closed stream makes no room");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

#[tokio::test]
async fn a_foreign_job_does_not_tell_its_structure() {
    let target = Target::start(&[]);
    let batch = json!({ "measurements": measurements([4.0, 5.0, 6.0], 8, 0) });
    created(target.post("/v1/structures/three-dof/batches", &target.admin, &batch).await).await;
    let response = target.post("/v1/structures/three-dof/diagnoses", &target.admin, &json!({})).await;
    assert_eq!(response.status(), 202);
    let diagnosis: serde_json::Value = response.json().await.unwrap();
    let diagnosis = diagnosis["diagnosis"].as_str().unwrap().to_owned();
    let trainings = "/v1/structures/three-dof/trainings";
    let body = json!({ "samples": 20_000, "epochs": 2 });
    let response = target.post(trainings, &target.admin, &body).await;
    assert_eq!(response.status(), 202);
    let training: serde_json::Value = response.json().await.unwrap();
    let id = training["training"].as_str().or(training["id"].as_str()).unwrap().to_owned();
    let definition = json!({
        "id": "own", "modes": 1, "mass": [{ "name": "m1", "kg": 2.0 }],
        "spring": [{ "name": "k1", "from": "ground", "to": "m1", "n_per_m": 50.0 }],
        "parameter": [{ "name": "k1", "prior": { "uniform": [30.0, 70.0] }, "sets": [{ "spring": "k1" }] }],
    });
    let put = target.ask(Method::PUT, "/v1/structures/own", Some(&target.admin), PATIENCE).json(&definition);
    created(put.send().await.unwrap()).await;
    let (reader, admin) = (target.token("read", &["own"]).await, target.token("admin", &["own"]).await);
    let (own_jobs, diagnosed) = (format!("/v1/jobs/{id}"), format!("/v1/jobs/{diagnosis}"));
    let refused = [
        (Method::GET, format!("/v1/trainings/{id}"), &reader),
        (Method::GET, format!("/v1/diagnoses/{diagnosis}"), &reader),
        (Method::GET, format!("/v1/diagnoses/{diagnosis}/report"), &reader),
        (Method::POST, format!("/v1/diagnoses/{diagnosis}/extension"), &admin),
        (Method::POST, format!("{own_jobs}/first"), &admin),
        (Method::DELETE, own_jobs.clone(), &admin),
        (Method::DELETE, diagnosed, &admin),
    ];
    for (method, path, token) in refused {
        let answer = target.ask(method.clone(), &path, Some(token), PATIENCE).json(&json!({})).send().await.unwrap();
        let refusal = problem(answer, 403, "forbidden_structure").await;
        assert!(!refusal.to_string().contains("three-dof"), "{method} {path}: {refusal}");
    }
    let listed = target.ask(Method::GET, "/v1/jobs", Some(&reader), PATIENCE).send().await.unwrap();
    assert_eq!(listed.json::<serde_json::Value>().await.unwrap()["items"], json!([]));
    let _ = target.ask(Method::DELETE, &own_jobs, Some(&target.admin), PATIENCE).send().await.unwrap();
}
