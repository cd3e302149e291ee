//! Start, stop, health, and the conditions under which the service does not start.

use std::io::{Read as _, Write as _};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::Arc;
use std::time::{Duration, Instant};

use serde_json::json;

use crate::helpers::{command, created, eventually, measurements, problem, refusal, spawn, Service, PATIENCE};

#[tokio::test]
async fn health_readiness_version_and_metrics_are_answered() {
    let (service, _folder) = spawn();
    assert_eq!(service.read("/healthz").await["status"], "alive");
    let ready = service.read("/readyz").await;
    assert_eq!((&ready["ready"], &ready["reasons"]), (&json!(true), &json!([])), "{ready}");
    assert_eq!(ready["baselines_in_use"], 3);
    let version = service.read("/version").await;
    assert_eq!(version["version"], env!("CARGO_PKG_VERSION"));
    service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 2, 0)).await;
    let text = service.get("/metrics").send().await.unwrap().text().await.unwrap();
    for line in [
        "modalwatch_assessments_total 1",
        "route=\"/v1/structures/{id}/batches\",status=\"201\"} 1",
        "modalwatch_baselines_in_use 3",
        "modalwatch_http_request_seconds_bucket",
    ] {
        assert!(text.contains(line), "{line} is missing:\n{text}");
    }
}

/// Every transaction adds at least one page to the write-ahead log, so the log counts them. A service that has just begun may write for other
/// reasons, too, which are few pages beside the 300 of a transaction for each request; a unit test counts the transactions alone.
#[tokio::test]
async fn requests_for_readiness_use_the_writer_at_most_once_a_second() {
    const PAGE_BYTES: u64 = 4_096;
    const FOR_OTHER_REASONS: u64 = 30;
    let (service, folder) = spawn();
    let log = folder.path().join("modalwatch.sqlite-wal");
    service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 2, 0)).await;
    let (started, before) = (Instant::now(), std::fs::metadata(&log).unwrap().len());
    for path in ["/readyz", "/metrics"].repeat(150) {
        assert!(service.get(path).send().await.unwrap().status().is_success());
    }
    let pages = (std::fs::metadata(&log).unwrap().len() - before) / PAGE_BYTES;
    let most = 1 + started.elapsed().as_secs() + FOR_OTHER_REASONS;
    assert!((1..=most).contains(&pages), "{pages} pages were written, at most {most} would be right");
}

#[tokio::test]
async fn the_clients_request_id_comes_back_and_a_strange_one_is_replaced() {
    let (service, _folder) = spawn();
    let ask = |id: &'static str| service.get("/healthz").header("x-request-id", id).send();
    assert_eq!(ask("abc-1").await.unwrap().headers()["x-request-id"], "abc-1");
    let replaced = ask("a b c").await.unwrap().headers()["x-request-id"].to_str().unwrap().to_owned();
    assert_eq!(replaced.len(), 36, "{replaced}");
}

#[tokio::test]
async fn a_full_queue_is_a_503_with_retry_after_and_stores_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = command(folder.path());
    let service = Service::spawn(command.env("MODALWATCH__MONITOR__COMPUTE__QUEUE", "1"));
    let service = Arc::new(service);
    let tasks: Vec<_> = (0..16)
        .map(|i| {
            let service = Arc::clone(&service);
            let body = json!({ "measurements": measurements([4.0, 5.0, 6.0], 20, i * 86_400) });
            tokio::spawn(async move { service.post("/v1/structures/three-dof/batches", &body).await })
        })
        .collect();
    let (mut taken, mut refused) = (0, 0);
    for task in tasks {
        let response = task.await.unwrap();
        if response.status() == 503 {
            assert_eq!(response.headers()["retry-after"], "1");
            problem(response, 503, "queue_full").await;
            refused += 1;
        } else {
            created(response).await;
            taken += 1;
        }
    }
    assert!(taken > 0 && refused > 0, "{taken} taken, {refused} refused");
    let history = service.read("/v1/structures/three-dof/history").await;
    assert_eq!(history["items"].as_array().unwrap().len(), taken);
}

#[tokio::test]
async fn a_client_that_never_ends_its_header_is_cut_off_and_does_not_keep_the_service_from_stopping() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = command(folder.path());
    let mut service = Service::spawn(command.env("MODALWATCH__HTTP__HEADER_TIMEOUT_S", "1"));
    let mut slow = std::net::TcpStream::connect(service.address()).unwrap();
    slow.write_all(b"GET /healthz HTTP/1.1\r\nHost: localhost\r\nX-Slow: ").unwrap();
    slow.set_read_timeout(Some(PATIENCE)).unwrap();
    let started = Instant::now();
    let mut answer = Vec::new();
    let ended = slow.read_to_end(&mut answer);
    // With the time limit of the defaults it would be held for 10 s.
    assert!(started.elapsed() < Duration::from_secs(9), "it was held for {:?}: {ended:?}", started.elapsed());

    let mut another = std::net::TcpStream::connect(service.address()).unwrap();
    another.write_all(b"GET /healthz HTTP/1.1\r\n").unwrap();
    let started = Instant::now();
    assert!(service.stop("TERM").success());
    // An open request has 30 s.
    assert!(started.elapsed() < Duration::from_secs(25), "stopping took {:?}", started.elapsed());
}

#[tokio::test]
async fn a_client_that_never_ends_its_body_is_answered_408() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = command(folder.path());
    let service = Service::spawn(command.env("MODALWATCH__HTTP__BODY_TIMEOUT_S", "1"));
    let mut slow = std::net::TcpStream::connect(service.address()).unwrap();
    let head = "POST /v1/structures/three-dof/batches HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 100\r\n\r\n{";
    slow.write_all(head.as_bytes()).unwrap();
    slow.set_read_timeout(Some(PATIENCE)).unwrap();
    let mut answer = [0; 12];
    slow.read_exact(&mut answer).unwrap();
    assert_eq!(&answer, b"HTTP/1.1 408");
}

#[tokio::test]
async fn sigterm_under_load_answers_what_was_taken_and_exits_with_0() {
    let (mut service, folder) = spawn();
    let client = service.client.clone();
    let url = format!("http://{}/v1/structures/three-dof/batches", service.address());
    let answered = Arc::new(AtomicUsize::new(0));
    let posts: Vec<_> = (0..40)
        .map(|i| {
            let body = json!({ "measurements": measurements([4.0, 5.0, 6.0], 20, i * 20_000) });
            let post = client.post(&url).json(&body).send();
            let answered = Arc::clone(&answered);
            tokio::spawn(async move {
                let taken = post.await.is_ok_and(|r| r.status() == 201);
                answered.fetch_add(1, Ordering::Relaxed);
                taken
            })
        })
        .collect();
    eventually("an answer", async || (answered.load(Ordering::Relaxed) > 0).then_some(())).await;
    let status = tokio::task::spawn_blocking(move || service.stop("TERM")).await.unwrap();
    assert!(status.success(), "{status}");
    let mut taken = 0;
    for post in posts {
        taken += usize::from(post.await.unwrap());
    }
    let service = Service::start(folder.path());
    let history = service.read("/v1/structures/three-dof/history").await;
    assert!(history["items"].as_array().unwrap().len() >= taken, "{taken} were answered 201");
}

#[tokio::test]
async fn the_reason_why_the_service_cannot_start_is_reported() {
    let (service, used) = spawn();
    let folder = tempfile::tempdir().unwrap();
    let mut taken = command(folder.path());
    let text = refusal(taken.args(["--listen", service.address()]).env_remove("X"));
    assert!(text.contains("the argument '--listen"), "{text}");
    let mut taken = std::process::Command::new(env!("CARGO_BIN_EXE_modalwatch"));
    let text = refusal(taken.args(["serve", "--listen", service.address(), "--data-dir"]).arg(folder.path()));
    assert!(text.contains("cannot listen on") && text.contains("--listen"), "{text}");

    let text = refusal(&mut command(used.path()));
    assert!(text.contains("in use by another modalwatch"), "{text}");
    let text = refusal(command(folder.path()).args(["--models", "/no/such/folder"]));
    assert!(text.contains("/no/such/folder"), "{text}");
    let text = refusal(command(folder.path()).env("MODALWATCH__HTTP__LISTN", "x"));
    assert!(text.to_lowercase().contains("listn"), "{text}");
    let text = refusal(command(folder.path()).env("MODALWATCH__MONITOR__COMPUTE__QUEUE", "0"));
    assert!(text.contains("monitor.compute.queue is 0"), "{text}");
    let text = refusal(command(folder.path()).env("MODALWATCH__LOG__LEVEL", "=="));
    assert!(text.contains("log.level"), "{text}");
}

#[tokio::test]
async fn a_database_that_is_not_ours_or_cannot_be_written_is_refused_and_left_as_it_is() {
    let with_file = |bytes: &[u8]| {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("modalwatch.sqlite"), bytes).unwrap();
        let text = refusal(&mut command(folder.path()));
        assert_eq!(std::fs::read(folder.path().join("modalwatch.sqlite")).unwrap(), bytes);
        text
    };
    assert!(with_file(b"just some text, longer than a header").contains("is not a SQLite database"));
    assert!(with_file(b"short").contains("is not a SQLite database"));

    let foreign = tempfile::tempdir().unwrap();
    let path = foreign.path().join("other.sqlite");
    make_foreign_database(&path).await;
    assert!(with_file(&std::fs::read(&path).unwrap()).contains("belongs to another program"));

    let folder = tempfile::tempdir().unwrap();
    Service::start(folder.path()).stop("TERM");
    let path = folder.path().join("modalwatch.sqlite");
    let set = |readonly: bool| {
        let mut permissions = std::fs::metadata(&path).unwrap().permissions();
        permissions.set_readonly(readonly);
        std::fs::set_permissions(&path, permissions).unwrap();
    };
    set(true);
    assert!(refusal(&mut command(folder.path())).contains("is read-only"));
    set(false);

    let mut bytes = std::fs::read(&path).unwrap();
    // The header of a page in the middle: no check reads the space between its header and its rows.
    let half = bytes.len() / 2 / 4_096 * 4_096;
    bytes[half..half + 2_000].fill(0xa5);
    std::fs::write(&path, &bytes).unwrap();
    let text = refusal(&mut command(folder.path()));
    assert!(text.contains("damaged") || text.contains("malformed"), "{text}");
}

async fn make_foreign_database(path: &std::path::Path) {
    use sqlx::Connection as _;
    let options = sqlx_sqlite::SqliteConnectOptions::new().filename(path).create_if_missing(true);
    let mut connection = sqlx_sqlite::SqliteConnection::connect_with(&options).await.unwrap();
    sqlx::query("create table recipes (name text)").execute(&mut connection).await.unwrap();
    connection.close().await.unwrap();
}

#[tokio::test]
async fn a_database_of_a_newer_program_is_refused() {
    use sqlx::Connection as _;
    let folder = tempfile::tempdir().unwrap();
    Service::start(folder.path()).stop("TERM");
    let options = sqlx_sqlite::SqliteConnectOptions::new().filename(folder.path().join("modalwatch.sqlite"));
    let mut connection = sqlx_sqlite::SqliteConnection::connect_with(&options).await.unwrap();
    let newer = "insert into _sqlx_migrations (version, description, success, checksum, execution_time)
                 values (9999, 'from the future', 1, x'00', 0)";
    sqlx::query(newer).execute(&mut connection).await.unwrap();
    connection.close().await.unwrap();
    let text = refusal(&mut command(folder.path()));
    assert!(text.contains("schema version 9999, newer"), "{text}");
}

#[test]
fn the_configuration_is_printed_with_what_is_in_force() {
    let mut print = std::process::Command::new(env!("CARGO_BIN_EXE_modalwatch"));
    print.args(["config", "print", "--listen", "127.0.0.1:9"]).env("MODALWATCH__MONITOR__DRAWS_PER_MEASUREMENT", "20");
    let text = String::from_utf8(print.output().unwrap().stdout).unwrap();
    assert!(text.contains("listen = \"127.0.0.1:9\"") && text.contains("draws_per_measurement = 20"), "{text}");
    let mut print = std::process::Command::new(env!("CARGO_BIN_EXE_modalwatch"));
    let text = String::from_utf8(print.args(["config", "print", "--default"]).output().unwrap().stdout).unwrap();
    assert!(text.contains("# Folder of the database"), "{text}");
}

#[test]
fn the_demo_prints_its_table_as_json_and_ends() {
    let mut demo = std::process::Command::new(env!("CARGO_BIN_EXE_modalwatch"));
    let folder = tempfile::tempdir().unwrap();
    let output = demo.args(["demo", "--exit", "--json"]).current_dir(folder.path()).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    let scenarios = report["scenarios"].as_array().unwrap();
    assert_eq!(scenarios.len(), 4, "{report}");
    for scenario in scenarios {
        for p in scenario["parameters"].as_array().unwrap() {
            let number = |key: &str| p[key].as_f64().unwrap_or_else(|| panic!("{key}: {p}"));
            let realised = number("realised_probability_of_damage");
            assert!((number("pooled_probability_of_damage") - realised).abs() <= 0.04, "{p}");
            let interval: [f64; 2] = serde_json::from_value(p["probability_of_damage_interval"].clone()).unwrap();
            assert!((interval[0]..=interval[1]).contains(&number("probability_of_damage")), "{p}");
            assert!(number("target_mean") > 0.0 && number("target_std") > 0.0 && number("std") > 0.0);
            assert!((0.0..=1.0).contains(&number("target_probability_of_damage")));
            assert!(p["exceeds"].is_boolean() && p["name"].is_string());
        }
    }
    assert!(std::fs::read_dir(folder.path()).unwrap().next().is_none(), "the demo should leave nothing behind");
}

#[test]
fn the_command_line_assesses_what_it_simulates_like_the_service() {
    let folder = tempfile::tempdir().unwrap();
    let run = |arguments: &[&str]| {
        let mut command = std::process::Command::new(env!("CARGO_BIN_EXE_modalwatch"));
        let output = command.args(arguments).current_dir(folder.path()).output().unwrap();
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    };
    let simulate = |k2: &str, seed: &str, start: &str, out: &str| {
        let k2 = format!("k2={k2}");
        let population = ["--parameter", "k1=4.0,0.3", "--parameter", &k2, "--parameter", "k3=6.0,0.2"];
        let head = [
            "simulate",
            "--structure",
            "three-dof",
            "--measurements",
            "20",
            "--seed",
            seed,
            "--start",
            start,
            "--out",
            out,
        ];
        run(&[&head[..], &population[..]].concat());
        std::fs::read_to_string(folder.path().join(out)).unwrap()
    };
    let undamaged = simulate("5.0,0.1", "1", "2026-01-01T00:00:00Z", "undamaged.csv");
    let damaged = simulate("4.5,0.1", "2", "2026-02-01T00:00:00Z", "damaged.csv");
    let offline =
        run(&["assess", "--structure", "three-dof", "--reference", "undamaged.csv", "--data", "damaged.csv", "--json"]);
    let offline: serde_json::Value = serde_json::from_str(&offline).unwrap();

    let runtime = tokio::runtime::Runtime::new().unwrap();
    runtime.block_on(async {
        let (service, _folder) = spawn();
        let path = "/v1/structures/three-dof/batches";
        let first = created(service.post_text(path, "text/csv", undamaged).await).await;
        created(service.post("/v1/structures/three-dof/reference", &json!({ "batches": [first["batch"]] })).await)
            .await;
        let online = created(service.post_text(path, "text/csv", damaged).await).await;
        let parameters = online["assessment"]["parameters"].as_array().unwrap();
        assert_eq!(parameters.len(), 3);
        for (k, online) in parameters.iter().enumerate() {
            let offline = &offline["assessment"]["quantities"][k];
            assert_eq!(offline["mean"], online["mean"], "{offline} {online}");
            assert_eq!(offline["std"], online["std"]);
            assert_eq!(offline["damage"]["probability_of_damage"], online["probability_of_damage"]);
        }
        assert!(parameters[1]["probability_of_damage"].as_f64().unwrap() > 0.9, "{online}");
    });
}
