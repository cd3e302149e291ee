//! What is stored stays whole: secrets that backups leave out, databases that another program has changed, rows that cannot be read, and
//! structures that are deleted.

use std::path::Path;
use std::time::Duration;

use reqwest::Method;
use serde_json::{json, Value};
use sqlx::Connection as _;
use sqlx_sqlite::{SqliteConnectOptions, SqliteConnection};

use crate::helpers::{command, created, eventually, measurements, problem, spawn, within, Service};
use crate::operations::world::{fails, program, run, settled, text, with_past};

/// Executes SQL on a database that no service has open.
pub async fn execute(data_dir: &Path, statement: &str) {
    let options = SqliteConnectOptions::new().filename(data_dir.join("modalwatch.sqlite"));
    let mut connection = SqliteConnection::connect_with(&options).await.unwrap();
    sqlx::raw_sql(sqlx::AssertSqlSafe(statement.to_owned())).execute(&mut connection).await.unwrap();
    sqlx::raw_sql("pragma wal_checkpoint(truncate)").execute(&mut connection).await.unwrap();
    connection.close().await.unwrap();
}

fn contains(file: &Path, text: &str) -> bool {
    std::fs::read(file).unwrap().windows(text.len()).any(|window| window == text.as_bytes())
}

#[tokio::test]
async fn a_backup_has_no_secrets_of_webhooks_unless_they_are_asked_for() {
    let (mut service, folder) = spawn();
    let webhook = created(service.post("/v1/webhooks", &json!({ "url": "https://example.com/alarms" })).await).await;
    let first = webhook["secret"].as_str().unwrap().to_owned();
    let path = format!("/v1/webhooks/{}", webhook["webhook"].as_str().unwrap());
    let rotated: Value = service.post(&format!("{path}/secret"), &json!({})).await.json().await.unwrap();
    let second = rotated["secret"].as_str().unwrap().to_owned();
    let manifest = created(service.post("/v1/backups", &json!({ "name": "plain" })).await).await;
    assert_eq!(manifest["with_secrets"], false);
    let asked = json!({ "name": "secret", "with_secrets": true });
    assert_eq!(created(service.post("/v1/backups", &asked).await).await["with_secrets"], true);
    service.stop("TERM");
    let stopped = folder.path().join("stopped");
    run(&["backup", "--data-dir", text(folder.path()), "--out", text(&stopped)]).await;
    let kept = folder.path().join("kept");
    run(&["backup", "--data-dir", text(folder.path()), "--out", text(&kept), "--with-secrets"]).await;
    let backups = folder.path().join("backups");
    for (backup, has) in
        [(backups.join("plain"), false), (backups.join("secret"), true), (stopped, false), (kept, true)]
    {
        let copy = backup.join("modalwatch.sqlite");
        for secret in [&first, &second] {
            assert_eq!(contains(&copy, secret), has, "{}", copy.display());
        }
    }

    let restored = tempfile::tempdir().unwrap();
    let said = run(&["restore", "--from", text(&backups.join("plain")), "--data-dir", text(restored.path())]).await;
    assert!(said.contains("1 webhooks are disabled"), "{said}");
    let service = Service::start(restored.path());
    assert_eq!(service.read(&path).await["enabled"], false);
    let enabled = json!({ "url": "https://example.com/alarms", "enabled": true });
    let put = async || service.request(Method::PUT, &path).json(&enabled).send().await.unwrap();
    problem(put().await, 409, "no_webhook_secret").await;
    let renewed: Value = service.post(&format!("{path}/secret"), &json!({})).await.json().await.unwrap();
    assert!(renewed["secret"].as_str().unwrap().starts_with("whsec_"), "{renewed}");
    let put: Value = put().await.json().await.unwrap();
    assert_eq!(put["enabled"], true, "{put}");
}

#[tokio::test]
async fn a_database_with_a_foreign_trigger_is_not_restored_and_the_doctor_names_it() {
    let (mut service, folder) = spawn();
    service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 4, 0)).await;
    service.stop("TERM");
    let changes = [
        ("create trigger spy after insert on measurement begin delete from audit_entry; end", "trigger \"spy\""),
        ("create view spy as select * from webhook", "view \"spy\""),
        ("create table spy (a)", "table \"spy\""),
        ("drop trigger batch_counted", "trigger batch_counted is missing"),
    ];
    for (number, (change, expected)) in changes.into_iter().enumerate() {
        let data_dir = folder.path().join(format!("data-{number}"));
        std::fs::create_dir(&data_dir).unwrap();
        std::fs::copy(folder.path().join("modalwatch.sqlite"), data_dir.join("modalwatch.sqlite")).unwrap();
        let backup = folder.path().join(format!("backup-{number}"));
        run(&["backup", "--data-dir", text(&data_dir), "--out", text(&backup)]).await;
        execute(&data_dir, change).await;
        let said = fails(&["backup", "--data-dir", text(&data_dir), "--out", text(&folder.path().join("never"))]).await;
        assert!(said.contains(expected), "{said}");
        // Somebody who changes a backup also adapts its manifest.
        execute(&backup, change).await;
        adapt(&backup);
        let target = tempfile::tempdir().unwrap();
        let said = fails(&["restore", "--from", text(&backup), "--data-dir", text(target.path())]).await;
        assert!(said.contains(expected), "{said}");
        assert!(!target.path().join("modalwatch.sqlite").exists());
        let found = doctor(&data_dir);
        assert!(found.contains(expected), "{found}");
    }
    assert!(doctor(folder.path()).contains("stored texts can be read"));
}

/// Adapts the manifest of a backup to its changed copy.
fn adapt(backup: &Path) {
    let bytes = std::fs::read(backup.join("modalwatch.sqlite")).unwrap();
    let record = backup.join("manifest.json");
    let mut manifest: Value = serde_json::from_slice(&std::fs::read(&record).unwrap()).unwrap();
    manifest["sha256"] = json!(data_encoding::HEXLOWER.encode(&<sha2::Sha256 as sha2::Digest>::digest(&bytes)));
    manifest["bytes"] = json!(bytes.len());
    std::fs::write(record, manifest.to_string()).unwrap();
}

/// The whole report of the doctor.
pub fn doctor(data_dir: &Path) -> String {
    let mut command = program(&["doctor", "--json", "--data-dir", text(data_dir)]);
    let output = command.env("MODALWATCH__HTTP__LISTEN", "127.0.0.1:0").output().unwrap();
    // Without the escapes of JSON.
    String::from_utf8(output.stdout).unwrap().replace("\\\"", "\"")
}

#[tokio::test]
async fn a_reference_that_cannot_be_read_is_named_by_everything() {
    let (mut service, folder) = spawn();
    with_past(&service, 2).await;
    let part = service.read("/v1/structures/three-dof").await["undamaged"]["batches"][0].clone();
    service.stop("TERM");
    execute(folder.path(), "update undamaged_state set doubts = '}{'").await;
    let found = doctor(folder.path());
    assert!(found.contains("undamaged reference 1 of three-dof"), "{found}");
    let service = Service::start(folder.path());
    let ready: Value = service.get("/readyz").send().await.unwrap().json().await.unwrap();
    let codes: Vec<&Value> = ready["findings"].as_array().unwrap().iter().map(|finding| &finding["code"]).collect();
    assert!(codes.contains(&&json!("stored_data_unreadable")), "{ready}");
    // Everything else is read and stored as before, and each answer says what is missing.
    let path = "/v1/structures/three-dof";
    let read = service.read(path).await;
    let sentence = read["undamaged_unreadable"].as_str().unwrap_or_else(|| panic!("{read}")).to_owned();
    assert!(read["undamaged"].is_null() && sentence.contains("modalwatch doctor"), "{read}");
    let put = service.request(Method::PUT, path).json(&read["definition"]).send().await.unwrap();
    assert_eq!(put.status(), 200);
    assert_eq!(put.json::<Value>().await.unwrap()["undamaged_unreadable"], sentence);
    let series = service.read(&format!("{path}/series")).await;
    assert_eq!(series["undamaged_unreadable"], sentence);
    assert!(series["parameters"].as_array().is_some_and(|all| !all.is_empty()), "{series}");
    assert!(series["parameters"].as_array().unwrap().iter().all(|one| one["threshold"].is_null()), "{series}");
    let report = service.get(&format!("{path}/report")).send().await.unwrap();
    assert_eq!(report.status(), 200);
    let report = report.text().await.unwrap();
    assert!(report.contains("The undamaged reference is missing: "), "{report}");
    // A batch of the reference, which is compared with none.
    let part = service.read(&format!("{path}/batches/{}", part.as_str().unwrap())).await;
    assert_eq!((&part["state"], &part["next_step"]), (&json!("assessed"), &json!(sentence)), "{part}");
    let again = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 20, 0)).await;
    assert_eq!((&again["batch"], &again["next_step"]), (&part["batch"], &json!(sentence)), "{again}");
    // The batch is stored, and the answer says so.
    let answer = service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 4, 90 * 86_400)).await;
    assert_eq!(answer["state"], "received", "{answer}");
    assert!(answer.to_string().contains("the batch is stored"), "{answer}");
}

#[tokio::test]
async fn a_batch_that_cannot_be_read_is_answered_with_what_is_known_of_it() {
    let (mut service, folder) = spawn();
    let given = [0, 1, 2].map(|day| measurements([4.0, 5.0, 6.0], 4, 86_400 * day));
    let mut ids = Vec::new();
    for batch in &given {
        ids.push(service.post_batch("three-dof", batch).await["batch"].as_str().unwrap().to_owned());
    }
    service.stop("TERM");
    let damage = [
        ("measurement", "covariates = '}{'", "covariates of measurement"),
        ("measurement", "frequency_hz = zeroblob(23)", "frequency_hz of measurement"),
        ("assessment", "trust = '}{'", "trust of assessment"),
    ];
    for (id, (table, change, _)) in ids.iter().zip(damage) {
        execute(folder.path(), &format!("update {table} set {change} where batch_id = '{id}'")).await;
    }
    let found = doctor(folder.path());
    let service = Service::start(folder.path());
    for ((id, (_, _, expected)), batch) in ids.iter().zip(damage).zip(&given) {
        assert!(found.contains(&format!("{expected} {id}")), "{found}");
        let read = service.read(&format!("/v1/structures/three-dof/batches/{id}")).await;
        assert_eq!((&read["state"], &read["measurement_count"]), (&json!("failed"), &json!(4)), "{read}");
        assert!(read["failure"].as_str().unwrap().contains("modalwatch doctor"), "{read}");
        let again = service.post_batch("three-dof", batch).await;
        for field in ["batch", "state", "failure", "received_at", "measured_to", "content_digest"] {
            assert_eq!(again[field], read[field], "{field}: {again}");
        }
    }
    // The history has all three; the one whose assessment is damaged is marked.
    let history = service.read("/v1/structures/three-dof/history").await;
    let states: Vec<&Value> = history["items"].as_array().unwrap().iter().map(|item| &item["state"]).collect();
    assert_eq!(states, ["assessed", "assessed", "failed"], "{history}");
    service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 4, 86_400 * 3)).await;
}

#[tokio::test]
async fn what_killed_backups_leave_is_seen_and_removed() {
    let (mut service, folder) = spawn();
    service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 4, 0)).await;
    service.stop("TERM");
    let elsewhere = tempfile::tempdir().unwrap();
    let old = || std::time::SystemTime::now() - std::time::Duration::from_hours(1);
    let leave = |folder: &Path, lock: bool| {
        let draft = folder.join(".draft-killed");
        std::fs::create_dir_all(&draft).unwrap();
        std::fs::write(draft.join("modalwatch.sqlite"), "a part of a copy").unwrap();
        if lock {
            std::fs::write(draft.join(".lock"), "").unwrap();
        }
        std::fs::File::open(&draft).unwrap().set_modified(old()).unwrap();
        draft
    };
    let backups = folder.path().join("backups");
    let drafts = [leave(&backups, true), leave(elsewhere.path(), false)];
    let found = doctor(folder.path());
    assert!(found.contains("broken-off backups") && found.contains(".draft-killed"), "{found}");
    run(&["backup", "--data-dir", text(folder.path()), "--out", text(&elsewhere.path().join("one"))]).await;
    assert!(!drafts[1].exists(), "a backup beside it removes it");
    // One that is being made stays.
    let held = leave(elsewhere.path(), true);
    let lock = std::fs::File::open(held.join(".lock")).unwrap();
    lock.lock().unwrap();
    run(&["backup", "--data-dir", text(folder.path()), "--out", text(&elsewhere.path().join("two"))]).await;
    assert!(held.exists(), "another backup is being made");
    drop(Service::start(folder.path()));
    assert!(!drafts[0].exists(), "the start removes it");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_structure_is_deleted_with_all_its_data_and_nothing_else() {
    let (mut service, folder) = spawn();
    with_past(&service, 4).await;
    let (path, asked) = ("/v1/structures/three-dof", "/v1/structures/three-dof?confirm=three-dof");
    let delete = async |service: &Service, path: &str| service.request(Method::DELETE, path).send().await.unwrap();
    for unconfirmed in [path.to_owned(), format!("{path}?confirm=three"), format!("{path}?sure=yes")] {
        problem(delete(&service, &unconfirmed).await, 422, "invalid").await;
    }
    problem(delete(&service, "/v1/structures/none?confirm=none").await, 404, "unknown_structure").await;
    // While a training runs, which would end in a structure that is gone.
    let recipe = json!({ "samples": 20_000, "epochs": 2_000, "units": 16 });
    let begun = service.post(&format!("{path}/trainings"), &recipe).await;
    assert_eq!(begun.status(), 202);
    let training: Value = begun.json().await.unwrap();
    let training = training["training"].as_str().unwrap();
    problem(delete(&service, asked).await, 409, "structure_has_jobs").await;
    let cancelled = service.request(Method::DELETE, &format!("/v1/jobs/{training}")).send().await.unwrap();
    assert!(cancelled.status().is_success(), "{}", cancelled.status());
    within(Duration::from_mins(3), "the end of the training", async || {
        (service.read(&format!("/v1/trainings/{training}")).await["state"] == "cancelled").then_some(())
    })
    .await;
    let others = service.read("/v1/structures").await["items"].as_array().unwrap().len();
    let gone: Value = delete(&service, asked).await.json().await.unwrap();
    assert_eq!(
        (&gone["structure"], &gone["batches"], &gone["measurements"]),
        (&json!("three-dof"), &json!(6), &json!(80)),
        "{gone}"
    );
    problem(service.get(path).send().await.unwrap(), 404, "unknown_structure").await;
    problem(delete(&service, asked).await, 404, "unknown_structure").await;
    let body = json!({ "measurements": measurements([4.0, 5.0, 6.0], 4, 0) });
    problem(service.post("/v1/structures/three-dof/batches", &body).await, 404, "unknown_structure").await;
    assert_eq!(service.read("/v1/structures").await["items"].as_array().unwrap().len(), others - 1);
    let audit = service.read("/v1/audit?limit=1000").await;
    assert!(
        audit["items"].as_array().unwrap().iter().any(|entry| entry["action"] == "DELETE /v1/structures/{id}"),
        "{audit}"
    );
    service.stop("TERM");
    assert!(doctor(folder.path()).contains("all pages and references are intact"));
    // It is part of the program, and returns without data.
    let service = Service::start(folder.path());
    assert_eq!(service.read("/v1/structures/three-dof/history").await["items"], json!([]));
    assert_eq!(service.read("/v1/structures/three-dof/alarms?superseded=true").await["items"], json!([]));
    service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 4, 0)).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_deletion_that_is_killed_goes_on_with_the_next_start() {
    let (mut service, folder) = spawn();
    for day in 0..120 {
        service.post_batch("three-dof", &measurements([4.0, 5.0, 6.0], 4, 86_400 * day)).await;
    }
    settled(&service).await;
    service.stop("TERM");
    // As if it had been killed after the first step.
    execute(folder.path(), "insert into structure_deletion values ('three-dof', 0)").await;
    let service = Service::spawn(&mut command(folder.path()));
    eventually("the end of the deletion", async || {
        let listed = service.read("/v1/structures").await;
        let known = listed["items"].as_array().unwrap().iter().any(|item| item["id"] == "three-dof");
        assert!(!known, "a structure that is being deleted is listed");
        let text = service.get("/metrics").send().await.unwrap().text().await.unwrap();
        let left = text.lines().find_map(|line| line.strip_prefix("modalwatch_structures ")).unwrap().to_owned();
        (left == "2").then_some(())
    })
    .await;
}

#[tokio::test]
async fn a_key_means_the_content_with_which_it_was_answered() {
    let (service, _folder) = spawn();
    let url = "/v1/structures/three-dof/batches";
    let (one, other) = (measurements([4.0, 5.0, 6.0], 4, 0), measurements([4.0, 5.0, 6.0], 4, 86_400));
    let post = async |measurements: &[Value], key: Option<&str>| {
        let mut request = service.request(Method::POST, url).json(&json!({ "measurements": measurements }));
        if let Some(key) = key {
            request = request.header("Idempotency-Key", key);
        }
        request.send().await.unwrap()
    };
    let first = created(post(&one, None).await).await;
    let answer = post(&one, Some("k")).await;
    assert_eq!((answer.status().as_u16(), &answer.headers()["idempotency-replayed"]), (201, &"true".parse().unwrap()));
    // The key is that of the first body now, so that another body is refused and the first is answered as before.
    problem(post(&other, Some("k")).await, 422, "idempotency_key_reused").await;
    let again: Value = post(&one, Some("k")).await.json().await.unwrap();
    assert_eq!(again["batch"], first["batch"]);
    created(post(&other, Some("l")).await).await;
}
