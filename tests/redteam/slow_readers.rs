//! Clients without a token that ask much and take nothing.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use rustix::process::{getrlimit, setrlimit, Resource, Rlimit};
use tokio::io::{AsyncReadExt as _, AsyncWriteExt as _};
use tokio::net::{TcpSocket, TcpStream};

use crate::helpers::within;
use crate::redteam::target::Target;

/// Requests that each socket sends at once.
const PIPELINED: usize = 60;

/// A socket that receives 2 kB at most and asks for the largest page that needs no token, again and again.
async fn slow_reader(address: SocketAddr) -> Option<TcpStream> {
    let socket = TcpSocket::new_v4().unwrap();
    socket.set_recv_buffer_size(2_048).unwrap();
    let connected = tokio::time::timeout(Duration::from_secs(2), socket.connect(address)).await;
    let mut stream = connected.ok()?.ok()?;
    let requests = "GET /openapi.json HTTP/1.1\r\nHost: localhost\r\n\r\n".repeat(PIPELINED);
    stream.write_all(requests.as_bytes()).await.ok()?;
    Some(stream)
}

/// Lets this process open enough files for the attack in its full size.
pub fn allow_many_sockets() {
    let files = getrlimit(Resource::Nofile);
    let wanted = Rlimit { current: files.maximum.or(Some(8_192)).map(|most| most.min(8_192)), ..files };
    setrlimit(Resource::Nofile, wanted).unwrap();
}

/// Opens the sockets, and says how many are open.
pub async fn attack(target: &Target, sockets: usize) -> Vec<TcpStream> {
    let address: SocketAddr = target.service.address().parse().unwrap();
    let opening: Vec<_> = (0..sockets).map(|_| tokio::spawn(slow_reader(address))).collect();
    let mut open = Vec::new();
    for socket in opening {
        open.extend(socket.await.unwrap());
    }
    println!("{} of {sockets} sockets are open", open.len());
    open
}

/// Both probes of a supervisor on the same machine are answered, one after the other, for this time.
async fn probes_are_answered(target: &Target, during: Duration) {
    let (started, mut slowest, mut asked) = (Instant::now(), Duration::ZERO, 0);
    while started.elapsed() < during {
        for path in ["/healthz", "/readyz"] {
            // As `modalwatch healthcheck` waits.
            let (status, took) = target.get(path, None, Duration::from_secs(4)).await.unwrap();
            assert_eq!(status, 200, "{path}");
            (slowest, asked) = (slowest.max(took), asked + 1);
        }
    }
    println!("{asked} probes were answered, the slowest after {slowest:?}");
    assert!(asked >= 4);
}

/// The attack of 2026: 64 connections instead of 1,024, and a write timeout of 4 s instead of 20 s.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn slow_readers_keep_neither_supervisors_nor_token_holders_nor_for_long_others_out() {
    let target = Target::start(&[
        ("http.max_connections", "64"),
        ("http.max_connections_per_address", "48"),
        ("http.write_timeout_s", "4"),
    ]);
    let sockets = attack(&target, 100).await;
    let began = Instant::now();
    assert!(sockets.len() >= 64, "all connections are in use");
    probes_are_answered(&target, Duration::from_secs(2)).await;
    // A valid token does not count for the address that it shares with the attacker.
    let (status, took) = target.get("/v1/structures", Some(&target.admin), Duration::from_secs(4)).await.unwrap();
    assert_eq!(status, 200, "after {took:?}");
    // The others wait until the service has ended the connections that take nothing.
    within(Duration::from_secs(15), "an ordinary page without a token", async || {
        let answer = target.get("/version", None, Duration::from_secs(11)).await.ok()?;
        (answer.0 == 200).then_some(())
    })
    .await;
    println!("an ordinary page was answered {:?} after the attack", began.elapsed());
    drop(sockets);
}

/// `cargo test --release --test robustness a_thousand_slow_readers -- --ignored --nocapture`: the attack in its full size against the
/// default settings, for a minute.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "a minute, with 1,040 sockets"]
async fn a_thousand_slow_readers_do_not_silence_the_probes() {
    allow_many_sockets();
    let target = Target::start(&[]);
    let mut sockets = attack(&target, 1_040).await;
    for _ in 0..6 {
        probes_are_answered(&target, Duration::from_secs(10)).await;
        // The attacker comes back with whatever was closed.
        sockets.clear();
        sockets = attack(&target, 1_040).await;
    }
}

/// A healthy reader of a long stream is not ended by the write timeout: here it is idle for three times as long.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_healthy_stream_outlives_the_write_timeout() {
    let target = Target::start(&[("http.write_timeout_s", "1")]);
    let mut stream = TcpStream::connect(target.service.address()).await.unwrap();
    let request =
        format!("GET /v1/events HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {}\r\n\r\n", target.admin);
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut head = [0; 4_096];
    let count = stream.read(&mut head).await.unwrap();
    assert!(head[..count].starts_with(b"HTTP/1.1 200"), "{}", String::from_utf8_lossy(&head[..count]));
    let closed = tokio::time::timeout(Duration::from_secs(3), async {
        let mut bytes = [0; 4_096];
        while stream.read(&mut bytes).await.is_ok_and(|count| count > 0) {}
    });
    assert!(closed.await.is_err(), "an idle stream was ended");
    target.batch(&target.admin, &crate::helpers::measurements([4.0, 5.0, 6.0], 5, 0)).await;
    let mut event = [0; 4_096];
    let count = tokio::time::timeout(Duration::from_secs(10), stream.read(&mut event)).await.unwrap().unwrap();
    assert!(String::from_utf8_lossy(&event[..count]).contains("event: batch"));
}
