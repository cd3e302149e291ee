//! Tables of a client with the scope `ingest`: millions of rows that are refused, long lines, many uploads at once, slow ones.

use std::fmt::Write as _;
use std::time::{Duration, Instant};

use bytes::Bytes;
use reqwest::Method;
use serde_json::{json, Value};
use tokio::io::AsyncWriteExt as _;
use tokio::net::TcpStream;
use tokio::task::JoinSet;

use crate::helpers::{created, measurements, time};
use crate::redteam::target::{peak_mib, Target};

const PATIENCE: Duration = Duration::from_mins(2);
const BATCHES: &str = "/v1/structures/three-dof/batches";
const PREVIEW: &str = "/v1/structures/three-dof/tables/preview";
const HEADER: &str = "measured_at,f1_hz,f2_hz,f3_hz";
const MIB: usize = 1 << 20;

/// Sends a table; returns status and body of the answer.
async fn sent(target: &Target, token: &str, path: &str, table: Bytes) -> (u16, Value) {
    let request = target.ask(Method::POST, path, Some(token), PATIENCE).header("content-type", "text/csv");
    let response = request.body(table).send().await.unwrap();
    (response.status().as_u16(), response.json().await.unwrap())
}

/// At least this number of bytes of rows that can be used, `every_s` seconds apart, each with a comment of this length.
fn usable(bytes: usize, every_s: usize, comment: usize) -> Bytes {
    let (mut table, comment) = (format!("{HEADER},comment\n"), "c".repeat(comment));
    for row in 0.. {
        if table.len() >= bytes {
            break;
        }
        writeln!(table, "{},0.4949,0.9250,1.2434,{comment}", time(every_s * row)).unwrap();
    }
    table.into()
}

/// Memory of the process above `rest`, MiB, after what was just sent.
fn above(rest: f64, target: &Target, what: &str) -> f64 {
    let needed = peak_mib(target.service.pid()) - rest;
    println!("{needed:.0} MiB above rest after {what}");
    needed
}

/// The attack of 2026 with tables of 8 instead of 31 MiB: what is refused is counted, and not kept.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn rows_that_are_refused_cost_neither_memory_nor_much_time() {
    let target = Target::start(&[]);
    let gateway = target.token("ingest", &["three-dof"]).await;
    let rest = peak_mib(target.service.pid());
    let preview = async |query: &str, table: String, what: &str| {
        let started = Instant::now();
        let (status, answer) = sent(&target, &gateway, &format!("{PREVIEW}?{query}"), table.into()).await;
        assert_eq!(status, 200, "{what}: {answer}");
        println!("{what}: {:?}", started.elapsed());
        above(rest, &target, what);
        answer
    };
    let short = preview("split=1d", format!("{HEADER}\n{}", "a\n".repeat(4 * MIB)), "short rows").await;
    let understood = &short["understood"];
    let counts = (&understood["rows"], &understood["accepted"], &understood["refused"]);
    assert_eq!(counts, (&json!(4 * MIB), &json!(0), &json!(4 * MIB)), "{short}");
    assert_eq!(understood["refused_rows"].as_array().unwrap().len(), 100);
    let none = format!("none of the {} rows can be used; the first: 1 cells, but the header has 4", 4 * MIB);
    assert_eq!(short["problems"][0], json!({ "pointer": "line 2", "message": none }));

    let same = format!("{HEADER}\n{}", "1,1,1,1\n".repeat(MIB / 2));
    let same = preview("split=none&time_unit=seconds", same, "rows with the same time").await;
    assert_eq!(same["understood"]["rows"], MIB / 2);
    let wide = preview("split=1d", ",".repeat(8 * MIB), "a wide header").await;
    let columns = format!("the header has {} columns: at most 1000 are read", 8 * MIB + 1);
    assert_eq!(wide["problems"], json!([{ "pointer": "line 1", "message": columns }]));
    let line = preview("split=1d", format!("{HEADER}\n{}1\n", ",".repeat(8 * MIB)), "a wide row").await;
    let cells = format!("{} cells, but the header has 4", 8 * MIB + 1);
    assert_eq!(line["understood"]["refused_rows"], json!([{ "line": 2, "column": null, "reason": cells }]));

    // Without `split`, as many problems are listed as of any batch.
    let table = format!("{HEADER}\n{}", "a\n".repeat(2_000_000));
    let (status, refused) = sent(&target, &gateway, BATCHES, table.into()).await;
    assert_eq!((status, refused["errors"].as_array().map(Vec::len)), (422, Some(21)), "{refused}");
    assert_eq!(refused["errors"][20]["message"], "and 1999980 more problems");
    let needed_mib = above(rest, &target, "all");
    assert!(needed_mib < 80.0, "{needed_mib:.0} MiB");
}

/// Rows of one client while another has its uploads read: as JSON and as CSV, one of each at a time, until all uploads are answered.
/// Returns how long the rows took.
async fn rows_beside(target: &Target, gateway: &str, uploads: &mut JoinSet<u16>) -> Vec<Duration> {
    let (mut took, mut answered) = (Vec::new(), 0);
    while !uploads.is_empty() {
        let start_s = 1_200 * took.len();
        let posted = Instant::now();
        target.batch(gateway, &measurements([4.0, 5.0, 6.0], 1, start_s)).await;
        took.push(posted.elapsed());
        let row = format!("{HEADER}\n{},0.4949,0.9250,1.2434\n", time(start_s + 600));
        let request = target.ask(Method::POST, BATCHES, Some(gateway), PATIENCE).header("content-type", "text/csv");
        let posted = Instant::now();
        created(request.body(row).send().await.unwrap()).await;
        took.push(posted.elapsed());
        while let Some(upload) = uploads.try_join_next() {
            let status = upload.unwrap();
            assert!([200, 503].contains(&status), "{status}");
            answered += usize::from(status == 200);
        }
    }
    assert!(answered > 0, "no upload was read");
    println!("{answered} uploads were read, the others waited for 20 s");
    took.sort();
    took
}

/// Previews of a table, all at once.
fn at_once(target: &Target, token: &str, query: &str, table: &Bytes, count: usize) -> JoinSet<u16> {
    let mut uploads = JoinSet::new();
    for _ in 0..count {
        let request = target.ask(Method::POST, &format!("{PREVIEW}?{query}"), Some(token), 10 * PATIENCE);
        let request = request.header("content-type", "text/csv").body(table.clone());
        uploads.spawn(async move { request.send().await.unwrap().status().as_u16() });
    }
    uploads
}

/// The attack of 2026 with 24 uploads of 8 MiB instead of 60 of 23 MiB.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn uploads_wait_on_their_sockets_and_rows_of_others_do_not_wait_for_them() {
    let target = Target::start(&[]);
    let (attacker, gateway) = (target.token("ingest", &[]).await, target.token("ingest", &["three-dof"]).await);
    let table = usable(8 * MIB, 60, 200);
    // What an assessment needs is not meant.
    target.batch(&gateway, &measurements([4.0, 5.0, 6.0], 1, 10_000_000)).await;
    let rest = peak_mib(target.service.pid());
    let mut uploads = at_once(&target, &attacker, "split=1d&ignore=comment", &table, 24);
    let took = rows_beside(&target, &gateway, &mut uploads).await;
    println!("{} rows, the median after {:?}, the slowest {:?}", took.len(), took[took.len() / 2], took.last());
    // One client has 32 MiB of bodies in memory, beside one table that is read and the rows that are assessed: 100 to 114 MiB. All bodies at once would
    // be 192 MiB without those.
    let needed_mib = above(rest, &target, "24 uploads");
    assert!(needed_mib < 150.0, "{needed_mib:.0} MiB");
    // Other tests use the same processors, so that a single row may be late.
    assert!(took[took.len() / 2] < Duration::from_secs(1), "{took:?}");
}

/// A client that announces large tables and does not send them has the room of one, until `http.body_timeout_s`.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn slow_uploads_of_one_client_leave_room_for_the_tables_of_others() {
    let target = Target::start(&[]);
    let (attacker, gateway) = (target.token("ingest", &[]).await, target.token("ingest", &["three-dof"]).await);
    let head = format!(
        "POST {PREVIEW} HTTP/1.1\r\nHost: localhost\r\nAuthorization: Bearer {attacker}\r\nContent-Type: text/csv\r\n\
         Content-Length: {}\r\n\r\n{HEADER}",
        32 * MIB
    );
    let mut slow = Vec::new();
    for _ in 0..40 {
        let mut stream = TcpStream::connect(target.service.address()).await.unwrap();
        stream.write_all(head.as_bytes()).await.unwrap();
        slow.push(stream);
    }
    // The service has accepted all of them when it answers a connection that came later.
    target.get("/healthz", None, PATIENCE).await.unwrap();
    let started = Instant::now();
    let table = usable(4 * MIB, 60, 200);
    let (status, answer) = sent(&target, &gateway, &format!("{PREVIEW}?split=1d&ignore=comment"), table).await;
    assert_eq!((status, &answer["problems"]), (200, &json!([])), "{answer}");
    assert!(started.elapsed() < Duration::from_secs(20), "after {:?}", started.elapsed());
    drop(slow);
}

/// `cargo test --release --test robustness the_largest_tables -- --ignored --nocapture`: the attacks in their full size.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
#[ignore = "some minutes: tables of 31 MiB, and 60 uploads of 23 MiB at once"]
async fn the_largest_tables_and_sixty_uploads_at_once_need_at_most_300_mib() {
    let target = Target::start(&[]);
    let (attacker, gateway) = (target.token("ingest", &[]).await, target.token("ingest", &["three-dof"]).await);
    target.batch(&gateway, &measurements([4.0, 5.0, 6.0], 1, 10_000_000)).await;
    let rest = peak_mib(target.service.pid());
    let mut seconds = format!("{HEADER}\n");
    for second in 0.. {
        if seconds.len() > 31 * MIB {
            break;
        }
        writeln!(seconds, "{second},1,1,1").unwrap();
    }
    let tables = [
        ("rows without cells", format!("{HEADER}\n{}", "a\n".repeat(31 * MIB / 2))),
        ("rows with the same time", format!("{HEADER}\n{}", "1,1,1,1\n".repeat(31 * MIB / 8))),
        ("a header of commas", ",".repeat(31 * MIB)),
        ("a row of commas", format!("{HEADER}\n{}1\n", ",".repeat(31 * MIB))),
        ("a cell of hyphens", format!("{HEADER}\n{},1,1,1\n", "-".repeat(31 * MIB))),
        ("rows with a time each", seconds),
    ];
    for (what, table) in tables {
        let started = Instant::now();
        let path = format!("{PREVIEW}?split=1d&time_unit=seconds");
        let (status, answer) = sent(&target, &attacker, &path, table.into()).await;
        assert_eq!(status, 200, "{what}: {answer}");
        println!(
            "{what}: {:?}, {} of {} rows",
            started.elapsed(),
            answer["understood"]["accepted"],
            answer["understood"]["rows"]
        );
        assert!(above(rest, &target, what) < 300.0, "{what}");
    }
    let mut uploads = at_once(&target, &attacker, "split=1d&ignore=comment", &usable(23 * MIB, 10, 1), 60);
    let took = rows_beside(&target, &gateway, &mut uploads).await;
    println!("{} rows, the median after {:?}, the slowest {:?}", took.len(), took[took.len() / 2], took.last());
    assert!(above(rest, &target, "60 uploads") < 300.0);
    assert!(took[took.len() - 1] < Duration::from_secs(1), "{:?}", took.last());
}
