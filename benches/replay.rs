//! Replay of history over PostgreSQL by one and by two workers, and what it costs new batches.
//!
//! ```sh
//! cargo bench --bench replay                                                   # all
//! cargo bench --bench replay -- batches=120 measurements=300 draws=512         # size of the history, posterior samples for the population
//! cargo bench --bench replay -- live rate=5 seconds=30                         # only new batches, with and without a replay beside them
//! ```
//!
//! Workers and service have one computing thread each. The service only takes and stores what the workers deliver (`roles = ["api"]`), so
//! that the rate is that of the workers. The history is posted once; each run has a copy of its database in which everything waits and nothing
//! is assessed, as after a new trained baseline.

#![allow(clippy::unwrap_used, reason = "a benchmark fails by panicking")]
#![allow(missing_docs, reason = "a benchmark has no interface")]

#[path = "../tests/zz_skipped/needs.rs"]
#[allow(dead_code, clippy::unwrap_used, reason = "shared with tests")]
mod needs;
#[path = "../tests/postgres/server.rs"]
#[allow(dead_code, reason = "shared with tests")]
mod server;

use std::io::{BufRead as _, BufReader};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use modalwatch::baseline::library::find_structure;
use modalwatch::quantity::Timestamp;
use modalwatch::simulator::population::Population;
use modalwatch::stats;
use serde_json::{json, Value};
use server::Server;

const STRUCTURE: &str = "/v1/structures/three-dof";

/// Measurements of a new batch beside the replay.
const NEW: usize = 20;

/// 2000-01-01T00:00:00Z, µs, and the time between two batches of the history. A piece is a month and has five of them: with
/// more, one worker would be idle for a noticeable part of so short a history while the other finishes the last piece.
const EPOCH_MICROS: i64 = 946_684_800_000_000;
const BETWEEN_MICROS: i64 = 6 * 86_400_000_000;

/// Time after the start of a service until its latency is measured: what is read and compiled once at the first requests is not a cost of
/// the replay.
const SETTLED: Duration = Duration::from_secs(5);

/// The program is started as it is.
const NO_WRAPPER: &[&str] = &[];

/// Starts a program in the scheduling class of Linux that runs only when no other process wants the processor.
const IDLE_CLASS: [&str; 3] = ["chrt", "--idle", "0"];

/// Size of the history and of the load.
#[derive(Clone, Copy)]
struct Size {
    batches: usize,
    measurements: usize,
    draws: usize,
    rate: u32,
    seconds: u32,
}

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    let number = |name: &str, default: usize| {
        let given = arguments.iter().find_map(|a| a.strip_prefix(name)?.strip_prefix('=')?.parse().ok());
        given.unwrap_or(default)
    };
    let named: Vec<&String> = arguments.iter().filter(|a| !a.contains('=')).collect();
    let wanted = |part: &str| named.is_empty() || named.iter().any(|name| *name == part);
    let size = Size {
        batches: number("batches", 160),
        measurements: number("measurements", 300),
        draws: number("draws", 512),
        rate: number("rate", 5) as u32,
        seconds: number("seconds", 30) as u32,
    };
    if !Server::is_installed() {
        println!("skipped: PostgreSQL is not installed");
        return;
    }
    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let history = History::new(size).await;
        if wanted("rates") {
            rates(&history).await;
        }
        if wanted("live") {
            live(&history).await;
        }
    });
}

async fn rates(history: &History) {
    let Size { batches, measurements, draws, .. } = history.size;
    println!(
        "replay of {batches} batches of {measurements} measurements with {draws} draws, workers with one thread each:"
    );
    let mut found = Vec::new();
    for workers in [1, 2] {
        let copy = history.copy(&format!("rates_{workers}"));
        let (_workers, service) = copy.start(workers, draws).await;
        let seconds = replayed(&service).await;
        found.push(batches as f64 / seconds);
        println!("  {workers} workers: {:.2} batches/s ({seconds:.1} s)", batches as f64 / seconds);
    }
    println!("  ratio {:.2}", found[1] / found[0]);
}

/// Latency of new batches with a replay by two workers, by two that run only when no other process wants the processors, and by the service
/// alone, each beside the latency without a replay.
async fn live(history: &History) {
    let Size { draws, rate, seconds, .. } = history.size;
    println!("POST of {NEW} measurements, assessed with {draws} draws, {rate}/s in an open loop for {seconds} s:");
    let replays = [
        ("by two workers", 2, NO_WRAPPER, "api"),
        ("by two workers of the idle class", 2, &IDLE_CLASS[..], "api"),
        ("by the service alone", 0, NO_WRAPPER, "api,worker"),
    ];
    for (number, (what, workers, wrapper, roles)) in replays.into_iter().enumerate() {
        // Just before, because the speed of a machine and of its disk changes from minute to minute.
        let without = without_replay(history, number).await;
        println!("  without a replay: {}", quantiles(&without));
        let copy = history.copy(&format!("live_{number}"));
        let _workers = copy.workers(workers, draws, wrapper).await;
        let service = copy.serve(roles, draws);
        tokio::time::sleep(SETTLED).await;
        let with = load(&service, history.size).await;
        let (left, ratio) = (waiting(&service).await, p99(&with) / p99(&without));
        println!("  with one {what}: {}; p99 {ratio:.2} times as large; {left} batches still waited", quantiles(&with));
        assert!(left > 0, "the replay ended before the load: give more batches");
    }
}

/// Latency of new batches of a history in which nothing waits.
async fn without_replay(history: &History, number: usize) -> Vec<f64> {
    let copy = history.copy(&format!("live_idle_{number}"));
    let service = copy.serve("api", history.size.draws);
    replayed(&service).await;
    load(&service, history.size).await
}

/// Posts at a fixed rate, ms from the time at which each post was due.
async fn load(service: &Process, size: Size) -> Vec<f64> {
    let rows = drawn(NEW, 7);
    let started = Instant::now();
    let mut posts = Vec::new();
    for i in 0..size.rate * size.seconds {
        let due = started + Duration::from_secs(1) * i / size.rate;
        tokio::time::sleep_until(due.into()).await;
        let behind = EPOCH_MICROS + (size.batches as i64 + 5) * BETWEEN_MICROS;
        let body = body("live", behind + i64::from(i) * 600_000_000, &rows);
        let post = service.client.post(format!("{}{STRUCTURE}/batches", service.url)).json(&body).send();
        posts.push(tokio::spawn(async move {
            let response = post.await.unwrap();
            let status = response.status();
            let answer: Value = response.json().await.unwrap();
            assert_eq!(status, 201, "{answer}");
            assert_eq!(answer["state"], "assessed", "{answer}");
            due.elapsed().as_secs_f64() * 1e3
        }));
    }
    let mut latencies_ms = Vec::new();
    for post in posts {
        latencies_ms.push(post.await.unwrap());
    }
    latencies_ms.sort_by(f64::total_cmp);
    latencies_ms
}

fn p99(sorted_ms: &[f64]) -> f64 {
    stats::quantile(sorted_ms, 0.99)
}

fn quantiles(sorted_ms: &[f64]) -> String {
    let [p50, p99, most] = [0.5, 0.99, 1.0].map(|level| stats::quantile(sorted_ms, level));
    format!("p50 {p50:.1} ms, p99 {p99:.1} ms, largest {most:.1} ms")
}

/// A database with a history.
struct History {
    server: Server,
    size: Size,
    folder: tempfile::TempDir,
}

/// A copy of it, in which everything waits.
struct Copy<'h> {
    history: &'h History,
    url: String,
}

/// A process of the program.
struct Process {
    child: Child,
    url: String,
    client: reqwest::Client,
}

impl History {
    async fn new(size: Size) -> Self {
        let (server, folder) = (Server::start(&[]), tempfile::tempdir().unwrap());
        server.sql("postgres", "create database history");
        let url = server.url("history");
        let made = Command::new(program()).args(["migrate", "schema", "--url", &url]).output().unwrap();
        assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
        let history = Self { server, size, folder };
        // Assessed with few draws, which takes little time.
        let service = history.process(&url, "api", 64, NO_WRAPPER);
        let mut first = Vec::new();
        for number in 0..size.batches {
            let rows = drawn(size.measurements, number as u64);
            let body = body("history", EPOCH_MICROS + number as i64 * BETWEEN_MICROS, &rows);
            let posted = service.post("/batches", &body).await;
            if number < 8 {
                first.push(posted["batch"].clone());
            }
        }
        service.post("/reference", &json!({ "batches": first })).await;
        replayed(&service).await;
        drop(service);
        // A database that is in use cannot be copied.
        let used = "select count(*) from pg_stat_activity where datname = 'history'";
        while history.server.sql("postgres", used) != "0" {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        history
    }

    fn copy(&self, name: &str) -> Copy<'_> {
        self.server.sql("postgres", &format!("create database {name} template history"));
        for statement in [
            "delete from modalwatch.process_point",
            "delete from modalwatch.chart_point",
            "delete from modalwatch.quantity_assessment",
            "delete from modalwatch.assessment",
            "update modalwatch.measurement_batch set state = 'received'",
        ] {
            self.server.sql(name, statement);
        }
        Copy { history: self, url: self.server.url(name) }
    }

    /// Starts the program by another one, which replaces itself by it.
    fn process(&self, url: &str, roles: &str, draws: usize, wrapper: &[&str]) -> Process {
        let folder = tempfile::tempdir_in(self.folder.path()).unwrap().keep();
        let program = program();
        let mut words = wrapper.iter().copied().chain([program.as_str()]);
        let mut child = Command::new(words.next().expect("the program itself"))
            .args(words)
            .args(["serve", "--listen", "127.0.0.1:0", "--roles", roles, "--data-dir"])
            .arg(folder)
            .env("MODALWATCH__STORE__URL", url)
            .env("MODALWATCH__MONITOR__DRAWS_FOR_POPULATION", draws.to_string())
            .env("MODALWATCH__MONITOR__COMPUTE__THREADS", "1")
            .env("RAYON_NUM_THREADS", "1")
            .env("MODALWATCH__LOG__LEVEL", "warn")
            .env("MODALWATCH__HTTP__RATE_LIMIT__REQUESTS_PER_S", "0")
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let url = line.trim().rsplit(' ').next().unwrap().to_owned();
        Process { child, url, client: modalwatch::notify::client_builder().build().unwrap() }
    }
}

impl Copy<'_> {
    fn serve(&self, roles: &str, draws: usize) -> Process {
        self.history.process(&self.url, roles, draws, NO_WRAPPER)
    }

    /// Starts workers, and waits until the database has heard of all.
    async fn workers(&self, workers: usize, draws: usize, wrapper: &[&str]) -> Vec<Process> {
        let start = |_| self.history.process(&self.url, "worker", draws, wrapper);
        let started: Vec<Process> = (0..workers).map(start).collect();
        let database = self.url.rsplit_once('/').unwrap().1;
        let heard = || self.history.server.sql(database, "select count(*) from modalwatch.computation_worker");
        while heard() != workers.to_string() {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        started
    }

    async fn start(&self, workers: usize, draws: usize) -> (Vec<Process>, Process) {
        (self.workers(workers, draws, NO_WRAPPER).await, self.serve("api", draws))
    }
}

impl Process {
    async fn post(&self, path: &str, body: &Value) -> Value {
        let response = self.client.post(format!("{}{STRUCTURE}{path}", self.url)).json(body).send().await.unwrap();
        let status = response.status();
        let answer: Value = response.json().await.unwrap();
        assert_eq!(status, 201, "{answer}");
        answer
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Waits until nothing waits; the seconds that it took. The metrics count what waits, which takes time from the workers if asked often.
async fn replayed(service: &Process) -> f64 {
    let started = Instant::now();
    while waiting(service).await > 0 {
        tokio::time::sleep(Duration::from_millis(500)).await;
    }
    started.elapsed().as_secs_f64()
}

/// Batches that wait.
async fn waiting(service: &Process) -> usize {
    let text = service.client.get(format!("{}/metrics", service.url)).send().await.unwrap().text().await.unwrap();
    let line = text.lines().find(|line| line.starts_with("modalwatch_pending_batches ")).unwrap();
    line.rsplit_once(' ').unwrap().1.parse().unwrap()
}

fn program() -> String {
    std::env::var("MODALWATCH_BENCH_PROGRAM").unwrap_or_else(|_| env!("CARGO_BIN_EXE_modalwatch").to_owned())
}

/// Body of a batch with ten seconds between measurements.
fn body(source: &str, from_micros: i64, rows: &[Vec<f64>]) -> Value {
    let row = |(i, row): (usize, &Vec<f64>)| {
        let at = Timestamp::from_micros(from_micros + 10_000_000 * i as i64).unwrap();
        json!({ "measured_at": at, "frequencies_hz": row })
    };
    json!({ "source": source, "measurements": rows.iter().enumerate().map(row).collect::<Vec<Value>>() })
}

/// Measurements of the undamaged structure of the paper, drawn from one population.
fn drawn(measurements: usize, seed: u64) -> Vec<Vec<f64>> {
    let simulator = find_structure("three-dof").unwrap();
    let moments = [("k1", 4.0, 0.3), ("k2", 5.0, 0.1), ("k3", 6.0, 0.2)].map(|(n, m, s)| (n.to_owned(), m, s));
    let population = Population::new(simulator.space(), &moments).unwrap();
    let drawn = population.draw(&simulator, measurements, 1.0, seed).unwrap();
    drawn.frequencies_hz.row_iter().map(|row| row.iter().copied().collect()).collect()
}
