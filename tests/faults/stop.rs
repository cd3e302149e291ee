//! Shutdown: SIGTERM with a request that never ends, and a second SIGTERM.

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::Arc;
use std::time::{Duration, Instant};

use crate::helpers::{command, eventually, Service, PATIENCE};
use crate::kit::{audit, batch, body, post, Acknowledged, BATCHES};

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
