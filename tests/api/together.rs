//! Requests that come together leave what one of their orders would leave: what is in use is what is stored, a job has a structure, and what was
//! ended stays ended.

use std::path::Path;
use std::time::Duration;

use rand::Rng as _;
use reqwest::{Method, RequestBuilder, StatusCode};
use serde_json::{json, Value};

use crate::helpers::{command, problem, spawn, time, two_masses_hz, within, Service, PATIENCE, TWO_MASSES};

fn put(service: &Service, id: &str, modes: usize) -> RequestBuilder {
    let definition =
        TWO_MASSES.replace("\"tiny\"", &format!("\"{id}\"")).replace("modes = 2", &format!("modes = {modes}"));
    service
        .request(Method::PUT, &format!("/v1/structures/{id}"))
        .header("content-type", "application/toml")
        .body(definition)
}

fn delete(service: &Service, id: &str) -> RequestBuilder {
    service.request(Method::DELETE, &format!("/v1/structures/{id}?confirm={id}"))
}

fn post(service: &Service, id: &str, modes: usize, start_s: usize) -> RequestBuilder {
    let hz = two_masses_hz(1000.0, 1400.0);
    let one = |i: usize| json!({ "measured_at": time(start_s + 600 * i), "frequencies_hz": &hz[..modes] });
    let body = json!({ "measurements": (0..10).map(one).collect::<Vec<_>>() });
    service.request(Method::POST, &format!("/v1/structures/{id}/batches")).json(&body)
}

/// A table of as many hours, each of which becomes a batch.
fn table(service: &Service, id: &str, modes: usize, start_s: usize) -> RequestBuilder {
    let hz = two_masses_hz(1000.0, 1400.0).map(|hz| hz.to_string());
    let head = ["f1_hz", "f2_hz"][..modes].join(",");
    let rows = (0..40).map(|hour| format!("{},{}\n", time(start_s + 3_600 * hour), hz[..modes].join(",")));
    let body = format!("measured_at,{head}\n{}", rows.collect::<String>());
    let post = service.request(Method::POST, &format!("/v1/structures/{id}/batches?split=1h"));
    post.header("content-type", "text/csv").body(body)
}

/// A training that lasts for many minutes.
fn train(service: &Service, id: &str) -> RequestBuilder {
    let path = format!("/v1/structures/{id}/trainings");
    service.request(Method::POST, &path).json(&json!({ "samples": 20_000, "epochs": 2_000 }))
}

async fn status(request: RequestBuilder) -> StatusCode {
    request.send().await.unwrap().status()
}

/// Sends all at once; the answers in the same order.
async fn at_once(requests: Vec<RequestBuilder>) -> Vec<(StatusCode, Value)> {
    let tasks: Vec<_> = requests.into_iter().map(|request| tokio::spawn(request.send())).collect();
    let mut answers = Vec::new();
    for task in tasks {
        let answer = task.await.unwrap().unwrap();
        answers.push((answer.status(), answer.json().await.unwrap_or(Value::Null)));
    }
    answers
}

async fn open_jobs(service: &Service) -> Vec<Value> {
    let jobs = service.read("/v1/jobs").await;
    let is_open = |job: &&Value| ["running", "waiting"].contains(&job["state"].as_str().unwrap());
    jobs["items"].as_array().unwrap().iter().filter(is_open).cloned().collect()
}

/// Ends all jobs and waits until none runs or waits.
async fn end_jobs(service: &Service) {
    within(Duration::from_mins(2), "the end of all jobs", async || {
        let open = open_jobs(service).await;
        for job in &open {
            let end = service.request(Method::DELETE, &format!("/v1/jobs/{}", job["job"].as_str().unwrap()));
            let answered = status(end).await;
            assert!([200, 404, 409].contains(&answered.as_u16()), "{answered} for {job}");
        }
        open.is_empty().then_some(())
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn whatever_comes_together_the_structure_in_use_is_the_stored_one_and_jobs_have_a_structure() {
    let (service, _folder) = spawn();
    let mut rng = modalwatch::stats::stream(51, "requests that come together");
    for round in 0..150 {
        let requests = (0..rng.random_range(2..7)).map(|i| match rng.random_range(0..9) {
            0..3 => put(&service, "tiny", rng.random_range(1..=2)),
            3..5 => delete(&service, "tiny"),
            5 => post(&service, "tiny", rng.random_range(1..=2), 86_400 * (8 * (round % 3) + i)),
            6 => train(&service, "tiny"),
            7 => table(&service, "tiny", rng.random_range(1..=2), 86_400 * (8 * (round % 3) + i) + 60),
            _ => service.request(Method::POST, "/v1/structures/tiny/diagnoses").json(&json!({})),
        });
        let answers = at_once(requests.collect()).await;
        for (status, answer) in &answers {
            assert!(!status.is_server_error(), "round {round}: {status} {answer} among {answers:?}");
        }
        let list = service.read("/v1/structures").await;
        let stored = list["items"].as_array().unwrap().iter().find(|item| item["id"] == "tiny").cloned();
        let in_use = service.get("/v1/structures/tiny").send().await.unwrap();
        let jobs = open_jobs(&service).await;
        if in_use.status() == 404 {
            assert!(stored.is_none(), "round {round}: {stored:?} is stored and not in use, after {answers:?}");
            assert!(jobs.is_empty(), "round {round}: {jobs:?} without a structure, after {answers:?}");
            continue;
        }
        let in_use: Value = in_use.json().await.unwrap();
        let stored = stored.unwrap_or_else(|| panic!("round {round}: in use and not stored, after {answers:?}"));
        assert_eq!(in_use["digest"], stored["digest"], "round {round}: after {answers:?}");
        let modes = in_use["definition"]["modes"].as_u64().unwrap() as usize;
        let after = post(&service, "tiny", modes, 86_400 * (8 * (round % 3) + 7)).send().await.unwrap();
        assert_eq!(after.status(), 201, "round {round}: {}, after {answers:?}", after.text().await.unwrap());
        for job in &jobs {
            let path = format!(
                "/v1/{}/{}",
                if job["kind"] == "training" { "trainings" } else { "diagnoses" },
                job["job"].as_str().unwrap()
            );
            assert_eq!(service.get(&path).send().await.unwrap().status(), 200, "round {round}: {job}");
        }
        if round % 3 == 0 {
            end_jobs(&service).await;
            assert_eq!(status(delete(&service, "tiny")).await, 200, "round {round}");
        }
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn the_limit_of_jobs_holds_for_requests_that_come_together() {
    let (service, _folder) = spawn();
    let ids: Vec<String> = (0..24).map(|i| format!("tower-{i}")).collect();
    for id in &ids {
        assert_eq!(status(put(&service, id, 2)).await, 201);
    }
    let answers = at_once(ids.iter().map(|id| train(&service, id)).collect()).await;
    let accepted = answers.iter().filter(|(status, _)| *status == 202).count();
    assert_eq!(accepted, 16, "{answers:?}");
    let refused = answers.iter().filter(|(status, answer)| *status == 503 && answer["code"] == "too_many_jobs");
    assert_eq!(refused.count(), 8, "{answers:?}");
    assert_eq!(open_jobs(&service).await.len(), 16);
}

fn start(data: &Path) -> Service {
    Service::spawn(command(data).env("MODALWATCH__HTTP__DRAIN_S", "1"))
}

async fn begins(service: &Service, id: &str) -> String {
    let answer = train(service, id).send().await.unwrap();
    assert_eq!(answer.status(), 202);
    let answer: Value = answer.json().await.unwrap();
    answer["training"].as_str().unwrap().to_owned()
}

async fn state(service: &Service, training: &str) -> Value {
    service.read(&format!("/v1/trainings/{training}")).await["state"].clone()
}

async fn runs(service: &Service, training: &str) {
    // That it has begun is stored before its first step.
    within(PATIENCE, "the training runs", async || {
        let answer = service.read(&format!("/v1/trainings/{training}")).await;
        (answer["state"] == "running" && answer["progress"] != "starting").then_some(())
    })
    .await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_cancelled_job_stays_cancelled_over_every_end_of_the_service_and_a_waiting_one_is_not_failed() {
    let folder = tempfile::tempdir().unwrap();
    let mut service = start(folder.path());
    for id in ["runs", "waits"] {
        assert_eq!(status(put(&service, id, 2)).await, 201);
    }
    let waiting = {
        let running = begins(&service, "runs").await;
        let waiting = begins(&service, "waits").await;
        // Three ends of the program while one runs: that one may be their cause.
        for _ in 0..3 {
            runs(&service, &running).await;
            service.kill();
            service = start(folder.path());
        }
        assert_eq!(state(&service, &running).await, "failed");
        runs(&service, &waiting).await;
        waiting
    };
    let behind = begins(&service, "runs").await;
    for (training, by_kill) in [(&waiting, true), (&behind, false)] {
        runs(&service, training).await;
        let cancelled = service.request(Method::DELETE, &format!("/v1/jobs/{training}"));
        assert_eq!(status(cancelled).await, 200);
        if by_kill {
            service.kill();
        } else {
            assert!(service.stop("TERM").success());
        }
        service = start(folder.path());
        assert_eq!(state(&service, training).await, "cancelled", "by a kill: {by_kill}");
        problem(
            service.request(Method::DELETE, &format!("/v1/jobs/{training}")).send().await.unwrap(),
            404,
            "unknown_job",
        )
        .await;
    }
    assert_eq!(open_jobs(&service).await, Vec::<Value>::new());
}
