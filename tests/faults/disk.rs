//! Full disks, and database files that cannot grow, are deleted or locked: writes are refused, reads are served, and the service
//! recovers by itself.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::time::Duration;

use serde_json::{json, Value};
use tempfile::TempDir;

use crate::faults::kit::{
    all_assessed, audit, batch, define_plain, history, history_of, plain_batch, post, ready, ready_again,
    without_floor, Acknowledged, PLAIN,
};
use crate::helpers::{command, eventually, Service};
use crate::needs;

/// A file system of a few MiB in memory.
struct SmallDisk {
    folder: TempDir,
}

impl SmallDisk {
    /// Mounts one. If that is not permitted, returns `None` and records the test as skipped.
    fn mount(mebibytes: usize) -> Option<Self> {
        let folder = tempfile::tempdir().unwrap();
        let size = format!("size={mebibytes}m");
        let mounted = Command::new("mount").args(["-t", "tmpfs", "-o", &size, "tmpfs"]).arg(folder.path()).output();
        if mounted.is_ok_and(|output| output.status.success()) {
            return Some(Self { folder });
        }
        needs::missing("only root may mount a small file system");
        None
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("-l").arg(self.folder.path()).status();
    }
}

/// Posts batches until three in a row are refused; each refusal must be a 503 or a 507 with the reason.
async fn fill(service: &Service, acknowledged: &mut Acknowledged) -> usize {
    let (mut number, mut refused) = (0, 0);
    while refused < 3 {
        assert!(number < 2_000, "the disk does not fill up");
        let given = plain_batch("filler", number, 150);
        number += 1;
        let (status, answer) = post(service, &given).await.unwrap();
        if status == 201 {
            acknowledged.add(&given, &answer);
            refused = 0;
        } else {
            refusal(status, &answer);
            refused += 1;
        }
    }
    number
}

/// A write that failed is answered 503 or 507 with its own code.
fn refusal(status: u16, answer: &Value) {
    assert!([503, 507].contains(&status), "{status}: {answer}");
    assert!(answer["code"].is_string() && answer["code"] != "internal", "{answer}");
}

/// While the disk is full, everything that was acknowledged can be read and nothing is written; then the disk has space again.
async fn full_and_healed(service: &Service, acknowledged: &mut Acknowledged, heal: impl FnOnce()) {
    define_plain(service).await;
    let early = batch("early", 0, 10);
    acknowledged.add(&early, &post(service, &early).await.unwrap().1);
    let refused = fill(service, acknowledged).await - 1;
    // The result of a check of the disk is used for a second, unless a write was refused since then: the next check writes
    // again and uses the last free bytes of the log.
    let mut reasons = Value::Null;
    for number in 0..2_000 {
        let crumb = plain_batch("crumb", number, 1);
        let (status, answer) = post(service, &crumb).await.unwrap();
        if status == 201 {
            acknowledged.add(&crumb, &answer);
        } else {
            refusal(status, &answer);
        }
        let (is_ready, found) = ready(service).await;
        if !is_ready {
            reasons = found;
            break;
        }
    }
    assert!(reasons.to_string().contains("nothing can be stored"), "{reasons}");
    assert_eq!(service.get("/healthz").send().await.unwrap().status(), 200);
    let stored = &history(service).await | &history_of(service, PLAIN).await;
    assert!(acknowledged.0.keys().all(|id| stored.contains(id)), "reads must still be served");
    let some = acknowledged.0.keys().next_back().unwrap();
    let read = service.read(&format!("/v1/structures/{PLAIN}/batches/{some}")).await;
    assert_eq!(read["content_digest"], acknowledged.0[some].as_str());
    // A batch that is assessed as well.
    let during = batch("during", 0, 10);
    let (status, answer) = post(service, &during).await.unwrap();
    if status == 201 {
        // Its measurements took the last bytes: the answer says that it is stored and waits.
        assert_eq!(answer["state"], "received", "{answer}");
        acknowledged.add(&during, &answer);
    } else {
        refusal(status, &answer);
    }
    let during_is_stored = status == 201;

    heal();
    ready_again(service).await;
    // The batch that was refused is now stored, once, and batches whose assessment could not be stored are assessed without a
    // further request.
    for given in [plain_batch("filler", refused, 150), batch("during", 0, 10), batch("after", 0, 10)] {
        let (status, answer) = post(service, &given).await.unwrap();
        assert_eq!(status, if during_is_stored && given == during { 200 } else { 201 }, "{answer}");
        assert_eq!(
            answer["state"],
            if given.structure.as_str() == PLAIN { "received" } else { "assessed" },
            "{answer}"
        );
        acknowledged.add(&given, &answer);
    }
    all_assessed(service).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_full_disk_refuses_writes_serves_reads_and_heals_without_a_restart() {
    let Some(disk) = SmallDisk::mount(7) else { return };
    let data = disk.folder.path().join("data");
    let mut service = Service::spawn(without_floor(&mut command(&data)));
    // The database is small, so that the log is soon written back.
    let ballast = disk.folder.path().join("ballast");
    std::fs::write(&ballast, vec![0; 4 << 20]).unwrap();
    let mut acknowledged = Acknowledged::default();
    full_and_healed(&service, &mut acknowledged, || std::fs::remove_file(&ballast).unwrap()).await;
    assert!(service.stop("TERM").success());
    let audit = audit(&data, &acknowledged).await;
    println!("{} acknowledged, {} stored", acknowledged.0.len(), audit.stored);
    assert_eq!(audit.unassessed, 0);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn after_a_kill_on_a_full_disk_the_service_starts_reads_and_heals() {
    let Some(disk) = SmallDisk::mount(7) else { return };
    let data = disk.folder.path().join("data");
    let mut service = Service::spawn(without_floor(&mut command(&data)));
    define_plain(&service).await;
    let ballast = disk.folder.path().join("ballast");
    std::fs::write(&ballast, vec![0; 4 << 20]).unwrap();
    let mut acknowledged = Acknowledged::default();
    fill(&service, &mut acknowledged).await;
    service.kill();
    // Not a byte is left.
    let _ = std::fs::write(disk.folder.path().join("crumbs"), vec![0; 8 << 20]);
    let mut service = Service::spawn(without_floor(&mut command(&data)));
    let stored = history_of(&service, PLAIN).await;
    assert!(acknowledged.0.keys().all(|id| stored.contains(id)), "reads must be served");
    // The start writes the log back, which may have made room.
    let mut number = 0;
    let reasons = eventually("the full disk is found", async || {
        number += 1;
        let _ = std::fs::write(disk.folder.path().join(format!("crumbs-{number}")), vec![0; 8 << 20]);
        let (is_ready, reasons) = ready(&service).await;
        (!is_ready).then_some(reasons)
    })
    .await;
    assert!(reasons.to_string().contains("nothing can be stored"), "{reasons}");
    let (status, answer) = post(&service, &plain_batch("full", 0, 150)).await.unwrap();
    refusal(status, &answer);
    std::fs::remove_file(&ballast).unwrap();
    for entry in std::fs::read_dir(disk.folder.path()).unwrap().map(Result::unwrap) {
        if entry.file_name().to_string_lossy().starts_with("crumbs") {
            std::fs::remove_file(entry.path()).unwrap();
        }
    }
    ready_again(&service).await;
    let given = plain_batch("after", 0, 150);
    let (status, answer) = post(&service, &given).await.unwrap();
    assert_eq!(status, 201, "{answer}");
    acknowledged.add(&given, &answer);
    assert!(service.stop("TERM").success());
    audit(&data, &acknowledged).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn files_that_may_not_grow_refuse_writes_and_heal_without_a_restart() {
    if needs::program("prlimit").is_none() || needs::program("bash").is_none() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let plain = command(folder.path());
    // The signal that the limit raises would end the program; this test is about the write that fails.
    let mut limited = Command::new("bash");
    limited.args(["-c", "trap '' XFSZ; ulimit -S -f 1500; exec \"$0\" \"$@\""]);
    limited.arg(plain.get_program()).args(plain.get_args()).env("MODALWATCH__LOG__LEVEL", "error");
    let mut service = Service::spawn(without_floor(&mut limited));
    let mut acknowledged = Acknowledged::default();
    let pid = service.pid().to_string();
    let heal = || {
        let raised = Command::new("prlimit").args(["--pid", &pid, "--fsize=unlimited:"]).status().unwrap();
        assert!(raised.success());
    };
    full_and_healed(&service, &mut acknowledged, heal).await;
    assert!(service.stop("TERM").success());
    assert_eq!(audit(folder.path(), &acknowledged).await.unassessed, 0);
}

fn database(folder: &Path) -> PathBuf {
    folder.join("modalwatch.sqlite")
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_database_that_is_deleted_while_open_acknowledges_nothing_more() {
    let folder = tempfile::tempdir().unwrap();
    let mut service = Service::start(folder.path());
    let mut acknowledged = Acknowledged::default();
    for number in 0..5 {
        let given = batch("before", number, 5);
        acknowledged.add(&given, &post(&service, &given).await.unwrap().1);
    }
    let away = folder.path().join("away");
    for file in ["modalwatch.sqlite", "modalwatch.sqlite-wal"] {
        std::fs::rename(folder.path().join(file), &away).unwrap();
        for number in 0..3 {
            let given = batch(file.strip_prefix("modalwatch.").unwrap(), number, 5);
            let (status, answer) = post(&service, &given).await.unwrap();
            assert_eq!((status, &answer["code"]), (503, &json!("database_gone")), "{file}: {answer}");
        }
        let (is_ready, reasons) = ready(&service).await;
        assert!(!is_ready && reasons.to_string().contains("deleted or replaced"), "{reasons}");
        assert_eq!(service.get("/healthz").send().await.unwrap().status(), 200);
        // If the file is put back before anything is written, the service continues.
        std::fs::rename(&away, folder.path().join(file)).unwrap();
        ready_again(&service).await;
    }
    // The file is replaced by another one of the same name.
    std::fs::copy(database(folder.path()), &away).unwrap();
    std::fs::rename(database(folder.path()), folder.path().join("original")).unwrap();
    std::fs::rename(&away, database(folder.path())).unwrap();
    let (status, answer) = post(&service, &batch("replaced", 0, 5)).await.unwrap();
    assert_eq!((status, &answer["code"]), (503, &json!("database_gone")), "{answer}");
    std::fs::rename(folder.path().join("original"), database(folder.path())).unwrap();

    let given = batch("after", 0, 5);
    let (status, answer) = post(&service, &given).await.unwrap();
    assert_eq!(status, 201, "{answer}");
    acknowledged.add(&given, &answer);
    service.kill();
    Service::start(folder.path()).stop("TERM");
    audit(folder.path(), &acknowledged).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_writer_from_outside_is_waited_for_and_then_refused_and_a_long_reader_costs_only_space() {
    use sqlx::Connection as _;
    let folder = tempfile::tempdir().unwrap();
    let mut service = Service::start(folder.path());
    let mut acknowledged = Acknowledged::default();
    let options = sqlx_sqlite::SqliteConnectOptions::new().filename(database(folder.path()));
    let mut other = sqlx_sqlite::SqliteConnection::connect_with(&options).await.unwrap();
    define_plain(&service).await;
    let given = batch("before", 0, 5);
    acknowledged.add(&given, &post(&service, &given).await.unwrap().1);

    // A long read transaction prevents that the log is written back: the log grows, with no other effect.
    sqlx::query("begin").execute(&mut other).await.unwrap();
    sqlx::query("select count(*) from measurement").fetch_all(&mut other).await.unwrap();
    let log = folder.path().join("modalwatch.sqlite-wal");
    let mut number = 0;
    while std::fs::metadata(&log).unwrap().len() < 8 << 20 {
        let given = plain_batch("during", number, 150);
        let (status, answer) = post(&service, &given).await.unwrap();
        assert_eq!(status, 201, "{answer}");
        acknowledged.add(&given, &answer);
        number += 1;
        assert!(number < 1_000);
    }
    sqlx::query("rollback").execute(&mut other).await.unwrap();
    let grown = std::fs::metadata(&log).unwrap().len();
    for number in 0..40 {
        let given = plain_batch("later", number, 150);
        acknowledged.add(&given, &post(&service, &given).await.unwrap().1);
    }
    let after = std::fs::metadata(&log).unwrap().len();
    assert!(after <= grown + (2 << 20), "the log goes on growing: {grown}, then {after} bytes");

    // The service waits for a writer that holds the lock for a second. The fixed time is what is tested.
    sqlx::query("begin immediate").execute(&mut other).await.unwrap();
    let waiting = batch("waiting", 0, 5);
    let (answered, ()) = tokio::join!(post(&service, &waiting), async {
        tokio::time::sleep(Duration::from_secs(1)).await;
        // Reads do not wait.
        assert_eq!(history(&service).await.len(), 1);
        sqlx::query("rollback").execute(&mut other).await.unwrap();
    });
    let (status, answer) = answered.unwrap();
    assert_eq!(status, 201, "{answer}");
    acknowledged.add(&waiting, &answer);

    // It does not wait for a longer lock, and continues once the lock is released.
    sqlx::query("begin immediate").execute(&mut other).await.unwrap();
    let refused = batch("refused", 0, 5);
    let (status, answer) = post(&service, &refused).await.unwrap();
    refusal(status, &answer);
    sqlx::query("rollback").execute(&mut other).await.unwrap();
    let (status, answer) = post(&service, &refused).await.unwrap();
    assert_eq!(status, 201, "{answer}");
    acknowledged.add(&refused, &answer);
    other.close().await.unwrap();
    assert!(service.stop("TERM").success());
    audit(folder.path(), &acknowledged).await;
}
