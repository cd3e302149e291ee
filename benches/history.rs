//! Queries of a database with a million batches, and the assessment of a history under a new reference.
//!
//! `cargo bench --bench history`
//!
//! - `queries`: pages of history, the overview of a thousand structures, a series of a hundred thousand batches; the program itself
//!   over loopback, on a database of `MODALWATCH_BENCH_BATCHES` batches (default 1 000 000), which is generated first and removed
//!   afterwards. Half of the batches belong to one structure.
//! - `engines` (only by name): the same database is generated as a SQLite file and moved to a PostgreSQL server on the same disk by `modalwatch
//!   migrate`; the queries are sent to both in turn, with the number of sequential scans that they cause on the server; then it is moved back,
//!   and the exports of both files are compared (up to 200,000 batches).
//! - `retention` (only by name): what is older than a day in 2020 is deleted by `retention.measurements_days` on both, beside ten posts a second.
//! - `replay`: stored batches assessed again after a new undamaged reference, on one thread and on all.
//!
//! Arguments after `--` select some of these; without arguments `queries` and `replay` run.

use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use modalwatch::assessment::BatchState;
use modalwatch::baseline::library::{find_structure, Library};
use modalwatch::measurement::{at_intervals, MeasurementBatch};
use modalwatch::monitor::compute::ComputeSettings;
use modalwatch::monitor::{Monitor, MonitorSettings, ReferenceChoice, ReferenceRequest};
use modalwatch::quantity::{Digest, StructureId, Timestamp};
use modalwatch::simulator::population::Population;
use modalwatch::stats;
use modalwatch::store::{HistoryQuery, Store, DATABASE_FILE};
use postgres::Server;
use rand::Rng as _;
use serde_json::json;
use sqlx::{AssertSqlSafe, Connection as _};
use sqlx_sqlite::{SqliteConnectOptions, SqliteConnection, SqliteJournalMode, SqliteSynchronous};

#[path = "../tests/zz_skipped/needs.rs"]
#[allow(dead_code, clippy::unwrap_used, reason = "shared with the tests")]
mod needs;
#[path = "../tests/postgres/server.rs"]
#[allow(dead_code, clippy::unwrap_used, reason = "shared with the tests, which fail by panicking")]
mod postgres;

/// Number of structures beside the large one; they share the other half of the batches.
const STRUCTURES: usize = 999;
/// Number of measurements of a generated batch.
const MEASUREMENTS: usize = 5;
/// Number of batches that one statement for each table inserts.
const AT_A_TIME: usize = 2_000;
/// Number of pages that are requested.
const PAGES: usize = 500;
/// Number of requests of the overview.
const OVERVIEWS: usize = 50;
/// Number of batches of the series.
const PLOTTED: i64 = 100_000;
/// Number of batches of the shorter series.
const PLOTTED_SHORT: i64 = 10_000;
/// Number of requests of the shorter series.
const SHORT_PLOTS: usize = 50;
/// Largest number of batches whose exports are compared.
const MOST_EXPORTED: usize = 200_000;
/// Posts beside the retention: interval, ms.
const BETWEEN_POSTS_MS: u64 = 100;
/// Delay of the first retention after the start of the service, which is `retention.every_s` up to half a minute.
const FIRST_RETENTION: Duration = Duration::from_secs(10);
/// Microseconds between batches of a structure: ten minutes.
const BETWEEN_US: i64 = 600_000_000;
/// 2020-01-01T00:00:00Z, µs.
const EPOCH_US: i64 = 1_577_836_800_000_000;

/// Number of batches that are assessed again, and of measurements in each.
const REPLAYED: usize = 600;
const OF_A_REPLAYED: usize = 20;

fn main() {
    let named: Vec<String> = std::env::args().skip(1).filter(|a| !a.starts_with("--")).collect();
    let wanted = |part: &str| named.is_empty() || named.iter().any(|name| name == part);
    let batches = std::env::var("MODALWATCH_BENCH_BATCHES").map_or(1_000_000, |text| text.parse().expect("a number"));
    let runtime = tokio::runtime::Runtime::new().expect("a runtime");
    if wanted("queries") {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let large = runtime.block_on(generate(folder.path(), batches));
        runtime.block_on(queries(folder.path(), large));
    }
    if named.iter().any(|name| name == "engines") {
        runtime.block_on(engines(batches));
    }
    if named.iter().any(|name| name == "retention") {
        runtime.block_on(retention(batches));
    }
    if wanted("replay") {
        let cores = std::thread::available_parallelism().map_or(1, usize::from);
        let one = runtime.block_on(replay(1));
        let all = runtime.block_on(replay(cores));
        println!("replay: {REPLAYED} batches of {OF_A_REPLAYED} measurements assessed again");
        println!("  1 thread {one:.0} batches/s, {cores} threads {all:.0} batches/s: {:.2} times", all / one);
    }
}

fn id_of(structure: usize) -> String {
    if structure == 0 {
        "large".to_owned()
    } else {
        format!("s{structure:04}")
    }
}

/// Generates a database of `batches` batches as the service would have written them over years; returns the number of those of
/// the large structure.
async fn generate(folder: &Path, batches: usize) -> usize {
    let started = Instant::now();
    let store = Store::open(folder).await.expect("a store");
    let definition = find_structure("three-dof").expect("it is shipped").definition().canonical_json();
    for structure in 0..=STRUCTURES {
        let id = id_of(structure);
        let json = definition.replace("\"three-dof\"", &format!("\"{id}\""));
        let digest = Digest::of_file(json.as_bytes());
        let id = StructureId::parse(&id).expect("an id");
        store.structures().put_structure(&id, &json, &digest, modalwatch::clock::now()).await.expect("a structure");
    }
    store.close().await;
    drop(store);
    let options = SqliteConnectOptions::new()
        .filename(folder.join(DATABASE_FILE))
        .journal_mode(SqliteJournalMode::Off)
        .synchronous(SqliteSynchronous::Off)
        .pragma("cache_size", "-400000");
    let mut connection = SqliteConnection::connect_with(&options).await.expect("a connection");
    let (mut written, mut large) = (0, 0);
    let mut of_structure = vec![0_i64; STRUCTURES + 1];
    let mut frequencies = vec![];
    for wave in 0..32 {
        let wave = 1.0 + 0.01 * f64::from(wave).sin();
        frequencies.push([0.495 * wave, 0.925 * wave, 1.243 * wave].to_vec());
    }
    while written < batches {
        let count = AT_A_TIME.min(batches - written);
        // Every second batch belongs to the large structure; the times of all structures advance together.
        let of = |i: usize| if i.is_multiple_of(2) { 0 } else { 1 + (i / 2) % STRUCTURES };
        let rows: Vec<_> = (written..written + count)
            .map(|i| {
                let structure = of(i);
                let number = of_structure[structure];
                of_structure[structure] += 1;
                large += usize::from(structure == 0);
                generated(structure, number, i, &frequencies[i % frequencies.len()])
            })
            .collect();
        insert(&mut connection, &serde_json::to_string(&rows).expect("plain data")).await;
        written += count;
    }
    connection.close().await.expect("it closes");
    let bytes = std::fs::metadata(folder.join(DATABASE_FILE)).expect("a file").len();
    println!(
        "database: {batches} batches of {MEASUREMENTS} measurements, {} structures, {large} batches of one of them",
        STRUCTURES + 1
    );
    println!("  {:.2} GB, made in {:.0} s", bytes as f64 / 1e9, started.elapsed().as_secs_f64());
    large
}

/// The values of a batch that the statements of [`insert`] use.
fn generated(structure: usize, number: i64, index: usize, frequencies: &[f64]) -> serde_json::Value {
    let start = Timestamp::from_micros(EPOCH_US + BETWEEN_US * number).expect("a time");
    let id = StructureId::parse(&id_of(structure)).expect("an id");
    let rows = vec![frequencies.to_vec(); MEASUREMENTS];
    let measurements = at_intervals(&rows, start, 10, None).expect("measurements");
    let source = "logger".to_owned();
    let batch = MeasurementBatch { structure: id, source, idempotency_key: None, posted_by: None, measurements };
    let hex = |values: &[f64]| {
        let bytes: Vec<u8> = values.iter().flat_map(|value| value.to_le_bytes()).collect();
        data_encoding::HEXLOWER.encode(&bytes)
    };
    let wave = (index as f64 * 0.37).sin();
    // The packed column for plots: trust, then each quantity in the order of the statement of `insert`.
    let mut plotted = vec![0.25, 0.0, 1.0];
    for mean in [4.0, 5.0, 6.0] {
        let mean = mean + 0.1 * wave;
        plotted.extend([mean, mean - 0.1, mean + 0.1, 0.02 + 0.01 * wave, 0.01, 0.05]);
    }
    json!([
        batch.structure.to_string(),
        format!("01890000-0000-7000-8000-{index:012}"),
        start.micros(),
        batch.content_digest().to_string(),
        hex(frequencies),
        wave,
        hex(&plotted)
    ])
}

/// Inserts generated batches with their measurements, assessments and chart points.
async fn insert(connection: &mut SqliteConnection, rows: &str) {
    let trust = r#"{"verdict":"accepted","p_value":0.25,"distance":1.1,"degrees_of_freedom":12,"findings":[
        {"code":"outlier","effect":"note","message":"one of them, far from the others","measurements":[2]}]}"#;
    let given = "with r as (select value ->> 0 as s, value ->> 1 as id, value ->> 2 as at, value ->> 3 as digest,
                                value ->> 4 as hex, value ->> 5 as wave, value ->> 6 as plotted from json_each(?1))";
    let steps: Vec<String> = (0..MEASUREMENTS).map(|i| format!("({i})")).collect();
    let last = 10_000_000 * (MEASUREMENTS - 1);
    let digest = "m".repeat(64);
    let statements = [
        format!(
            "insert into measurement_batch select s, id, 'logger', null, digest, at + 60000000, at, at + {last},
             {MEASUREMENTS}, 'assessed', null, null from r"
        ),
        format!(
            "insert into measurement select s, id, k.column1, 'logger', at + k.column1 * 10000000, unhex(hex), null,
             '{{}}', '{{}}', null from r, (values {}) k",
            steps.join(", ")
        ),
        format!(
            "insert into assessment select s, id, '{digest}', 0, '{digest}', 1, 10, {MEASUREMENTS}, 0, 0, unhex(hex),
             at + 60000000, 40.0, '{trust}', unhex(plotted), null from r"
        ),
        format!(
            "insert into quantity_assessment select s, id, '{digest}', 0, k.column1, k.column2, 'N/m', 'parameter',
                 k.column3 + 0.1 * wave, 0.1, 0.01, 0.01, 0.0, 3.5, 0.02 + 0.01 * wave, 0, 0.01 * wave,
                 k.column3 - 0.1 + 0.1 * wave, k.column3 + 0.1 + 0.1 * wave, 0.1, 0.2, k.column3, 0.1, 0.01, 0.05, 0.02,
                 -0.1, 0.1, null
             from r, (values ('k1', 0, 4.0), ('k2', 1, 5.0), ('k3', 2, 6.0)) k"
        ),
        format!(
            "insert into chart_point select s, 0, k.column1, at + {last}, id, wave, 3.0, 1.0, 0.3, 0, 0.2 * wave, 0,
             'normal', null from r, (values ('k1'), ('k2'), ('k3'), ('simulation:fit')) k"
        ),
    ];
    let mut transaction = connection.begin().await.expect("a transaction");
    for statement in statements {
        let (table, select) = statement.split_once(" select ").expect("one of the above");
        sqlx::query(AssertSqlSafe(format!("{table} {given} select {select}")))
            .bind(rows)
            .execute(&mut *transaction)
            .await
            .expect("rows");
    }
    transaction.commit().await.expect("a commit");
}

/// The program on a database.
struct Program {
    process: std::process::Child,
    url: String,
    client: reqwest::Client,
}

impl Program {
    /// Starts it on the file of a folder, or on a database of a server.
    fn start(folder: &Path, url: Option<&str>, settings: &[(&str, &str)]) -> Self {
        let mut process = modalwatch(&["serve", "--listen", "127.0.0.1:0", "--data-dir"])
            .arg(folder)
            .env("MODALWATCH__LOG__LEVEL", "error")
            .env("MODALWATCH__HTTP__RATE_LIMIT__REQUESTS_PER_S", "0")
            .envs(url.map(|url| ("MODALWATCH__STORE__URL", url)))
            .envs(settings.iter().copied())
            .stdout(Stdio::piped())
            .spawn()
            .expect("the service starts");
        let mut line = String::new();
        BufReader::new(process.stdout.take().expect("it was piped")).read_line(&mut line).expect("it says its address");
        let url = line.trim().rsplit(' ').next().expect("the address is its last word").to_owned();
        Self { process, url, client: modalwatch::notify::client_builder().build().expect("a client can be made") }
    }

    /// Milliseconds until an answer is complete, and the answer.
    async fn get(&self, path: &str) -> (f64, Vec<u8>) {
        let started = Instant::now();
        let response = self.client.get(format!("{}{path}", self.url)).send().await.expect("the service answers");
        assert_eq!(response.status(), 200, "{path}");
        let bytes = response.bytes().await.expect("the answer is complete");
        (started.elapsed().as_secs_f64() * 1e3, bytes.to_vec())
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// The program with arguments.
fn modalwatch(arguments: &[&str]) -> Command {
    let program = std::env::var("MODALWATCH_BENCH_PROGRAM");
    let mut command = Command::new(program.as_deref().unwrap_or(env!("CARGO_BIN_EXE_modalwatch")));
    command.args(arguments);
    command
}

/// The paths of pages of the history at random places.
fn pages(large: usize) -> Vec<String> {
    let mut stream = stats::stream(20_260_301, "pages that somebody looks at");
    let mut page = |number: usize| {
        let (structure, length) = if number.is_multiple_of(2) {
            (0, large)
        } else {
            (stream.random_range(1..=STRUCTURES), large / STRUCTURES)
        };
        let place = stream.random_range(0..length.max(1)) as i64;
        // The cursor of the previous page.
        let cursor = format!("{}~01890000-0000-7000-8000-000000000000", EPOCH_US + BETWEEN_US * place);
        format!("/v1/structures/{}/history?cursor={cursor}", id_of(structure))
    };
    (0..PAGES).map(&mut page).collect()
}

/// The path of the series of this many batches of the large structure.
fn series(batches: i64) -> String {
    let to = Timestamp::from_micros(EPOCH_US + BETWEEN_US * batches).expect("a time");
    format!("/v1/structures/large/series?to={to}")
}

/// Sends the queries to the program itself.
async fn queries(folder: &Path, large: usize) {
    let started = Instant::now();
    let service = Program::start(folder, None, &[]);
    println!("  the service is ready after {:.0} s, including its check of the file", started.elapsed().as_secs_f64());
    ask(&[("", &service)], large).await;
}

/// Sends each query to several services in turn.
async fn ask(services: &[(&str, &Program)], large: usize) {
    let longest = PLOTTED.min(large as i64);
    let kinds = [
        (format!("history page of 100 batches, {PAGES} at random places"), pages(large)),
        (
            format!("overview of {} structures, {OVERVIEWS} times", STRUCTURES + 2),
            vec!["/v1/overview".to_owned(); OVERVIEWS],
        ),
        (
            format!("series of {} batches, {SHORT_PLOTS} times", PLOTTED_SHORT.min(longest)),
            vec![series(PLOTTED_SHORT.min(longest)); SHORT_PLOTS],
        ),
        (format!("series of {longest} batches, 5 times"), vec![series(longest); 5]),
    ];
    for (what, paths) in kinds {
        let mut latencies_ms = vec![Vec::new(); services.len()];
        for path in paths {
            let mut first: Option<String> = None;
            for ((_, service), latencies_ms) in services.iter().zip(&mut latencies_ms) {
                let (latency_ms, answer) = service.get(&path).await;
                latencies_ms.push(latency_ms);
                let answer = String::from_utf8(answer).expect("JSON");
                let expected = first.get_or_insert_with(|| answer.clone());
                let differs = expected.bytes().zip(answer.bytes()).position(|(a, b)| a != b);
                assert!(
                    *expected == answer,
                    "{path}: the answers of {} and {} bytes differ from byte {differs:?}",
                    expected.len(),
                    answer.len()
                );
            }
        }
        for ((engine, _), latencies_ms) in services.iter().zip(latencies_ms) {
            println!("{engine}{what}: {}", quantiles(latencies_ms));
        }
    }
}

/// Moves data and prints time and memory.
fn moved(from: &str, to: &str) {
    let started = Instant::now();
    let mut moving = modalwatch(&["migrate", "--from", from, "--to", to, "--json"])
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .expect("the program runs");
    let mut peak = String::new();
    let status = loop {
        let memory = std::fs::read_to_string(format!("/proc/{}/status", moving.id())).unwrap_or_default();
        if let Some(line) = memory.lines().find_map(|line| line.strip_prefix("VmHWM:")) {
            line.trim().clone_into(&mut peak);
        }
        match moving.try_wait().expect("it was started here") {
            Some(status) => break status,
            None => std::thread::sleep(Duration::from_millis(100)),
        }
    };
    assert!(status.success(), "{from} to {to}");
    let seconds = started.elapsed().as_secs_f64();
    let said: serde_json::Value = serde_json::from_reader(moving.stdout.take().expect("it was piped")).expect("JSON");
    let rows: u64 = said["tables"].as_array().expect("tables").iter().filter_map(|table| table["rows"].as_u64()).sum();
    println!(
        "  moved {rows} rows in {seconds:.0} s, {:.0} rows/s, compared in every row; peak memory {peak}",
        rows as f64 / seconds
    );
}

/// A database on a server, moved there from a folder; its URL.
fn on_server(server: &Server, folder: &Path) -> String {
    let url = server.database_of(folder);
    moved(&format!("sqlite:{}", folder.display()), &url);
    let name = url.rsplit_once('/').expect("a path").1;
    // The server does this by itself some minutes later.
    server.sql(name, "vacuum analyze");
    let tables = "select relname || ' ' || pg_size_pretty(pg_total_relation_size(c.oid)) from pg_class c
                  join pg_namespace n on n.oid = relnamespace where nspname = 'modalwatch' and relkind in ('r', 'p')
                  order by pg_total_relation_size(c.oid) desc limit 5";
    println!(
        "  {:.2} GB on the server: {}",
        server.sql(name, &format!("select pg_database_size('{name}')")).parse::<f64>().expect("a number") / 1e9,
        server.sql(name, tables).replace('\n', ", ")
    );
    url
}

/// The same data on both: queries in turn, and back again.
async fn engines(batches: usize) {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let large = generate(folder.path(), batches).await;
    let server = Server::start(&[]);
    let url = on_server(&server, folder.path());
    let name = url.rsplit_once('/').expect("a path").1.to_owned();
    // `n_live_tup` is reset together with the counts.
    let scans = "select coalesce(string_agg(s.relname || ' ' || seq_scan, ', ' order by s.relname), 'none')
                 from pg_stat_user_tables s join pg_class c on c.oid = s.relid where c.reltuples > 10000 and seq_scan > 0";
    {
        let file = Program::start(folder.path(), None, &[]);
        let data = tempfile::tempdir().expect("a temporary folder");
        let on_server = Program::start(data.path(), Some(&url), &[]);
        server.sql(&name, "select pg_stat_reset()");
        ask(&[("SQLite: ", &file), ("PostgreSQL: ", &on_server)], large).await;
        // The server counts at the latest ten seconds after a statement.
        tokio::time::sleep(Duration::from_secs(11)).await;
        println!(
            "sequential scans of tables with more than 10,000 rows during the queries: {}",
            server.sql(&name, scans)
        );
    }
    if batches > MOST_EXPORTED {
        return;
    }
    let back = tempfile::tempdir().expect("a temporary folder");
    moved(&url, &format!("sqlite:{}", back.path().display()));
    let mut exports = Vec::new();
    for folder in [folder.path(), back.path()] {
        let service = Program::start(folder, None, &[]);
        let mut lines = Vec::new();
        for structure in [0, 1, STRUCTURES] {
            let (_, export) = service.get(&format!("/v1/structures/{}/export", id_of(structure))).await;
            let text = String::from_utf8(export).expect("lines of JSON");
            // Without the time of the export, and the digest over all lines.
            lines.extend(
                text.lines()
                    .filter(|line| !line.contains("\"exported_at\"") && !line.contains("\"sha256\""))
                    .map(str::to_owned),
            );
        }
        exports.push(lines);
    }
    assert_eq!(exports[0].len(), exports[1].len());
    assert!(exports[0] == exports[1], "the exports differ");
    println!("there and back: {} lines of three exports are the same", exports[0].len());
}

/// Deletes what is older than a day in 2020 while posts come in, on both.
async fn retention(batches: usize) {
    let folder = tempfile::tempdir().expect("a temporary folder");
    generate(folder.path(), batches).await;
    let server = Server::start(&[]);
    let url = on_server(&server, folder.path());
    let data = tempfile::tempdir().expect("a temporary folder");
    let now_us = modalwatch::clock::now().micros();
    let days = ((now_us - EPOCH_US) / 86_400_000_000 - 1).to_string();
    let settings =
        [("MODALWATCH__RETENTION__MEASUREMENTS_DAYS", days.as_str()), ("MODALWATCH__RETENTION__EVERY_S", "10")];
    let mut next = 0;
    for (engine, folder, url) in [("SQLite", folder.path(), None), ("PostgreSQL", data.path(), Some(url.as_str()))] {
        let quiet = Program::start(folder, url, &[]);
        let (latencies_ms, _, _) = posts(&quiet, &mut next, Some(Duration::from_secs(20))).await;
        println!("{engine}: posts without retention: {}", quantiles(latencies_ms));
        drop(quiet);
        let busy = Program::start(folder, url, &settings);
        let (latencies_ms, deleted, seconds) = posts(&busy, &mut next, None).await;
        println!("  with retention: {}", quantiles(latencies_ms));
        println!("  {deleted} batches deleted in {seconds:.0} s, {:.0} batches/s", deleted as f64 / seconds);
    }
    let name = url.rsplit_once('/').expect("a path").1;
    let size = format!("select pg_database_size('{name}') / 1e9");
    println!("size on the server after it: {} GB", server.sql(name, &size));
    server.sql(name, "vacuum");
    println!("dead rows after a vacuum: {}", server.sql(name, "select sum(n_dead_tup) from pg_stat_user_tables"));
}

/// Posts small batches at a constant rate, for some time or until retention, which begins after [`FIRST_RETENTION`], has run. Their
/// latencies, what was deleted, and the time.
async fn posts(service: &Program, next: &mut u64, limit: Option<Duration>) -> (Vec<f64>, u64, f64) {
    let started = Instant::now();
    let mut latencies_ms = Vec::new();
    let mut interval = tokio::time::interval(Duration::from_millis(BETWEEN_POSTS_MS));
    loop {
        interval.tick().await;
        let start = Timestamp::from_micros(1_767_225_600_000_000 + BETWEEN_US * *next as i64).expect("a time");
        *next += 1;
        let rows: Vec<_> = (0..MEASUREMENTS as i64)
            .map(|i| {
                let at = Timestamp::from_micros(start.micros() + 1_000_000 * i).expect("a time");
                json!({ "measured_at": at, "frequencies_hz": [0.4695 + 0.0003 * i as f64, 0.9209, 1.2361] })
            })
            .collect();
        let posted = Instant::now();
        let request = service.client.post(format!("{}/v1/structures/three-dof/batches", service.url));
        let response = request.json(&json!({ "measurements": rows })).send().await.expect("the service answers");
        assert_eq!(response.status(), 201);
        response.bytes().await.expect("the answer is complete");
        if limit.is_some() || started.elapsed() > FIRST_RETENTION {
            latencies_ms.push(posted.elapsed().as_secs_f64() * 1e3);
        }
        if limit.is_some_and(|limit| started.elapsed() > limit) {
            return (latencies_ms, 0, started.elapsed().as_secs_f64());
        }
        if limit.is_none() && next.is_multiple_of(20) {
            let (_, answer) = service.get("/v1/retention?days=0").await;
            let plan: serde_json::Value = serde_json::from_slice(&answer).expect("JSON");
            if let Some(deleted) = plan["last_run"]["deleted"]["batches"].as_u64() {
                return (latencies_ms, deleted, started.elapsed().saturating_sub(FIRST_RETENTION).as_secs_f64());
            }
        }
    }
}

fn quantiles(mut latencies_ms: Vec<f64>) -> String {
    latencies_ms.sort_by(f64::total_cmp);
    let [p50, p99, most] = [0.5, 0.99, 1.0].map(|level| stats::quantile(&latencies_ms, level));
    format!("p50 {p50:.1} ms, p99 {p99:.1} ms, largest {most:.1} ms")
}

/// Number of batches per second that are assessed again with this number of threads.
async fn replay(threads: usize) -> f64 {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let store = Store::open(folder.path()).await.expect("a store");
    let compute = ComputeSettings { threads, ..ComputeSettings::default() };
    let settings = MonitorSettings { compute, ..MonitorSettings::default() };
    let monitor = Monitor::open(store, Library::open(None).expect("shipped"), settings).await.expect("a monitor");
    let structure = StructureId::parse("three-dof").expect("an id");
    let simulator = find_structure("three-dof").expect("it is shipped");
    let moments = [("k1", 4.0, 0.3), ("k2", 5.0, 0.1), ("k3", 6.0, 0.2)].map(|(n, m, s)| (n.to_owned(), m, s));
    let population = Population::new(simulator.space(), &moments).expect("all parameters are named");
    let mut first = None;
    for number in 0..REPLAYED {
        let drawn = population.draw(&simulator, OF_A_REPLAYED, 1.0, number as u64).expect("a physical population");
        let rows: Vec<Vec<f64>> = drawn.frequencies_hz.row_iter().map(|row| row.iter().copied().collect()).collect();
        let start = Timestamp::from_micros(EPOCH_US + BETWEEN_US * number as i64).expect("a time");
        let measurements = at_intervals(&rows, start, 1, None).expect("measurements");
        let (structure, source) = (structure.clone(), "logger".to_owned());
        let batch = MeasurementBatch { structure, source, idempotency_key: None, posted_by: None, measurements };
        let taken = monitor.ingest().take(batch).await.expect("the batch is accepted");
        first.get_or_insert(taken.view.record.batch_id);
    }
    let started = Instant::now();
    // All other batches are assessed again under this reference.
    monitor
        .replay()
        .declare_reference(
            &structure,
            ReferenceRequest {
                choice: ReferenceChoice::Batches(first.into_iter().collect()),
                leave_out_doubtful: false,
                threshold_probability: 0.05,
                reason: None,
            },
        )
        .await
        .expect("an undamaged reference");
    let waiting = async || !monitor.store().batches().pending(&structure, 1).await.expect("an answer").is_empty();
    while waiting().await {
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    let seconds = started.elapsed().as_secs_f64();
    let query = HistoryQuery { limit: REPLAYED, ..HistoryQuery::default() };
    let history = monitor.store().history().page(&structure, &query).await.expect("a history");
    let compared = |entry: &modalwatch::store::HistoryEntry| {
        entry.assessment.as_ref().is_some_and(|assessment| assessment.undamaged_version == Some(1))
    };
    assert!(history.iter().all(|entry| entry.state == BatchState::Assessed), "some batches failed");
    assert_eq!(history.iter().filter(|entry| compared(entry)).count(), REPLAYED - 1);
    monitor.store().close().await;
    (REPLAYED - 1) as f64 / seconds
}
