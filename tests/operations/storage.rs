//! Full and failing disks, recovery, and the deletion of old batches.

use std::os::unix::fs::PermissionsExt as _;
use std::path::Path;
use std::process::Command;

use reqwest::{Method, Response};
use serde_json::{json, Value};

use crate::access::world::{id_of, World};
use crate::helpers::{command, created, eventually, measurements, problem, spawn, Service, TWO_MASSES};
use crate::operations::world::{run, settled, text, with_past};

async fn post(service: &Service, start: usize) -> Response {
    let body = json!({ "measurements": measurements([4.0, 5.0, 6.0], 4, start) });
    service.post("/v1/structures/three-dof/batches", &body).await
}

/// Batches in the history.
async fn history(service: &Service) -> usize {
    service.read("/v1/structures/three-dof/history?limit=1000").await["items"].as_array().unwrap().len()
}

async fn metric(service: &Service, line: &str) -> f64 {
    let text = service.get("/metrics").send().await.unwrap().text().await.unwrap();
    let found = text.lines().find_map(|l| l.strip_prefix(line)).unwrap_or_else(|| panic!("no {line} in {text}"));
    found.trim().parse().unwrap()
}

fn codes(list: &Value) -> Vec<&str> {
    list.as_array().unwrap().iter().map(|reason| reason["code"].as_str().unwrap()).collect()
}

#[tokio::test]
async fn below_the_floor_posts_are_refused_reads_go_on_and_a_new_floor_heals() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("config.toml");
    let data = folder.path().join("data");
    std::fs::write(&config, "").unwrap();
    let service = Service::spawn(command(&data).arg("--config").arg(&config));
    with_past(&service, 2).await;
    // The minimum of free space is larger than any disk, as if the disk were full.
    std::fs::write(&config, "[store]\nmin_free_bytes = 9000000000000000000\n").unwrap();
    service.signal("HUP");
    let refused = wait_for_status(&service, 507).await;
    let stored = history(&service).await;
    assert_eq!(refused.headers()["retry-after"], "30");
    let refused = problem(refused, 507, "disk_full").await;
    assert!(refused["detail"].as_str().unwrap().contains("repeat the request then"), "{refused}");
    let structure = json!({ "batches": ["x"] });
    assert_ne!(service.post("/v1/structures/three-dof/reference", &structure).await.status(), 500);
    problem(service.post("/v1/backups", &json!({})).await, 507, "disk_full").await;
    let ready = service.get("/readyz").send().await.unwrap();
    assert_eq!(ready.status(), 503);
    let ready: Value = ready.json().await.unwrap();
    assert_eq!((&ready["ready"], codes(&ready["reasons"])), (&json!(false), vec!["disk_full"]), "{ready}");
    assert_eq!(service.read("/healthz").await["status"], "alive");
    assert_eq!(history(&service).await, stored);
    assert!(metric(&service, "modalwatch_ready ").await < 0.5);
    assert!(metric(&service, "modalwatch_write_failures_total{cause=\"disk_full\"} ").await >= 1.0);

    std::fs::write(&config, "").unwrap();
    service.signal("HUP");
    wait_for_status(&service, 201).await;
    ready_again(&service).await;
    assert!(metric(&service, "modalwatch_ready ").await > 0.5);
}

#[tokio::test]
async fn below_the_floor_rights_are_taken_away_and_room_is_made_and_nothing_is_added() {
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("config.toml");
    std::fs::write(&config, "").unwrap();
    let world = World::with(|command| command.arg("--config").arg(&config));
    let (stolen, reader) = (world.token(&["ingest"], &[]).await, world.token(&["read"], &[]).await);
    let put = world.ask(Method::PUT, "/v1/structures/tiny", &world.admin).header("content-type", "application/toml");
    created(put.body(TWO_MASSES).send().await.unwrap()).await;
    let notes = "/v1/structures/three-dof/notes";
    let note = json!({ "at": "2026-01-01T00:00:00Z", "text": "bolts" });
    let stored = created(world.post(notes, &world.admin, &note).await).await["note"].as_str().unwrap().to_owned();
    let training = json!({ "samples": 200_000, "epochs": 200 });
    let training = world.post("/v1/structures/three-dof/trainings", &world.admin, &training).await;
    let training: Value = training.json().await.unwrap();
    let entries = async || world.read("/v1/audit", &world.admin).await["items"].as_array().unwrap().clone();
    let before = entries().await.len();

    std::fs::write(&config, "[store]\nmin_free_bytes = 9000000000000000000\n").unwrap();
    world.service.signal("HUP");
    let mut attempt = 0;
    eventually("a post that is answered 507", async || {
        attempt += 1;
        let body = json!({ "measurements": measurements([4.0, 5.0, 6.0], 1, 86_400 + 600 * attempt) });
        let answer = world.post("/v1/structures/three-dof/batches", &stolen, &body).await;
        (answer.status() == 507).then_some(())
    })
    .await;
    let token = json!({ "name": "another", "scopes": ["read"] });
    for (path, body) in [("/v1/tokens", &token), (notes, &note), ("/v1/backups", &json!({}))] {
        problem(world.post(path, &world.admin, body).await, 507, "disk_full").await;
    }
    assert_eq!(entries().await.len(), before, "what is refused for want of room takes none");

    let taken_away = [
        (Method::DELETE, format!("/v1/tokens/{}", id_of(&stolen)), 200),
        (Method::POST, format!("/v1/tokens/{}/rotation", id_of(&reader)), 201),
        (Method::DELETE, format!("{notes}/{stored}"), 204),
        (Method::DELETE, format!("/v1/jobs/{}", training["training"].as_str().unwrap()), 200),
        (Method::DELETE, "/v1/structures/tiny?confirm=tiny".to_owned(), 200),
    ];
    for (method, path, status) in &taken_away {
        let request = world.ask(method.clone(), path, &world.admin).json(&json!({ "overlap_s": 0 }));
        let answer = request.send().await.unwrap();
        assert_eq!(answer.status(), *status, "{method} {path}: {}", answer.text().await.unwrap());
    }
    problem(world.get("/v1/structures", &stolen).await, 401, "token_revoked").await;
    problem(world.get("/v1/structures", &reader).await, 401, "token_expired").await;
    problem(world.get("/v1/structures/tiny", &world.admin).await, 404, "unknown_structure").await;
    let recorded = entries().await;
    assert_eq!(recorded.len(), before + taken_away.len());
    assert!(recorded[..taken_away.len()].iter().all(|entry| entry["outcome"] == "done"), "{recorded:?}");

    // Each of them takes a little of what is left, those that are refused as well: nobody may have many.
    let unknown = "/v1/tokens/0123456789abcdef";
    let revoke_unknown = async || world.ask(Method::DELETE, unknown, &world.admin).send().await.unwrap();
    let mut attempts = 0;
    let limited = loop {
        let answer = revoke_unknown().await;
        if answer.status() != 404 {
            break answer;
        }
        attempts += 1;
        assert!(attempts < 1_000, "no limit");
    };
    problem(limited, 429, "too_many_requests").await;
    std::fs::write(&config, "").unwrap();
    world.service.signal("HUP");
    eventually("no limit above the floor", async || (revoke_unknown().await.status() == 404).then_some(())).await;
}

/// Waits until the service is ready; what `/readyz` reports about the writer may be a second old.
async fn ready_again(service: &Service) {
    eventually("ready", async || (service.get("/readyz").send().await.unwrap().status() == 200).then_some(())).await;
}

/// Posts batches until one has this answer, because a signal does not act at once.
async fn wait_for_status(service: &Service, status: u16) -> Response {
    let mut attempt = 0;
    eventually(&format!("a post that is answered {status}"), async || {
        attempt += 1;
        Some(post(service, 86_400 * 100 + attempt * 4_000).await).filter(|response| response.status() == status)
    })
    .await
}

/// A limit on the size of files makes every write of the log fail, until it is lifted; the process is not restarted.
#[tokio::test]
async fn a_disk_that_fails_is_answered_503_and_the_service_heals_by_itself() {
    let folder = tempfile::tempdir().unwrap();
    let service = command(folder.path());
    let arguments: Vec<_> = service.get_args().map(|a| a.to_str().unwrap().to_owned()).collect();
    let mut shell = Command::new("sh");
    // The signal is ignored; otherwise the limit would end the process.
    shell.args(["-c", "trap '' XFSZ; exec \"$0\" \"$@\""]).arg(service.get_program()).args(&arguments);
    shell.env("MODALWATCH__LOG__LEVEL", "off");
    let service = Service::spawn(&mut shell);
    with_past(&service, 2).await;
    let limit = |bytes: &str| {
        let set =
            Command::new("prlimit").args(["--pid", &service.pid().to_string(), &format!("--fsize={bytes}:")]).status();
        assert!(set.unwrap().success());
    };
    limit("4096");
    for round in 0..5 {
        let refused = post(&service, 86_400 * 50 + round * 4_000).await;
        let refused = problem(refused, 503, "disk_failed").await;
        assert!(!refused["detail"].as_str().unwrap().contains('/'), "an internal path: {refused}");
        let ready: Value = service.get("/readyz").send().await.unwrap().json().await.unwrap();
        assert_eq!(codes(&ready["reasons"]), ["disk_failed"], "{ready}");
        assert_eq!(history(&service).await, 4, "a refused batch is in the history");
    }
    limit("unlimited");
    for round in 0..5 {
        let taken = post(&service, 86_400 * 50 + round * 4_000).await;
        assert_eq!(taken.status(), 201, "the service did not recover: {}", taken.text().await.unwrap());
    }
    ready_again(&service).await;
    assert!(metric(&service, "modalwatch_write_failures_total{cause=\"disk_failed\"} ").await >= 5.0);
    settled(&service).await;
}

#[tokio::test]
async fn batches_are_deleted_only_on_request_and_never_those_of_references_and_alarms() {
    let (mut service, folder) = spawn();
    with_past(&service, 8).await;
    let data_dir = text(folder.path()).to_owned();
    let ids = async |service: &Service| {
        let page = service.read("/v1/structures/three-dof/history?limit=1000").await;
        page["items"].as_array().unwrap().iter().map(|i| i["batch"].as_str().unwrap().to_owned()).collect::<Vec<_>>()
    };
    let all = ids(&service).await;
    assert_eq!(all.len(), 10);
    let plan = service.read("/v1/retention").await;
    assert_eq!((&plan["measurements_days"], &plan["would_delete"]), (&json!(0), &json!([])), "{plan}");
    // Of ten batches, two belong to the undamaged reference, and the damaged ones belong to the open alarm.
    let alarms = service.read("/v1/structures/three-dof/alarms").await;
    let opened = alarms["items"][0]["opened_batch"].as_str().unwrap().to_owned();
    let first_of_alarm = all.iter().position(|id| *id == opened).unwrap();
    let expected: Vec<String> = all[2..first_of_alarm].to_vec();
    assert!(!expected.is_empty(), "{alarms}");
    let plan = service.read("/v1/retention?days=1").await;
    assert_eq!(plan["would_delete"][0]["batches"], expected.len(), "{plan}");
    problem(service.get("/v1/retention?days=-1").send().await.unwrap(), 422, "invalid").await;
    service.stop("TERM");

    let dry = run(&["retention", "--dry-run", "--days", "1", "--data-dir", &data_dir]).await;
    let dry: Value = serde_json::from_str(&dry).unwrap();
    assert_eq!(dry["would_delete"], plan["would_delete"]);
    let mut service = Service::start(folder.path());
    assert_eq!(ids(&service).await, all, "a dry run, or a start without the setting, deleted something");
    service.stop("TERM");

    let mut deleting = command(folder.path());
    deleting.env("MODALWATCH__RETENTION__MEASUREMENTS_DAYS", "1").env("MODALWATCH__RETENTION__EVERY_S", "1");
    let service = Service::spawn(&mut deleting);
    let kept: Vec<String> = all.iter().filter(|id| !expected.contains(id)).cloned().collect();
    eventually("the deletion", async || (ids(&service).await == kept).then_some(())).await;
    let deleted = metric(&service, "modalwatch_retention_deleted_batches_total ").await;
    assert!((deleted - expected.len() as f64).abs() < 0.5, "{deleted}");
    let gone = format!("/v1/structures/three-dof/batches/{}", expected[0]);
    problem(service.get(&gone).send().await.unwrap(), 404, "unknown_batch").await;
    let still = service.read("/v1/structures/three-dof/alarms?state=open").await;
    assert_eq!(still["items"].as_array().unwrap().len(), alarms["items"].as_array().unwrap().len(), "{still}");
    let batch = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 4, 86_400 * 40)).await;
    assert_eq!(batch["assessment"]["undamaged_version"], 1, "{batch}");
}

/// Everything below a folder that others than its owner may use in any way.
fn open_to_others(folder: &Path) -> Vec<String> {
    let mut found = Vec::new();
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        let mode = std::fs::symlink_metadata(&path).unwrap().permissions().mode() & 0o777;
        if mode & 0o077 != 0 {
            found.push(format!("{} {mode:o}", path.display()));
        }
        if path.is_dir() {
            found.extend(open_to_others(&path));
        }
    }
    found
}

/// The command with a mask that takes no permission from new files.
fn without_mask(command: &Command) -> Command {
    let mut shell = Command::new("sh");
    shell.args(["-c", "umask 000; exec \"$0\" \"$@\""]).arg(command.get_program()).args(command.get_args());
    shell.envs(command.get_envs().filter_map(|(name, value)| Some((name, value?))));
    shell
}

#[tokio::test]
async fn the_files_of_the_service_are_its_owners_only_whatever_the_mask_says() {
    let folder = tempfile::tempdir().unwrap();
    let data = folder.path().join("data");
    // What an earlier version has left: a lock file for everybody, and a backup that was killed.
    let draft = data.join("backups/.draft-killed");
    std::fs::create_dir_all(&draft).unwrap();
    std::fs::set_permissions(data.join("backups"), std::fs::Permissions::from_mode(0o755)).unwrap();
    std::fs::write(data.join("modalwatch.lock"), "").unwrap();
    std::fs::set_permissions(data.join("modalwatch.lock"), std::fs::Permissions::from_mode(0o666)).unwrap();

    let mut service = Service::spawn(&mut without_mask(&command(&data)));
    with_past(&service, 2).await;
    assert_eq!(service.post("/v1/backups", &json!({ "name": "one" })).await.status(), 201);
    assert_eq!(open_to_others(&data), Vec::<String>::new());
    assert!(!draft.exists(), "the folder of a killed backup is removed at the start");
    service.stop("TERM");

    let program = |args: &[&str]| {
        let mut command = Command::new(crate::helpers::program());
        command.args(args);
        let output = without_mask(&command).output().unwrap();
        assert!(output.status.success(), "{args:?}: {}", String::from_utf8_lossy(&output.stderr));
    };
    let (out, restored) = (folder.path().join("kept/out"), folder.path().join("restored"));
    program(&["backup", "--data-dir", text(&data), "--out", text(&out)]);
    std::fs::create_dir(&restored).unwrap();
    program(&["restore", "--from", text(&out), "--data-dir", text(&restored)]);
    program(&["restore", "--from", text(&out), "--data-dir", text(&restored), "--replace"]);
    for folder in [&data, &out, &restored] {
        assert_eq!(open_to_others(folder), Vec::<String>::new());
    }
}
