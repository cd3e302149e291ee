//! The service over loopback, each batch on disk before its 201. `cargo bench --bench service`
//!
//! - `latency`: posts of 50 measurements with assessment in an open loop: post number i starts at i/rate, whether or not the
//!   previous one was answered, so that a slow answer does not delay later posts. For comparison with the disk alone: two bare SQLite
//!   commits for each post, at the same rate.
//! - `sustained`: posts of 20 measurements with assessment, as many as the service accepts from 32 clients.
//! - `storing`: the same without an assessment, beside bare SQLite commits of the same rows on the same disk.
//! - `engines` (only by name): `sustained` on a SQLite file and on a PostgreSQL server on the same disk, in turn, `rounds=5` times.
//! - `statements` (only by name): which statements a batch costs on a PostgreSQL server, by `pg_stat_statements`.
//!
//! Arguments after `--` select some of these (default: the first three) and set `rate=50 seconds=30`. `MODALWATCH_BENCH_PROGRAM` is the path
//! of another build to measure instead.

use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::Arc;
use std::time::{Duration, Instant};

use modalwatch::baseline::library::find_structure;
use modalwatch::quantity::Timestamp;
use modalwatch::simulator::population::Population;
use modalwatch::stats;
use modalwatch::store::Store;
use postgres::Server;
use serde_json::{json, Value};
use sqlx::Connection as _;
use sqlx_sqlite::{SqliteConnectOptions, SqliteConnection, SqliteSynchronous};

#[path = "../tests/zz_skipped/needs.rs"]
#[allow(dead_code, clippy::unwrap_used, reason = "shared with the tests")]
mod needs;
#[path = "../tests/postgres/server.rs"]
#[allow(dead_code, clippy::unwrap_used, reason = "shared with the tests, which fail by panicking")]
mod postgres;

/// Number of measurements of a post in `latency`, and in the other two.
const LARGE: usize = 50;
const SMALL: usize = 20;

/// Number of clients that post as fast as they are answered.
const CLIENTS: usize = 32;

/// Number of batches that are drawn; further batches repeat their values at other times.
const DRAWN: usize = 200;

/// 2026-01-01T00:00:00Z, µs.
const EPOCH_MICROS: i64 = 1_767_225_600_000_000;

/// A structure with a trained model, and the same structure under another id without a model.
const ASSESSED: &str = "three-dof";
const STORED: &str = "plain";

fn main() {
    let arguments: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    let number = |name: &str, default: u32| {
        let given = arguments.iter().find_map(|a| a.strip_prefix(name)?.strip_prefix('=')?.parse().ok());
        given.unwrap_or(default)
    };
    let named: Vec<&String> = arguments.iter().filter(|a| !a.contains('=')).collect();
    let wanted = |part: &str| named.is_empty() || named.iter().any(|name| *name == part);
    let (rate, seconds) = (number("rate", 50), number("seconds", 30));
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    if wanted("latency") {
        runtime.block_on(latency(rate, seconds));
    }
    if wanted("sustained") {
        runtime.block_on(sustained(seconds));
    }
    if wanted("storing") {
        runtime.block_on(storing(seconds));
    }
    if named.iter().any(|name| *name == "engines") {
        runtime.block_on(engines(number("rounds", 5), seconds));
    }
    if named.iter().any(|name| *name == "statements") {
        runtime.block_on(statements(seconds));
    }
}

/// The program with its own data folder.
struct Service {
    process: Child,
    url: String,
    client: reqwest::Client,
    folder: tempfile::TempDir,
}

impl Service {
    fn start() -> Self {
        Self::start_on(None)
    }

    /// Starts it on a database of a server, or on a file.
    fn start_on(url: Option<&str>) -> Self {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let program = std::env::var("MODALWATCH_BENCH_PROGRAM");
        let mut command = Command::new(program.as_deref().unwrap_or(env!("CARGO_BIN_EXE_modalwatch")));
        command
            .args(["serve", "--listen", "127.0.0.1:0", "--data-dir"])
            .arg(folder.path())
            .env("MODALWATCH__LOG__LEVEL", "warn")
            .env("MODALWATCH__HTTP__RATE_LIMIT__REQUESTS_PER_S", "0")
            .envs(url.map(|url| ("MODALWATCH__STORE__URL", url)));
        let mut process = command.stdout(Stdio::piped()).spawn().expect("the service starts");
        let mut line = String::new();
        BufReader::new(process.stdout.take().expect("it was piped")).read_line(&mut line).expect("it says its address");
        let url = line.trim().rsplit(' ').next().expect("the address is its last word").to_owned();
        Self {
            process,
            url,
            client: modalwatch::notify::client_builder().build().expect("a client can be made"),
            folder,
        }
    }

    async fn post(&self, path: &str, body: Vec<u8>) -> Value {
        let request = self.client.post(format!("{}{path}", self.url)).header("content-type", "application/json");
        let response = request.body(body).send().await.expect("the service answers");
        assert_eq!(response.status(), 201);
        response.json().await.expect("the answer is whole")
    }

    /// Declares a first batch as the undamaged reference.
    async fn declare_undamaged(&self) {
        let batch = self.post(&batches(ASSESSED), body("undamaged", 0, LARGE)).await;
        let declared = json!({ "batches": [batch["batch"]] }).to_string().into_bytes();
        self.post(&format!("/v1/structures/{ASSESSED}/reference"), declared).await;
    }

    /// Posts until the time is over; returns the latency of each post, ms.
    async fn load(&self, structure: &str, seconds: u32) -> (Vec<f64>, f64) {
        self.load_from(structure, 0, seconds).await
    }

    /// As [`Self::load`], beginning with this body.
    async fn load_from(&self, structure: &str, first: usize, seconds: u32) -> (Vec<f64>, f64) {
        let next = Arc::new(AtomicUsize::new(first));
        let started = Instant::now();
        let end = started + Duration::from_secs(u64::from(seconds));
        let clients: Vec<_> = (0..CLIENTS)
            .map(|_| {
                let (next, client, url) = (Arc::clone(&next), self.client.clone(), self.url.clone());
                let path = format!("{url}{}", batches(structure));
                tokio::spawn(async move {
                    let mut latencies_ms = Vec::new();
                    while Instant::now() < end {
                        let body = body("logger", next.fetch_add(1, Ordering::Relaxed), SMALL);
                        let posted = Instant::now();
                        let request = client.post(&path).header("content-type", "application/json").body(body);
                        let response = request.send().await.expect("the service answers");
                        assert_eq!(response.status(), 201);
                        response.bytes().await.expect("the answer is whole");
                        latencies_ms.push(posted.elapsed().as_secs_f64() * 1e3);
                    }
                    latencies_ms
                })
            })
            .collect();
        let mut all = Vec::new();
        for client in clients {
            all.extend(client.await.expect("no client panics"));
        }
        let per_second = all.len() as f64 / started.elapsed().as_secs_f64();
        (all, per_second)
    }

    /// Peak resident memory, as the operating system prints it.
    fn peak(&self) -> String {
        let status = std::fs::read_to_string(format!("/proc/{}/status", self.process.id())).unwrap_or_default();
        let line = status.lines().find(|l| l.starts_with("VmHWM")).unwrap_or("VmHWM: unknown").to_owned();
        line.split_whitespace().skip(1).collect::<Vec<_>>().join(" ")
    }

    /// Seconds of processor time so far, of all threads.
    fn processor_s(&self) -> f64 {
        processor_s(&self.process.id().to_string())
    }
}

impl Drop for Service {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

async fn latency(rate: u32, seconds: u32) {
    let service = Service::start();
    service.declare_undamaged().await;
    let bodies: Vec<Vec<u8>> = (0..rate * seconds).map(|i| body("logger", i as usize, LARGE)).collect();
    let path = format!("{}{}", service.url, batches(ASSESSED));
    let started = Instant::now();
    let mut posts = Vec::new();
    for (i, body) in bodies.into_iter().enumerate() {
        let due = started + Duration::from_secs(1) * u32::try_from(i).expect("few posts") / rate;
        tokio::time::sleep_until(due.into()).await;
        let post = service.client.post(&path).header("content-type", "application/json").body(body).send();
        posts.push(tokio::spawn(async move {
            let response = post.await.expect("the service answers");
            let stored = response.status() == 201;
            response.bytes().await.expect("the answer is whole");
            stored.then(|| due.elapsed().as_secs_f64() * 1e3)
        }));
    }
    let (mut latencies_ms, mut refused) = (Vec::new(), 0);
    for post in posts {
        match post.await.expect("no post panics") {
            Some(latency_ms) => latencies_ms.push(latency_ms),
            None => refused += 1,
        }
    }
    println!("latency: POST of {LARGE} measurements, assessed, {rate}/s in an open loop for {seconds} s");
    // A service that cannot keep up fills its queue and refuses posts; the quantiles are then those of the accepted posts.
    println!("  {}; {refused} refused", quantiles(latencies_ms));
    println!("  {:.1} ms of processor time per batch", 1e3 * service.processor_s() / f64::from(rate * seconds));
    let bare_ms = bare_pairs(service.folder.path(), rate, seconds).await;
    println!("  two bare SQLite commits of the same rows, at the same rate: {}", quantiles(bare_ms));
    println!("  peak resident memory of the service: {}", service.peak());
}

async fn sustained(seconds: u32) {
    let service = Service::start();
    service.declare_undamaged().await;
    let before = service.processor_s();
    let (latencies_ms, per_second) = service.load(ASSESSED, seconds).await;
    let each_ms = 1e3 * (service.processor_s() - before) / latencies_ms.len() as f64;
    println!("sustained: POST of {SMALL} measurements, assessed, {CLIENTS} clients for {seconds} s");
    println!("  {per_second:.0} batches/s; {}", quantiles(latencies_ms));
    println!("  {each_ms:.1} ms of processor time per batch; peak resident memory: {}", service.peak());
}

async fn storing(seconds: u32) {
    let service = Service::start();
    let definition = find_structure(ASSESSED).expect("it is shipped").definition().canonical_json();
    let definition = definition.replace("\"three-dof\"", "\"plain\"");
    let put = service.client.put(format!("{}/v1/structures/{STORED}", service.url));
    let put = put.header("content-type", "application/json").body(definition).send().await.expect("an answer");
    assert!(put.status().is_success());
    // Measured before and after, because other programs use the disk as well.
    let bare_before = bare_commits(service.folder.path(), seconds.div_ceil(2)).await;
    let before = service.processor_s();
    let (latencies_ms, per_second) = service.load(STORED, seconds).await;
    let each_ms = 1e3 * (service.processor_s() - before) / latencies_ms.len() as f64;
    let bare_after = bare_commits(service.folder.path(), seconds.div_ceil(2)).await;
    let bare = f64::midpoint(bare_before, bare_after);
    println!("storing: POST of {SMALL} measurements, not assessed, {CLIENTS} clients for {seconds} s");
    println!("  {per_second:.0} batches/s; {}; {each_ms:.2} ms of processor time per batch", quantiles(latencies_ms));
    println!("  bare SQLite: {bare_before:.0} and {bare_after:.0} commits/s of the same rows");
    println!("  ratio {:.2} (bare to service)", bare / per_second);
}

/// The service on a SQLite file and on a PostgreSQL server with its default settings, on the same disk, in turn.
async fn engines(rounds: u32, seconds: u32) {
    let server = Server::start(&[]);
    println!("engines: POST of {SMALL} measurements, assessed, {CLIENTS} clients, {seconds} s on each in turn, {rounds} rounds");
    let mut ratios = Vec::new();
    let mut all_ms = [Vec::new(), Vec::new()];
    for round in 0..rounds {
        let url = prepared(&server, &format!("round{round}"));
        let mut rates = [0.0; 2];
        for (engine, url) in [None, Some(url.as_str())].into_iter().enumerate() {
            let service = Service::start_on(url);
            service.declare_undamaged().await;
            // The first batches prepare the statements; then the server knows its tables, as it does by itself after a minute.
            let (first, _) = service.load(ASSESSED, 2).await;
            if url.is_some() {
                server.sql(&format!("round{round}"), "analyze");
            }
            let first = first.len() + 4 * CLIENTS;
            let (service_s, server_s) = (service.processor_s(), server_processor_s(&server));
            let (latencies_ms, per_second) = service.load_from(ASSESSED, first, seconds).await;
            let each_ms = |spent_s: f64| 1e3 * spent_s / latencies_ms.len() as f64;
            let (service_ms, server_ms) =
                (each_ms(service.processor_s() - service_s), each_ms(server_processor_s(&server) - server_s));
            rates[engine] = per_second;
            println!(
                "  {}: {per_second:.0} batches/s; {}; {service_ms:.1} ms of processor time per batch{}",
                ["SQLite    ", "PostgreSQL"][engine],
                quantiles(latencies_ms.clone()),
                url.map_or(String::new(), |_| format!(", and {server_ms:.1} ms of the server"))
            );
            all_ms[engine].extend(latencies_ms);
        }
        ratios.push(rates[1] / rates[0]);
    }
    ratios.sort_by(f64::total_cmp);
    let [sqlite_ms, postgres_ms] = all_ms;
    println!("  SQLite, all rounds: {}", quantiles(sqlite_ms));
    println!("  PostgreSQL, all rounds: {}", quantiles(postgres_ms));
    println!("  rate of PostgreSQL to SQLite: {ratios:.2?}, median {:.2} (goal: 0.6)", stats::quantile(&ratios, 0.5));
}

/// Which statements a batch costs on a server, and their times there.
async fn statements(seconds: u32) {
    let server = Server::start(&[
        "-c",
        "shared_preload_libraries=pg_stat_statements",
        "-c",
        "pg_stat_statements.track_planning=on",
        "-c",
        "track_wal_io_timing=on",
    ]);
    let url = prepared(&server, "statements");
    server.sql("statements", "create extension pg_stat_statements schema public");
    let service = Service::start_on(Some(&url));
    service.declare_undamaged().await;
    // The first batches prepare the statements.
    let (first, _) = service.load(ASSESSED, 2).await;
    server.sql("statements", "analyze");
    server.sql("statements", "select public.pg_stat_statements_reset()");
    let alone = 200;
    for index in first.len()..first.len() + alone {
        service.post(&batches(ASSESSED), body("logger", 2 * CLIENTS + index, SMALL)).await;
    }
    let per_batch = |batches: f64| {
        format!(
            "select round((calls / {batches})::numeric, 2) || ' calls, ' || round((total_plan_time / {batches})::numeric, 3) || ' ms planned, '
               || round((total_exec_time / {batches})::numeric, 3) || ' ms executed: ' || left(regexp_replace(query, '\\s+', ' ', 'g'), 90)
             from public.pg_stat_statements where calls / {batches} > 0.02 order by total_plan_time + total_exec_time desc limit 24"
        )
    };
    println!(
        "statements of a batch on the server, one client:\n{}",
        server.sql("statements", &per_batch(alone as f64))
    );
    server.sql("statements", "select public.pg_stat_statements_reset()");
    let (latencies_ms, per_second) = service.load_from(ASSESSED, first.len() + 4 * CLIENTS + alone, seconds).await;
    println!("statements of a batch on the server, {CLIENTS} clients, {per_second:.0} batches/s:");
    println!("{}", server.sql("statements", &per_batch(latencies_ms.len() as f64)));
}

/// A database with the tables of the program; its URL.
fn prepared(server: &Server, name: &str) -> String {
    server.sql("postgres", &format!("create database {name}"));
    let url = server.url(name);
    let program = std::env::var("MODALWATCH_BENCH_PROGRAM");
    let made = Command::new(program.as_deref().unwrap_or(env!("CARGO_BIN_EXE_modalwatch")))
        .args(["migrate", "schema", "--url", &url])
        .stdout(Stdio::null())
        .status();
    assert!(made.expect("the program runs").success());
    url
}

/// Seconds of processor time of all processes of the server that run now.
fn server_processor_s(server: &Server) -> f64 {
    server.sql("postgres", "select pid from pg_stat_activity").lines().map(processor_s).sum()
}

/// Seconds of processor time of a process so far, of all threads.
fn processor_s(pid: &str) -> f64 {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap_or_default();
    let fields: Vec<&str> = stat.rsplit(')').next().unwrap_or_default().split_whitespace().collect();
    // Hundredths of a second, in user and system mode.
    [11, 12].iter().filter_map(|i| fields.get(*i)?.parse::<f64>().ok()).sum::<f64>() / 100.0
}

/// A bare connection to the tables of a store: write-ahead log, full sync, one statement for each table, no service.
struct Bare {
    connection: SqliteConnection,
    insert_measurements: String,
    measurements: usize,
    commits: u32,
    _folder: tempfile::TempDir,
}

impl Bare {
    /// Opens one in a folder, for batches of this number of measurements.
    async fn open(beside: &Path, measurements: usize) -> Self {
        let folder = tempfile::tempdir_in(beside).expect("a temporary folder");
        Store::open(folder.path()).await.expect("a store").close().await;
        let options = SqliteConnectOptions::new()
            .filename(folder.path().join("modalwatch.sqlite"))
            .foreign_keys(true)
            .synchronous(SqliteSynchronous::Full);
        let mut connection = SqliteConnection::connect_with(&options).await.expect("a connection");
        let plain = "insert into structure values ('plain', '{}', 'digest', 0, 0)";
        sqlx::query(plain).execute(&mut connection).await.expect("a structure");
        let row = |i| format!("('plain', ?1, {i}, 'logger', ?2 + {i}, ?3, null, '{{}}', '{{}}', null)");
        let rows: Vec<String> = (0..measurements).map(row).collect();
        let insert_measurements = format!("insert into measurement values {}", rows.join(", "));
        Self { connection, insert_measurements, measurements, commits: 0, _folder: folder }
    }

    /// Commits the rows of one more batch.
    async fn commit(&mut self) {
        let (id, at) = (format!("01890000-0000-7000-8000-{:012}", self.commits), i64::from(self.commits) * 1_000_000);
        let frequencies = [0.5_f64, 0.9, 1.2].map(f64::to_le_bytes).concat();
        let mut transaction = self.connection.begin_with("begin immediate").await.expect("a transaction");
        sqlx::query(
            "insert into measurement_batch values ('plain', ?1, 'logger', null, ?2, ?3, ?3, ?3, ?4, 'received', null, null)",
        )
        .bind(&id)
        .bind("d".repeat(64))
        .bind(at)
        .bind(self.measurements as i64)
        .execute(&mut *transaction)
        .await
        .expect("a batch");
        sqlx::query(sqlx::AssertSqlSafe(self.insert_measurements.clone()))
            .bind(&id)
            .bind(at)
            .bind(&frequencies)
            .execute(&mut *transaction)
            .await
            .expect("its measurements");
        transaction.commit().await.expect("a commit");
        self.commits += 1;
    }
}

/// Number of bare commits per second, one transaction after another.
async fn bare_commits(beside: &Path, seconds: u32) -> f64 {
    let mut bare = Bare::open(beside, SMALL).await;
    let started = Instant::now();
    while started.elapsed() < Duration::from_secs(u64::from(seconds)) {
        bare.commit().await;
    }
    f64::from(bare.commits) / started.elapsed().as_secs_f64()
}

/// Times of two bare commits, ms, started `rate` times a second: a lower bound for a post.
async fn bare_pairs(beside: &Path, rate: u32, seconds: u32) -> Vec<f64> {
    let mut bare = Bare::open(beside, LARGE).await;
    let started = Instant::now();
    let mut latencies_ms = Vec::new();
    for i in 0..rate * seconds {
        let due = started + Duration::from_secs(1) * i / rate;
        tokio::time::sleep_until(due.into()).await;
        bare.commit().await;
        bare.commit().await;
        latencies_ms.push(due.elapsed().as_secs_f64() * 1e3);
    }
    latencies_ms
}

fn quantiles(mut latencies_ms: Vec<f64>) -> String {
    latencies_ms.sort_by(f64::total_cmp);
    let [p50, p99, most] = [0.5, 0.99, 1.0].map(|level| stats::quantile(&latencies_ms, level));
    format!("p50 {p50:.1} ms, p99 {p99:.1} ms, largest {most:.1} ms")
}

fn batches(structure: &str) -> String {
    format!("/v1/structures/{structure}/batches")
}

/// Body number `index` of a source, with one second between measurements.
fn body(source: &str, index: usize, measurements: usize) -> Vec<u8> {
    let rows = &drawn()[index % DRAWN];
    let row = |(i, row): (usize, &Vec<f64>)| {
        let micros = EPOCH_MICROS + 1_000_000 * (index * measurements + i) as i64;
        json!({ "measured_at": Timestamp::from_micros(micros).expect("a time"), "frequencies_hz": row })
    };
    let rows: Vec<Value> = rows.iter().take(measurements).enumerate().map(row).collect();
    json!({ "source": source, "measurements": rows }).to_string().into_bytes()
}

/// Measurements of the undamaged structure of the paper, drawn from one population.
fn drawn() -> &'static Vec<Vec<Vec<f64>>> {
    static DRAWN_ROWS: std::sync::OnceLock<Vec<Vec<Vec<f64>>>> = std::sync::OnceLock::new();
    DRAWN_ROWS.get_or_init(|| {
        let simulator = find_structure(ASSESSED).expect("it is shipped");
        let moments = [("k1", 4.0, 0.3), ("k2", 5.0, 0.1), ("k3", 6.0, 0.2)].map(|(n, m, s)| (n.to_owned(), m, s));
        let population = Population::new(simulator.space(), &moments).expect("all parameters are named");
        let one = |seed: usize| {
            let drawn = population.draw(&simulator, LARGE, 1.0, seed as u64).expect("the population is physical");
            drawn.frequencies_hz.row_iter().map(|row| row.iter().copied().collect()).collect()
        };
        (0..DRAWN).map(one).collect()
    })
}
