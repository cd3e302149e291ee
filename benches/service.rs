//! Latency of a POST of 50 measurements on loopback, and the memory of the service. `cargo bench --bench service`
//!
//! Open loop: post number i starts at i/rate, whether or not the one before was answered, so a slow answer does not hide
//! the ones behind it. Arguments after `--`: rate per second and seconds, 20 and 30 without them.

use std::io::{BufRead as _, BufReader};
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use modalwatch::baseline::library::find_structure;
use modalwatch::simulator::population::Population;
use modalwatch::stats;
use serde_json::{json, Value};

const MEASUREMENTS: usize = 50;

fn main() {
    let numbers: Vec<u32> = std::env::args().skip(1).filter_map(|a| a.parse().ok()).collect();
    let (rate, seconds) = (numbers.first().copied().unwrap_or(20), numbers.get(1).copied().unwrap_or(30));
    let folder = tempfile::tempdir().expect("a temporary folder");
    let mut service = Command::new(env!("CARGO_BIN_EXE_modalwatch"))
        .args(["serve", "--listen", "127.0.0.1:0", "--data-dir"])
        .arg(folder.path())
        .env("MODALWATCH__LOG__LEVEL", "warn")
        .stdout(Stdio::piped())
        .spawn()
        .expect("the service starts");
    let mut line = String::new();
    BufReader::new(service.stdout.take().expect("it was piped")).read_line(&mut line).expect("it says its address");
    let url = line.trim().rsplit(' ').next().expect("the address is its last word").to_owned();
    let bodies: Vec<Value> = (0..rate * seconds).map(body).collect();

    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    let mut latencies_ms = runtime.block_on(post_all(&url, bodies, rate));
    let status = std::fs::read_to_string(format!("/proc/{}/status", service.id())).unwrap_or_default();
    let peak = status.lines().find(|l| l.starts_with("VmHWM")).unwrap_or("VmHWM: unknown").to_owned();
    service.kill().expect("it runs");
    service.wait().expect("it was started here");

    latencies_ms.sort_by(f64::total_cmp);
    let quantile = |level| stats::quantile(&latencies_ms, level);
    println!(
        "POST of {MEASUREMENTS} measurements, {rate}/s for {seconds} s, each assessed and on disk before its 201:"
    );
    println!("  p50 {:.1} ms, p99 {:.1} ms, largest {:.1} ms", quantile(0.5), quantile(0.99), quantile(1.0));
    println!(
        "  peak resident memory of the service: {}",
        peak.split_whitespace().skip(1).collect::<Vec<_>>().join(" ")
    );
}

async fn post_all(url: &str, bodies: Vec<Value>, rate: u32) -> Vec<f64> {
    let client = reqwest::Client::new();
    let path = format!("{url}/v1/structures/three-dof/batches");
    let first = client.post(&path).json(&bodies[0]).send().await.expect("the service answers");
    let batch: Value = first.json().await.expect("it answers JSON");
    let baseline = json!({ "batches": [batch["batch"]] });
    let answer = client.post(format!("{url}/v1/structures/three-dof/baseline")).json(&baseline).send().await;
    assert!(answer.expect("the service answers").status().is_success());
    let started = Instant::now();
    let mut posts = Vec::new();
    for (i, body) in bodies.into_iter().skip(1).enumerate() {
        let due = started + Duration::from_secs(1) * u32::try_from(i).expect("few posts") / rate;
        tokio::time::sleep_until(due.into()).await;
        let post = client.post(&path).json(&body).send();
        posts.push(tokio::spawn(async move {
            let response = post.await.expect("the service answers");
            assert_eq!(response.status(), 201);
            response.bytes().await.expect("the answer is whole");
            due.elapsed().as_secs_f64() * 1e3
        }));
    }
    let mut latencies = Vec::new();
    for post in posts {
        latencies.push(post.await.expect("no post panics"));
    }
    latencies
}

fn body(index: u32) -> Value {
    let simulator = find_structure("three-dof").expect("it is shipped");
    let moments = [("k1", 4.0, 0.3), ("k2", 5.0, 0.1), ("k3", 6.0, 0.2)].map(|(n, m, s)| (n.to_owned(), m, s));
    let population = Population::new(simulator.space(), &moments).expect("all parameters are named");
    let drawn = population.draw(&simulator, MEASUREMENTS, 1.0, u64::from(index)).expect("the population is physical");
    let row = |(i, row): (usize, nalgebra::MatrixView1xX<'_, f64, nalgebra::U1, nalgebra::Dyn>)| {
        let second = index as usize * MEASUREMENTS + i;
        let (day, rest) = (second / 86_400, second % 86_400);
        let at = format!("2026-01-{:02}T{:02}:{:02}:{:02}Z", 1 + day, rest / 3600, rest / 60 % 60, rest % 60);
        json!({ "measured_at": at, "frequencies_hz": row.iter().collect::<Vec<_>>() })
    };
    json!({ "measurements": drawn.frequencies_hz.row_iter().enumerate().map(row).collect::<Vec<_>>() })
}
