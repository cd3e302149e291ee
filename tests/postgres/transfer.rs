//! Moving everything between a data folder and a server.

use std::process::{Command, Stdio};
use std::time::Duration;

use reqwest::Method;
use serde_json::{json, Value};

use crate::helpers::{command, created, measurements, time, within, Service, PATIENCE};
use crate::postgres::server::Server;
use crate::postgres::world::{answers, database_with_tables, done, pending, refused, serve};

const STRUCTURE: &str = "/v1/structures/three-dof";

/// A structure with a reference, an alarm with a comment, a note and a webhook.
async fn history(service: &Service) {
    let hook = json!({ "url": "https://hooks.example/alarms", "enabled": false });
    created(service.post("/v1/webhooks", &hook).await).await;
    for day in 0..12 {
        let k = if day < 8 { [4.0, 5.0, 6.0] } else { [4.0, 3.8, 6.0] };
        service.post_batch("three-dof", &measurements(k, 10, day * 86_400)).await;
    }
    let reference = json!({ "from": time(0), "to": time(6 * 86_400) });
    created(service.post(&format!("{STRUCTURE}/reference"), &reference).await).await;
    within(PATIENCE, "the comparison", async || (pending(service).await == 0.0).then_some(())).await;
    let comment = json!({ "text": "seen", "author": "Ann" });
    created(service.post(&format!("{STRUCTURE}/alarms/1/comments"), &comment).await).await;
    let note = json!({ "at": time(0), "text": "inspection", "author": "Ann" });
    created(service.post(&format!("{STRUCTURE}/notes"), &note).await).await;
}

/// What a service exports.
async fn export(service: &Service) -> Vec<u8> {
    let response = service.request(Method::GET, &format!("{STRUCTURE}/export")).send().await.unwrap();
    assert!(response.status().is_success());
    response.bytes().await.unwrap().to_vec()
}

/// Lines of an archive without the time at which it was made.
fn lines(archive: &[u8]) -> Vec<Value> {
    let text = std::str::from_utf8(archive).unwrap();
    let plain = |line: &str| {
        let mut record: Value = serde_json::from_str(line).unwrap();
        for name in ["exported_at", "sha256"] {
            record.as_object_mut().unwrap().remove(name);
        }
        record
    };
    text.lines().map(plain).collect()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn there_and_back_is_the_same() {
    if !Server::is_installed() {
        return;
    }
    let [first, second] = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let url = Server::get().database_of(first.path());
    let (from, to) = (format!("sqlite:{}", first.path().display()), format!("sqlite:{}", second.path().display()));
    let mut service = Service::start(first.path());
    history(&service).await;
    let (before, archive) = (answers(&service, "three-dof").await, export(&service).await);
    assert!(before[&format!("{STRUCTURE}/alarms")]["body"]["items"].as_array().unwrap().len() == 1, "{before:?}");

    // A rehearsal while the service stores a further batch.
    let said = done(&["migrate", "--from", &from, "--to", &url]);
    assert!(said.contains("A service was using the source") && said.contains("equal in every row"), "{said}");
    service.post_batch("three-dof", &measurements([4.0, 3.8, 6.0], 10, 20 * 86_400)).await;
    let (later, archive_later) = (answers(&service, "three-dof").await, export(&service).await);
    assert!(archive_later.len() > archive.len());
    assert!(service.stop("TERM").success());

    // The final move writes what has come since, on request only.
    let said = refused(&["migrate", "--from", &from, "--to", &url]);
    assert!(said.contains("already has data") && said.contains("--replace"), "{said}");
    let said = done(&["migrate", "--from", &from, "--to", &url, "--replace", "--json"]);
    let moved: Value = serde_json::from_str(&said).unwrap();
    assert_eq!(moved["rehearsal"], false);
    let table =
        |name: &str| moved["tables"].as_array().unwrap().iter().find(|table| table["table"] == name).unwrap().clone();
    assert_eq!(table("measurement_batch")["rows"], 13);
    assert_eq!(table("measurement_batch")["written"], 1, "{moved}");
    assert_eq!(table("measurement")["rows"], 130);

    let mut service = Service::spawn(&mut serve(first.path(), &url));
    assert_eq!(answers(&service, "three-dof").await, later);
    assert_eq!(lines(&export(&service).await), lines(&archive_later));
    // The service on the server goes on: numbers that the database gives do not collide.
    service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 10, 30 * 86_400)).await;
    let comment = json!({ "text": "again", "author": "Ben" });
    created(service.post(&format!("{STRUCTURE}/alarms/1/comments"), &comment).await).await;
    let (moved_on, archive_on) = (answers(&service, "three-dof").await, export(&service).await);
    assert!(service.stop("TERM").success());

    done(&["migrate", "--from", &url, "--to", &to]);
    let service = Service::start(second.path());
    assert_eq!(answers(&service, "three-dof").await, moved_on);
    assert_eq!(lines(&export(&service).await), lines(&archive_on));
    service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 10, 31 * 86_400)).await;
    created(service.post(&format!("{STRUCTURE}/alarms/1/comments"), &comment).await).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_move_that_was_killed_is_not_served_and_is_completed_by_the_next() {
    if !Server::is_installed() {
        return;
    }
    let [first, second] = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let url = Server::get().database_of(first.path());
    let database = url.rsplit_once('/').unwrap().1.to_owned();
    let (from, to) = (format!("sqlite:{}", first.path().display()), format!("sqlite:{}", second.path().display()));
    let mut service = Service::start(first.path());
    history(&service).await;
    let before = answers(&service, "three-dof").await;
    service.stop("TERM");

    done(&["migrate", "schema", "--url", &url]);
    // A lock on a table in the middle holds the move up there.
    let server = Server::get();
    let mut holder = Command::new("/usr/bin/env")
        .args([
            "psql",
            "-q",
            "-d",
            &url,
            "-c",
            "begin; lock table modalwatch.quantity_assessment in share mode; select pg_sleep(600)",
        ])
        .stdout(Stdio::null())
        .spawn()
        .unwrap();
    let locked = "select count(*) from pg_locks l join pg_class c on c.oid = l.relation where c.relname = 'quantity_assessment' and l.mode = 'ShareLock'";
    within(PATIENCE, "the lock", async || (server.sql(&database, locked) == "1").then_some(())).await;
    let mut moving = Command::new(env!("CARGO_BIN_EXE_modalwatch"))
        .args(["migrate", "--from", &from, "--to", &url])
        .spawn()
        .unwrap();
    let waits = "select count(*) from pg_locks l join pg_class c on c.oid = l.relation where c.relname = 'quantity_assessment' and not l.granted";
    within(PATIENCE, "the move arrives at the table", async || (server.sql(&database, waits) != "0").then_some(()))
        .await;
    moving.kill().unwrap();
    moving.wait().unwrap();
    holder.kill().unwrap();
    holder.wait().unwrap();
    let blocking = format!("select count(pg_terminate_backend(pid)) from pg_stat_activity where datname = '{database}' and pid <> pg_backend_pid()");
    server.sql(&database, &blocking);
    within(PATIENCE, "the sessions end", async || (server.sql(&database, locked) == "0").then_some(())).await;

    let said = crate::helpers::refusal(&mut serve(second.path(), &url));
    assert!(said.contains("run the same `modalwatch migrate"), "{said}");
    // Without --replace: what is there is the beginning of the same move.
    done(&["migrate", "--from", &from, "--to", &url]);
    let mut service = Service::spawn(&mut serve(first.path(), &url));
    assert_eq!(answers(&service, "three-dof").await, before);
    service.stop("TERM");

    // Back, broken off at any moment.
    for pause_ms in [0, 20, 40, 80, 160, 320] {
        let mut moving = Command::new(env!("CARGO_BIN_EXE_modalwatch"))
            .args(["migrate", "--from", &url, "--to", &to])
            .stderr(Stdio::null())
            .spawn()
            .unwrap();
        std::thread::sleep(Duration::from_millis(pause_ms));
        moving.kill().unwrap();
        moving.wait().unwrap();
        if second.path().join("modalwatch.sqlite").exists() {
            break;
        }
    }
    if !second.path().join("modalwatch.sqlite").exists() {
        done(&["migrate", "--from", &url, "--to", &to]);
    }
    let service = Service::spawn(&mut command(second.path()));
    assert_eq!(answers(&service, "three-dof").await, before);
}

#[test]
fn what_cannot_be_moved_is_said() {
    if !Server::is_installed() {
        return;
    }
    let [empty, other] = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let url = Server::get().database_of(empty.path());
    let (from, to) = (format!("sqlite:{}", empty.path().display()), format!("sqlite:{}", other.path().display()));
    for (from, to, says) in [
        (from.as_str(), url.as_str(), "has no database of modalwatch"),
        (url.as_str(), to.as_str(), "modalwatch migrate schema"),
        (url.as_str(), "modalwatch-data", "sqlite:FOLDER"),
        ("postgres://watch:secret@db", to.as_str(), "names no database"),
    ] {
        let said = refused(&["migrate", "--from", from, "--to", to]);
        assert!(said.contains(says) && !said.contains("secret"), "{from} to {to}: {said}");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_backup_by_the_tools_of_the_server_is_restored_with_the_same_answers() {
    if !Server::is_installed() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let server = Server::get();
    let url = database_with_tables(server, folder.path());
    let mut service = Service::spawn(&mut serve(folder.path(), &url));
    history(&service).await;
    let before = answers(&service, "three-dof").await;
    // While it runs.
    let dump = folder.path().join("modalwatch.dump");
    Server::tool("pg_dump", &["--format=custom", "--file", dump.to_str().unwrap(), &url]);
    service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 10, 40 * 86_400)).await;
    service.stop("TERM");
    let restored = server.database_of(&folder.path().join("restored"));
    Server::tool("pg_restore", &["--dbname", &restored, dump.to_str().unwrap()]);
    let service = Service::spawn(&mut serve(folder.path(), &restored));
    assert_eq!(answers(&service, "three-dof").await, before);
    service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 10, 41 * 86_400)).await;
}
