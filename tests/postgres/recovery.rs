//! The state of a server at a chosen moment, from a base backup and the archive of its write-ahead log.

use std::path::Path;
use std::time::Duration;

use reqwest::Method;
use serde_json::json;

use crate::helpers::{created, measurements, time, within, Service, PATIENCE};
use crate::postgres::server::{give_to_server, Server};
use crate::postgres::world::{answers, database_with_tables, pending, serve};

const STRUCTURE: &str = "/v1/structures/three-dof";

/// The time of the server, as `recovery_target_time` takes it.
const NOW: &str = "select clock_timestamp()::text";

/// Posts a batch a day, so many from a day on.
async fn days(service: &Service, from: usize, count: usize, k: [f64; 3]) {
    for day in from..from + count {
        service.post_batch("three-dof", &measurements(k, 10, day * 86_400)).await;
    }
    within(PATIENCE, "the assessments", async || (pending(service).await == 0.0).then_some(())).await;
}

/// Waits until the server has archived all that was written so far.
async fn archived(server: &Server) {
    let segment = server.sql("postgres", "select pg_walfile_name(pg_switch_wal())");
    let done = format!("select coalesce(last_archived_wal >= '{segment}', false) from pg_stat_archiver");
    within(PATIENCE, "the archive", async || (server.sql("postgres", &done) == "t").then_some(())).await;
}

/// A folder for the server below one of the test.
fn folder_for_server(folder: &Path, name: &str) -> String {
    use std::os::unix::fs::PermissionsExt as _;
    std::fs::set_permissions(folder, std::fs::Permissions::from_mode(0o755)).unwrap();
    let path = folder.join(name);
    std::fs::create_dir(&path).unwrap();
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o700)).unwrap();
    give_to_server(&path);
    path.display().to_string()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_server_that_is_recovered_to_a_moment_answers_what_was_known_then_and_goes_on() {
    if !Server::is_installed() {
        return;
    }
    let [place, data] = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let archive = folder_for_server(place.path(), "archive");
    let command = format!("archive_command=test ! -f {archive}/%f && cp %p {archive}/%f");
    let server = Server::start(&["-c", "archive_mode=on", "-c", &command, "-c", "wal_level=replica"]);
    let url = database_with_tables(&server, data.path());
    let mut service = Service::spawn(&mut serve(data.path(), &url));
    days(&service, 0, 8, [4.0, 5.0, 6.0]).await;
    let reference = json!({ "from": time(0), "to": time(6 * 86_400) });
    created(service.post(&format!("{STRUCTURE}/reference"), &reference).await).await;

    // The base, while the service runs.
    let base = folder_for_server(place.path(), "base");
    let from = format!("postgres://modalwatch@{}/postgres", server.address());
    Server::tool_of_server("pg_basebackup", &["-d", &from, "-D", &base, "-X", "none", "--checkpoint=fast"]);

    // What came between the base and the moment is in the archive only.
    days(&service, 8, 4, [4.0, 3.8, 6.0]).await;
    let comment = json!({ "text": "seen", "author": "Ann" });
    created(service.post(&format!("{STRUCTURE}/alarms/1/comments"), &comment).await).await;
    let then = answers(&service, "three-dof").await;
    assert_eq!(then[&format!("{STRUCTURE}/alarms")]["body"]["items"].as_array().unwrap().len(), 1, "{then:?}");
    tokio::time::sleep(Duration::from_millis(50)).await;
    let moment = server.sql("postgres", NOW);
    tokio::time::sleep(Duration::from_millis(50)).await;

    // A mistake after it: the structure is deleted. What comes in meanwhile is lost with the recovery.
    days(&service, 12, 2, [4.0, 3.8, 6.0]).await;
    let deleted = service.request(Method::DELETE, &format!("{STRUCTURE}?confirm=three-dof")).send().await.unwrap();
    assert!(deleted.status().is_success(), "{}", deleted.text().await.unwrap());
    within(PATIENCE, "the deletion", async || {
        let rows = server.sql(url.rsplit_once('/').unwrap().1, "select count(*) from modalwatch.measurement");
        (rows == "0").then_some(())
    })
    .await;
    archived(&server).await;
    assert!(service.stop("TERM").success());
    server.kill();

    let restore = format!("restore_command = 'cp {archive}/%f %p'");
    let target = format!("recovery_target_time = '{moment}'\nrecovery_target_action = 'promote'");
    let settings = Path::new(&base).join("postgresql.auto.conf");
    let text = std::fs::read_to_string(&settings).unwrap();
    std::fs::write(&settings, format!("{text}\n{restore}\n{target}\n")).unwrap();
    std::fs::write(Path::new(&base).join("recovery.signal"), "").unwrap();
    give_to_server(Path::new(&base));
    let recovered = Server::start_on(&base, &[]);
    within(PATIENCE, "the recovery", async || {
        (recovered.sql("postgres", "select pg_is_in_recovery()") == "f").then_some(())
    })
    .await;

    let url = recovered.url(url.rsplit_once('/').unwrap().1);
    let mut service = Service::spawn(&mut serve(data.path(), &url));
    assert_eq!(answers(&service, "three-dof").await, then);
    // It goes on, also with what was sent after the moment.
    days(&service, 12, 2, [4.0, 3.8, 6.0]).await;
    assert!(service.stop("TERM").success());
}
