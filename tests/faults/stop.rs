//! Shutdown: SIGTERM with a request that never ends, while something computes, during the start, and a second SIGTERM.

use std::fmt::Write as _;
use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::path::Path;
use std::process::Stdio;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::Arc;
use std::time::{Duration, Instant};

use reqwest::Method;
use serde_json::{json, Value};

use crate::faults::kit::{
    audit, batch, body, define_as, define_plain, plain_batch, post, Acknowledged, BATCHES, PLAIN,
};
use crate::helpers::{command, eventually, exit_within, within, Service, PATIENCE};

/// A request whose body never arrives; the service waits for it, because it has requested the body.
fn hanging(service: &Service) -> TcpStream {
    let mut stream = TcpStream::connect(service.address()).unwrap();
    let head = format!(
        "POST {BATCHES} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\nContent-Length: 1000\r\n\
         Expect: 100-continue\r\n\r\n"
    );
    stream.write_all(head.as_bytes()).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    let mut answer = [0; 12];
    stream.read_exact(&mut answer).unwrap();
    assert_eq!(&answer, b"HTTP/1.1 100");
    stream
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_request_that_never_ends_holds_the_stop_no_longer_than_the_drain_time() {
    let folder = tempfile::tempdir().unwrap();
    let mut command = command(folder.path());
    let mut service = Service::spawn(command.env("MODALWATCH__HTTP__DRAIN_S", "1"));
    let _hanging = hanging(&service);
    let started = Instant::now();
    let status = service.stop("TERM");
    assert!(status.success(), "{status}");
    // With the drain time of the defaults it would be 30 s.
    assert!(started.elapsed() < Duration::from_secs(25), "it took {:?}", started.elapsed());
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_second_sigterm_ends_the_process_at_once_and_what_was_acknowledged_stays() {
    let folder = tempfile::tempdir().unwrap();
    let mut service = Service::start(folder.path());
    let mut acknowledged = Acknowledged::default();
    let first = batch("a", 0, 5);
    acknowledged.add(&first, &post(&service, &first).await.unwrap().1);
    let _hanging = hanging(&service);
    // Clients post until the service stops.
    let (url, client) = (format!("http://{}{BATCHES}", service.address()), service.client.clone());
    let answered = Arc::new(AtomicUsize::new(0));
    let counter = Arc::clone(&answered);
    let load = tokio::spawn(async move {
        let mut taken = Vec::new();
        for number in 0.. {
            let given = batch("b", number, 5);
            let Ok(response) = client.post(&url).json(&body(&given)).send().await else { break };
            if response.status() != 201 {
                break;
            }
            let Ok(answer) = response.json::<serde_json::Value>().await else { break };
            taken.push((given, answer));
            counter.fetch_add(1, Ordering::Relaxed);
        }
        taken
    });
    eventually("some answers", async || (answered.load(Ordering::Relaxed) >= 5).then_some(())).await;
    service.signal("TERM");
    // Once the service accepts no more connections, it has received the first signal.
    eventually("the end of listening", async || TcpStream::connect(service.address()).err()).await;
    let started = Instant::now();
    // The drain time is 30 s: only the second signal can end it now.
    let status = service.stop("TERM");
    assert!(!status.success(), "it was cut off: {status}");
    assert!(started.elapsed() < Duration::from_secs(25), "it took {:?}", started.elapsed());
    for (given, answer) in load.await.unwrap() {
        acknowledged.add(&given, &answer);
    }
    audit(folder.path(), &acknowledged).await;
}

/// The drain time of the services below, s.
const DRAIN_S: u64 = 1;

/// Time that the end may take in addition to the drain time: that of the parts behind the requests, and of what computes.
const BEHIND: Duration = Duration::from_secs(2);

fn start(data_dir: &Path) -> Service {
    Service::spawn(command(data_dir).env("MODALWATCH__HTTP__DRAIN_S", DRAIN_S.to_string()))
}

/// SIGTERM must end the process in order and in time.
fn ends_in_time(service: &mut Service, while_it: &str) {
    let begun = Instant::now();
    let status = service.stop("TERM");
    assert!(status.success(), "{while_it}: {status}");
    let (took, limit) = (begun.elapsed(), Duration::from_secs(DRAIN_S) + BEHIND);
    println!("stopped while it {while_it}: {took:?}");
    assert!(took <= limit, "{while_it}: {took:?} instead of {limit:?}");
}

/// Waits until a job of the service does what is named.
async fn does(service: &Service, path: &str, what: &str) {
    within(Duration::from_mins(1), what, async || {
        let job = service.read(path).await;
        assert!(job["state"] == "running" || job["state"] == "waiting", "too early: {job}");
        job["progress"].as_str().is_some_and(|progress| progress.contains(what)).then_some(())
    })
    .await;
}

async fn begins(service: &Service, path: &str, body: &Value, id: &str) -> String {
    let answer = service.post(path, body).await;
    let (status, answer) = (answer.status(), answer.json::<Value>().await.unwrap());
    assert_eq!(status, 202, "{answer}");
    answer[id].as_str().unwrap().to_owned()
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_does_not_wait_for_a_training_or_a_diagnosis_and_the_next_start_knows_them() {
    let folder = tempfile::tempdir().unwrap();
    let mut service = start(folder.path());
    define_plain(&service).await;
    for number in 0..4 {
        assert_eq!(post(&service, &plain_batch("a", number, 500)).await.unwrap().0, 201);
    }
    // Minutes of simulations, during which a training reports nothing; minutes of epochs, after each of which it does.
    let trainings = [
        (json!({ "samples": 2_000_000, "epochs": 2_000 }), "simulating"),
        (json!({ "samples": 20_000, "epochs": 2_000, "units": 16 }), "epoch"),
    ];
    for (recipe, doing) in trainings {
        let path = format!("/v1/structures/{PLAIN}");
        let training = begins(&service, &format!("{path}/trainings"), &recipe, "training").await;
        let training = format!("/v1/trainings/{training}");
        let diagnosis = begins(&service, &format!("{path}/diagnoses"), &json!({}), "diagnosis").await;
        let diagnosis = format!("/v1/diagnoses/{diagnosis}");
        does(&service, &training, doing).await;
        ends_in_time(&mut service, &format!("trained ({doing}) and diagnosed"));
        service = start(folder.path());
        let resumed = service.read(&training).await;
        assert!(resumed["state"] == "running" || resumed["state"] == "waiting", "{resumed}");
        let goes_on = service.read(&diagnosis).await;
        assert!(["waiting", "running", "done"].iter().any(|state| goes_on["state"] == *state), "{goes_on}");
        // It begins again in earnest, and ends when somebody asks for it.
        does(&service, &training, doing).await;
        let job = training.replace("/v1/trainings/", "/v1/jobs/");
        assert!(service.request(Method::DELETE, &job).send().await.unwrap().status().is_success());
        within(Duration::from_mins(8), "the end of the training", async || {
            (service.read(&training).await["state"] == "cancelled").then_some(())
        })
        .await;
        within(Duration::from_mins(5), "the result of the diagnosis", async || {
            let read = service.read(&diagnosis).await;
            assert!(read["state"] != "failed" && read["state"] != "cancelled", "{read}");
            (read["state"] == "done" && read["result"]["verdict"].is_string()).then_some(())
        })
        .await;
    }
}

/// A tower of masses, each on the one below, of which the first spring is a parameter.
fn tower(id: &str, masses: usize) -> String {
    let mut text = format!("id = \"{id}\"\nmodes = 3\nmeasurement_noise = {{ relative = 0.002 }}\n");
    for i in 0..masses {
        writeln!(text, "[[mass]]\nname = \"m{i}\"\nkg = 1.0").unwrap();
    }
    for i in 0..masses {
        let below = if i == 0 { "ground".to_owned() } else { format!("m{}", i - 1) };
        writeln!(text, "[[spring]]\nname = \"s{i}\"\nfrom = \"{below}\"\nto = \"m{i}\"\nn_per_m = 1e6").unwrap();
    }
    text + "[[parameter]]\nname = \"s0\"\nprior = { uniform = [5e5, 1.5e6] }\nsets = { spring = \"s0\" }\n"
}

/// Sends a request and does not wait for its answer.
fn sent(service: &Service, request: reqwest::RequestBuilder) -> tokio::task::JoinHandle<Option<u16>> {
    let pid = service.pid();
    tokio::spawn(async move {
        let answer = request.send().await.ok().map(|answer| answer.status().as_u16());
        println!("process {pid} answered {answer:?}");
        answer
    })
}

/// Processor time of a process so far, s.
fn processor_s(pid: u32) -> f64 {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).unwrap();
    let fields: Vec<&str> = stat.rsplit_once(')').unwrap().1.split_whitespace().collect();
    // Fields 14 and 15 of proc(5), in hundredths of a second.
    (fields[11].parse::<f64>().unwrap() + fields[12].parse::<f64>().unwrap()) / 100.0
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_does_not_wait_for_a_structure_or_a_table_that_is_being_read() {
    let folder = tempfile::tempdir().unwrap();
    let mut service = start(folder.path());
    let put = |service: &Service, id: &str| {
        let request = service.request(Method::PUT, &format!("/v1/structures/{id}"));
        request.header("content-type", "application/toml").body(tower(id, 2_000))
    };
    let before = processor_s(service.pid());
    let _answers: Vec<_> = ["a", "b", "c", "d"].map(|id| sent(&service, put(&service, id))).into();
    eventually("the simulation of a tower", async || (processor_s(service.pid()) > before + 0.3).then_some(())).await;
    ends_in_time(&mut service, "read structures of 2,000 masses");

    let mut service = start(folder.path());
    let mut table = "measured_at,f1_hz,f2_hz,f3_hz\n".to_owned();
    while table.len() < 4_000_000 {
        let row = table.len();
        let (day, second) = (1 + row / 86_400 % 28, row % 86_400);
        let time = format!("2026-01-{day:02}T{:02}:{:02}:{:02}Z", second / 3600, second / 60 % 60, second % 60);
        writeln!(table, "{time},0.4,0.6,0.9").unwrap();
    }
    let preview = |service: &Service| {
        let request = service.request(Method::POST, "/v1/structures/three-dof/tables/preview?split=1h");
        request.header("content-type", "text/csv").body(table.clone())
    };
    let before = processor_s(service.pid());
    let _answers: Vec<_> = (0..20).map(|_| sent(&service, preview(&service))).collect();
    eventually("the reading of a table", async || (processor_s(service.pid()) > before + 0.3).then_some(())).await;
    ends_in_time(&mut service, "read tables of 4 MB");
    drop(start(folder.path()));
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_does_not_wait_for_a_client_that_reads_no_answer() {
    let folder = tempfile::tempdir().unwrap();
    let mut service = start(folder.path());
    define_plain(&service).await;
    for number in 0..8 {
        assert_eq!(post(&service, &plain_batch("a", number, 4_000)).await.unwrap().0, 201);
    }
    let path = format!("/v1/structures/{PLAIN}/measurements?format=ndjson");
    // Several at a time on each connection: the system takes the first megabytes of what nobody reads.
    let requests = format!("GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n").repeat(20);
    let streams: Vec<TcpStream> = (0..8)
        .map(|_| {
            let mut stream = TcpStream::connect(service.address()).unwrap();
            stream.write_all(requests.as_bytes()).unwrap();
            let mut answer = [0; 12];
            stream.read_exact(&mut answer).unwrap();
            assert_eq!(&answer, b"HTTP/1.1 200");
            stream
        })
        .collect();
    ends_in_time(&mut service, "sent measurements that nobody reads");
    drop(streams);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_stop_during_the_start_ends_it() {
    let folder = tempfile::tempdir().unwrap();
    let service = start(folder.path());
    // The eigenproblem of each takes seconds, in which the signal comes.
    for id in ["a", "b"] {
        let put = service.request(Method::PUT, &format!("/v1/structures/{id}"));
        let put = put.header("content-type", "application/toml").body(tower(id, 2_000)).send().await.unwrap();
        assert_eq!(put.status(), 201, "{}", put.text().await.unwrap());
    }
    define_as(&service, "last").await;
    drop(service);
    let mut child = command(folder.path()).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().unwrap();
    // The handlers of the signals are in place before anything is computed.
    eventually("the first structure", async || (processor_s(child.id()) > 0.3).then_some(())).await;
    let pid = rustix::process::Pid::from_child(&child);
    rustix::process::kill_process(pid, rustix::process::Signal::TERM).unwrap();
    let status = exit_within(&mut child, BEHIND);
    if status.is_none() {
        child.kill().unwrap();
    }
    let mut printed = String::new();
    child.stdout.take().unwrap().read_to_string(&mut printed).unwrap();
    assert_eq!(printed, "", "it went on to start");
    assert!(status.is_some_and(|status| status.success()), "{status:?} within {BEHIND:?}");
    let service = start(folder.path());
    assert_eq!(service.read("/v1/structures/last").await["id"], "last");
}
