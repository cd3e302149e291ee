//! Slow, idle, disconnected, numerous or hostile clients: the others are still served.

use std::collections::BTreeMap;
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::sync::Arc;
use std::time::{Duration, Instant};

use serde_json::Value;

use crate::faults::kit::{
    all_assessed, audit, batch, body, history, open_files, post, ready, resident_mib, Acknowledged, BATCHES,
};
use crate::helpers::{command, problem, spawn, Service, PATIENCE};
use crate::needs;

/// Bytes of a request that posts a batch.
fn request(number: usize) -> Vec<u8> {
    let text = body(&batch("gone", number, 10)).to_string();
    let length = text.len();
    let head = format!(
        "POST {BATCHES} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: {length}\r\n\r\n"
    );
    [head.into_bytes(), text.into_bytes()].concat()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn clients_that_disconnect_midway_leave_complete_batches_and_a_working_writer() {
    let (mut service, folder) = spawn();
    for number in 0..60 {
        let bytes = request(number);
        let mut stream = TcpStream::connect(service.address()).unwrap();
        // The request is cut in the header, in the body, or after it, while the batch is being stored.
        let cut = if number % 2 == 0 { bytes.len() } else { bytes.len() * (number % 7 + 1) / 9 };
        stream.write_all(&bytes[..cut]).unwrap();
        std::thread::sleep(Duration::from_micros(300 * (number as u64 % 10)));
        drop(stream);
    }
    let mut acknowledged = Acknowledged::default();
    for number in 0..10 {
        let given = batch("stays", number, 10);
        let (status, answer) = post(&service, &given).await.unwrap();
        assert_eq!(status, 201, "{answer}");
        acknowledged.add(&given, &answer);
    }
    // Complete posts are stored although the client did not wait for the answer; incomplete ones are not.
    let stored = history(&service).await.len();
    assert!((20..=40).contains(&stored), "{stored} stored of 10 and 30 whole ones");
    all_assessed(&service).await;
    assert!(ready(&service).await.0);
    assert!(service.stop("TERM").success());
    audit(folder.path(), &acknowledged).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn idle_and_slow_connections_are_cut_off_and_others_are_served() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = command(folder.path());
    command.env("MODALWATCH__HTTP__HEADER_TIMEOUT_S", "1").env("MODALWATCH__HTTP__BODY_TIMEOUT_S", "1");
    let service = Service::spawn(command.env("MODALWATCH__HTTP__MAX_CONNECTIONS", "32"));
    let before = open_files(service.pid());
    let mut held = Vec::new();
    for number in 0..120 {
        let mut stream = TcpStream::connect(service.address()).unwrap();
        match number % 3 {
            0 => {}
            1 => stream.write_all(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nX-Slow: ").unwrap(),
            _ => stream.write_all(&request(number)[..300]).unwrap(),
        }
        held.push(stream);
    }
    // All connections are in use and more than twice as many wait; nevertheless each client is served.
    let given = batch("patient", 0, 5);
    let started = Instant::now();
    let (status, answer) = post(&service, &given).await.unwrap();
    assert_eq!(status, 201, "{answer}");
    // Three rounds of connections are before it, each of which would hold its place for 10 s and more with the time limits of the defaults.
    assert!(started.elapsed() < Duration::from_secs(28), "it waited for {:?}", started.elapsed());
    // The service ended each connection: a read returns the end or an answer and does not block.
    for mut stream in held {
        stream.set_read_timeout(Some(PATIENCE)).unwrap();
        let mut answer = Vec::new();
        let ended = stream.read_to_end(&mut answer);
        let reset = ended.as_ref().is_err_and(|e| e.kind() == std::io::ErrorKind::ConnectionReset);
        assert!(ended.is_ok() || reset, "{ended:?}");
    }
    let after = open_files(service.pid());
    assert!(after <= before + 8, "{before} files were open, now {after}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 4)]
async fn a_burst_is_answered_with_201_429_or_503_and_nothing_accepted_is_lost() {
    let (service, folder) = spawn();
    let service = Arc::new(service);
    let tasks: Vec<_> = (0..400)
        .map(|number| {
            let service = Arc::clone(&service);
            tokio::spawn(async move {
                let given = batch("burst", number, 5);
                let request = service.request(reqwest::Method::POST, BATCHES).json(&body(&given));
                let response = request.send().await.unwrap();
                let status = response.status().as_u16();
                let retry_after = response.headers().get("retry-after").cloned();
                (given, status, retry_after, response.json::<Value>().await.unwrap())
            })
        })
        .collect();
    let started = Instant::now();
    let page = service.read("/v1/structures/three-dof/history?limit=10").await;
    assert!(page["items"].is_array() && started.elapsed() < Duration::from_secs(20), "{:?}", started.elapsed());
    let (mut acknowledged, mut counts) = (Acknowledged::default(), BTreeMap::<u16, usize>::new());
    for task in tasks {
        let (given, status, retry_after, answer) = task.await.unwrap();
        *counts.entry(status).or_default() += 1;
        match status {
            201 => acknowledged.add(&given, &answer),
            429 | 503 => assert!(retry_after.is_some(), "{answer}"),
            _ => panic!("{status}: {answer}"),
        }
    }
    println!("answers: {counts:?}");
    assert!(counts[&201] >= 20, "{counts:?}");
    all_assessed(&service).await;
    assert_eq!(history(&service).await, acknowledged.0.keys().cloned().collect());
    let mut service = Arc::into_inner(service).unwrap();
    assert!(service.stop("TERM").success());
    audit(folder.path(), &acknowledged).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn nested_swollen_and_compressed_bodies_are_refused_in_flat_memory() {
    let (service, _folder) = spawn();
    let service = Arc::new(service);
    // The memory after a round varies by about 50 MiB, because the allocator returns memory late. So the maximum after the first
    // three rounds, in which each thread reads a body, is compared with the minimum after the last three.
    let (mut early, mut late) = (0.0_f64, f64::INFINITY);
    for round in 0..9 {
        let deep = format!("{{\"measurements\": {}", "[".repeat(1_000_000));
        let objects = "{\"measurements\":".repeat(200_000);
        let zeros = format!("{{\"measurements\": [{}0]}}", "0,".repeat(1_500_000));
        let text = format!("{{\"source\": \"{}\", \"measurements\": []}}", "x".repeat(4_000_000));
        let cells = format!("measured_at,f1_hz,f2_hz,f3_hz\n{}", ",".repeat(4_000_000));
        let lines = format!("measured_at,f1_hz,f2_hz,f3_hz\n{}", "\n,,,".repeat(900_000));
        let large = "[".repeat(20 << 20);
        let json = [deep, objects, zeros, text, large].map(|text| ("application/json", text));
        let csv = [cells, lines].map(|text| ("text/csv", text));
        let mut tasks = Vec::new();
        for (kind, text) in json.into_iter().chain(csv) {
            let service = Arc::clone(&service);
            tasks.push(tokio::spawn(async move { service.post_text(BATCHES, kind, text).await.status().as_u16() }));
        }
        for task in tasks {
            let status = task.await.unwrap();
            assert!([400, 413, 422].contains(&status), "{status}");
        }
        // A gzip bomb is not unpacked: one megabyte would become one gigabyte.
        // Its body is not read either, so the connection is closed after the answer. It therefore has a separate connection.
        let bomb = modalwatch::notify::client_builder()
            .build()
            .unwrap()
            .post(format!("http://{}{BATCHES}", service.address()));
        let bomb = bomb.header("content-encoding", "gzip");
        let bomb = bomb.header("content-type", "application/json").body(gzip_of_zeros(1 << 20));
        problem(bomb.send().await.unwrap(), 415, "unsupported_encoding").await;
        let now = resident_mib(service.pid());
        match round {
            0..=2 => early = early.max(now),
            6..=8 => late = late.min(now),
            _ => {}
        }
    }
    println!("memory at most {early:.0} MiB in the first three rounds, at least {late:.0} MiB in the last three");
    // The four rounds in between send about 180 MiB; if their bodies were kept, the memory would show it.
    assert!(late < early + 90.0 && late < 500.0, "{early:.0} MiB, then {late:.0} MiB");
    assert_eq!(history(&service).await.len(), 0);
}

/// `length` bytes of a gzip stream that unpacks to a thousand times as much: deflate blocks that contain only repetitions.
fn gzip_of_zeros(length: usize) -> Vec<u8> {
    let head = [0x1f, 0x8b, 8, 0, 0, 0, 0, 0, 0, 3, 0xec, 0xc1, 1, 0];
    head.into_iter().chain(std::iter::repeat(0)).take(length).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn with_few_file_handles_connections_wait_and_the_database_still_opens() {
    if needs::program("prlimit").is_none() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let plain = command(folder.path());
    let mut limited = std::process::Command::new("prlimit");
    limited.arg("--nofile=96:96").arg(plain.get_program()).args(plain.get_args());
    limited.env("MODALWATCH__LOG__LEVEL", "warn").env("MODALWATCH__HTTP__HEADER_TIMEOUT_S", "2");
    let mut service = Service::spawn(&mut limited);
    let mut idle: Vec<TcpStream> = (0..150).map(|_| TcpStream::connect(service.address()).unwrap()).collect();
    let mut acknowledged = Acknowledged::default();
    for number in 0..8 {
        let given = batch("few", number, 5);
        let (status, answer) = post(&service, &given).await.unwrap();
        assert_eq!(status, 201, "{answer}");
        acknowledged.add(&given, &answer);
        // Database connections of readers are opened when they are first needed.
        let reads = (0..4).map(|_| service.get("/v1/structures/three-dof/history").send());
        for read in reads.map(|read| tokio::spawn(async move { read.await.unwrap().status().as_u16() })) {
            assert_eq!(read.await.unwrap(), 200);
        }
        // Idle clients connect again whenever they are disconnected.
        idle.push(TcpStream::connect(service.address()).unwrap());
    }
    assert!(open_files(service.pid()) < 96);
    drop(idle);
    assert!(ready(&service).await.0);
    assert!(service.stop("TERM").success());
    audit(folder.path(), &acknowledged).await;
}
