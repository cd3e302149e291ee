//! Attacks on a service whose data are on a server: texts that a server cannot hold, rows that cannot be read, passwords, rights of files,
//! and the end of a service that waits.

use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use reqwest::Method;
use serde_json::{json, Value};

use crate::helpers::{created, eventually, measurements, problem, within, Service, PATIENCE};
use crate::postgres::database::url_of;
use crate::postgres::server::Server;
use crate::postgres::world::{pending, refused, serve};

const STRUCTURE: &str = "/v1/structures/three-dof";

/// Paths with the character U+0000 in each part that a client chooses.
const WITH_ZERO: [&str; 14] = [
    "/v1/structures/a%00b",
    "/v1/structures/three-dof/batches/%00",
    "/v1/structures/three-dof/batches/%00/detail",
    "/v1/structures/three-dof/history?cursor=1~%00",
    "/v1/structures/three-dof/history?parameter=%00",
    "/v1/structures/three-dof/exceedances?cursor=1~%00~%00",
    "/v1/structures/three-dof/measurements?cursor=1~%00~0",
    "/v1/structures/three-dof/alarms?cursor=%00",
    "/v1/diagnoses/%00",
    "/v1/trainings/%00",
    "/v1/webhooks/%00",
    "/v1/webhooks/%00/deliveries",
    "/v1/audit?cursor=%00",
    "/v1/tokens/%00",
];

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn texts_that_a_server_cannot_hold_are_no_error_of_the_service() {
    if !Server::is_installed() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let url = url_of(folder.path()).await.to_string();
    let service = Service::spawn(&mut serve(folder.path(), &url));
    for path in WITH_ZERO {
        for method in [Method::GET, Method::DELETE, Method::PUT, Method::POST] {
            let response = service.request(method.clone(), path).json(&json!({})).send().await.unwrap();
            let status = response.status().as_u16();
            // A page behind a place that no batch has is empty.
            assert!(status < 500, "{method} {path}: {status} {}", response.text().await.unwrap());
        }
    }
    let mut ids = Vec::new();
    for day in 0..2 {
        let batch = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 20, day * 86_400)).await;
        ids.push(batch["batch"].clone());
    }
    let zero = "a\u{0}b";
    for (path, body) in [
        ("reference", json!({ "batches": ids, "reason": zero })),
        ("maintenance", json!({ "from": "2027-01-01T00:00:00Z", "to": "2027-01-02T00:00:00Z", "reason": zero })),
        ("notes", json!({ "at": "2026-02-01T00:00:00Z", "text": zero, "author": "Ida" })),
        ("notes", json!({ "at": "2026-02-01T00:00:00Z", "text": "text", "author": zero })),
        ("batches", json!({ "source": zero, "measurements": measurements([4.0, 5.0, 6.0], 2, 900_000) })),
    ] {
        problem(service.post(&format!("{STRUCTURE}/{path}"), &body).await, 422, "invalid").await;
    }
    let token = service.post("/v1/tokens", &json!({ "name": zero, "scopes": ["admin"] })).await;
    problem(token, 422, "invalid").await;
    // Still works.
    created(
        service.post(&format!("{STRUCTURE}/reference"), &json!({ "batches": ids, "reason": "new\nbearings" })).await,
    )
    .await;
    let batch = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 10, 30 * 86_400)).await;
    assert_eq!(batch["state"], "assessed", "{batch}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn rows_that_cannot_be_read_are_left_out_and_named() {
    if !Server::is_installed() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let url = url_of(folder.path()).await.to_string();
    let database = url.rsplit_once('/').unwrap().1.to_owned();
    let service = Service::spawn(&mut serve(folder.path(), &url));
    let mut ids = Vec::new();
    for day in 0..8 {
        let k2 = if day < 4 { 5.0 } else { 3.6 };
        let batch = service.post_batch("three-dof", &measurements([4.0, k2, 6.0], 20, day * 86_400)).await;
        ids.push(batch["batch"].as_str().unwrap().to_owned());
    }
    created(service.post(&format!("{STRUCTURE}/reference"), &json!({ "batches": ids[..2] })).await).await;
    within(PATIENCE, "the comparison", async || (pending(&service).await == 0.0).then_some(())).await;
    let hook = json!({ "url": "https://hooks.example/alarms", "enabled": false });
    created(service.post("/v1/webhooks", &hook).await).await;
    for text in ["first", "second"] {
        let note = json!({ "at": "2026-02-01T00:00:00Z", "text": text, "author": "Ida" });
        created(service.post(&format!("{STRUCTURE}/notes"), &note).await).await;
    }
    let sql = |statement: &str| Server::get().sql(&database, &format!("set search_path = modalwatch; {statement}"));
    for statement in [
        format!("update assessment set trust = '}}{{' where batch_id = '{}'", ids[3]),
        format!("update assessment set plotted = '\\x00' where batch_id = '{}'", ids[4]),
        format!("update measurement set covariates = '}}{{' where batch_id = '{}'", ids[5]),
        format!("update assessment set trust = '}}{{' where batch_id = '{}'", ids[7]),
        "insert into process_point (structure_id, undamaged_version, measured_to_us, batch_id, estimate, held, known, changes)
         select structure_id, undamaged_version, opened_at_us, opened_batch, '{}', false, '\\x', '}{'
         from alarm_episode where kind = 'damage' and ended_at_us is null and not withdrawn
         on conflict (structure_id, undamaged_version, measured_to_us, batch_id) do update set changes = '}{'"
            .to_owned(),
        "update webhook set events = '}{'".to_owned(),
        "update note set from_us = 9000000000000000000 where text = 'second'".to_owned(),
        "insert into diagnosis (diagnosis_id, structure_id, structure_digest, request, started_by, alarm, state, result, created_at_us)
         values ('01900000-0000-7000-8000-000000000001', 'three-dof', 'd', '{}', 'requested', 1, 'done', '}{', 1)"
            .to_owned(),
    ] {
        sql(&statement);
    }
    let history = service.read(&format!("{STRUCTURE}/history")).await;
    let items = history["items"].as_array().unwrap();
    assert_eq!(items.len(), 8);
    let failed: Vec<&str> =
        items.iter().filter(|item| item["state"] == "failed").map(|item| item["batch"].as_str().unwrap()).collect();
    assert_eq!(failed, [&ids[3], &ids[7]], "{history}");
    assert_eq!(service.read(&format!("{STRUCTURE}/notes")).await["items"].as_array().unwrap().len(), 1);
    let series = service.read(&format!("{STRUCTURE}/series")).await;
    assert!(series["unreadable"].as_str().is_some_and(|said| said.contains("left out")), "{series}");
    for path in [
        "/v1/overview",
        "/v1/structures",
        "/v1/jobs",
        "/v1/webhooks",
        "/v1/audit",
        "/metrics",
        STRUCTURE,
        &format!("{STRUCTURE}/alarms"),
        &format!("{STRUCTURE}/report"),
        &format!("{STRUCTURE}/diagnoses"),
        &format!("{STRUCTURE}/measurements"),
        &format!("{STRUCTURE}/exceedances"),
        &format!("{STRUCTURE}/charts"),
        &format!("{STRUCTURE}/history?format=csv"),
        &format!("{STRUCTURE}/references"),
    ] {
        let response = service.get(path).send().await.unwrap();
        assert_eq!(response.status(), 200, "{path}: {}", response.text().await.unwrap());
    }
    let alarms = service.read(&format!("{STRUCTURE}/alarms?state=open")).await;
    let alarm = format!("{STRUCTURE}/alarms/{}", alarms["items"][0]["alarm"]);
    let closing = json!({ "reason": "other", "text": "test", "author": "Ida" });
    created(service.post(&format!("{alarm}/closing"), &closing).await).await;
    let ready = service.read("/readyz").await;
    assert!(ready["findings"].to_string().contains("stored_data_unreadable"), "{ready}");
    // The doctor looks at all rows, also while a service uses the database.
    let doctor = modalwatch_with(&["doctor", "--json"], &url, folder.path());
    let said = String::from_utf8_lossy(&doctor.stdout).into_owned();
    assert!(!doctor.status.success(), "{said}");
    for expected in
        [&format!("trust of assessment {}", ids[3]), "events of webhook", "from_us of note", "result of diagnosis"]
    {
        assert!(said.contains(expected), "{expected}: {said}");
    }
}

/// The program with a database in its settings.
fn modalwatch_with(arguments: &[&str], url: &str, folder: &Path) -> std::process::Output {
    let mut command = Command::new(env!("CARGO_BIN_EXE_modalwatch"));
    command.args(arguments).env("MODALWATCH__STORE__URL", url).env("MODALWATCH__HTTP__LISTEN", "127.0.0.1:0");
    command.current_dir(folder).output().unwrap()
}

#[tokio::test]
async fn a_password_is_in_no_message_whatever_is_wrong_with_its_url() {
    if !Server::is_installed() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let address = Server::get().address();
    let other = format!("sqlite:{}", folder.path().display());
    for url in [
        format!("postgre://watch:correct-horse@{address}/shm"),
        format!("postgre://watch:a@correct-horse@{address}/shm"),
        "mysql://db/shm?user=watch&password=correct-horse".to_owned(),
        format!("postgres://watch:correct-horse?correct-horse@{address}/shm"),
        format!("postgres://watch:correct-horse/correct-horse@{address}/shm"),
        format!("postgres://watch:correct-horse#@{address}/shm"),
        format!("postgres://watch:a@correct-horse@{address}/no-such-database"),
        format!("postgres://{address}/no-such-database?user=modalwatch&p%61ssword=correct-horse"),
        format!("postgres://{address}/no-such-database?user=modalwatch&password=correct-horse&sslmode=correct"),
        format!("postgres://watch:correct-horse@{address}"),
        "correct-horse".to_owned(),
    ] {
        for said in [
            refused(&["migrate", "--from", &url, "--to", &other]),
            refused(&["migrate", "--from", &other, "--to", &url]),
            refused(&["migrate", "schema", "--url", &url]),
            {
                let output = modalwatch_with(&["doctor"], &url, folder.path());
                format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
            },
            {
                let output = modalwatch_with(&["config", "print"], &url, folder.path());
                format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
            },
        ] {
            // A text that is no URL at all is shown where it was typed, and is no password then.
            assert!(url == "correct-horse" || !said.contains("correct-horse"), "{url}: {said}");
            assert!(!said.contains("panicked"), "{url}: {said}");
        }
    }
}

/// Files and folders that others than their owner may use.
fn open_to_others(folder: &Path, found: &mut Vec<String>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let mode = std::fs::metadata(&path).unwrap().permissions().mode() & 0o777;
        if mode & 0o077 != 0 {
            found.push(format!("{} {mode:o}", path.display()));
        }
        if path.is_dir() {
            open_to_others(&path, found);
        }
    }
}

/// The program without a mask that takes permissions from new files.
fn without_mask(arguments: &[&str]) -> Command {
    let mut shell = Command::new("sh");
    shell.args(["-c", "umask 000; exec \"$0\" \"$@\"", env!("CARGO_BIN_EXE_modalwatch")]).args(arguments);
    shell
}

#[tokio::test]
async fn a_folder_into_which_data_are_moved_and_that_of_a_service_on_a_server_are_their_owners_only() {
    if !Server::is_installed() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let url = url_of(folder.path()).await.to_string();
    let data = folder.path().join("data");
    let mut command = without_mask(&["serve", "--listen", "0", "--data-dir", data.to_str().unwrap()]);
    command.env("MODALWATCH__STORE__URL", &url).env("MODALWATCH__LOG__LEVEL", "warn");
    let mut service = Service::spawn(&mut command);
    service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 4, 0)).await;
    service.stop("TERM");
    let moved = folder.path().join("moved/deep");
    let output =
        without_mask(&["migrate", "--from", &url, "--to", &format!("sqlite:{}", moved.display())]).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let mut found = Vec::new();
    open_to_others(folder.path(), &mut found);
    assert_eq!(found, Vec::<String>::new());
    assert!(moved.join("modalwatch.sqlite").exists());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_service_that_waits_ends_at_once_when_it_is_told_to() {
    if !Server::is_installed() {
        return;
    }
    let folders = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let url = url_of(folders[0].path()).await.to_string();
    let first = Service::spawn(&mut serve(folders[0].path(), &url));
    let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
    let mut command = Command::new(env!("CARGO_BIN_EXE_modalwatch"));
    command.args(["serve", "--listen", &port.to_string(), "--data-dir"]).arg(folders[1].path());
    command.env("MODALWATCH__STORE__URL", &url).env("MODALWATCH__STORE__STANDBY", "true");
    let mut standby = command.stdout(std::process::Stdio::null()).stderr(std::process::Stdio::null()).spawn().unwrap();
    let client = modalwatch::notify::client_builder().build().unwrap();
    eventually("it waits", async || {
        client.get(format!("http://127.0.0.1:{port}/healthz")).send().await.is_ok().then_some(())
    })
    .await;
    let began = Instant::now();
    assert!(Command::new("kill").args(["-TERM", &standby.id().to_string()]).status().unwrap().success());
    let status = within(PATIENCE, "its end", async || standby.try_wait().unwrap()).await;
    assert!(status.success(), "{status}");
    assert!(began.elapsed() < Duration::from_secs(10), "{:?}", began.elapsed());
    let read: Value = first.read(&format!("{STRUCTURE}/history")).await;
    assert_eq!(read["items"], json!([]), "the other goes on");
}
