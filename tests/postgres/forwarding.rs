//! A client may ask any node: one that stands by passes the request on to the one that serves.

use std::io::{Read as _, Write as _};
use std::net::IpAddr;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

use reqwest::{Method, Response};
use serde_json::{json, Value};
use tempfile::TempDir;

use crate::helpers::{created, eventually, measurements, problem, refusal, within, Service};
use crate::postgres::database::url_of;
use crate::postgres::node::{serving, Node};
use crate::postgres::server::Server;
use crate::postgres::world::{done, serve};

const BATCHES: &str = "/v1/structures/three-dof/batches";

/// Three nodes on one database, of which the first serves.
struct Three {
    nodes: Vec<Node>,
    folders: [TempDir; 3],
    database: String,
}

impl Three {
    async fn start(settings: &[(&str, &str)]) -> Self {
        let folders = [(); 3].map(|()| tempfile::tempdir().unwrap());
        let database = url_of(folders[0].path()).await.to_string();
        let mut nodes = vec![Node::with(folders[0].path(), &database, settings)];
        nodes[0].becomes("serving").await;
        for folder in &folders[1..] {
            nodes.push(Node::with(folder.path(), &database, settings));
        }
        for node in &nodes[1..] {
            node.becomes("standby").await;
        }
        Self { nodes, folders, database }
    }
}

fn batch(number: usize) -> Value {
    json!({ "measurements": measurements([4.0, 5.0, 6.0], 3, number * 3_600), "source": "gateway" })
}

/// What of an answer must not depend on the node: its status, its body, and all headers but the time and the id of the request.
async fn seen(response: Response) -> (u16, Vec<(String, String)>, Vec<u8>) {
    let status = response.status().as_u16();
    let own = ["date", "x-request-id", "connection", "transfer-encoding", "content-length"];
    let headers = response.headers().iter().filter(|(name, _)| !own.contains(&name.as_str()));
    let mut headers: Vec<(String, String)> =
        headers.map(|(name, value)| (name.to_string(), value.to_str().unwrap().to_owned())).collect();
    headers.sort();
    (status, headers, response.bytes().await.unwrap().to_vec())
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn every_node_answers_as_the_one_that_serves() {
    if !Server::is_installed() {
        return;
    }
    let three = Three::start(&[("HTTP__BODY_TIMEOUT_S", "2")]).await;
    let nodes = &three.nodes;
    let readiness = nodes[1].readiness().await;
    assert_eq!(readiness["serving_node"], nodes[0].url.as_str(), "{readiness}");
    assert_eq!(nodes[0].readiness().await["role"], "serving");

    // Batches as JSON, a table and NDJSON, through each node; a repetition through another node finds what is stored.
    let first = created(nodes[1].post(BATCHES, &batch(0)).await).await;
    let again = nodes[2].post(BATCHES, &batch(0)).await;
    assert_eq!(again.headers()["idempotency-replayed"], "true");
    assert_eq!(again.json::<Value>().await.unwrap()["batch"], first["batch"]);
    let keyed =
        |node: &Node| node.request(Method::POST, BATCHES).header("idempotency-key", "k-1").json(&batch(1)).send();
    let stored = created(keyed(&nodes[2]).await.unwrap()).await;
    assert_eq!(keyed(&nodes[1]).await.unwrap().json::<Value>().await.unwrap()["batch"], stored["batch"]);
    let table =
        "measured_at,f1,f2,f3\n2026-05-01T00:00:00Z,0.4695,0.9209,1.2361\n2026-05-01T00:10:00Z,0.4709,0.9208,1.2323\n";
    let csv =
        nodes[1].request(Method::POST, BATCHES).header("content-type", "text/csv").body(table).send().await.unwrap();
    created(csv).await;
    let lines = (10..40).map(|number| batch(number).to_string()).collect::<Vec<_>>().join("\n");
    let bulk = nodes[2].request(Method::POST, BATCHES).header("content-type", "application/x-ndjson").body(lines);
    let bulk: Value = bulk.send().await.unwrap().json().await.unwrap();
    assert_eq!(bulk["stored"], 30, "{bulk}");

    // Pages, files, lists and mistakes are the same at each node.
    let of_batch = format!("{BATCHES}/{}", first["batch"].as_str().unwrap());
    let requests = [
        (Method::GET, "/"),
        (Method::GET, "/assets/app.js"),
        (Method::GET, "/docs/"),
        (Method::GET, "/openapi.json"),
        (Method::GET, "/version"),
        (Method::GET, &of_batch),
        (Method::HEAD, &of_batch),
        (Method::GET, "/v1/structures/three-dof/history?limit=1000"),
        (Method::GET, "/v1/structures/three-dof/history?format=csv&limit=1000"),
        (Method::GET, "/v1/structures/three-dof/../three-dof"),
        (Method::GET, "/v1/structures/a%20b%2Fc/history"),
        (Method::GET, "/nowhere?q=%C3%A9&r=a+b"),
        (Method::DELETE, "/healthz"),
        (Method::OPTIONS, "/v1/structures"),
        (Method::POST, BATCHES),
    ];
    let at_each_node = requests.len() as f64;
    for (method, path) in requests {
        let mut answers = Vec::new();
        for node in nodes {
            let request = node.request(method.clone(), path).header("x-request-id", "mine");
            let response = request.send().await.unwrap();
            assert_eq!(response.headers()["x-request-id"], "mine", "{method} {path}");
            answers.push(seen(response).await);
        }
        assert!(answers[0] == answers[1] && answers[0] == answers[2], "{method} {path}: {answers:?}");
    }
    // What is too large or too slow is refused as by the serving node.
    for node in nodes {
        let large = format!("{{\"source\": \"{}\"}}", "x".repeat(5 << 20));
        let request = node.request(Method::POST, BATCHES).header("content-type", "application/json").body(large);
        problem(request.send().await.unwrap(), 413, "body_too_large").await;
        let said = raw(node, &format!("POST {BATCHES} HTTP/1.1\r\nhost: localhost\r\ncontent-type: application/json\r\ncontent-length: 100\r\n\r\n{{"));
        assert!(said.contains(" 408 ") && said.contains("body_timeout"), "{said}");
    }
    for (node, serves) in nodes.iter().zip([1.0, 0.0, 0.0]) {
        assert_eq!(node.metric("modalwatch_serving").await, Some(serves));
        let forwarded = node.metric("modalwatch_forwarded_requests_total{outcome=\"answered\"}").await;
        assert_eq!(forwarded.is_some_and(|count| count >= at_each_node), serves == 0.0, "{forwarded:?}");
    }
}

/// What a node answers to these bytes, until it closes the connection or has been silent for some seconds.
fn raw(node: &Node, request: &str) -> String {
    let mut connection = std::net::TcpStream::connect(("127.0.0.1", node.port())).unwrap();
    connection.set_read_timeout(Some(Duration::from_secs(8))).unwrap();
    connection.write_all(request.as_bytes()).unwrap();
    let (mut answer, mut part) = (Vec::new(), [0; 4_096]);
    while let Ok(count @ 1..) = connection.read(&mut part) {
        answer.extend_from_slice(&part[..count]);
        if answer.ends_with(b"}") {
            break;
        }
    }
    String::from_utf8_lossy(&answer).into_owned()
}

/// Reads a stream of events until it has this text; `None` if it ends before.
async fn reads(stream: &mut Response, text: &str) -> Option<String> {
    let mut received = String::new();
    while let Ok(Some(chunk)) = stream.chunk().await {
        received.push_str(&String::from_utf8_lossy(&chunk));
        if received.contains(text) {
            return Some(received);
        }
    }
    None
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn events_reach_the_readers_at_every_node_and_reads_go_on_after_a_takeover() {
    if !Server::is_installed() {
        return;
    }
    let mut three = Three::start(&[("STORE__TAKEOVER_S", "2")]).await;
    let mut streams = Vec::new();
    for node in &three.nodes {
        streams.push(node.get("/v1/events").await);
    }
    let sent = Instant::now();
    created(three.nodes[1].post(BATCHES, &batch(0)).await).await;
    for stream in &mut streams {
        let read = tokio::time::timeout(Duration::from_secs(20), reads(stream, "event: batch")).await;
        read.expect("the event does not arrive").expect("the stream ended");
    }
    // A stream that waits for more bytes would deliver only with the comment after 15 s.
    assert!(sent.elapsed() < Duration::from_secs(10), "{:?}", sent.elapsed());

    // The streams end with the node that serves; the answers of the next one are the same.
    let before = three.nodes[2].read("/v1/structures/three-dof/history").await;
    three.nodes[0].kill();
    for stream in &mut streams[1..] {
        let ended = tokio::time::timeout(Duration::from_secs(20), reads(stream, "event: never")).await;
        assert_eq!(ended.expect("the stream of a node that is gone goes on"), None);
    }
    three.nodes.remove(0);
    let next = serving(&three.nodes).await;
    let other = &three.nodes[1 - next];
    other.becomes("standby").await;
    // It says that nobody serves until it knows the next one.
    eventually("the next one is known", async || (other.status("/v1/structures").await == 200).then_some(())).await;
    assert_eq!(other.read("/v1/structures/three-dof/history").await, before);
    let mut stream = other.get("/v1/events").await;
    created(three.nodes[next].post(BATCHES, &batch(1)).await).await;
    assert!(reads(&mut stream, "event: batch").await.is_some());

    // A node that stands by ends its streams when it stops, and what it has passed on is answered before.
    let stopping = Instant::now();
    other.signal("TERM");
    while stream.chunk().await.unwrap().is_some() {}
    eventually("it has ended", async || (other.status("/healthz").await == 0).then_some(())).await;
    assert!(stopping.elapsed() < Duration::from_secs(10), "{:?}", stopping.elapsed());
    drop(three.folders);
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_standby_that_serves_nobody_says_so_and_when_to_come_back() {
    if !Server::is_installed() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let database = url_of(folder.path()).await.to_string();
    let name = database.rsplit_once('/').unwrap().1;
    // The lock is held by something that does not register itself, as an earlier version of the program.
    let held = Server::get().session(name, "select pg_advisory_lock(120325192903799), pg_sleep(3600)");
    let locked = "select count(*) from pg_locks where locktype = 'advisory' and granted
                  and database = (select oid from pg_database where datname = current_database())";
    eventually("the lock is held", async || (Server::get().sql(name, locked) == "1").then_some(())).await;
    let node = Node::with(folder.path(), &database, &[]);
    eventually("it is alive", async || (node.status("/healthz").await == 200).then_some(())).await;
    eventually("it stands by", async || (node.readiness().await["role"] == "standby").then_some(())).await;
    let response = node.get("/readyz").await;
    assert_eq!(response.status(), 503);
    let readiness: Value = response.json().await.unwrap();
    assert_eq!(readiness["reasons"][0]["code"], "no_service", "{readiness}");
    for response in [node.get("/v1/structures").await, node.post(BATCHES, &batch(0)).await] {
        assert_eq!(response.headers()["retry-after"], "1");
        let refused = problem(response, 503, "no_service").await;
        assert!(refused["detail"].as_str().unwrap().contains("nothing was changed"), "{refused}");
    }
    assert_eq!(node.metric("modalwatch_forwarded_requests_total{outcome=\"no_service\"}").await, Some(2.0));
    // A session that sleeps does not notice that its client has left.
    let end = locked.replace("count(*)", "count(pg_terminate_backend(pid))");
    Server::get().sql(name, &end);
    drop(held);
    node.becomes("serving").await;
    created(node.post(BATCHES, &batch(0)).await).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn an_address_that_does_not_lead_to_the_serving_node_is_seen_and_nothing_goes_round_in_circles() {
    if !Server::is_installed() {
        return;
    }
    let folders = [(); 3].map(|()| tempfile::tempdir().unwrap());
    let database = url_of(folders[0].path()).await.to_string();
    for wrong in ["bridge-2:8080", "http://bridge-2/v1", "http://0.0.0.0:8080"] {
        let mut command = serve(folders[0].path(), &database);
        let said = refusal(command.env("MODALWATCH__STORE__NODE_URL", wrong));
        assert!(said.contains("store.node_url") && said.contains("http://bridge-2.example:8080"), "{wrong}: {said}");
    }
    let ports = [(); 2].map(|()| std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port());
    // One at which nobody listens, and one of another node.
    for leads_to in [ports[0], ports[1]] {
        let url = format!("http://127.0.0.1:{leads_to}");
        let mut first = Node::with(folders[0].path(), &database, &[("STORE__NODE_URL", &url)]);
        first.becomes("serving").await;
        let other = Node::at(("127.0.0.1", ports[1]), folders[1].path(), &database, &[]);
        let readiness = eventually("it sees it", async || {
            Some(other.readiness().await).filter(|found| found["reasons"][0]["code"] == "node_unreachable")
        })
        .await;
        let reason = readiness["reasons"][0]["message"].as_str().unwrap();
        assert!(reason.contains(&url) && reason.contains("store.node_url"), "{readiness}");
        let asked = Instant::now();
        problem(other.get("/v1/structures").await, 503, "no_service").await;
        assert!(asked.elapsed() < Duration::from_secs(10));
        assert_eq!(first.status("/v1/structures").await, 200, "it serves those who ask it directly");
        first.kill();
        other.becomes("serving").await;
    }
}

/// The admin's token in a file.
fn admin_file(folder: &Path) -> (String, String) {
    let path = folder.join("admin-token");
    done(&["token", "file", path.to_str().unwrap()]);
    let token = std::fs::read_to_string(&path).unwrap().trim().to_owned();
    (path.to_str().unwrap().to_owned(), token)
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_token_that_is_revoked_through_any_node_is_refused_at_all_within_a_second() {
    if !Server::is_installed() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (path, admin) = admin_file(folder.path());
    let three = Three::start(&[("ACCESS__ADMIN_TOKEN_FILE", &path)]).await;
    for (made_at, revoked_at) in [(1, 2), (2, 0), (0, 1)] {
        let new = json!({ "name": "reader", "scopes": ["read"] });
        let made = three.nodes[made_at].request(Method::POST, "/v1/tokens").bearer_auth(&admin).json(&new);
        let token = created(made.send().await.unwrap()).await["token"].as_str().unwrap().to_owned();
        let ask = |node: &Node| node.request(Method::GET, "/v1/structures").bearer_auth(&token).send();
        for node in &three.nodes {
            assert_eq!(ask(node).await.unwrap().status(), 200);
        }
        let stream = three.nodes[1].request(Method::GET, "/v1/events").bearer_auth(&token).send().await.unwrap();
        let id = token.split('_').nth(1).unwrap();
        let revoke = three.nodes[revoked_at].request(Method::DELETE, &format!("/v1/tokens/{id}")).bearer_auth(&admin);
        assert!(revoke.send().await.unwrap().status().is_success());
        let revoked = Instant::now();
        for node in &three.nodes {
            problem(ask(node).await.unwrap(), 401, "token_revoked").await;
        }
        assert!(revoked.elapsed() < Duration::from_secs(1), "{:?}", revoked.elapsed());
        let mut stream = stream;
        let end = tokio::time::timeout(Duration::from_secs(3), reads(&mut stream, "event: never")).await;
        assert!(end.is_ok(), "the stream goes on without its token");
    }
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_client_cannot_speak_as_a_node_and_is_known_by_its_own_address_behind_one() {
    if !Server::is_installed() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let (path, admin) = admin_file(folder.path());
    let three = Three::start(&[("ACCESS__ADMIN_TOKEN_FILE", &path)]).await;
    let code = "0".repeat(64);
    for value in [
        format!("192.0.2.1:5 1.1 {code}"),
        format!("127.0.0.1:5 1.0 {code}"),
        "127.0.0.1:5 1.1".to_owned(),
        "x".to_owned(),
        String::new(),
        format!("127.0.0.1:5 1.1 {code} more"),
    ] {
        for node in &three.nodes {
            let request = node.request(Method::GET, "/v1/structures").bearer_auth(&admin);
            let refused = request.header("modalwatch-forwarded", &value).send().await.unwrap();
            assert!(refused.headers().contains_key("retry-after"), "{value}");
            problem(refused, 503, "no_service").await;
        }
    }
    // Where there are no nodes, the header means nothing.
    let alone = tempfile::tempdir().unwrap();
    let file = Service::start(alone.path());
    let ignored = file.get("/v1/structures").header("modalwatch-forwarded", format!("192.0.2.1:5 1.1 {code}"));
    assert_eq!(ignored.send().await.unwrap().status(), 200);

    // The limit of failures counts the address of the client, not that of the node between them, and not one that the client claims.
    let from = |address: [u8; 4]| {
        let builder = modalwatch::notify::client_builder().local_address(IpAddr::from(address));
        builder.timeout(Duration::from_secs(20)).build().unwrap()
    };
    let (attacker, other) = (from([127, 0, 0, 2]), from([127, 0, 0, 3]));
    let wrong = "mw_AAAAAAAAAAAAAAAA_AAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAA";
    let url = format!("{}/v1/structures", three.nodes[1].url);
    let try_it = async |client: &reqwest::Client, claim: &str| {
        let request = client.get(&url).bearer_auth(wrong).header("x-forwarded-for", claim);
        request.send().await.unwrap().status().as_u16()
    };
    let mut limited = false;
    for number in 0..15 {
        limited |= try_it(&attacker, &format!("192.0.2.{number}")).await == 429;
    }
    assert!(limited, "an address may try without end through a node that stands by");
    assert_eq!(try_it(&other, "127.0.0.2").await, 401, "another address is limited with it");
    assert_eq!(three.nodes[0].status("/readyz").await, 200);

    // The audit names the client too.
    let note = json!({ "name": "reader", "scopes": ["read"] });
    let made = other.post(format!("{}/v1/tokens", three.nodes[2].url)).bearer_auth(&admin).json(&note);
    created(made.send().await.unwrap()).await;
    let audit = three.nodes[1].request(Method::GET, "/v1/audit").bearer_auth(&admin).send().await.unwrap();
    let audit: Value = audit.json().await.unwrap();
    let entries = audit["items"].as_array().unwrap();
    let is_of_client = |entry: &&Value| entry["action"] == "POST /v1/tokens" && entry["peer"] == "127.0.0.3";
    assert_eq!(entries.iter().filter(is_of_client).count(), 1, "{audit}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn without_tokens_a_node_passes_on_nothing_that_the_serving_one_would_refuse() {
    if !Server::is_installed() {
        return;
    }
    let three = Three::start(&[]).await;
    for node in &three.nodes {
        let ask = |name: &'static str, value: &'static str| {
            node.request(Method::GET, "/v1/structures").header(name, value).send()
        };
        problem(ask("origin", "https://elsewhere.example").await.unwrap(), 403, "forbidden_origin").await;
        problem(ask("sec-fetch-site", "cross-site").await.unwrap(), 403, "forbidden_origin").await;
        problem(ask("host", "elsewhere.example").await.unwrap(), 403, "forbidden_origin").await;
        problem(ask("x-forwarded-for", "192.0.2.1").await.unwrap(), 401, "unauthorized").await;
        let said = raw(node, "GET /v1/structures HTTP/1.0\r\nhost: localhost\r\n\r\n");
        assert!(said.contains(" 401 "), "{said}");
        // A header cannot be had removed by naming it as one of the connection.
        let said = raw(node, "GET /v1/structures HTTP/1.1\r\nhost: localhost\r\nx-forwarded-for: 192.0.2.1\r\nconnection: x-forwarded-for\r\n\r\n");
        assert!(said.contains(" 401 "), "{said}");
    }
    // Through a standby that listens on other addresses than the loopback, only this machine is served.
    let Some(outside) = address_of_this_machine() else { return };
    let folder = tempfile::tempdir().unwrap();
    let public = Node::listening("0.0.0.0", folder.path(), &three.database, &[]);
    public.becomes("standby").await;
    let url = format!("http://{outside}:{}/v1/structures", public.port());
    let refused =
        problem(public.client.get(url).header("host", "localhost").send().await.unwrap(), 401, "unauthorized").await;
    assert!(refused["detail"].as_str().unwrap().contains("another machine"), "{refused}");
}

/// An address of this machine besides the loopback.
fn address_of_this_machine() -> Option<IpAddr> {
    let output = Command::new("hostname").arg("-I").output().ok()?;
    let text = String::from_utf8(output.stdout).ok()?;
    text.split_whitespace().find_map(|text| text.parse::<IpAddr>().ok().filter(IpAddr::is_ipv4))
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn requests_that_run_during_a_takeover_end_with_an_answer_or_a_time_to_come_back() {
    if !Server::is_installed() {
        return;
    }
    let mut three = Three::start(&[("STORE__TAKEOVER_S", "2")]).await;
    // The serving node hangs: what was passed on to it is answered when another one has taken over.
    three.nodes[0].signal("STOP");
    let asked = Instant::now();
    let body = batch(0);
    let (posted, read) =
        tokio::join!(three.nodes[1].post(BATCHES, &body), three.nodes[2].get("/v1/structures/three-dof/history"));
    assert!(asked.elapsed() < Duration::from_secs(25), "{:?}", asked.elapsed());
    assert!(posted.headers().contains_key("retry-after"), "{posted:?}");
    let refused = problem(posted, 503, "service_lost").await;
    assert!(refused["detail"].as_str().unwrap().contains("repeated safely"), "{refused}");
    // A read is repeated at the next node by itself, which may still be starting.
    assert!(read.status() == 200 || read.headers().contains_key("retry-after"), "{read:?}");
    let stopped = three.nodes.remove(0);
    serving(&three.nodes).await;
    for node in &three.nodes {
        within(Duration::from_secs(20), "each node answers", async || {
            (node.post(BATCHES, &batch(0)).await.status().is_success()).then_some(())
        })
        .await;
        let history = node.read("/v1/structures/three-dof/history").await;
        assert_eq!(history["items"].as_array().unwrap().len(), 1, "{history}");
    }
    // The node that has hung does not answer from what it knew before, although it does not know yet that it was replaced.
    stopped.signal("CONT");
    let woken = Instant::now();
    while woken.elapsed() < Duration::from_secs(2) {
        let answered = stopped.status("/v1/structures").await;
        assert!([0, 503].contains(&answered), "{answered}");
    }
}
