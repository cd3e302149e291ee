//! Clock jumps: `faketime` changes the system clock of the running program; the monotonic clock of its timers is not affected.

use std::path::Path;
use std::process::Command;
use std::time::Duration;

use modalwatch::measurement::MeasurementBatch;
use modalwatch::quantity::StructureId;
use serde_json::{json, Value};

use crate::faults::kit::{audit, batch, body, define_as, history, post, ready, Acknowledged, BATCHES};
use crate::helpers::{command, created, eventually, within, Service};
use crate::needs;

/// A structure whose id comes after three-dof.
const OTHER: &str = "three-dof-too";

const LIBRARY: &str = "/usr/lib/x86_64-linux-gnu/faketime/libfaketimeMT.so.1";

/// Longer than two checks of the service, which come every five seconds.
const TWO_CHECKS: Duration = Duration::from_secs(11);

/// Sets the program's clock: `+0`, `-365d`, or a time at which it stands still.
fn set(file: &Path, time: &str) {
    // Written to another file and renamed, because the program may read it at any moment.
    let beside = file.with_extension("new");
    std::fs::write(&beside, format!("{time}\n")).unwrap();
    std::fs::rename(&beside, file).unwrap();
}

/// Command line of a service whose clock is [`set`] by a file.
fn command_with_clock(data: &Path, file: &Path) -> Command {
    let mut command = command(data);
    command.env("LD_PRELOAD", LIBRARY).env("FAKETIME_TIMESTAMP_FILE", file).env("FAKETIME_NO_CACHE", "1");
    // Only the system clock can be set; the monotonic clock never jumps.
    command.env("FAKETIME_DONT_FAKE_MONOTONIC", "1").env("DONT_FAKE_MONOTONIC", "1");
    command
}

/// Open silence alarms of a structure.
async fn silence_alarms(service: &Service, structure: &str) -> usize {
    let alarms = service.read(&format!("/v1/structures/{structure}/alarms")).await;
    let open = |a: &&Value| a["kind"] == "silence" && a["ended_at"].is_null();
    alarms["items"].as_array().unwrap().iter().filter(open).count()
}

/// Waits until a structure has this number of open silence alarms.
async fn wait_for_silence(service: &Service, structure: &str, wanted: usize) {
    let what = format!("{wanted} alarms of silence of {structure}");
    eventually(&what, async || (silence_alarms(service, structure).await == wanted).then_some(())).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_clock_that_jumps_or_stands_still_keeps_batches_in_order_and_answers_current() {
    if !needs::installed(Path::new(LIBRARY)) {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (data, file) = (folder.path().join("data"), folder.path().join("clock"));
    set(&file, "+0");
    let mut command = command_with_clock(&data, &file);
    let mut service = Service::spawn(command.env("MODALWATCH__MONITOR__ALARM__SILENCE_AFTER_S", "3600"));
    let mut acknowledged = Acknowledged::default();
    let mut number = 0;
    let mut take = async |service: &Service| {
        let given = batch("logger", number, 10);
        number += 1;
        let answer = created(service.post(BATCHES, &body(&given)).await).await;
        assert_eq!(answer["state"], "assessed", "{answer}");
        acknowledged.add(&given, &answer);
        answer
    };
    let undamaged = take(&service).await["batch"].clone();
    let other = take(&service).await["batch"].as_str().unwrap().to_owned();

    // The clock is set back by a year: measurements of the present are refused with the reason, those of a year ago are accepted.
    set(&file, "-365d");
    let (status, answer) = post(&service, &batch("logger", 2, 10)).await.unwrap();
    let year =
        answer["detail"].as_str().unwrap_or_default().contains("in the future: the clock of the service shows 20");
    assert!(status == 422 && year, "{answer}");
    let early =
        json!({ "measurements": [{ "measured_at": "2020-06-01T00:00:00Z", "frequencies_hz": [0.49, 0.92, 1.24] }] });
    let early = created(service.post(BATCHES, &early).await).await;
    assert!(early["received_at"].as_str() < Some("2026"), "the clock is not set back: {early}");
    // The newest assessment is the current one, although its time is earlier than that of the previous one.
    let declared = service.post("/v1/structures/three-dof/reference", &json!({ "batches": [undamaged] })).await;
    created(declared).await;
    let path = format!("{BATCHES}/{other}");
    eventually("the comparison", async || {
        (service.read(&path).await["assessment"]["undamaged_version"] == 1).then_some(())
    })
    .await;

    // The clock is set ahead by a day, and to the present again: that day was no silence.
    for time in ["+1d", "+0"] {
        set(&file, time);
        take(&service).await;
        tokio::time::sleep(TWO_CHECKS).await;
        assert_eq!(silence_alarms(&service, "three-dof").await, 0, "{time}");
    }

    // The clock stands still: ids are still distinct, and requests still time out by the monotonic clock.
    set(&file, "2027-01-01 00:00:00");
    let mut ids: Vec<String> = Vec::new();
    for _ in 0..8 {
        ids.push(take(&service).await["batch"].as_str().unwrap().to_owned());
    }
    ids.sort();
    ids.dedup();
    assert_eq!(ids.len(), 8);
    assert!(ready(&service).await.0);
    let page = service.read("/v1/structures/three-dof/history?limit=100").await;
    let times: Vec<&str> =
        page["items"].as_array().unwrap().iter().map(|i| i["measured_from"].as_str().unwrap()).collect();
    assert!(times.is_sorted() && times.len() == 13, "{times:?}");
    assert!(service.stop("TERM").success());

    // The next start uses the correct clock.
    let mut service = Service::start(&data);
    assert_eq!(history(&service).await.len(), 13);
    assert!(service.stop("TERM").success());
    audit(&data, &acknowledged).await;
}

/// A small computer takes the local time of its hardware clock for UTC until the clock is set.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn after_a_clock_that_was_two_hours_ahead_silence_is_noticed_and_none_while_batches_come() {
    if !needs::installed(Path::new(LIBRARY)) {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (data, file) = (folder.path().join("data"), folder.path().join("clock"));
    set(&file, "+2h");
    let start = || {
        let mut command = command_with_clock(&data, &file);
        Service::spawn(command.env("MODALWATCH__MONITOR__ALARM__SILENCE_AFTER_S", "8"))
    };
    let mut service = start();
    let mut number = 0;
    let mut take = async |service: &Service| {
        number += 1;
        created(service.post(BATCHES, &body(&batch("logger", number, 10))).await).await
    };
    let ahead = take(&service).await;
    set(&file, "+0");
    let right = take(&service).await;
    assert!(right["received_at"].as_str() < ahead["received_at"].as_str(), "{right} after {ahead}");
    define_as(&service, OTHER).await;
    let other = MeasurementBatch { structure: StructureId::parse(OTHER).unwrap(), ..batch("other", 0, 10) };
    assert_eq!(post(&service, &other).await.unwrap().0, 201);
    wait_for_silence(&service, "three-dof", 1).await;
    wait_for_silence(&service, OTHER, 1).await;
    take(&service).await;
    wait_for_silence(&service, "three-dof", 0).await;

    // The next process does not know that the clock was ahead, and the ids of the first batches are of that time.
    service.kill();
    let service = start();
    for _ in 0..20 {
        let last = take(&service).await;
        assert_eq!(silence_alarms(&service, "three-dof").await, 0, "a batch has just come");
        let overview = service.read("/v1/overview").await;
        let mut structures = overview["items"].as_array().unwrap().iter();
        let own = structures.find(|structure| structure["id"] == "three-dof").unwrap();
        assert_eq!(own["last_received_at"], last["received_at"], "{own}");
        tokio::time::sleep(Duration::from_secs(1)).await;
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_diagnosis_runs_on_schedule_only_after_new_batches_and_a_restart_does_not_repeat_it() {
    if !needs::installed(Path::new(LIBRARY)) {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (data, file) = (folder.path().join("data"), folder.path().join("clock"));
    let weekly = || {
        let mut command = command_with_clock(&data, &file);
        Service::spawn(command.env("MODALWATCH__DIAGNOSIS__EVERY_DAYS", "7"))
    };
    let ended = async |service: &Service, wanted: usize| {
        let listed = within(Duration::from_mins(3), "a diagnosis on schedule", async || {
            let listed = service.read("/v1/structures/three-dof/diagnoses").await["items"].as_array().unwrap().clone();
            let ended = listed.iter().all(|item| item["state"] != "running");
            (listed.len() >= wanted && ended).then_some(listed)
        });
        let listed = listed.await;
        assert_eq!(listed.len(), wanted, "{listed:?}");
        assert!(listed.iter().all(|item| item["trigger"] == "schedule" && item["state"] == "done"), "{listed:?}");
    };
    let two_checks = || tokio::time::sleep(TWO_CHECKS);

    set(&file, "+0");
    let mut service = weekly();
    created(service.post(BATCHES, &body(&batch("logger", 0, 40))).await).await;
    two_checks().await;
    ended(&service, 0).await;
    set(&file, "+8d");
    ended(&service, 1).await;
    // Another week without a batch.
    set(&file, "+16d");
    two_checks().await;
    ended(&service, 1).await;
    created(service.post(BATCHES, &body(&batch("logger", 1, 40))).await).await;
    ended(&service, 2).await;
    service.kill();
    let service = weekly();
    created(service.post(BATCHES, &body(&batch("logger", 2, 40))).await).await;
    two_checks().await;
    ended(&service, 2).await;
}
