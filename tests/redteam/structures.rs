//! Definitions of large structures: many at a time, by clients that leave, and at the next start.

use std::net::{TcpListener, TcpStream};
use std::process::Stdio;
use std::time::{Duration, Instant};

use reqwest::Method;
use serde_json::{json, Value};

use crate::helpers::within;
use crate::redteam::target::{command, peak_mib, Target};

const PATIENCE: Duration = Duration::from_mins(1);

/// A tower of `count` masses, one above the other.
fn tower(id: &str, count: usize) -> Value {
    let mass = |number: usize| json!({ "name": format!("m{number}"), "kg": 2.0 });
    let spring = |number: usize| {
        let below = if number == 0 { "ground".to_owned() } else { format!("m{}", number - 1) };
        json!({ "name": format!("k{number}"), "from": below, "to": format!("m{number}"), "n_per_m": 5e6 })
    };
    json!({
        "id": id,
        "modes": 3,
        "mass": (0..count).map(mass).collect::<Vec<_>>(),
        "spring": (0..count).map(spring).collect::<Vec<_>>(),
        "parameter": [{ "name": "k0", "prior": { "uniform": [3e6, 7e6] }, "sets": [{ "spring": "k0" }] }],
    })
}

fn put(target: &Target, id: &str, masses: usize) -> reqwest::RequestBuilder {
    let path = format!("/v1/structures/{id}");
    target.ask(Method::PUT, &path, Some(&target.admin), PATIENCE).json(&tower(id, masses))
}

/// Status of several definitions that are put at once, and the memory that they needed, MiB.
async fn put_at_once(target: &Target, count: usize, masses: usize) -> (Vec<u16>, f64) {
    let before = peak_mib(target.service.pid());
    let requests: Vec<_> =
        (0..count).map(|number| tokio::spawn(put(target, &format!("tower-{number}"), masses).send())).collect();
    let mut answers = Vec::new();
    for request in requests {
        answers.push(request.await.unwrap().unwrap().status().as_u16());
    }
    (answers, peak_mib(target.service.pid()) - before)
}

/// Starts the program again in the folder of a target; returns when it answered that it lives, and when that it is ready.
async fn times_of_a_start(mut target: Target) -> (Duration, Duration) {
    assert!(target.service.stop("TERM").success());
    let port = TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap();
    let mut command = command(target.folder.path(), &port.to_string(), &[]);
    let started = Instant::now();
    let mut child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
    let client = modalwatch::notify::client_builder().timeout(Duration::from_secs(2)).build().unwrap();
    let mut times = Vec::new();
    for path in ["/healthz", "/readyz"] {
        within(Duration::from_mins(2), path, async || {
            // Before the program listens, a connection is refused.
            TcpStream::connect(port).ok()?;
            let response = client.get(format!("http://{port}{path}")).send().await.ok()?;
            (response.status() == 200).then_some(())
        })
        .await;
        times.push(started.elapsed());
    }
    child.kill().unwrap();
    child.wait().unwrap();
    (times[0], times[1])
}

/// The attack of 2026 with towers of 1,000 instead of 2,000 masses.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn large_definitions_are_checked_one_at_a_time_and_the_next_start_answers_at_once() {
    let target = Target::start(&[]);
    let (answers, needed_mib) = put_at_once(&target, 8, 1_000).await;
    println!("8 towers needed {needed_mib:.0} MiB");
    assert!(answers.iter().all(|status| *status == 201), "{answers:?}");
    // A matrix of 1,000 × 1,000 has 8 MB, and a check needs a few of them.
    assert!(needed_mib < 120.0, "{needed_mib:.0} MiB");
    let (alive, ready) = times_of_a_start(target).await;
    println!("alive after {alive:?}, ready after {ready:?}");
    assert!(alive < Duration::from_millis(1_500), "alive after {alive:?}");
}

/// `cargo test --release --test robustness the_largest_definitions -- --ignored --nocapture`
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "two minutes: 16 towers of 2,000 masses"]
async fn the_largest_definitions_need_the_memory_of_one_and_the_next_start_answers_at_once() {
    let target = Target::start(&[]);
    let started = Instant::now();
    let (answers, needed_mib) = put_at_once(&target, 16, 2_000).await;
    println!("{answers:?} after {:?}, {needed_mib:.0} MiB", started.elapsed());
    assert!(needed_mib < 500.0, "{needed_mib:.0} MiB");
    let (alive, ready) = times_of_a_start(target).await;
    println!("alive after {alive:?}, ready after {ready:?}");
    assert!(alive < Duration::from_millis(1_500), "alive after {alive:?}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_definition_whose_client_leaves_is_not_stored() {
    let target = Target::start(&[]);
    for number in 0..2 {
        let gone = put(&target, &format!("gone-{number}"), 2_000).timeout(Duration::from_millis(150)).send().await;
        assert!(gone.is_err(), "the client should have left before the answer: {gone:?}");
    }
    let stays = put(&target, "stays", 10).send().await.unwrap();
    assert_eq!(stays.status(), 201, "{}", stays.text().await.unwrap());
    // Their checks would have ended within this time.
    let started = Instant::now();
    while started.elapsed() < Duration::from_secs(6) {
        for number in 0..2 {
            let path = format!("/v1/structures/gone-{number}");
            let (status, _) = target.get(&path, Some(&target.admin), PATIENCE).await.unwrap();
            assert_eq!(status, 404, "{path} after {:?}", started.elapsed());
        }
        tokio::time::sleep(Duration::from_millis(200)).await;
    }
}
