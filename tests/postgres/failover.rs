//! Services on one database: one serves, the others wait for it; servers and services that end, hang or come back.

use std::collections::BTreeMap;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use reqwest::Method;
use serde_json::{json, Value};

use crate::database::url_of;
use crate::helpers::{eventually, exit_within, measurements, problem, refusal, within, Service, PATIENCE};
use crate::server::Server;
use crate::world::{answer, answers, pending, serve};

const BATCHES: &str = "/v1/structures/three-dof/batches";

/// A service that waits, on a port that is known before it serves.
struct Standby {
    child: Child,
    url: String,
    client: reqwest::Client,
}

impl Standby {
    fn start(folder: &Path, url: &str, takeover_s: &str) -> Self {
        let port = std::net::TcpListener::bind("127.0.0.1:0").unwrap().local_addr().unwrap().port();
        let mut command = Command::new(env!("CARGO_BIN_EXE_modalwatch"));
        command.args(["serve", "--listen", &port.to_string(), "--data-dir"]).arg(folder);
        command.env("MODALWATCH__STORE__URL", url).env("MODALWATCH__STORE__STANDBY", "true");
        command.env("MODALWATCH__STORE__TAKEOVER_S", takeover_s).env("MODALWATCH__LOG__LEVEL", "warn");
        let child = command.stdout(Stdio::null()).stderr(Stdio::null()).spawn().unwrap();
        let client = modalwatch::notify::client_builder().build().unwrap();
        Self { child, url: format!("http://127.0.0.1:{port}"), client }
    }

    /// Status of an answer; 0 if there is none.
    async fn status(&self, path: &str) -> u16 {
        let response = self.client.get(format!("{}{path}", self.url)).send().await;
        response.map_or(0, |response| response.status().as_u16())
    }

    async fn read(&self, path: &str) -> Value {
        self.client.get(format!("{}{path}", self.url)).send().await.unwrap().json().await.unwrap()
    }

    fn signal(&self, signal: &str) {
        assert!(Command::new("kill")
            .args([&format!("-{signal}"), &self.child.id().to_string()])
            .status()
            .unwrap()
            .success());
    }
}

impl Drop for Standby {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn batch(number: usize) -> Value {
    json!({ "measurements": measurements([4.0, 5.0, 6.0], 3, number * 3_600), "source": "gateway" })
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_second_service_is_refused_or_waits_and_takes_over_with_all_that_was_acknowledged() {
    if !Server::is_installed() {
        return;
    }
    let folders = [(); 3].map(|()| tempfile::tempdir().unwrap());
    let url = url_of(folders[0].path()).await.to_string();
    let mut first = Service::spawn(&mut serve(folders[0].path(), &url));
    let said = refusal(&mut serve(folders[1].path(), &url));
    assert!(
        said.contains(&format!("is served by modalwatch {}@", first.pid())) && said.contains("store.standby"),
        "{said}"
    );

    // Two wait: alive, not ready, and refusing with a time to come back.
    let waiting = [1, 2].map(|i| Standby::start(folders[i].path(), &url, "10"));
    for standby in &waiting {
        eventually("it is alive", async || (standby.status("/healthz").await == 200).then_some(())).await;
        assert_eq!(standby.status("/readyz").await, 503);
        assert_eq!(standby.status("/v1/structures").await, 503);
    }
    for number in 0..5 {
        assert_eq!(first.post(BATCHES, &batch(number)).await.status(), 201);
    }
    first.kill();
    // Exactly one takes over.
    let ready = || async {
        let mut ready = Vec::new();
        for standby in &waiting {
            ready.push(standby.status("/readyz").await == 200);
        }
        ready
    };
    let which = eventually("one takes over", async || ready().await.iter().position(|ready| *ready)).await;
    let history = waiting[which].read("/v1/structures/three-dof/history?limit=100").await;
    assert_eq!(history["items"].as_array().unwrap().len(), 5, "{history}");
    assert!(history["items"].as_array().unwrap().iter().all(|item| item["state"] == "assessed"), "{history}");
    assert_eq!(ready().await.iter().filter(|ready| **ready).count(), 1, "both serve");
    let other = &waiting[1 - which];
    waiting[which].signal("TERM");
    eventually("the other takes over", async || (other.status("/readyz").await == 200).then_some(())).await;
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn a_service_that_hangs_is_replaced_and_ends_when_it_wakes_up() {
    if !Server::is_installed() {
        return;
    }
    let folders = [(); 2].map(|()| tempfile::tempdir().unwrap());
    let url = url_of(folders[0].path()).await.to_string();
    let mut first = Service::spawn(&mut serve(folders[0].path(), &url));
    let standby = Standby::start(folders[1].path(), &url, "2");
    eventually("it is alive", async || (standby.status("/healthz").await == 200).then_some(())).await;
    assert_eq!(first.post(BATCHES, &batch(0)).await.status(), 201);
    // As long as it lives, nobody takes over from it, however little it has to do.
    tokio::time::sleep(Duration::from_secs(5)).await;
    assert_eq!(standby.status("/readyz").await, 503);
    first.signal("STOP");
    eventually("the standby takes over", async || (standby.status("/readyz").await == 200).then_some(())).await;
    let posted = standby.client.post(format!("{}{BATCHES}", standby.url)).json(&batch(1)).send().await.unwrap();
    assert_eq!(posted.status(), 201);
    first.signal("CONT");
    assert!(!first.wait(PATIENCE).success(), "it has to end as a failure, so that its supervisor starts it again");
    let history = standby.read("/v1/structures/three-dof/history?limit=100").await;
    assert_eq!(history["items"].as_array().unwrap().len(), 2, "{history}");
}

#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn while_the_server_is_away_requests_are_told_to_come_back_and_then_it_goes_on() {
    if !Server::is_installed() {
        return;
    }
    // A server of its own, whose data survive a crash.
    let server = Server::start(&[]);
    let folder = tempfile::tempdir().unwrap();
    let url = server.database_of(folder.path());
    crate::world::done(&["migrate", "schema", "--url", &url]);
    let service = Service::spawn(&mut serve(folder.path(), &url));
    let mut acknowledged = 0;
    for round in 0..3 {
        assert_eq!(service.post(BATCHES, &batch(10 * round)).await.status(), 201);
        if round == 1 {
            server.kill();
        } else {
            server.stop();
        }
        let refused = problem(service.post(BATCHES, &batch(10 * round + 1)).await, 503, "database_unreachable").await;
        assert!(refused["detail"].as_str().unwrap().contains("repeat it"), "{refused}");
        let response = service.get("/v1/structures/three-dof/history").send().await.unwrap();
        assert!(response.headers().contains_key("retry-after"));
        problem(response, 503, "database_unreachable").await;
        let health = service.get("/readyz").send().await.unwrap();
        assert_eq!(health.status(), 503);
        let health: Value = health.json().await.unwrap();
        assert_eq!(health["reasons"][0]["code"], "database_unreachable", "{health}");
        assert_eq!(service.get("/healthz").send().await.unwrap().status(), 200);
        server.start_again();
        eventually("it is ready again", async || {
            (service.get("/readyz").send().await.unwrap().status() == 200).then_some(())
        })
        .await;
        let response = service.post(BATCHES, &batch(10 * round + 1)).await;
        assert!([200, 201].contains(&response.status().as_u16()), "{}", response.text().await.unwrap());
        acknowledged += 2;
    }
    eventually("all are assessed", async || (pending(&service).await == 0.0).then_some(())).await;
    let history = service.read("/v1/structures/three-dof/history?limit=100").await;
    let items = history["items"].as_array().unwrap();
    assert_eq!(items.len(), acknowledged, "{history}");
    assert!(items.iter().all(|item| item["state"] == "assessed"), "{history}");
}

/// Three services, of which one serves at a time, and their server; a fault every some seconds; clients that repeat what was not answered.
///
/// `MODALWATCH_CLUSTER_S` sets the seconds of load.
#[tokio::test(flavor = "multi_thread", worker_threads = 2)]
async fn under_load_and_faults_every_acknowledged_batch_is_there_once_and_as_in_a_file() {
    if !Server::is_installed() {
        return;
    }
    let seconds = std::env::var("MODALWATCH_CLUSTER_S").ok().and_then(|text| text.parse().ok()).unwrap_or(20_u64);
    let server = Server::start(&[]);
    let folders = [(); 3].map(|()| tempfile::tempdir().unwrap());
    let url = server.database_of(folders[0].path());
    crate::world::done(&["migrate", "schema", "--url", &url]);
    let mut nodes: Vec<Standby> = folders.iter().map(|folder| Standby::start(folder.path(), &url, "2")).collect();
    let begun = std::time::Instant::now();
    let (mut acknowledged, mut number, mut fault, mut odd) = (BTreeMap::new(), 0, 0, Vec::new());
    let (mut refusals, mut next_fault) = (0_usize, Duration::from_secs(4));
    while begun.elapsed() < Duration::from_secs(seconds) {
        let body = batch(number);
        'repeat: loop {
            for node in &nodes {
                let request =
                    node.client.post(format!("{}{BATCHES}", node.url)).timeout(Duration::from_secs(15)).json(&body);
                let Ok(response) = request.send().await else { continue };
                let (status, retry) = (response.status().as_u16(), response.headers().contains_key("retry-after"));
                let answer: Value = response.json().await.unwrap_or_default();
                match status {
                    200 | 201 => {
                        acknowledged.insert(number, answer["batch"].as_str().unwrap().to_owned());
                        break 'repeat;
                    }
                    503 if retry => refusals += 1,
                    _ => odd.push((number, status, answer)),
                }
            }
            assert!(begun.elapsed() < Duration::from_secs(seconds) + PATIENCE, "nobody serves any more");
            tokio::time::sleep(Duration::from_millis(100)).await;
        }
        number += 1;
        if begun.elapsed() > next_fault {
            next_fault += Duration::from_secs(5);
            let serving = acting(&nodes).await;
            match fault % 4 {
                0 => {
                    nodes[serving] = Standby::start(folders[serving].path(), &url, "2");
                }
                1 => {
                    server.stop();
                    server.start_again();
                }
                2 => {
                    nodes[serving].signal("STOP");
                    let node = nodes[serving].child.id();
                    tokio::spawn(async move {
                        tokio::time::sleep(Duration::from_secs(4)).await;
                        let _ = Command::new("kill").args(["-CONT", &node.to_string()]).status();
                    });
                }
                _ => {
                    server.kill();
                    server.start_again();
                }
            }
            fault += 1;
        }
        // A service that was taken over from ends; its supervisor starts it again.
        for (node, folder) in nodes.iter_mut().zip(&folders) {
            if exit_within(&mut node.child, Duration::ZERO).is_some() {
                *node = Standby::start(folder.path(), &url, "2");
            }
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    assert!(odd.is_empty(), "answers that no client expects: {odd:?}");
    for node in &nodes {
        node.signal("CONT");
    }
    drop(nodes);
    let service = within(PATIENCE, "a service that starts", async || {
        let mut command = serve(folders[0].path(), &url);
        command.env("MODALWATCH__STORE__STANDBY", "true");
        Some(Service::spawn(&mut command))
    })
    .await;
    within(Duration::from_mins(2), "all are assessed", async || (pending(&service).await == 0.0).then_some(())).await;

    // The same batches, one after another, in a file.
    let folder = tempfile::tempdir().unwrap();
    let file = Service::start(folder.path());
    for number in 0..number {
        assert_eq!(file.post(BATCHES, &batch(number)).await.status(), 201);
    }
    let (found, expected) = (results(&service).await, results(&file).await);
    assert_eq!(found.len(), acknowledged.len(), "a batch is missing or there twice");
    for (number, id) in &acknowledged {
        let path = format!("{BATCHES}/{id}");
        let stored = answer(&service, Method::GET, &path, None).await;
        assert_eq!(stored["status"], 200, "batch {number} was acknowledged: {stored}");
    }
    assert_eq!(found, expected);
    println!("{} batches, {fault} faults, {refusals} refusals with Retry-After in {seconds} s", acknowledged.len());
}

/// Index of the service that serves now.
async fn acting(nodes: &[Standby]) -> usize {
    eventually("one serves", async || {
        for (i, node) in nodes.iter().enumerate() {
            if node.status("/readyz").await == 200 {
                return Some(i);
            }
        }
        None
    })
    .await
}

/// The numbers of each batch, by the time of its first measurement.
async fn results(service: &Service) -> BTreeMap<String, Value> {
    let all = answers(service, "three-dof").await;
    let batches = all.iter().filter(|(path, _)| path.contains("/batches/"));
    batches
        .map(|(_, answer)| {
            let body = &answer["body"];
            let assessment = &body["assessment"];
            let numbers = json!({
                "measurements": body["measurements"], "parameters": assessment["parameters"], "trust": assessment["trust"],
                "findings": assessment["findings"], "state": body["state"],
            });
            (body["measurements"][0]["measured_at"].as_str().unwrap().to_owned(), numbers)
        })
        .collect()
}
