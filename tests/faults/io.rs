//! Writes and syncs that fail: `fiu` makes the system calls of the unmodified program fail, once, at random, or always.

use std::io::{BufRead as _, BufReader};
use std::path::Path;
use std::process::{Child, Command, ExitStatus};

use crate::faults::kit::{all_assessed, audit, batch, post, ready, ready_again, Acknowledged};
use crate::helpers::{command, exit_within, Service, PATIENCE};
use crate::needs;

/// Batches posted under each kind of fault.
const PER_CASE: usize = 16;

const PRELOAD: &str = "/usr/lib/fiu/fiu_run_preload.so /usr/lib/fiu/fiu_posix_preload.so";

/// Starts a program under fault injection, as `fiu-run -x` does.
fn controlled(data_dir: &Path, control: &Path) -> Command {
    let mut command = command(data_dir);
    command.env("LD_PRELOAD", PRELOAD).env("FIU_ENABLE", "").env("FIU_CTRL_FIFO", control);
    command.env("MODALWATCH__LOG__LEVEL", "error");
    command
}

/// The status of a program that ends by itself; `None` for one that listens.
fn ended_by_itself(child: &mut Child) -> Option<ExitStatus> {
    let stdout = child.stdout.take().unwrap();
    let (said, line) = std::sync::mpsc::channel();
    std::thread::spawn(move || {
        let mut text = String::new();
        // Without a line the program has closed its output, because it ends.
        let _ = BufReader::new(stdout).read_line(&mut text);
        let _ = said.send(text);
    });
    match line.recv_timeout(PATIENCE) {
        Ok(text) if !text.is_empty() => None,
        _ => exit_within(child, PATIENCE),
    }
}

/// Sets the system calls of the running program that fail.
fn control(service: &Service, control: &Path, order: &str) {
    let output =
        Command::new("fiu-ctrl").arg("-f").arg(control).args(["-c", order, &service.pid().to_string()]).output();
    let output = output.unwrap();
    assert!(output.status.success(), "{order}: {}", String::from_utf8_lossy(&output.stderr));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn what_is_acknowledged_while_writes_and_syncs_fail_is_there_afterwards() {
    if needs::program("fiu-ctrl").is_none() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (data, fifo) = (folder.path().join("data"), folder.path().join("control"));
    let mut service = Service::spawn(&mut controlled(&data, &fifo));
    let mut acknowledged = Acknowledged::default();
    let mut failed = 0;
    let (eio, enospc) = ("failinfo=5", "failinfo=28");
    let cases = [
        ("posix/io/sync/fsync", format!("onetime,{eio}")),
        ("posix/io/rw/pwrite", format!("onetime,{eio}")),
        ("posix/io/sync/fsync", format!("probability=0.3,{eio}")),
        ("posix/io/rw/pwrite", format!("probability=0.1,{eio}")),
        ("posix/io/rw/pwrite", format!("probability=0.1,{enospc}")),
        ("posix/io/rw/pwrite/reduce", "probability=0.1".to_owned()),
        ("posix/io/rw/ftruncate", format!("probability=0.5,{eio}")),
        ("posix/io/rw/pread", format!("probability=0.05,{eio}")),
        ("posix/io/sync/fsync", eio.to_owned()),
        ("posix/io/rw/pwrite", eio.to_owned()),
    ];
    for (case, (point, how)) in cases.iter().enumerate() {
        let source = format!("case{case}");
        let (random, for_ever) =
            (how.contains("probability"), !how.contains("probability") && !how.contains("onetime"));
        let verb = if random { "enable_random" } else { "enable" };
        control(&service, &fifo, &format!("{verb} name={point},{how}"));
        let mut refused = Vec::new();
        for number in 0..PER_CASE {
            let given = batch(&source, number, 2);
            let (status, answer) = post(&service, &given).await.expect("the service stays up");
            match status {
                201 => acknowledged.add(&given, &answer),
                500..=599 => refused.push(given),
                _ => panic!("{point} {how}: {status}: {answer}"),
            }
        }
        if for_ever {
            assert_eq!(refused.len(), PER_CASE, "{point} fails always, and yet a batch was acknowledged");
            let (is_ready, reasons) = ready(&service).await;
            assert!(!is_ready, "{point}: {reasons}");
        }
        control(&service, &fifo, &format!("disable name={point}"));
        // The service recovers without a restart, and a retry stores one batch.
        ready_again(&service).await;
        failed += refused.len();
        println!("{point} {how}: {} of {PER_CASE} refused", refused.len());
        for given in refused {
            let (status, answer) = post(&service, &given).await.unwrap();
            assert_eq!(status, 201, "{point} {how}: {answer}");
            acknowledged.add(&given, &answer);
        }
    }
    assert!(failed >= 3 * PER_CASE, "only {failed} posts had a fault: the test shows little");
    all_assessed(&service).await;
    service.kill();
    let mut service = Service::start(&data);
    all_assessed(&service).await;
    assert!(service.stop("TERM").success());
    let audit = audit(&data, &acknowledged).await;
    assert_eq!((audit.stored, audit.unassessed), (cases.len() * PER_CASE, 0), "each batch once");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_start_on_a_failing_disk_says_so_or_works_and_loses_nothing() {
    if needs::program("fiu-ctrl").is_none() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let mut acknowledged = Acknowledged::default();
    let mut service = Service::start(folder.path());
    for number in 0..10 {
        let given = batch("before", number, 5);
        acknowledged.add(&given, &post(&service, &given).await.unwrap().1);
    }
    service.kill();
    let mut refusals = 0;
    for (point, probability) in
        [("pwrite", 1.0), ("pwrite", 0.5), ("sync/fsync", 1.0), ("sync/fsync", 0.5), ("pread", 1.0), ("pread", 0.1)]
    {
        let point = if point.contains('/') { format!("posix/io/{point}") } else { format!("posix/io/rw/{point}") };
        let mut command = controlled(folder.path(), Path::new(""));
        command.env("FIU_ENABLE", format!("enable_random name={point},probability={probability},failinfo=5"));
        command.stdout(std::process::Stdio::piped()).stderr(std::process::Stdio::piped());
        let mut child = command.spawn().unwrap();
        // The program either stops by itself with a reason or starts; in the second case it is killed.
        if let Some(status) = ended_by_itself(&mut child) {
            let mut said = String::new();
            std::io::Read::read_to_string(&mut child.stderr.take().unwrap(), &mut said).unwrap();
            assert!(!status.success() && said.contains("modalwatch: "), "{point} {probability}: {status} {said}");
            assert!(!said.contains("panicked"), "{point} {probability}: {said}");
            refusals += 1;
        } else {
            child.kill().unwrap();
            child.wait().unwrap();
        }
    }
    assert!(refusals >= 2, "{refusals} of 6 starts were refused");
    Service::start(folder.path()).stop("TERM");
    audit(folder.path(), &acknowledged).await;
}
